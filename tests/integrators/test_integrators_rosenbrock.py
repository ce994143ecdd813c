"""Rodas5P: order conditions, published stiff problems, fields with sparse Jacobians, and exact transposes."""

import autograd.numpy as anp
import numpy as np
import pytest
import scipy.sparse as sp
from scipy.integrate import solve_ivp
from stiff import SCENES, robertson
from test_integrators_radau import RATES, SMALL, X, pendulum, pendulum_by_scipy
from test_integrators_variation import KNOWN

import sparsedp as dp
from sparsedp.errors import DerivativeError
from sparsedp.integrators import rosenbrock
from sparsedp.solvers.jacobian import Jacobians


def table():
    """Weights b, coefficients alpha and beta, and nodes of the method in its usual form."""
    lower = np.zeros((2, 8, 8))
    for part, rows in zip(lower, (rosenbrock.A, rosenbrock.C), strict=True):
        for i, row in enumerate(rows):
            part[i, : len(row)] = row
    gamma = np.linalg.inv(np.eye(8) / rosenbrock.GAMMA - lower[1])
    alpha = lower[0] @ gamma
    return np.array(rosenbrock.B) @ gamma, alpha, alpha + gamma, alpha.sum(1), gamma


def test_order_conditions():
    """Those of Rosenbrock methods of order 5 (Hairer and Wanner, IV.7), and nodes and weights of time derivatives."""
    b, alpha, beta, nodes, gamma = table()
    sums = beta.sum(1)
    conditions = {
        1: b,
        1 / 2: b * sums,
        1 / 3: b * nodes**2,
        1 / 6: b * (beta @ sums),
        1 / 4: b * nodes**3,
        1 / 8: b * nodes * (alpha @ sums),
        1 / 12: b * (beta @ nodes**2),
        1 / 24: b * (beta @ beta @ sums),
        1 / 5: b * nodes**4,
        1 / 10: b * nodes**2 * (alpha @ sums),
        1 / 15: b * nodes * (alpha @ nodes**2),
        1 / 30: b * nodes * (alpha @ beta @ sums),
        1 / 20: b * (beta @ nodes**3),
        1 / 40: b * (beta @ (nodes * (alpha @ sums))),
        1 / 60: b * (beta @ beta @ nodes**2),
        1 / 120: b * (beta @ beta @ beta @ sums),
    }
    for wanted, terms in conditions.items():
        assert np.sum(terms) == pytest.approx(wanted, abs=1e-12)
    assert np.sum(b * (alpha @ sums) ** 2) == pytest.approx(1 / 20, abs=1e-12)
    assert nodes == pytest.approx(rosenbrock.NODES, abs=1e-12)
    assert gamma.sum(1) == pytest.approx(rosenbrock.D, abs=1e-12)


def angle(x, count=1, **options):
    """Of (first angle, g, end, first time): the last angle."""
    step = dp.stepper("rodas5p", pendulum, lambda p: p["T"] / count, **options)
    return dp.rollout(step, ({"a": x[0], "s": 0.0}, x[3]), {"g": x[1], "T": x[2]}, count)[0]["a"]


@pytest.mark.whole
def test_order_five():
    """On a smooth problem that depends on the time; the continuous output has order 4 in a step."""
    exact = pendulum_by_scipy(*X)
    errors = [abs(angle(X, count) - exact) for count in (16, 32, 64)]
    assert np.log2(np.array(errors[:-1]) / errors[1:]) == pytest.approx([5, 5], abs=0.4)
    errors = []
    for h in (0.1, 0.05):
        step = dp.stepper("rodas5p", lambda u, p: -u * u, h)
        run, arguments = step.scheme.interval(np.ones(1), None, None, h)
        middle, share = run.inner_state(run._steps(*arguments)[0])
        errors.append(abs(middle[0] - 1 / (1 + share * h)))
    assert np.log2(errors[0] / errors[1]) >= 4.7


@pytest.mark.whole
@pytest.mark.parametrize("stiffness", [1e2, 1e6, 1e10])
def test_prothero_robinson(stiffness):
    """u' = -k (u - cos t) - sin t, whose solution is cos t: order 5 for a small k, then an error h^3 / k."""
    rate = lambda u, k, t: -k * (u - anp.cos(t)) - anp.sin(t)
    for tolerance in (1e-3, 1e-5, 1e-8):
        step = dp.stepper("rodas5p", rate, 5.0, tolerance=tolerance)
        assert abs(step((1.0, 0.0), stiffness)[0] - np.cos(5.0)) <= tolerance
        assert len(step.taken) < 110
    errors = []
    for count in (10, 20):
        step = dp.stepper("rodas5p", rate, 1.0 / count)
        errors.append(abs(dp.rollout(step, (1.0, 0.0), stiffness, count)[0] - np.cos(1.0)))
    assert errors[0] <= 5e-6 / stiffness
    assert errors[1] < 1e-14 or np.log2(errors[0] / errors[1]) >= 2.9


def test_stiff_components_decay():
    """The stability function is 0 at infinity, and less than 1 on the imaginary axis."""
    assert abs(dp.stepper("rodas5p", lambda u, p: -p * u, 1.0)(np.ones(1), 1e12)[0]) < 1e-10
    for frequency in (1e-1, 1.0, 1e1, 1e3):
        turn = dp.stepper("rodas5p", lambda u, p: anp.array([p * u[1], -p * u[0]]), 1.0)
        assert np.linalg.norm(turn(np.array([1.0, 0.0]), frequency)) <= 1.0 + 1e-12


@pytest.mark.whole
def test_published_values():
    """Robertson at 40 s (Hairer and Wanner) and at 1e11 s (IVP test set): rate constants over nine decades."""
    step = dp.stepper("rodas5p", robertson, 40.0, tolerance=1e-6, floor=SMALL["Robertson"])
    assert step(np.array([1.0, 0, 0]), RATES) == pytest.approx([0.7158, 9.185e-6, 0.2841], rel=1e-3)
    late = dp.stepper("rodas5p", robertson, 1e11, tolerance=1e-4, floor=np.array([1e-8, 1e-13, 1.0]))
    end = late(np.array([1.0, 0, 0]), RATES)
    assert end == pytest.approx([0.2083340149701255e-7, 0.8333360770334713e-13, 0.9999999791665050], rel=1e-4)


@pytest.mark.whole
@pytest.mark.parametrize(
    ("name", "tolerance"),
    [("van der Pol, 1000", 1e-3), ("van der Pol, 100", 1e-5), ("Robertson", 1e-3), ("HIRES", 1e-5)],
)
def test_stiff_problems_with_their_gradients(name, tolerance):
    rate, _, start, params, end, number = SCENES[name]
    state, slopes = map(np.array, KNOWN[name])
    params = np.array(params)
    step = dp.stepper("rodas5p", rate, end, tolerance=tolerance, floor=SMALL.get(name))
    new = step(np.array(start), params)
    value, g = dp.value_and_grad(lambda p: step(np.array(start), p)[number])(params)
    assert value == new[number]
    assert np.linalg.norm(g * params - slopes) <= 6 * tolerance**0.8 * np.linalg.norm(slopes)
    assert np.max(np.abs(new - state)) <= 10 * tolerance * np.max(np.abs(state))


# ---- derivatives ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tolerance", [None, pytest.param(1e-4, marks=pytest.mark.whole)])
def test_the_backward_pass_is_the_transpose(tolerance):
    """Of a tree with time: in state, params, length and time, against forward mode and differences."""
    loss = lambda x: angle(x, tolerance=tolerance)
    slopes = dp.grad(loss)(X)
    forward = np.array([dp.jvp(loss, X, e)[1] for e in np.eye(4)])
    assert slopes == pytest.approx(forward, rel=1e-12)
    if tolerance is None:
        differences = [(loss(X + 1e-5 * e) - loss(X - 1e-5 * e)) / 2e-5 for e in np.eye(4)]
        assert slopes == pytest.approx(differences, rel=1e-8)


@pytest.mark.whole
def test_second_derivatives_in_everything():
    loss = lambda x: angle(x, 2)
    tangent = np.array([0.3, 0.5, -0.2, 0.1])
    slopes = dp.grad(loss)
    wanted = (slopes(X + 1e-4 * tangent) - slopes(X - 1e-4 * tangent)) / 2e-4
    assert dp.hvp(loss, X, tangent) == pytest.approx(wanted, rel=1e-6)


def test_one_jacobian_for_each_step(monkeypatch):
    """The backward pass uses the factors of the forward pass, and new ones if they are too large to be kept."""
    count = 0
    evaluate = Jacobians.evaluate

    def counted(*args):
        nonlocal count
        count += 1
        return evaluate(*args)

    monkeypatch.setattr(Jacobians, "evaluate", counted)
    step = dp.stepper("rodas5p", robertson, 1e-3, tolerance=1e-3, floor=SMALL["Robertson"])
    loss = lambda p: step(np.array([1.0, 0, 0]), p)[1]
    loss(RATES)
    trials = count
    dp.grad(loss)(RATES)
    assert len(step.taken) <= trials <= 1.5 * len(step.taken)
    assert count == 2 * trials
    monkeypatch.setattr(rosenbrock, "KEPT_BYTES", 0)
    dp.grad(loss)(RATES)
    assert count == 3 * trials + len(step.taken) - 2


# ---- fields on grids ------------------------------------------------------------------------------------------------

GRID = dp.Grid((9, 8), size=1.0)
L = dp.laplacian(GRID, dp.neumann)


def brusselator(s, p):
    """Return the rates of Prigogine and Lefever's reactions with diffusion."""
    reaction = s["u"] ** 2 * s["v"]
    return {
        "u": p["a"] - (p["b"] + 1) * s["u"] + reaction + p["D"] * L(s["u"]),
        "v": p["b"] * s["u"] - reaction + p["D"] * L(s["v"]),
    }


WAVE = np.cos(np.pi * GRID.centres()[0]) * np.ones(GRID.shape)
START = {"u": 1.0 + 0.5 * WAVE, "v": 3.0 - WAVE}
PARAMS = {"a": 1.0, "b": 3.0, "D": 0.05}


def jacobian(s, p):
    """Return the Jacobian of the rates above, as a matrix of the unknowns u, v."""
    u = s["u"].ravel()
    product = 2 * u * s["v"].ravel()
    diffusion = p["D"] * L.matrix
    of_u = sp.vstack([sp.diags_array(product - p["b"] - 1) + diffusion, sp.diags_array(p["b"] - product)])
    of_v = sp.vstack([sp.diags_array(u**2), diffusion - sp.diags_array(u**2)])
    return sp.hstack([of_u, of_v])


def mean_square(s):
    return anp.mean(s["u"] ** 2)


@pytest.mark.whole
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"jacobian": jacobian},
        {"sparsity": jacobian(START, PARAMS)},
        {"solver": "krylov"},
    ],
)
def test_reactions_on_a_grid(options):
    """Value and gradient, with the Jacobian found, given, on a given pattern, and by products."""
    step = dp.stepper("rodas5p", brusselator, 1.0, tolerance=1e-2, **options)
    loss = lambda p: mean_square(step(START, p))
    value, slopes = dp.value_and_grad(loss)(PARAMS)
    tangent = {"a": 0.3, "b": -0.2, "D": 0.1}
    forward = dp.jvp(loss, PARAMS, tangent)[1]
    assert sum(slopes[name] * tangent[name] for name in PARAMS) == pytest.approx(forward, rel=1e-8)
    assert (value, slopes["b"]) == pytest.approx(EXACT, rel=1e-2)


def by_scipy(b):
    """Return the mean square of u by SciPy's Radau."""
    shapes = lambda z: {"u": z[: L.shape[0]].reshape(GRID.shape), "v": z[L.shape[0] :].reshape(GRID.shape)}
    flat = lambda s: np.concatenate([s["u"].ravel(), s["v"].ravel()])
    params = {**PARAMS, "b": b}
    rate = lambda t, z: flat(brusselator(shapes(z), params))
    exact = lambda t, z: jacobian(shapes(z), params).tocsc()
    run = solve_ivp(rate, (0, 1), flat(START), "Radau", jac=exact, rtol=1e-10, atol=1e-11, t_eval=[1])
    return float(mean_square(shapes(run.y[:, -1])))


EXACT = (0.758698859, -1.944537073)  # (by_scipy(3.0), (by_scipy(3.001) - by_scipy(2.999)) / 0.002)


@pytest.mark.whole
def test_the_reference_of_reactions_on_a_grid():
    assert EXACT == pytest.approx((by_scipy(3.0), (by_scipy(3.001) - by_scipy(2.999)) / 0.002), rel=1e-6)


@pytest.mark.whole
def test_single_precision_and_one_cell():
    """The state is rounded at the end of each interval, and the stages are computed in double precision."""
    step = dp.stepper("rodas5p", lambda u, p: -p * u**2, 1.0, tolerance=1e-5)
    new = step(np.ones(1, np.float32), 1.0)
    assert new.dtype == np.float32 and new[0] == pytest.approx(0.5, rel=1e-5)
    slope = dp.grad(lambda u: step(u, 1.0)[0])(np.ones(1, np.float32))
    assert slope.dtype == np.float32 and slope[0] == pytest.approx(0.25, rel=1e-4)
    fine = dp.stepper("rodas5p", lambda u, p: -p * u**2, 1.0, tolerance=1e-12)
    assert fine(1.0, 1.0) == pytest.approx(0.5, abs=1e-12)


@pytest.mark.parametrize("method", ["radau", "rodas5p"])
def test_floors_of_a_tree_after_a_rejected_step(method):
    """A step that was rejected compared the tree of floors with the flat state."""
    names = "abc"
    tree = lambda u: dict(zip(names, u, strict=True))
    rate = lambda s, p: tree(robertson([s[name] for name in names], p))
    floors = tree(SMALL["Robertson"])
    one = dp.stepper(method, rate, 1e-3, tolerance=1e-3, floor=floors)
    other = dp.stepper(method, robertson, 1e-3, tolerance=1e-3, floor=SMALL["Robertson"])
    end = one(tree(np.array([1.0, 0, 0])), RATES)
    assert np.array([end[name] for name in names]) == pytest.approx(other(np.array([1.0, 0, 0]), RATES), rel=1e-12)


@pytest.mark.whole
def test_other_jacobians_are_refused():
    wrong = dp.stepper("rodas5p", brusselator, 0.1, jacobian=lambda s, p: sp.eye_array(2 * L.shape[0]))
    with pytest.raises(DerivativeError, match=r"the jacobian given for stepper\(rodas5p\) differs from the derivative"):
        wrong(START, PARAMS)
    narrow = dp.stepper("rodas5p", brusselator, 0.1, sparsity=sp.eye_array(2 * L.shape[0]))
    with pytest.raises(DerivativeError, match=r"the sparsity given for stepper\(rodas5p\) lacks entries in row"):
        narrow(START, PARAMS)


@pytest.mark.parametrize("distance", [1e-15, 1e-12, -1e-8, 1e-4, -5e-3])
def test_a_step_with_a_nearly_singular_matrix_is_refused(distance):
    """Its growth has a pole of order 7 where g h J has the eigenvalue 1: 1e84 at a distance of 1e-12."""
    rates = np.array([-1.0, (1 + distance) / rosenbrock.GAMMA])
    step = dp.stepper("rodas5p", lambda u, p: p * u, 1.0)
    with pytest.raises(dp.errors.ConvergenceError, match="the matrix of a step is singular or nearly so"):
        step(np.ones(2), rates)
    exact = np.exp(rates)
    assert dp.stepper("rodas5p", lambda u, p: p * u, 1.0, tolerance=1e-6)(np.ones(2), rates) == pytest.approx(
        exact, rel=1e-4
    )


def test_stiff_decay_and_equilibria_are_not_refused():
    step = dp.stepper("rodas5p", lambda u, p: p * u, 1.0)
    assert step(np.ones(3), np.array([-1.0, -1e12, 0.5])) == pytest.approx(np.exp([-1.0, -np.inf, 0.5]), abs=1e-3)
    assert np.all(step(np.zeros(2), np.array([-1.0, 1.0])) == 0)
    shear = np.array([[-1.0, 1e8], [0.0, -1.0]])
    linear = dp.stepper("rodas5p", lambda u, p: p @ u, 1.0)
    assert linear(np.array([0.0, 1.0]), shear) == pytest.approx(np.exp(-1.0) * np.array([1e8, 1.0]), rel=1e-3)
