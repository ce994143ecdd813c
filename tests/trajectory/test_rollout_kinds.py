"""rollout: every kind of state, result and derivative, each against the loop on the tape."""

import gc
import weakref

import autograd
import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils.pytree import leaves
from sparsedp.autodiff.derivative import pullback, pushforward
from sparsedp.autodiff.tape import plain
from sparsedp.errors import GrowthWarning

U = np.array([0.3, -0.5, 0.8])


def bend(u, p):
    return u + 0.1 * anp.sin(p * u) * anp.roll(u, 1)


def loop(u, p, n):
    states = [u]
    for _ in range(n):
        states.append(bend(states[-1], p))
    return states


def close(one, other, bound=1e-13):
    for a, b in zip(leaves(one), leaves(other), strict=True):
        assert np.max(np.abs(np.asarray(a) - np.asarray(b)), initial=0.0) <= bound


WEIGHTS = np.cos(np.arange(8 * 3.0)).reshape(8, 3)
KEEPS = {
    "all": (
        lambda u, p, **o: anp.sum(WEIGHTS * dp.rollout(bend, u, p, 7, keep="all", **o) ** 2),
        lambda u, p: sum(anp.sum(WEIGHTS[i] * s**2) for i, s in enumerate(loop(u, p, 7))),
    ),
    "numbers": (
        lambda u, p, **o: anp.sum(WEIGHTS[[0, 3, 6]] * dp.rollout(bend, u, p, 7, keep=[0, 3, 6], **o) ** 2),
        lambda u, p: sum(anp.sum(WEIGHTS[i] * s**2) for i, s in enumerate(loop(u, p, 7)) if i in (0, 3, 6)),
    ),
    "function": (
        lambda u, p, **o: sum(dp.rollout(bend, u, p, 7, keep=lambda i, s: anp.sum(WEIGHTS[i] * s**3), **o)),
        lambda u, p: sum(anp.sum(WEIGHTS[i] * s**3) for i, s in enumerate(loop(u, p, 7))),
    ),
    "some": (
        lambda u, p, **o: sum(
            part["mean"] + anp.sum(part["pair"][0] * part["pair"][1] ** 2)
            for part in dp.rollout(bend, u, p, 7, keep=pairs, **o)
            if part is not None
        ),
        lambda u, p: sum(anp.mean(s) + anp.sum(s[1:] * 4.0) for i, s in enumerate(loop(u, p, 7)) if i % 3 == 1),
    ),
    "last": (
        lambda u, p, **o: anp.sum(WEIGHTS[0] * dp.rollout(bend, u, p, 7, **o) ** 2),
        lambda u, p: anp.sum(WEIGHTS[0] * loop(u, p, 7)[-1] ** 2),
    ),
    "no steps": (
        lambda u, p, **o: anp.sum(WEIGHTS[0] * dp.rollout(bend, u, p, 0, **o) ** 2) + 0.0 * p,
        lambda u, p: anp.sum(WEIGHTS[0] * u**2) + 0.0 * p,
    ),
}


def pairs(i, state):
    """Something on every third state: results of several shapes, constants among them."""
    if i % 3 == 1:
        return {"mean": anp.mean(state), "pair": (state[1:], np.array([2.0, 2.0])), "i": i}
    return None


@pytest.mark.sampled
@pytest.mark.parametrize("memory", [None, 136, 160, 256])
@pytest.mark.parametrize("name", KEEPS)
def test_every_kind_of_result(name, memory):
    by_rollout, by_loop = KEEPS[name]
    x = (U, 1.3)
    (value, slope), (wanted, exact) = (
        dp.value_and_grad(lambda x: f(*x))(x) for f in (lambda *a: by_rollout(*a, memory=memory), by_loop)
    )
    assert abs(value - wanted) < 1e-15 and abs(value) > 0
    close(slope, exact)
    assert dp.check.gradient(lambda x: by_rollout(*x, memory=memory), x, quick=True)


@pytest.mark.parametrize("name", KEEPS)
def test_second_order_of_every_kind(name, rng):
    x = (U, 1.3)
    along = (rng.normal(size=3), 0.7)

    def product(f, reverse):
        def slope(x):
            return dp.value_and_grad(lambda x: f(*x))(x)[1]

        if reverse:
            return dp.value_and_grad(lambda x: anp.sum(slope(x)[0] * along[0]) + slope(x)[1] * along[1])(x)[1]
        return pushforward(slope, x, along)[1]

    wanted = product(KEEPS[name][1], True)
    for reverse in (True, False):
        close(product(lambda u, p: KEEPS[name][0](u, p, memory=160), reverse), wanted)


def few(s, p, f=0.0):
    """Trees with a whole number, an empty branch and nothing at all in them."""
    u, count, empty = s
    return u * anp.cos(p["k"] * u) + 0.1 * p["k"] + 0.1 * f, count + 1, empty


@pytest.mark.sampled
@pytest.mark.parametrize("options", [{}, {"memory": 200}, {"memory": "1 kB"}, {"truncate": 1}], ids=str)
@pytest.mark.parametrize("inputs", [False, True])
@pytest.mark.parametrize("keep", ["last", "all", "function", "nothing"])
@pytest.mark.parametrize("n", [0, 1, 2])
def test_no_step_one_and_two(n, keep, inputs, options):
    """Values, and derivatives forward, in reverse and of second order, against the loop written out."""
    seen = []
    kept = {
        "function": lambda i, s: (seen.append(i), anp.sum(s[0] ** 3) * (i + 1 + s[1]))[1],
        "nothing": lambda i, s: s[2],
    }
    force = np.cos(np.arange(float(n))) if inputs else None

    def rolled(u, k, force):
        out = dp.rollout(few, (u, 3, ()), {"k": k, "none": []}, n, inputs=force, keep=kept.get(keep, keep), **options)
        if keep in kept:
            assert len(out) == n + 1
            if keep == "function":
                return sum(out, 0.0 * k)
            return 0.0 * k + len(out) + anp.sum(u)
        assert out[2] == () and np.array_equal(out[1], np.arange(3, n + 4) if keep == "all" else n + 3)
        return anp.sum(out[0] ** 2)

    def looped(u, k, force):
        from sparsedp.autodiff.tape import plain

        states = [(u, 3, ())]
        for i in range(n):
            u = plain(states[-1][0]) if i and "truncate" in options else states[-1][0]
            states.append(few((u, *states[-1][1:]), {"k": k}, *([] if force is None else [force[i]])))
        if keep == "function":
            return sum(kept[keep](i, s) for i, s in enumerate(states))
        if keep == "nothing":
            return 0.0 * k + n + 1.0 + anp.sum(states[0][0])
        return sum(anp.sum(s[0] ** 2) for s in (states if keep == "all" else states[-1:]))

    x = (U, 1.3, force)
    along = (np.ones(3), 0.5, None if force is None else np.ones(n))
    slope = lambda f: lambda x: dp.value_and_grad(lambda x: f(*x))(x)[1]
    for way in (
        lambda f: f(*x),
        lambda f: dp.value_and_grad(lambda x: f(*x))(x),
        lambda f: pushforward(lambda x: f(*x), x, along)[1],
        lambda f: pushforward(slope(f), x, along)[1],
        lambda f: dp.value_and_grad(lambda x: anp.sum(slope(f)(x)[0] * U) + slope(f)(x)[1])(x)[1],
    ):
        ours, wanted = ([leaf for leaf in leaves(way(f)) if leaf is not None] for f in (rolled, looped))
        close(ours, wanted)
    seen.clear()
    rolled(*x)
    assert seen == (list(range(n + 1)) if keep == "function" else [])


@pytest.mark.parametrize("keep", ["last", "all", lambda i, s: (i, s)], ids=["last", "all", "function"])
@pytest.mark.parametrize("state", [(), {}, {"n": 1, "word": "a"}], ids=str)
def test_states_without_numbers(state, keep):
    step = lambda s, p: {**s, "n": s["n"] + 1} if "n" in s else s
    for n in (0, 1, 2):
        out = dp.rollout(step, state, None, n, keep=keep)
        states = [{**state, "n": 1 + i} if "n" in state else state for i in range(n + 1)]
        if callable(keep):
            assert out == tuple(enumerate(states))
        elif keep == "last" or "n" not in state:
            assert out == states[-1]
        else:
            assert out["word"] == "a" and np.array_equal(out["n"], np.arange(1, n + 2))


def test_taylor_remainder_of_third_order(rng):
    """f(x + t d) - f - t f' - t^2/2 f'' falls as t^3."""
    x = (U, 1.3)
    d = (rng.normal(size=3), 0.7)
    loss = lambda x: KEEPS["last"][0](*x, memory=160)
    slope = lambda x: dp.value_and_grad(loss)(x)[1]
    (value, g), (_, h) = dp.value_and_grad(loss)(x), pushforward(slope, x, d)
    dot = lambda a, b: float(np.sum(a[0] * b[0]) + a[1] * b[1])
    steps = 2.0 ** -np.arange(3, 8)
    rest = [abs(loss((x[0] + t * d[0], x[1] + t * d[1])) - value - t * dot(g, d) - t**2 / 2 * dot(h, d)) for t in steps]
    assert np.all(np.log2(np.array(rest[:-1]) / rest[1:]) >= 2.9)


def test_third_derivative():
    def third(f):
        first = lambda p: dp.value_and_grad(f)(p)[1]
        second = lambda p: dp.value_and_grad(first)(p)[1]
        return dp.value_and_grad(second)(1.3)[1]

    wanted = third(lambda p: anp.sum(loop(U, p, 4)[-1]))
    assert abs(third(lambda p: anp.sum(dp.rollout(bend, U, p, 4, memory=136))) - wanted) < 1e-13


def test_functions_without_jvp():
    """autograd has no JVP of the Fourier transform: Hessian products go by two reverse passes."""
    step = lambda u, p: u + 0.1 * p * anp.real(anp.fft.ifft(anp.fft.fft(u) ** 2))

    def plain(x):
        u = x[0]
        for _ in range(3):
            u = step(u, x[1])
        return anp.sum(u**2)

    def product(f):
        slope = lambda x: dp.value_and_grad(f)(x)[1]
        return dp.value_and_grad(lambda x: anp.sum(slope(x)[0] * U) + slope(x)[1])((U, 0.4))[1]

    close(product(lambda x: anp.sum(dp.rollout(step, x[0], x[1], 3) ** 2)), product(plain))


@pytest.mark.parametrize("k", [1, 2, 3, 7, 50])
@pytest.mark.parametrize("memory", [None, 160])
@pytest.mark.parametrize("losses", [False, True])
def test_truncation(k, memory, losses):
    """State i is a constant for the steps after it where n - i is a multiple of k."""
    from sparsedp.autodiff.tape import plain

    n = 7

    def cut(u, p):
        total = 0.0
        for i in range(n):
            total = total + anp.sum(WEIGHTS[i] * u**2)
            u = bend(plain(u) if i and (n - i) % k == 0 else u, p)
        last = anp.sum(WEIGHTS[n] * u**2)
        if losses:
            return total + last
        return last

    def ours(u, p):
        if not losses:
            return anp.sum(WEIGHTS[n] * dp.rollout(bend, u, p, n, truncate=k, memory=memory) ** 2)
        return anp.sum(WEIGHTS * dp.rollout(bend, u, p, n, truncate=k, memory=memory, keep="all") ** 2)

    (value, slope), (wanted, exact) = (dp.value_and_grad(lambda x: f(*x))((U, 1.3)) for f in (ours, cut))
    assert abs(value - wanted) < 1e-15
    close(slope, exact)
    _, tangent = pushforward(lambda x: ours(*x), (U, 1.3), (np.ones(3), 0.5))
    assert abs(tangent - np.sum(exact[0]) - 0.5 * exact[1]) < 1e-13


@pytest.mark.parametrize("dtype", ["f4", "f8", "c16"])
def test_dtypes(dtype):
    u = (U + (0.2j if dtype == "c16" else 0)).astype(dtype)
    p = np.dtype(dtype).type(1.3)
    size = lambda x: anp.sum(anp.abs(x) ** 2)
    value, slope = dp.value_and_grad(lambda x: size(dp.rollout(bend_twice, *x, 5)))((u, p))
    wanted, exact = dp.value_and_grad(lambda x: size(dp.rollout(bend_twice, *x, 5, memory=1e6)))((u, p))
    assert value == wanted and slope[0].dtype == dtype and slope[0].tobytes() == exact[0].tobytes()

    def by_loop(x):
        u = x[0]
        for _ in range(5):
            u = bend_twice(u, x[1])
        return size(u)

    close(slope, dp.value_and_grad(by_loop)((u, p))[1], 1e-4 if dtype == "f4" else 1e-13)


def bend_twice(u, p):
    return u + p * u * u * u.dtype.type(0.25)


def test_complex_and_real_fields_of_different_shapes(rng):
    """Values, gradients and second derivatives in both nestings; z: complex (3,), r: a number."""

    def step(s, p):
        z, r = s
        return z * anp.exp(1j * p * r), r + 0.1 * anp.sum(anp.real(z * z)) * p

    def by_loop(z, r, p, n):
        states = [(z, r)]
        for _ in range(n):
            states.append(step(states[-1], p))
        return anp.stack([z for z, _ in states]), anp.stack([r for _, r in states])

    size = lambda z, r: anp.sum(anp.imag(z[-1]) ** 3) + anp.sum(anp.real(z[0]) ** 2 * r[-1])
    x = (U + 0.2j, 0.7, 1.3)
    along = (U[::-1] - 1j * U, -0.3, 0.4)
    for n in (0, 1, 3):
        ours = lambda x, n=n: size(*dp.rollout(step, x[:2], x[2], n, keep="all"))
        wanted = lambda x, n=n: size(*by_loop(*x, n))
        close(dp.value_and_grad(ours)(x), dp.value_and_grad(wanted)(x))
        exact = dp.hvp(wanted, x, along)
        close(dp.hvp(ours, x, along), exact)
        for loss in (ours, wanted):
            product = lambda x, loss=loss: sum(
                anp.sum(anp.real(a * b)) for a, b in zip(dp.grad(loss)(x), along, strict=True)
            )
            close(dp.grad(product)(x), exact)


def test_layouts_of_memory_do_not_change_a_bit():
    field = np.arange(12.0).reshape(3, 4) / 10
    step = lambda u, p: u + 0.1 * anp.sum(u) * anp.cos(u)
    loss = lambda u: anp.sum(dp.rollout(step, u, None, 4) ** 2)
    frozen = field.copy()
    frozen.flags.writeable = False
    value, slope = dp.value_and_grad(loss)(field)
    for other in (np.asfortranarray(field), np.repeat(field, 2, axis=0)[::2], field[::-1][::-1], frozen):
        again, same = dp.value_and_grad(loss)(other)
        assert again == value and same.tobytes() == slope.tobytes()


def test_numbers_as_state_and_inputs():
    push = np.linspace(0.0, 1.0, 4)
    step = lambda s, p, f: (s[0] + 0.1 * s[1], s[1] - 0.1 * p * s[0] + f["push"], s[2] + f["more"])
    loss = lambda x: dp.rollout(step, (x[0], 0.5, 0), x[1], 4, inputs={"push": x[2], "more": np.arange(4)})
    assert isinstance(loss((1.0, 2.0, push))[0], float) and loss((1.0, 2.0, push))[2] == 6
    assert dp.check.gradient(lambda x: loss(x)[0] ** 2 + loss(x)[1], (1.0, 2.0, push), quick=True)


def test_numbers_of_python_keep_a_float32_state_in_nested_rollouts():
    """A step gets a number of Python as such: as float64 it would widen the state of the inner rollout."""
    u = np.ones(3, np.float32)
    p = {"rate": 0.5}
    types = []

    def step(u, p):
        types.append(type(plain(p["rate"])))
        return u * p["rate"]

    outer = lambda u, p: dp.rollout(step, u, p, 2)
    assert dp.rollout(outer, u, p, 2).dtype == np.float32
    assert set(types) == {float}
    slope = dp.grad(lambda p: anp.sum(dp.rollout(outer, u, p, 2)))(p)["rate"]
    assert slope == pytest.approx(4 * 3 * 0.5**3)


@pytest.mark.parametrize("memory", [None, 200])
def test_numbers_of_python_without_a_step(memory):
    for keep in ("last", "all"):
        loss = lambda x, keep=keep: anp.sum(dp.rollout(lambda u, p: u * p, *x, 0, memory=memory, keep=keep) ** 2)
        assert dp.value_and_grad(loss)((0.5, 2.0)) == (0.25, (1.0, 0.0))
        assert dp.hvp(loss, (0.5, 2.0), (1.0, 1.0)) == (2.0, 0.0)
        assert dp.grad(lambda x, loss=loss: sum(dp.grad(loss)(x)))((0.5, 2.0)) == (2.0, 0.0)


@pytest.mark.parametrize("memory", [1500, 3000])
def test_an_empty_state_under_a_budget_has_a_gradient(memory):
    loss = lambda p: p**2 + anp.sum(dp.rollout(lambda u, p: u * p, np.zeros(0), p, 2000, memory=memory))
    assert dp.value_and_grad(loss)(1.5) == (2.25, 3.0)


def test_jvp_needs_no_kept_state():
    runs = []
    _, tangent = pushforward(lambda p: dp.rollout(bend, U, p, 6, record=runs.append), 1.3, 1.0)
    close(tangent, pushforward(lambda p: loop(U, p, 6)[-1], 1.3, 1.0)[1])
    dp.rollout(bend, U, 1.3, 6, record=runs.append)
    assert runs[-1].kept == 0


@pytest.mark.parametrize("memory", [136, None])
def test_memory_is_released(memory):
    """Without the cycle collector, all records are freed once the gradient is computed."""

    class Step:
        def __call__(self, u, p):
            return u * p

    def gradient(step):
        return dp.value_and_grad(lambda u: anp.sum(dp.rollout(step, u, 1.1, 5, memory=memory)))(U)

    step = Step()
    watch = weakref.ref(step)
    gc.collect()
    gc.disable()
    try:
        gradient(step)
        del step
        assert watch() is None
    finally:
        gc.enable()


def test_an_argument_changed_after_the_run_is_not_seen():
    u = U.copy()
    p = np.array([1.3])
    f = np.ones((4, 3))
    step = lambda u, p, f: u * p + 0.1 * f * u
    value, pull = pullback(lambda x: anp.sum(dp.rollout(step, x[0], x[1], 4, inputs=x[2])), (u, p, f))
    wanted = dp.value_and_grad(lambda x: anp.sum(dp.rollout(step, *x[:2], 4, inputs=x[2])))((u.copy(), p + 0, f + 0))
    u[:], p[:], f[:] = 9.0, 9.0, 9.0
    close(pull(1.0), wanted[1], 0.0)


KINDS = {
    "mixed": lambda one, other, p: 0.7 * one + 0.2 * other * p,
    "itself": lambda one, other, p: one,
    "the other one": lambda one, other, p: other,
    "params": lambda one, other, p: p,
    "constant": lambda one, other, p: CONSTANT,
    "seen backwards": lambda one, other, p: one[::-1],
    "sum": lambda one, other, p: one * anp.sum(other) * 0.3,
}
CONSTANT = np.array([0.2, 0.1, -0.4])
FEW = np.array([1.0, 0.0, -0.6])


@pytest.mark.filterwarnings("ignore:Output seems independent")
@pytest.mark.parametrize("weight", [0.0, 1.0], ids=["one field is used", "both are used"])
@pytest.mark.parametrize("second", [*KINDS, "as the first"])
@pytest.mark.parametrize("first", KINDS)
def test_variables_that_are_constant_swapped_given_on_or_the_same(first, second, weight):
    """Each as the loop on autograd's tape; with a budget to the last bit as without."""

    def step(state, p):
        new = KINDS[first](*state, p)
        return new, (new if second == "as the first" else KINDS[second](*state[::-1], p))

    def by_loop(x):
        state = x[0], x[1]
        for _ in range(6):
            state = step(state, x[2])
        return anp.sum(FEW * state[0]) + weight * anp.sum(WEIGHTS[1] * state[1] ** 2)

    def by_rollout(x, memory=None):
        one, other = dp.rollout(step, (x[0], x[1]), x[2], 6, memory=memory)
        return anp.sum(FEW * one) + weight * anp.sum(WEIGHTS[1] * other**2)

    x = U, 0.5 - U, np.array([0.4, -0.7, 1.1])
    ours = dp.value_and_grad(by_rollout)(x)
    close(ours, autograd.value_and_grad(by_loop)(x))
    close(dp.value_and_grad(lambda x: by_rollout(x, 480))(x), ours, 0.0)


def logistic(x, r):
    return r * x * (1.0 - x)


LINEAR = np.array([[-10.0, 10.0, 0.0], [28.0, -1.0, 0.0], [0.0, 0.0, -8.0 / 3.0]])
FIRST = np.array([[1.0, 0.0, 0.0]] * 3)
TURNED = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def lorenz(u, p, dt=0.02):
    def rate(u):
        return LINEAR @ u + (FIRST @ u) * (TURNED @ u)

    a = rate(u)
    b = rate(u + 0.5 * dt * a)
    c = rate(u + 0.5 * dt * b)
    return u + dt / 6.0 * (a + 2.0 * b + 2.0 * c + rate(u + dt * c))


@pytest.mark.parametrize(
    "step, start, p, n, exponent",
    [
        (logistic, np.array([0.3]), 4.0, 500, np.log(2.0)),
        pytest.param(lorenz, np.array([1.0, 2.0, 20.0]), None, 1300, 0.01811, marks=pytest.mark.whole),
    ],
    ids=["logistic", "lorenz"],
)
def test_growth_is_the_lyapunov_exponent(step, start, p, n, exponent):
    runs = []
    with pytest.warns(GrowthWarning):
        dp.value_and_grad(lambda u: dp.rollout(step, u, p, n, record=runs.append)[0])(start)
    back = runs[-1]
    assert back.direction == "backward" and back.flagged
    assert abs(back.growth / exponent - 1) < 0.25


def test_a_stable_run_is_not_flagged(recwarn):
    runs = []
    dp.value_and_grad(lambda u: anp.sum(dp.rollout(bend, u, 1.3, 400, record=runs.append) ** 2))(0.01 * U)
    assert not runs[-1].flagged and not recwarn.list and runs[-1].norms[0][0] == 400
