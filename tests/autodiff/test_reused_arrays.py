"""A caller may write into an array at once after a call: values and derivatives of all orders are the same as with
copies.

Every differentiable callable is called in a loop with constants in one array that is filled anew for each call, and
with NaN at the end; the same loop with a fresh copy for each call is the reference, to the last bit.
"""

import threading
import warnings

import autograd
import autograd.numpy as anp
import numpy as np
import pytest
import scipy.sparse as sp
from differentiable_cases import CALLS, CASES, CONSTANT, LINE, PLACES, entries, field

import sparsedp as dp
from sparsedp._utils.pytree import flatten, leaves
from sparsedp.autodiff.derivative import pullback, pushforward
from sparsedp.autodiff.tape_constants import constant
from sparsedp.errors import DerivativeError

# One array and no other, so that nothing beside it is kept; or nothing to differentiate; or tested where it stands.
ALONE = """
animate average certified certify check component convergence curl diagonal dirichlet divergence errors explain
face_laplacian flux face_lift free_slip from_blackbox from_functions from_linear_operator from_matrix grad
continuation free_faces
gradient harmonic_average hvp identity inflow interior jit jvp laplace laplacian lift mask matrix_exponential
matched_layer matrix_function matrix_power minimize neumann no_slip Operator outflow
patch physical_gradient plot projection prolong report restrict robin sample set_threads smoothness stress
brinkman cut_cells cut_flow distribute equal flatten gather interop total_variation update_direction upwind v_curve
value_and_grad vjp work_precision eigenpairs from_image load save testing
""".split()


def test_every_public_name_is_looked_at():
    named = {name for _, names in CASES.values() for name in names}
    assert named | set(ALONE) == set(dp.__all__) and not named & set(ALONE)


# ---- one array for all calls, against a copy for each ---------------------------------------------------------------


def total(fun, makers, place, reused, x):
    """The sum of weighted results of CALLS calls, x at one place, constants elsewhere."""
    rooms = {}
    result = 0.0
    for seed in range(CALLS):
        args = []
        for number, make in enumerate(makers):
            value = make(10 * number + seed + 1)
            if number == place:
                args.append(x)
                continue
            if reused:
                room = rooms.setdefault(number, flatten(value)[1](np.empty_like(leaf) for leaf in leaves(value)))
                for target, source in zip(leaves(room), leaves(value), strict=True):
                    target[...] = source
                value = room
            args.append(value)
        y = fun(*args)
        result = result + anp.sum(field(np.shape(autograd.tracer.getval(y)), seed) * y)
    for room in rooms.values():
        for target in leaves(room):
            target[...] = np.nan if target.dtype.kind == "f" else 0
    return result


def second_reverse(loss, x, v):
    def slope(x):
        pairs = zip(leaves(dp.value_and_grad(loss)(x)[1]), leaves(v), strict=True)
        return sum(anp.sum(g * t) for g, t in pairs)

    return dp.value_and_grad(slope)(x)


def second_forward(loss, x, v):
    return pushforward(lambda x: dp.value_and_grad(loss)(x)[1], x, v)


def second_mixed(loss, x, v):
    return dp.value_and_grad(lambda x: pushforward(loss, x, v)[1])(x)


WAYS = {
    "gradient": lambda loss, x, v: dp.value_and_grad(loss)(x),
    "tangent": pushforward,
    "reverse over reverse": second_reverse,
    "forward over reverse": second_forward,
    "reverse over forward": second_mixed,
}


def answer(way, loss, x, v):
    """What a way of differentiating gives, or the name of its error: some rules have no second derivative."""
    try:
        return way(loss, x, v)
    except (DerivativeError, NotImplementedError) as error:
        return type(error).__name__


def places():
    for name, (make, _) in CASES.items():
        for number, maker in enumerate(make()[1]):
            if all(np.asarray(leaf).dtype.kind == "f" for leaf in leaves(maker(1))) and (name, number) not in CONSTANT:
                yield pytest.param(name, number, id=f"{name}-{number}")


@pytest.mark.parametrize(("name", "place"), list(places()))
def test_one_array_for_all_calls(name, place):
    same_as_fresh(name, place, "gradient")


def other_ways():
    """Two ways for each place, which alternate: each occurs in half of all places."""
    ways = [way for way in WAYS if way != "gradient"]
    for number, case in enumerate(places()):
        for way in ways[number % 2 :: 2]:
            yield pytest.param(*case.values, way, id=f"{case.id}-{way}")


@pytest.mark.whole
@pytest.mark.parametrize(("name", "place", "way"), list(other_ways()))
def test_one_array_for_all_calls_in_other_derivatives(name, place, way):
    same_as_fresh(name, place, way)


def same_as_fresh(name, place, way):
    x = CASES[name][0]()[1][place](0)
    v = flatten(x)[1](field(np.shape(leaf), 77) for leaf in leaves(x))
    fresh, reused = (
        answer(WAYS[way], lambda x, r=reused: total(*CASES[name][0](), place, r, x), x, v) for reused in (False, True)
    )
    # Only radau and some schemes of transport have no second derivative.
    without = name.startswith("transport_") or name == "stepper_radau"
    assert not isinstance(fresh, str) or (without and way not in ("gradient", "tangent"))
    for one, other in zip(leaves(fresh), leaves(reused), strict=True):
        assert np.array_equal(one, other)


@pytest.mark.parametrize(
    ("name", "place"),
    [("matrix_solver", 1), ("implicit", 2), ("stepper_crank_nicolson", 0), ("stepper_imex", 0), ("convection", 0)],
)
def test_differences_agree(name, place):
    """Independent of any tape: a difference of values."""
    fun, makers = CASES[name][0]()
    x = makers[place](0)
    v = field(x.shape, 77)
    slope = np.sum(v * dp.value_and_grad(lambda x: total(fun, makers, place, True, x))(x)[1])
    ahead, behind = (total(fun, makers, place, True, x + h * v) for h in (1e-5, -1e-5))
    assert slope == pytest.approx((ahead - behind) / 2e-5, rel=1e-7)


def test_a_solve_by_hand():
    """y_n = A_n^-1 ... A_1^-1 y, dense: the gradient of w.y_n is A_1^-T ... A_n^-T w."""
    solve = dp.matrix_solver(PLACES)
    work = np.empty(16)
    w = field(6, 5)

    def loss(y):
        for seed in range(4):
            work[:] = entries(seed)
            y = solve(work, y)
        return anp.sum(w * y)

    expected = w
    for seed in reversed(range(4)):
        A = sp.csr_array((entries(seed), PLACES.indices, PLACES.indptr)).toarray()
        expected = np.linalg.solve(A.T, expected)
    found = dp.value_and_grad(loss)(field(6, 9))[1]
    assert np.max(np.abs(found - expected)) <= 1e-13 * np.max(np.abs(expected))


# ---- what else can change under a pullback ---------------------------------------------------------------------------


@pytest.mark.parametrize("size", [4, 20000])
def test_views_of_what_is_written_into(size):
    """A read-only view of a writeable array changes with it; rows of one array are apart."""
    base = np.ones((2, size))
    view = base.view()
    view.flags.writeable = False
    product = dp.differentiable("product", lambda x, w: x * w, lambda nums, ans, x, w: lambda g: (g * w,))

    def loss(x):
        y = product(x, view[0]) + x * view[1] + product(x, base[0]) * base[1, ::-1]
        base[:] = 7.0
        y = y + x * view[1]
        base[:] = np.nan
        return anp.sum(y)

    assert np.array_equal(dp.value_and_grad(loss)(np.ones(size))[1], np.full(size, 1.0 + 1.0 + 1.0 + 7.0))


def test_what_cannot_change_is_not_copied():
    fixed = field(20000, 1)
    fixed.flags.writeable = False
    assert constant(fixed) is fixed and constant(fixed[3:]).base is fixed
    work = field(20000, 2)
    first = constant(work)
    again = constant(work)
    assert first is again and first is not work and not first.flags.writeable
    work[-1] = 0.0
    assert constant(work) is not first and first[-1] != 0.0
    work[-1] = -0.0
    kept = constant(work)
    work[-1] = 0.0
    assert np.signbit(kept[-1]) and not np.signbit(constant(work)[-1])
    for kind in (complex, np.float32, np.int16, np.longdouble, "U3"):
        work = np.ones((3, 9000)).astype(kind)[:, ::2]
        kept = constant(work)
        assert kept.dtype == work.dtype and np.array_equal(kept, work) and not np.shares_memory(kept, work)
        work[-1, -1] = 0
        assert kept[-1, -1] != work[-1, -1] and np.array_equal(constant(work), work)


def test_copies_live_as_long_as_their_tape():
    from sparsedp.autodiff.tape_constants import copies

    before = len(copies)
    work = field(20000, 1)
    value, pull = pullback(lambda x: work * x * work, np.ones(20000))
    assert len(copies) == before + 1
    del value, pull
    assert len(copies) == before


@pytest.mark.parametrize("size", [4, 20000])
def test_the_array_that_is_differentiated(size):
    """The caller writes into x, into the value and into the cotangent, and into one gradient of two."""
    x = np.full(size, 2.0)
    g = np.full(size, 3.0)
    value, pull = pullback(lambda x: anp.exp(x) * x, x)
    expected = 3.0 * np.exp(2.0) * 3.0
    x[:], value[:] = 0.0, 0.0
    back = pull(g)
    assert np.allclose(back, expected, rtol=1e-14)
    value, pull = pullback(lambda pair: pair[0] + pair[1][::-1], (x, np.ones(size)))
    first, second = pull(g)
    g[:] = 0.0
    first[:] = 1.0
    assert np.all(second == 3.0)
    reused = np.zeros(3)
    _, pull = pullback(lambda x: x + 1.0, np.ones(3))
    rows = []
    for n in range(3):
        reused[:] = 0.0
        reused[n] = 1.0
        rows.append(pull(reused))
    assert np.array_equal(rows, np.eye(3))


@pytest.mark.parametrize("size", [4, 20000])
def test_a_loss_that_writes_into_what_it_was_given(size):
    x = np.full(size, 2.0)

    def loss(u):
        y = u**3
        x[:] = 0.0
        return anp.sum(y)

    assert np.all(dp.value_and_grad(loss)(x)[1] == 12.0)


@pytest.mark.parametrize("form", ["array", "row", "part"])
def test_a_rule_that_writes_into_its_own_result(form):
    """The normal form of foreign code: one buffer for the results of all calls."""
    room = np.empty((2, 4))
    buffer = {"array": room[0].copy(), "row": room[1], "part": room.reshape(-1)[2:6]}[form]

    def forward(x):
        np.multiply(x, x, out=buffer)
        if form == "array":
            return buffer
        return buffer[:]

    square = dp.differentiable("square", forward, lambda nums, ans, x: lambda g: (2 * x * g,))
    x = field(4, 1)
    value, slope = dp.value_and_grad(lambda x: anp.sum(square(square(x)) * square(x)))(x)
    assert value == pytest.approx(np.sum(x**6), rel=1e-14)
    assert np.allclose(slope, 6 * x**5, rtol=1e-14)
    same = dp.differentiable("same", lambda x: x, lambda nums, ans, x: lambda g: (g,))
    assert np.array_equal(same(x), x)


def test_tapes_of_autograd_itself():
    """Rules keep their constants on the tape of autograd.grad too."""
    solve = dp.matrix_solver(PLACES)
    work = entries(1)

    def loss(b):
        y = solve(work, b)
        work[:] = np.nan
        return anp.sum(y)

    found = autograd.grad(loss)(np.ones(6))
    A = sp.csr_array((entries(1), PLACES.indices, PLACES.indptr)).toarray()
    assert np.allclose(found, np.linalg.solve(A.T, np.ones(6)), rtol=1e-12)


def test_threads_share_nothing_but_content():
    """Eight losses at once over one large constant that each changes to its own."""
    product = dp.differentiable("product", lambda x, w: x * w, lambda nums, ans, x, w: lambda g: (g * w,))
    wrong = []

    def run(number):
        work = np.empty(20000)

        def loss(x):
            for turn in range(20):
                work[:] = 1.0 + (number + turn) % 3
                x = product(x, work)
            return anp.sum(x)

        expected = np.prod([1.0 + (number + turn) % 3 for turn in range(20)])
        if not np.all(dp.value_and_grad(loss)(np.ones(20000))[1] == expected):
            wrong.append(number)

    threads = [threading.Thread(target=run, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


# ---- steps that hold an array ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("memory", [None, 500, "1 MB"])
@pytest.mark.parametrize("when", ["inside", "after"])
def test_a_step_whose_own_array_changes(memory, when):
    """In a rollout: the gradient of what was computed, or an error that says that the step changed."""
    work = np.ones(6)
    w = field(6, 3)

    def step(u, p):
        if when == "inside":
            work[:] = 1.0 + 0.1 * work
        return u + 0.1 * p * work * u**2

    def loss(p):
        work[:] = 1.0
        u = dp.rollout(step, w, p, 8, memory=memory)
        if when == "after":
            work[:] = 3.0
        return anp.sum(u)

    def difference(p, h=1e-5):
        v = field(6, 4)
        return (loss(p + h * v) - loss(p - h * v)) / (2 * h), v

    p = field(6, 2)
    expected, v = difference(p)
    try:
        found = np.sum(v * dp.value_and_grad(loss)(p)[1])
    except DerivativeError as error:
        assert "when it is run again" in str(error)
    else:
        assert found == pytest.approx(expected, rel=1e-7)


# ---- kept and returned arrays ------------------------------------------------------------------------------------


def test_set_ups_own_their_coefficients():
    """What is kept by content must not change with the array that it was made for."""
    solve = dp.matrix_solver(PLACES, method="krylov")
    work = entries(1)
    b = np.ones(6)
    expected = solve(work.copy(), b)
    fresh = dp.matrix_solver(PLACES, method="krylov")
    fresh(work, b)
    work[:] = entries(2)
    assert np.array_equal(fresh(entries(1), b), expected)
    elliptic = dp.elliptic_solver(dp.divergence(LINE), dp.gradient(LINE, dp.dirichlet))
    k = field(7, 1)
    expected = dp.elliptic_solver(dp.divergence(LINE), dp.gradient(LINE, dp.dirichlet))(k.copy(), b)
    elliptic(k, b)
    k[:] = 2.0
    assert np.array_equal(elliptic(field(7, 1), b), expected)


@pytest.mark.parametrize("method", ["lbfgs", "gd", "adam", "newton_cg"])
def test_minimize_hands_out_copies(method):
    options = {"rate": 0.1} if method in ("gd", "adam") else {}
    start = np.full(3, 2.0)
    lower = np.full(3, 0.5)
    options["bounds"] = lower, None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        known = []
        seen = []
        best = dp.minimize(
            lambda x: anp.sum((x - 0.3) ** 4), start, method, 4, callback=lambda r, x: known.append(x.copy()), **options
        )

        def spoil(record, x):
            seen.append(x.copy())
            x[:] = np.nan
            start[:] = lower[:] = np.nan

        again = dp.minimize(lambda x: anp.sum((x - 0.3) ** 4), start, method, 4, callback=spoil, **options)
    assert np.array_equal(best.x, again.x) and np.array_equal(known, seen)
