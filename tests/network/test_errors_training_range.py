"""The warning for inputs of a network that leave the range of training."""

import copy
import pickle
import warnings

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp

training_range = dp.network.training_range
SEEN = np.array([[0.0, 10.0], [1.0, 30.0]])
TABLE = [
    (
        lambda: training_range(SEEN, margin=-1.0),
        ValueError,
        "margin of training_range must be >= 0, got -1; the default is 0.1",
    ),
    (
        lambda: training_range(SEEN, axis=1),
        ValueError,
        "axis of training_range must be a negative integer, got 1; write -1 for the last axis",
    ),
    (
        lambda: training_range(np.ones(3), axis=-2),
        dp.errors.ShapeError,
        "training_range needs inputs with axis -2, got shape (3,)",
    ),
    (
        lambda: training_range(np.ones((3, 0)), axis=-1),
        dp.errors.ShapeError,
        "training_range needs inputs with values, got shape (3, 0)",
    ),
    (
        lambda: training_range(np.array([1.0 + 2.0j])),
        TypeError,
        "inputs of training_range must hold real numbers, got dtype complex128",
    ),
    (
        lambda: training_range(["a", "b"]),
        TypeError,
        "inputs of training_range must hold real numbers, got dtype <U1",
    ),
    (
        lambda: training_range(np.ma.array([1.0, 2.0], mask=[False, True])),
        TypeError,
        "training_range takes plain arrays, got a masked array; fill it first",
    ),
    (
        lambda: training_range(SEEN).outside(np.array([1.0 + 2.0j])),
        TypeError,
        "x of training_range must hold real numbers, got dtype complex128",
    ),
    (
        lambda: training_range(np.array([1.0, np.nan])),
        dp.errors.NonFiniteError,
        "inputs of training_range must be finite, got 1 that are NaN or infinite, the first at 1",
    ),
    (
        lambda: training_range(SEEN, axis=-1)(np.ones((2, 3))),
        dp.errors.ShapeError,
        "training_range needs 2 features along axis -1, got shape (2, 3)",
    ),
]


@pytest.mark.parametrize("call, kind, message", TABLE, ids=range(len(TABLE)))
def test_message(call, kind, message):
    with pytest.raises(kind) as caught:
        call()
    assert str(caught.value) == message


def test_a_value_outside_is_reported_once():
    guarded = training_range(SEEN, axis=-1)
    inside = np.array([[1.1, 8.0], [-0.1, 32.0]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert guarded(inside) is inside
    message = (
        "1 of 4 inputs of a network are outside the range of training, the first is 33 of feature 1, outside 8 to 32; "
        "its results there are not supported by data: train on longer rollouts or on more states"
    )
    with pytest.warns(dp.errors.RangeWarning) as caught:
        guarded(inside + np.array([0.0, 1.0]) * (inside > 30))
        guarded(inside + 100.0)
    assert [str(warning.message) for warning in caught] == [message]
    assert caught[0].filename == __file__
    for other in (copy.deepcopy(guarded), pickle.loads(pickle.dumps(guarded))):
        with pytest.warns(dp.errors.RangeWarning, match="4 of 4 inputs of a network are outside"):
            other(inside + 100.0)
    assert repr(guarded) == "<training_range of 2 features>"


def test_ranges_of_channels_of_all_values_and_of_nan():
    fields = np.stack([np.linspace(0.0, 1.0, 12), np.linspace(5.0, 7.0, 12)]).reshape(1, 2, 3, 4)
    of_channels = training_range(fields, axis=-3, margin=0.0)
    assert not np.any(of_channels.outside(fields[0]))
    assert np.array_equal(of_channels.outside(fields[:, ::-1]), np.ones((1, 2, 3, 4), bool))
    of_all = training_range(fields, margin=0.0)
    assert not np.any(of_all.outside(fields[:, ::-1]))
    with pytest.warns(dp.errors.RangeWarning, match="the first is nan, outside 0 to 7"):
        of_all(np.array([1.0, np.nan]))


@pytest.mark.parametrize(
    ("inputs", "lower", "upper"),
    [
        (np.float16([-60000, 60000]), -72000, 72000),
        (np.int8([-128, 127]), -153.5, 152.5),
        (np.uint8([0, 250]), -25, 275),
        (np.array([False, True]), -0.1, 1.1),
        (np.array([-1e308, 1e308]), -1.2e308, 1.2e308),
        (np.array([-1.7e308, 1.7e308]), -np.finfo(float).max, np.finfo(float).max),
    ],
)
def test_the_range_does_not_overflow_in_the_dtype_of_the_data(inputs, lower, upper):
    guarded = training_range(inputs)
    assert (guarded.lower, guarded.upper) == pytest.approx((lower, upper), rel=1e-15)
    assert not np.any(guarded.outside(inputs))
    assert np.all(guarded.outside([np.inf, -np.inf, np.nan]))


def test_bounds_are_read_only_and_lists_become_arrays():
    guarded = training_range(SEEN, axis=-1)
    for bounds in (guarded, copy.deepcopy(guarded), pickle.loads(pickle.dumps(guarded))):
        for bound in (bounds.lower, bounds.upper):
            with pytest.raises(ValueError, match="read-only"):
                bound[0] = -99.0
    x = guarded([0.5, 20.0])
    assert isinstance(x, np.ndarray)
    assert np.array_equal(x, [0.5, 20.0])


def test_values_are_compared_in_double_precision():
    guarded = training_range(SEEN * 1e4, margin=0.0)
    assert np.array_equal(guarded.outside(np.float16([0.0, 6e4, np.inf, -1.0])), [False, False, True, True])
    assert np.array_equal(training_range([0, 300], margin=0.0).outside(np.int8([-1, 100])), [True, False])


def test_features_are_checked_after_the_warning():
    guarded = training_range(SEEN, axis=-1)
    with pytest.warns(dp.errors.RangeWarning):
        guarded(SEEN + 100.0)
    with pytest.raises(dp.errors.ShapeError, match="training_range needs 2 features along axis -1"):
        guarded(np.ones((2, 3)))


def drift(guarded):
    """Return a rollout of a correction that grows by a tenth in each step."""
    return lambda u, n: dp.rollout(lambda u, p: guarded(u) * 1.1, u, None, n)


def test_in_a_rollout_its_gradient_and_a_program():
    u = np.array([0.5, 1.0])
    advance = drift(training_range(u, margin=1.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        end = advance(u, 4)
    assert np.array_equal(end, drift(lambda u: u)(u, 4))
    with pytest.warns(dp.errors.RangeWarning, match="the first is 1.61051, outside 0 to 1.5"):
        slope = dp.grad(lambda u: anp.sum(advance(u, 7) ** 2))(u)
    assert slope == pytest.approx(2 * 1.1**14 * u)
    guarded = training_range(u, margin=1.0)
    program = dp.jit(lambda u: guarded(u) * 1.1)
    program(u)
    with pytest.warns(dp.errors.RangeWarning, match="the first is 5, outside 0 to 1.5") as caught:
        program(10 * u)
    assert caught[0].filename == __file__
