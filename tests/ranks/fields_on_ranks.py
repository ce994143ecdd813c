"""NumPy's functions of fields on ranks, and derivatives, compared with one process.

mpirun -n 2 python -m mpi4py tests/ranks/fields_on_ranks.py
"""

import pickle
import warnings

import autograd.numpy as anp
import numpy as np
from mpi4py import MPI

import sparsedp as dp

COMM = MPI.COMM_WORLD
PLAIN = dp.Grid((7, 9), size=(1.0, 2.0), periodic=(True, False))
GRID = dp.distribute(PLAIN, COMM)


def same_everywhere(value):
    """A number, with the same bits on all ranks."""
    assert len(set(COMM.allgather(np.asarray(value).tobytes()))) == 1, COMM.allgather(value)
    return value


def close(value, expected, tol=1e-13):
    """Compare with the expected value, relative to its size."""
    value = np.asarray(dp.gather(value))
    expected = np.asarray(expected)
    assert value.shape == expected.shape and value.dtype == expected.dtype, (value, expected)
    same_everywhere(value)
    error = np.abs(np.subtract(value, expected, dtype=complex))
    assert np.max(error, initial=0.0) <= tol * np.max(np.abs(expected), initial=1e-300), (value, expected)


def fields():
    """A field of every kind: the whole array, and on ranks."""
    whole = np.random.default_rng(0).standard_normal(PLAIN.shape)
    u = dp.identity(GRID.cells)(whole)
    yield from ((whole.astype(kind), u.astype(kind)) for kind in (float, np.float32))
    yield from ((np.rint(3 * whole).astype(int), np.rint(3 * u).astype(int)), (whole > 0, u > 0))
    yield whole + 1j * whole**2, u + 1j * u**2


# Functions whose result on a field must be that on the whole array; all others must be refused.
ARITHMETIC = [
    lambda u: u + u,
    lambda u: 2.0 * u,
    lambda u: u * 2,
    lambda u: u * (1 + 2j),
    lambda u: -u,
    lambda u: u**2,
    lambda u: abs(u),
    lambda u: u == u,
    lambda u: u != 0,
    lambda u: np.where(u == 0, u, 1.0),
    lambda u: np.conj(u),
    lambda u: u.real,
    lambda u: u.imag,
    lambda u: np.sqrt(u + 0j),
    lambda u: np.zeros_like(u),
    lambda u: np.reshape(u, (7, 9)),
    lambda u: u.astype(complex),
    lambda u: np.sum(u),
    lambda u: np.mean(u),
    lambda u: np.linalg.norm(u),
    lambda u: np.vdot(u, u),
    lambda u: np.any(u),
    lambda u: np.all(u),
    lambda u: np.count_nonzero(u),
    lambda u: np.shape(u),
    lambda u: np.ndim(u),
    lambda u: np.size(u),
    lambda u: np.array_equal(u, u),
    lambda u: np.ones_like(u, dtype=float),
    lambda u: u.nbytes,
    np.iscomplexobj,
]
ORDERED = [
    np.max,
    np.min,
    np.argmax,
    np.argmin,
    lambda u: np.clip(u, -1, 1),
    lambda u: u > 1,
    lambda u: np.maximum(u, 0),
]
REFUSED = [
    lambda u: u[0],
    lambda u: u[0, 1],
    lambda u: float(u),
    lambda u: bool(u),
    lambda u: list(u),
    lambda u: len(u),
    lambda u: np.asarray(u),
    lambda u: np.sum(u, axis=0),
    lambda u: np.mean(u, axis=1),
    lambda u: np.max(u, axis=0),
    lambda u: np.add(u, u, out=u),
    lambda u: np.add.reduce(u),
    lambda u: np.add.accumulate(u),
    pickle.dumps,
    lambda u: np.concatenate([u, u]),
    lambda u: np.roll(u, 1),
    lambda u: u @ u,
    lambda u: np.dot(u, u),
    lambda u: np.fft.fft(u),
    lambda u: np.linalg.norm(u, 1),
    lambda u: np.reshape(u, -1),
    lambda u: int(u),
    lambda u: np.stack([u, u]),
    lambda u: np.einsum("ij->", u),
    lambda u: divmod(u, 2),
    lambda u: np.sort(u),
    lambda u: u.__setitem__(0, 1.0),
    lambda u: np.add(u, u, where=False),
    lambda u: anp.array([u, u]),
    lambda u: np.sum(u, initial=1.0),
    lambda u: np.sum(u, keepdims=True),
    lambda u: u.__iadd__(1.0),
]


def numpy_is_whole_or_refused():
    """Arithmetic and sums act on the whole array; other functions raise an error with their name."""
    for whole, u in fields():
        tol = 1e-6 if whole.dtype == np.float32 else 1e-13
        for act in ARITHMETIC + (ORDERED if whole.dtype.kind != "c" else []):
            try:
                expected = act(whole)
            except TypeError:
                continue  # NumPy takes no such numbers either
            close(act(u), expected, tol)
        for act in REFUSED:
            try:
                actual = act(u)
            except TypeError as error:
                assert "on ranks" in str(error), error
            else:
                raise AssertionError(f"not refused: number {REFUSED.index(act)}, {actual}")


def no_function_of_numpy_sees_the_block():
    """All functions of NumPy, of one field and of two: an error, or the result for the whole array."""
    whole, u = next(fields())
    taken = set()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, act in [pair for room in (np, np.linalg, np.fft) for pair in vars(room).items()]:
            if not callable(act) or isinstance(act, type) or name in ("iterable", "lookfor") or name.startswith("_"):
                continue
            for count in (1, 2):
                try:
                    actual = act(*[u] * count)
                    expected = act(*[whole] * count)
                except Exception:
                    continue
                if isinstance(actual, (type(u), float, bool, np.generic)) and np.asarray(expected).dtype != object:
                    np.testing.assert_allclose(dp.gather(actual), expected, rtol=1e-12, err_msg=name)
                    taken.add(name)
    assert len(taken) > 60, sorted(taken)


def losses(grid):
    """Losses of (field, number) that meet fields, numbers and operators in every way."""
    L = 0.01 * dp.laplacian(grid, dp.dirichlet)
    G = dp.gradient(grid, dp.robin(1, 1))
    A = dp.average(grid)
    points = dp.sample(grid, [[0.3, 0.4], [0.9, 1.9]])
    B = dp.lift(grid, {"y": dp.dirichlet})
    x, y = grid.centres()
    return [
        lambda u, a: anp.sum(anp.sin(L(u) * a) ** 2),
        lambda u, a: anp.mean(anp.exp(a * x * u) * u) + anp.max(u * y) - anp.min(x - a * u),
        lambda u, a: anp.linalg.norm(anp.where(x > 0.5, u * a, u**2)) * a,
        lambda u, a: anp.sum(G(u) * A(a * u**3 + 1.0) / (2.0 + anp.cos(A(u)))),
        lambda u, a: anp.sum(points(u * u) * anp.array([a, 2.0])),
        lambda u, a: anp.sum(B(B.domain.join(a, anp.sin(a))) * G(u)),
        lambda u, a: anp.sum(points.T(a * points(u)) * anp.tanh(u)) + anp.sum(a * x),
        lambda u, a: sum(anp.sum(v * v * (k + a)) for k, v in enumerate(grid.split(G(u * a)))),
        lambda u, a: anp.sum(G(u) * grid.join(*[a * v**2 for v in grid.split(G(u))])),
        lambda u, a: anp.sum(grid.join(u * u, a * anp.ones((7, 10))) * G(u)),
        lambda u, a: anp.sum(anp.abs(L(u * (1.0 + 1j * a))) ** 2),
        lambda u, a: anp.sum(anp.real((a + 1j) * u) * anp.imag(u * (u + 1j * a * x))),
        lambda u, a: anp.sum(grid.volumes * (u - a) ** 2 / (1.0 + u**2)),
    ]


def derivatives_are_those_of_one_process():
    """Gradients, tangents and Hessian products, of fields on ranks and of fields that every rank knows."""
    rng = np.random.default_rng(1)
    u, t = rng.standard_normal((2, *PLAIN.shape))
    for number, (one, loss) in enumerate(zip(losses(PLAIN), losses(GRID))):
        for field in (lambda w: w, dp.identity(GRID.cells)):
            given = [((field(u), 0.7), (field(t), -0.4)), ((u, 0.7), (t, -0.4))]
            acts = [lambda x, f=f: f(*x) for f in (loss, one)]
            value, expected = (dp.value_and_grad(act)(x) for act, (x, _) in zip(acts, given))
            same_everywhere(value[0])
            assert type(value[1][0]) is type(given[0][0][0]), number
            slopes = [dp.jvp(act, *pair)[1] for act, pair in zip(acts, given)]
            curved = [dp.hvp(act, *pair) for act, pair in zip(acts, given)]
            actual = (value[0], *value[1], slopes[0], *curved[0])
            right = (expected[0], *expected[1], slopes[1], *curved[1])
            for pair in zip(actual, right):
                close(*pair, 1e-12)


def rollouts_keep_what_one_process_keeps():
    """The last state and its gradient, for every memory, with a state on ranks or known to all; same bits."""
    u = np.random.default_rng(2).standard_normal(PLAIN.shape)
    actual = set()
    expected = flow = ()
    for grid, field in ((PLAIN, None), (GRID, None), (GRID, dp.identity(GRID.cells))):
        L = dp.laplacian(grid, dp.dirichlet)
        convect = dp.convection(grid)
        step = lambda u, k, L=L: u + k * 1e-3 * L(anp.tanh(u))
        for memory in (None, 6000, 2600):
            start = u if field is None else field(u)
            end = lambda u, k, step=step, memory=memory: anp.sum(dp.rollout(step, u, k, 9, memory=memory) ** 2)
            value, slope = dp.value_and_grad(lambda x, end=end: end(*x))((start, 0.7))
            results = [value, *slope]
            expected = expected or results
            for pair in zip(results, expected):
                close(*pair)
            if grid is GRID and field is not None:
                actual.add(b"".join(np.asarray(dp.gather(result)).tobytes() for result in results))
        v = np.sin(np.arange(grid.faces.size))
        loss = lambda v, convect=convect: anp.sum(anp.sin(convect(v, v)))
        carried = dp.value_and_grad(loss)(v)
        flow = flow or carried
        for pair in zip(carried, flow):
            close(*pair, 1e-12)
    assert len(actual) == 1


def geometry_and_batches():
    """Coordinates, volumes, and what an operator refuses."""
    for space, plain in ((GRID.cells, PLAIN.cells), (GRID.faces, PLAIN.faces), (GRID.nodes, PLAIN.nodes)):
        close(space.volumes, plain.volumes, 0.0)
    for axis in range(2):
        for actual, expected in zip(GRID.face_centres(axis), PLAIN.face_centres(axis)):
            close(actual, expected, 0.0)
    G = dp.gradient(GRID)
    for wrong in (np.zeros((5, *GRID.shape)), np.zeros(3), GRID.faces.volumes):
        try:
            G(wrong)
        except dp.errors.ShapeError as error:
            assert "gradient takes a field on cells" in str(error), error
        else:
            raise AssertionError(f"{np.shape(wrong)} was taken")


if __name__ == "__main__":
    numpy_is_whole_or_refused()
    no_function_of_numpy_sees_the_block()
    geometry_and_batches()
    rollouts_keep_what_one_process_keeps()
    derivatives_are_those_of_one_process()
    if COMM.rank == 0:
        print("all agree")
