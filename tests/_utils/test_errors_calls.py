"""Calls that do not fit a signature, names of other libraries, paths, and the frames of a traceback."""

import os
import pickle
import re
import traceback
from inspect import signature

import autograd.numpy as anp
import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import eigsh, lobpcg

import sparsedp as dp
from sparsedp._utils.calls import deprecated_attribute
from sparsedp.errors import ShapeError

GRID = dp.Grid((4, 3))
U = np.ones((4, 3))
L = dp.laplacian(GRID, dp.dirichlet)
M = sp.eye_array(12, format="csr")
STEP = dp.stepper("rk4", lambda u, p: -p * u, 0.1)


def square(x):
    return anp.sum(x**2)


ADD = "a sparse matrix cannot be added to laplacian; write A + dp.from_matrix(M, A.domain, A.codomain)"
LBFGS = "it has memory, line_search"
NEEDS = "boundary on x needs dirichlet, neumann, robin(a, b) or a pair of them"
PARAMS = "dp.rollout(step, start, params, n), with params=None if the step has none"
TABLE = [
    # dp.Grid
    (
        lambda: dp.Grid(64, 64),
        TypeError,
        "dp.Grid takes 1 argument by position, got 2; write dp.Grid((64, 64)) for cells of width 1, or add size=1.0",
    ),
    (
        lambda: dp.Grid((8, 8), 1.0),
        TypeError,
        "dp.Grid takes 1 argument by position, got 2; write dp.Grid((8, 8), size=1.0)",
    ),
    (lambda: dp.Grid(8, dx=0.1), TypeError, "dp.Grid has no argument 'dx'; write spacing=0.1"),
    (lambda: dp.Grid(8, extent=2.0), TypeError, "dp.Grid has no argument 'extent'; write size=2.0"),
    (lambda: dp.Grid(nx=8), TypeError, "dp.Grid has no argument 'nx'; write dp.Grid((64, 64), size=1.0)"),
    (lambda: dp.Grid(), TypeError, "dp.Grid needs the argument 'shape'; write dp.Grid((64, 64), size=1.0)"),
    # functions
    (lambda: dp.plot(U), TypeError, "dp.plot needs the argument 'u'; write dp.plot(grid, u)"),
    (lambda: dp.rollout(STEP, U, 100), TypeError, f"dp.rollout needs the argument 'n'; write {PARAMS}"),
    (lambda: dp.rollout(STEP, U, 1.0, steps=3), TypeError, "dp.rollout has no argument 'steps'; write n=..."),
    (lambda: dp.laplacian(GRID, bc=dp.dirichlet), TypeError, "dp.laplacian has no argument 'bc'; write boundary=..."),
    (
        lambda: dp.laplacian(GRID, grid=GRID),
        TypeError,
        "dp.laplacian was given an argument twice, by position and by name; write dp.laplacian(grid)",
    ),
    (lambda: dp.curl(GRID, U), TypeError, "dp.curl takes 1 argument by position, got 2; write dp.curl(grid)"),
    (
        lambda: dp.save("u.npz", GRID, U),
        TypeError,
        "dp.save takes 2 arguments by position, got 3; write dp.save('run.npz', grid, u=u)",
    ),
    (lambda: dp.save(U, GRID), TypeError, "save takes the path of a file first, got ndarray; write 'fields.npz'"),
    (lambda: dp.grad(square, argnums=0), TypeError, "dp.grad has no argument 'argnums'; write argnum=..."),
    (
        lambda: dp.ensemble(square, [U], workers=2),
        TypeError,
        "dp.ensemble has no argument 'workers'; write executor=...",
    ),
    (
        lambda: dp.ensemble(square, 3),
        TypeError,
        "ensemble takes a list of scenes, got 3; write [first, second, ...], or range(n) for numbers",
    ),
    (
        lambda: dp.work_precision(square, {"a": {}}, over={"steps": 5}),
        TypeError,
        "over of work_precision takes a list of values for 'steps', got 5; write [5]",
    ),
    (
        lambda: dp.sample(GRID, (0.5, 0.5)),
        ShapeError,
        "sample needs points of shape (m, 2), got an array of shape (2,); write [[0.5, 0.5]] for one point",
    ),
    (
        lambda: dp.inverse(L, U),
        ValueError,
        "method must be one of auto, separable, direct, structured, multigrid, krylov, schur, got an array "
        "of shape (4, 3); write dp.inverse(op)(b) for a right-hand side b",
    ),
    (
        lambda: dp.projection(GRID, np.ones(GRID.faces.size)),
        ShapeError,
        "the second argument of projection is solid, a boolean array on cells(4, 3), got an array on faces(4, 3); "
        "write dp.projection(grid)(v) for a velocity v",
    ),
    # objects that are called
    (
        lambda: dp.transport(GRID)(U, np.zeros(31)),
        TypeError,
        "dp.transport(grid) needs the argument 'dt'; write dp.transport(grid)(u, v, dt)",
    ),
    (
        lambda: STEP(U),
        TypeError,
        "bad operand type for unary -: 'NoneType'; write step(state, params): the params given are None",
    ),
    # modules
    (lambda: dp.check(square, U), TypeError, "sparsedp.check is a module; write dp.check.gradient(loss, x)"),
    (lambda: dp.network(3), TypeError, "sparsedp.network is a module; write dp.network.dense(p, x)"),
    (lambda: dp.interop(square), TypeError, "sparsedp.interop is a module; write dp.interop.to_torch(f)"),
    (lambda: dp.optimize(square, U), TypeError, "sparsedp.optimize is a module; write dp.minimize(loss, start)"),
    (lambda: dp.advection(GRID), TypeError, "sparsedp.advection is a module; write dp.transport(grid)"),
    (
        lambda: dp.report(square),
        TypeError,
        "sparsedp.report is a module; write dp.explain(loss, x), or python -m sparsedp report scene.py",
    ),
    (lambda: dp.check.grad, AttributeError, "module 'sparsedp.check' has no attribute 'grad'; write 'gradient'"),
    (
        lambda: dp.check.gradient(square),
        TypeError,
        "dp.check.gradient needs the argument 'x'; write dp.check.gradient(loss, x)",
    ),
    # minimize
    (
        lambda: dp.minimize(square, U, constraints=[]),
        ValueError,
        "lbfgs takes no constraints; write method= one of augmented_lagrangian, mma, slsqp, trust_constr, ipopt",
    ),
    (
        lambda: dp.minimize(square, U, lr=0.1),
        TypeError,
        f"lbfgs has no option 'lr'; {LBFGS}; write method='adam', rate=...",
    ),
    (
        lambda: dp.minimize(square, U, options={}),
        TypeError,
        f"lbfgs has no option 'options'; {LBFGS}; write the options themselves as keyword arguments, as in memory=20",
    ),
    (lambda: dp.minimize(square, U, memry=3), TypeError, f"lbfgs has no option 'memry'; {LBFGS}; write 'memory'"),
    # operators
    (lambda: L + M, TypeError, ADD),
    (lambda: M + L, TypeError, ADD),
    (lambda: L - M, TypeError, ADD),
    (lambda: M - L, TypeError, ADD),
    (
        lambda: L @ M,
        TypeError,
        "laplacian @ a sparse matrix is not defined; write A @ dp.from_matrix(M, A.domain, A.codomain)",
    ),
    (lambda: L**2, TypeError, "laplacian ** 2 is not defined; write A @ A, or dp.matrix_power(A, exponent)(u)"),
    (
        lambda: L(U.ravel()),
        ShapeError,
        "laplacian takes a field on cells(4, 3), got an array of shape (12,); write op(u.reshape(4, 3)), or op @ u for "
        "a flat array",
    ),
    (
        lambda: lobpcg(-L, np.eye(12)[:, :2], M=dp.inverse(-L)),
        ShapeError,
        "-laplacian takes a field on cells(4, 3), got an array of shape (12, 2); for the columns of a matrix, as "
        "lobpcg of SciPy gives them, write op.to_scipy()",
    ),
    (lambda: L.tocsr(), AttributeError, "Operator has no attribute 'tocsr'; write op.matrix"),
    # conditions
    (
        lambda: dp.transport(GRID, boundary=dp.inflow),
        TypeError,
        f"{NEEDS}, got inflow; inflow belongs to dp.projection and dp.flow_step, write dp.dirichlet here",
    ),
    (
        lambda: dp.laplacian(GRID, {"x": (dp.outflow, dp.inflow)}),
        TypeError,
        f"{NEEDS}, got (outflow, inflow); outflow belongs to dp.projection and dp.flow_step, write dp.neumann here",
    ),
    (
        lambda: dp.laplacian(GRID, "periodic"),
        TypeError,
        f"{NEEDS}, got 'periodic'; write dp.Grid(shape, periodic=True) and no condition",
    ),
    # steps
    (
        lambda: dp.stepper(square, 0.1),
        ValueError,
        "method must be one of euler, heun, ssprk3, rk4, backward_euler, crank_nicolson, tr_bdf2, imex, radau, "
        f"rodas5p, etdrk4, leapfrog, got {square!r}; write stepper('rk4', rate, dt)",
    ),
]


@pytest.mark.parametrize(("call", "error", "message"), TABLE, ids=[row[2][:50] for row in TABLE])
def test_message(call, error, message):
    with pytest.raises(error) as caught:
        call()
    assert str(caught.value) == message


FUNCTIONS = sorted(name for name in dp._MODULE_OF if hasattr(getattr(dp, name), "__wrapped__"))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_public_function_says_what_to_write(name):
    function = getattr(dp, name)
    parameters = signature(function).parameters.values()
    required = [p.name for p in parameters if p.default is p.empty and p.kind is p.POSITIONAL_OR_KEYWORD]
    if required:
        with pytest.raises(
            TypeError, match=re.escape(f"dp.{name} needs the argument {required[0]!r}; write dp.{name}(")
        ):
            function()
    if not any(p.kind is p.VAR_KEYWORD for p in parameters):
        with pytest.raises(TypeError, match=re.escape(f"dp.{name} has no argument 'qqqq'; write dp.{name}(")):
            function(qqqq=1)


def test_public_functions_are_wrapped_once_and_can_be_pickled():
    assert len(FUNCTIONS) > 50
    for name in FUNCTIONS:
        function = getattr(dp, name)
        assert pickle.loads(pickle.dumps(function)) is function and function.__module__ == "sparsedp"
        assert function.__doc__ == function.__wrapped__.__doc__
    assert pickle.loads(pickle.dumps(dp.check.gradient)) is dp.check.gradient


def test_an_error_of_the_arguments_inside_a_function_stays():
    with pytest.raises(TypeError, match=r"<lambda>\(\) takes 1 positional argument but 2 were given"):
        dp.grad(lambda x: x)(1.0, 2.0)


def test_what_the_advice_says_works():
    A = -L
    smallest = eigsh(A, k=2, which="SM", return_eigenvectors=False)
    values, _ = lobpcg(A.to_scipy(), np.eye(12)[:, :2], M=dp.inverse(A).to_scipy(), largest=False, tol=1e-9, maxiter=40)
    assert np.allclose(np.sort(smallest), np.sort(values))
    assert np.array_equal((L + dp.from_matrix(M, L.domain, L.codomain))(U), L(U) + U)
    assert np.array_equal((L @ dp.from_matrix(M, L.domain, L.codomain))(U), L(U))
    assert dp.stepper("backward_euler", dp.laplacian(GRID), 0.1)(U).shape == U.shape


# ---- tracebacks ------------------------------------------------------------------------------------------------------


def failing_calls():
    """Calls whose error arises deep inside: a value, a gradient, a rollout and its gradient, an optimization."""
    operator = -dp.laplacian(dp.Grid((16, 16), size=1.0), dp.dirichlet)
    solve = dp.inverse(operator, "krylov", maxiter=1)
    b = np.random.default_rng(0).standard_normal((16, 16))

    def loss(b):
        return anp.sum(solve(b))

    def step(u, p):
        return p * solve(u)

    def long_loss(p):
        return anp.sum(dp.rollout(step, b, p, 3))

    return {
        "solve": lambda: solve(b),
        "gradient": lambda: dp.value_and_grad(loss)(b),
        "rollout": lambda: dp.rollout(step, b, 1.0, 3),
        "gradient of a rollout": lambda: dp.grad(long_loss)(1.0),
        "minimize": lambda: dp.minimize(loss, b),
        "check": lambda: dp.check.gradient(loss, b),
        "hvp": lambda: dp.hvp(loss, b, b),
        "pull": lambda: dp.vjp(lambda b: dp.inverse(operator, "krylov", maxiter=1)(b), b),
    }


def frames_of(call):
    with pytest.raises(dp.errors.ConvergenceError) as caught:
        call()
    return [frame.filename for frame in traceback.extract_tb(caught.value.__traceback__)][1:]  # without this file's


@pytest.mark.parametrize("name", failing_calls())
def test_a_traceback_shows_the_frames_of_the_user(name, monkeypatch):
    call = failing_calls()[name]
    frames = frames_of(call)
    inside = [file for file in frames if file != __file__]
    assert len(inside) == 2  # the entrance, and the line that raised
    assert inside[-1].endswith("solve.py") and frames[0] == __file__
    monkeypatch.setenv("SPARSEDP_TRACEBACK", "full")
    whole = frames_of(call)
    assert len(whole) >= len(frames) + 4  # the hidden frames of `solve`, whose path is the shortest
    assert [file for file in whole if file == __file__] == [file for file in frames if file == __file__]


def test_a_traceback_of_a_users_error_ends_there():
    def loss(x):
        return anp.sum(x) / nothing  # noqa: F821

    with pytest.raises(NameError) as caught:
        dp.value_and_grad(loss)(np.ones(3))
    frames = traceback.extract_tb(caught.value.__traceback__)
    assert [frame.name for frame in frames if frame.filename == __file__][-1] == "loss" and len(frames) == 3


def test_causes_are_shortened_too():
    with pytest.raises(dp.errors.DerivativeError) as caught:
        dp.grad(lambda x: float(anp.sum(x)))(np.ones(3))
    assert len(traceback.extract_tb(caught.value.__cause__.__traceback__)) <= 3


# ---- paths -----------------------------------------------------------------------------------------------------------

LONG = "a" * 300


def minimize_into(path):
    dp.minimize(square, U, checkpoint=path)


def save_npz(path):
    dp.save(f"{path}.npz", GRID, u=U)


def save_zarr(path):
    pytest.importorskip("zarr")
    pytest.importorskip("xarray")
    dp.save(f"{path}.zarr", GRID, u=U)


@pytest.mark.parametrize(
    ("write", "name", "advice"),
    [
        (minimize_into, "file", "File exists; give the path of a folder, this is a file"),
        (minimize_into, "file/below", "Not a directory; give a path through folders, a part of this one is a file"),
        (minimize_into, LONG, "File name too long; shorten the name, most file systems take up to 255 bytes"),
        (save_npz, LONG, "File name too long; shorten the name, most file systems take up to 255 bytes"),
        (save_zarr, LONG, "File name too long; shorten the name, most file systems take up to 255 bytes"),
        (save_npz, "missing/u", "No such file or directory; create the folder first"),
        (save_zarr, "missing/u", "No such file or directory; create the folder first"),
        (save_npz, "folder", "Is a directory; give the path of a file, this is a folder"),
        (dp.from_image, LONG, "File name too long; shorten the name, most file systems take up to 255 bytes"),
        (
            lambda path: dp.load(f"{path}.npz"),
            LONG,
            "File name too long; shorten the name, most file systems take up to",
        ),
    ],
    ids=lambda value: "long name" if value == LONG else None,
)
def test_a_path_that_cannot_be_used(write, name, advice, tmp_path):
    (tmp_path / "file").write_text("")
    os.mkdir(tmp_path / "folder.npz")
    with pytest.raises(OSError, match=re.escape(advice)) as caught:
        write(tmp_path / name)
    assert str(tmp_path / name) in str(caught.value) and str(caught.value).count(";") == 1


def test_a_file_that_is_not_there_keeps_pythons_words(tmp_path):
    with pytest.raises(FileNotFoundError) as caught:
        dp.load(tmp_path / "u.npz")
    assert caught.value.strerror == "No such file or directory"


def test_a_deprecated_attribute_works_and_warns():
    class Plan:
        skipped = ("velocity",)
        left_out = deprecated_attribute("left_out", "skipped", "0.5")

    message = "Plan.left_out is deprecated and will be removed in version 0.5; write Plan.skipped"
    with pytest.warns(DeprecationWarning, match=message) as warned:
        assert Plan().left_out == ("velocity",)
    assert warned[0].filename == __file__
