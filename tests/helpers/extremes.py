"""Scenes of extreme cases: operators, dense inverses to compare with, and the kinds of arrays a field may come as."""

from typing import Any, NamedTuple

import numpy as np
import pytest

import sparsedp as dp
from sparsedp import kernels
from sparsedp.solvers.choose_method import METHODS as WORDS

METHODS = ("auto", *(word for word in WORDS if word != "schur"))  # schur refuses operators without multipliers
OPTIONS = {"krylov": {"preconditioner": "jacobi", "maxiter": 5000}}  # where coefficients or cells differ in size
EVERY = pytest.mark.parametrize("method", METHODS)
# Point smoothing: structured refuses honestly there (tests/solvers/test_structured.py), and auto does not choose it.
STRONG = pytest.mark.parametrize("method", [word for word in METHODS if word != "structured"])


# ---- solvers -----------------------------------------------------------------------------------------------------


def unfit(op, method):
    """Why a method may refuse an operator, or "": the only reasons for which a test is skipped."""
    dim = op.domain.grid.dim
    return {
        "separable": "" if op.separable else "no sum of 1-D factors",
        "structured": "1-D" if dim == 1 else "" if kernels.compiled() else "numba is not installed",
    }.get(method, "")


def solver(op, method, **options):
    """inverse(op, method). Skips the test when the method refuses the operator for a reason that is known here."""
    try:
        return dp.inverse(op, method, **options)
    except ValueError as error:
        if not unfit(op, method) or not str(error).startswith(f"{method} "):
            raise
        pytest.skip(str(error))


def elliptic(D, G, method, **options):
    """elliptic_solver for a coefficient that varies."""
    if unfit(D @ dp.diagonal(D.domain, 1.0 + np.arange(D.domain.size)) @ G, method):
        pytest.skip(f"{method} does not take this operator with a coefficient that varies")
    return dp.elliptic_solver(D, G, method, **options)


# ---- operators ---------------------------------------------------------------------------------------------------


def stretched(*shape, unit=1.0, **options):
    return dp.Grid(shape, spacing=[unit * (1.0 + 0.5 * np.sin(np.arange(n))) for n in shape], **options)


def regions(count):
    """Solid cells that leave `count` regions of 2 x 2 cells, and as many islands of one cell."""
    solid = np.ones((3 * count, 5), dtype=bool)
    for number in range(count):
        solid[3 * number : 3 * number + 2, :2] = False
        solid[3 * number, 3] = False
    return solid


def neumann(grid, solid=None):
    return -dp.divergence(grid) @ dp.gradient(grid, solid=solid)


def obstacle():
    """Two regions, an island, and a coefficient that varies: no sum of factors."""
    grid = stretched(16, 14)
    solid = np.zeros(grid.shape, dtype=bool)
    solid[7:10] = True
    solid[8, 5] = False
    k = dp.diagonal(grid.faces, speeds(grid))
    return -dp.divergence(grid) @ k @ dp.gradient(grid, solid=solid)


SCENES = {
    "dirichlet": lambda: -dp.laplacian(dp.Grid((14, 13), size=1.0), dp.dirichlet),
    "neumann": lambda: neumann(stretched(14, 13)),
    "obstacle": obstacle,
    "line": lambda: -dp.laplacian(stretched(151), {"x": (dp.robin(1, 2), dp.neumann)}),
    "box": lambda: dp.laplacian(dp.Grid((6, 5, 7), periodic=(True, False, True))),
}
IN_SCENES = pytest.mark.parametrize("scene", SCENES)


# ---- coefficients and cells ----------------------------------------------------------------------------------------

COEFFICIENTS = ("inclusion 1e8", "inclusion 1e-8", "checkerboard 1e8", "random 8 decades")
BOUNDARIES = {"dirichlet": dp.dirichlet, "neumann": dp.neumann, "robin": dp.robin(1, 2), "periodic": dp.neumann}
SMALL = [(1,), (2,), (1, 1), (1, 7), (7, 1), (2, 2), (13, 11), (17,), (1, 1, 1), (2, 1, 3), (5, 3, 7)]
NONE = [(0,), (0, 3), (3, 0), (2, 0, 3)]
CLOSED = {"all solid": ((4, 3), np.ones((4, 3), dtype=bool)), **{f"no cells {shape}": (shape, None) for shape in NONE}}
GEOMETRIES = {
    **{f"{n} regions, {n} islands": (regions(n).shape, regions(n)) for n in (1, 2, 50)},
    **{str(shape): (shape, None) for shape in SMALL},
    **CLOSED,
}


def coefficient(name, grid):
    """One value for each face of a 2-D grid of unit cells."""
    rng = np.random.default_rng(3)
    x, y = (grid.join(*(grid.face_centres(a)[b] for a in range(2))) for b in range(2))
    inside = (x - x.mean()) ** 2 + (y - y.mean()) ** 2 < 16
    return {
        "inclusion 1e8": np.where(inside, 1e8, 1.0),
        "inclusion 1e-8": np.where(inside, 1e-8, 1.0),
        "checkerboard 1e8": np.where((x // 3 + y // 3) % 2, 1e8, 1.0),
        "random 8 decades": 10.0 ** rng.uniform(-4, 4, x.shape),
    }[name]


def weak(grid, boundary, axis):
    """Diffusion that is 1e6 times weaker along one axis."""
    k = dp.diagonal(grid.faces, grid.join(*(1e-6 if a == axis else 1.0 for a in range(grid.dim))))
    return -dp.divergence(grid) @ k @ dp.gradient(grid, boundary)


ANISOTROPIC = {
    "weak y": lambda boundary: weak(dp.Grid((16, 15), size=1.0), boundary, 1),
    "weak x": lambda boundary: weak(dp.Grid((15, 16), size=1.0), boundary, 0),
    "flat cells": lambda boundary: -dp.laplacian(dp.Grid((16, 15), spacing=(1.0, 1e-4)), boundary),
    "high cells": lambda boundary: -dp.laplacian(dp.Grid((15, 16), spacing=(1e-4, 1.0)), boundary),
    "clustered": lambda boundary: (
        -dp.laplacian(dp.Grid((15, 16), spacing=[np.geomspace(1e-4, 1, n) for n in (15, 16)]), boundary)
    ),
    "weak z": lambda boundary: weak(dp.Grid((6, 7, 5), size=1.0), boundary, 2),
}


# ---- what is right -----------------------------------------------------------------------------------------------


def dense(op):
    return op.matrix.toarray()


def exact(op):
    """Dense generalised inverse: orthogonal projections in the inner product of the cell volumes."""
    root = np.sqrt(op.domain.volumes.ravel())
    scaled = root[:, None] * dense(op) / root
    assert np.allclose(scaled, scaled.T, rtol=1e-13, atol=1e-13 * np.max(np.abs(scaled), initial=0.0))
    return np.linalg.pinv((scaled + scaled.T) / 2, rcond=1e-12, hermitian=True) * root / root[:, None]


def agree(got, wanted, rel=1e-8, size=0.0):
    """Same shape, no NaN, and the largest difference small beside the largest value wanted, or beside `size`."""
    got = np.asarray(got)
    wanted = np.asarray(wanted)
    assert got.shape == wanted.shape
    assert np.max(np.abs(got - wanted), initial=0.0) <= rel * np.max(np.abs(wanted), initial=size)


def same_bits(got, wanted):
    assert got.dtype == wanted.dtype and got.shape == wanted.shape
    assert np.array_equal(got, wanted)


# ---- columns of the table ----------------------------------------------------------------------------------------


class Column(NamedTuple):
    """A scene that is linear in its field."""

    run: Any  # field -> field, differentiable
    shape: tuple  # of the field
    matrix: np.ndarray  # the same map, dense
    infos: tuple  # the logs of the solvers
    reaches: Any = lambda x: x  # what of the field reaches the first solver


def poisson(scene, method):
    op = SCENES[scene]()
    inv = solver(op, method, nullspace="project")
    return Column(inv, op.domain.shape, exact(op), (inv.info,))


def projection(method, grid, solid=None, k=1.0, **options):
    """Also with a coefficient: v + k G p without divergence."""
    G = dp.gradient(grid, solid=solid)
    D = dp.divergence(grid)
    inside = dp.interior(grid, solid)
    KG = G if np.ndim(k) == 0 else dp.diagonal(grid.faces, k) @ G
    pressure = solver(-D @ KG, method, nullspace="project", **options)

    def run(v):
        v = inside(v)
        return v + KG(pressure(D(v)))

    matrix = (np.eye(grid.faces.size) + dense(KG) @ exact(-D @ KG) @ dense(D)) @ dense(inside)
    return Column(run, grid.faces.shape, matrix, (pressure.info,), lambda v: D(inside(v)))


def implicit(method):
    """Three implicit steps of diffusion."""
    grid = stretched(13, 11)
    op = dp.identity(grid.cells) - 0.3 * dp.laplacian(grid, {"x": dp.dirichlet})
    inv = solver(op, method)
    return Column(lambda u: inv(inv(inv(u))), grid.shape, np.linalg.matrix_power(exact(op), 3), (inv.info,))


def varied(method):
    """Three implicit steps with a coefficient that varies."""
    grid = stretched(12, 11)
    D = dp.divergence(grid)
    G = dp.gradient(grid, dp.dirichlet)
    k = speeds(grid)
    solve = elliptic(D, G, method)
    op = 2.0 * dp.identity(grid.cells) - D @ dp.diagonal(grid.faces, k) @ G
    matrix = np.linalg.matrix_power(2.0 * exact(op), 3)
    return Column(lambda u: march(solve, u, k, 2.0), grid.shape, matrix, (solve.info,))


def speeds(grid):
    return 1.0 + np.sin(np.arange(grid.faces.size)) ** 2


def march(solve, u, k, shift, steps=3):
    for _ in range(steps):
        u = solve(k, shift * u, shift)
    return u


def walled():
    solid = np.zeros((12, 11), dtype=bool)
    solid[5:8] = solid[9, 3] = True
    solid[6, 4] = False
    return solid


COLUMNS = {
    **{f"poisson {scene}": lambda method, scene=scene: poisson(scene, method) for scene in SCENES},
    "projection": lambda method: projection(method, stretched(12, 11)),
    "projection with solids": lambda method: projection(method, stretched(12, 11), walled()),
    "rollout": implicit,
    "rollout, k varies": varied,
}


# ---- kinds of arrays ---------------------------------------------------------------------------------------------


def strided(b):
    wide = np.full([3 * n for n in b.shape], np.nan)
    part = wide[tuple(slice(1, None, 3) for _ in b.shape)]
    part[...] = b
    return part


def reversed_memory(b):
    turned = tuple(slice(None, None, -1) for _ in b.shape)
    return b[turned].copy()[turned]


def read_only(b):
    b = b.copy()
    b.flags.writeable = False
    return b


KINDS = {
    "Fortran order": np.asfortranarray,
    "strided": strided,
    "reversed": reversed_memory,
    "read-only": read_only,
    "broadcast": lambda b: np.broadcast_to(b[..., :1], b.shape),
    "other byte order": lambda b: b.astype(">f8"),
    "float32": lambda b: b.astype(np.float32),
    "int64": lambda b: np.round(8 * b).astype(np.int64),
    "bool": lambda b: b > 0,
}


def check_kind(fun, given):
    """fun(given) is fun(contiguous float64 copy), in single precision for float32; `given` is left as it was."""
    before = given.copy()
    plain = np.ascontiguousarray(given, dtype=float)
    got = fun(given)
    wanted = fun(plain)
    if given.dtype == np.float32:
        assert got.dtype == np.float32
        agree(got, wanted, 2e-6)
    else:
        same_bits(got, wanted)
    assert np.array_equal(given, before) and given.dtype == before.dtype
    assert not np.may_share_memory(got, given)


def check_gradient_of_kind(loss, given):
    """The gradient equals that at the contiguous float64 copy, in the dtype of the input; integers have none."""
    if given.dtype.kind in "biu":
        with pytest.raises(dp.errors.DerivativeError, match="a gradient needs floating values"):
            dp.value_and_grad(loss)(given)
        return
    before = given.copy()
    slope = dp.value_and_grad(loss)(given)[1]
    wanted = dp.value_and_grad(loss)(np.ascontiguousarray(given, dtype=float))[1]
    assert slope.shape == given.shape and slope.dtype == given.dtype
    if given.dtype == np.float32:
        agree(slope, wanted, rel=1e-5)
    else:
        assert np.array_equal(slope, wanted)
    assert np.array_equal(given, before)
