"""Layers against loops in autograd.numpy, their first and second derivatives, and files."""

import json

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp import network as nn
from sparsedp._utils import pytree
from sparsedp.autodiff.derivative import pullback, pushforward, value_and_grad

PADDINGS = ["periodic", "zero", "replicate"]
SHAPES = [((3,), (7,)), ((5,), (5,)), ((1,), (4,)), ((3, 5), (6, 7)), ((1, 3), (4, 3)), ((5, 5), (5, 8))]


def twin(p, x, padding):
    """Return the convolution as a sum of shifted fields, one for each entry of the filters."""
    w = p["weight"]
    dim = anp.ndim(x) - 2
    widths = anp.shape(w)[-dim:]
    total = 0.0
    for place in np.ndindex(*widths):
        moved = x
        for axis, (d, width) in enumerate(zip(place, widths)):
            n = x.shape[2 + axis]
            at = np.arange(n) + d - width // 2
            inside = ((at >= 0) & (at < n)).astype(float) if padding == "zero" else np.ones(n)
            at = at % n if padding == "periodic" else np.clip(at, 0, n - 1)
            picked = [slice(None)] * (2 + dim)
            picked[2 + axis] = at
            moved = moved[tuple(picked)] * inside.reshape((-1,) + (1,) * (dim - 1 - axis))
        part = w[(slice(None), slice(None), *place)]
        total = total + anp.einsum("oc,sc...->so...", part, moved)
    return total + anp.reshape(p["bias"], (-1,) + (1,) * dim)


def setting(rng, widths, cells, samples=3, inputs=2, outputs=4):
    p = nn.convolution_weights(rng, inputs, outputs, widths)
    return {**p, "bias": rng.standard_normal(outputs)}, rng.standard_normal((samples, inputs, *cells))


@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("widths, cells", SHAPES)
def test_convolution_against_a_sum_of_shifted_fields(rng, widths, cells, padding):
    p, x = setting(rng, widths, cells)
    y, pull = pullback(lambda a: nn.convolution(a[0], a[1], padding), (p, x))
    expected_y, pull_expected = pullback(lambda a: twin(a[0], a[1], padding), (p, x))
    g = rng.standard_normal(y.shape)
    assert np.allclose(y, expected_y, rtol=1e-12, atol=1e-12)
    for a, b in zip(pytree.leaves(pull(g)), pytree.leaves(pull_expected(g))):
        assert np.allclose(a, b, rtol=1e-12, atol=1e-12)
    direction = ({"weight": rng.standard_normal(p["weight"].shape), "bias": rng.standard_normal(4)}, x[::-1])
    slope = pushforward(lambda a: nn.convolution(a[0], a[1], padding), (p, x), direction)[1]
    back = pull(g)
    pairs = zip(pytree.leaves(back), pytree.leaves(direction))
    assert np.sum(slope * g) == pytest.approx(sum(np.sum(a * b) for a, b in pairs), rel=1e-12)


@pytest.mark.parametrize("padding", PADDINGS)
def test_second_order_of_a_small_network(rng, padding):
    p = {"a": nn.convolution_weights(rng, 1, 3, 3), "b": nn.convolution_weights(rng, 3, 1, 5)}
    x = rng.standard_normal((2, 1, 6))
    v = rng.standard_normal((3, 1, 3))

    def loss(convolution):
        net = lambda q: convolution(p["b"], nn.tanh(convolution({**p["a"], "weight": q}, x, padding)), padding)
        return lambda q: anp.sum(net(q) ** 2)

    def along(f):
        slope = lambda q: anp.sum(value_and_grad(f)(q)[1] * v)
        return value_and_grad(slope)(p["a"]["weight"])[1]

    assert np.allclose(along(loss(nn.convolution)), along(loss(twin)), rtol=1e-10)


@pytest.mark.parametrize("shape", [(6,), (4, 5)])
def test_copies_for_each_sample(rng, shape):
    p, x = setting(rng, (3,) * len(shape), shape)
    copies = {name: np.stack([value * (1 + i) for i in range(3)]) for name, value in p.items()}
    y, pull = pullback(lambda a: nn.convolution(a[0], a[1]), (copies, x))
    g = rng.standard_normal(y.shape)
    slopes, back = pull(g)
    for i in range(3):
        own = {name: value[i] for name, value in copies.items()}
        one, pull_one = pullback(lambda a: nn.convolution(a[0], a[1]), (own, x[i : i + 1]))
        assert np.allclose(y[i], one[0], rtol=1e-12)
        (slope, slope_x) = pull_one(g[i : i + 1])
        assert np.allclose(slopes["weight"][i], slope["weight"]) and np.allclose(slopes["bias"][i], slope["bias"])
        assert np.allclose(back[i], slope_x[0])


def test_dense(rng):
    p = {"weight": rng.standard_normal((3, 4)), "bias": rng.standard_normal(4)}
    x = rng.standard_normal((5, 3))
    loss = lambda f: lambda a: anp.sum(anp.sin(f(a[0], a[1])))
    value, slopes = value_and_grad(loss(nn.dense))((p, x))
    expected_value, expected_slopes = value_and_grad(loss(lambda p, x: anp.dot(x, p["weight"]) + p["bias"]))((p, x))
    assert value == pytest.approx(expected_value, rel=1e-14)
    assert all(np.allclose(a, b, rtol=1e-12) for a, b in zip(pytree.leaves(slopes), pytree.leaves(expected_slopes)))
    assert dp.check.gradient(loss(nn.dense), (p, x), quick=True)
    copies = {name: np.stack([value] * 5) for name, value in p.items()}
    assert np.allclose(nn.dense(copies, x), nn.dense(p, x), rtol=1e-13)
    assert dp.check.gradient(loss(nn.dense), (copies, x), quick=True)


@pytest.mark.parametrize("activation", [nn.tanh, nn.softplus])
def test_activations(rng, activation):
    x = rng.standard_normal(50) * 3
    result = dp.check.gradient(lambda u: anp.sum(activation(u) ** 2), x)
    assert result.verdict == "agrees", result
    assert np.all(np.isfinite(value_and_grad(lambda u: anp.sum(activation(u)))(np.array([-800.0, 0.0, 800.0]))[1]))


def test_relu_takes_the_mean_at_its_kink():
    slope = value_and_grad(lambda u: anp.sum(nn.relu(u)))(np.array([-2.0, 0.0, 3.0]))[1]
    assert np.array_equal(slope, [0.0, 0.5, 1.0])


def test_training_a_residual_network(rng):
    p = [nn.convolution_weights(rng, 1, 4, 3), nn.residual_weights(rng, 4, 3), nn.convolution_weights(rng, 4, 1, 3)]
    x = rng.standard_normal((4, 1, 16))

    def net(q):
        hidden = nn.residual_block(q[1], nn.convolution(q[0], x))
        return nn.convolution(q[2], hidden) - anp.roll(x, 1, axis=-1) ** 2

    assert dp.check.gradient(lambda q: anp.sum(net(q) ** 2), p, quick=True).verdict == "agrees"
    best = dp.minimize(net, p, "levenberg_marquardt", maxiter=15, apart=True)
    assert best.value < 0.2 * best.history[0].value


def test_the_gain_keeps_the_size_of_a_signal():
    rng = np.random.default_rng(5)
    x = rng.standard_normal((200, 64))
    p = nn.dense_weights(rng, 64, 64)
    assert np.std(nn.dense(p, x)) == pytest.approx(1, abs=0.1)
    p = nn.convolution_weights(rng, 8, 8, (3, 3))
    assert np.std(nn.convolution(p, rng.standard_normal((20, 8, 9, 9)))) == pytest.approx(1, abs=0.15)


def test_saved_parameters_are_loaded(tmp_path, rng):
    tree = {"net": [nn.dense_weights(rng, 2, 3), (np.float32(1.5), None)], "name": "a", "steps": 3, "rate": 1e-3}
    path = tmp_path / "net.npz"
    nn.save(path, tree)
    back = nn.load(path)
    assert np.array_equal(back["net"][0]["weight"], tree["net"][0]["weight"]) and isinstance(back["net"][1], tuple)
    assert back["net"][1][0].dtype == np.float32 and back["steps"] == 3 and back["name"] == "a"
    with pytest.raises(TypeError, match="save needs dicts with strings as keys; write str\\(key\\)"):
        nn.save(path, {1: 2})
    with pytest.raises(
        TypeError, match=r"save takes arrays, numbers, strings and None, got set; write np.asarray\(value\)"
    ):
        nn.save(path, {"a": {1}})
    (tmp_path / "half.npz").write_bytes((tmp_path / "net.npz").read_bytes()[:100])
    np.savez(tmp_path / "foreign.npz", np.frombuffer(json.dumps({"format": "x"}).encode(), np.uint8))
    for name in ("half.npz", "foreign.npz"):
        with pytest.raises(
            ValueError, match=".* was not written by dp.network.save, or is damaged; save the parameters again"
        ):
            nn.load(tmp_path / name)


def test_refusals(rng):
    p, x = setting(rng, (3,), (6,))
    with pytest.raises(ValueError, match="padding must be one of periodic, zero, replicate, got 'same'"):
        nn.convolution(p, x, "same")
    with pytest.raises(
        dp.errors.ShapeError,
        match=r"convolution takes x \(samples, inputs, n\) or \(samples, inputs, nx, ny\) and a weight "
        r"\(outputs, inputs, widths\), got \(6,\) and \(4, 2, 3\)",
    ):
        nn.convolution(p, x[0, 0])
    with pytest.raises(
        ValueError, match=r"convolution needs odd widths, so that the output lies on the same cells, got \(2,\)"
    ):
        nn.convolution({**p, "weight": p["weight"][..., :2]}, x)
    with pytest.raises(ValueError, match=r"convolution needs odd widths, .* got \(4, 4\)"):
        nn.convolution_weights(np.random.default_rng(0), 1, 2, (4, 4))
    with pytest.raises(
        dp.errors.ShapeError,
        match=r"convolution got x \(3, 1, 6\), weight \(4, 2, 3\) and bias \(4,\); inputs, outputs or samples differ",
    ):
        nn.convolution(p, x[:, :1])
    with pytest.raises(
        dp.errors.ShapeError,
        match=r"dense takes x \(samples, inputs\), a weight \(inputs, outputs\) and a bias \(outputs,\), "
        r"got \(3,\), \(3, 2\) and \(2,\)",
    ):
        nn.dense(nn.dense_weights(rng, 3, 2), np.ones(3))


@pytest.mark.parametrize("cells", [(0,), (1,), (1, 1), (2, 1)])
@pytest.mark.parametrize("padding", PADDINGS)
def test_small_and_empty_fields(rng, cells, padding):
    p, x = setting(rng, (3,) * len(cells), cells)
    loss = lambda f: lambda a: anp.sum(f(a[0], a[1], padding) ** 2)
    value, slopes = value_and_grad(loss(nn.convolution))((p, x))
    if x.size:
        expected_value, expected_slopes = value_and_grad(loss(twin))((p, x))
        assert value == pytest.approx(expected_value)
        assert all(np.allclose(a, b) for a, b in zip(pytree.leaves(slopes), pytree.leaves(expected_slopes)))
    assert nn.convolution(p, x[:0], padding).shape == (0, 4, *cells)
