"""Physical gradients: an inverse simulator as the backward rule of a simulator."""

import autograd.numpy as anp

from sparsedp._utils.validation import check_number, check_shape
from sparsedp.autodiff.tape import differentiable, plain
from sparsedp.optimize.first_order import Descent

__all__ = ["PhysicalGradient", "physical_gradient"]


def physical_gradient(physics, inverse, rate=1.0, name="physical gradient"):
    r"""Simulator and inverse simulator -> the simulator with a backward rule that inverts it.

    The value is y = physics(x). The cotangent that the rule hands back for a cotangent g = dL/dy is

        x - inverse(y - rate g, x)

    the step from where the inverse simulator would have to start to reach a better end, back to x. For the network
    that made x this is the gradient of the proxy loss |x - x*|^2 / 2 with x* = inverse(y - rate g, x) held fixed, so
    each network keeps its own gradient, and the scale of the physics drops out. For L = |y - t|^2 / 2 and rate 1
    the target is t itself, and gradient descent with rate 1 on x solves the problem in one step.

    Parameters
    ----------
    physics : callable
        ``physics(x) -> y``, arrays; plain NumPy is enough.
    inverse : callable
        ``inverse(y, x) -> x``, near the present x; it may be local, approximate, damped or learned.
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
        On the way back, if the inverse returns another shape than x.

    Notes
    -----
    This is not the derivative of the physics, and dp.check.gradient will say so; it is an update.
    Source: P. Holl, V. Koltun, N. Thuerey, Scale-invariant learning by physics inversion, NeurIPS 2022.

    Examples
    --------
    >>> cube = physical_gradient(lambda x: x**3, lambda y, x: anp.sign(y) * abs(y) ** (1 / 3))
    >>> from sparsedp.autodiff.derivative import value_and_grad
    >>> loss = lambda x: 0.5 * (cube(x) - 8.0) ** 2
    >>> value, update = value_and_grad(loss)(1.0)
    >>> round(1.0 - update, 12)  # x - update is the solution
    2.0
    """
    rate = check_number("rate of physical_gradient", rate, "> 0", "; the default is 1")

    def vjp(nums, y, x):
        def pull(g):
            here = plain(x)
            start = inverse(plain(y) - rate * plain(g), here)
            check_shape(f"x from the inverse of {name}", start, anp.shape(here))
            return (here - start,)

        return pull

    rule = differentiable(name, physics, vjp)
    rule.made = physical_gradient, (physics, inverse, rate, name)
    return rule


class PhysicalGradient(Descent):
    """The method of minimize: gradient descent with rate 1 on x, through the inverse simulator.

    Parameters
    ----------
    physics, inverse : callable
        As for dp.physical_gradient; `loss` is then a function of y = physics(x).
    rate : float
    """

    def __init__(self, physics=None, inverse=None, rate=1.0):
        if physics is None or inverse is None:
            raise TypeError(
                "physical_gradient needs physics and inverse; write minimize(loss_of_y, x, 'physical_gradient', "
                "physics=f, inverse=f_inverse)"
            )
        super().__init__(rate=1.0)
        self.rule = physical_gradient(physics, inverse, rate)
