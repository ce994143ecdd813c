"""What the pages of the learning examples promise: case B12, learned first guesses, and case A8 by a network."""

import re

import numpy as np
from scripts import example, run


def rows(text, pattern):
    return [(found[1].strip(), *map(float, found.groups()[1:])) for found in re.finditer(pattern, text, re.MULTILINE)]


@example("conductivity_design.py")
def test_conductivity_design():
    """Case B12: ratio 0.75 +- 0.005 at n = 200, both contents as known, and the exact conductivity."""
    printed = run("conductivity_design.py")
    rod, plate = rows(printed, r"^(.*\S) +(\d\.\d+) +(\d\.\d+) +(\d\.\d+) +(\d+) +\S+ +(\S+) to (\S+)$")
    assert abs(rod[3] - 0.75) <= 0.005 and abs(rod[1] - 1 / 3) <= 1e-4 and abs(rod[2] - 1 / 4) <= 1e-4
    assert rod[4] <= 30 and abs(rod[5] - 0.5) <= 1e-2 and abs(rod[6] - 0.5) <= 1e-2
    assert float(re.search(r"off by (\S+)", printed)[1]) <= 1e-2
    assert plate[3] < 0.5


@example("limited_heating.py")
def test_limited_heating():
    """The limit is met in each cell, the multipliers are the change of the loss, and p-norms are too strict."""
    printed = run("limited_heating.py")
    free, limited, low, high = rows(printed, r"^(\S.*\S) +(\d\.\d+) +(\d\.\d+) +(\d+) +\S+$")
    assert free[2] > 1.3 and abs(limited[2] - 1.0) <= 1e-5 and max(low[2], high[2]) < 1.0
    assert free[1] < limited[1] < high[1] < low[1] and limited[3] <= 400
    change, price = map(float, re.findall(r"(-\d\.\d+)(?:,|$)", printed, re.MULTILINE))
    assert abs(change - price) <= 1e-3 * abs(price)


@example("warm_start_learned.py")
def test_warm_start_learned():
    """Every learned guess is far better after k iterations, and none does what multigrid does from zero."""
    printed = run("warm_start_learned.py")
    zero, *learned = rows(printed, r"^(\S.*?) +\d+\.\d +(\S+e\S+) +(\S+e\S+) +(\S+) +(\S+)$")
    assert zero[0] == "zero" and len(learned) == 3
    for _, residual, error, plain, cycles in learned:
        assert residual < zero[1] / 5 and error < zero[2] / 5
        assert zero[4] <= cycles + 0.5 and zero[4] <= 5 < plain < zero[3]


@example("residual_or_physics.py")
def test_residual_or_physics():
    """Case A8: the adjoint finds the start, a network with the adjoint keeps the physics; residuals break it."""
    found = rows(run("residual_or_physics.py"), r"^(\w.*?) +\d+ +\d+\.\d +\d+\.\d +(\S+) +(\S+) +(\S+) +(\S+)$")
    assert len(found) == 4
    by_equation, by_scheme, network, start = found
    assert start[3] <= 0.03 and start[4] == network[4] == 0.0
    assert min(by_equation[4], by_scheme[4]) > 0 and min(by_equation[3], by_scheme[3]) > start[3]


@example("ensemble.py")
def test_ensemble():
    """Two processes give the bits of one, and a few iterations halve the misfit."""
    printed = run("ensemble.py")
    assert "the same bits" in printed and "5 iterations of 12 experiments" in printed
    before, after = map(float, re.search(r"misfit (\S+) -> (\S+);", printed).groups())
    assert after < before / 2


@example("predator_prey.py")
def test_predator_prey():
    """The recorded step has the gradient of the plain one, and all searches find the same rates."""
    printed = run("predator_prey.py")
    assert "program of the step: agrees" in printed
    errors = [float(error) for error in re.findall(r"^(?:diff|rev).* (\S+)$", printed, re.MULTILINE)]
    assert len(errors) == 3 and errors[0] < 1e-5 and errors[2] < 1e-13
    found = re.findall(r"^(?:least_squares|minimize).* (\d+\.\d+) +(\d+\.\d+) %$", printed, re.MULTILINE)
    assert len(found) == 4 and len({misfit for misfit, _ in found}) == 1
    assert all(float(error) < 5.0 for _, error in found)


@example("pendulums.py")
def test_pendulums():
    """A motion for all lengths leaves a tenth of the swing of a motion for one length."""
    printed = run("pendulums.py")
    assert "program of the step: agrees" in printed and "gradient: agrees" in printed
    found = re.findall(r"^(?:one length|all lengths) .* (\S+) m +(\S+) +(\S+)$", printed, re.MULTILINE)
    (place, mean, _), (all_place, all_mean, _) = [tuple(map(float, figures)) for figures in found]
    assert abs(place - 10.0) < 0.01 and abs(all_place - 10.0) < 0.01
    assert all_mean < mean / 10


@example("torch_training.py")
def test_torch_training():
    """The network has the law, though it has seen temperatures alone."""
    found = rows(run("torch_training.py"), r"^ +(-?0\.\d) +(\d\.\d+) +(\d\.\d+)$")
    assert len(found) == 5 and all(abs(mine / true - 1) < 0.03 for _, true, mine in found)


@example("jax_optimiser.py")
def test_jax_optimiser():
    """Where the drop fell, to a hundredth, and how fast it spreads."""
    printed = run("jax_optimiser.py")
    x, y = map(float, re.search(r"fell at \((\S+), (\S+)\), true", printed).groups())
    assert abs(x - 0.35) < 0.01 and abs(y - 0.6) < 0.01
    assert abs(float(re.search(r"diffusivity (\S+),", printed)[1]) - 0.01) < 5e-4


@example("mesh_design.py")
def test_mesh_design():
    """A mesh of scikit-fem: the textbook's derivative, and near the exact optimum, which coarse elements undercut."""
    printed = run("mesh_design.py")
    assert float(re.search(r"textbooks: difference (\S+)", printed)[1]) < 1e-9 and "differences: agrees" in printed
    assert abs(float(re.search(r"iterations (\S+) ", printed)[1]) / (np.pi / 9) - 1) < 0.02
    assert float(re.search(r"mean difference (\S+)", printed)[1]) < 0.05


@example("mbb_beam.py")
def test_mbb_beam():
    """The published compliances of both filters to 0.1 %, with our derivative."""
    printed = run("mbb_beam.py")
    assert float(re.search(r"textbooks: difference (\S+)", printed)[1]) < 1e-9 and "differences: agrees" in printed
    table = rows(printed, r"^optimality criteria, (.*\S) +(\d+\.\d+) +(\d+\.\d+) +(\d+) ")
    assert [row[0] for row in table] == ["sensitivity filter", "density filter"]
    for _, compliance, published, iterations in table:
        assert abs(compliance / published - 1) <= 1e-3 and iterations < 200
    searches = rows(printed, r"^(moving asymptotes|augmented Lagrangian), density filter +(\d+\.\d+) +(\d+) ")
    volumes = re.findall(r", volume (\S+),", printed)
    assert len(searches) == len(volumes) == 2
    for (_, compliance, _), volume in zip(searches, volumes):
        assert 233.3 < compliance < 233.71 and abs(float(volume) - 0.5) < 1e-3


@example("membrane_design.py")
def test_membrane_design():
    """The optimality condition of the lowest eigenvalue, and a refused cluster whose values are raised alike."""
    printed = run("membrane_design.py")
    heavy, light = map(float, re.search(r"u\^2 up to (\S+) in heavy cells, from (\S+) in light ones", printed).groups())
    assert heavy < light
    before, after = map(float, re.search(r"^eigenvalue (\S+) -> (\S+)$", printed, re.MULTILINE).groups())
    assert after > 1.35 * before
    assert "pairs 1 to 2 of eigenpairs have no derivatives one by one" in printed
    second, third = map(
        float, re.search(r"second and third eigenvalue .* -> (\S+), (\S+)$", printed, re.MULTILINE).groups()
    )
    assert 38.5 < second <= third < 1.03 * second
    assert np.allclose([float(mean) for mean in re.findall(r"mean density (\S+)", printed)], 1.5, atol=1e-5)


@example("volume_to_point.py")
def test_volume_to_point():
    """Right derivatives, the volume kept in every stage, and each design best in what it was made for."""
    printed = run("volume_to_point.py")
    assert printed.count(": agrees") == 3
    table = rows(printed, r"^(mean|peak), \S+ \S+ +(\d+) +(0\.\d+) +(\S+) +(\S+) +(\S+) +\S+$")
    assert len(table) == 15 and all(abs(row[2] - 0.4) < 1e-3 for row in table)
    by_hand, for_mean, for_peak = table[4::5]
    assert for_mean[3] < 1.01 * by_hand[3] and for_mean[3] < for_peak[3]
    assert for_peak[4] < 0.85 * for_mean[4]
    assert for_mean[5] < 0.6 * table[5][5]  # projection in stages removes grey


@example("data_assimilation.py")
def test_data_assimilation():
    """The analysis is better than the background, the weak constraint than the strong one, and a transform pays."""
    printed = run("data_assimilation.py")
    assert "gradient: agrees" in printed and float(re.search(r"adjoint test: (\S+)", printed)[1]) < 1e-12
    (_, *strong), (_, *weak) = rows(printed, r"^(strong|weak) +(\S+) +(\S+) +(\S+) ")
    assert strong[2] < strong[0] < strong[1] and weak[2] < 0.85 * strong[2] and weak[0] < 0.85 * strong[0]
    searches = {row[0]: row[1:] for row in rows(printed, r"^(\w+, \w+) +(\S+) +(\d+) +(\S+) +(\S+) +(\S+)$")}
    assert len(searches) == 4
    for name in ("gauss_newton, z", "lbfgs, z", "lbfgs, metric"):
        assert searches[name][3] < 0.35 and searches[name][4] < 0.3
        assert searches[name][0] < 0.7 * searches["lbfgs, plain"][0]
    assert abs(searches["lbfgs, z"][0] / searches["lbfgs, metric"][0] - 1) < 0.02


@example("pylops_exchange.py")
def test_pylops_exchange():
    """PyLops solves with our heat, and we search through a camera of PyLops."""
    printed = run("pylops_exchange.py")
    edges, squares = map(float, re.search(r"off by (\S+) with jumps counted, (\S+) by squares", printed).groups())
    before, after = map(float, re.search(r"off by (\S+) -> (\S+)$", printed, re.MULTILINE).groups())
    assert edges < 0.05 and edges < squares / 2 and after < before / 2
    assert printed.count("agrees") == 2 and "PyLops finds the transpose right" in printed
