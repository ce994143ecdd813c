"""benchmarks.mosaic: matrix-free hexahedra beside assembled matrices, flows beside exact ones, and their gradients."""

import sys

import numpy as np
import pytest
import skfem
from scipy.sparse.linalg import spsolve
from skfem.models.elasticity import lame_parameters, linear_elasticity
from skfem.models.poisson import laplace

import sparsedp as dp
from benchmarks.mosaic.__main__ import FORWARD, main, stored
from benchmarks.mosaic.cylinders import DragTask, OpenChannel, flux_variation
from benchmarks.mosaic.flows import SpectralFlow, StaggeredFlow, relative_error, taylor_green
from benchmarks.mosaic.gradients import agreement, growth
from benchmarks.mosaic.hexahedra import Hexahedra, Level, elasticity_matrix, heat_matrix
from benchmarks.mosaic.meshes import Cantilever, Slab, random_density

pytestmark = pytest.mark.whole
WIDTHS = (0.5, 0.3, 0.2)


def box(shape, kind):
    """Return hexahedra that are fixed at x = 0, and scikit-fem's basis and form on the same mesh."""
    fixed = np.zeros([n + 1 for n in shape], dtype=bool)
    fixed[0] = True
    axes = [width * np.arange(n + 1) for n, width in zip(shape, WIDTHS, strict=True)]
    mesh = skfem.MeshHex.init_tensor(*axes)
    if kind == "heat":
        return Hexahedra(shape, WIDTHS, heat_matrix(WIDTHS), fixed), skfem.Basis(mesh, skfem.ElementHex1()), laplace
    element = skfem.ElementVector(skfem.ElementHex1())
    form = linear_elasticity(*lame_parameters(1.0, 0.3))
    return Hexahedra(shape, WIDTHS, elasticity_matrix(WIDTHS, 0.3), fixed), skfem.Basis(mesh, element), form


def nodes_of(basis, shape):
    """Return the unknown of scikit-fem at each node of our arrays."""
    place = np.round(basis.mesh.p / np.reshape(WIDTHS, (3, 1))).astype(int)
    order = np.argsort(np.ravel_multi_index(place, [n + 1 for n in shape]))
    return basis.nodal_dofs[:, order].ravel()


def assembled(basis, form, k, shape):
    """Return the matrix of scikit-fem for one coefficient an element, in the order of our arrays."""
    middles = basis.mesh.p[:, basis.mesh.t].mean(axis=1)
    element = np.ravel_multi_index((middles / np.reshape(WIDTHS, (3, 1))).astype(int), shape)
    entries = form.coo_data(basis)
    entries.data = entries.data * np.tile(k.ravel()[element], entries.data.size // element.size)
    numbers = nodes_of(basis, shape)
    return entries.tocsr()[np.ix_(numbers, numbers)]


@pytest.mark.parametrize("kind", ["heat", "elasticity"])
def test_hexahedra_beside_the_assembled_matrix(kind, rng):
    shape = (4, 3, 2)
    mesh, basis, form = box(shape, kind)
    k = rng.uniform(0.1, 1.0, shape)
    matrix = assembled(basis, form, k, shape)
    free = mesh.free.ravel() == 1
    u, b = rng.standard_normal((2, *mesh.nodes))
    np.testing.assert_allclose(mesh.product(k, u).ravel()[free], (matrix @ (mesh.free * u).ravel())[free], atol=1e-13)
    assert np.all(mesh.product(k, u)[mesh.free == 0] == 0)
    x = mesh.solve(k, b)
    np.testing.assert_allclose(x.ravel()[free], spsolve(matrix[np.ix_(free, free)], b.ravel()[free]), rtol=1e-7)
    assert np.all(x[mesh.free == 0] == 0)


@pytest.mark.parametrize("kind", ["heat", "elasticity"])
def test_derivatives_of_hexahedra(kind, rng):
    mesh, _, _ = box((2, 2, 1), kind)
    assert dp.check.operator(mesh.stiffness(rng.uniform(0.1, 1.0, mesh.shape))).verdict == "agrees"
    point = {"k": rng.uniform(0.1, 1.0, mesh.shape), "b": rng.standard_normal(mesh.nodes)}
    audit = dp.check.gradient(lambda at: np.sum(mesh.solve(at["k"], at["b"]) ** 2), point)
    assert audit.verdict == "agrees"
    assert "Hessian product: agrees" in str(audit)
    assert "forward mode: agrees" in str(audit)


@pytest.mark.parametrize(("shape", "most"), [((32, 16, 1), 30), ((8, 4, 4), 12), ((3, 3, 1), 2), ((1, 1, 1), 2)])
def test_multigrid_of_hexahedra(shape, most, rng):
    mesh, _, _ = box(shape, "heat")
    k = 1e-3 + 0.999 * rng.uniform(0.05, 0.95, shape) ** 3
    level = Level(mesh.shape, WIDTHS, mesh.matrix, k, mesh.free)
    a, b = mesh.free * rng.standard_normal((2, *mesh.nodes))
    assert np.sum(a * level.cycle(b)) == pytest.approx(np.sum(b * level.cycle(a)), rel=1e-10)
    np.testing.assert_allclose(level.product(a), mesh.product(k, a), atol=1e-13)
    mesh.solve(k, b)
    _, inverse = mesh.set_up(k)
    assert inverse.info.forward.iterations <= most
    if level.coarse is not None:  # the matrices of the next level are P^T A P
        c = level.coarse.free * rng.standard_normal(level.coarse.free.shape)
        np.testing.assert_allclose(
            level.coarse.product(c), level._restrict(level.product(level._interpolate(c))), atol=1e-12
        )


def test_hexahedra_refuse_what_they_cannot_solve():
    mesh, _, _ = box((2, 2, 1), "heat")
    for wrong in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="^the coefficients of all elements must be positive and finite$"):
            mesh.solve(np.full(mesh.shape, wrong), np.ones(mesh.nodes))
    with pytest.raises(ValueError, match=r"^k must be a real array of shape \(2, 2, 1\), got float64 of shape \(\)$"):
        mesh.solve(0.5, np.ones(mesh.nodes))
    with pytest.raises(ValueError, match=r"^k must be a real array of shape \(2, 2, 1\), got complex128 of shape"):
        mesh.solve(np.ones(mesh.shape) + 0j, np.ones(mesh.nodes))
    with pytest.raises(dp.errors.NonFiniteError):
        mesh.solve(np.ones(mesh.shape), np.full(mesh.nodes, np.nan))
    np.testing.assert_allclose(  # the scale of the coefficients and of the data does not matter
        mesh.solve(np.full(mesh.shape, 1e-200), np.full(mesh.nodes, 1e-200)),
        mesh.solve(np.ones(mesh.shape), np.ones(mesh.nodes)),
    )


def test_compliances():
    slab = Slab(16)
    for density in (0.05, 0.4, 0.95):
        exact = 16.0 / (1e-3 + 0.999 * density**3)
        assert slab.compliance(np.full(slab.shape, density)) == pytest.approx(exact, rel=1e-9)
    # Computed once, and within the rounding errors of single precision equal to the stored results of Mosaic.
    slab = Slab(6)
    assert slab.compliance(random_density(slab.shape)) == pytest.approx(85.65076, rel=1e-6)
    slab = Slab(12)
    assert slab.compliance(np.full(slab.shape, 0.5), slab.gaussian_source()) == pytest.approx(97.30923, rel=1e-6)
    beam = Cantilever((8, 2, 4))
    assert beam.compliance(np.full(beam.shape, 0.5)) == pytest.approx(0.003975325, rel=1e-6)


def test_periodic_flows():
    exact = np.exp(-2.0 * 0.02) * taylor_green(16, 2)
    assert relative_error(SpectralFlow(16, 2, 0.02, 0.05, 20)(taylor_green(16, 2)), exact) < 1e-13
    fine = SpectralFlow(16, 3, 0.01, 0.025, 10)(taylor_green(16, 3))
    errors = []
    for n in (16, 32):
        ours = StaggeredFlow(n, 3, 0.01, 0.0125, 20)(taylor_green(n, 3))
        errors.append(relative_error(ours[:: n // 16, :: n // 16, :: n // 16], fine))
    assert errors[0] < 5e-3
    assert 1.9 < np.log2(errors[0] / errors[1]) < 2.1


@pytest.mark.parametrize("solver", [StaggeredFlow, SpectralFlow])
def test_gradients_of_flows(solver):
    flow = solver(8, 2, 1e-3, 0.05, 4)
    start = taylor_green(8, 2) + 0.2 * np.random.default_rng(1).standard_normal((8, 8, 2))
    found = agreement(lambda v: np.sum(flow(v) ** 2), start, steps=(1e-3, 1e-4), directions=3)
    assert 1.0 - found.cosine < 1e-12
    wrong = agreement(lambda v: np.sum(np.round(1e3 * flow(v)) ** 2), start, steps=(1.0,), directions=3)
    assert wrong.error > 0.5  # the gradient of a step function is 0


def test_growth_is_that_of_two_runs():
    flow, start = StaggeredFlow(8, 2, 1e-3, 0.05, 40), taylor_green(8, 2)
    grown = growth(flow, start, (1, 40))
    direction = np.random.default_rng(0).standard_normal(start.shape)
    size = np.linalg.norm(flow.to_faces(direction))
    moved = flow.step.start(flow.to_faces(start + 1e-6 * direction)), flow.step.start(flow.to_faces(start))
    ends = [dp.rollout(flow.step, state, None, 40)["v"] for state in moved]
    allowed = np.linalg.norm(dp.projection(flow.grid)(flow.to_faces(direction))) / size
    assert grown[1] == pytest.approx(np.linalg.norm(ends[0] - ends[1]) / (1e-6 * size * allowed), rel=1e-4)


def test_cylinders():
    velocity = OpenChannel(16, 0.05, 60)()
    assert flux_variation(velocity) < 1e-8  # mass is conserved
    assert np.max(np.abs(OpenChannel(16, 0.05, 60, solid=True)()[7:9, 7:9])) == 0.0
    task = DragTask(16, steps=10, dt=0.04)
    assert dp.check.gradient(task.loss, task.flat() + 0.05 * np.cos(np.arange(16.0)), quick=True).verdict == "agrees"
    assert task.loss(task.flat()) == pytest.approx(task.drag(task.flat()))
    assert task.loss(2.0 * task.flat()) - task.drag(2.0 * task.flat()) == pytest.approx(12.5)


@pytest.mark.parametrize("dim", [2, 3])
def test_tesseract(dim, rng):
    tesseract_core = pytest.importorskip("tesseract_core", reason="needs tesseract-core[runtime]")
    flow = tesseract_core.Tesseract.from_tesseract_api("benchmarks/mosaic/tesseract_api.py")
    start = taylor_green(8, dim) + 0.1 * rng.standard_normal((8,) * dim + (dim,))
    v0 = np.float32(start[:, :, None] if dim == 2 else start)
    settings = {"viscosity": np.float32([0.01]), "dt": np.float32([0.05]), "steps": 10}
    result = flow.apply({"v0": v0, **settings})["result"]
    assert result.shape == v0.shape
    exact = StaggeredFlow(8, dim, float(np.float32(0.01)), float(np.float32(0.05)), 10)
    expected, pull = dp.vjp(exact, v0.reshape(start.shape).astype(float))
    np.testing.assert_allclose(result.reshape(start.shape), expected, atol=1e-6)
    g = np.float32(rng.standard_normal(v0.shape))
    cotangent = flow.vector_jacobian_product({"v0": v0, **settings}, ["v0"], ["result"], {"result": g})["v0"]
    np.testing.assert_allclose(cotangent.reshape(start.shape), pull(g.reshape(start.shape).astype(float)), atol=1e-5)


def test_quick_tables(capsys, monkeypatch, tmp_path):
    densities = np.array([0.2, 0.5])
    values = 16.0 / (1e-3 + 0.999 * densities**3)
    np.savez(
        tmp_path / "thermal_mesh__forward_agreement",
        sweep_values=densities,
        reference_0=values[0],
        reference_1=values[1],
    )
    pairs = stored(tmp_path, "thermal_mesh__forward_agreement")
    assert pairs == [(0.2, values[0]), (0.5, values[1])]
    assert FORWARD["heat, uniform density"][1](0.5) == pytest.approx(values[1])
    monkeypatch.delenv("MOSAIC_REFERENCES", raising=False)
    monkeypatch.setitem(sys.modules, "jax", None)  # not needed here
    main(["--quick"])
    text = capsys.readouterr().out
    assert "no stored results: write --references FOLDER for the part forward" in text
    assert text.count("agrees") == 3
    assert "stays above 0.99 to the end" in text
    with pytest.raises(SystemExit):
        main(["everything"])
    assert "the parts are forward, gradients, horizons, drag, cost, got everything" in capsys.readouterr().err
