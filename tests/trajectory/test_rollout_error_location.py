"""An error that a step raises says in which step of the rollout, keeps its type and what it carries."""

import numpy as np
import pytest

import sparsedp as dp
from sparsedp.autodiff.tape import differentiable
from sparsedp.errors import ConvergenceError, UnstableStepError

LIMIT = "transport upwind: dt = 0.2 is too large at 8 of 8 points"


def growing(step):
    """A step whose velocity doubles: beyond the limit from the fourth on."""
    return lambda state, _: (step(state[0], state[1]), 2.0 * state[1])


def test_forward():
    move = dp.transport(dp.Grid(8, periodic=True))
    step = growing(lambda u, v: move(u, v, 0.2))
    state = np.ones(8), np.ones(8)
    with pytest.raises(UnstableStepError, match=f"^in step 3 of rollout: {LIMIT}"):
        dp.rollout(step, state, None, 6)
    with pytest.raises(UnstableStepError, match=f"^in step 1 of rollout: in step 1 of rollout: {LIMIT}"):
        dp.rollout(lambda outer, _: dp.rollout(step, outer, None, 2), state, None, 3)


def test_backward():
    def stuck(nums, ans, u):
        def pull(g):
            if u[0] > 2.5:
                return (g,)
            raise ConvergenceError("stuck", info="record", best=u)

        return pull

    rule = differentiable("stuck", lambda u: u + 1.0, stuck)
    start = np.zeros(2)
    with pytest.raises(ConvergenceError, match="^in the backward pass through step 2 of rollout: stuck$") as caught:
        dp.value_and_grad(lambda u: dp.rollout(lambda u, _: rule(u), u, None, 5)[0])(start)
    assert caught.value.info == "record" and np.array_equal(caught.value.best, [2.0, 2.0])
