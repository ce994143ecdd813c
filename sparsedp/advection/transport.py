"""transport: one time step of the advection of a field by a velocity."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, overload

import numpy as np

from sparsedp._utils.base_classes import Frozen, Reconstructible
from sparsedp._utils.calls import public
from sparsedp._utils.validation import check_choice
from sparsedp.advection.arguments import check_inflow, check_step, flatten_array
from sparsedp.advection.cut_transport import CutTransport
from sparsedp.advection.eulerian import Eulerian
from sparsedp.advection.maccormack import MacCormack
from sparsedp.advection.method import Identity, TransportMethod
from sparsedp.advection.rule import rule_of
from sparsedp.advection.semi_lagrangian import SemiLagrangian
from sparsedp.advection.settings import TransportSettings
from sparsedp.autodiff.tape import isbox
from sparsedp.errors import DerivativeError
from sparsedp.grid.boundary_conditions import (
    MixedWall,
    conditions_of,
    describe_patches,
    dirichlet,
    neumann,
    resolve,
    walls_of,
)
from sparsedp.grid.grid import check_grid
from sparsedp.kernels.fluxes import SCHEMES
from sparsedp.operators.masks_and_lift import Body, check_solid
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.base import Matrix

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from sparsedp.grid.grid import Grid
    from sparsedp.grid.space import Space

__all__ = ["Transport", "transport"]

METHODS: dict[str, type[TransportMethod]] = {
    **dict.fromkeys(SCHEMES, Eulerian),
    "semi_lagrangian": SemiLagrangian,
    "maccormack": MacCormack,
}
CHOICES = {  # the accepted values of the options; the first one is the default
    "velocity": ("faces", "cells"),
    "of": ("cells", "faces"),
    "interpolation": ("linear", "cubic"),
    "form": (None, "flux", "advective"),
    "backtrace": ("euler", "midpoint"),
    "clamp": (True, False),
    "unstable": ("raise", "allow"),
}


@overload
def transport(
    grid: Grid,
    scheme: str = ...,
    boundary: Any = ...,
    velocity: str = ...,
    of: str = ...,
    interpolation: str = ...,
    form: str | None = ...,
    backtrace: str = ...,
    clamp: bool = ...,
    solid: ArrayLike | None = ...,
    unstable: str = ...,
) -> Transport: ...
@overload
def transport(
    grid: Grid,
    scheme: str = ...,
    boundary: Any = ...,
    *,
    form: str | None = ...,
    solid: Body,
    unstable: str = ...,
) -> CutTransport: ...
def transport(
    grid: Grid,
    scheme: str = "upwind",
    boundary: Any = neumann,
    velocity: str = "faces",
    of: str = "cells",
    interpolation: str = "linear",
    form: str | None = None,
    backtrace: str = "euler",
    clamp: bool = True,
    solid: ArrayLike | Body | None = None,
    unstable: str = "raise",
) -> Transport | CutTransport:
    """Return one time step of transport, ``move(u, v, dt, inflow=0.0)``, differentiable in all four arguments.

    Parameters
    ----------
    grid : Grid
    scheme : "upwind", "van_leer", "semi_lagrangian" or "maccormack"
        ===============  =====  ======================  ===========================================================
        scheme           order  time step               properties
        ===============  =====  ======================  ===========================================================
        upwind           1      CFL number at most 1    linear in u, conserves the sum, derivatives of every order
        van_leer         2      CFL number at most 1/2  limited slopes, two stages; order 1 at extrema
        semi_lagrangian  1      any                     linear in u, preserves constants, does not conserve the sum
        maccormack       2      any                     semi_lagrangian, corrected by half the error of going back
        ===============  =====  ======================  ===========================================================

        The CFL number of a point is the sum of |v| dt / h over its sides through which the flow leaves (form "flux") or
        enters (form "advective"). semi_lagrangian interpolates u at the departure point of each point, the position at
        distance v dt upstream. maccormack is of order 2 in time if v is the mean of the velocities at the beginning and
        at the end of the step, and of order 1 if v is one of these velocities. Both schemes work on cells of any width.
        Except upwind, all schemes have first derivatives only; in u alone, semi_lagrangian has derivatives of every
        order.
    boundary : condition, or dict of conditions
        Values that enter where the velocity points inwards: for dirichlet `inflow`, for neumann the value of the point
        at the wall. Where the velocity points outwards, both conditions let the field leave. For a closed wall, set
        the velocity to 0. semi_lagrangian and maccormack use these values from one spacing beyond the last point on.
        An inflow through part of a wall is written with `patch`. Of a face field, the points at the end of a patch lie
        between two faces of the wall; they have inflow if one of these faces has.
    velocity : "faces" or "cells"
        "faces": v is a flat face field. "cells": v has the shape (dim, *grid.shape), in 1-D also grid.shape.
    of : "cells" or "faces"
        Whether u is a cell field or a flat face field. Of a face field each component is transported. The velocity is
        then interpolated to the control volumes of the faces (half cells at walls): linearly between cell centres, by
        the mean of both faces at a cell centre, and by the mean weighted with the widths on sides in two cells.
    interpolation : "linear" or "cubic"
        For semi_lagrangian and maccormack. linear: order 1, no new extrema. cubic (Catmull-Rom): order 2 to 3 where the
        field is smooth, may create small new extrema; distances of neighbouring points may change by a factor of at
        most 5.
    form : "flux" or "advective", optional
        For upwind and van_leer. flux: du/dt = -div(v u), conserves the sum of u times volume. advective: du/dt =
        -v . grad u, preserves constants. Default: flux for a velocity on faces, advective for one on cells.
    backtrace : "euler" or "midpoint"
        For semi_lagrangian and maccormack: the velocity that determines a departure point. euler: the velocity at the
        point itself. midpoint: the velocity half-way along the path.
    clamp : bool
        For maccormack: whether to clamp the result to the least and greatest value of u at the corners of the cell
        around the departure point, so that there are no new extrema.
    solid : bool array, shape grid.shape, or body of `cut_cells`, optional
        Solid cells. There is no flux through their faces, and their values do not change. semi_lagrangian and
        maccormack, when they interpolate u, replace the value of a solid cell by the mean of its fluid neighbours.
        Around a body of `cut_cells` upwind and van_leer in flux form are steps with its `advection`; cells of less
        than half a cell count as half cells in the CFL number.
    unstable : "raise" or "allow"
        For upwind and van_leer: whether to raise UnstableStepError if the CFL number exceeds the limit of the scheme.

    Returns
    -------
    Transport
        ``move(u, v, dt, inflow=0.0)`` returns the field after the step. u [unit], v [length / time], dt [time]; inflow
        [unit] is a number, or an array with one value for each point of ``move.walls`` (x-lower, x-upper, y-lower, ...,
        for each component in turn). Values at sides that are not dirichlet are not used.

    Raises
    ------
    ValueError
        If an option has another value than those above or is not used by the scheme, or if a condition is neither
        dirichlet nor neumann. On use, if dt <= 0, or if inflow is traced or not 0 although no side is dirichlet.
    UnstableStepError
        On use, if dt is too large for the stability of the scheme.
    NonFiniteError, ShapeError, TypeError
        On use, if u, v or inflow hold NaN or infinity, have a wrong shape, or are not real, respectively.
    DerivativeError
        If `solid` is traced.

    See Also
    --------
    upwind, conservation_law, cut_cells, flow_step, convection, dirichlet, neumann, patch

    Notes
    -----
    Options by scheme. The first value is the default. An option that the scheme does not use raises ValueError.

    =============  =========================  ===========================
    option         values                     schemes
    =============  =========================  ===========================
    velocity       "faces", "cells"           all
    of             "cells", "faces"           all
    form           None, "flux", "advective"  upwind, van_leer
    unstable       "raise", "allow"           upwind, van_leer
    interpolation  "linear", "cubic"          semi_lagrangian, maccormack
    backtrace      "euler", "midpoint"        semi_lagrangian, maccormack
    clamp          True, False                maccormack
    =============  =========================  ===========================

    Limiters and clamps (van_leer, and maccormack unless clamp=False) have kinks in u where neighbouring values are
    equal, for example where a field is 0. The derivative there is one of several one-sided derivatives or their mean,
    and `check.gradient` returns "inconclusive".

    References
    ----------
    R. Courant, E. Isaacson, M. Rees, Comm. Pure Appl. Math. 5 (1952) 243-255.
    B. van Leer, J. Comput. Phys. 32 (1979) 101-136.
    A. Staniforth, J. Cote, Monthly Weather Review 119 (1991) 2206-2223.
    A. Selle, R. Fedkiw, B. Kim, Y. Liu, J. Rossignac, J. Sci. Comput. 35 (2008) 350-371.

    Examples
    --------
    >>> from sparsedp import Grid
    >>> move = transport(Grid(4, periodic=True))
    >>> move(np.array([0.0, 1.0, 0.0, 0.0]), np.ones(4), 0.25)
    array([0.  , 0.75, 0.25, 0.  ])
    """
    check_grid("transport", grid)
    check_choice("scheme= of transport", scheme, METHODS)
    options = METHODS[scheme].options
    choices = dict(
        velocity=velocity,
        of=of,
        interpolation=interpolation,
        form=form,
        backtrace=backtrace,
        clamp=clamp,
        unstable=unstable,
    )
    for name, choice in choices.items():
        advice = "; write backtrace= or clamp=" if name == "form" else ""  # form= before version 0.2
        check_choice(f"{name}= of transport", choice, CHOICES[name], advice)
        if choice != CHOICES[name][0] and name not in ("velocity", "of", *options):
            raise ValueError(f"transport {scheme} does not use {name}; leave it out")
    if "form" in options and form is None:
        if velocity == "faces":
            form = "flux"
        else:
            form = "advective"
    body = None
    if isinstance(solid, Body):
        body, solid = solid, None
    settings = TransportSettings(
        grid=grid,
        scheme=scheme,
        sides=_sides(grid, boundary),
        velocity=velocity,
        of=of,
        interpolation=interpolation,
        form=form,
        backtrace=backtrace,
        clamp=clamp,
        solid=None if solid is None else check_solid(grid, solid).copy(),
        unstable=unstable,
    )
    if body is not None:
        _check_body(settings, body)
        return CutTransport(settings, body)
    return Transport(settings)


def _check_body(settings, body):
    """Raise ValueError for options that transport around a body of cut_cells does not have."""
    if settings.grid != body.grid:
        raise ValueError(f"transport takes a body of cut_cells on its grid {settings.grid}, got one on {body.grid}")
    form = settings.scheme, settings.velocity, settings.of, settings.form
    if form not in (("upwind", "faces", "cells", "flux"), ("van_leer", "faces", "cells", "flux")):
        raise ValueError(
            "transport around a body of cut_cells takes upwind or van_leer in flux form, of cells with a velocity on "
            f"faces, got scheme={settings.scheme!r}, form={settings.form!r}, of={settings.of!r}, "
            f"velocity={settings.velocity!r}"
        )
    if any(isinstance(wall, MixedWall) for _, _, wall in walls_of(settings.sides)):
        raise ValueError(
            "transport around a body of cut_cells takes one condition for each wall, got a patch; write "
            "u + dt * body.advection(u, v, inflow) with inflow on faces"
        )


def _sides(grid: Grid, boundary: Any) -> tuple:
    """Return the conditions of both sides of each axis; raise unless they are dirichlet or neumann."""
    sides = resolve(grid, boundary, patches=True)
    for _, _, wall in walls_of(sides):
        for condition in conditions_of(wall):
            if condition not in (dirichlet, neumann):
                raise ValueError(
                    f"transport takes dirichlet (inflow values) or neumann (outflow), got {condition}; "
                    "write boundary=dp.dirichlet"
                )
    return sides


def method_and_rule(settings: TransportSettings) -> tuple[TransportMethod, Any]:
    """Return the scheme, and a step of it as a differentiable function."""
    if settings.grid.cells.size:
        method = METHODS[settings.scheme](settings)
    else:
        method = Identity(settings)
    return method, rule_of(method)


class Transport(Frozen, Reconstructible):
    """One time step of transport, ``move(u, v, dt, inflow=0.0)``, as `transport` returns it. Immutable.

    Parameters
    ----------
    settings : TransportSettings

    Attributes
    ----------
    settings : TransportSettings
    method : TransportMethod
        The scheme, as plain functions of flat arrays.
    """

    settings: TransportSettings
    method: TransportMethod
    _rule: Any

    def __init__(self, settings: TransportSettings) -> None:
        method, rule = settings.grid.backend.implementation(method_and_rule)(settings)
        super().__init__(settings=settings, method=method, _rule=rule)

    def recipe(self) -> tuple:
        """Return the call that builds an equal object, for pickling and copying."""
        return Transport, (self.settings,)

    @public("dp.transport(grid)")
    def __call__(self, u: Any, v: Any, dt: Any, inflow: Any = 0.0) -> Any:
        """Return the field after one step, a new array; differentiable in every argument."""
        if not (type(inflow) is float and inflow == 0):
            check_inflow(self.method.name, self.settings, inflow)
        return self._rule(u, v, dt, inflow)

    @property
    def space(self) -> Space:
        """Space of the transported field."""
        return self.settings.space

    @property
    def walls(self) -> Space:
        """Space of the inflow values; ``move.walls.join(...)`` builds them from an array or number for each wall."""
        return self.method.walls

    def operator(self, v: ArrayLike, dt: float) -> Operator:
        """Return the step for a constant velocity as an Operator with a matrix, for inflow values of 0.

        Parameters
        ----------
        v : array
            Velocity, as for the call [length / time].
        dt : float
            Time step > 0 [time].

        Returns
        -------
        Operator

        Raises
        ------
        ValueError
            If the scheme is not linear in u, or dt <= 0.
        DerivativeError
            If v or dt are traced, because an Operator must be constant.

        Examples
        --------
        >>> from sparsedp import Grid
        >>> move = transport(Grid(3, periodic=True))
        >>> move.operator(np.ones(3), 0.5).matrix.toarray()
        array([[0.5, 0. , 0.5],
               [0.5, 0.5, 0. ],
               [0. , 0.5, 0.5]])
        """
        settings = self.settings
        name = self.method.name
        settings.grid.backend.check("transport.operator")
        if not self.method.linear:
            raise ValueError(
                f"{name} is not linear in u and has no matrix; write scheme='upwind', or call move(u, v, dt)"
            )
        if isbox(v) or isbox(dt):
            raise DerivativeError(
                f"{name}.operator needs constant v and dt, got traced ones; call move(u, v, dt) instead"
            )
        dt = check_step(name, dt)
        flat = flatten_array(name, "v", v, self.method.velocity_shapes)
        return Operator(Matrix(self.method.matrix(flat, dt)), self.space, self.space, name)

    def __getattr__(self, name: str) -> Any:
        advice = "; write lambda u, v: move(u, v, dt)" if name == "step" else ""  # an attribute before version 0.2
        raise AttributeError(f"transport has no attribute {name!r}{advice}")

    def __repr__(self) -> str:
        settings = self.settings
        conditions = {str(wall) for _, _, wall in walls_of(settings.sides) if not isinstance(wall, MixedWall)}
        words = [f"velocity on {settings.velocity}"]
        if settings.form:
            words.append(f"{settings.form} form")
        else:
            words += [settings.interpolation, settings.backtrace]
        words += sorted(conditions)
        patches = describe_patches(settings.sides).strip("[]")
        if patches:
            words.append(patches)
        if settings.solid is not None:
            words.append(f"{np.count_nonzero(settings.solid)} solid cells")
        return f"<transport {settings.scheme}: {self.space}, {', '.join(words)}>"
