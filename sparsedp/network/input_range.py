"""A warning for networks in a time loop whose inputs leave the range of the training data."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sparsedp._utils.base_classes import Reconstructible
from sparsedp._utils.calls import frames_inside
from sparsedp._utils.validation import check_finite, check_kind, check_number, check_plain
from sparsedp.autodiff.program_trace import check_values
from sparsedp.autodiff.tape import plain
from sparsedp.errors import RangeWarning, ShapeError

__all__ = ["TrainingRange", "training_range"]


def training_range(inputs: ArrayLike, axis: int | None = None, margin: float = 0.1) -> TrainingRange:
    """Return a function that returns its argument, and warns when values leave the range of the training inputs.

    Parameters
    ----------
    inputs : real array
        The inputs of a network in training, with any leading axes, such as samples and times.
    axis : int < 0, optional
        The axis of features or channels, counted from the end: -1 for `dense`, -2 or -3 for `convolution` in one or two
        dimensions. Each has its own range. Default: one range for all values.
    margin : float >= 0, optional
        How far beyond the least and the largest value of training a value may be, as a share of the range.

    Returns
    -------
    TrainingRange
        ``guarded(x)`` returns x, with the derivative 1. The first x with a value that is outside the range, or not
        finite, issues a `RangeWarning`. ``guarded.outside(x)`` returns where values are outside or not finite.

    Raises
    ------
    TypeError
        If `inputs` does not hold real numbers; on use, if x does not.
    NonFiniteError
        If `inputs` contains NaN or infinity.
    ShapeError
        If `inputs` is empty or does not have the axis; on use, if x has another number of features.
    ValueError
        If `margin` is negative, or `axis` is not negative.

    See Also
    --------
    network.dense, network.convolution

    Notes
    -----
    A network that corrects a solver in each time step is trained on states near the data. Its own errors lead
    it to other states, for which it was not trained, and there they may grow without bound. The range is necessary for
    a state to be like the training states, not sufficient. To raise an error instead of the warning, call
    ``warnings.filterwarnings("error", category=sparsedp.errors.RangeWarning)``.

    Examples
    --------
    >>> import numpy as np
    >>> guarded = training_range(np.array([[0.0, 10.0], [1.0, 30.0]]), axis=-1)
    >>> guarded(np.array([1.1, 20.0]))
    array([ 1.1, 20. ])
    >>> guarded.outside(np.array([[1.2, 20.0], [0.5, 7.0]]))
    array([[ True, False],
           [False,  True]])
    """
    inputs = _real_array("inputs of training_range", inputs)
    check_finite("inputs of training_range", inputs)
    check_number("margin of training_range", margin, ">= 0", "; the default is 0.1")
    if axis is not None and not (isinstance(axis, (int, np.integer)) and axis < 0):
        raise ValueError(f"axis of training_range must be a negative integer, got {axis!r}; write -1 for the last axis")
    if inputs.size == 0:
        raise ShapeError(f"training_range needs inputs with values, got shape {inputs.shape}")
    if axis is not None and inputs.ndim < -axis:
        raise ShapeError(f"training_range needs inputs with axis {axis}, got shape {inputs.shape}")
    others = None
    if axis is not None:
        others = tuple(number for number in range(inputs.ndim) if number != inputs.ndim + axis)
    least = np.min(inputs, axis=others)
    largest = np.max(inputs, axis=others)
    greatest = np.finfo(float).max
    with np.errstate(over="ignore"):
        slack = np.multiply(margin, 0.5 * largest - 0.5 * least) * 2.0
        return TrainingRange(np.maximum(least - slack, -greatest), np.minimum(largest + slack, greatest), axis)


def _real_array(name: str, values: Any) -> NDArray:
    """Return values as a float64 array; raise TypeError if they are not real numbers."""
    check_plain("training_range", values)
    array = np.asarray(plain(values))
    check_kind(name, array.dtype, "real numbers")
    with np.errstate(over="ignore"):  # a longdouble beyond the range of float64 is outside
        return array.astype(float)


def _read_only(bound):
    bound = np.array(bound)
    bound.flags.writeable = False
    return bound


class TrainingRange(Reconstructible):
    """The range of the inputs of a network in training; see `training_range`.

    Parameters
    ----------
    lower, upper : arrays
        The least and the largest value, one number or one for each feature; finite, and read-only.
    axis : int or None
        The axis of the features.

    Attributes
    ----------
    has_warned : bool
        Whether a warning has been issued. Set it to False for another one.
    """

    name = "training_range"

    def __init__(self, lower: NDArray, upper: NDArray, axis: int | None) -> None:
        self.lower = _read_only(lower)
        self.upper = _read_only(upper)
        self.axis = axis
        self.has_warned = False

    def recipe(self) -> tuple:
        """Return the call that builds an equal object, for pickling and copying."""
        return TrainingRange, (self.lower, self.upper, self.axis)

    def __call__(self, x: Any) -> Any:
        """Return x, and warn if a value is outside the range.

        Parameters
        ----------
        x : array

        Returns
        -------
        array

        Raises
        ------
        ShapeError
            If x does not have the features of training.
        TypeError
            If x does not hold real numbers.
        """
        check_values(self._warn, x)
        return np.asarray(x) if isinstance(x, (list, tuple)) else x

    def outside(self, x: Any) -> NDArray:
        """Return where values of an array are outside the range, or not finite.

        Parameters
        ----------
        x : array

        Returns
        -------
        bool array like x

        Raises
        ------
        ShapeError
            If x does not have the features of training.
        TypeError
            If x does not hold real numbers.
        """
        x = self._checked(x)
        lower, upper = self.lower, self.upper
        if self.axis is not None:
            shape = (-1, *[1] * (-1 - self.axis))
            lower, upper = lower.reshape(shape), upper.reshape(shape)
        return ~((x >= lower) & (x <= upper))

    def _checked(self, x: Any) -> NDArray:
        """Return an array as float64; raise an error if it does not have the features of training."""
        x = _real_array("x of training_range", x)
        if self.axis is not None:
            count = self.lower.size
            if x.ndim < -self.axis or x.shape[self.axis] != count:
                raise ShapeError(f"training_range needs {count} features along axis {self.axis}, got shape {x.shape}")
        return x

    def _warn(self, x: Any) -> None:
        x = self._checked(x)
        if self.has_warned:
            return
        outside = self.outside(x)
        if not np.any(outside):
            return
        self.has_warned = True
        first = np.unravel_index(int(np.argmax(outside)), outside.shape)
        lower, upper = self.lower, self.upper
        of_feature = ""
        if self.axis is not None:
            feature = int(first[self.axis])
            lower, upper = lower[feature], upper[feature]
            of_feature = f" of feature {feature}"
        warnings.warn(
            RangeWarning(
                f"{np.count_nonzero(outside)} of {outside.size} inputs of a network are outside the range of training, "
                f"the first is {x[first]:.6g}{of_feature}, outside {lower:.6g} to {upper:.6g}; its results "
                "there are not supported by data: train on longer rollouts or on more states"
            ),
            stacklevel=frames_inside() + 1,
        )

    def __repr__(self) -> str:
        return f"<training_range of {self.lower.size} features>"
