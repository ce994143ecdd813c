"""Solves whose matrix depends on parameters entry by entry, on a pattern that does not change.

With A x = b, where A has the entries `data` at the places (i, j) of the pattern, a change gives

    A dx = db - dA x,

so with the adjoint solve A^T y = g, one for both arguments,

    cotangent of b: y,    of the entry at (i, j): -y_i x_j.

Only the places of the pattern are ever touched: with R and C, which pick the row's and the column's
value for each entry, the cotangent is -(R y) * (C x), and dA x = R^T (ddata * C x). The transposed
solve is a rule of the same form with R and C exchanged; derivatives of every order follow.
"""

import numpy as np
import scipy.sparse as sp

from sparsedp.errors import NonFiniteError, ShapeError
from sparsedp.fields import check_plain
from sparsedp.operators.given import from_matrix
from sparsedp.recipe import Remade
from sparsedp.solvers.choose import build, check_settings
from sparsedp.solvers.kept import Kept
from sparsedp.solvers.record import SolveLog
from sparsedp.space import Space
from sparsedp.tape import Rule, isbox, of_argument, plain
from sparsedp.tree import copied

__all__ = ["MatrixSolver", "matrix_solver"]


def matrix_solver(pattern, method="auto", rtol=1e-10, maxiter=None, nullspace="raise", domain=None, **options):
    """Sparsity pattern -> solve(data, b): x of A x = b, where A has the entries `data` on the pattern.

    Parameters
    ----------
    pattern : sparse matrix or 2-D array, square
        Its places count, not its values; a stored 0 is a place.
    method, rtol, maxiter, nullspace, **options
        As in `inverse`; options go to the method.
    domain : Space, int or tuple of int, optional
        Where b and x live. Default: flat arrays.

    Returns
    -------
    MatrixSolver
        Call it as ``solve(data, b)``. `solve.rows` and `solve.columns` hold the place of each entry.
        Differentiable in data and b, to every order. The set-up depends on the content of data; the
        last two are kept. `solve.info` holds the records.

    Raises
    ------
    ShapeError
        If the pattern is not square or does not fit the domain; on use, if data or b has another shape.
    TypeError
        On use, if data does not hold numbers.
    NonFiniteError
        On use, if data or b holds NaN or infinity.
    ConvergenceError, IncompatibleError
        On use, as for `inverse`.

    Notes
    -----
    Formula: data_bar_ij = -y_i x_j on the pattern, with A^T y = g: one adjoint solve for data and b.
    Null space: as for `inverse`. The derivative in data of a singular system is that along changes
    which keep its null vectors, such as those that leave every row sum 0.
    Cost: one set-up for each new content of data, one solve, one adjoint solve, memory of the order of
    the entries: no outer product is formed.

    Examples
    --------
    >>> from sparsedp import value_and_grad
    >>> solve = matrix_solver([[1, 0], [1, 1]])
    >>> data, b = np.array([2.0, 1.0, 4.0]), np.array([2.0, 5.0])
    >>> solve(data, b)
    array([1., 1.])
    >>> value_and_grad(lambda data: solve(data, b)[1])(data)
    (1.0, array([ 0.125, -0.25 , -0.25 ]))
    """
    check_settings(method, rtol, maxiter, nullspace)
    pattern = _canonical(pattern)
    domain = domain if isinstance(domain, Space) else Space(pattern.shape[0] if domain is None else domain)
    if pattern.shape != (domain.size, domain.size):
        raise ShapeError(f"matrix_solver takes a square pattern of {domain.size} rows, got shape {pattern.shape}")
    settings = dict(method=method, rtol=float(rtol), maxiter=maxiter, nullspace=nullspace, options=copied(options))
    return MatrixSolver(pattern, domain, settings)


def _canonical(pattern):
    """csr_array of ones with sorted indices, each place once."""
    entries = pattern if sp.issparse(pattern) else np.asarray(pattern)
    if entries.ndim != 2:
        raise ShapeError(f"matrix_solver takes a 2-D pattern, got an array of shape {entries.shape}")
    places = sp.coo_array(entries)
    found = sp.csr_array((np.ones(places.nnz), (places.row, places.col)), shape=places.shape)
    found.sum_duplicates()
    found.sort_indices()
    found.data = np.ones(found.nnz)
    return found


class MatrixSolver(Remade):
    """solve(data, b), made by `matrix_solver`.

    Attributes
    ----------
    rows, columns : int arrays, shape (entries,)
        Place of each entry, in the order of data: row by row, columns ascending.
    domain : Space
    info : SolveLog
        Records of the last forward and the last adjoint solve, and of the last set-up.
    """

    name = "matrix_solver"

    def __init__(self, pattern, domain, settings):
        self.domain, self.info = domain, SolveLog()
        self.rows = np.repeat(np.arange(pattern.shape[0]), np.diff(pattern.indptr))
        self.columns = pattern.indices
        self._pattern, self._settings, self._kept = pattern, settings, Kept()
        self._row_of, self._column_of = (self._picking(place) for place in (self.rows, self.columns))
        self._checked, self._free = self._rule(False, True), self._rule(False, False)
        self._adjoint = self._rule(True, False)

    def recipe(self):
        """The call that makes it again: see recipe.py."""
        return MatrixSolver, (self._pattern, self.domain, self._settings)

    def _picking(self, place):
        """Operator: a field -> for each entry the value at its row, or its column."""
        shape = (place.size, self.domain.size)
        matrix = sp.csr_array((np.ones(place.size), place, np.arange(place.size + 1)), shape=shape)
        return from_matrix(matrix, self.domain, name="entries")

    def __call__(self, data, b):
        """Solve A x = b.

        Parameters
        ----------
        data : array, shape (entries,)
        b : array, a field on the domain; leading axes are a batch

        Returns
        -------
        array of the shape of b
        """
        check_plain(self.name, data, b)
        values = np.asarray(plain(data))
        if values.shape != self.rows.shape:
            raise ShapeError(f"data takes one value for each of {self.rows.size} entries, got shape {values.shape}")
        if values.dtype.kind not in "biufc":
            raise TypeError(f"data must hold numbers, got dtype {values.dtype}")
        wrong = ~np.isfinite(values)
        if wrong.any():
            first, many = int(np.argmax(wrong)), np.count_nonzero(wrong)
            place = f"row {self.rows[first]}, column {self.columns[first]}"
            raise NonFiniteError(f"data must be finite, got {many} that are NaN or infinite, the first at {place}")
        if np.shape(plain(b))[-len(self.domain.shape) :] != self.domain.shape:
            raise ShapeError(f"b takes a field on {self.domain}, got an array of shape {np.shape(plain(b))}")
        return self._checked(data if isbox(data) else values, b if isbox(b) else np.asarray(b))

    # ------------------------------------------------------------ rules

    def _rule(self, transposed, checked):
        """The solve (or the transposed solve) as a rule in (data, b)."""
        row, column = (self._column_of, self._row_of) if transposed else (self._row_of, self._column_of)

        def forward(data, b):
            inv = self._inverse(data)
            return (inv.T if transposed else inv if checked else inv.tangent).apply(b)

        def vjp(nums, ans, data, b):
            def pull(g):
                y = (self._free if transposed else self._adjoint)(data, g)
                slopes = {0: lambda: -(row(y) * column(ans)), 1: lambda: y}
                return tuple(of_argument(slopes[num](), (data, b)[num]) for num in nums)

            return pull

        def jvp(nums, tangents, ans, data, b):
            change = {0: lambda t: -row.T(t * column(ans)), 1: lambda t: t}
            total = sum(change[num](t) for num, t in zip(nums, tangents, strict=True))
            return (self._adjoint if transposed else self._free)(data, total)

        return Rule(f"{self.name}.T" if transposed else self.name, forward, vjp, jvp)

    # ------------------------------------------------------------ set-up

    def _inverse(self, data):
        """The set-up for this content, from the last two or new."""
        known = self._kept.find((data,))
        if known is not None:
            return known
        matrix = sp.csr_array((data, self._pattern.indices, self._pattern.indptr), shape=self._pattern.shape)
        op = from_matrix(matrix, self.domain, self.domain, name=f"matrix of {self.rows.size} entries")
        return self._kept.put((data,), build(op, name=self.name, log=self.info, solves="few", **self._settings))

    def __repr__(self):
        return f"<{self.name}: {self.rows.size} entries on {self.domain}>"

    def __str__(self):
        last = self._kept.last
        if last is None:
            return f"{self!r}, not set up yet"
        return f"{self!r}, {len(self._kept)} of {self._kept.most} set-ups kept, the last one:\n{last}"
