"""Matrix-free finite elements on a box of equal hexahedra: one element matrix, applied to the values at the corners.

The stiffness matrix is a sum over elements with one coefficient each,

    A(k) = sum_e k_e G_e^T K G_e ,

where G_e picks the values at the corners of the element e, and K is the element matrix that scikit-fem computes.
No matrix of the whole mesh is assembled. The equations are solved by conjugate gradients, preconditioned by one V-cycle
of geometric multigrid. Its coarse elements have the Galerkin matrices sum_child P^T K_child P.
"""

from functools import cached_property

import autograd.numpy as np
import skfem
from scipy import sparse
from scipy.sparse.linalg import splu
from skfem.models.elasticity import lame_parameters, linear_elasticity
from skfem.models.poisson import laplace

import sparsedp as dp

__all__ = ["Hexahedra", "elasticity_matrix", "heat_matrix"]

SWEEPS = 2  # of the smoother, before and after the coarse correction
MOST_FACTORED = 600  # unknowns of the coarsest level, whose matrix is factored, unless its shape is odd
SMOOTHED = 0.25  # the smoother damps eigenvalues between this share of the largest one and the largest one
ISOTROPIC = 1.5  # ratio of widths up to which elements become longer along both axes
CORNERS = list(np.ndindex(2, 2, 2))


def heat_matrix(widths):
    """Return the element matrix of heat conduction with conductivity 1 for a box of the given widths."""
    return _element_matrix(widths, skfem.ElementHex1(), laplace)


def elasticity_matrix(widths, poisson):
    """Return the element matrix of linear elasticity with Young's modulus 1 for a box of the given widths."""
    first, shear = lame_parameters(1.0, poisson)
    return _element_matrix(widths, skfem.ElementVector(skfem.ElementHex1()), linear_elasticity(first, shear))


def _element_matrix(widths, element, form):
    """Return the element matrix, its unknowns ordered by component and then by corner as in `CORNERS`."""
    mesh = skfem.MeshHex.init_tensor(*([0.0, width] for width in widths))
    basis = skfem.Basis(mesh, element)
    at_upper_side = (mesh.p > 0.5 * np.reshape(widths, (3, 1))).astype(int)
    corner = np.ravel_multi_index(at_upper_side, (2, 2, 2))
    order = basis.nodal_dofs[:, np.argsort(corner)].ravel()
    return form.assemble(basis).toarray()[np.ix_(order, order)]


def interpolation(coarsened):
    """Return one matrix for each child of an element: values at its corners from those at the corners of the parent.

    Parameters
    ----------
    coarsened : sequence of bool
        The axes along which the parent is twice as long. Along the others it has one child.
    """
    matrices = []
    halves = [(np.array([[1.0, 0.0], [0.5, 0.5]]), np.array([[0.5, 0.5], [0.0, 1.0]])), (np.eye(2),)]
    x, y, z = (halves[0] if yes else halves[1] for yes in coarsened)
    for along_x in x:
        for along_y in y:
            for along_z in z:
                matrices.append(np.kron(np.kron(along_x, along_y), along_z))
    return matrices


class Hexahedra:
    """A box of nx x ny x nz equal hexahedra with trilinear fields, differentiable in one coefficient for each element.

    Parameters
    ----------
    shape : tuple of 3 int
        Elements along each axis.
    widths : sequence of 3 float
        Of an element; they decide along which axes multigrid makes larger elements.
    matrix : array, shape (8 c, 8 c)
        The element matrix, for fields of c components.
    fixed : bool array, shape (nx + 1, ny + 1, nz + 1)
        The nodes at which the field is 0.
    """

    def __init__(self, shape, widths, matrix, fixed, rtol=1e-10):
        self.shape = tuple(shape)
        self.widths = tuple(widths)
        self.matrix = matrix
        self.components = matrix.shape[0] // 8
        self.nodes = (self.components, *(n + 1 for n in shape))
        self.corners = (matrix.shape[0], *shape)
        self.free = np.broadcast_to(~fixed, self.nodes).astype(float)
        self.rtol = rtol
        self.gather = dp.from_functions(self._gathered, self._scattered, self.nodes, self.corners, name="gather")
        self.solve = dp.differentiable("hexahedral solve", self._solve, self._pull, self._push)
        self._last = None

    # ------------------------------------------------------------ products

    def _gathered(self, u):
        """Return the values at the corners of each element."""
        out = np.empty((self.components, 8, *self.shape), u.dtype)
        for number, corner in enumerate(CORNERS):
            out[:, number] = u[(slice(None), *self._nodes_at(corner))]
        return out.reshape(self.corners)

    def _scattered(self, values):
        """Return the sums of the values at the corners that are one node."""
        values = values.reshape(self.components, 8, *self.shape)
        out = np.zeros(self.nodes, values.dtype)
        for number, corner in enumerate(CORNERS):
            out[(slice(None), *self._nodes_at(corner))] += values[:, number]
        return out

    def _nodes_at(self, corner):
        """Return the index of the nodes at one corner of the elements."""
        return tuple(slice(first, first + n) for first, n in zip(corner, self.shape, strict=True))

    def product(self, k, u):
        """Return A(k) u on the free nodes, 0 elsewhere; differentiable in both arguments, and linear in each."""
        at_corners = self.gather(self.free * u)
        return self.free * self.gather.T(k * np.tensordot(self.matrix, at_corners, 1))

    def energies(self, y, x):
        """Return y_e^T K x_e of each element, the derivative of y^T A(k) x."""
        at_corners = np.tensordot(self.matrix, self.gather(self.free * x), 1)
        return np.sum(self.gather(self.free * y) * at_corners, axis=0)

    def stiffness(self, k):
        """Return the Operator A(k), with the identity on fixed nodes."""

        def apply(u):
            return self.product(k, u) + (1.0 - self.free) * u

        return dp.from_functions(apply, apply, self.nodes, self.nodes, name="stiffness")

    # ------------------------------------------------------------ solves

    def set_up(self, k):
        """Return the power of two s near the largest k, and the inverse of A(k / s); the last ones are kept."""
        if k.shape != self.shape or np.iscomplexobj(k):
            raise ValueError(f"k must be a real array of shape {self.shape}, got {k.dtype} of shape {k.shape}")
        if not np.all((k > 0.0) & np.isfinite(k)):
            raise ValueError("the coefficients of all elements must be positive and finite")
        if self._last is None or not np.array_equal(self._last[0], k):
            scale = 2.0 ** np.frexp(np.max(k))[1]
            cycle = Level(self.shape, self.widths, self.matrix, k / scale, self.free).correction
            inverse = dp.inverse(self.stiffness(k / scale), "krylov", rtol=self.rtol, preconditioner=cycle)
            self._last = (k.copy(), scale, inverse)
        return self._last[1:]

    def _solve(self, k, b):
        scale, inverse = self.set_up(np.array(k))
        return inverse(self.free * b) / scale

    def _pull(self, places, x, k, b):
        def pull(g):
            y = self.solve(k, g)
            return tuple(-self.energies(y, x) if place == 0 else self.free * y for place in places)

        return pull

    def _push(self, places, tangents, x, k, b):
        change = 0.0
        for place, tangent in zip(places, tangents, strict=True):
            change = change + (-self.product(tangent, x) if place == 0 else tangent)
        return self.solve(k, change)


# ---------------------------------------------------------------- multigrid


class Level:
    """A level of the multigrid hierarchy.

    Parameters
    ----------
    shape : tuple of 3 int
    widths : sequence of 3 float
    matrices : array, shape (8 c, 8 c) or (8 c, 8 c, nx, ny, nz)
        The element matrix, or one for each element.
    k : array, shape (nx, ny, nz)
        The factor of the matrix of each element.
    free : array, shape (c, nx + 1, ny + 1, nz + 1)
        1 at free nodes, 0 at fixed ones.
    """

    def __init__(self, shape, widths, matrices, k, free):
        self.mesh = Hexahedra(shape, widths, np.zeros(matrices.shape[:2]), free[0] == 0)
        self.matrices = matrices
        self.k = k
        self.free = free
        of_corners = np.moveaxis(np.diagonal(matrices), -1, 0)  # the diagonal of the element matrices
        diagonal = self.mesh._scattered(of_corners.reshape(-1, *matrices.shape[2:] or (1, 1, 1)) * k)
        self.inverse_diagonal = free / np.where(free == 0, 1.0, diagonal)
        coarsened = self._coarsened_axes()
        self.coarse = None
        if np.sum(free) > MOST_FACTORED and any(coarsened):
            self.interpolations = interpolation(coarsened)
            self.steps = [2 if yes else 1 for yes in coarsened]
            self.coarse = Level(*self._coarse_problem())
            self.largest = 1.1 * self._largest_eigenvalue()

    def product(self, u):
        """Return A u; u is 0 at fixed nodes, and so is the result."""
        at_corners = self.mesh._gathered(u)
        if self.matrices.ndim == 2:
            result = np.tensordot(self.matrices, at_corners, 1)
        else:
            result = np.einsum("ijxyz,jxyz->ixyz", self.matrices, at_corners)
        return self.free * self.mesh._scattered(self.k * result)

    def _coarsened_axes(self):
        """Return which axes get elements twice as long: those of short elements, as links along them are strong."""
        can_be = [n % 2 == 0 for n in self.mesh.shape]
        shortest = min((width for width, yes in zip(self.mesh.widths, can_be, strict=True) if yes), default=0.0)
        return [yes and width < ISOTROPIC * shortest for width, yes in zip(self.mesh.widths, can_be, strict=True)]

    def _children(self):
        """Return the index of the elements that are child number 0, 1, ... of their parents."""
        offsets = np.ndindex(*self.steps)
        return [tuple(slice(first, None, step) for first, step in zip(o, self.steps, strict=True)) for o in offsets]

    def _coarse_problem(self):
        """Return the arguments of the next level, whose elements have Galerkin matrices."""
        identity = np.eye(self.mesh.components)
        shape = tuple(n // step for n, step in zip(self.mesh.shape, self.steps, strict=True))
        matrices = 0.0
        for child, weights in zip(self._children(), self.interpolations, strict=True):
            P = np.kron(identity, weights)
            if self.matrices.ndim == 2:
                of_child = (P.T @ self.matrices @ P)[:, :, None, None, None]
            else:
                left = np.tensordot(P.T, self.matrices[(slice(None), slice(None), *child)], 1)
                of_child = np.moveaxis(np.tensordot(left, P, (1, 0)), -1, 1)
            matrices = matrices + of_child * self.k[child]
        nodes = tuple(slice(None, None, step) for step in self.steps)
        widths = [width * step for width, step in zip(self.mesh.widths, self.steps, strict=True)]
        return shape, widths, np.ascontiguousarray(matrices), np.ones(shape), self.free[(slice(None), *nodes)]

    def _interpolate(self, u):
        """Return the trilinear interpolation of a coarse field."""
        for axis, step in enumerate(self.steps, start=1):
            if step == 2:
                u = np.moveaxis(u, axis, 0)
                fine = np.empty((2 * u.shape[0] - 1, *u.shape[1:]))
                fine[::2] = u
                fine[1::2] = 0.5 * (u[1:] + u[:-1])
                u = np.moveaxis(fine, 0, axis)
        return self.free * u

    def _restrict(self, r):
        """Return the transposed interpolation of a fine field."""
        for axis, step in enumerate(self.steps, start=1):
            if step == 2:
                r = np.moveaxis(r, axis, 0)
                coarse = r[::2].copy()
                coarse[1:] += 0.5 * r[1::2]
                coarse[:-1] += 0.5 * r[1::2]
                r = np.moveaxis(coarse, 0, axis)
        return self.coarse.free * r

    def _largest_eigenvalue(self):
        """Return an estimate of the largest eigenvalue of A divided by its diagonal, by the power method."""
        signs = (-1.0) ** np.sum(np.indices(self.free.shape), axis=0)
        v = self.free * (signs + 0.1 * np.sin(np.arange(signs.size)).reshape(signs.shape))
        for _ in range(12):
            v = v / np.linalg.norm(v)
            w = self.inverse_diagonal * self.product(v)
            estimate = np.linalg.norm(w)
            v = w
        return estimate

    def _smooth(self, x, b):
        """Return x after Chebyshev sweeps, which damp the upper part of the spectrum."""
        upper = self.largest
        lower = SMOOTHED * upper
        centre = 0.5 * (upper + lower)
        radius = 0.5 * (upper - lower)
        direction = self.inverse_diagonal * (b - self.product(x)) / centre
        x = x + direction
        ratio = radius / centre
        for _ in range(SWEEPS - 1):
            next_ratio = 1.0 / (2.0 * centre / radius - ratio)
            residual = self.inverse_diagonal * (b - self.product(x))
            direction = next_ratio * ratio * direction + 2.0 * next_ratio / radius * residual
            x = x + direction
            ratio = next_ratio
        return x

    @cached_property
    def factors(self):
        """The LU factors of the assembled matrix of the coarsest level."""
        numbers = self.mesh._gathered(np.arange(float(self.free.size)).reshape(self.free.shape)).astype(int)
        rows, columns = np.broadcast_arrays(numbers[:, None], numbers[None])
        places = rows.ravel(), columns.ravel()
        matrices = self.matrices.reshape(*self.matrices.shape[:2], *self.matrices.shape[2:] or (1, 1, 1)) * self.k
        assembled = sparse.coo_array((matrices.ravel(), places), shape=(self.free.size,) * 2)
        free = sparse.diags_array(self.free.ravel())
        return splu((free @ assembled @ free + sparse.eye_array(self.free.size) - free).tocsc())

    def cycle(self, b):
        """Return an approximation of the solution for b by one V-cycle, which is symmetric."""
        if self.coarse is None:
            return self.free * self.factors.solve(b.ravel()).reshape(b.shape)
        x = self._smooth(np.zeros(b.shape), b)
        x = x + self._interpolate(self.coarse.cycle(self._restrict(b - self.product(x))))
        return self._smooth(x, b)

    @property
    def correction(self):
        """The cycle as an Operator, the identity on fixed nodes."""

        def apply(b):
            return self.cycle(self.free * b) + (1.0 - self.free) * b

        return dp.from_functions(apply, apply, self.free.shape, self.free.shape, name="V-cycle")
