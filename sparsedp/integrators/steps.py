"""Step: what `stepper` returns, a function of state and params for time loops."""

from math import isfinite

import numpy as np

from sparsedp.errors import NonFiniteError
from sparsedp.fields import check_finite
from sparsedp.integrators.combination import like
from sparsedp.integrators.problem import positive
from sparsedp.recipe import Remade
from sparsedp.tape import is_variable, plain
from sparsedp.tree import leaves

__all__ = ["Step"]


class Step(Remade):
    """step(state, params): the state after a time dt. Made by `stepper`.

    Parameters
    ----------
    method : str
    problem : Problem
    dt : number, traced number, or function of params
    scheme : callable
        ``scheme(u, params, t, h)``: the state after a step h.
    limit : Limit or None
        Of explicit steps.
    made : (function, arguments)
        What makes the same step again.

    Attributes
    ----------
    order : int
        Of accuracy in time.
    info : SolveLog or None
        Records of the last solves and set-up.
    taken : list of float
        With error control: the accepted lengths of the last interval, as shares of it.
    """

    def __init__(self, method, problem, dt, scheme, limit, made):
        self.method, self.problem, self.dt, self.scheme, self.limit = method, problem, dt, scheme, limit
        self.name, self.made = f"stepper({method})", made

    def recipe(self):
        """The call that makes it again: see recipe.py."""
        return self.made

    @property
    def order(self):
        return self.scheme.order

    @property
    def info(self):
        return getattr(self.scheme, "info", None)

    @property
    def taken(self):
        return getattr(self.scheme, "taken", [1.0])

    def __call__(self, state, params=None, *inputs):
        """One step.

        Parameters
        ----------
        state : array or tree u, or the pair (u, t) where the rate takes a time
        params : tree
        *inputs : tree, optional
            Of this step; the rate then gets the pair (params, input) as its params.

        Returns
        -------
        state, like the one given
        """
        params = (params, *inputs) if inputs else params
        u, t = self._parts(state)
        if self.problem.op is not None and isinstance(u, (dict, list, tuple)):
            raise TypeError(
                f"{self.name} has an Operator, which acts on one array, got a {type(u).__name__} as u; "
                "stack its parts into one array, or apply the Operator inside the rate of an implicit method"
            )
        h = positive(self.dt(params), "dt") if callable(self.dt) else self.dt
        if self.limit is not None:
            self.limit.check(h, self.problem.coefficient(params))
        try:
            new = like(self.scheme(u, params, t, h), u)
        except NonFiniteError:  # a solver on the way may have met it: name the argument
            self._blame(state, params)
            raise
        new = self.checked(new, state, params, h)
        return (new, t + h) if self.problem.timed else new

    def checked(self, new, state, params, h):
        """The new state, refused when it is not finite."""
        if not all(map(_finite, leaves(new))):
            self._refuse(state, params, h)
        return new

    def _parts(self, state):
        if not self.problem.timed:
            return state, None
        if not (isinstance(state, (tuple, list)) and len(state) == 2):
            given = type(state).__name__
            raise TypeError(f"the rate of {self.name} takes a time, so its state is the pair (u, t), got {given}")
        return state

    def _refuse(self, state, params, h):
        """Say where NaN or infinity came from."""
        self._blame(state, params)
        raise NonFiniteError(
            f"{self.name} got NaN or infinity from a finite state with dt = {float(plain(h)):.6g}; "
            "take smaller steps or an implicit method"
        )

    def _blame(self, state, params):
        """Refuse arguments that are not finite."""
        for what, tree in (("state", state), ("params", params)):
            found = leaves(tree)
            for number, leaf in enumerate(found):
                if is_variable(leaf):
                    place = f"part {number + 1} of the {what}" if len(found) > 1 else f"the {what}"
                    check_finite(f"{place} of {self.name}", np.asarray(plain(leaf)))

    def __repr__(self):
        length = "given by the params" if callable(self.dt) else f"{float(plain(self.dt)):g}"
        return f"<{self.name}: order {self.order}, dt {length}>"


def _finite(leaf):
    """Whether all numbers are finite; their sum tells in one pass, unless it overflows."""
    value = plain(leaf)
    if type(value) is np.ndarray and value.dtype == np.float64 and isfinite(np.add.reduce(value, axis=None)):
        return True
    return not is_variable(value) or bool(np.isfinite(np.sum(value)) or np.all(np.isfinite(value)))
