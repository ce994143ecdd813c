"""Derivatives over error-controlled steps: right where a jump moves with a parameter, or refused; in every mode."""

import autograd.numpy as anp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from stiff import SCENES

import sparsedp as dp
from sparsedp.autodiff.derivative import pushforward, value_and_grad
from sparsedp.errors import DerivativeError

# State at the end and derivative of one number in the logarithms of the params: python tests/helpers/stiff.py
KNOWN = {
    "van der Pol, 20": ([-1.9084613390494942, 0.036092028802400165], [-0.6642059117567769]),
    "van der Pol, 100": ([-1.8689241598837123, 0.007496838315134471], [-0.742386399841996]),
    "van der Pol, 1000": ([1.7061677321704865, -0.0008928097010248124], [1.7847935434610434]),
    "Robertson": (
        [5.20307184411703e-05, 2.0813357318911267e-10, 0.999947969073425],
        [0.0001039659539466278, -0.00010396531406907325, 5.1982867013740734e-05],
    ),
    "HIRES": (
        [
            0.0007371312573329202,
            0.00014424857263168814,
            5.88872974097415e-05,
            0.0011756513432838074,
            0.0023863561988419256,
            0.006238968252775369,
            0.0028499983951938207,
            0.002850001604806185,
        ],
        [
            13.181091573380774,
            0.6027508221842813,
            1.3514979414364539,
            0.05933727769719117,
            -0.8737759408055765,
            -0.6277197544759274,
            0.2677284174433122,
            -0.9377740215543796,
            -13.343292505519743,
            -0.014550360554001737,
            0.8958338145181076,
            -0.8195709080001411,
        ],
    ),
}


def solved(name, tolerance, floor=None):
    """(errors of the state relative to its largest entry, of the gradient relative to its norm), or what refused it."""
    rate, _, start, params, end, number = SCENES[name]
    state, slopes = map(np.array, KNOWN[name])
    start = np.array(start)
    params = np.array(params)
    step = dp.stepper("tr_bdf2", rate, end, tolerance=tolerance, floor=floor)
    end_state = step(start, params)
    error = np.max(np.abs(end_state - state)) / np.max(np.abs(state))
    try:
        value, g = value_and_grad(lambda p: step(start, p)[number])(params)
    except DerivativeError as refused:
        return error, str(refused)
    assert value == end_state[number]  # a trace changes no bit
    return error, float(np.linalg.norm(g * params - slopes) / np.linalg.norm(slopes))


def judge(name, tolerances, floor=None):
    """The gradient is within ten tolerances or refused; the error of the state falls with the tolerance."""
    found = [solved(name, tolerance, floor) for tolerance in tolerances]
    for tolerance, (_, of_gradient) in zip(tolerances, found, strict=True):
        if isinstance(of_gradient, str):
            assert "give a smaller floor or tolerance" in of_gradient
        else:
            assert of_gradient <= 10 * tolerance
    errors = [error for error, _ in found]
    assert errors == sorted(errors, reverse=True)
    assert all(error <= 10 * tolerance for error, tolerance in zip(errors, tolerances, strict=True))
    return [of_gradient for _, of_gradient in found]


@pytest.mark.whole
def test_a_jump_that_moves():
    """With lengths that are held the derivative at mu = 20 was wrong by 90 %."""
    assert all(isinstance(error, float) for error in judge("van der Pol, 20", [1e-3]))


@pytest.mark.whole
@pytest.mark.parametrize("name, most", [("Robertson", 2e-6), ("HIRES", 1e-2)])
def test_values_fall_with_the_tolerance(name, most):
    """Newton's method took errors of 1e-5 in species of 5e-5 for rounding, and they added up."""
    rate, _, start, params, end, _ = SCENES[name]
    state = np.array(KNOWN[name][0])
    errors = []
    for tolerance in (1e-3, 1e-4):
        new = dp.stepper("tr_bdf2", rate, end, tolerance=tolerance)(np.array(start), np.array(params))
        errors.append(np.max(np.abs(new - state)) / np.max(np.abs(state)))
    assert errors[1] < errors[0] <= most


@pytest.mark.slow
@pytest.mark.parametrize("name", ["van der Pol, 20", "van der Pol, 100", "HIRES"])
def test_right_at_every_tolerance(name):
    assert all(isinstance(error, float) for error in judge(name, [1e-3, 1e-4, 1e-5]))


@pytest.mark.slow
def test_long_runs_are_right_or_refused():
    """Two jumps in a time of 2000, each in a thousandth."""
    assert isinstance(judge("van der Pol, 1000", [1e-3, 1e-4, 1e-5])[0], float)


@pytest.mark.slow
@pytest.mark.parametrize("floor", [None, np.array([1e-6, 1e-11, 1e-2])])
def test_species_far_below_the_floor(floor):
    """The remainder of A after 4e7 s is 5e-5, and B is 2e-10: a floor says so."""
    found = judge("Robertson", [1e-3, 1e-4, 1e-5], floor)
    assert floor is None or all(isinstance(error, float) for error in found)


def oscillator(u, p):
    return anp.array([u[1], p * (1 - u[0] ** 2) * u[1] - u[0]])


def oscillator_by_scipy(p, start=2.0, end=8.0):
    rate = lambda t, u: [u[1], p * (1 - u[0] ** 2) * u[1] - u[0]]
    return solve_ivp(rate, (0.0, end), [start, 0.0], method="DOP853", rtol=1e-13, atol=1e-13).y[0, -1]


@pytest.mark.slow
def test_every_mode_and_order():
    """Gradient, tangent and both Hessian products beside differences of SciPy's solution."""
    slope = (oscillator_by_scipy(5.001) - oscillator_by_scipy(4.999)) / 2e-3
    bend = (oscillator_by_scipy(5.001) - 2 * oscillator_by_scipy(5.0) + oscillator_by_scipy(4.999)) / 1e-6
    step = dp.stepper("rk4", oscillator, 8.0, tolerance=1e-4)
    loss = lambda p: step(np.array([2.0, 0.0]), p)[0]
    gradient = lambda p: value_and_grad(loss)(p)[1]
    assert gradient(5.0) == pytest.approx(slope, rel=1e-3)
    assert pushforward(loss, 5.0, 1.0)[1] == pytest.approx(slope, rel=1e-3)
    assert pushforward(gradient, 5.0, 1.0)[1] == pytest.approx(bend, rel=1e-3)
    assert value_and_grad(gradient)(5.0)[1] == pytest.approx(bend, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("count", [4, pytest.param(40, marks=pytest.mark.slow)])
def test_in_loops(count):
    """A rollout and a plain loop cut the run at fixed times: right, or refused where a cut falls into the jump."""
    slope = (oscillator_by_scipy(5.001) - oscillator_by_scipy(4.999)) / 2e-3
    step = dp.stepper("rk4", oscillator, 8.0 / count, tolerance=1e-6)

    def looped(p):
        u = np.array([2.0, 0.0])
        for _ in range(count):
            u = step(u, p)
        return u[0]

    for loss in (looped, lambda p: dp.rollout(step, np.array([2.0, 0.0]), p, count)[0]):
        for derivative in (lambda p: value_and_grad(loss)(p)[1], lambda p: pushforward(loss, p, 1.0)[1]):
            assert derivative(5.0) == pytest.approx(slope, rel=1e-4)


@pytest.mark.whole
def test_uncertain_derivatives_are_refused():
    """Two runs that meet in the middle of a jump: the terms of the derivative there cancel to a thousandth."""
    found = solve_ivp(lambda t, u: oscillator(u, 20.0), (0, 20), [2.0, 0.0], "Radau", rtol=1e-8, dense_output=True)
    times = np.linspace(0, 20, 100_001)
    jump = times[np.argmax(np.abs(found.sol(times)[1]))]
    first, then = (dp.stepper("tr_bdf2", oscillator, end, tolerance=1e-2) for end in (jump, 20.0 - jump))
    loss = lambda mu: then(first(np.array([2.0, 0.0]), mu), mu)[0]
    with pytest.raises(
        DerivativeError,
        match=r"the derivative of stepper\(tr_bdf2\) over \d+ steps is uncertain by \S+ of its size, more than the \S+ "
        r"that its tolerance 0.01 allows; give a smaller floor or tolerance, end no interval in the middle of a "
        "fast change, or take fixed steps",
    ):
        value_and_grad(loss)(20.0)


@pytest.mark.whole  # test_uncertain_derivatives_are_refused is one of these
@pytest.mark.parametrize("cut", [16.969, 16.9692, 16.9694])
def test_what_hides_an_error_is_no_evidence(cut):
    """What extrapolation takes away and what errors of the tolerance do have opposite signs: 69 % wrong, and taken."""
    first, then = (dp.stepper("tr_bdf2", oscillator, length, tolerance=1e-2) for length in (cut, 20.0 - cut))
    with pytest.raises(DerivativeError, match="give a smaller floor or tolerance"):
        value_and_grad(lambda mu: then(first(np.array([2.0, 0.0]), mu), mu)[0])(20.0)


def test_complex_and_single_precision():
    """Turning and growing: u = exp((1j - p) t); the derivative of |u|^2 is -2 t exp(-2 p t)."""
    step = dp.stepper("rk4", lambda u, p: (1j - p) * u, 2.0, tolerance=1e-6)
    slope = value_and_grad(lambda p: anp.sum(anp.abs(step(np.array([1.0 + 0j]), p)) ** 2))(0.3)[1]
    assert slope == pytest.approx(-4 * np.exp(-1.2), rel=1e-5)
    single = dp.stepper("heun", lambda u, p: -p * u, 2.0, tolerance=1e-4)
    new, pulled = value_and_grad(lambda u: anp.sum(single(u, 0.5)))(np.ones(3, np.float32))
    assert pulled.dtype == np.float32 and pulled == pytest.approx(np.exp(-1.0), rel=1e-3)


@pytest.mark.slow
def test_without_extrapolation_the_message_names_another_method():
    """Errors of crank_nicolson fall more slowly than its tolerance: a smaller one would be refused, too."""

    def prey(u, p):
        return anp.array([p[0] * u[0] - p[1] * u[0] * u[1], p[1] * u[0] * u[1] - p[2] * u[1]])

    def slope(method):
        step = dp.stepper(method, prey, 20.0, tolerance=1e-4)
        return value_and_grad(lambda p: step(np.array([1.0, 0.5]), p)[0])(np.array([1.0, 0.8, 0.6]))[1]

    with pytest.raises(
        DerivativeError,
        match=r"the derivative of stepper\(crank_nicolson\) over \d+ steps is uncertain by \S+ of its size, more than "
        r"the \S+ that its tolerance 0.0001 allows; take tr_bdf2, which extrapolates, end no interval in the middle of "
        "a fast change, or take fixed steps",
    ):
        slope("crank_nicolson")
    assert np.allclose(slope("tr_bdf2"), [-7.108311, -6.095685, -16.290818], rtol=0, atol=1e-3 * 16.3)  # by SciPy
