"""What is no grid, no operator, no function, or no plain array is named at the door."""

import re

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

GRID = dp.Grid((4, 3))
U = np.ones((4, 3))
V = np.ones(GRID.faces.size)
MASKED = np.ma.masked_array(U, mask=np.eye(4, 3, dtype=bool))
SHAPE = dp.errors.ShapeError
TYPE = TypeError
VALUE = ValueError
LAP = -dp.laplacian(GRID, dp.dirichlet)
SOLVE = dp.elliptic_solver(dp.divergence(GRID), dp.gradient(GRID, dp.dirichlet))
BUILDERS = {
    "divergence": dp.divergence,
    "flux": lambda grid: dp.flux(grid, np.s_[1:2, 1:2]),
    "forces": lambda grid: dp.forces(grid, cells=np.s_[1:2, 1:2]),
    "laplacian": dp.laplacian,
    "brinkman": dp.brinkman,
    "curl": dp.curl,
    "upwind": dp.upwind,
    "interior": dp.interior,
    "sample": lambda grid: dp.sample(grid, [[0.5, 0.5]]),
    "restrict": lambda grid: dp.restrict(grid, 2),
    "prolong": lambda grid: dp.prolong(grid, 2),
    "component": lambda grid: dp.component(grid, "x"),
    "harmonic_average": dp.harmonic_average,
    "projection": dp.projection,
    "transport": dp.transport,
}


@pytest.mark.parametrize("given", [None, (4, 3), 7, U, GRID.cells], ids=lambda given: type(given).__name__)
@pytest.mark.parametrize("name", BUILDERS)
def test_what_is_no_grid(name, given):
    message = f"{name} takes a Grid, got {type(given).__name__}; write dp.Grid((64, 64), size=1.0)"
    with pytest.raises(TypeError) as caught:
        BUILDERS[name](given)
    assert str(caught.value) == message


TABLE = [
    (lambda: dp.curl("grid"), TYPE, "curl takes a Grid, got str; write dp.Grid((64, 64), size=1.0)"),
    (
        lambda: dp.from_matrix([[1, 2], [3]]),
        SHAPE,
        "matrix needs rows of one length, got a list of different ones; fill them with 0",
    ),
    (
        lambda: dp.lift(GRID, dp.dirichlet).domain.volumes,
        SHAPE,
        "values on walls have no volumes; take those of grid.cells, faces, nodes or edges",
    ),
    (lambda: dp.diagonal(GRID.cells, MASKED), TYPE, "diagonal takes plain arrays, got a masked array; fill it first"),
    (
        lambda: GRID.split(np.ma.masked_array(V)),
        TYPE,
        "split takes plain arrays, got a masked array; fill it first",
    ),
    (
        lambda: GRID.join(*map(np.ma.masked_array, GRID.split(V))),
        TYPE,
        "join takes plain arrays, got a masked array; fill it first",
    ),
    (lambda: dp.from_matrix(MASKED), TYPE, "matrix takes plain arrays, got a masked array; fill it first"),
    (
        lambda: dp.from_linear_operator(np.eye(3)),
        TYPE,
        "from_linear_operator takes a LinearOperator, got ndarray; write dp.from_matrix",
    ),
    (
        lambda: dp.from_linear_operator(lambda x: x),
        TYPE,
        "from_linear_operator takes a LinearOperator, got function; write dp.from_functions",
    ),
    (lambda: SOLVE(1.0, MASKED), TYPE, "elliptic_solver takes plain arrays, got a masked array; fill it first"),
    (
        lambda: SOLVE(np.ma.masked_array(V), U),
        TYPE,
        "elliptic_solver takes plain arrays, got a masked array; fill it first",
    ),
    (lambda: SOLVE(None, U), TYPE, "k must hold numbers, got dtype object; write np.asarray(k, float)"),
    (lambda: SOLVE("1", U), TYPE, "k must hold numbers, got dtype <U1; write np.asarray(k, float)"),
    (
        lambda: dp.matrix_solver(np.eye(4))(np.ones(4), MASKED[:, 0]),
        TYPE,
        "matrix_solver takes plain arrays, got a masked array; fill it first",
    ),
    (lambda: dp.implicit(None), TYPE, "implicit, as residual, takes a function, got NoneType; write lambda x: ..."),
    (
        lambda: dp.implicit(lambda x: x, LAP.matrix),
        TYPE,
        "implicit, as jacobian, takes a function, got csr_array; write lambda x: ...",
    ),
    (
        lambda: dp.implicit(lambda x: x)(MASKED),
        TYPE,
        "implicit(<lambda>) takes plain arrays, got a masked array; fill it first",
    ),
    (
        lambda: dp.value_and_grad(3.0),
        TYPE,
        "value_and_grad takes a function, got float; write lambda x: np.sum(x**2)",
    ),
    (
        lambda: dp.matrix_exponential(LAP, "a"),
        TYPE,
        "time of matrix_exponential must be one real number, got 'a'",
    ),
    (
        lambda: dp.matrix_power(LAP, [1, 2]),
        TYPE,
        "exponent of matrix_power must be one real number, got [1, 2]",
    ),
    (
        lambda: dp.rollout(None, U, None, 3),
        TYPE,
        "rollout takes a function, got NoneType; write lambda state, params: ...",
    ),
    (lambda: dp.minimize(None, U), TYPE, "minimize takes a function, got NoneType; write lambda x: np.sum(x**2)"),
    (
        lambda: dp.minimize(np.sum, U, callback=1),
        TYPE,
        "callback of minimize takes a function, got int; write lambda record, x: False",
    ),
    (lambda: dp.explain(1.0, U), TYPE, "explain takes a function, got float; write lambda x: np.sum(x**2)"),
    (lambda: dp.stress(1.0, U), TYPE, "stress takes a function, got float; write lambda x: np.sum(x**2)"),
    (
        lambda: dp.work_precision(1.0, {}),
        TYPE,
        "work_precision takes a function, got float; write lambda cells: (loss, x)",
    ),
    (
        lambda: dp.update_direction(LAP.matrix, U),
        TYPE,
        "update_direction takes a function, got csr_array; write lambda x: A @ x - b",
    ),
    (
        lambda: dp.check.gradient(1.0, U),
        TYPE,
        "check.gradient takes a function, got float; write lambda x: np.sum(x**2)",
    ),
    (lambda: dp.check.order(2), TYPE, "check.order takes a function, got int; write lambda n: error on n cells"),
    (
        lambda: dp.check.twin(np.eye(3)),
        TYPE,
        "check.twin takes an Operator, got ndarray; write dp.from_matrix(...) first",
    ),
    (
        lambda: dp.check.transpose(np.eye(3)),
        TYPE,
        "check.transpose takes an Operator, got ndarray; write dp.from_matrix(...) first",
    ),
    (
        lambda: dp.check.operator(None),
        TYPE,
        "check.operator takes an Operator, got NoneType; write dp.from_matrix(...) first",
    ),
    (
        lambda: dp.plot(None, U),
        TYPE,
        "plot takes a Grid, got NoneType; write dp.Grid((64, 64), size=1.0)",
    ),
    (
        lambda: dp.inverse(np.eye(3)),
        TYPE,
        "inverse takes an Operator, got ndarray; write dp.from_matrix(...) first",
    ),
    (
        lambda: dp.convergence([1.0, 0.5]),
        TYPE,
        "convergence takes what minimize returns, got list; write dp.convergence(dp.minimize(loss, start))",
    ),
    (
        lambda: dp.v_curve(1.0),
        TYPE,
        "v_curve takes what check.gradient returns, got float; write dp.v_curve(dp.check.gradient(loss, x))",
    ),
    *(
        (make, TYPE, f"{name} takes an Operator, got csr_array; write dp.from_matrix(...) first")
        for name, make in {
            "matrix_exponential": lambda: dp.matrix_exponential(dp.laplacian(GRID).matrix),
            "matrix_power": lambda: dp.matrix_power(dp.laplacian(GRID).matrix, 2),
            "matrix_function": lambda: dp.matrix_function(dp.laplacian(GRID).matrix, np.exp),
        }.items()
    ),
]


@pytest.mark.parametrize(("call", "error", "message"), TABLE, ids=[row[2][:60] for row in TABLE])
def test_message(call, error, message):
    with pytest.raises(error) as caught:
        call()
    assert str(caught.value) == message


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.complex64, np.complex128, int, bool])
def test_what_solves_take(kind):
    """Single and complex numbers keep their kind; whole numbers and flags become float64; lists are arrays."""
    b = U.astype(kind)
    wanted = np.dtype(kind) if np.dtype(kind).kind in "fc" else np.dtype(float)
    for solve in (dp.inverse(LAP), dp.inverse(LAP).T, lambda b: SOLVE(1.0, b)):
        x = solve(b)
        assert x.dtype == wanted and solve(b.tolist()).shape == (4, 3)
        assert LAP(x) == pytest.approx(b.astype(wanted), abs=1e-5)
    value, slope = dp.value_and_grad(lambda k: anp.sum(anp.real(SOLVE(k, b))))(V)
    assert slope.dtype == float and np.all(slope <= 1e-12) and value > 0


RENAMED = {"minimise": "dp.minimize", "part": "dp.component(grid, axis)", "embed": "dp.component(grid, axis).T"}


@pytest.mark.parametrize("name, now", RENAMED.items())
def test_a_name_of_the_first_edition_tells_the_new_one(name, now):
    with pytest.raises(AttributeError, match=re.escape(now) + "$"):
        getattr(dp, name)


@pytest.mark.parametrize("act", [lambda: LAP - 1, lambda: 1 + LAP, lambda: LAP + 2.5])
def test_a_number_is_no_operator(act):
    with pytest.raises(TypeError, match=re.escape("cannot be added to -laplacian; write -laplacian + c * dp.identity")):
        act()


@pytest.mark.parametrize("act", [lambda: LAP.matvec(np.ones(3)), lambda: LAP.rmatvec(np.ones((13, 1)))])
def test_a_flat_product_takes_a_flat_array_of_the_size(act):
    with pytest.raises(SHAPE, match=r"@ x must have shape \(12,\), got \(\d+,\); for a field write op\(u\)"):
        act()
