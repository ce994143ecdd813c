"""Several threads share one object: every result has the bits that one thread alone gets.

Each kind of public object is made twice. One is used by this thread alone, call after call; the other one by four
threads at once, from its first use on, which begin together and change over as often as Python lets them.
"""

import os
import subprocess
import sys
from threading import Barrier, Thread

import autograd
import autograd.numpy as np
import pytest
from catalogue import CATALOGUE

import sparsedp as dp
from sparsedp import kernels, network
from sparsedp._utils.pytree import leaves
from sparsedp.report.stress_cases import run

FOUR = 4
TIMES = {"few": 1, "many": 2}
NUMBA = pytest.mark.skipif(not kernels.compiled(), reason="numba is not installed")


@pytest.fixture(params=["few", pytest.param("many", marks=pytest.mark.whole)])
def check(request):
    """What is made for all four is, from its first use on and several times, what is made for one alone."""

    def compare(make, times=2):
        alone = make()
        wanted = [alone(number) for number in range(FOUR)]
        for number, results in enumerate(at_once(make(), times * TIMES[request.param])):
            for result in results:
                if isinstance(result, BaseException):
                    raise result
                assert same(result, wanted[number])

    return compare


@pytest.fixture(autouse=True)
def hurried():
    """Threads change over after a microsecond, not after five milliseconds."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


def at_once(work, times):
    """Run work(0) ... work(3) several times in four threads; return the results of each thread."""
    begin = Barrier(FOUR)
    found = [[] for _ in range(FOUR)]

    def act(number):
        begin.wait()
        for _ in range(times):
            try:
                found[number].append(work(number))
            except BaseException as error:
                found[number].append(error)
                return

    team = [Thread(target=act, args=(number,)) for number in range(FOUR)]
    for one in team:
        one.start()
    for one in team:
        one.join()
    return found


def same(found, wanted):
    """Whether two trees hold the same bits."""
    pairs = [tuple(map(np.asarray, pair)) for pair in zip(leaves(found), leaves(wanted), strict=True)]
    return all(a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes() for a, b in pairs)


def numbers(number, shape, least=-1.0, most=1.0):
    """Data of one thread."""
    return np.random.default_rng(number).uniform(least, most, shape)


def slope(loss, *x):
    """Value and gradient."""
    return dp.value_and_grad(loss)(*x)


# ---------------------------------------------------------------- operators

GRID = dp.Grid((7, 6), size=(1.0, 1.3))


def through(op):
    """Return a function that computes values of an operator and of its transpose, and a gradient."""

    def work(number):
        u = numbers(number, op.domain.shape)
        g = numbers(number + 9, op.codomain.shape)
        return op(u), op.T(g), slope(lambda u: np.sum(np.abs(op(u)) ** 3), u)

    return work


@pytest.mark.parametrize("form", ["explicit", "matrix_free"])
def test_operators(check, form):
    def make():
        made = [through(getattr(entry.make(GRID, dp.dirichlet), form)()) for entry in CATALOGUE if entry.least_dim < 3]
        return lambda number: [work(number) for work in made]

    check(make, 1)


def test_compositions_and_functions(check):
    L = dp.laplacian(GRID, dp.dirichlet)

    def make():
        stack = np.cumsum(np.ones((42, 42)), axis=0) / 42
        some = dp.from_functions(
            lambda u: stack @ u.ravel(), lambda g: (stack.T @ g).reshape(7, 6), GRID.cells, 42, "some"
        )
        works = [through(op) for op in (some, L @ L + 2 * L, dp.matrix_power(-L, 0.5), dp.matrix_exponential(0.1 * L))]
        return lambda number: [work(number) for work in works]

    check(make)


# ---------------------------------------------------------------- solves


def heat(grid, boundary=dp.dirichlet, number=3):
    """1 - D k G with k that no transform takes."""
    k = dp.diagonal(grid.faces, numbers(number, grid.faces.shape, 0.5, 1.5))
    return dp.identity(grid.cells) - dp.divergence(grid) @ k @ dp.gradient(grid, boundary)


def wind(grid):
    """An operator that is not symmetric."""
    return heat(grid) + 0.3 * dp.upwind(grid, 0, 1, dp.dirichlet)


PLANE = dp.Grid((16, 17), size=1.0)
ROOM = dp.Grid((8, 7, 9), size=1.0)
OPERATORS = {
    "dense": ("direct", lambda: wind(dp.Grid((8, 8), size=1.0))),
    "dense and complex": ("direct", lambda: dp.from_matrix(wind(dp.Grid(40)).matrix * (1 + 2j))),
    "sparse LU, 1-D": ("direct", lambda: wind(dp.Grid(400, size=1.0))),
    "sparse LU": ("direct", lambda: wind(PLANE)),
    "multigrid": ("multigrid", lambda: heat(PLANE)),
    "multigrid with wind": ("multigrid", lambda: wind(PLANE)),
    "multigrid, one level": ("multigrid", lambda: heat(dp.Grid((8, 8), size=1.0))),
    "separable": ("separable", lambda: -dp.laplacian(PLANE, dp.dirichlet)),
    "separable by elimination": ("separable", lambda: -dp.laplacian(dp.Grid((32, 600), size=1.0), dp.dirichlet)),
    "separable, Neumann": ("separable", lambda: -dp.laplacian(ROOM)),
    "krylov": ("krylov", lambda: wind(dp.Grid((8, 9), size=1.0))),
    "structured": ("structured", lambda: heat(PLANE)),
    "structured, 3-D": ("structured", lambda: heat(ROOM)),
    "auto": ("auto", lambda: heat(PLANE)),
}


@pytest.mark.whole
@pytest.mark.parametrize("name", OPERATORS)
def test_inverses(check, name):
    method, op = OPERATORS[name]
    if method == "structured" and not kernels.compiled():
        pytest.skip("numba is not installed")

    def make():
        solve = dp.inverse(op(), method, nullspace="project")
        work = through(solve)
        return lambda number: [work(number), [solve(numbers(many, solve.domain.shape)) for many in range(6)]]

    check(make)


@pytest.mark.parametrize("method", ["auto", "direct", "multigrid"])
def test_elliptic_solver_and_harmonic_average(check, method):
    def make():
        solve = dp.elliptic_solver(dp.divergence(PLANE), dp.gradient(PLANE, dp.dirichlet), method)
        to_faces = dp.harmonic_average(PLANE)
        b = numbers(7, PLANE.shape)
        return lambda number: slope(lambda k: np.sum(solve(to_faces(k), b) ** 2), numbers(number, PLANE.shape, 0.5, 2))

    check(make, 1)


def test_matrix_solver(check):
    def make():
        matrix = wind(dp.Grid((7, 7), size=1.0)).matrix
        solve = dp.matrix_solver(matrix)
        data = matrix.data
        b = numbers(1, matrix.shape[0])
        return lambda number: slope(lambda data: np.sum(solve(data, b) ** 2), data * (1 + 0.01 * number))

    check(make)


@pytest.mark.parametrize("cells", [5, 40, 300])
def test_implicit(check, cells):
    L = dp.laplacian(dp.Grid(cells, size=1.0), dp.dirichlet)
    b = np.ones(cells)

    def make():
        root = dp.implicit(lambda u, p: p * u**3 - 0.01 * L(u) - b)
        return lambda number: slope(lambda p: np.sum(root(b, p) ** 2), 1.0 + numbers(number, cells, 0, 1))

    check(make, 1)


# ---------------------------------------------------------------- transport and flow


@pytest.mark.parametrize("scheme", ["upwind", "van_leer", "semi_lagrangian", "maccormack"])
@pytest.mark.parametrize("cells", [(9, 8), (160, 150)])  # the larger ones borrow arrays of a call before
def test_transport(check, scheme, cells):
    grid = dp.Grid(cells, size=1.0)

    def make():
        move = dp.transport(grid, scheme)
        u = numbers(1, grid.shape)
        v = 0.1 * numbers(2, grid.faces.shape)
        return lambda number: slope(lambda a: np.sum(move(a[0], a[1], 0.01 / (number + 9)) ** 2), (u + number, v))

    check(make, 1)


@pytest.mark.parametrize("solid", [False, True])
def test_projection_and_flow_step(check, solid):
    grid = dp.Grid((12, 11), size=1.0)
    mask = np.zeros(grid.shape, bool)
    mask[4:6, 5] = solid

    def make():
        P = dp.projection(grid, mask if solid else None)
        step = dp.flow_step(grid, 0.01, viscosity=0.01, solid=mask if solid else None)
        carry = dp.convection(grid)
        state = step.start(np.zeros(grid.faces.size))
        project = through(P)

        def run(v):
            flow = dp.rollout(step, {**state, "v": v}, None, 3)["v"]
            return np.sum(flow**2) + np.sum(carry(v, v) * P.pressure.T(numbers(3, grid.shape)))

        return lambda number: [project(number), slope(run, numbers(number, grid.faces.shape))]

    check(make, 1)


# ---------------------------------------------------------------- time


def rate(u, p):
    return p * u * (1 - u)


@pytest.mark.whole
@pytest.mark.parametrize(
    ("method", "tolerance"),
    [
        *((method, None) for method in ("euler", "ssprk3", "backward_euler", "crank_nicolson", "imex", "etdrk4")),
        *((method, 1e-2) for method in ("heun", "rk4", "tr_bdf2", "radau", "imex")),
    ],
)
def test_steppers(check, method, tolerance):
    split = method in ("imex", "etdrk4")
    L = dp.laplacian(dp.Grid(20, size=1.0), dp.dirichlet)

    def make():
        step = dp.stepper(method, rate, 0.01, tolerance=tolerance, **({"linear": (L, 0.1)} if split else {}))

        def run(p):
            return np.sum(dp.rollout(step, 0.5 * np.ones(20), p, 2) ** 2)

        return lambda number: slope(run, 1 + numbers(number, 20, 0, 1))

    check(make, 1)


def test_linear_implicit_steps(check):
    L = dp.laplacian(dp.Grid((8, 8), size=1.0), dp.dirichlet)

    def make():
        step = dp.stepper("backward_euler", L, lambda p: 0.01 * p)
        u = numbers(1, (8, 8))
        return lambda number: slope(lambda p: np.sum(dp.rollout(step, u, p, 3) ** 2), 1.0 + number)

    check(make)


@pytest.mark.parametrize("memory", [None, 5000])
def test_rollouts(check, memory):
    move = dp.transport(GRID)
    cube = dp.differentiable("cube", lambda u: u**3, lambda nums, ans, u: lambda g: (3 * u**2 * g,))

    def make():
        def run(v):
            end = dp.rollout(
                lambda u, v: 0.5 * np.sin(cube(move(u, v, 0.01))), np.ones(GRID.shape), v, 12, memory=memory
            )
            return np.sum(end**2)

        return lambda number: slope(run, 0.1 * numbers(number, GRID.faces.shape))

    check(make, 1)


# ---------------------------------------------------------------- derivatives, instruments, optimizers


def nested(d):
    """A derivative inside a derivative: which trace a value belongs to decides."""

    def loss(x):
        inner = d(lambda y: np.sum(np.sin(x) * y**3))(x * 1.0)
        return np.sum(inner**2 * x)

    return loss


def gradient_of(f):
    return lambda x: dp.value_and_grad(f)(x)[1]


@pytest.mark.sampled(0)
@pytest.mark.parametrize("outer", [gradient_of, autograd.grad])
@pytest.mark.parametrize("inner", [gradient_of, autograd.grad])
def test_nested_derivatives(check, outer, inner):
    def work(number):
        return [outer(nested(inner))(numbers(number, 5)) for _ in range(10)]

    check(lambda: work)
    x = numbers(0, 5)  # d/dx sum of 9 sin(x)^2 x^4 x by hand
    wanted = 9 * (2 * np.sin(x) * np.cos(x) * x**5 + 5 * np.sin(x) ** 2 * x**4)
    assert np.max(np.abs(work(0)[0] / wanted - 1)) < 1e-13


def test_a_derivative_in_a_thread_that_a_loss_starts():
    def loss(x):
        found = []
        one = Thread(target=lambda: found.append(dp.value_and_grad(lambda y: x * y**2)(3.0 * x)[1]))
        one.start()
        one.join()
        return found[0]  # d/dy x y^2 at 3 x: 6 x^2

    assert dp.value_and_grad(loss)(2.0) == (24.0, 24.0)


def test_adopted_simulators_that_write_into_a_buffer(check):
    buffer = np.zeros(30)

    def foreign(u):
        buffer[:] = 0.0
        for i in range(30):
            buffer[i] += u[i] ** 2 + 0.1 * u[i - 1]
        return buffer

    def make():
        simulate = dp.from_blackbox(foreign, derivative="difference")
        return lambda number: slope(lambda u: np.sum(simulate(u) ** 2), numbers(number, 30, 1.0, 2.0))

    check(make, 1)


def test_networks(check):
    def make():
        p = network.dense_weights(np.random.default_rng(0), 3, 8)
        image = network.convolution_weights(np.random.default_rng(1), 1, 2, (3, 3))

        def loss(x):
            y = network.tanh(network.dense(p, x))
            return np.sum(y**2) + np.sum(network.convolution(image, np.reshape(x, (1, 1, 2, 6))) ** 2)

        return lambda number: slope(loss, numbers(number, (4, 3)))

    check(make)


def test_updates_and_checks_of_operators(check):
    L = dp.laplacian(GRID, dp.dirichlet)

    def make():
        cube = dp.physical_gradient(lambda x: x**3, lambda y, x: np.sign(y) * np.abs(y) ** (1 / 3))

        def work(number):
            x = numbers(number, 8, 0.5, 1.5)
            step = dp.update_direction(lambda x: np.outer(x, x**2).ravel(), x).step
            return step, slope(lambda x: np.sum((cube(x) - 2.0) ** 2), x), dp.check.operator(L).verdict == "agrees"

        return work

    check(make, 1)


@pytest.mark.filterwarnings("ignore::sparsedp.errors.GrowthWarning")  # a filter that other threads leave where it is
def test_stress_hears_of_growth_in_its_own_thread(check):
    def work(number):
        factor = 30.0 if number == 0 else 0.9
        loss = lambda u: np.sum(dp.rollout(lambda u, p: factor * u, u, None, 20) ** 2)
        return [run(loss, numbers(number, 4)).has_grown for _ in range(10)]

    check(lambda: work, 1)
    assert work(0) == [True] * 10 and work(1) == [False] * 10


def test_grids(check):
    def make():
        grid = dp.Grid((5, 4, 3), size=(1.0, 2.0, 3.0), periodic=(False, True, False))

        def work(number):
            parts = grid.split(numbers(number, grid.faces.size))
            spaces = [space.volumes for space in (grid.cells, grid.faces, grid.nodes, grid.edges)]
            return grid.centres(), grid.face_centres(0), grid.volumes, spaces, parts, grid.join(*parts)

        return work

    check(make)


def bowl(number):
    """A loss with a small solve in it."""
    solve = dp.inverse(-dp.laplacian(dp.Grid(6, size=1.0), dp.dirichlet))
    b = numbers(number, 6)
    return lambda x: np.sum((solve(x) - b) ** 2) + 0.01 * np.sum(x**4)


@pytest.mark.sampled(0)
@pytest.mark.parametrize("method", ["gd", "adam", "lbfgs", "newton_cg"])
def test_minimize(check, method):
    def work(number):
        best = dp.minimize(bowl(number), np.ones(6), method, maxiter=5)
        return best.x, best.value, [(r.value, r.gradient_norm, r.evaluations, r.solves) for r in best.history]

    check(lambda: work, 1)


def scene():
    """A loss with a linear and a nonlinear solve, each with objects of its own."""
    solve = dp.inverse(dp.identity(PLANE.cells) - dp.laplacian(PLANE, dp.dirichlet), "krylov", rtol=1e-6)
    small = dp.implicit(lambda u, p: u**3 + u - p)
    return lambda b: np.sum(solve(b) ** 2) + np.sum(small(np.ones(3), b[0, :3]) ** 2)


def test_instruments(check):
    """Each sees its own loss only, and disturbs no other thread."""

    def work(number):
        b = numbers(5, PLANE.shape)
        loss = scene()
        if number == 0:
            plan = dp.explain(loss, b)
            return sorted((kind, many) for (_, kind), many in plan.counts.items())
        if number == 1:
            result = dp.check.gradient(lambda x: np.sum(np.sin(x) ** 2), numbers(1, 4))
            return [result.verdict == "agrees"]
        if number == 2:
            found = dp.certify(loss, b)
            best = dp.minimize(loss, b, tolerance=dp.certified(0.1), maxiter=2)
            return found.gradient, found.gradient_error, best.x
        return slope(loss, b)

    check(lambda: work, 1)


FIRST = """
import sys
from threading import Barrier, Thread
sys.setswitchinterval(1e-6)
begin, found = Barrier(4), []

def act():
    begin.wait()
    import autograd.numpy as np
    import sparsedp as dp
    grid = dp.Grid((20, 20), size=1.0)
    k, move, P = np.linspace(1.0, 2.0, grid.faces.size), dp.transport(grid), dp.projection(grid)
    solve = dp.elliptic_solver(dp.divergence(grid), dp.gradient(grid, dp.dirichlet), "multigrid")
    loss = lambda k: np.sum(solve(k, move(np.ones(grid.shape), P(0.1 * k), 0.01)) ** 2)
    found.append(dp.value_and_grad(loss)(k)[1].tobytes())

team = [Thread(target=act) for _ in range(4)]
[one.start() for one in team]
[one.join() for one in team]
sys.exit(not len(found) == 4 == found.count(found[0]))
"""


@pytest.mark.whole
def test_the_first_use_of_the_library_by_four_threads():
    assert subprocess.run([sys.executable, "-c", FIRST], check=False, timeout=300).returncode == 0


SLOW_TYPES = """
import time, weakref
from numba.core.types import abstract

def intern(cls, inst):
    reference = weakref.ref(inst, abstract._on_type_disposal)
    known = abstract._typecache.get(reference)
    known = known and known()
    if known is not None:
        return known
    time.sleep(0.002)  # another thread creates the same type meanwhile
    inst._code = abstract._autoincr()
    abstract._typecache[reference] = reference
    return inst

abstract._TypeMetaclass._intern = intern
"""


@pytest.mark.whole
@NUMBA
def test_numba_types_that_threads_create_at_once():
    """numba numbers a type twice if two threads create it at once; afterwards it found no signature of our loops."""
    assert subprocess.run([sys.executable, "-c", SLOW_TYPES + FIRST], check=False, timeout=300).returncode == 0


# ---------------------------------------------------------------- teams of the compiled kernels


TEAMS = """
import os, sys
from threading import Thread
import numpy as np
import sparsedp as dp

grid = dp.Grid((330, 330), size=1.0)
solves, b = [], np.random.default_rng(0).standard_normal(grid.shape)
for number in range(3):
    k = dp.diagonal(grid.faces, np.random.default_rng(number).uniform(0.5, 1.5, grid.faces.size))
    op = dp.identity(grid.cells) - dp.divergence(grid) @ k @ dp.gradient(grid, dp.dirichlet)
    solves.append(dp.inverse(op, "structured"))
wanted = [solve(b) for solve in solves]
found = [[] for _ in solves]

def act(number):
    found[number] = [solves[number](b) for _ in range(3)]

team = [Thread(target=act, args=(number,)) for number in range(3)]
[one.start() for one in team]
[one.join() for one in team]
good = all(len(some) == 3 and all(np.array_equal(x, y) for y in some) for x, some in zip(wanted, found))
if not good or not hasattr(os, "fork"):
    sys.exit(not good)
child = os.fork()
good = np.array_equal(solves[0](b), wanted[0])
if not child:
    os._exit(int(not good))
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.mark.whole
@NUMBA
@pytest.mark.parametrize("layer", ["workqueue", pytest.param("default", marks=pytest.mark.whole)])
def test_teams_of_several_solvers_take_turns(layer):
    """numba's own threads end the process where two teams meet; the bits do not depend on who gets the team.

    And a forked child may solve.
    """
    environment = os.environ | {"NUMBA_THREADING_LAYER": layer, "NUMBA_NUM_THREADS": "2"}
    assert subprocess.run([sys.executable, "-c", TEAMS], env=environment, check=False, timeout=300).returncode == 0
