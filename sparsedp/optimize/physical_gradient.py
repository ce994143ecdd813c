"""Physical gradients: the backward pass of a simulator is replaced by its inverse simulator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import autograd.numpy as anp

from sparsedp._utils.validation import check_number, check_shape
from sparsedp.autodiff.tape import differentiable, plain
from sparsedp.optimize.first_order import DescentState, GradientDescent
from sparsedp.optimize.method import Method

if TYPE_CHECKING:
    from sparsedp.optimize.objective import Objective
    from sparsedp.optimize.result import Evaluation

__all__ = ["PhysicalGradient", "physical_gradient"]


def physical_gradient(
    physics: Callable[[Any], Any],
    inverse: Callable[[Any, Any], Any],
    rate: float = 1.0,
    name: str = "physical gradient",
) -> Callable[[Any], Any]:
    r"""Return a simulator whose backward pass uses an inverse simulator instead of the derivative.

    Parameters
    ----------
    physics : callable
        ``physics(x)`` maps an array x to an array y. It is not differentiated, so any NumPy code can be used.
    inverse : callable
        ``inverse(y, x)`` returns an array x' close to x for which physics(x') is close to y. It may be approximate, for
        example a few damped iterations or a trained network.
    rate : float
        Step size in y; 1 / (second derivative of the loss with respect to y) is a good value.
    name : str
        Name of the function in the counts of `explain`.

    Returns
    -------
    callable
        ``f(x)``, which can be differentiated once. If `physics` and `inverse` accept batches, so does f.

    Raises
    ------
    ValueError
        If the rate is not positive.
    ShapeError
        In the backward pass, if the inverse returns another shape than x.

    See Also
    --------
    minimize, update_direction

    Notes
    -----
    The forward pass computes y = physics(x). For a cotangent g = dL/dy the backward pass returns

        x - x*,    x* = inverse(y - rate g, x),

    where x* is an input for which the simulator gives a better output. If a network computed x, its gradient is that of
    the proxy loss |x - x*|^2 / 2 with constant x*. Thus the network is differentiated as usual, while the scaling of
    the physics has no effect on the step. For L = |y - t|^2 / 2 and rate 1, x* = inverse(t, x), so that one step of
    gradient descent with learning rate 1 on x solves the problem if the inverse is exact.

    The result is an update direction, not the derivative of the physics. Therefore dp.check.gradient reports an error.

    References
    ----------
    P. Holl, V. Koltun, N. Thuerey, Scale-invariant learning by physics inversion, NeurIPS 2022.

    Examples
    --------
    >>> cube = physical_gradient(lambda x: x**3, lambda y, x: anp.sign(y) * abs(y) ** (1 / 3))
    >>> from sparsedp import value_and_grad
    >>> loss = lambda x: 0.5 * (cube(x) - 8.0) ** 2
    >>> value, update = value_and_grad(loss)(1.0)
    >>> round(1.0 - update, 12)  # x - update is the solution
    2.0
    """
    rate = check_number("rate of physical_gradient", rate, "> 0", "; the default is 1")

    def vjp(nums, y, x):
        def pull(cotangent):
            current = plain(x)
            target = inverse(plain(y) - rate * plain(cotangent), current)
            check_shape(f"x from the inverse of {name}", target, anp.shape(current))
            return (current - target,)

        return pull

    rule = differentiable(name, physics, vjp)
    rule.constructor_call = physical_gradient, (physics, inverse, rate, name)
    return rule


@dataclass
class PhysicalGradient(Method):
    """Gradient descent with learning rate 1 on x, with the backward pass of `physical_gradient`.

    Parameters
    ----------
    physics, inverse : callable
        As for dp.physical_gradient. Required. The loss is a function of y = physics(x).
    rate : float
        Step size in y.

    Notes
    -----
    x <- inverse(y - rate dL/dy, x).

    References
    ----------
    P. Holl, V. Koltun, N. Thuerey, Scale-invariant learning by physics inversion, NeurIPS 2022.
    """

    name: ClassVar[str] = "physical_gradient"
    physics: Callable[[Any], Any] | None = None
    inverse: Callable[[Any, Any], Any] | None = None
    rate: float = 1.0

    def __post_init__(self) -> None:
        if self.physics is None or self.inverse is None:
            raise TypeError(
                "physical_gradient needs physics and inverse; write minimize(loss_of_y, x, 'physical_gradient', "
                "physics=f, inverse=f_inverse)"
            )
        self._descent = GradientDescent(rate=1.0)
        self._simulator = physical_gradient(self.physics, self.inverse, self.rate)

    @property
    def compares_losses(self) -> bool:
        """False: every step to a point with a finite loss is accepted."""
        return False

    def composed(self, loss: Callable[..., Any]) -> Callable[..., Any]:
        """Return the loss as a function of x, given the loss as a function of y = physics(x)."""

        def loss_of_x(x, *batch):
            return loss(self._simulator(x), *batch)

        return loss_of_x

    def begin(self, first: Evaluation) -> DescentState:
        """Return the state at the start."""
        return self._descent.begin(first)

    def advance(self, state: DescentState, objective: Objective) -> DescentState:
        """Return the state after one iteration. Raises NoStepFound if no admissible point is found."""
        return self._descent.advance(state, objective)
