"""Physical gradients: an inverse simulator as the derivative rule of a simulator."""

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
    r"""Give a simulator a derivative rule that uses its inverse simulator.

    Parameters
    ----------
    physics : callable
        ``physics(x)`` returns y; arrays. Plain NumPy is enough.
    inverse : callable
        ``inverse(y, x)`` returns an x for which physics(x) is near y, near the present x. It may be local, approximate,
        damped or learned.
    rate : float
        Step in y per cotangent: 1 / (second derivative of the loss in y).
    name : str
        Appears in counts.

    Returns
    -------
    callable
        ``f(x)``, differentiable once; it works on one sample and on a batch alike.

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
    The value is y = physics(x). For a cotangent g = dL/dy the rule returns

        x - inverse(y - rate g, x),

    the difference of x and the input from which the simulator would reach a better result. For the network that
    computed x this is the gradient of the proxy loss |x - x*|^2 / 2 with x* = inverse(y - rate g, x) held fixed. So
    each network keeps its own gradient, and the scale of the physics does not matter. For L = |y - t|^2 / 2 and rate 1
    the target is t itself, and gradient descent with rate 1 on x solves the problem in one step.

    This is an update, not the derivative of the physics; dp.check.gradient reports the difference.

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
    rule.made = physical_gradient, (physics, inverse, rate, name)
    return rule


@dataclass
class PhysicalGradient(Method):
    """Gradient descent with rate 1 on x, with the derivative rule of `physical_gradient`.

    Parameters
    ----------
    physics, inverse : callable
        As for dp.physical_gradient; required. The loss is a function of y = physics(x).
    rate : float
        Factor of the step in y.

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
        """Never: every admissible step is taken."""
        return False

    def composed(self, loss: Callable[..., Any]) -> Callable[..., Any]:
        """Return the loss as a function of x, given that of y."""

        def loss_of_x(x, *batch):
            return loss(self._simulator(x), *batch)

        return loss_of_x

    def begin(self, first: Evaluation) -> DescentState:
        """Return the state at the start."""
        return self._descent.begin(first)

    def advance(self, state: DescentState, objective: Objective) -> DescentState:
        """Return the state after one iteration. Raises NoStepFound if no admissible point is found."""
        return self._descent.advance(state, objective)
