"""torch: functions of this library under its gradcheck, and functions of torch on our tape."""

import pickle
import weakref

import autograd.numpy as anp
import numpy as np
import pytest
from bridged import FIELD, GRID, INVERSE, SCENES, SIDES, L, gradient_with_a_reused_constant, numbers

import sparsedp as dp
from sparsedp._utils.pytree import flatten, leaves, mapped

torch = pytest.importorskip("torch", reason="torch is not installed: the extra `torch`")
to_torch = dp.interop.to_torch
from_torch = dp.interop.from_torch


def tensor(x, moves=True):
    return torch.tensor(x, requires_grad=moves)


# ---- functions of this library for torch -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENES)
def test_gradcheck(name):
    """torch's own test, of first and of second order, of all arguments; values equal the results of the function."""
    f, args = SCENES[name]
    g = to_torch(f)
    given, rebuild = flatten(mapped(tensor, args))
    flat = lambda *tensors: tuple(leaves(g(*rebuild(tensors))))
    for found, wanted in zip(flat(*given), leaves(f(*args)), strict=True):
        assert np.array_equal(found.detach().numpy(), wanted)
    assert torch.autograd.gradcheck(flat, given)
    assert torch.autograd.gradgradcheck(flat, given)


def test_the_structure_of_the_result():
    f, args = SCENES["trees"]
    found = to_torch(lambda p, **options: {**f(p), **options})(*mapped(tensor, args), steps=3, word="ink")
    assert list(found) == ["a", "more", "steps", "word"] and found["steps"] == 3 and found["word"] == "ink"
    assert type(found["more"]) is tuple and found["more"][0].shape == ()


def test_float32_stays_float32():
    u = tensor(FIELD.astype("f"))
    y = to_torch(INVERSE)(u)
    y.sum().backward()
    assert y.dtype == u.grad.dtype == torch.float32
    assert np.allclose(u.grad, INVERSE.T(np.ones(GRID.shape)), rtol=1e-6)


def test_nothing_is_done_for_arguments_without_a_gradient():
    """No pull for what does not ask, no record where nothing does, or torch does not look."""
    asked = []
    made = []

    def vjp(nums, ans, a, b):
        made.append(nums)
        return lambda g: asked.append(nums) or tuple(g * (b, a)[num] for num in nums)

    product = to_torch(dp.differentiable("product", lambda a, b: a * b, vjp))
    a = tensor(numbers(3))
    b = tensor(numbers(3, seed=1), False)
    product(a, b).sum().backward()
    assert made == asked == [(0,)] and b.grad is None
    assert np.array_equal(a.grad, b)
    product(a.detach(), b)
    with torch.no_grad():
        assert not product(a, b).requires_grad
    assert made == [(0,)]


def test_a_result_that_is_not_used_has_no_cotangent():
    f = to_torch(lambda a, b: (a * b, a**2, L(b)))
    a = tensor(FIELD)
    b = tensor(FIELD + 1)
    f(a, b)[1].sum().backward()
    assert np.allclose(a.grad, 2 * FIELD) and not b.grad.any()


def test_memory_is_shared_where_nobody_else_has_it():
    seen = []
    f = to_torch(lambda u: seen.append(u) or u * 2.0)
    u = tensor(FIELD, False)
    f(u)
    assert np.shares_memory(seen[0], u.numpy()) and not seen[0].flags.writeable
    kept = np.ones(3)
    for g in (lambda u: kept, lambda u: (u, u), lambda u: u.T, lambda u: (anp.sum(u), kept)):
        for moves in (False, True):
            u = tensor(FIELD, moves)
            for y in leaves(to_torch(g)(u)):
                with torch.no_grad():
                    y += 1.0
            assert np.array_equal(u.detach(), FIELD) and np.array_equal(kept, np.ones(3))
    x = tensor(FIELD)
    loss = to_torch(lambda a: a)(x)
    slope = torch.ones(GRID.shape, dtype=torch.float64)
    loss.backward(slope)
    x.grad += 1.0
    assert np.array_equal(slope, np.ones(GRID.shape))  # a gradient of its own, not the cotangent handed on


def test_gradients_share_no_memory():
    a = tensor(FIELD)
    b = tensor(FIELD)
    to_torch(lambda a, b: a + b)(a, b).sum().backward()
    a.grad.zero_()
    assert np.array_equal(b.grad, np.ones(GRID.shape))


@pytest.mark.parametrize("changed", ["argument", "beside", "result"])
def test_a_change_before_the_way_back_is_refused(changed):
    a = tensor(FIELD)
    b = tensor(FIELD + 2, False)
    y = to_torch(lambda a, b: anp.exp(a * b))(a, b)
    with torch.no_grad():
        {"argument": a, "beside": b, "result": y}[changed].mul_(2.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        y.sum().backward()


def test_arrays_beside_tensors_may_be_reused():
    work = np.array([1.0, 2.0])
    a = tensor(np.array([3.0, 4.0]))
    y = to_torch(lambda a, w: a**2 * w)(a, work)
    work[:] = np.nan
    slope = torch.autograd.grad(y.sum(), a, create_graph=True)[0]
    slope.sum().backward()
    assert slope.tolist() == [6.0, 16.0] and a.grad.tolist() == [2.0, 4.0]


def test_layouts_and_kinds():
    u = tensor(numbers(4, 5)).T[:, ::1]
    assert np.array_equal(to_torch(L)(u).detach(), L(u.detach().numpy()))
    turned = to_torch(lambda u: u[::-1])(tensor(FIELD))
    assert np.array_equal(turned.detach(), FIELD[::-1])
    places = torch.tensor([0, 2])
    assert to_torch(lambda u, k: (u[k], k))(tensor(np.arange(4.0)), places)[1].dtype == torch.int64
    assert to_torch(lambda n: n / 2)(torch.tensor([3])).dtype == torch.float64
    assert to_torch(lambda t: t * 2.0)(tensor(1.5)).item() == 3.0
    assert to_torch(lambda: np.ones(2))().tolist() == [1.0, 1.0]


def test_refusals():
    with pytest.raises(TypeError, match="^to_torch takes a function, got int; write dp.interop.to_torch"):
        to_torch(3)
    with pytest.raises(TypeError, match="^to_torch computes on the CPU, got a tensor on meta; write tensor.cpu\\(\\)$"):
        to_torch(L)(torch.ones(GRID.shape, device="meta"))
    for half in (torch.float16, torch.bfloat16):
        with pytest.raises(
            TypeError, match=r"^to_torch takes float32 or float64, got torch.*; write tensor.float\(\)$"
        ):
            to_torch(L)(torch.ones(GRID.shape, dtype=half))
        with pytest.raises(
            TypeError, match=r"^from_torch takes and gives float32 or float64, got torch.*; write tensor.float\(\)$"
        ):
            from_torch(lambda x, half=half: x.to(half))(FIELD)
    with pytest.raises(TypeError, match="result of to_torch must be float32, float64, complex64 or complex128, got"):
        to_torch(lambda x: x.astype(np.longdouble))(torch.ones(2))
    for dtype in (np.float16, np.longdouble):
        with pytest.raises(TypeError, match=r"arguments of from_torch\[0\] must be float32, float64, complex64 or"):
            from_torch(torch.sin)(np.ones(2, dtype))
    net = from_torch(torch.nn.Linear(2, 1).double())
    with pytest.raises(
        dp.errors.ShapeError, match="parameters of from_torch: unknown key 'q'; expected 'weight', 'bias'"
    ):
        net({**net.parameters, "q": np.ones(2)}, np.ones(2))
    with pytest.raises(TypeError, match="^laplacian needs arrays of NumPy, got a Parameter of torch; wrap"):
        L(torch.nn.Parameter(torch.ones(GRID.shape)))
    with pytest.raises(dp.errors.ShapeError, match="laplacian takes a field on cells"):
        to_torch(L)(torch.ones(3))


def test_the_way_back_twice_to_the_same_bits_and_freed():
    f, args = SCENES["rollout"]
    u, p = mapped(tensor, args)
    y = to_torch(f)(u, p).sum()
    first, second = (torch.autograd.grad(y, [u, *p.values()], retain_graph=True) for _ in range(2))
    assert all(map(torch.equal, first, second))


def test_a_tape_is_gone_with_its_graph():
    marks = []

    def vjp(nums, ans, u):
        mark = np.zeros(3)
        marks.append(weakref.ref(mark))
        return lambda g: (g + mark,)

    y = to_torch(dp.differentiable("kept", lambda u: 1.0 * u, vjp))(tensor(numbers(3)))
    y.sum().backward()
    assert marks[0]() is not None
    del y
    assert marks[0]() is None  # at once: there is no cycle


def test_a_bridge_travels():
    twin = pickle.loads(pickle.dumps(to_torch(L)))
    assert torch.equal(twin(torch.tensor(FIELD)), to_torch(L)(torch.tensor(FIELD)))


def test_a_network_learns_through_a_solve():
    torch.manual_seed(0)
    net = torch.nn.Linear(1, 1).double()
    apply = to_torch(INVERSE)
    x = torch.tensor(FIELD)[..., None]
    wanted = apply(3.0 * x[..., 0] - 1.0)
    optimizer = torch.optim.LBFGS(net.parameters(), line_search_fn="strong_wolfe")

    def loss():
        optimizer.zero_grad()
        value = torch.sum((apply(net(x)[..., 0]) - wanted) ** 2)
        value.backward()
        return value

    optimizer.step(loss)
    assert net.weight.item() == pytest.approx(3.0, abs=1e-6) and net.bias.item() == pytest.approx(-1.0, abs=1e-6)


# ---- functions of torch on our tape ----------------------------------------------------------------------------------


def of_torch(x, y):
    return torch.sin(x) * y, {"sum": (x**2).sum(), "last": torch.argmax(x)}


def twin(x, y):
    return anp.sin(x) * y, {"sum": anp.sum(x**2)}


PAIR = numbers(4), numbers(4, seed=1)


def loss_with(g):
    return lambda v: anp.sum(g(*v)[0] ** 2) * g(*v)[1]["sum"]


def test_every_order_of_a_torch_function():
    """Value, gradient, tangent and Hessian product are those of the twin in autograd.numpy."""
    mine = loss_with(from_torch(of_torch))
    theirs = loss_with(twin)
    assert dp.check.gradient(mine, PAIR).verdict == "agrees"
    for act in (dp.grad, lambda f: dp.grad(lambda x: sum(anp.sum(g**2) for g in dp.grad(f)(x)))):
        for found, wanted in zip(act(mine)(PAIR), act(theirs)(PAIR), strict=True):
            assert np.allclose(found, wanted, rtol=1e-12)
    for act in (dp.jvp, dp.hvp):
        pairs = zip(leaves(act(mine, PAIR, PAIR[::-1])), leaves(act(theirs, PAIR, PAIR[::-1])), strict=True)
        assert all(np.allclose(found, wanted, rtol=1e-12) for found, wanted in pairs)
    assert from_torch(of_torch)(*PAIR)[1]["last"] == np.argmax(PAIR[0])


def test_complex_and_single_precision():
    z = numbers(3) + 1j * numbers(3, seed=2)
    wave = from_torch(lambda z: torch.exp(1j * z) * z)
    assert dp.check.gradient(lambda z: anp.sum(anp.abs(wave(z)) ** 2), z).verdict == "agrees"
    value, slope = dp.value_and_grad(lambda u: anp.sum(from_torch(torch.exp)(u)))(numbers(3).astype("f"))
    assert slope.dtype == "f" and from_torch(torch.exp)(1 + np.arange(3, dtype="f")).dtype == "f"


def test_a_module_and_its_parameters():
    torch.manual_seed(0)
    module = torch.nn.Sequential(torch.nn.Linear(2, 3), torch.nn.Tanh(), torch.nn.Linear(3, 1)).double()
    before = [p.detach().numpy().copy() for p in module.parameters()]
    net = from_torch(module)
    x = numbers(5, 2)
    assert list(net.parameters) == ["0.weight", "0.bias", "2.weight", "2.bias"]
    assert np.array_equal(net(net.parameters, x), module(torch.tensor(x)).detach())
    loss = lambda p: anp.sum((net(p, x) - x[:, :1]) ** 2)
    assert dp.check.gradient(loss, net.parameters).verdict == "agrees"
    best = dp.minimize(loss, net.parameters, maxiter=20)
    assert best.value < 0.5 * loss(net.parameters)
    assert all(np.array_equal(p.detach(), was) and p.grad is None for p, was in zip(module.parameters(), before))
    assert np.array_equal(net({}, x), net(net.parameters, x))
    module.load_state_dict({name: torch.tensor(p) for name, p in best.x.items()})
    assert np.array_equal(module(torch.tensor(x)).detach(), net(best.x, x))


def test_a_function_with_random_numbers_runs_once():
    runs = []

    def noisy(x):
        runs.append(1)
        return x**3 * torch.rand(3, dtype=torch.float64)

    f = from_torch(noisy)
    x = np.array([1.0, 2.0, 3.0])
    slope = dp.grad(lambda x: anp.sum(f(x)))
    torch.manual_seed(1)
    draws = torch.rand(3, dtype=torch.float64).numpy()
    torch.manual_seed(1)
    assert np.allclose(dp.grad(lambda x: anp.sum(slope(x)))(x), 6 * x * draws) and len(runs) == 1


def test_constants_may_be_reused_and_results_written_to():
    f = from_torch(lambda a, w: a**2 * w)
    assert gradient_with_a_reused_constant(f).tolist() == [6.0, 12.0]
    own = torch.ones(2)
    from_torch(lambda: own)()[:] = 5.0
    assert own.tolist() == [1.0, 1.0]


def test_arguments_are_not_written_into():
    u = np.array([-1.0, 2.0])
    twice = from_torch(lambda x: x.mul_(2.0))
    assert twice(u).tolist() == [-2.0, 4.0] and u.tolist() == [-1.0, 2.0]
    with pytest.raises(RuntimeError, match="in-place operation"):
        dp.grad(lambda u: anp.sum(twice(u)))(u)


def test_what_does_not_depend_on_the_argument():
    f = from_torch(lambda x: (torch.ones(3, dtype=torch.float64), x[:1]))
    assert dp.grad(lambda x: anp.sum(f(x)[0]) + anp.sum(x))(np.ones(3)).tolist() == [1.0, 1.0, 1.0]


def test_refusals_of_torch_functions():
    with pytest.raises(TypeError, match="^from_torch takes a function, got str; write dp.interop.from_torch"):
        from_torch("net")


@pytest.mark.whole
def test_the_audit_examines_a_function_of_torch():
    """A wrong rule behind it is named: the function is run again at other values."""
    act = from_torch(lambda x: {"a": torch.sin(x), "b": x})
    cube = dp.differentiable("cube", lambda u: u**3, lambda nums, ans, u: lambda g: (3.03 * u**2 * g,))
    found = dp.check.gradient(lambda u: anp.sum(cube(act(u)["a"])), np.linspace(1.0, 2.0, 5), quick=True)
    assert found.culprit == "cube" and "was not examined" not in str(found)


def test_there_and_back():
    """A function of this library as one of torch, as one of this library."""
    f = from_torch(to_torch(lambda k, b: SCENES["elliptic_solver"][0](k, b)))
    loss = lambda k: anp.sum(f(k, FIELD) ** 2)
    direct = lambda k: anp.sum(SCENES["elliptic_solver"][0](k, FIELD) ** 2)
    assert np.allclose(dp.grad(loss)(SIDES), dp.grad(direct)(SIDES), rtol=1e-12)
    assert np.allclose(dp.hvp(loss, SIDES, SIDES), dp.hvp(direct, SIDES, SIDES), rtol=1e-9)


def test_a_second_run_in_another_order():
    """A gradient of the gradient runs the function again, which may then return its dict in another order."""
    calls = []

    def f(x):
        calls.append(None)
        results = {"a": x**2, "b": 10.0 * x**3}
        if len(calls) % 2:
            return results
        return dict(reversed(results.items()))

    x = tensor(np.array([1.0, 2.0]))
    (slope,) = torch.autograd.grad(to_torch(f)(x)["a"].sum(), x, create_graph=True)
    assert len(calls) == 2 and slope.tolist() == [2.0, 4.0]
    assert torch.autograd.grad(slope.sum(), x)[0].tolist() == [2.0, 2.0]
    calls.clear()
    answers = iter([{"a": 1.0, "b": 1.0}, {"a": 1.0, "c": 1.0}])
    loss = to_torch(lambda x: {name: scale * x for name, scale in next(answers).items()})(x)["a"].sum()
    with pytest.raises(
        dp.errors.ShapeError, match="result of to_torch: unknown key 'c'; expected 'a', 'b'; return the"
    ):
        torch.autograd.grad(loss, x, create_graph=True)
