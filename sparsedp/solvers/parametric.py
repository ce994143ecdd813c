"""Solves whose operator depends on a parameter: x of (shift - D diag(k) G) x = b, differentiable in k, b and shift.

With A = shift - D diag(k) G and A x = b, a change of the data gives

    A dx = db - x dshift + D (dk * G x),

so with the adjoint solve A^T y = g, one for all arguments,

    cotangent of b: y,    of shift: -y.x,    of k: (D^T y) * (G x).

The transposed solve is a rule of the same form with D, G exchanged for G^T, D^T: each is the other's
helper, and derivatives of every order follow.
"""

from functools import cached_property
from math import prod

import autograd.numpy as anp
import numpy as np

from sparsedp.errors import NonFiniteError, ShapeError
from sparsedp.fields import check_finite, check_plain
from sparsedp.operator import Operator
from sparsedp.operators.boundary import identity
from sparsedp.recipe import Remade
from sparsedp.solvers.assembly import Assembly
from sparsedp.solvers.choose import build, check_settings
from sparsedp.solvers.kept import Kept
from sparsedp.solvers.record import SolveLog
from sparsedp.space import fits
from sparsedp.structure.base import Structure
from sparsedp.structure.lazy import Chain, Diagonal
from sparsedp.tape import Rule, isbox, of_argument, plain
from sparsedp.tree import copied

__all__ = ["EllipticSolver", "elliptic_solver"]


def elliptic_solver(D, G, method="auto", rtol=1e-10, maxiter=None, nullspace="raise", **options):
    """Divergence and gradient -> solve(k, b, shift=0.0): x of (shift - D diag(k) G) x = b.

    Parameters
    ----------
    D : Operator, faces -> cells
    G : Operator, cells -> faces
        Boundary conditions and obstacles are part of it.
    method, rtol, maxiter, nullspace, **options
        As in `inverse`; options go to the method.

    Returns
    -------
    EllipticSolver
        Call it as ``solve(k, b, shift=0.0)``: k a number or one value for each face, finite and >= 0;
        b a field on the cells; shift a finite number. Differentiable in all three, to every order.
        The set-up depends on the content of (k, shift); the last two are kept.

    Raises
    ------
    TypeError
        If D or G is not an Operator, and on use, if k or b is a masked array.
    ShapeError
        If D and G do not fit, and on use, if k or b has another shape.
    ValueError
        On use, if k is negative or complex.
    NonFiniteError
        On use, if k, b or shift holds NaN or infinity.
    ConvergenceError
        On use, as for `inverse`.

    Notes
    -----
    Cost: one solve; its derivative in any of k, b, shift one more, with the transpose of the same
    set-up. Null space: where shift is 0 and no wall holds the level (pure Neumann), as for `inverse`;
    derivatives are projected, never refused.

    Examples
    --------
    >>> from sparsedp import Grid, dirichlet, divergence, gradient, value_and_grad
    >>> grid = Grid(2)
    >>> solve = elliptic_solver(divergence(grid), gradient(grid, dirichlet))
    >>> solve(1.0, np.array([2.0, 2.0]))
    array([1., 1.])
    >>> value_and_grad(lambda k: anp.sum(solve(k, np.array([2.0, 2.0]))))(1.0)
    (2.0, -2.0)
    """
    for name, op in (("D", D), ("G", G)):
        if not isinstance(op, Operator):
            raise TypeError(
                f"elliptic_solver takes Operators, got {type(op).__name__} for {name}; write dp.from_matrix first"
            )
    if not (fits(D.domain, G.codomain) and fits(D.codomain, G.domain)):
        raise ShapeError(
            f"elliptic_solver needs D @ G to be square: {D.name} maps {D.domain} to {D.codomain}, "
            f"{G.name} {G.domain} to {G.codomain}"
        )
    check_settings(method, rtol, maxiter, nullspace)
    settings = dict(method=method, rtol=float(rtol), maxiter=maxiter, nullspace=nullspace, options=copied(options))
    return EllipticSolver(D, G, settings)


class EllipticSolver(Remade):
    """solve(k, b, shift=0.0), made by `elliptic_solver`.

    Attributes
    ----------
    info : SolveLog
        Records of the last forward and the last adjoint solve, and of the last set-up.
    """

    def __init__(self, D, G, settings):
        self.D, self.G = D, G
        self.info = SolveLog()
        self._settings = settings
        self._kept = Kept()
        self._assembly = Assembly(D, G)

    def recipe(self):
        """The call that makes it again: see recipe.py."""
        return EllipticSolver, (self.D, self.G, self._settings)  # what is kept is set up again

    def __call__(self, k, b, shift=0.0):
        """Solve (shift - D diag(k) G) x = b.

        Parameters
        ----------
        k : float, or array of the shape of a field on the faces
        b : array, a field on the cells; leading axes are a batch
        shift : float

        Returns
        -------
        array of the shape and dtype of b
        """
        check_plain("elliptic_solver", k, b)
        k = self._coefficient(k)
        _check_shift(plain(shift))
        return self._rule(False, True)(k, b if isbox(b) else np.asarray(b), shift)

    def _coefficient(self, k):
        values, space = np.asarray(plain(k)), self.D.domain
        if values.shape not in ((), space.shape):
            advice = "; write harmonic_average(grid)(k)" if values.shape == self.D.codomain.shape else ""
            raise ShapeError(
                f"k takes a number or a field on {space.told}, got an array of shape {values.shape}{advice}"
            )
        if values.dtype.kind not in "biuf":
            instead = "k.real" if values.dtype.kind == "c" else "np.asarray(k, float)"
            raise ValueError(f"k must hold real numbers, got dtype {values.dtype}; write {instead}")
        check_finite("k", values)
        if np.any(values < 0):
            raise ValueError(f"k must be >= 0, got {values.min():g} at {np.argmin(values)}")
        if values.ndim == 0:
            return k * np.ones(space.shape)
        return k if isbox(k) else values

    # ------------------------------------------------------------ rules

    def _rule(self, transposed, checked=False):
        """The solve (or the transposed solve) as a rule in (k, b, shift). Not kept: it holds this solver."""

        def forward(k, b, shift):
            inv = self._inverse(k, float(shift))
            return (inv.T if transposed else inv if checked else inv.tangent).apply(b)

        def vjp(nums, ans, k, b, shift):
            def pull(g):
                other = self._rule(not transposed)(k, g, shift)
                x, y = (other, ans) if transposed else (ans, other)
                slopes = {0: lambda: self.D.T(y) * self.G(x), 1: lambda: other, 2: lambda: -anp.sum(y * x)}
                with np.errstate(over="ignore", invalid="ignore"):  # what overflows is refused
                    return tuple(_representable(of_argument(slopes[num](), (k, b, shift)[num])) for num in nums)

            return pull

        def jvp(nums, tangents, ans, k, b, shift):
            first, second = (self.D.T, self.G.T) if transposed else (self.G, self.D)
            change = {0: lambda t: second(t * first(ans)), 1: lambda t: t, 2: lambda t: -t * ans}
            total = sum(change[num](t) for num, t in zip(nums, tangents, strict=True))
            return self._rule(transposed)(k, total, shift)

        return Rule("elliptic_solver.T" if transposed else "elliptic_solver", forward, vjp, jvp)

    # ------------------------------------------------------------ set-up

    def _inverse(self, k, shift):
        """The set-up for this content, from the last two or new."""
        k = np.asarray(k, dtype=float)
        known = self._kept.find((k, shift))
        if known is not None:
            return known
        op, settings = self._operator(k.copy(), shift), self._settings
        return self._kept.put((k, shift), build(op, name="elliptic_solver", log=self.info, solves="few", **settings))

    def _operator(self, k, shift):
        name = f"{shift:g} - {self.D.name} @ diag(k) @ {self.G.name}"
        if k.size and np.all(k == k[0]) and self._product.separable and self._settings["method"] != "direct":
            # A constant coefficient keeps the operator a sum of 1-D factors.
            op = -k[0] * self._product + shift * identity(self.G.domain)
            return Operator(op.structure, self.G.domain, self.D.codomain, name)
        return Operator(Elliptic(self._assembly, k, shift), self.G.domain, self.D.codomain, name)

    @cached_property
    def _product(self):
        return self.D @ self.G

    def __repr__(self):
        return f"<elliptic_solver: shift - {self.D.name} @ diag(k) @ {self.G.name} on {self.G.domain}>"

    def __str__(self):
        if not len(self._kept):
            return f"{self!r}, not set up yet"
        return f"{self!r}, {len(self._kept)} of {self._kept.most} set-ups kept, the last one:\n{self._kept.last}"


def _representable(cotangent):
    """Refuse products of two solutions that overflow."""
    if not np.all(np.isfinite(plain(cotangent))):
        raise NonFiniteError("a gradient of elliptic_solver is beyond 1.8e308; scale the loss or the right-hand side")
    return cotangent


def _check_shift(shift):
    if np.shape(shift) != ():
        raise ShapeError(f"shift takes one number, got an array of shape {np.shape(shift)}")
    if np.asarray(shift).dtype.kind not in "biuf":
        raise ValueError(f"shift must be real, got {shift!r}; write for example shift=1.0")
    check_finite("shift", shift)


class Elliptic(Structure):
    """shift - D diag(k) G as a structure: applied without a matrix, assembled by one product.

    Parameters
    ----------
    assembly : Assembly
        D, G and the map from k to the entries.
    k : array, shape (faces,)
    shift : float
    """

    def __init__(self, assembly, k, shift, transposed=False):
        self.assembly, self.k, self.shift = assembly, k.reshape(-1), shift
        self.transposed = transposed
        self.shape = (prod(assembly.D.codomain.shape),) * 2
        self.dtype = np.result_type(assembly.D.dtype, assembly.G.dtype)
        self.has_entries = assembly.has_entries

    @cached_property
    def _product(self):
        """D diag(k) G, which acts in one pass where D and G are differences of a grid."""
        product = Chain([self.assembly.D.structure, Diagonal(self.k), self.assembly.G.structure])
        return product.transpose() if self.transposed else product

    def apply(self, x, out):
        wide = x.astype(np.result_type(x.dtype, np.float64), copy=False)
        np.copyto(out, self.shift * wide - self._product.product(wide), casting="same_kind")

    def magnitude(self):
        first, second = self.assembly.magnitudes[self.transposed]
        return lambda x: abs(self.shift) * x + second(self.k * first(x))

    def transpose(self):
        return Elliptic(self.assembly, self.k, self.shift, not self.transposed)

    @cached_property
    def _entries(self):
        matrix = self.assembly.matrix(self.k, self.shift)
        return matrix.T.tocsr() if self.transposed else matrix

    def explicit(self):
        return self._entries
