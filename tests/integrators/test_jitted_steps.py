"""Steps of stepper() under dp.jit: their programs agree, and check values in each call."""

import autograd.numpy as np
import pytest

import sparsedp as dp

RING = dp.Grid(16, periodic=True)
LAPLACIAN = dp.laplacian(RING)
U = np.sin(np.arange(16.0))


def rate(u, p):
    return p * u * (1.0 - u)


STEPS = {
    **{method: dp.stepper(method, rate, 0.01) for method in ("euler", "heun", "ssprk3", "rk4")},
    "rk4 of an operator": dp.stepper("rk4", LAPLACIAN, lambda p: 1e-3 * p),
    "backward_euler": dp.stepper("backward_euler", LAPLACIAN, 0.01),
    "imex": dp.stepper("imex", rate, 0.01, linear=(LAPLACIAN, 0.1)),
}


@pytest.mark.parametrize("name", STEPS)
def test_programs_agree(name):
    result = dp.check.jit(STEPS[name], U, 0.7)
    assert result, result
    assert len(result.rows) == 6


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_program_checks_values_in_each_call():
    step = dp.jit(STEPS["rk4"])
    step(U, 0.7)
    with pytest.raises(dp.errors.NonFiniteError, match=r"state of stepper\(rk4\)"):
        step(np.where(U > 0.9, np.nan, U), 0.7)
    with pytest.raises(dp.errors.NonFiniteError, match=r"params of stepper\(rk4\)"):
        step(U, np.inf)
    with pytest.raises(dp.errors.NonFiniteError, match="got NaN or infinity from a finite state with dt = 0.01; "):
        step(1e200 * U, 0.7)
    unstable = dp.jit(STEPS["rk4 of an operator"])
    unstable(U, 0.7)
    with pytest.raises(dp.errors.UnstableStepError, match="rk4 is unstable for"):
        unstable(U, 1e4)
    with pytest.raises(ValueError, match="dt must be"):
        unstable(U, -1.0)
