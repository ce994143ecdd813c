"""leapfrog and sponge: orders, energy, the backward pass, damping, echoes, derivatives, refusals."""

import tracemalloc

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp


def strings(n, dt, damping=None, periodic=True, **options):
    """Waves p' = -c^2 div v, v' = -grad p on a line; params: c."""
    grid = dp.Grid(n, size=1.0, periodic=periodic)
    D = dp.divergence(grid)
    G = dp.gradient(grid)
    inside = dp.interior(grid)
    rates = (lambda v, c: -(c**2) * D(v)), (lambda p, c: -inside(G(p)))
    return grid, dp.stepper("leapfrog", rates, dt, damping=damping, **options)


def standing(grid, time, dt):
    """p = cos(2 pi c t) cos(2 pi x) with c = 1; v half a step before."""
    (x,), (y,) = grid.centres(), grid.face_centres(0)
    wave = 2 * np.pi
    return np.cos(wave * time) * np.cos(wave * x), np.sin(wave * (time - dt / 2)) * np.sin(wave * y)


def test_order_two():
    errors = []
    for n in (20, 40, 80):
        dt = 0.5 / n
        grid, step = strings(n, dt)
        p, v = dp.rollout(step, standing(grid, 0.0, dt), 1.0, n)
        right = standing(grid, 0.5, dt)
        errors.append(max(np.max(np.abs(p - right[0])), np.max(np.abs(v - right[1]))))
    rates = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all(np.abs(rates - 2) < 0.1)


@pytest.mark.filterwarnings("ignore:overflow")
def test_exact_at_the_limit():
    """With c dt = h the scheme follows the waves exactly (Courant, Friedrichs, Lewy, 1928); beyond it blows up."""
    grid, step = strings(20, 0.05)
    start = standing(grid, 0.0, 0.05)
    p, v = dp.rollout(step, start, 1.0, 20)
    np.testing.assert_allclose(p, start[0], atol=1e-13)
    np.testing.assert_allclose(v, start[1], atol=1e-13)
    _, step = strings(20, 0.05, unstable="allow")
    with pytest.raises(
        dp.errors.NonFiniteError, match="NaN or infinity from a finite state with dt = 0.05; take smaller steps"
    ):
        dp.rollout(step, start, 1.5, 2000)


@pytest.mark.parametrize("damping", [None, (3.0, 3.0)])
def test_steps_beyond_the_limit_are_refused(damping):
    """h w <= 2, w = 2 c n, with damping too: at once, for each content of the params and whatever is traced."""
    grid, step = strings(20, 0.05, damping)
    start = standing(grid, 0.0, 0.05)
    with pytest.raises(
        dp.errors.UnstableStepError,
        match="leapfrog is unstable with dt = 0.05: waves of frequency 40.4 grow; dt = 0.0485148 is safe, or write "
        "unstable='allow'",
    ):
        step(start, 1.01)
    step(start, 1.0)
    with pytest.raises(dp.errors.UnstableStepError, match="waves of frequency 60 grow"):
        dp.value_and_grad(lambda c: anp.sum(dp.rollout(step, start, c, 3)[0] ** 2))(1.5)
    _, step = strings(20, lambda c: 0.1 / c, damping)
    with pytest.raises(dp.errors.UnstableStepError, match="dt = 0.1: waves"):
        step(start, 1.0)


@pytest.mark.parametrize("shape", [(2,), (9, 8), (5, 4, 6)])
def test_the_limit_of_a_box(shape):
    """Against the eigenvalues, where the waves have different speeds."""
    grid = dp.Grid(shape)
    D = dp.divergence(grid)
    G = dp.gradient(grid)
    inside = dp.interior(grid)
    c = np.where(np.arange(grid.cells.size).reshape(shape) % 2, 1.0, 3.0)
    w = np.max(np.linalg.eigvals(c.reshape(-1, 1) ** 2 * (-D @ inside @ G).matrix.toarray()).real) ** 0.5
    state = np.zeros(shape), np.zeros(grid.faces.size)
    rates = (lambda v, c: -(c[0] ** 2) * D(v)), (lambda p, c: -inside(G(p)))
    step = dp.stepper("leapfrog", rates, lambda c: c[1] * 2 / w)
    step(state, (c, 1.0))
    with pytest.raises(dp.errors.UnstableStepError):
        step(state, (c, 1.03))


def test_the_estimate_is_made_once_and_inputs_do_not_count():
    calls = []
    g = lambda p, c: (calls.append(1), -c[0] * p)[1]
    step = dp.stepper("leapfrog", (lambda q, c: q + c[1], g), 0.1)
    dp.rollout(step, (np.ones(3), np.zeros(3)), 2.0, 4, inputs=np.arange(4.0))
    most = len(calls)
    dp.rollout(step, (np.ones(3), np.zeros(3)), 2.0, 4, inputs=np.arange(4.0))
    assert len(calls) - most == 4 < most


@pytest.mark.whole
def test_nothing_is_lost_in_ten_thousand_steps():
    grid, step = strings(32, 0.02)
    rng = np.random.default_rng(0)
    state = rng.standard_normal(32), rng.standard_normal(32)
    energy = lambda state: sum(float(np.sum(x**2)) for x in state)
    p, v = dp.rollout(step, state, 1.0, 10_000)
    drift = [energy(step(s, 1.0)) for s in (state, (p, v))]
    assert 0.5 < drift[1] / drift[0] < 2  # a second-order shadow of it is conserved, it swings around that
    shadow = lambda p, v: np.sum(p**2) + np.sum(v * step((p, v), 1.0)[1])
    assert shadow(p, v) == pytest.approx(shadow(*state), rel=1e-9)


def test_a_reversed_step():
    grid, step = strings(12, 0.03)
    rng = np.random.default_rng(0)
    state = rng.standard_normal(12), rng.standard_normal(12)
    new = step(state, 1.2)
    for one, other in zip(step.back(new, 1.2), state, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-14)
    with pytest.raises(ValueError, match="leapfrog step with damping cannot be reversed"):
        strings(12, 0.03, (1.0, 1.0))[1].back(new, 1.2)
    with pytest.raises(ValueError, match=r"stepper\(rk4\) cannot be reversed; write 'leapfrog'"):
        dp.stepper("rk4", lambda u, c: u, 0.1).back(1.0, None)


def test_damping_is_stable_at_any_rate():
    """Uniform damping: both fields die out as exp(-s t), and at huge rates they never grow."""
    grid, step = strings(40, 0.0025, (0.5, 0.5))
    p, _ = dp.rollout(step, standing(grid, 0.0, 0.0025), 1.0, 400)
    exact = np.exp(-0.5) * standing(grid, 1.0, 0.0025)[0]
    assert np.max(np.abs(p - exact)) < 2e-3
    grid, step = strings(40, 0.02, (1e6, 1e6))
    start = standing(grid, 0.0, 0.02)
    assert np.max(np.abs(dp.rollout(step, start, 1.0, 50)[0])) < 1.001


def test_trees_and_inputs():
    """The fields may be trees; what enters from step to step is an input."""
    rates = (lambda q, c: {"a": q["b"], "c": 0 * q["b"] + c[1]}), (lambda p, c: {"b": -c[0] * p["a"]})
    step = dp.stepper("leapfrog", rates, 0.1, damping=({"a": 0.0, "c": 0.0}, {"b": 0.0}))
    state = {"a": 1.0, "c": 0.0}, {"b": 0.0}
    p, q = dp.rollout(step, state, 2.0, 3, inputs=np.array([1.0, 2.0, 3.0]))
    assert p["c"] == pytest.approx(0.6)
    assert (
        dp.check.gradient(lambda c: dp.rollout(step, state, c, 3, inputs=np.ones(3))[0]["a"], 2.0, quick=True).verdict
        == "agrees"
    )


@pytest.mark.parametrize("damped", [False, True])
def test_derivatives(damped):
    """Against a loop in autograd.numpy, in state and params, to second order."""
    n = 8
    dt = 0.05
    rng = np.random.default_rng(1)
    sigma = 3 * rng.random(n) * damped, 3 * rng.random(n) * damped
    grid, step = strings(n, dt, sigma if damped else None)
    state = (rng.standard_normal(n), rng.standard_normal(n))
    weights = rng.standard_normal(n)

    def twin(p, v, c):
        for _ in range(5):
            new = v - dt * (p - anp.roll(p, 1)) * n
            v = (new - 0.5 * dt * sigma[1] * v) / (1 + 0.5 * dt * sigma[1])
            new = p - dt * c**2 * (anp.roll(v, -1) - v) * n
            p = (new - 0.5 * dt * sigma[0] * p) / (1 + 0.5 * dt * sigma[0])
        return anp.sum(weights * p**2)

    ours = lambda x: anp.sum(weights * dp.rollout(step, x[:2], x[2], 5)[0] ** 2)
    other = lambda x: twin(*x)
    x = (*state, np.array(1.3))
    t = (weights, weights[::-1].copy(), np.array(0.3))
    assert ours(x) == pytest.approx(other(x), rel=1e-13)
    for one, two in ((dp.grad(ours)(x), dp.grad(other)(x)), (dp.hvp(ours, x, t), dp.hvp(other, x, t))):
        for a, b in zip(one, two, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12)


def pulse(cells, deep, steps):
    """A round pulse in a box of `cells` and a sponge around; the pressure in the box at the end."""
    n = cells + 2 * deep
    grid = dp.Grid((n, n))
    D = dp.divergence(grid)
    G = dp.gradient(grid)
    inside = dp.interior(grid)
    rates = (lambda v, _: -D(v)), (lambda p, _: -inside(G(p)))
    x, y = (c - n / 2 for c in grid.centres())
    square = (x**2 + y**2) / 18
    step = dp.stepper("leapfrog", rates, 0.5, damping=dp.sponge(grid, deep, 1.0) if deep < 60 else None)
    return dp.rollout(step, ((1 - square) * np.exp(-square), np.zeros(grid.faces.size)), None, steps)[0][
        deep : n - deep, deep : n - deep
    ]


@pytest.mark.parametrize(("deep", "most"), [(20, 6e-4), (30, 2e-4)])
def test_echo_of_a_sponge(deep, most):
    """Against a box so large that nothing comes back (wavelength about 13 cells; the pulse is 1 high)."""
    assert np.max(np.abs(pulse(30, deep, 120) - pulse(30, 65, 120))) < most


def test_sponge_on_some_sides():
    grid = dp.Grid((8, 6), size=(4.0, 3.0), origin=(1.0, 0.0), periodic=(False, True))
    inside, between = dp.sponge(grid, {"x": (0, 3)}, 2.0, echo=0.01)
    assert inside.shape == (8, 6) and between.shape == (grid.faces.size,)
    assert np.all(inside[:5] == 0) and np.all(inside[5:] > 0)
    depth = (np.array([0.25, 0.75, 1.25]) / 1.5) ** 2 / 1.5
    np.testing.assert_allclose(inside[5:, 0], 1.5 * 2.0 * np.log(100) * depth)
    assert not np.any(dp.sponge(grid, 0, 1.0)[0])
    everywhere = dp.sponge(dp.Grid((5, 4)), 2, 1.0)[0]
    np.testing.assert_allclose(everywhere, everywhere[::-1, ::-1])


def test_refusals():
    rates = (lambda v, c: v), (lambda p, c: p)
    with pytest.raises(TypeError, match="the rates of leapfrog must be a pair, got function; write"):
        dp.stepper("leapfrog", rates[0], 0.1)
    with pytest.raises(TypeError, match="a rate of leapfrog takes a function, got float; write lambda field"):
        dp.stepper("leapfrog", (rates[0], 1.0), 0.1)
    with pytest.raises(TypeError, match="leapfrog does not use linear; leave it out"):
        dp.stepper("leapfrog", rates, 0.1, linear=dp.laplacian(dp.Grid(3)))
    with pytest.raises(TypeError, match="rk4 does not use damping; leave it out"):
        dp.stepper("rk4", rates[0], 0.1, damping=(1.0, 1.0))
    with pytest.raises(TypeError, match="damping, for both fields of the state, must be a pair, got float"):
        dp.stepper("leapfrog", rates, 0.1, damping=1.0)
    with pytest.raises(ValueError, match=r"damping needs finite rates >= 0 \[1 / time\]; take dp.sponge"):
        dp.stepper("leapfrog", rates, 0.1, damping=(-1.0, 0.0))
    step = dp.stepper("leapfrog", rates, 0.1, damping=((1.0, 2.0), None))
    with pytest.raises(TypeError, match=r"the state of leapfrog must be a pair, got ndarray; write \(p, v\)"):
        step(np.ones(3))
    with pytest.raises(
        dp.errors.ShapeError, match=r"damping\[0\]: expected one array or number, got a tuple of length 2"
    ):
        step((np.ones(3), np.ones(3)))
    step = dp.stepper("leapfrog", (rates[0], lambda p, c: (p, p)), 0.1, damping=(None, 1.0))
    with pytest.raises(dp.errors.ShapeError, match="rate: expected one array or number, got a tuple of length 2"):
        step((np.ones(3), np.ones(3)))
    with pytest.raises(ValueError, match="sponge on x needs a whole number of cells from 0 to 4, got 5"):
        dp.sponge(dp.Grid(4), 5, 1.0)
    with pytest.raises(ValueError, match="speed of sponge must be > 0, got 0; give the speed of the fastest waves"):
        dp.sponge(dp.Grid(4), 2, 0)


# ---- a rollout that runs its steps backward ----


@pytest.mark.parametrize("keep", ["last", "each"])
def test_reversed_steps_give_the_gradient(keep):
    """To 1e-10 of that with all states kept, in state, params and inputs; second order too."""
    rng = np.random.default_rng(2)
    grid = dp.Grid(24, size=1.0, periodic=True)
    D = dp.divergence(grid)
    G = dp.gradient(grid)
    rates = (lambda v, given: -(given[0] ** 2) * D(v) + given[1]), (lambda p, given: -G(p))
    step = dp.stepper("leapfrog", rates, 0.01)
    weights = rng.standard_normal(24)

    def loss(x, memory):
        given = dict(inputs=x["beat"], memory=memory)
        if keep == "each":
            told = dp.rollout(step, x["state"], x["c"], 40, keep=lambda i, state: anp.sum(weights * state[0]), **given)
            return sum(one**2 for one in told)
        return anp.sum(weights * dp.rollout(step, x["state"], x["c"], 40, **given)[0] ** 2)

    x = {"state": (rng.standard_normal(24), rng.standard_normal(24)), "c": 1 + rng.random(24), "beat": rng.random(40)}
    for act in (lambda f: dp.grad(f)(x), lambda f: dp.hvp(f, x, x)):
        kept, turned = (act(lambda x, memory=memory: loss(x, memory)) for memory in (None, "reverse"))
        pairs = [(kept["c"], turned["c"]), (kept["beat"], turned["beat"]), *zip(kept["state"], turned["state"])]
        for one, other in pairs:
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-10 * np.max(np.abs(one)))


def test_reversed_steps_keep_one_state():
    """Ten times the steps take no more memory."""
    grid, step = strings(20_000, 2e-5)
    state = np.sin(6 * grid.centres()[0]), np.zeros(20_000)
    peaks = []
    for n in (10, 100):
        tracemalloc.start()
        dp.grad(lambda c, n=n: anp.sum(dp.rollout(step, state, c, n, memory="reverse")[0] ** 2))(1.0)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.05 * peaks[0] + 100 * 1000


def test_reversed_steps_refuse():
    state = np.ones(12), np.ones(12)
    with pytest.raises(ValueError, match="leapfrog step with damping cannot be reversed"):
        dp.rollout(strings(12, 0.03, (1.0, 1.0))[1], state, 1.0, 3, memory="reverse")
    with pytest.raises(ValueError, match=r"stepper\(rk4\) cannot be reversed; write 'leapfrog'"):
        dp.rollout(dp.stepper("rk4", lambda u, c: u, 0.1), 1.0, None, 3, memory="reverse")
    message = (
        r"memory='reverse' needs a step with step.back\(state, params\), got .*; write memory='200 MB', or take a step "
    )
    with pytest.raises(ValueError, match=message):
        dp.rollout(lambda u, c: u, 1.0, None, 3, memory="reverse")


def test_reversed_steps_that_miss_the_first_state_are_refused():
    class Wrong:
        def __call__(self, u, c):
            return c * u

        def back(self, u, c):
            return u / c + 1e-3

    with pytest.raises(dp.errors.DerivativeError, match="reversed steps end 3.0e-03 away from the first state, beside"):
        dp.grad(lambda c: dp.rollout(Wrong(), 1.0, c, 3, memory="reverse"))(1.0)


@pytest.mark.parametrize("error", [0.0, pytest.param(1e-3, marks=pytest.mark.whole)])
def test_reversed_steps_in_single_precision(error):
    """Rounding of float32 is allowed for, and the gradient has its digits; a wrong reverse step is refused."""
    grid = dp.Grid(24, size=1.0)
    D = dp.divergence(grid)
    G = dp.gradient(grid, dp.dirichlet)
    leapfrog = dp.stepper("leapfrog", (lambda v, c: -c * D(v), lambda p, c: -G(anp.sin(p))), 0.01)

    class Step:
        def __call__(self, state, c):
            return leapfrog(state, c)

        def back(self, state, c):
            p, v = leapfrog.back(state, c)
            return p + np.float32(error), v

    def loss(u, memory, kind):
        state = u, np.zeros(grid.faces.size, kind)
        return anp.sum(dp.rollout(Step(), state, kind(1.0), 300, memory=memory)[0] ** 2)

    u = np.exp(-50 * (grid.centres()[0] - 0.5) ** 2)
    single = lambda u: loss(u, "reverse", np.float32)
    if error:
        with pytest.raises(dp.errors.DerivativeError, match="away from the first state, beside states of size"):
            dp.grad(single)(u.astype(np.float32))
        return
    found = dp.grad(single)(u.astype(np.float32))
    right = dp.grad(lambda u: loss(u, None, np.float64))(u)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, right, rtol=0, atol=1e-4 * np.max(np.abs(right)))


class Lossy:
    """Steps whose reverse is wrong in a small field beside a large one."""

    def __call__(self, state, c):
        large, small = state
        return large, small + 0.1 * c

    def back(self, state, c):
        large, small = state
        return large, small - 0.1 * c + 0.01


def test_a_large_field_hides_no_error_of_a_small_one():
    loss = lambda c: dp.rollout(Lossy(), (1e9, 1.0), c, 3, memory="reverse")[1] ** 2
    with pytest.raises(dp.errors.DerivativeError, match="end 3.0e-02 away from the first state, beside states of size"):
        dp.grad(loss)(1.0)


@pytest.mark.parametrize("cells", [{"z": (2, 2)}, {"x": (2,)}, {"x": (1, 1, 1)}, {0: (2, 2)}])
def test_a_sponge_on_no_axis_is_refused(cells):
    with pytest.raises(ValueError, match=r"sponge needs a number of cells or a pair for axes of \['x', 'y'\], got"):
        dp.sponge(dp.Grid((5, 4)), cells, 1.0)


def test_damped_rates_go_to_the_fields_of_their_names():
    """In another order they went to the wrong fields where there is damping."""
    x = {"a": np.array([1.0]), "b": np.array([2.0])}, np.array([1.0])
    rates = [lambda q, c: {"a": 3.0 * q, "b": 5.0 * q}, lambda q, c: {"b": 5.0 * q, "a": 3.0 * q}]
    damping = ({"b": 0.5, "a": 0.25}, None)
    steps = [dp.stepper("leapfrog", (f, lambda p, c: 0.0 * p["a"]), 0.1, damping=damping) for f in rates]
    for step in steps:
        (p, _), s = step(x), {"a": 0.0125, "b": 0.025}
        wanted = {"a": ((1 - s["a"]) + 0.3) / (1 + s["a"]), "b": (2 * (1 - s["b"]) + 0.5) / (1 + s["b"])}
        assert all(p[name] == pytest.approx(wanted[name], rel=1e-14) for name in "ab")


def test_damping_of_other_names_is_refused():
    x = {"a": np.array([1.0]), "b": np.array([2.0])}, np.array([1.0])
    rates = lambda q, c: {"a": 3.0 * q, "b": 5.0 * q}, lambda p, c: 0.0 * p["a"]
    step = dp.stepper("leapfrog", rates, 0.1, damping=({"b": 0.0, "c": 9.0}, None))
    with pytest.raises(dp.errors.ShapeError, match=r"damping\[0\]: unknown key 'c'; expected 'a', 'b'"):
        step(x)


@pytest.mark.parametrize("n", [0, 1, 20, 40])
def test_frequencies_of_every_kind(n):
    """None at all, one alone, many, growth without a wave, and no finite slope at the state."""
    c = np.linspace(1.0, 30.0, n)
    ones = (np.ones(n), np.ones(n))
    rates = [
        (lambda q, p: 0.0 * q, lambda p, c: 0.0 * p),
        (lambda q, p: -30.0 * q, lambda p, c: 30.0 * p),
        (lambda q, p: -c * q, lambda p, _: c * p),
        (lambda q, p: c * q, lambda p, _: c * p),
        (lambda q, p: -anp.sqrt(anp.abs(q - 1.0)), lambda p, c: 0.0 * p),
    ]
    for number, pair in enumerate(rates):
        step = dp.stepper("leapfrog", pair, 0.1)
        if number in (1, 2) and n > 1 or (number, n) == (1, 1):
            with pytest.raises(dp.errors.UnstableStepError, match="leapfrog is unstable with dt = 0.1: waves of freq"):
                step(ones, 1.0)
        else:
            with np.errstate(all="ignore"):
                step(ones, 1.0)
