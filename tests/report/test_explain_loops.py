"""What explain says of time loops: bytes kept, steps run again, solves that a zero step skips."""

import autograd.numpy as anp
import numpy as np

import sparsedp as dp
from sparsedp.autodiff.tape import untraced

GRID = dp.Grid((12, 10), size=(1.0, 1.0))
L = dp.laplacian(GRID, dp.dirichlet)
U = np.sin(np.arange(120.0)).reshape(GRID.shape)


def test_a_time_loop():
    """Every state kept: nothing runs twice. Under a budget: fewer bytes, more steps, and both are said."""
    move = dp.transport(GRID, "upwind")
    wind = 0.1 * np.sin(np.arange(float(GRID.faces.size)))

    def loss(memory):
        return lambda v: anp.sum(dp.rollout(lambda u, w: move(u, w, 0.01), U, v, 20, memory=memory) ** 2)

    free = dp.explain(loss(None), wind)
    tight = dp.explain(loss(8 * U.nbytes + 2 * wind.nbytes), wind)
    assert free.counts["rollout.step", "forward"] == free.counts["rollout.step", "vjp"] == 20
    assert free.recomputation == 1.0 and free.tape_bytes >= 20 * U.nbytes
    assert tight.recomputation == 1 + tight.counts["rollout.step", "recomputed"] / 20 > 1.0
    assert tight.tape_bytes < free.tape_bytes - 10 * U.nbytes
    assert tight.value == free.value


def test_implicit_steps_take_one_adjoint_solve_each():
    step = dp.stepper("backward_euler", lambda u, nu: nu * L(u), 0.01)
    plan = dp.explain(lambda nu: anp.sum(dp.rollout(step, U, nu, 3) ** 2), 0.1)
    assert plan.counts["rollout.step", "forward"] == plan.totals["adjoint solves"] == 3


def test_without_diffusion_no_diffusion_solve():
    """nu = 0: the identity; nothing set up, nothing solved, and it is said."""
    from sparsedp.integrators.runge_kutta import Resolvent
    from sparsedp.solvers.choose_method import check_settings

    spread = Resolvent(L, "diffusion", check_settings("auto", 1e-10, None, "raise", {}))
    plan = dp.explain(lambda u: anp.sum(spread(0.0, u) ** 2), U)
    assert plan.totals["set-ups built"] == plan.totals["forward solves"] == plan.totals["adjoint solves"] == 0
    assert any("no solve and no set-up" in sentence for sentence in plan.skipped)


def test_comparisons_and_shapes_in_a_loss():
    kinds = list(untraced)
    plan = dp.explain(lambda u: anp.sum(anp.where(L(u) > 0, L(u), 0.0) ** 2) / anp.size(u), U)
    assert plan.counts["laplacian", "forward"] == 2 and plan.counts["laplacian", "vjp"] == 1
    assert list(untraced) == kinds  # none stays behind


def test_each_scene_skips_what_it_does_not_need():
    """By the public steps alone: what is not needed is not built, not solved, not taped, and a line says so."""
    n = 4
    move = dp.transport(GRID, "upwind")
    wind = 0.1 * np.sin(np.arange(float(GRID.faces.size)))
    carried = dp.explain(lambda v: anp.sum(dp.rollout(lambda u, w: move(u, w, 0.01), U, v, n) ** 2), wind)
    for word in ("hierarchies built", "set-ups built", "matrices assembled", "forward solves", "adjoint solves"):
        assert carried.totals[word] == 0, word  # no projection: no pressure
    assert any(sentence.startswith("solves: none") for sentence in carried.skipped)

    step = dp.stepper("backward_euler", L, 0.01)
    spread = lambda start, k: dp.explain(lambda u: anp.sum(dp.rollout(step, u, k, n) ** 2), start)
    plan = spread(U, 0.5)  # a fixed operator: one set-up, 2 n solves
    assert plan.totals["set-ups built"] == 1 and plan.totals["hierarchies built"] == 0
    assert plan.totals["forward solves"] + plan.totals["adjoint solves"] == 2 * n
    still = spread(U, 0.0)  # nu = 0: no diffusion
    assert still.totals["set-ups built"] == still.totals["forward solves"] == still.totals["adjoint solves"] == 0
    assert np.array_equal(dp.rollout(step, U, 0.0, n), U)
    only = dp.explain(lambda u: anp.sum(dp.rollout(step, u, 0.5, n) ** 2), U, gradient=False)
    assert only.totals["forward solves"] == n and only.totals["adjoint solves"] == only.tape_nodes == 0


def test_an_operator_whose_transpose_ran_without_a_tape_is_not_called_independent_of_x():
    grid = dp.Grid((4, 4), periodic=True)
    step = dp.flow_step(grid, 0.1, 0.01)

    def energy(v):
        return anp.sum(dp.rollout(step, step.start(v), None, 3)["v"] ** 2)

    plan = dp.explain(energy, np.arange(32.0) / 32)
    assert not [sentence for sentence in plan.skipped if "does not depend on x" in sentence]
