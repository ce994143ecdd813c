"""Every message about the argument `disk` of rollout."""

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp.errors import DerivativeError

U = np.linspace(0.0, 1.0, 5)
MEMORY = 8 * U.nbytes


def gradient(**options):
    loss = lambda u: anp.sum(dp.rollout(lambda u, p: 0.9 * u, u, None, 20, **{"memory": MEMORY, **options}))
    return dp.grad(loss)(U)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        (
            {"memory": None},
            ValueError,
            "disk of rollout needs memory as bytes or text, got memory=None; write memory='2 GB', and the states that "
            "do not fit into it go to files",
        ),
        (
            {"memory": "reverse"},
            ValueError,
            "memory='reverse' needs a step with step.back(state, params), got <function gradient.<locals>",
        ),
        (
            {"keep": "all"},
            ValueError,
            "keep='all' returns every state in memory, so that disk has no effect; leave disk out",
        ),
        ({"disk": 3}, TypeError, 'disk of rollout must be a path or a pair (path, "20 GB"), got 3'),
        ({"disk": ""}, TypeError, "disk of rollout must be a path or a pair (path, \"20 GB\"), got ''"),
        (
            {"disk": ("x", "many")},
            ValueError,
            "rollout needs disk as bytes > 0 or a text, got 'many'; write for example \"200 MB\"",
        ),
        (
            {"disk": ("x", 0)},
            ValueError,
            'rollout needs disk as bytes > 0 or a text, got 0; write for example "200 MB"',
        ),
    ],
)
def test_arguments_that_do_not_fit(tmp_path, options, error, message):
    with pytest.raises(error) as caught:
        gradient(**{"disk": tmp_path, **options})
    assert str(caught.value).startswith(message)


def test_second_derivatives(tmp_path):
    loss = lambda u: anp.sum(dp.rollout(lambda u, p: u * u, u, None, 20, memory=MEMORY, disk=tmp_path))
    with pytest.raises(
        DerivativeError,
        match="rollout with disk has first derivatives only, because files cannot hold traced states; leave disk out",
    ):
        dp.hvp(loss, U, U)


def test_distributed_fields(tmp_path, monkeypatch):
    monkeypatch.setattr("sparsedp.trajectory.rollout.is_array", lambda value: False)
    with pytest.raises(TypeError, match="disk of rollout cannot be used with distributed fields; leave it out"):
        gradient(disk=tmp_path)
