"""Foreign code with branches: the other side is met later, and no Jacobian is returned that a probe does not see."""

import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.derivative import pullback, pushforward
from sparsedp.errors import DerivativeError, SparsedpError

N = 24


def relu(x):
    return np.maximum(x, 0.0)


def relu_of_real(x):
    return np.where(x.real > 0, x, 0.0 * x)


def upwind(x):
    """Values and the wind that carries them: differences from the side that the wind comes from."""
    u = x[:N]
    w = x[N:]
    gain = np.where(w.real > 0, w * (u - np.roll(u, 1)), w * (np.roll(u, -1) - u))
    return np.concatenate([u - 0.3 * gain, 0.9 * w + 0.1 * np.roll(w, 1)])


def upwind_matrix(x):
    u = x[:N]
    w = x[N:]
    one = np.eye(N)
    before = np.roll(np.eye(N), -1, 1)
    after = np.roll(np.eye(N), 1, 1)
    up = w > 0
    difference = np.where(up[:, None], one - before, after - one)
    of_u = one - 0.3 * w[:, None] * difference
    of_w = -0.3 * np.diag(difference @ u)
    return np.block([[of_u, of_w], [np.zeros((N, N)), 0.9 * one + 0.1 * before]])


def sort(x):
    return np.sort(x) * np.arange(1, x.size + 1)


def sort_matrix(x):
    J = np.zeros((x.size, x.size))
    J[np.arange(x.size), np.argsort(x)] = np.arange(1, x.size + 1)
    return J


def leader(x):
    """Everything follows the largest entry."""
    return x**2 + x[np.argmax(x.real)]


def leader_matrix(x):
    J = np.diag(2 * x)
    J[:, np.argmax(x)] += 1
    return J


def distance(x):
    """abs of complex numbers loses the imaginary part."""
    return np.abs(x) * x + np.abs(x - np.roll(x, 1))


def distance_matrix(x):
    sign = np.sign(x - np.roll(x, 1))
    return np.diag(2 * np.abs(x) + sign) - np.roll(np.diag(np.roll(sign, -1)), 1, 0)


def mixed(x):
    """Analytic on one side only: no complex step is right on the other."""
    return np.where(x.real > 0, x**2, np.abs(x) * np.roll(x, 1))


def mixed_matrix(x):
    low = x <= 0
    before = np.roll(np.eye(x.size), -1, 1)
    return np.diag(np.where(low, -np.roll(x, 1), 2 * x)) + np.where(low, np.abs(x), 0.0)[:, None] * before


def compared(x):
    """Python's comparison: a complex number that gets there raises."""
    y = 1.5 * x
    if x[0].real < 0:
        for i in range(x.size):
            y[i] = x[i] ** 3 if x[i] > 0 else -x[i - 1]
    return y


def compared_matrix(x):
    if x[0] >= 0:
        return 1.5 * np.eye(x.size)
    up = x > 0
    return np.diag(np.where(up, 3 * x**2, 0.0)) - np.where(up, 0.0, 1.0)[:, None] * np.roll(np.eye(x.size), -1, 1)


def tiny_rows(x):
    """A branch in rows of other units."""
    scale = np.where(np.arange(x.size) % 3 == 0, 1e-12, 1.0)
    return scale * (x**2 + np.where(x.real > 1, 0.0, np.roll(x, 2)))


def tiny_rows_matrix(x):
    scale = np.where(np.arange(x.size) % 3 == 0, 1e-12, 1.0)
    other = np.where(x > 1, 0.0, 1.0)[:, None] * np.roll(np.eye(x.size), -2, 1)
    return scale[:, None] * (np.diag(2 * x) + other)


CODES = {
    relu: lambda x: np.diag((x > 0) * 1.0),
    relu_of_real: lambda x: np.diag((x > 0) * 1.0),
    upwind: upwind_matrix,
    sort: sort_matrix,
    leader: leader_matrix,
    distance: distance_matrix,
    mixed: mixed_matrix,
    compared: compared_matrix,
    tiny_rows: tiny_rows_matrix,
}
REAL = [relu, upwind, sort, leader, mixed, tiny_rows]


def real(f):
    """The same through code that loses an imaginary part: only differences are left."""
    made = lambda x: f(np.asarray(x).real)
    made.__name__ = f"real {f.__name__}"
    return made


def rows_agree(J, known, digits):
    size = np.abs(known).max(axis=1)
    return np.all(np.abs(J - known).max(axis=1) <= digits * size)


SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.whole) for seed in range(1, 8))]


@pytest.mark.sampled(0)
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("f", CODES, ids=lambda f: f.__name__)
def test_the_other_side_is_met_later(f, seed):
    """The first point sees one side of every branch; the ones that follow turn a few, and then all."""
    rng = np.random.default_rng(seed)
    for code in (f, real(f)) if f in REAL else (f,):
        adopted = dp.from_blackbox(code)
        x = 2 + rng.random(2 * N)
        for turned in (0, 3, 10, 2 * N):
            x = np.where(np.isin(np.arange(2 * N), rng.choice(2 * N, turned, replace=False)), -x, x)
            g, v = rng.standard_normal((2, 2 * N))
            known = CODES[f](x)
            assert rows_agree(adopted.jacobian(x).toarray(), known, 1e-7)
            value, pull = pullback(adopted, x)
            assert np.allclose(pull(g), known.T @ g, rtol=1e-6, atol=1e-7)
            assert np.allclose(pushforward(adopted, x, v)[1], known @ v, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("f", [relu, relu_of_real, real(relu)], ids=lambda f: f.__name__)
def test_at_a_kink_and_near_it(f):
    """Exactly at a kink the derivative is the mean of both sides; next to the kink it is one-sided."""
    adopted = dp.from_blackbox(f)
    x = np.linspace(1.0, 2.0, 300)
    adopted.jacobian(x)
    x[::3], x[1::30], x[2::30] = 0.0, 1e-6, -1e-6
    known = np.where(x > 0, 1.0, np.where(x < 0, 0.0, 0.5))
    assert np.allclose(adopted.jacobian(x).toarray(), np.diag(known), atol=1e-8)


def test_a_kink_without_a_derivative_is_refused():
    """Three equal numbers: no linear map is the derivative of the largest of three."""
    largest = dp.from_blackbox(lambda x: np.array([np.max(x.real)]), name="largest")
    assert np.allclose(largest.jacobian(np.array([1.0, 3.0, 2.0])).toarray(), [[0, 1, 0]])
    with pytest.raises(DerivativeError, match="row 0 of the Jacobian of largest .* does not agree"):
        largest.jacobian(np.ones(3))


@pytest.mark.parametrize("f", REAL, ids=lambda f: f.__name__)
@pytest.mark.parametrize("derivative", ["auto", "complex", "difference"])
def test_a_sparsity_that_lacks_entries(f, derivative, rng):
    """What is given is not searched for: it is right, or refused, at the first point and at later ones."""
    x = 2 + rng.random(2 * N)
    adopted = dp.from_blackbox(f, sparsity=CODES[f](x) != 0, derivative=derivative)
    for turned in (0, 3, 10, 2 * N):
        x = np.where(np.arange(2 * N) < turned, -x, x)
        try:
            found = adopted.jacobian(x).toarray()
        except DerivativeError:
            continue
        assert rows_agree(found, CODES[f](x), 1e-7)


def test_code_that_refuses_every_probe():
    """What it says is said, not that its sparsity lacks entries."""
    x = np.array([1.0, 2.0])

    def narrow(z):
        if np.any(z.real != x):
            raise ValueError("outside of the table")
        return z**2

    with pytest.raises(ValueError, match="outside of the table"):
        dp.from_blackbox(narrow, sparsity=np.eye(2), derivative="complex").jacobian(x)


@pytest.mark.parametrize("place", [2, 4, 9])
def test_no_memory_is_no_branch_of_the_code(place):
    """It is handed on from wherever the code runs into it, and so is Ctrl-C; the next call is as the first."""
    x = np.array([1.0, -2.0, 3.0])
    calls = []

    def full(z):
        calls.append(z)
        if len(calls) == place:
            raise trouble
        return z**2

    for trouble in (MemoryError(), KeyboardInterrupt()):
        calls.clear()
        adopted = dp.from_blackbox(full)
        with pytest.raises(type(trouble)):
            adopted.jacobian(x)
        assert np.allclose(adopted.jacobian(x).toarray(), np.diag(2 * x), rtol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_never_a_wrong_number(seed):
    """Random programs of branches, at random points: the Jacobian agrees with dense differences."""
    rng = np.random.default_rng(seed)
    parts = [rng.choice([relu, upwind, sort, leader, distance, mixed, tiny_rows]) for _ in range(2)]
    f = lambda x: parts[1](parts[0](x))
    adopted = dp.from_blackbox(f)
    for _ in range(4):
        x = rng.standard_normal(2 * N)
        known = CODES[parts[1]](parts[0](x)) @ CODES[parts[0]](x)
        try:
            found = adopted.jacobian(x).toarray()
        except SparsedpError:
            continue
        assert rows_agree(found, known, 1e-5)
