"""Checks of values are calls of a program: a replay raises the same error as the function."""

import autograd.numpy as anp
import numpy as np
import pytest
from differentiable_cases import LINE, PLACES, entries, field

import sparsedp as dp
from sparsedp._utils.pytree import leaves
from sparsedp.autodiff.jit import gap

SQUARE = dp.Grid((6, 5), size=(1.0, 0.8))
RING = dp.Grid(12, periodic=True)
FACES = SQUARE.faces
V = 0.1 * field(FACES.shape, 0)
K = field(SQUARE.shape, 1)
U = field(6, 2)
W = field(7, 1)
RINGED = field(12, 0)
ENTRIES = entries(0)
NAN = np.nan


def flow(**options):
    return dp.flow_step(SQUARE, 0.01, **options)


def convection(v):
    step = flow(viscosity=0.01)
    return step({"v": v, "p": np.zeros(SQUARE.shape), "a": np.zeros(FACES.shape)})["v"]


def friction(v, p):
    return flow(viscosity=0.01, friction=lambda p: p).start(v, p)["a"]


def viscosity(v, p):
    return flow(viscosity=lambda p: p).start(v, p)["a"]


def scalar(v, p):
    step = flow(viscosity=0.01, scalars={"s": {"source": lambda s, p: p * s["s"]}})
    return step.start(v, p, {"s": K})["r"]["s"]


def elliptic(k, b, shift=0.0):
    return dp.elliptic_solver(dp.divergence(SQUARE), dp.gradient(SQUARE, dp.dirichlet))(k, b, shift)


def tensor(k, b):
    return elliptic(k * np.eye(2)[:, :, None, None], b)


def harmonic(k):
    return dp.harmonic_average(SQUARE)(k)


def matrix(data, b):
    return dp.matrix_solver(PLACES)(data, b)


def from_a_start(b, start):
    return dp.inverse(-dp.laplacian(SQUARE, dp.dirichlet), method="krylov")(b, start=start)


def brinkman(level):
    return dp.brinkman(SQUARE)(level)


def forces(v, p, nu):
    return dp.forces(SQUARE, cells=np.s_[1:3, :2])(v, p, nu)


def explicit(u, p):
    return dp.stepper("rk4", None, 0.001, linear=(dp.laplacian(LINE), lambda p: p))(u, p)


def overflow(u, p):
    return dp.stepper("heun", lambda u, p: p * u**2, 0.1)(u, p)


def step_length(u, p):
    return dp.stepper("rk4", lambda u, p: -u, lambda p: p)(u, p)


def newton(u, p):
    return dp.stepper("backward_euler", lambda u, p: -p * u**2, 0.1)(u, p)


def leapfrog(u, w, c):
    D = dp.divergence(LINE)
    G = dp.gradient(LINE)
    return dp.stepper("leapfrog", (lambda v, c: -c * D(v), lambda p, c: -G(p)), 0.01)((u, w), c)


def law(u, p):
    return dp.conservation_law(RING, lambda u, p, axis: p * u, lambda u, p, axis: p + 0 * u)(u, p)


def transport(u, v, dt):
    return dp.transport(RING, "van_leer", velocity="cells")(u, v, dt)


def no_root(p):
    return dp.implicit(lambda x, p: x**2 + p)(np.ones(3), p)


def smoothness(u):
    return dp.smoothness(SQUARE)(u)


def variation(u):
    return dp.total_variation(SQUARE, 1e-3)(u)


# Function, arguments that it accepts, and arguments that it refuses.
CASES = [
    (convection, (V,), (500 * V,)),
    (friction, (V, V), (V, -V)),
    (friction, (V, V), (V, NAN * V)),
    (viscosity, (V, 0.01), (V, -0.01)),
    (viscosity, (V, 0.01), (V, 50.0)),
    (scalar, (V, 1.0), (V, np.inf)),
    (elliptic, (1.0, K), (-1.0, K)),
    (elliptic, (1.0, K), (NAN, K)),
    (elliptic, (1.0, K, 0.5), (1.0, K, NAN)),
    (tensor, (K, K), (-K, K)),
    (harmonic, (K,), (-K,)),
    (harmonic, (K,), (NAN * K,)),
    (matrix, (ENTRIES, U), (NAN * ENTRIES, U)),
    (from_a_start, (K, K), (K, NAN * K)),
    (brinkman, (V,), (NAN * V,)),
    (forces, (V, K, 0.1), (V, K, -0.1)),
    (forces, (V, K, 0.1), (NAN * V, K, 0.1)),
    (explicit, (U, 0.1), (U, 1e5)),
    (overflow, (U, 0.1), (U, 1e308)),
    (overflow, (U, 0.1), (NAN * U, 0.1)),
    (step_length, (U, 0.1), (U, -0.1)),
    (newton, (U, 0.1), (NAN * U, 0.1)),
    (leapfrog, (U, W, 1.0), (U, W, 1e6)),
    (law, (RINGED, 1.0), (RINGED, -1.0)),
    (law, (RINGED, 1.0), (NAN * RINGED, 1.0)),
    (transport, (RINGED, RINGED, 0.1), (RINGED, RINGED, -0.1)),
    (transport, (RINGED, RINGED, 0.1), (RINGED, 1e3 * RINGED, 0.1)),
    (no_root, (-np.ones(3),), (np.ones(3),)),
    (smoothness, (K,), (NAN * K,)),
    (variation, (K,), (NAN * K,)),
]
FAST = (harmonic, leapfrog, law, explicit, overflow)
PARAMETERS = [
    pytest.param(*case, id=f"{case[0].__name__}-{k}", marks=[] if case[0] in FAST else pytest.mark.whole)
    for k, case in enumerate(CASES)
]


def error_of(function, *args):
    with np.errstate(all="ignore"), pytest.raises(Exception, match=".") as caught:
        function(*args)
    return caught.type, str(caught.value)


@pytest.mark.parametrize(("function", "accepted", "refused"), PARAMETERS)
def test_checks_are_made_in_every_replay(function, accepted, refused):
    def loss(args):
        return sum(anp.sum(leaf) for leaf in leaves(function(*args)))

    jitted = dp.jit(function, check=False)
    jitted_loss = dp.jit(loss, check=False)
    jitted(*accepted)
    dp.value_and_grad(jitted_loss)(list(accepted))
    expected = error_of(function, *refused)
    assert error_of(jitted, *refused) == expected
    assert error_of(dp.value_and_grad(jitted_loss), list(refused)) == error_of(dp.value_and_grad(loss), list(refused))
    assert jitted.forms == 1


def test_gap_of_values_that_are_not_finite():
    expected = np.array([1.0, np.inf, NAN])
    assert gap(expected, np.array([1.0, np.inf, NAN])) == 0.0
    assert gap(expected, np.array([1.0 + 4 * np.finfo(float).eps, np.inf, NAN])) == 4.0
    assert gap(expected, np.array([1.0, -np.inf, NAN])) == np.inf
    assert gap(expected, np.array([1.0, NAN, np.inf])) == np.inf
    assert gap(expected, np.array([1.0, 2.0, NAN])) == np.inf


@pytest.mark.parametrize("method", ["imex", "etdrk4"])
@pytest.mark.parametrize("factor", [1e200, NAN])
@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning", "ignore:invalid value:RuntimeWarning")
def test_errors_inside_a_time_step_have_the_message_of_the_function(method, factor):
    step = dp.stepper(method, lambda u, p: -p * u**3, 0.1, linear=(dp.laplacian(RING), 1e-3))
    jitted = dp.jit(step)
    jitted(RINGED, 1.0)
    jitted(1.1 * RINGED, 1.0)
    with pytest.raises(dp.errors.NonFiniteError) as of_function:
        step(factor * RINGED, 1.0)
    with pytest.raises(dp.errors.NonFiniteError) as of_program:
        jitted(factor * RINGED, 1.0)
    assert str(of_program.value) == str(of_function.value)
    with pytest.raises(dp.errors.NonFiniteError) as of_gradient:
        dp.value_and_grad(lambda u: anp.sum(jitted(u, 1.0)))(factor * RINGED)
    assert str(of_gradient.value) == str(of_function.value)
