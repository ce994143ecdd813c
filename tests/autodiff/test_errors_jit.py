"""Messages of dp.jit: what it cannot record, functions that are not pure, and many forms of arguments."""

import re
import warnings

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.jit import FORMS_BEFORE_WARNING, opaque
from sparsedp.autodiff.tape import plain

X = np.sin(np.arange(16.0))
Y = np.cos(np.arange(16.0))


def decides(u):
    return u if u[0] > 0 else -u


def converts(u):
    return float(u[0]) * u


def chooses(u):
    return anp.sum(u[u > 0])


def finds(u):
    return anp.sum(u[anp.nonzero(u)])


def indexes_with_a_tuple(u):
    return u[(anp.argmax(u),)]


def hides(u):
    return anp.dot(u, [u[0]] * 16)


def converts_to_an_integer(u):
    return u * anp.int64(u[0])


def works_in_place(u):
    v = anp.sin(u)
    w = v
    v += 1.0
    return anp.sum(w)


def catches(u):
    try:
        return u if u[0] > 0 else -u
    except dp.errors.JitError:
        return 0.0 * u


def reads(u):
    return u * plain(u)[0]


def closes(u):
    square = dp.differentiable("square", lambda x: u * x, lambda nums, ans, x: lambda g: (g * u,))
    return square(2.0 * u)


def hides_in_an_array(u):
    return np.asarray(u) * 2.0 + u


REFUSED = [
    (
        closes,
        "dp.jit cannot record square, which got a traced value by its closure or inside an array of NumPy; pass traced "
        "values as arguments, and write anp.array([...])",
    ),
    (
        hides_in_an_array,
        "dp.jit cannot record add, which got a traced value by its closure or inside an array of NumPy; pass traced "
        "values as arguments, and write anp.array([...])",
    ),
    (
        decides,
        "dp.jit cannot record a decision by a traced value (if, while, and, or); write np.where(condition, a, b), "
        "or call the function without dp.jit",
    ),
    (
        converts,
        "dp.jit cannot record converts: a traced value was refused (float() argument must be a string or a real "
        "number, not 'ArrayBox'); write the function with autograd.numpy, without float(), int(), item() and "
        "u[i] = ...",
    ),
    (
        chooses,
        "dp.jit cannot record a traced mask as an index, because the shape of its result depends on values; "
        "write np.where(condition, a, b)",
    ),
    (
        finds,
        "dp.jit cannot record nonzero, because the shape of its result depends on values; "
        "write np.where(condition, a, b)",
    ),
    (
        indexes_with_a_tuple,
        "dp.jit cannot record indexes_with_a_tuple: a traced value was refused (only integers, slices (`:`), ellipsis "
        "(`...`), numpy.newaxis (`None`) and integer or boolean arrays are valid indices); write the function with "
        "autograd.numpy, without float(), int(), item() and u[i] = ...",
    ),
    (
        hides,
        "dp.jit cannot record dot with a traced value inside a list; write anp.array([...]) around values, and "
        "anp.where for entries chosen by a traced index",
    ),
    (works_in_place, "dp.jit cannot record an operation in place (u += v); write u = u + v"),
    (
        catches,
        "dp.jit cannot record a decision by a traced value (if, while, and, or); write np.where(condition, a, b), "
        "or call the function without dp.jit",
    ),
    (
        converts_to_an_integer,
        "dp.jit cannot convert a traced array by an integer type of NumPy; write u.astype(int)",
    ),
]


@pytest.mark.parametrize(("function", "message"), REFUSED, ids=[function.__name__ for function, _ in REFUSED])
def test_decisions_are_refused(function, message):
    with pytest.raises(dp.errors.JitError, match=re.escape(message)):
        dp.jit(function)(X)


def test_values_are_not_read():
    with pytest.raises(
        dp.errors.JitError,
        match=r"dp.jit cannot record a decision by the values of a traced array \(reads in .*\); "
        r"call the function without dp.jit",
    ):
        dp.jit(reads)(X)


def test_tangents_of_calls_that_decide():
    twice = opaque(lambda u: 2.0 * u)
    message = "dp.jit cannot record tangents and second derivatives of <lambda>; call the function without dp.jit"
    with pytest.raises(dp.errors.JitError, match=message):
        dp.jit(lambda u: dp.jvp(twice, u, u)[1])(X)


def test_counts_of_calls_that_decide():
    """The count is a constant of the program, which must not become stale."""

    @opaque
    def halved(u):
        n = 0
        while np.max(np.abs(plain(u))) > 1.0:
            u = 0.5 * u
            n += 1
        return u, n

    jitted = dp.jit(lambda u: halved(u)[0] * halved(u)[1], check=False)
    assert jitted(3.0 * X)[1] == 2 * 0.75 * X[1]
    assert jitted(3.1 * X)[1] == pytest.approx(2 * 0.775 * X[1])
    message = (
        "halved returned a leaf that is not floating and differs from that of the recording; "
        "call the function without dp.jit"
    )
    with pytest.raises(dp.errors.JitError, match=message):
        jitted(9.0 * X)


@pytest.mark.parametrize("function", [lambda u, p: p * u, lambda u, p: p, lambda u, p: anp.sin(p) + 0.0 * u])
def test_values_of_outer_traces(function):
    message = (
        "dp.jit cannot record a function that uses a traced value which is not one of its arguments; pass it as an "
        "argument"
    )
    with pytest.raises(dp.errors.JitError, match=message):
        dp.grad(lambda p: anp.sum(dp.jit(lambda u: function(u, p))(X)))(2.0)


def test_lengths_of_steps_are_not_read():
    step = dp.stepper("rk4", lambda u, p: -p * u**2, 2.0, tolerance=1e-5)
    jitted = dp.jit(lambda u, p: (step(u, p), len(step.taken)))
    message = (
        "dp.jit cannot record taken of stepper(rk4), which differs from call to call and is not traced; read it "
        "outside of the jitted function"
    )
    with pytest.raises(dp.errors.JitError, match=re.escape(message)):
        jitted(X**2, 1.0)
    dp.jit(step)(X**2, 1.0)
    assert len(step.taken) > 1


def test_integers_have_no_derivative():
    message = "Can't differentiate w.r.t. type <class 'numpy.int64'>"
    with pytest.raises(TypeError, match=re.escape(message)):
        dp.grad(lambda u: anp.sum(u.astype(int)))(X)


def test_a_function_that_is_not_pure_is_named():
    rng = np.random.default_rng(0)

    def noisy(u):
        return u + rng.random()

    jitted = dp.jit(noisy)
    jitted(X)
    message = (
        "the program of noisy differs from the function in result 0: the function uses something that has changed, or "
        "random numbers, or values of traced arrays; pass what changes as an argument"
    )
    with pytest.raises(dp.errors.JitError, match=message):
        jitted(Y)
    with pytest.raises(dp.errors.JitError, match=message):
        jitted(Y + 1.0)  # again, as long as they differ
    gradient = dp.value_and_grad(dp.jit(lambda u: anp.sum(noisy(u) ** 2)))
    pull = dp.jit(noisy)
    dp.vjp(pull, X)
    for x in (Y, Y + 1.0):
        with pytest.raises(dp.errors.JitError, match="the program of .*noisy differs from the function in result 0"):
            dp.vjp(pull, x)
    gradient(X)
    with pytest.raises(
        dp.errors.JitError, match=r"the program of value_and_grad\(<lambda>\) differs from the function"
    ):
        gradient(Y)
    unchecked = dp.jit(noisy, check=False)
    assert unchecked(X)[0] - X[0] == pytest.approx(unchecked(Y)[0] - Y[0])


def test_many_forms_are_reported():
    jitted = dp.jit(lambda u, n: n * u)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for n in range(FORMS_BEFORE_WARNING):
            jitted(X, n)
    message = (
        "dp.jit recorded <lambda> for 8 forms of its arguments, and args[1] changes: now 8; pass it as a floating "
        "number, or leave out dp.jit"
    )
    with pytest.warns(dp.errors.JitWarning, match=re.escape(message)):
        jitted(X, FORMS_BEFORE_WARNING)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert jitted(X, 100)[1] == 100 * X[1]


def test_a_function_is_needed():
    with pytest.raises(TypeError, match="jit takes a function, got int; write lambda x: ..."):
        dp.jit(3)
