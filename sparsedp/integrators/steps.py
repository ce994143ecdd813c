"""Step: what `stepper` returns, a function of state and params for time loops; and how large an explicit one may be."""

import numpy as np

from sparsedp.errors import ConvergenceError, NonFiniteError, UnstableStepError
from sparsedp.fields import check_finite, rounded_down, surely_finite
from sparsedp.integrators.problem import like, positive
from sparsedp.recipe import Remade
from sparsedp.solvers.separable import spectrum
from sparsedp.tape import is_variable, plain
from sparsedp.tree import leaves

__all__ = ["Limit", "Step"]


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
        if not all(map(_finite, leaves(new))):
            self._blame(state, params)
            raise NonFiniteError(
                f"{self.name} got NaN or infinity from a finite state with dt = {float(plain(h)):.6g}; "
                "take smaller steps or an implicit method"
            )
        return (new, t + h) if self.problem.timed else new

    def _parts(self, state):
        if not self.problem.timed:
            return state, None
        if not (isinstance(state, (tuple, list)) and len(state) == 2):
            given = type(state).__name__
            raise TypeError(f"the rate of {self.name} takes a time, so its state is the pair (u, t), got {given}")
        return state

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
    return not is_variable(value) or surely_finite(value) or bool(np.all(np.isfinite(value)))


ROUNDING = 1e-12  # a step at the limit may lie beyond it by rounding
DENSE_UP_TO = 64


class Limit:
    """The largest stable h c of an explicit step for u' = c L u.

    From the eigenvalues of a sum of 1-D factors, else, where L has symmetric entries, from its least
    eigenvalue. Of other operators nothing is known, and any step is taken.

    Parameters
    ----------
    op : Operator
    reach : float
        Length of the stable interval on the negative real axis.
    name : str
        The method, for the message.
    """

    def __init__(self, op, reach, name):
        self.op, self.name = op, name
        least = least_eigenvalue(op)
        self.largest = reach / -least if least is not None and least < 0 else np.inf

    def check(self, h, c):
        """Refuse a step that would grow without bound."""
        h, c = float(plain(h)), float(plain(c))
        if h * c > self.largest * (1 + ROUNDING):
            raise UnstableStepError(
                f"{self.name} is unstable for {self.op.name} with dt = {h:.12g}: the largest stable dt is "
                f"{rounded_down(self.largest / c)}; take smaller steps or an implicit method, or write unstable='allow'"
            )


def least_eigenvalue(op):
    """The most negative eigenvalue of an operator with real ones, or None when that is not known."""
    if op.dtype.kind == "c":
        return None
    found = spectrum(op.structure) if op.separable else None
    if found is not None:
        return float(np.min(found.eigenvalues))
    if not op.structure.has_entries:
        return None
    matrix = op.matrix
    different = abs(matrix - matrix.T)
    if different.nnz and different.max() > 1e-14 * abs(matrix).max():
        return None
    return _least_of_symmetric(matrix)


def _least_of_symmetric(matrix):
    from scipy.sparse.linalg import ArpackError, eigsh

    n = matrix.shape[0]
    if n <= DENSE_UP_TO:
        return float(np.min(np.linalg.eigvalsh(matrix.toarray()), initial=0.0))
    start = np.random.default_rng(0).standard_normal(n)  # the same bits in every run
    try:
        return float(eigsh(matrix, 1, which="SA", v0=start, tol=1e-3, return_eigenvectors=False)[0])
    except (ArpackError, ConvergenceError):
        return None
