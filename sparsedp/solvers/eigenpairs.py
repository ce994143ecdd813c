"""eigenpairs(op, k): eigenvalues and eigenvectors of an operator, differentiable in its coefficients and the mass."""

from __future__ import annotations

from functools import cached_property, partial
from inspect import signature
from typing import TYPE_CHECKING, Any

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.html import table
from sparsedp._utils.pytree import keys, leaves, mapped, paired
from sparsedp._utils.validation import (
    check_choice,
    check_finite,
    check_kind,
    check_number,
    check_on,
    check_plain,
    check_type,
    check_whole,
    is_number,
    place,
)
from sparsedp.autodiff.backend import require_arrays
from sparsedp.autodiff.program_trace import recording_trace
from sparsedp.autodiff.tape import isbox, plain
from sparsedp.errors import DerivativeError, JitError, NonFiniteError, ShapeError
from sparsedp.grid.space import Space, fits
from sparsedp.operators.given import check_operator
from sparsedp.operators.operator import Operator
from sparsedp.solvers.eigen_rules import (
    CoefficientOperator,
    ConstantOperator,
    DiagonalMass,
    EigenProblem,
    IdentityMass,
    member_values,
    member_vectors,
)
from sparsedp.solvers.eigensolver import METHODS, ROUNDING, EigenSettings
from sparsedp.solvers.general_eigenpairs import GeneralEigenpairs, GeneralEigenProblem, JacobianMember
from sparsedp.solvers.parametric import CutEllipticSolver, ParametricSolver
from sparsedp.solvers.roots import Root

if TYPE_CHECKING:
    from sparsedp._utils.html import Markup

__all__ = ["Eigenpairs", "eigenpairs"]


def eigenpairs(
    op: Any,
    k: int = 1,
    which: str | float = "smallest",
    mass: Any = None,
    coefficients: Any = (),
    mass_coefficients: Any = (),
    symmetric: bool = True,
    cluster: float = 1e-6,
    method: str = "auto",
    rtol: float = 1e-10,
    maxiter: int | None = None,
) -> Eigenpairs:
    """Return k eigenvalues and eigenvectors of A v = lambda v or A v = lambda M v (generalized eigenvalue problem).

    Parameters
    ----------
    op : Operator, a solver of `elliptic_solver` or `matrix_solver`, or a function
        A, of shape (n, n). A solver stands for the operator that it inverts, with these `coefficients`. A residual
        ``f(x, *params)`` as in `steady`, or the function that `implicit` returns, stands for its Jacobian df/dx at
        ``coefficients=(x, *params)``, with symmetric=False. The function of `implicit` keeps the sparsity pattern.
    k : int
        Number of pairs, 1 <= k <= n.
    which : "smallest", "largest" or float
        The k smallest eigenvalues with their signs, the k largest, or those nearest to a number, in the units of the
        eigenvalues.
    mass : None, number, array, Operator or a solver of `matrix_solver`, optional
        M, symmetric and positive definite. None is the identity. A number or an array of the shape of the domain is a
        diagonal matrix, such as a density. An Operator or a solver is any mass matrix of shape (n, n). With
        symmetric=False any M is allowed; a singular one needs a number as `which`. For a residual whose state is a tree
        the mass is a tree of arrays and numbers, such as ``{"v": free(ones), "p": 0.0}`` for a flow.
    coefficients : array, number, or tuple of them
        The coefficients of the solver `op`: k or (k, shift) of `elliptic_solver`, the entries of `matrix_solver`. For a
        residual the tuple (x, *params), whose entries may be trees.
    mass_coefficients : array
        The coefficients of the solver `mass`.
    symmetric : bool
        If True, an operator that is not symmetric is refused. If False, A need not be symmetric: the values are
        complex, and each right vector has a left one, as `scipy.linalg.eig` has them beside `scipy.linalg.eigh`.
    cluster : float
        Neighbouring eigenvalues whose relative difference is smaller form a cluster; see Notes.
    method : "auto", "dense", "arpack" or "lobpcg"
        "dense" is LAPACK on the full matrix, followed by "arpack" if rounding errors are larger than the eigenvalues.
        "arpack" is the implicitly restarted Lanczos method of ARPACK in shift-invert mode: with the inverse of
        A - sigma M. "lobpcg" has an approximate solve as preconditioner, and takes which="smallest" only. "auto" is
        "dense" up to 512 unknowns, else "arpack".
    rtol : float
        Largest relative residual |A v - lambda M v| / |lambda M v| of a pair, unless the residual is at the level of
        rounding errors.
    maxiter : int, optional
        Largest number of iterations of "arpack" or "lobpcg".

    Returns
    -------
    Eigenpairs
        `.values`, shape (k,), ascending; `.vectors`, shape (k, *domain.shape): ``vectors[i]`` is a field, whereas SciPy
        returns columns. ``value, vector = pairs[i]``. `.clusters` lists the ranges of equal eigenvalues;
        ``.sum(start, stop)`` and ``.project(u, start, stop)`` are their differentiable functions. Differentiable in
        `coefficients`, `mass` and `mass_coefficients`, to every order.
    GeneralEigenpairs
        With symmetric=False: `.values`, complex, in ascending order of the real parts, with first and second
        derivatives; `.vectors`, `.left_vectors` and `.condition_numbers`, without derivatives, which are computed when
        they are read.

    Raises
    ------
    TypeError
        If `op` or `mass` is of another type or on ranks, or is not symmetric.
    ShapeError
        If `op` is not square, or the mass does not fit.
    ValueError
        If k is not between 1 and the number of unknowns, the mass is not positive, A - lambda M is singular for every
        lambda, or an option is out of range.
    NonFiniteError
        If the mass or a coefficient holds NaN or infinity.
    ConvergenceError
        If iterations end without the pairs, or the residual of a pair is too large.
    DerivativeError
        When a derivative is computed that does not exist: of a single member of a cluster, of a multiple eigenvalue.
    JitError
        While `dp.jit` records: the computation depends on the values.

    See Also
    --------
    inverse, elliptic_solver, matrix_solver, matrix_function, steady, continuation

    Notes
    -----
    **Normalisation.** The sum of v_i * M v_j over all entries is 1 for i = j and 0 otherwise. The first entry of a
    vector that is larger than half of its largest entry is positive. Differences on a stretched grid are symmetric with
    respect to the cell volumes w; then the sum of w * v_i * M v_j is 1 or 0. Solid cells are not unknowns; vectors
    are 0 there.

    **Derivatives.** Changes dA and dM change a simple eigenvalue by ::

        dlambda = v . (dA - lambda dM) v

    (Hellmann-Feynman theorem), which needs no solve. The cotangent g of its vector takes one adjoint solve ::

        [ A - lambda M   -M v ] [ y ]   [ g ]
        [ -(M v)^T          0 ] [ c ] = [ 0 ]

    whose symmetric matrix belongs to the linearized problem (Nelson's method), and dv changes the loss by ::

        g . dv = -y . (dA - lambda dM) v + c (v . dM v) / 2 .

    The bordered system is solved by sparse LU up to 20 000 unknowns and for a shift, else by MINRES with the inverse of
    A - sigma M as preconditioner.

    **Clusters.** At a multiple (degenerate) eigenvalue the single values have kinks, and the single vectors are an
    arbitrary basis of the eigenspace. Functions that treat the members of a cluster alike have derivatives:
    ``pairs.sum(start, stop)`` and ``pairs.project(u, start, stop)`` of whole clusters to every order, in forward and
    reverse mode; every symmetric function of `values` and every function of `vectors` that no rotation changes to first
    order, in reverse mode. Other derivatives are refused, and also derivatives of a cluster that continues behind the
    last of the k pairs; one more eigenvalue is computed to detect that. Other pairs are not affected:
    ``pairs.values[0]`` and ``pairs[0]`` are differentiable if pair 0 is simple.

    **Multiple eigenvalues** are complete: iterations are repeated in the complement of the pairs that are known.

    **Operators that are not symmetric.** With right vectors v of norm 1 and left vectors w, w^H A = lambda w^H M,
    scaled so that w^H M v = 1 (`scipy.linalg.eig` scales both to norm 1), a simple eigenvalue changes by ::

        dlambda = w^H (dA - lambda dM) v .

    `.condition_numbers` are |w| |M v| / |w^H M v|. A multiple eigenvalue with enough vectors (semisimple) has bases
    with w_i^H M v_j = 1 for i = j and 0 otherwise, without derivatives. A defective one, up to rounding, has fewer
    vectors, of which some are repeated, w^H M v = 0, an infinite condition number, and left vectors of norm 1.

    The vectors take one sparse LU factorisation for each eigenvalue. Near a number `which` ARPACK iterates with the LU
    factors of A - which M, in complex arithmetic if `which` is complex. A singular M has infinite eigenvalues; they are
    not found. So with the Jacobian of a flow, whose constraint div v = 0 has no mass, the eigenvalues are the growth
    rates of small perturbations of the steady state (linear stability), and their imaginary parts the frequencies.

    References
    ----------
    R. B. Nelson, Simplified calculation of eigenvector derivatives, AIAA J. 14, 1976; J. R. Magnus, On differentiating
    eigenvalues and eigenvectors, Econometric Theory 1, 1985; R. B. Lehoucq, D. C. Sorensen, C. Yang, ARPACK Users'
    Guide, SIAM, 1998; A. V. Knyazev, Toward the optimal preconditioned eigensolver, SIAM J. Sci. Comput. 23, 2001.

    Examples
    --------
    >>> import numpy as np
    >>> from sparsedp import Grid, dirichlet, divergence, elliptic_solver, from_matrix, gradient, value_and_grad
    >>> pairs = eigenpairs(from_matrix([[2.0, 1.0], [1.0, 2.0]]), 2)
    >>> print(np.round(pairs.values, 12))
    [1. 3.]
    >>> grid = Grid(2)
    >>> rod = elliptic_solver(divergence(grid), gradient(grid, dirichlet))
    >>> value, slope = value_and_grad(lambda k: eigenpairs(rod, coefficients=k).values[0])(np.ones(3))
    >>> print(np.round(value, 12), np.round(slope, 12) + 0.0)
    2.0 [1. 0. 1.]
    """
    for solver in (op, mass):
        if isinstance(solver, CutEllipticSolver):
            raise TypeError(
                f"eigenpairs takes no solver with a body of cut_cells, got {solver!r}; represent the body by solid "
                "cells of the grid, or write the matrix as an Operator"
            )
    differentiable = leaves((mass, coefficients, mass_coefficients))
    if recording_trace(differentiable) is not None:
        raise JitError("dp.jit cannot record eigenpairs, which decides by values; call the function without dp.jit")
    require_arrays("eigenpairs", map(plain, differentiable))
    settings = _checked_settings(k, which, symmetric, cluster, method, rtol, maxiter)
    if not symmetric and (isinstance(op, Root) or not isinstance(op, (Operator, ParametricSolver)) and callable(op)):
        return _of_residual(op, coefficients, mass, mass_coefficients, settings)
    stiffness = _pencil_member("op", op, coefficients, "coefficients")
    domain, codomain = _spaces(op)
    if not fits(domain, codomain):
        raise ShapeError(f"eigenpairs takes a square operator, got one from {domain} to {codomain}; write op.T @ op")
    mass = _mass_member(mass, mass_coefficients, domain, symmetric)
    problem = (EigenProblem if symmetric else GeneralEigenProblem)(stiffness, mass, settings)
    pencil = problem.pencil([plain(value) for value in problem.coefficients])
    _check_count(settings.k, pencil)
    if isinstance(problem, GeneralEigenProblem):
        _check_real(pencil, problem)
        general: Any = GeneralEigenpairs(problem, None)
        return general
    if pencil.weights is None or not pencil.mass_is_symmetric:
        raise _not_symmetric(pencil, isinstance(op, ParametricSolver))
    _check_real(pencil, problem)
    return Eigenpairs(problem, domain)


def _of_residual(residual, coefficients, mass, mass_coefficients, settings):
    """Return the eigenvalues of the Jacobian of a residual F(x, *params) at coefficients = (x, *params)."""
    if not (isinstance(coefficients, tuple) and coefficients):
        raise TypeError(
            "eigenpairs of a residual needs the state and the parameters of its Jacobian, got "
            f"{type(coefficients).__name__}; write coefficients=(x, *params)"
        )
    state, *params = coefficients
    stiffness = JacobianMember(residual, state, tuple(params))
    unknowns = stiffness.unknowns
    domain = Space(unknowns.size)
    if not (mass is None or isinstance(mass, (Operator, ParametricSolver))):
        masses = [mass] * len(unknowns.shapes)
        if keys(mass) is not None:
            masses = paired(mass, state, "mass", advice="; give a mass like the state")
        for leaf, shape in zip(masses, unknowns.shapes, strict=True):
            if np.shape(leaf) not in ((), shape):
                raise ShapeError(
                    f"the mass of eigenpairs is a number or an array like the state, of shape {shape}, got one of "
                    f"shape {np.shape(leaf)}"
                )
        parts = [anp.ravel(leaf * np.ones(shape)) for leaf, shape in zip(masses, unknowns.shapes, strict=True)]
        mass = anp.concatenate(parts)
    problem = GeneralEigenProblem(stiffness, _mass_member(mass, mass_coefficients, domain, False), settings)
    pencil = problem.pencil([plain(value) for value in problem.coefficients])
    _check_count(settings.k, pencil)

    def split(rows):
        trees = [unknowns.split(row) for row in rows]
        return mapped(lambda *fields: anp.array(fields), *trees)

    return GeneralEigenpairs(problem, split)


def _check_real(pencil, problem):
    """Raise DerivativeError for derivatives with complex operators."""
    if pencil.complex and any(map(isbox, problem.coefficients)):
        raise DerivativeError(
            "eigenpairs of complex operators have no derivatives; write the real symmetric operator of real and "
            "imaginary parts"
        )


def _checked_settings(k, which, symmetric, cluster, method, rtol, maxiter):
    """Return the checked options."""
    k = check_whole("k of eigenpairs", k, 1)
    check_choice("symmetric", symmetric, (True, False))
    check_choice("method of eigenpairs", method, METHODS)
    if isinstance(which, str) or not (is_number(which) or isinstance(which, complex)):
        check_choice("which", which, ("smallest", "largest"), "; write 'smallest', 'largest' or a number near to them")
    elif not np.isfinite(which):
        raise NonFiniteError(f"which must be finite, got {which}")
    elif isinstance(which, complex) and symmetric:
        raise TypeError(f"the eigenvalues of a symmetric operator are real, got which={which}; write a real number")
    cluster = check_number("cluster", cluster, "from 0 to below 1")
    rtol = check_number("rtol", rtol, "between 0 and 1")
    if maxiter is not None:
        maxiter = check_whole("maxiter", maxiter, 1)
    return EigenSettings(k, which, symmetric, cluster, method, rtol, maxiter)


def _spaces(op):
    """Return the domain and the codomain of an Operator, or of the operator of a solver."""
    if isinstance(op, ParametricSolver):
        return op.G.domain, op.D.codomain
    return op.domain, op.codomain


def _pencil_member(name, op, coefficients, coefficients_name):
    """Return A or M with its coefficients; the names are those of the arguments."""
    if isinstance(op, ParametricSolver):
        op.D.backend.check("eigenpairs")
        op.D.codomain.backend.check("eigenpairs")
        if isinstance(coefficients, list) and any(map(np.ndim, coefficients)):
            raise TypeError(f"{coefficients_name} must be an array or a tuple (k, shift), got a list of arrays")
        if not isinstance(coefficients, tuple):
            coefficients = (coefficients,)
        if not coefficients:
            raise TypeError(f"eigenpairs needs the coefficients of {op!r}, got none; write {coefficients_name}=...")
        most = len(signature(op.of_coefficients).parameters)
        if len(coefficients) > most:
            raise TypeError(
                f"{op!r} has up to {most} coefficients, got {len(coefficients)}; write {coefficients_name}=..."
            )
        return CoefficientOperator(*op.of_coefficients(*coefficients))
    if callable(op) and not isinstance(op, Operator):
        example = (
            "dp.from_functions(f, f, n, n), the solver of dp.elliptic_solver with coefficients=, or symmetric=False "
            "for the Jacobian of a residual"
        )
        check_type(f"eigenpairs, as {name},", op, Operator, "an Operator", example)
    check_operator("eigenpairs", op)
    if not (isinstance(coefficients, tuple) and not coefficients):
        raise TypeError(
            f"{coefficients_name} belong to a solver, got an Operator {op}; write "
            f"eigenpairs(solve, {coefficients_name}=...)"
        )
    return ConstantOperator(op)


def _mass_member(mass, coefficients, domain, symmetric):
    """Return M with its coefficients."""
    if mass is None:
        return IdentityMass()
    if isinstance(mass, (Operator, ParametricSolver)):
        member = _pencil_member("mass", mass, coefficients, "mass_coefficients")
        for space in _spaces(mass):
            if not fits(space, domain):
                raise ShapeError(f"the mass of eigenpairs acts on {space}, but the operator on {domain}")
        return member
    check_plain("eigenpairs", mass)
    values = np.asarray(plain(mass))
    check_kind("the mass of eigenpairs", values.dtype, "real numbers")
    if values.shape not in ((), domain.shape):
        raise ShapeError(
            f"the mass of eigenpairs is a number or a field on {domain.described}, got an array of shape {values.shape}"
        )
    check_finite("the mass of eigenpairs", values)
    if symmetric and np.any(values <= 0):
        where = place(int(np.argmin(values)), values.shape or (1,))
        raise ValueError(f"the mass of eigenpairs must be > 0, got {np.min(values):g} at {where}")
    return DiagonalMass(mass if isbox(mass) else values.astype(np.result_type(values, float)))


def _check_count(k, pencil):
    """Raise ValueError if there are fewer than k eigenvalues."""
    if k > pencil.unknowns:
        raise ValueError(f"eigenpairs got k={k}, but {pencil.name} has {pencil.unknowns} unknowns; write a smaller k")


def _not_symmetric(pencil, has_coefficients):
    """Return the error for an operator or a mass that is not symmetric."""
    name = pencil.name if pencil.weights is None else "the mass"
    if pencil.complex:
        return TypeError(
            f"eigenpairs takes complex operators that are equal to their conjugate transpose, and {name} is not; write "
            "symmetric=False for eigenvalues"
        )
    advice = "" if has_coefficients else ", or 0.5 * (A + A.T) for its symmetric part"
    return TypeError(
        f"eigenpairs takes a symmetric operator, and {name} is not; write symmetric=False for its eigenvalues{advice}"
    )


class Eigenpairs:
    """Eigenvalues and eigenvectors, which `eigenpairs` returns.

    Parameters
    ----------
    problem : EigenProblem
    domain : Space

    Attributes
    ----------
    values : array, shape (k,)
        Ascending.
    vectors : array, shape (k, *domain.shape)
    clusters : tuple of range
        The numbers of the pairs of each cluster; a simple eigenvalue is a cluster of one.
    cut : tuple of bool
        Whether a cluster has members that are not among the k pairs.
    """

    def __init__(self, problem: EigenProblem, domain: Any) -> None:
        self._problem = problem
        self._domain = domain
        self._tolerance = problem.settings.cluster  # relative difference of the eigenvalues of a cluster
        spectrum = problem.plain_solution.spectrum
        pencil = problem.plain_solution.pencil
        self._floor = ROUNDING * float(np.ldexp(pencil.scale, pencil.exponent))
        self.clusters: tuple[range, ...] = _clusters(spectrum.values, self._are_equal)
        self._beyond = spectrum.beyond
        self._plain_values = spectrum.values
        cut = []
        for members in self.clusters:
            ends = spectrum.values[[members.start, members.stop - 1]]
            cut.append(any(self._are_equal(end, value) for end in ends for value in spectrum.beyond))
        self.cut: tuple[bool, ...] = tuple(cut)

    def _are_equal(self, one, other):
        """Return whether two eigenvalues belong to one cluster."""
        return abs(one - other) <= max(self._tolerance * max(abs(one), abs(other)), self._floor)

    # ------------------------------------------------------------ values and vectors

    @cached_property
    def values(self) -> Any:
        """The eigenvalues, ascending, shape (k,)."""
        if not any(map(isbox, self._problem.coefficients)):
            return self._plain_values.copy()
        return anp.concatenate([self._values_of(number) for number in range(len(self.clusters))])

    @cached_property
    def vectors(self) -> Any:
        """The eigenvectors as fields, shape (k, *domain.shape)."""
        if not any(map(isbox, self._problem.coefficients)):
            return self._problem.plain_solution.fields(range(len(self))).copy()
        return anp.concatenate([self._vectors_of(number) for number in range(len(self.clusters))])

    def __getitem__(self, index: int) -> tuple[Any, Any]:
        """Return the eigenvalue and the eigenvector of one pair; only its own cluster is differentiated."""
        number, place = self._cluster_and_member(index)
        return self._values_of(number)[place], self._vectors_of(number)[place]

    def __len__(self) -> int:
        return len(self._plain_values)

    def sum(self, start: int = 0, stop: int | None = None) -> Any:
        """Return the sum of the eigenvalues start to stop - 1.

        Parameters
        ----------
        start, stop : int
            Default: all pairs.

        Returns
        -------
        float
            Differentiable in forward and reverse mode, to every order, unless `start` or `stop` cuts a cluster.

        Raises
        ------
        ValueError
            Unless 0 <= start < stop <= number of pairs; unlike for a list, negative numbers do not count from the end.
        """
        whole, parts = self._divided(start, stop)
        total = 0.0
        if whole:
            block = self._problem.block(whole)
            total = total + anp.sum(block * np.eye(len(whole)))
        for number, places in parts:
            total = total + anp.sum(self._values_of(number)[places])
        return total

    def project(self, u: Any, start: int = 0, stop: int | None = None) -> Any:
        """Return the projection of a field on the space of the eigenvectors start to stop - 1.

        Parameters
        ----------
        u : array, a field on the domain
        start, stop : int
            Default: all pairs.

        Returns
        -------
        array like u
            The sum of v (v . M u) over these vectors. Differentiable in u and in the coefficients, in forward and
            reverse mode, to every order, unless `start` or `stop` cuts a cluster. Gaps between the eigenvalues of these
            pairs do not matter, only those to other pairs.

        Raises
        ------
        ValueError
            Unless 0 <= start < stop <= number of pairs.
        """
        whole, parts = self._divided(start, stop)
        check_plain("project", u)
        check_on("project", u, self._domain)
        problem = self._problem
        _, of_mass = problem.parts(problem.coefficients)
        image = anp.reshape(problem.plain_solution.weights * problem.mass.product(u, of_mass), (-1,))
        spaces = [problem.vectors(whole)] if whole else []
        spaces += [self._vectors_of(number)[places] for number, places in parts]
        total = np.zeros(self._domain.shape)
        for vectors in spaces:
            shares = anp.dot(anp.conj(anp.reshape(vectors, (len(vectors), -1))), image)
            total = total + anp.tensordot(shares, vectors, axes=1)
        return total

    def _divided(self, start, stop):
        """Divide the pairs start to stop - 1 into whole clusters and parts of clusters.

        The whole clusters are one block for derivatives of a sum or a projection: these depend on the space of its
        vectors only, and so not on the gaps inside, which single vectors would be divided by.

        Returns
        -------
        whole : range
            Pairs of whole clusters; may be empty.
        parts : list of (number of a cluster, slice of places in it)
        """
        chosen = self._range_of(start, stop)
        whole: list[int] = []
        parts = []
        for number, members in enumerate(self.clusters):
            first = max(chosen.start, members.start)
            last = min(chosen.stop, members.stop)
            if first >= last:
                continue
            if len(members) == last - first and not self.cut[number]:
                whole += members
            else:
                parts.append((number, slice(first - members.start, last - members.start)))
        if not whole:
            return range(0), parts
        return range(whole[0], whole[-1] + 1), parts

    def _range_of(self, start, stop):
        """Return the range of the pairs start to stop - 1."""
        count = len(self)
        if stop is None:
            stop = count
        advice = f"; write 0 <= start < stop <= {count}"
        start = check_whole("start", start, 0, advice)
        stop = check_whole("stop", stop, 0, advice)
        if not start < stop <= count:
            raise ValueError(f"start={start} and stop={stop} are not a range of {count} eigenpairs{advice}")
        return range(start, stop)

    def _cluster_and_member(self, index):
        """Return the number of the cluster of a pair, and the place of the pair in it."""
        if not hasattr(index, "__index__"):
            raise TypeError(f"pairs[i] takes an integer, got {index!r}; write pairs.values[i] and pairs.vectors[i]")
        if not -len(self) <= index < len(self):
            raise IndexError(f"there is no pair {index} among {len(self)} eigenpairs; write 0 to {len(self) - 1}")
        index = range(len(self))[index]
        starts = [members.start for members in self.clusters]
        number = int(np.searchsorted(starts, index, side="right")) - 1
        return number, index - starts[number]

    # ------------------------------------------------------------ clusters

    def _values_of(self, number):
        """Return the eigenvalues of a cluster, with the derivatives that exist."""
        members = self.clusters[number]
        if self.cut[number]:
            return self._problem.cut_values(members, partial(self._refusal, number))
        block = self._problem.block(members)
        if len(members) == 1:
            return anp.reshape(block, (1,))
        values = self._plain_values[members.start : members.stop]
        spread = (values[-1] - values[0]) / max(np.max(np.abs(values)), self._floor)
        return member_values(block, partial(self._refusal, number), float(spread))

    def _vectors_of(self, number):
        """Return the eigenvectors of a cluster, with the derivatives that exist."""
        members = self.clusters[number]
        if self.cut[number]:
            return self._problem.cut_vectors(members, partial(self._refusal, number))
        vectors = self._problem.vectors(members)
        if len(members) == 1:
            return vectors
        return member_vectors(vectors, partial(self._refusal, number))

    def _refusal(self, number):
        """Return the error for a derivative that does not exist."""
        members = self.clusters[number]
        values = self._plain_values[members.start : members.stop]
        if self.cut[number]:
            nearest = self._beyond[np.argmin(np.abs(self._beyond - values[-1]))]
            gap = float(np.min(np.abs(values - nearest)))
            return DerivativeError(
                f"pair {members.stop - 1} of eigenpairs has no derivative: its eigenvalue {values[-1]:.10g} differs "
                f"by {gap:.1e} from {nearest:.10g} of the next pair, which was not computed; write another k, so that "
                "no cluster is cut"
            )
        gap = float(np.max(np.diff(values)))
        return DerivativeError(
            f"pairs {members.start} to {members.stop - 1} of eigenpairs have no derivatives one by one: their "
            f"eigenvalues {values[0]:.10g} to {values[-1]:.10g} form a cluster with gaps up to {gap:.1e}; write "
            f"pairs.sum({members.start}, {members.stop}) or pairs.project(u, {members.start}, {members.stop})"
        )

    # ------------------------------------------------------------ description

    def __repr__(self) -> str:
        values = self._plain_values
        return f"<{len(self)} eigenpairs on {self._domain}, from {values[0]:.6g} to {values[-1]:.6g}>"

    def _repr_html_(self) -> Markup:
        """Return a table for notebooks."""
        rows = []
        for members, cut in zip(self.clusters, self.cut, strict=True):
            more = " or more" if cut else ""
            rows += [[number, f"{self._plain_values[number]:.10g}", f"{len(members)}{more}"] for number in members]
        return table(rows, ["pair", "eigenvalue", "multiplicity"], repr(self))


def _clusters(values, are_equal):
    """Return the ranges of neighbouring equal values."""
    starts = [0]
    for number in range(1, len(values)):
        if not are_equal(values[number - 1], values[number]):
            starts.append(number)
    return tuple(map(partial(range), starts, [*starts[1:], len(values)]))
