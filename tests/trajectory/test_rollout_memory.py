"""rollout under a budget: bits, counts and bytes; steps with a derivative of their own."""

import tracemalloc

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp.autodiff.tape import Rule
from sparsedp.errors import BudgetWarning
from sparsedp.trajectory.checkpoint_plan import advances, budget_within_reach, slots_within, stride


def shift(wrong=None):
    """A donor-cell step with a derivative of its own: u_i + c_i (u_(i-1) - u_i), periodic."""

    def forward(u, c):
        out = np.empty_like(u)
        np.subtract(u[:-1], u[1:], out=out[1:])
        np.subtract(u[-1:], u[:1], out=out[:1])
        out *= c
        out += u
        return out

    def vjp(nums, ans, u, c):
        def pull(g):
            moved = g * c
            back = g - moved
            back[:-1] += moved[1:]
            back[-1] += moved[0]
            into = np.empty_like(c) if 1 in nums else None
            if into is not None:
                into[1:] = g[1:] * (u[:-1] - u[1:])
                into[0] = g[0] * (u[-1] - u[0])
            cotangents = (g if wrong == "identity" else back), into
            return tuple(cotangents[num] for num in nums)

        return pull

    return dp.differentiable("shift", forward, vjp)


def plain(u, c):
    """The same as a user of autograd writes it."""
    return u + c * (anp.roll(u, 1, 0) - u)


RULE = shift()
KINDS = pytest.mark.parametrize("step", [RULE, plain], ids=["rule", "formula"])


N = 40
CELLS = 12
U0 = np.sin(np.arange(CELLS))
C0 = 0.4 + 0.2 * np.cos(np.arange(CELLS))
WEIGHTS = np.cos(np.arange(CELLS * (N + 1.0))).reshape(N + 1, CELLS)
BUDGETS = [CELLS * 8 * k for k in (7, 8, 9, 11, 17, 46)]


def loss(step, x, keep="last", n=N, **options):
    out = dp.rollout(step, *x, n, keep=keep, **options)
    if keep == "last":
        return anp.sum(WEIGHTS[0] * out**2)
    if keep == "all":
        return anp.sum(WEIGHTS * out**2)
    return sum(out)


@pytest.mark.parametrize("keep", ["last", "all", lambda i, u: anp.sum(WEIGHTS[i] * u**3)], ids=["last", "all", "each"])
@pytest.mark.parametrize("memory", [None, *BUDGETS])
def test_a_rule_gives_the_gradient_of_the_formula(keep, memory):
    x = (U0, C0)
    value, slope = dp.value_and_grad(lambda x: loss(RULE, x, keep, memory=memory))(x)
    same, exact = dp.value_and_grad(lambda x: loss(plain, x, keep))(x)
    assert abs(value - same) < 1e-13
    assert max(np.max(np.abs(a - b)) for a, b in zip(slope, exact)) < 1e-13
    _, again = dp.value_and_grad(lambda x: loss(RULE, x, keep))(x)
    assert all(a.tobytes() == b.tobytes() for a, b in zip(slope, again))


@pytest.mark.whole
def test_a_wrong_rule_is_caught_by_the_check():
    assert dp.check.gradient(lambda x: loss(RULE, x), (U0, C0), quick=True).verdict == "agrees"
    assert dp.check.gradient(lambda x: loss(shift("identity"), x), (U0, C0)).verdict == "disagrees"


def test_an_input_is_never_overwritten():
    u = U0.copy()
    c = C0.copy()
    end = dp.rollout(RULE, u, c, 5)
    assert np.array_equal(u, U0) and np.array_equal(c, C0)
    kept = end.copy()
    dp.rollout(RULE, u, c, 9)
    assert np.array_equal(end, kept)


# ---------------------------------------------------------------- the schedule


def test_binomial_schedule_is_optimal():
    known: dict = {}

    def best(n, s):
        if n <= 1 or s == 1:
            return n * (n - 1) // 2
        if (n, s) not in known:
            known[n, s] = min(m + best(n - m, s - 1) + best(m, s) for m in range(1, n))
        return known[n, s]

    def ours(n, s):
        if n <= 1 or s == 1:
            return n * (n - 1) // 2
        m = stride(n, s)
        return m + ours(n - m, s - 1) + ours(m, s)

    assert all(best(n, s) == advances(n, s) == ours(n, s) for n in range(60) for s in range(1, 8))


@KINDS
@pytest.mark.parametrize("slots", [1, 2, 3, 5, 11, 60])
@pytest.mark.parametrize("n", [1, 2, 7, N])
def test_steps_are_run_again_as_rarely_as_possible(step, slots, n):
    runs: list = []
    memory = CELLS * 8 * (slots + 6)
    with recording() as calls:
        dp.value_and_grad(lambda x: loss(step, x, n=n, memory=memory, record=runs.append))((U0, C0))
    kept = slots_within(memory, CELLS * 8, n, 2 * CELLS * 8)
    assert runs[-1].recomputed == advances(n, kept) - (n - 1) == calls["rollout.step", "recomputed"]
    assert runs[-1].factor == pytest.approx((advances(n, kept) + 1) / n)
    assert calls["rollout.step", "forward"] == calls["rollout.step", "vjp"] == n
    assert calls["rollout", "forward"] == calls["rollout", "vjp"] == 1


def test_many_steps_without_recursion():
    """10^5 steps of 16^2 cells, 24 states kept."""
    u = np.random.default_rng(0).random((16, 16))
    c = np.full((16, 16), 0.3)
    kept = slots_within(31 * 2048, 2048, 100_000, 2 * 2048)
    assert kept == 24 and advances(100_000, kept) < 5 * 100_000 - 1
    runs: list = []
    step = RULE  # the test itself is shorter; the benchmark runs all
    n = 2_000
    slope = dp.value_and_grad(lambda u: anp.sum(dp.rollout(step, u, c, n, memory=31 * 2048, record=runs.append)))(u)[1]
    assert np.max(np.abs(slope - 1)) < 1e-9 and runs[-1].steps == n


# ---------------------------------------------------------------- bytes


def peak(call):
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.sampled(0)
@KINDS
@pytest.mark.parametrize("keep", ["last", "all"])
def test_peak_is_the_trajectory(step, keep, monkeypatch):
    """Where tapes have no room beside it."""
    monkeypatch.setattr("sparsedp.trajectory.rollout.TAPE_BYTES", 2**22)
    u = np.random.default_rng(0).random(20_000)
    n = 100
    c = np.full(u.shape, 0.5)
    weights = np.ones(()) if keep == "last" else np.ones((n + 1, 1))

    def gradient():
        return dp.value_and_grad(lambda x: anp.sum(weights * dp.rollout(step, *x, n, keep=keep)))((u, c))

    gradient()
    used = peak(gradient) / (n * u.nbytes)
    # The loss of all states has a cotangent of the size of the trajectory, and a product on the tape.
    assert used < (1.2 if keep == "last" else 3.3)


@pytest.mark.whole
@KINDS
@pytest.mark.parametrize("states", [7, 12, *(pytest.param(states, marks=pytest.mark.whole) for states in (9, 24))])
def test_peak_under_a_budget(step, states):
    u = np.random.default_rng(0).random(20_000)
    n = 60
    c = np.full(u.shape, 0.5)
    gradient = lambda: dp.value_and_grad(lambda x: anp.sum(dp.rollout(step, *x, n, memory=states * u.nbytes)))((u, c))
    gradient()
    beside = 5 if step is RULE else 7  # what the step needs by itself
    assert peak(gradient) < (states + beside) * u.nbytes + 100_000
    plain = peak(lambda: dp.rollout(step, u, c, n, memory=states * u.nbytes))
    assert plain < 7.2 * u.nbytes  # nothing is kept without a gradient


# u times c, without a temporary array.
SCALED = Rule("scaled", lambda u, c: u * c, lambda nums, ans, u, c: lambda g: tuple(g * (c, u)[num] for num in nums))


@pytest.mark.sampled(0)
@pytest.mark.parametrize("keep", ["last", "each"])
@pytest.mark.parametrize("params", [True, False])
@pytest.mark.parametrize("states", [8, 9, 16, 80])
def test_peak_memory_of_a_step_without_other_arrays_is_the_budget(states, params, keep):
    """All of it, the result and its cotangent included; the states that are kept fill it."""
    n = 60
    rng = np.random.default_rng(0)
    size = 400_000
    u = rng.random(size // 8)
    v = rng.random(u.shape)
    weights = np.cos(u)
    for given in (u, v, weights):  # they are read-only: the tape of the loss keeps no copies beside the rollout
        given.flags.writeable = False
    step = SCALED
    runs = []

    def total(u, v):
        options = {"keep": lambda i, u: anp.sum(u[:3])} if keep == "each" else {}
        out = dp.rollout(step, u, v, n, memory=states * size, record=runs.append, **options)
        if keep == "each":
            return sum(out)
        return anp.sum(weights * out)

    gradient = lambda: dp.value_and_grad((lambda x: total(*x)) if params else lambda u: total(u, v))(
        (u, v) if params else u
    )
    gradient()
    assert runs[1].kept >= min(n, states - 5 - 2 * params - min(5, states // 16))
    entering = 2 * size * (keep == "each")  # what enters at a state, and the sum
    assert peak(gradient) < states * size + entering + 100_000


def test_a_slightly_small_budget_warns():
    """100 steps: the numbers of runs agree with the formula; the least budget is found by trials."""
    n = 100
    size = U0.nbytes
    runs = []
    tight = lambda memory: dp.value_and_grad(
        lambda u: anp.sum(dp.rollout(RULE, u, C0, n, memory=memory, record=runs.append))
    )(U0)
    with pytest.warns(
        BudgetWarning,
        match="rollout runs 100 steps 49.5 times each within memory=576, and 8.46 times with more; write memory=672",
    ):
        tight(6 * size)
    assert runs[-1].factor == 49.51
    tight(7 * size)
    assert runs[-1].factor == 8.46
    for slots in range(1, 101):
        beside = size
        memory = (slots + 5 + min(5, slots // 15)) * size
        told = budget_within_reach(memory, size, n, beside)
        runs_of = lambda memory: advances(n, slots_within(memory, size, n, beside)) + 1
        found = [more for more in range(memory, 2 * memory + 1, size) if runs_of(more) <= runs_of(memory) / 3]
        assert told == (found[0] if found else None)


def test_all_returned_states_are_the_kept_states():
    """Whatever the budget: no step is run again."""
    for step in (RULE, plain):
        runs = []
        wanted = dp.value_and_grad(lambda x: loss(step, x, "all"))((U0, C0))
        value, slopes = dp.value_and_grad(lambda x: loss(step, x, "all", memory=7 * U0.nbytes, record=runs.append))(
            (U0, C0)
        )
        assert runs[-1].recomputed == 0 and value == wanted[0]
        assert all(a.tobytes() == b.tobytes() for a, b in zip(slopes, wanted[1]))


@pytest.mark.slow
@pytest.mark.parametrize("memory", ["1 GB", "100 MB"])
def test_ten_thousand_steps_at_256(memory):
    u = np.random.default_rng(0).random((256, 256))
    c = np.full((256, 256), 0.4)

    def gradient(n, memory):
        return dp.value_and_grad(lambda x: anp.sum(dp.rollout(RULE, *x, n, memory=memory) ** 2))((u, c))

    assert peak(lambda: gradient(10_000, memory)) < (1.0 if memory == "1 GB" else 0.1) * 1e9
    short = gradient(1000, memory)
    full = gradient(1000, None)
    assert all(a.tobytes() == b.tobytes() for a, b in zip(short[1], full[1]))


@pytest.mark.slow
@pytest.mark.parametrize("memory", [None, "1 MB"])
def test_a_hundred_thousand_steps(memory):
    """16^2 cells, no recursion trouble; the wind turns once, mass stays, and the gradient of the mass says so."""
    grid = dp.Grid((16, 16), size=1.0, periodic=True)
    n = 100_000
    move = dp.transport(grid, velocity="cells")
    x = grid.centres()[0]
    step = lambda u, v: move(u, v, 1e-3)
    u = 1.0 + np.sin(2 * np.pi * x)
    v = np.stack([np.ones(x.shape), 0.3 * np.ones(x.shape)])
    runs = []
    loss = lambda p: anp.sum(dp.rollout(step, *p, n, memory=memory, record=runs.append))
    value, slopes = dp.value_and_grad(loss)((u, v))
    assert value == pytest.approx(256.0, rel=1e-10) and np.max(np.abs(slopes[0] - 1.0)) < 1e-10
    assert runs[-1].steps == n and np.all(np.isfinite(slopes[1]))


def test_steps_that_solve_run_once_where_no_budget_is_given():
    """Their tapes are kept longer than the tapes of other steps: here 60 of more than 130 kB each."""
    grid = dp.Grid((128, 128), size=1.0)
    step = dp.stepper("crank_nicolson", dp.laplacian(grid, dp.dirichlet), 1e-4)
    u = np.sin(3 * grid.centres()[0])
    with recording() as calls:
        dp.value_and_grad(lambda u: anp.sum(dp.rollout(step, u, None, 60) ** 2))(u)
    assert calls["stepper(crank_nicolson)", "solve"] == 60


def test_constants_of_a_step_leave_its_tapes_where_they_are():
    """The velocity, 4 MB, and the weights are the same for all steps: no tape holds more than the states do."""
    grid = dp.Grid((512, 512), periodic=True)
    move = dp.transport(grid)
    u = np.sin(grid.centres()[0])
    v = 0.1 * np.ones(grid.faces.size)
    with recording() as calls:
        dp.value_and_grad(lambda u: anp.sum(dp.rollout(lambda u, v: move(u, v, 1.0), u, v, 5) ** 2))(u)
    assert calls["transport upwind", "forward"] == 5


@pytest.mark.whole
@pytest.mark.parametrize("given", ["16 MB", None])
def test_tapes_of_large_steps_keep_to_their_room(given, monkeypatch):
    """A step that makes arrays far larger than the state, as between all pairs of bodies: few of them stay on tapes."""
    monkeypatch.setattr("sparsedp.trajectory.rollout.TAPE_BYTES", 2**24)
    x = np.random.default_rng(0).random((120, 3))
    pairs = 120**2 * 8

    def step(x, strength):
        apart = x[:, None] - x[None]
        return x - strength * anp.sum(apart / (anp.sum(apart**2, 2, keepdims=True) + 1.0) ** 1.5, 1)

    loss = lambda strength: anp.sum(dp.rollout(step, x, strength, 100, memory=given) ** 2)
    one_step = 24 * pairs  # of arrays of pairs, forward and back
    assert peak(lambda: dp.grad(loss)(1e-3)) < 2**24 + one_step
