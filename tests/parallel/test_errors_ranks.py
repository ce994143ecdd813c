"""Errors on ranks and in one process: every message of parallel/."""

import pickle
import sys

import autograd.numpy as anp
import numpy as np
import pytest
from launch import launched, on_ranks, printed

import sparsedp as dp
from sparsedp.errors import ShapeError


class Scene:
    """A grid on one rank, as on many, and what lies on it."""

    def __init__(self):
        from mpi4py import MPI

        self.grid = dp.distribute(dp.Grid((5, 4)), MPI.COMM_SELF)
        self.u, self.G = 1.0 * self.grid.volumes, dp.gradient(self.grid)
        self.other = dp.distribute(dp.Grid((3, 2)), MPI.COMM_SELF).volumes

    def double(self):
        """An operator of two functions."""
        return dp.from_functions(lambda u: 2 * u, lambda g: 2 * g, self.grid.cells, self.grid.cells, name="double")


REFUSED = [
    (
        TypeError,
        "u[...] does not work on a field on ranks; write dp.gather(u) for the whole array",
        lambda s: s.u[0],
    ),
    (ShapeError, "a field on cells(5, 4) is needed, got one on cells(3, 2)", lambda s: s.u + s.other),
    (
        ShapeError,
        "a field on cells(5, 4) is needed, got an array of shape (3,); give the whole array",
        lambda s: s.u + np.ones(3),
    ),
    (
        TypeError,
        "the derivative of vdot of a field on ranks is not known; write sums of products",
        lambda s: dp.grad(lambda u: anp.vdot(u, u))(s.u),
    ),
    (
        TypeError,
        "a grid on ranks cannot be pickled; pickle the grid that was given to dp.distribute",
        lambda s: pickle.dumps(s.grid),
    ),
    (
        TypeError,
        "gradient takes no out on ranks; leave it out",
        lambda s: s.G.apply(s.u, out=np.ones(s.grid.faces.size)),
    ),
    (ShapeError, "gradient takes a field on cells(5, 4), got one on cells(3, 2)", lambda s: s.G(s.other)),
    (
        TypeError,
        "an operator of two functions cannot be applied to fields on ranks, because its rows are not known; build it "
        "from operators of the grid or from a matrix",
        lambda s: s.double()(s.u),
    ),
    (
        TypeError,
        "brinkman does not work on ranks yet; give it the grid from before dp.distribute",
        lambda s: dp.brinkman(s.grid),
    ),
    (
        TypeError,
        "eigenpairs does not work on ranks yet; give it the grid from before dp.distribute",
        lambda s: dp.eigenpairs(-dp.laplacian(s.grid, dp.dirichlet), mass=np.ones((5, 4))),
    ),
    (
        TypeError,
        "eigenpairs does not work on ranks yet; give it the grid from before dp.distribute",
        lambda s: dp.eigenpairs(dp.elliptic_solver(dp.divergence(s.grid), s.G), coefficients=1.0),
    ),
    (
        TypeError,
        "eigenpairs does not work on a field on ranks; write dp.gather(u) for the whole array",
        lambda s: dp.eigenpairs(dp.identity(dp.Grid((5, 4)).cells), mass=s.u),
    ),
    (
        TypeError,
        "a batch of coefficients does not work on ranks yet; give it the grid from before dp.distribute",
        lambda s: dp.elliptic_solver(dp.divergence(s.grid), s.G)(np.array([[1.0], [2.0]]), s.u),
    ),
    (
        TypeError,
        "disk of rollout cannot be used with distributed fields; leave it out",
        lambda s: dp.rollout(lambda u, p: u, s.u, None, 3, memory="1 MB", disk="."),
    ),
    (
        TypeError,
        "laplace does not work on ranks yet; give it the grid from before dp.distribute",
        lambda s: dp.laplace(lambda u: u, s.u, 1.0),
    ),
    (
        TypeError,
        "laplace does not work on ranks yet; give it the grid from before dp.distribute",
        lambda s: dp.laplace(lambda u: u, np.ones((5, 4)), dp.identity(s.grid.cells)),
    ),
    (
        TypeError,
        "a misfit of laplace does not work on ranks yet; give it the grid from before dp.distribute",
        lambda s: dp.laplace(lambda u: u * s.u, 1.0, 1.0),
    ),
    (
        TypeError,
        "transport.operator does not work on ranks yet; give it the grid from before dp.distribute",
        lambda s: dp.transport(s.grid).operator(np.ones(s.grid.faces.size), 0.1),
    ),
    (
        TypeError,
        "inverse takes no method and no options on ranks, got 'direct'; omit them",
        lambda s: dp.inverse(dp.laplacian(s.grid), method="direct"),
    ),
    (
        TypeError,
        "inverse takes real operators on ranks, 0+1j * laplacian is complex; solve it on one process",
        lambda s: dp.inverse(1j * dp.laplacian(s.grid)),
    ),
    (
        TypeError,
        "inverse of sample does not work on ranks; both sides must be stored in the same way",
        lambda s: dp.inverse(dp.from_matrix(np.eye(20), s.grid.cells, 20, name="sample")),
    ),
    (
        TypeError,
        "check.operator does not work on ranks yet; give it the grid from before dp.distribute",
        lambda s: dp.check.operator(s.G),
    ),
    (
        TypeError,
        "check.vjp does not work on ranks yet; give it the grid from before dp.distribute",
        lambda s: dp.check.vjp(s.G),
    ),
    (
        TypeError,
        "check.jvp does not work on a field on ranks; write dp.gather(u) for the whole array",
        lambda s: dp.check.jvp(lambda u: u, x=s.u),
    ),
    (
        TypeError,
        "check.hessian does not work on a field on ranks; write dp.gather(u) for the whole array",
        lambda s: dp.check.hessian(lambda u: anp.sum(u**2), lambda u, v: 2 * v, s.u),
    ),
    (
        TypeError,
        "an estimate of the error of solves (certify, certified) does not work on ranks yet; give it the grid from "
        "before dp.distribute",
        lambda s: dp.certify(lambda u: anp.sum(dp.inverse(-dp.laplacian(s.grid, dp.dirichlet))(u)), s.u),
    ),
    (
        TypeError,
        "an estimate of the error of solves (certify, certified) does not work on ranks yet; give it the grid from "
        "before dp.distribute",
        lambda s: dp.certify(lambda k: anp.sum(dp.steady(lambda x, k: x**3 - k, s.u, k)), 8.0),
    ),
    (
        TypeError,
        "a patch of a wall does not work on ranks yet; give it the grid from before dp.distribute",
        lambda s: dp.laplacian(s.grid, {"x": dp.patch((0.0, 2.0), dp.dirichlet)}),
    ),
    (
        TypeError,
        "a patch of a wall does not work on ranks yet; give it the grid from before dp.distribute",
        lambda s: dp.transport(s.grid, boundary={"x": dp.patch((0.0, 2.0), dp.dirichlet)}),
    ),
    (
        TypeError,
        "a patch of a wall does not work on ranks yet; give it the grid from before dp.distribute",
        lambda s: dp.projection(s.grid, boundary={"x": dp.patch((0.0, 2.0), dp.outflow)}),
    ),
    (
        TypeError,
        "a tensor does not work on ranks yet; give it the grid from before dp.distribute",
        lambda s: dp.elliptic_solver(dp.divergence(s.grid), s.G)(np.ones((2, 2, 5, 4)), np.ones((5, 4))),
    ),
    (
        TypeError,
        "Solution has no matrix on ranks; invert a sum or product of operators",
        lambda s: dp.inverse(dp.identity(s.grid.cells) + dp.inverse(dp.laplacian(s.grid, dp.dirichlet))),
    ),
    (
        TypeError,
        "minimize of fields on ranks takes lbfgs, bounds of numbers and a callback, got adam, rate; leave the rest "
        "out, or start from dp.gather(u)",
        lambda s: dp.minimize(lambda u: anp.sum(u * u), s.u, "adam", rate=0.1),
    ),
    (
        TypeError,
        "minimize of fields on ranks takes lbfgs, bounds of numbers and a callback, got lbfgs, metric; leave the rest "
        "out, or start from dp.gather(u)",
        lambda s: dp.minimize(lambda u: anp.sum(u * u), s.u, metric=dp.identity(s.grid.cells)),
    ),
    (
        TypeError,
        "minimize of fields on ranks takes lbfgs, bounds of numbers and a callback, got augmented_lagrangian, "
        "constraints; leave the rest out, or start from dp.gather(u)",
        lambda s: dp.minimize(
            lambda u: anp.sum(u * u), s.u, "augmented_lagrangian", constraints=lambda u: 1.0 - anp.sum(u)
        ),
    ),
    (
        TypeError,
        "metric does not work on ranks yet; give it the grid from before dp.distribute",
        lambda s: dp.minimize(lambda u: anp.sum(u * u), np.ones((5, 4)), metric=dp.identity(s.grid.cells)),
    ),
    (
        TypeError,
        "implicit(<lambda>) takes, for fields on ranks, residuals in which each number is coupled to a few near ones; "
        "write dp.gather(u) for unknowns that every rank solves for alone",
        lambda s: dp.implicit(lambda x, k: x - k + anp.sum(x) ** 2)(s.u, 1.0),
    ),
    (
        TypeError,
        "implicit(<lambda>) takes fields that are all distributed in the same way, or none, got float among them; "
        "write dp.identity(grid.cells)(u) for the field of an array",
        lambda s: dp.implicit(lambda x: x)({"a": s.u, "b": 1.0}),
    ),
    (
        TypeError,
        "implicit(<lambda>) takes no sparsity for fields on ranks; leave it out",
        lambda s: dp.implicit(lambda x: x**2 - 2.0, sparsity=np.eye(20))(s.u),
    ),
    (
        TypeError,
        "distribute takes a communicator, got int; write mpi4py.MPI.COMM_WORLD",
        lambda s: dp.distribute(dp.Grid(3), 2),
    ),
]


@on_ranks
@pytest.mark.parametrize("case", range(len(REFUSED)))
def test_refusals(case):
    error, message, act = REFUSED[case]
    with pytest.raises(error) as caught:
        act(Scene())
    assert str(caught.value) == message


X = 1.0 + np.arange(20.0).reshape(5, 4)


def run_flow(scene, viscosity, scalars=None):
    """One step of a flow at rest."""
    step = dp.flow_step(scene.grid, 0.01, viscosity, scalars=scalars)
    step(step.start(0.0 * scene.G(scene.u), None, dict.fromkeys(scalars or (), scene.u)))


NOT_ON_RANKS_YET = {
    "cut_cells": lambda s: dp.cut_cells(s.grid, lambda x, y: x - 1.5),
    "cut_flow": lambda s: dp.cut_flow(s.grid, lambda x, y: x - 1.5),
    "gradient with order=4": lambda s: dp.gradient(s.grid, dp.dirichlet, order=4),
    "divergence with order=4": lambda s: dp.divergence(s.grid, order=4),
    "laplacian with order=4": lambda s: dp.laplacian(s.grid, dp.dirichlet, order=4),
    "matched_layer": lambda s: dp.matched_layer(s.grid, 0, 1.0),
    "a viscosity that varies in flow_step": lambda s: run_flow(s, X),
    "a diffusivity that varies in flow_step": lambda s: run_flow(s, 0.1, {"heat": {"diffusivity": X}}),
    "density in flow_step": lambda s: dp.flow_step(s.grid, 0.01, 0.1, density=X),
    "density in projection": lambda s: dp.projection(s.grid)(s.G(s.u), X),
    "conservation_law": lambda s: dp.conservation_law(
        s.grid, lambda u, p, axis: u, lambda u, p, axis: 1.0, positive={"u": lambda u, p: u}
    ),
    "shallow_water": lambda s: dp.shallow_water(s.grid),
    "free_faces": lambda s: dp.free_faces(s.grid),
}
FIELDS_NOT_ON_RANKS = {
    "stepper(rodas5p)": lambda s: dp.stepper("rodas5p", lambda u, p: -(u**3), 0.1)(s.u),
    "continuation": lambda s: dp.continuation(lambda u, p: u - p, s.u, 0.0, 1.0),
}


@on_ranks
@pytest.mark.parametrize("name", NOT_ON_RANKS_YET)
def test_not_on_ranks_yet(name):
    message = f"{name} does not work on ranks yet; give it the grid from before dp.distribute"
    with pytest.raises(TypeError) as caught:
        NOT_ON_RANKS_YET[name](Scene())
    assert str(caught.value) == message


@on_ranks
@pytest.mark.parametrize("name", FIELDS_NOT_ON_RANKS)
def test_fields_not_on_ranks(name):
    message = f"{name} does not work on a field on ranks; write dp.gather(u) for the whole array"
    with pytest.raises(TypeError) as caught:
        FIELDS_NOT_ON_RANKS[name](Scene())
    assert str(caught.value) == message


@on_ranks
def test_a_null_vector_that_nobody_tries():
    from mpi4py import MPI

    grid = dp.distribute(dp.Grid(8, spacing=[np.linspace(1, 2, 8)], periodic=True), MPI.COMM_SELF)
    with pytest.raises(dp.errors.ConvergenceError) as caught:
        dp.inverse(dp.upwind(grid))
    assert "the null vector of one side is not known on ranks" in str(caught.value)


@on_ranks
def test_another_mpi(monkeypatch):
    monkeypatch.setenv("PMI_SIZE", "4")
    message = "4 processes were started, but mpi4py belongs to another MPI and finds one; reinstall it for this MPI"
    with pytest.raises(RuntimeError) as caught:
        dp.distribute(dp.Grid(3))
    assert str(caught.value) == message


@on_ranks
def test_names():
    scene = Scene()
    assert repr(scene.u) == "<field on cells(5, 4), on rank 0 of 1>" and repr(scene.grid).endswith("on 1 ranks)")


@on_ranks
def test_operators_are_pictured_as_on_one_process():
    scene = Scene()
    assert scene.G._repr_html_().replace(" on 1 ranks", "") == dp.gradient(dp.Grid((5, 4)))._repr_html_()


@on_ranks
def test_an_audit_names_places_as_on_one_process():
    from mpi4py import MPI

    plain = dp.Grid((5, 4), size=1.0)
    factors = np.ones(plain.shape)
    factors[2, 1] = 1.5

    def wrong_vjp(nums, ans, u):
        return lambda g: (2 * u * g * factors,)

    wrong = dp.differentiable("wrong square", lambda u: u * u, wrong_vjp)
    texts = []
    for grid in (plain, dp.distribute(plain, MPI.COMM_SELF)):
        L = dp.laplacian(grid)
        u = dp.identity(grid.cells)(np.sin(np.arange(20.0)).reshape(5, 4))
        audit = dp.check.gradient(lambda u, L=L: anp.sum(L(wrong(u)) ** 2), u)
        texts.append([line for line in str(audit).splitlines() if "(2, 1)" in line or "x = " in line])
    assert texts[0] and texts[0] == texts[1]


def test_several_processes_without_mpi4py(monkeypatch):
    monkeypatch.setenv("OMPI_COMM_WORLD_SIZE", "2")
    monkeypatch.setitem(sys.modules, "mpi4py", None)
    message = "distribute on several processes needs mpi4py and petsc4py (*); install them, or start one process"
    with pytest.raises(ImportError) as caught:
        dp.distribute(dp.Grid(3))
    start, end = message.split("*")
    assert str(caught.value).startswith(start) and str(caught.value).endswith(end)


def test_what_gather_does_not_take():
    with pytest.raises(ShapeError, match="gather takes one field, got list; gather them one by one"):
        dp.gather([np.ones(3), np.ones(2)])


# ------------------------------------------------------------ errors of one rank among several

PLANTED = {
    "clock: TypeError": "work_precision measures times, which differ between processes; run it on one process",
    "kernel in a gradient: MemoryError": "no room (on rank 1, whose block begins at cell (6, 0))",
    "argument: ValueError": (
        "argument 0['k'] of the loss is not the same on rank 1 as on rank 0; give all ranks the same numbers, random "
        "ones by the same seed"
    ),
    "another way: ValueError": (
        "rank 1 has maximum of shape (), float64, rank 0 has add of shape (), float64; write no branches that depend "
        "on the number of the rank, on a clock or on numbers of one rank"
    ),
}


@on_ranks
@pytest.mark.parametrize("count", [2, pytest.param(4, marks=pytest.mark.whole)])
def test_an_error_of_one_rank_is_that_of_all(count):
    """Type and words: 30 kinds, planted on the last rank or met by it alone."""
    lines = printed("faults.py", count).splitlines()
    assert lines[-1] == "all agree" and len(lines) >= 30
    assert count != 2 or {f"{fault}: {message}" for fault, message in PLANTED.items()} <= set(lines)


@on_ranks
@pytest.mark.whole
@pytest.mark.parametrize(
    "how, message",
    [("kill", "signal 9"), ("file", "No such file or directory: '/nowhere/rank.npy'"), ("waits", "of one rank")],
)
def test_a_rank_that_ends_ends_all(how, message):
    done = launched("faults.py", 2, how, seconds=30)
    assert done.returncode != 0 and message in done.stderr + done.stdout
    assert how == "kill" or "rank 1 of 2: Traceback" in done.stderr


@on_ranks
def test_jitted_functions_of_arrays_where_fields_on_ranks_exist():
    """The ranks look at the kinds of arguments, which a recorded program does not need."""
    Scene()
    loss = dp.jit(lambda x: np.sum(x**2))
    value, slope = dp.value_and_grad(loss)(np.array([1.0, 2.0]))
    assert value == 5.0 and slope.tolist() == [2.0, 4.0]
    end = dp.jit(lambda p: np.sum(dp.rollout(lambda u, p: u * p, np.ones(3), p, 4)))
    assert end(2.0) == 48.0
