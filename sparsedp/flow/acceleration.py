"""What is explicit in a step of flow: the force, less what is carried away, and explicit viscosity.

a(v) = force(v) - div(v v) + nu (L v + B)
"""

from typing import Any

import numpy as np

from sparsedp.errors import ShapeError, UnstableStepError
from sparsedp.fields import is_number, rounded_down
from sparsedp.tape import dtype_of, plain

__all__ = ["Acceleration", "Viscous"]

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
