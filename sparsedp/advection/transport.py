"""transport: a field carried by a velocity for one time step. The schemes are laws in files of their own."""

import numpy as np

from sparsedp._utils.calls import public
from sparsedp._utils.reconstruction import Frozen, Remade
from sparsedp._utils.validation import check_choice
from sparsedp.advection.eulerian import Eulerian
from sparsedp.advection.law import Law, Setting
from sparsedp.advection.maccormack import MacCormack
from sparsedp.advection.no_cells import NoCells
from sparsedp.advection.rule import rule_of
from sparsedp.advection.semi_lagrangian import SemiLagrangian
from sparsedp.advection.values import check_step, flat_numbers
from sparsedp.autodiff.tape import Rule, isbox
from sparsedp.errors import DerivativeError
from sparsedp.grid.boundary_conditions import dirichlet, neumann, resolve
from sparsedp.grid.grid import check_grid
from sparsedp.kernels.fluxes import SCHEMES
from sparsedp.operators.masks_and_lift import check_solid
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.base import Matrix

__all__ = ["Transport", "transport"]

LAWS = {**dict.fromkeys(SCHEMES, Eulerian), "semi_lagrangian": SemiLagrangian, "maccormack": MacCormack}
CHOICES = {  # the first one is the default; a scheme says in `options` which of the last five it uses
    "velocity": ("faces", "cells"),
    "of": ("cells", "faces"),
    "interpolation": ("linear", "cubic"),
    "form": (None, "flux", "advective"),
    "backtrace": ("euler", "midpoint"),
    "clamp": (True, False),
    "unstable": ("raise", "allow"),
}


def transport(
    grid,
    scheme="upwind",
    boundary=neumann,
    velocity="faces",
    of="cells",
    interpolation="linear",
    form=None,
    backtrace="euler",
    clamp=True,
    solid=None,
    unstable="raise",
):
    """Grid -> one time step of transport, ``move(u, v, dt, inflow=0.0)``, differentiable in all four.

    Parameters
    ----------
    grid : Grid
    scheme : "upwind", "van_leer", "semi_lagrangian" or "maccormack"
        ===============  =====  ======================  ===========================================================
        scheme           order  time step               properties
        ===============  =====  ======================  ===========================================================
        upwind           1      CFL number at most 1    linear in u, conserves the sum, derivatives of every order
        van_leer         2      CFL numbers sum to 1/2  limited slopes, two stages; 1 at extrema; first derivatives
        semi_lagrangian  1      any                     linear in u, keeps constants, does not conserve the sum
        maccormack       2      any                     semi_lagrangian and back, half of the error added
        ===============  =====  ======================  ===========================================================

        semi_lagrangian takes the value of the place that the content of a point comes from. maccormack is of order 2 in
        time too where v is the mean of the velocities at both ends of the step, and of order 1 where it is that of one
        end. Both work on cells of any width, with first derivatives (in u alone of every order).
    boundary : condition, or dict of conditions
        Where the velocity points inwards: dirichlet brings in `inflow`, neumann the value of the
        point at the wall. Outwards the field leaves in both cases. A closed wall is a velocity of 0 there.
        semi_lagrangian, maccormack: these values stand one spacing beyond the last point and further out.
    velocity : "faces" or "cells"
        "faces": v is a flat face field. "cells": v has the shape (dim, *grid.shape), in 1-D also grid.shape.
    of : "cells" or "faces"
        What u is: a cell field, or a flat face field each component of which is carried. The velocity is
        then interpolated to the control volumes of the faces (half cells at walls), linearly between
        cells, as the mean inside a cell, and with the flow through both half cells along a side.
    interpolation : "linear" or "cubic"
        Of semi_lagrangian and maccormack. linear: order 1, no new extrema. cubic (Catmull-Rom): order 2 to 3
        where the field is smooth, small new extrema; widths of cells may change by a factor of 5 from one to the next.
    form : "flux" or "advective", optional
        Of upwind and van_leer. flux: du/dt = -div(v u), conserves the sum of u times volume. advective: du/dt =
        -v . grad u, keeps constants. Default: flux for a velocity on faces, advective for one on cells.
    backtrace : "euler" or "midpoint"
        Of semi_lagrangian and maccormack: how a departure point is found, along the velocity at the point itself or
        along the one half way.
    clamp : bool
        Of maccormack: to the least and greatest sample of the cell around the departure point.
    solid : bool array, shape grid.shape, optional
        Nothing passes through a face that touches a solid cell; what is in solid cells stays.
        semi_lagrangian, maccormack: looked at from outside, a solid cell has the mean of its fluid neighbours.
    unstable : "raise" or "allow"
        Of upwind and van_leer: what to do when a point would get a negative weight (CFL number above 1).

    Returns
    -------
    Transport
        ``move(u, v, dt, inflow=0.0)``: u [unit], v [length / time], dt [time], inflow [unit] a number or one
        value for each place of ``move.walls`` (x-lower, x-upper, y-lower, ..., each component in turn).

    Raises
    ------
    ValueError
        If a word is not one of those above, an option is given that the scheme does not use, or a condition is
        neither dirichlet nor neumann. On use: dt <= 0.
    UnstableStepError
        On use, if the step is larger than the scheme allows.
    NonFiniteError, ShapeError, TypeError
        On use, if u, v or inflow hold NaN or infinity, have another shape, or are no real numbers.
    DerivativeError
        If `solid` is traced.

    Notes
    -----
    Limiters and clamps (van_leer, maccormack but for clamp=False) have kinks in u where neighbours are equal, as in a
    field that is 0 in places. The derivative is one of several there, and `check.gradient` says "inconclusive".

    Source
    ------
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
    check_choice("scheme= of transport", scheme, LAWS)
    words = dict(velocity=velocity, of=of, interpolation=interpolation, form=form, backtrace=backtrace, clamp=clamp)
    words["unstable"] = unstable
    for name, word in words.items():
        advice = "; write backtrace= or clamp=" if name == "form" else ""  # words of form in the first edition
        check_choice(f"{name}= of transport", word, CHOICES[name], advice)
        if word != CHOICES[name][0] and name not in ("velocity", "of", *LAWS[scheme].options):
            raise ValueError(f"transport {scheme} does not use {name}; leave it out")
    if "form" in LAWS[scheme].options and form is None:
        words["form"] = "flux" if velocity == "faces" else "advective"
    solid = None if solid is None else check_solid(grid, solid).copy()
    return Transport(Setting(grid, scheme, _sides(grid, boundary), solid=solid, **words))


def _sides(grid, boundary):
    sides = resolve(grid, boundary)
    for condition in [condition for pair in sides for condition in pair or ()]:
        if condition not in (dirichlet, neumann):
            raise ValueError(f"transport takes dirichlet (inflow values) or neumann (outflow), got {condition}")
    return sides


class Transport(Frozen, Remade):
    """One time step of transport, made by `transport`. Call it: ``move(u, v, dt, inflow=0.0)``. Frozen."""

    setting: Setting
    law: Law
    _rule: Rule

    def __init__(self, setting):
        layout, kind = setting.grid.layout, LAWS[setting.scheme] if setting.grid.cells.size else NoCells
        law = (Law if layout else kind)(setting)
        super().__init__(setting=setting, law=law, _rule=layout.transport(setting) if layout else rule_of(law))

    def recipe(self):
        """The call that makes it again: see _utils/reconstruction.py."""
        return Transport, (self.setting,)

    @public("dp.transport(grid)")
    def __call__(self, u, v, dt, inflow=0.0):
        """The field after one step; differentiable in every argument; the result is fresh."""
        return self._rule(u, v, dt, inflow)

    @property
    def space(self):
        """Where the moved field lives."""
        return self.setting.space

    @property
    def walls(self):
        """Where inflow values live; ``move.walls.join(...)`` makes them from one array or number for each wall."""
        return self.law.walls

    def operator(self, v, dt):
        """Velocity, time step -> the step as an explicit Operator on u, without what flows in.

        Parameters
        ----------
        v : array
            As for the call [length / time].
        dt : float
            [time]

        Returns
        -------
        Operator

        Raises
        ------
        ValueError
            If the scheme is not linear in u, or dt <= 0.
        DerivativeError
            If v or dt are traced: an Operator is constant.

        Examples
        --------
        >>> from sparsedp import Grid
        >>> move = transport(Grid(3, periodic=True))
        >>> move.operator(np.ones(3), 0.5).matrix.toarray()
        array([[0.5, 0. , 0.5],
               [0.5, 0.5, 0. ],
               [0. , 0.5, 0.5]])
        """
        name = self.law.name
        if self.setting.grid.layout:
            self.setting.grid.layout.check("transport.operator")
        if not self.law.linear:
            raise ValueError(
                f"{name} is not linear in u and has no matrix; write scheme='upwind', or call move(u, v, dt)"
            )
        if isbox(v) or isbox(dt):
            raise DerivativeError(
                f"{name}.operator needs constant v and dt, got traced ones; call move(u, v, dt) instead"
            )
        dt, flat = check_step(name, dt), flat_numbers(name, "v", v, self.law.velocity_shapes)
        return Operator(Matrix(self.law.matrix(flat, dt)), self.space, self.space, name)

    def __getattr__(self, name):
        advice = "; write lambda u, v: move(u, v, dt)" if name == "step" else ""  # of the first edition
        raise AttributeError(f"transport has no attribute {name!r}{advice}")

    def __repr__(self):
        setting = self.setting
        conditions = {str(c) for pair in setting.sides for c in pair or ()}
        own = f"{setting.form} form" if setting.form else f"{setting.interpolation}, {setting.backtrace}"
        words = [f"velocity on {setting.velocity}", own, *sorted(conditions)]
        if setting.solid is not None:
            words.append(f"{np.count_nonzero(setting.solid)} solid cells")
        return f"<transport {setting.scheme}: {self.space}, {', '.join(words)}>"
