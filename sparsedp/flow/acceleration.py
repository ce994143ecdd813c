"""What is explicit in a step of flow: the force, less what is carried away, and explicit viscosity.

    a(v) = force(v) - div(v v) + nu (L v + B)

The parts carry their derivatives without the tape; what the user wrote, the force and a viscosity of params,
is put on a small tape of its own.
"""

from typing import Any

import numpy as np

from sparsedp.derivative import pullback
from sparsedp.errors import ShapeError, UnstableStepError
from sparsedp.fields import is_number, rounded_down
from sparsedp.tape import dtype_of, is_variable, plain
from sparsedp.tree import flatten, leaves

__all__ = ["Acceleration", "Viscous", "total"]

ROUNDING = 1e-12  # a step at the limit may lie beyond it by rounding


class Viscous:
    """nu (L v + B), nu a number or a function of params; refused where the step is not stable.

    Parameters
    ----------
    laplacian : Operator
    walls : array or None
        B, what moving walls add.
    viscosity : float or callable
    dt : float
    """

    def __init__(self, laplacian, walls, viscosity, dt):
        self.laplacian, self.walls, self.viscosity, self.dt = laplacian, walls, viscosity, dt
        rows = laplacian.structure.magnitude()(np.ones(laplacian.domain.size))
        self._steepest = float(np.max(rows, initial=0.0))  # no eigenvalue is beyond the largest sum of a row
        if not callable(viscosity):
            self._check(viscosity)

    def _check(self, viscosity):
        """Adams-Bashforth is stable for dt nu |lambda| <= 1."""
        rate = viscosity * self._steepest
        if self.dt * rate > 1 + ROUNDING:
            raise UnstableStepError(
                f"flow_step is unstable for viscosity = {viscosity:.6g} with dt = {self.dt:.12g}: the largest "
                f"stable dt is {rounded_down(1 / rate)}; take smaller steps or write implicit=True"
            )

    def number(self, params):
        """The viscosity."""
        if not callable(self.viscosity):
            return self.viscosity
        found = self.viscosity(params)
        if not is_number(plain(found)) or not 0 <= plain(found) < np.inf:
            raise ValueError(f"the viscosity in flow_step must be a finite number >= 0, got {plain(found)}")
        self._check(float(plain(found)))
        return found

    def _bend(self, v):
        return self.laplacian(v) if self.walls is None else self.laplacian(v) + self.walls

    def __call__(self, v, params):
        return self.number(params) * self._bend(v)

    def backward(self, v, params, g):
        """Cotangents of v and params, plain."""
        if not (callable(self.viscosity) and any(map(is_variable, leaves(params)))):
            return self.number(params) * self.laplacian.T(g), None
        number, pull = pullback(self.number, params)
        return number * self.laplacian.T(g), pull(np.sum(g * self._bend(v)))


class Acceleration:
    """The sum of those parts that a scene has; the others are None.

    Parameters
    ----------
    faces : Space
    convect : Rule or None
        div(v w).
    force : callable or None
    viscous : Viscous or None
    """

    def __init__(self, faces, convect, force, viscous):
        self.faces, self.convect, self.viscous = faces, convect, viscous
        self.force: Any = force

    def _pushed(self, v, params):
        """The force; a number is the same on all faces."""
        force = self.force(v, params)
        if np.shape(plain(force)) == ():
            return force * np.ones(v.shape, dtype_of(v))
        if np.shape(plain(force)) != v.shape:
            raise ShapeError(
                f"flow_step takes a force on {self.faces}, got an array of shape {np.shape(plain(force))}; join its "
                "components with grid.join"
            )
        return force

    def __call__(self, v, params):
        a = 0.0 * v if self.convect is None else -self.convect(v, v)
        if self.force is not None:
            a = a + self._pushed(v, params)
        return a if self.viscous is None else a + self.viscous(v, params)

    def backward(self, v, params, g):
        """Cotangents of v and params, plain: of params one tree for each part that uses them."""
        back: Any = 0.0
        slopes: list = []
        if self.convect is not None:
            back = sum(self.convect.vjp((0, 1), None, v, v)(-g))
        if self.force is not None:
            of_v, slope = pullback(lambda both: self._pushed(*both), (v, params))[1](g)
            back, slopes = back + of_v, [*slopes, slope]
        if self.viscous is not None:
            of_v, slope = self.viscous.backward(v, params, g)
            back, slopes = back + of_v, [*slopes, slope]
        return back, slopes


def total(trees):
    """The sum of trees of cotangents, leaf by leaf; None is none, and the sum of none."""
    found = [tree for tree in trees if tree is not None]
    if len(found) < 2:
        return found[0] if found else None
    (one, rebuild), others = flatten(found[0]), leaves(found[1])
    return rebuild([a if b is None else b if a is None else a + b for a, b in zip(one, others, strict=True)])
