"""What the schemes that look back refuse."""

import re

import numpy as np
import pytest

import sparsedp as dp
from sparsedp.errors import NonFiniteError

GRID = dp.Grid((3, 2))
U = np.ones((3, 2))
V = np.zeros(17)


def bad(array, index, value=np.nan):
    array = np.array(array, dtype=float)
    array[index] = value
    return array


STRETCHED = dp.Grid(3, spacing=[np.array([1.0, 1.0, 12.0])])
CASES = [
    (
        lambda: dp.transport(STRETCHED, "maccormack", interpolation="cubic"),
        ValueError,
        "transport maccormack with cubic interpolation needs points whose distances change by at most "
        "a factor of 5 from one to the next, got 6.5; write interpolation='linear'",
    ),
    (
        lambda: dp.transport(GRID, "semi_lagrangian", form="flux"),
        ValueError,
        "transport semi_lagrangian does not use form; leave it out",
    ),
    (
        lambda: dp.transport(GRID, "semi_lagrangian")(bad(U, (1, 1)), V, 0.1),
        NonFiniteError,
        "transport semi_lagrangian needs a finite field, got 1 that are NaN or infinite, the first at (1, 1)",
    ),
    (
        lambda: dp.transport(GRID, "semi_lagrangian", backtrace="midpoint")(U, bad(V, slice(5, 7), np.inf), 0.1),
        NonFiniteError,
        "transport semi_lagrangian needs a finite velocity, got 2 that are NaN or infinite, the first at 5",
    ),
    (
        lambda: dp.transport(GRID, "maccormack", dp.dirichlet)(U, V, 0.1, bad(np.zeros(10), 3)),
        NonFiniteError,
        "transport maccormack needs finite inflow values, got 1 that are NaN or infinite, the first at 3",
    ),
    (
        lambda: dp.transport(GRID, "semi_lagrangian")(U, V, 0.0),
        ValueError,
        "dt of transport semi_lagrangian must be > 0, got 0; write dt=0.01, or -v for a step backwards in time",
    ),
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case[2][:60])
def test_message(case):
    act, kind, message = case
    with pytest.raises(kind, match=f"^{re.escape(message)}$"):
        act()


@pytest.mark.parametrize("scheme", ["semi_lagrangian", "maccormack"])
@pytest.mark.parametrize("velocity", ["faces", "cells"])
@pytest.mark.parametrize("of", ["faces", "cells"])
def test_nonfinite_values_are_refused(scheme, velocity, of):
    move = dp.transport(GRID, scheme, velocity=velocity, of=of)
    u = np.zeros(move.space.shape)
    v = np.zeros((2, 3, 2) if velocity == "cells" else 17)
    for number in range(v.size):
        v.flat[number] = np.nan
        with pytest.raises(NonFiniteError, match="needs a finite velocity, got 1 that are NaN or infinite"):
            move(u, v, 0.1)
        v.flat[number] = 0.0
    for number in range(u.size):
        u.flat[number] = -np.inf
        with pytest.raises(NonFiniteError, match="needs a finite field, got 1 that are NaN or infinite"):
            move(u, v, 0.1)
        u.flat[number] = 0.0
