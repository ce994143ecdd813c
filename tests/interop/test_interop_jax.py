"""JAX: functions of this library under jit, grad and vmap and its check_grads, and functions of JAX on our tape."""

import pickle
from collections import OrderedDict

import autograd.numpy as anp
import numpy as np
import pytest
from bridged import FIELD, GRID, INVERSE, SCENES, SIDES, L, gradient_with_a_reused_constant, numbers

import sparsedp as dp
from sparsedp._utils.pytree import leaves

jax = pytest.importorskip("jax", reason="jax is not installed: the extra `jax`")
jnp = jax.numpy
to_jax = dp.interop.to_jax
from_jax = dp.interop.from_jax


@pytest.fixture
def doubles():
    with jax.enable_x64(True):
        yield


def close(found, wanted, rtol=1e-12):
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True)
    return all(np.allclose(one, other, rtol=rtol, atol=1e-300) for one, other in pairs)


# ---- functions of this library for JAX -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENES)
def test_check_grads(name, doubles):
    """JAX's own test, of first and of second order, of all arguments, traced by jit and not."""
    from jax.test_util import check_grads

    f, args = SCENES[name]
    g = to_jax(f, like=f(*args))
    assert close(g(*args), f(*args), 0) and close(jax.jit(g)(*args), f(*args), 0)
    assert jax.tree.structure(jax.jit(g)(*args)) == jax.tree.structure(f(*args))
    check_grads(jax.jit(g), args, 2, modes=["rev"])
    check_grads(g, args, 1, modes=["rev"])


@pytest.mark.parametrize("jit", [lambda f: f, jax.jit], ids=["at once", "jit"])
def test_vmap_of_a_gradient(jit, doubles):
    f, (u, p) = SCENES["rollout"]
    loss = lambda u, p: jnp.sum(to_jax(f, u)(u, p) ** 2)
    many = np.stack([u, 2 * u, u + 1])
    found = jit(jax.vmap(jax.value_and_grad(loss, argnums=(0, 1)), (0, None)))(many, p)
    ours = dp.value_and_grad(lambda x: anp.sum(f(*x) ** 2))
    for k, one in enumerate(many):
        assert close(jax.tree.map(lambda leaf, k=k: leaf[k], found), ours((one, p)))
    assert close(jit(jax.vmap(to_jax(L)))(many), L(many))


def test_third_derivatives(doubles):
    cube = to_jax(lambda x: anp.sum(x**3))
    x = np.array([1.0, 2.0, 3.0])
    assert close(jax.jacrev(jax.grad(cube))(x), np.diag(6 * x))
    assert close(jax.jit(jax.jacrev(jax.jacrev(jax.grad(cube))))(x), third(x))


def third(x):
    """The third derivatives of the sum of cubes."""
    places = np.arange(x.size)
    found = np.zeros((x.size,) * 3)
    found[places, places, places] = 6.0
    return found


def test_dtypes_follow_jax():
    """float32 by default, in the values that come back from float64 too."""
    u = jnp.asarray(FIELD)
    for g in (to_jax(INVERSE), to_jax(INVERSE, like=np.zeros(GRID.shape)), to_jax(lambda u: INVERSE(u.astype(float)))):
        for jit in (lambda f: f, jax.jit):
            slope = jit(jax.grad(lambda u, g=g: jnp.sum(g(u))))(u)
            assert jit(g)(u).dtype == slope.dtype == jnp.float32
            assert np.allclose(slope, INVERSE.T(np.ones(GRID.shape)), rtol=1e-6)
    with jax.enable_x64(True):
        assert jax.jit(to_jax(INVERSE))(FIELD).dtype == jnp.float64


def test_only_what_is_asked_for_is_differentiated(doubles):
    made = []

    def vjp(nums, ans, a, b):
        made.append(nums)
        return lambda g: tuple(g * (b, a)[num] for num in nums)

    product = to_jax(dp.differentiable("product", lambda a, b: a * b, vjp))
    for jit in (lambda f: f, jax.jit):
        slope = jit(jax.grad(lambda a, b: jnp.sum(product(a, b))))(FIELD, FIELD + 1)
        assert close(slope, FIELD + 1)
    assert made == [(0,), (0,)]
    results = to_jax(lambda a, k: {"cut": anp.exp(a), "square": a[k] ** 2, "places": k})
    used = lambda a: jnp.sum(results(a, np.array([0, 2]))["square"])
    for jit in (lambda f: f, jax.jit):
        assert close(jit(jax.grad(used))(np.arange(3.0)), np.array([0, 0, 4]))


def test_large_arrays_pass_through_jit():
    """A call back that waits for its own arguments would never end."""
    twice = jax.jit(jax.value_and_grad(lambda x: jnp.sum(to_jax(lambda x: 2.0 * x, x)(x))))
    x = jnp.ones(2_000_000)
    for _ in range(3):
        value, slope = twice(x)
    assert value == 4e6 and slope.shape == x.shape and float(slope[-1]) == 2.0


def test_memory_is_not_shared():
    kept = np.ones(3)
    y = to_jax(lambda x: kept)(1.0)
    kept[:] = 5.0
    assert y.tolist() == [1.0, 1.0, 1.0]


def test_shapes_are_learned_once_for_each_set():
    seen = []
    g = to_jax(lambda u: seen.append(u.shape) or 2.0 * u)
    for n in (3, 3, 4):
        jax.eval_shape(g, jax.ShapeDtypeStruct((n,), np.float32))
    assert seen == [(3,), (4,)]
    del seen[:]
    jax.eval_shape(to_jax(g, like=np.zeros(3)), jax.ShapeDtypeStruct((3,), np.float32))
    assert not seen


def test_refusals():
    with pytest.raises(TypeError, match="^to_jax takes a function, got int; write dp.interop.to_jax"):
        to_jax(3)
    picky = to_jax(lambda u: dp.transport(GRID)(u, np.full(GRID.faces.size, 9.0), 1.0))
    with pytest.raises(
        TypeError,
        match=r"^to_jax learns the shape of a result by one run with ones, which this function does not take \(.*\); "
        "give like, arrays of the shapes of the result",
    ):
        jax.jit(picky)(jnp.ones(GRID.shape))
    with pytest.raises(dp.errors.UnstableStepError):
        picky(jnp.ones(GRID.shape))  # at once: the error as it is
    with pytest.raises(Exception, match="UnstableStepError"):
        jax.jit(to_jax(picky, np.ones(GRID.shape)))(jnp.ones(GRID.shape)).block_until_ready()
    with pytest.raises(Exception, match=r"result of to_jax: expected shape \(3,\), as like has it, got \(5, 4\)"):
        jax.jit(to_jax(L, np.zeros(3)))(jnp.ones(GRID.shape)).block_until_ready()
    for like, words in (
        (
            {"p": 1.0, "q": 1.0},
            r"result of to_jax: expected the entries \['p'\], \['q'\], got \['a'\], \['b'\]; return the",
        ),
        ({"a": 1.0}, r"result of to_jax: expected the entries \['a'\], got \['a'\], \['b'\]; return the same"),
        ((1.0, 1.0), r"result of to_jax: expected the entries \[0\], \[1\], got \['a'\], \['b'\]"),
        (
            {"a": np.ones(2), "b": np.ones(3)},
            r"result of to_jax\['b'\]: expected shape \(3,\), as like has it, got \(2,\)",
        ),
    ):
        with pytest.raises(dp.errors.ShapeError, match=words):
            to_jax(lambda x: {"a": x, "b": x}, like)(jnp.ones(2))
    with pytest.raises(
        dp.errors.ShapeError,
        match=r"result of to_jax: expected the entries \['a'\], got \['a'\], \['b'\]; return the same each time",
    ):
        to_jax(lambda x: {"a": x, "b": x}, {"a": 1.0})(jnp.ones(2))
    for dtype in (jnp.float16, jnp.bfloat16):
        with pytest.raises(TypeError, match="an argument of to_jax must be float32, float64, complex64 or complex128"):
            to_jax(L)(jnp.ones(GRID.shape, dtype))
        with pytest.raises(TypeError, match="a result of another library must be float32, float64, complex64"):
            from_jax(lambda x: x.astype(dtype))(FIELD)
    with pytest.raises(TypeError, match="result of to_jax must be float32, float64, complex64 or complex128, got"):
        to_jax(lambda x: x.astype(np.longdouble))(jnp.ones(2))
    with pytest.raises(
        TypeError, match="an argument of from_jax must be float32, float64, complex64 or complex128, got"
    ):
        from_jax(jnp.sin)(np.ones(2, np.longdouble))
    with pytest.raises(TypeError, match="forward-mode"):
        jax.jvp(to_jax(L), (jnp.ones(GRID.shape),), (jnp.ones(GRID.shape),))
    with pytest.raises(TypeError, match="^laplacian needs arrays of NumPy, got a ArrayImpl of jax; wrap"):
        L(jnp.ones(GRID.shape))
    with pytest.raises(TypeError, match="needs arrays of NumPy, got a .*Tracer of jax; wrap what is computed in"):
        jax.grad(lambda u: jnp.sum(INVERSE(u)))(jnp.ones(GRID.shape))


def test_a_bridge_travels():
    twin = pickle.loads(pickle.dumps(to_jax(L, FIELD)))
    assert close(twin(FIELD), to_jax(L)(FIELD))


# ---- functions of JAX on our tape ------------------------------------------------------------------------------------


def of_jax(x, p):
    return {"y": jnp.sin(x) * p["k"], "more": (jnp.sum(x**2), jnp.argmax(x))}


def twin(x, p):
    return {"y": anp.sin(x) * p["k"], "more": (anp.sum(x**2), 0)}


PAIR = numbers(4), {"k": numbers(4, seed=1)}


def loss_with(g):
    return lambda v: anp.sum(g(*v)["y"] ** 2) * g(*v)["more"][0]


def test_every_order_of_a_jax_function():
    """Value, gradient, tangent and Hessian products are those of the twin in autograd.numpy."""
    mine = loss_with(from_jax(of_jax))
    theirs = loss_with(twin)
    assert dp.check.gradient(mine, PAIR).verdict == "agrees"
    squared = lambda f: lambda x: sum(anp.sum(g**2) for g in leaves(dp.grad(f)(x)))
    for act in (dp.grad, lambda f: dp.grad(squared(f))):
        assert close(act(mine)(PAIR), act(theirs)(PAIR))
    for act in (dp.jvp, dp.hvp, lambda f, x, t: dp.grad(lambda x: dp.jvp(f, x, t)[1])(x)):
        assert close(act(mine, PAIR, PAIR), act(theirs, PAIR, PAIR))
    assert from_jax(of_jax)(*PAIR)["more"][1] == np.argmax(PAIR[0])


def test_float64_in_float64_out():
    """Whatever JAX is set to; and float32 stays float32."""
    assert not jax.config.jax_enable_x64
    f = from_jax(lambda x: jnp.exp(x) * jnp.float32(1.0))
    for kind in ("d", "f"):
        x = numbers(3).astype(kind)
        value, slope = dp.value_and_grad(lambda x: anp.sum(f(x)))(x)
        assert f(x).dtype == slope.dtype == kind
        assert np.allclose(slope, np.exp(x), rtol=4 * np.finfo(kind).eps)
    assert not jax.config.jax_enable_x64
    z = numbers(3) + 1j * numbers(3, seed=2)
    wave = from_jax(lambda z: jnp.exp(1j * z) * z)
    assert dp.check.gradient(lambda z: anp.sum(anp.abs(wave(z)) ** 2), z).verdict == "agrees"


def test_constants_may_be_reused_and_results_written_to():
    f = from_jax(lambda a, w: a**2 * w)
    assert gradient_with_a_reused_constant(f).tolist() == [6.0, 12.0]
    f(np.ones(2), np.ones(2))[:] = 0.0


def test_forward_mode_is_refused_and_the_hessian_is_reverse_over_reverse(doubles):
    cube = to_jax(lambda u: anp.sum(u**3))
    x = jnp.arange(1.0, 4.0)
    assert close(jax.jacrev(jax.grad(cube))(x), jnp.diag(6.0 * x))
    for forward in (
        jax.hessian(cube),
        jax.jacfwd(cube),
        lambda x: jax.jvp(cube, (x,), (x,)),
        jax.jit(jax.hessian(cube)),
    ):
        with pytest.raises(
            dp.errors.DerivativeError,
            match=r"a function of to_jax has reverse-mode derivatives only, and jax.hessian, jax.jacfwd and "
            r"jax.jvp ask for forward-mode ones; write jax.jacrev\(jax.grad\(f\)\) for the Hessian, jax.jacrev\(f\) "
            "for the Jacobian, or dp.jvp and dp.hvp with arrays of NumPy",
        ):
            forward(x)


def test_errors_of_type_of_the_function_itself_are_left_alone():
    def refuse(u):
        if np.all(u == 1.0):
            return u
        raise TypeError("only ones")

    with pytest.raises(TypeError, match="only ones"):
        to_jax(refuse)(jnp.arange(3.0))


def test_refusals_of_jax_functions():
    with pytest.raises(TypeError, match="^from_jax takes a function, got str; write dp.interop.from_jax"):
        from_jax("net")


def test_the_audit_examines_a_function_of_jax():
    """A wrong rule behind it is named: the function is run again at other values."""
    act = from_jax(lambda x: {"a": jnp.sin(x), "b": x})
    cube = dp.differentiable("cube", lambda u: u**3, lambda nums, ans, u: lambda g: (3.03 * u**2 * g,))
    found = dp.check.gradient(lambda u: anp.sum(cube(act(u)["a"])), np.linspace(1.0, 2.0, 5), quick=True)
    assert found.culprit == "cube" and "was not examined" not in str(found)


def test_there_and_back():
    """A function of this library as one of JAX, as one of this library."""
    solve, _ = SCENES["elliptic_solver"]
    f = from_jax(to_jax(solve, FIELD))
    loss, direct = (lambda k, f=f: anp.sum(f(k, FIELD) ** 2) for f in (f, solve))
    assert close(dp.grad(loss)(SIDES), dp.grad(direct)(SIDES))
    slope = lambda f: dp.grad(lambda k: anp.sum(dp.grad(f)(k) ** 2))(SIDES)
    assert close(slope(loss), slope(direct), 1e-9)


# ---- results in another order ----------------------------------------------------------------------------------------


def in_turn(function):
    """The function, which returns an ordered dict in another order each time."""
    calls = []

    def turned(x):
        calls.append(None)
        entries = [*function(x).items()]
        return OrderedDict(entries if len(calls) % 2 else entries[::-1])

    return turned


def powers(x):
    return {"a": x**2, "b": 10.0 * x**3}


def test_results_are_paired_by_key():
    """JAX keeps the order of an OrderedDict, so that one run may differ from the next."""
    x = jnp.array([1.0, 2.0])
    for f in (to_jax(in_turn(powers)), to_jax(in_turn(powers), OrderedDict(b=np.ones(2), a=np.ones(2)))):
        for call in (f, f, jax.jit(f), jax.jit(f)):
            result = call(x)
            assert result["a"].tolist() == [1.0, 4.0] and result["b"].tolist() == [10.0, 80.0]
            assert jax.grad(lambda x, call=call: jnp.sum(call(x)["a"]))(x).tolist() == [2.0, 4.0]
    f = from_jax(in_turn(powers))
    assert dp.grad(lambda x: anp.sum(f(x)["a"]))(np.array([1.0, 2.0])).tolist() == [2.0, 4.0]
    assert dp.hvp(lambda x: anp.sum(f(x)["a"]), np.array([1.0, 2.0]), np.ones(2)).tolist() == [2.0, 2.0]


def test_the_form_of_a_result_may_depend_on_shapes():
    def f(x):
        if x.size == 2:
            return OrderedDict(a=x**2, b=x)
        return OrderedDict(b=x, a=x**2)

    for bridged, kind in ((from_jax(f), np.arange), (to_jax(f), jnp.arange)):
        for size in (2, 3, 2):
            x = 1.0 + kind(size)
            assert close(bridged(x), f(x)) and [*bridged(x)] == [*f(x)]
