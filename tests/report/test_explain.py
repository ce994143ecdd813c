"""What explain counts: exact calls, solves and set-ups of whole scenes, and what was left out."""

import json
import subprocess
import sys

import autograd.numpy as anp
import numpy as np
import pytest

import sparsedp as dp
from sparsedp._utils.counters import count, note

GRID = dp.Grid((12, 10), size=(1.0, 1.0))
G = dp.gradient(GRID, dp.dirichlet)
D = dp.divergence(GRID)
L = dp.laplacian(GRID, dp.dirichlet)
U = np.sin(np.arange(120.0)).reshape(GRID.shape)
K = 1.5 + np.sin(np.arange(float(GRID.faces.size)))
N = 6


def one_operator(u):
    return anp.sum(L(u) ** 2)


def twice_the_same(u):
    return anp.sum(L(L(u)) ** 2)


def not_on_the_tape(u):
    return anp.sum(L(U) * u)


def composed(u):
    return anp.sum((D @ G)(u) ** 2)


def two_branches(x):
    return anp.sum(G(x["u"]) * x["v"])


def fixed_steps(u):
    """Implicit diffusion with a fixed operator, n steps: one set-up, 2 n solves."""
    solve = dp.inverse(dp.identity(GRID.cells) - 0.01 * L)
    for _ in range(N):
        u = solve(u)
    return anp.sum(u**2)


def loop_of_operators(u):
    for _ in range(N):
        u = u + 1e-4 * L(u)
    return anp.sum(u**2)


def elliptic(k):
    return anp.sum(dp.elliptic_solver(D, G, "direct")(k, U) ** 2)


def elliptic_in_b(b):
    return anp.sum(dp.elliptic_solver(D, G, "direct")(K, b) ** 2)


def elliptic_in_both(x):
    return anp.sum(dp.elliptic_solver(D, G, "direct")(x[0], x[1]) ** 2)


def value_only(u):
    return anp.sum(dp.inverse(-L, "multigrid")(U) ** 2) + anp.sum(u)


def nothing_to_solve(u):
    return anp.sum(dp.inverse(-L, "direct")(0 * U) * u)


def hierarchy(u):
    return anp.sum(dp.inverse(-L, "multigrid")(u) ** 2)


def entries(data):
    return anp.sum(dp.matrix_solver([[1, 0], [1, 1]])(data, np.array([2.0, 5.0])) ** 2)


def root_of_a_cubic(p):
    return anp.sum(dp.implicit(lambda x, p: x**3 - p, jacobian=lambda x, p: np.diag(3 * x**2))(np.ones(3), p))


# scene: (loss, x, {(name, kind): calls}); every other call of these kinds is 0
SCENES = {
    "one operator": (one_operator, U, {("laplacian", "forward"): 1, ("laplacian", "vjp"): 1}),
    "twice the same": (twice_the_same, U, {("laplacian", "forward"): 2, ("laplacian", "vjp"): 2}),
    "not on the tape": (not_on_the_tape, U, {("laplacian", "forward"): 1}),
    "composed": (composed, U, {("divergence @ gradient", "forward"): 1, ("divergence @ gradient", "vjp"): 1}),
    "two branches": (
        two_branches,
        {"u": U, "v": K, "n": 3},
        {("gradient", "forward"): 1, ("gradient", "vjp"): 1},
    ),
    "fixed operator, n steps": (
        fixed_steps,
        U,
        {
            ("inverse(identity + -0.01 * laplacian)", kind): many
            for kind, many in dict(forward=N, vjp=N, solve=N, adjoint=N, setup=1, reused=2 * N - 1).items()
        },
    ),
    "a loop": (loop_of_operators, U, {("laplacian", "forward"): N, ("laplacian", "vjp"): N}),
    "elliptic in k": (
        elliptic,
        K,
        {
            **{("elliptic_solver", k): 1 for k in ("forward", "vjp", "solve", "adjoint", "setup", "reused")},
            **{(name, "forward"): 1 for name in ("elliptic_solver.T", "divergence.T", "gradient")},
        },
    ),
    "elliptic in b": (
        elliptic_in_b,
        U,
        {
            **{("elliptic_solver", k): 1 for k in ("forward", "vjp", "solve", "adjoint", "setup", "reused")},
            ("elliptic_solver.T", "forward"): 1,
        },
    ),
    "elliptic in both: one adjoint": (
        elliptic_in_both,
        (K, U),
        {
            **{("elliptic_solver", k): 1 for k in ("forward", "vjp", "solve", "adjoint", "setup", "reused")},
            **{(name, "forward"): 1 for name in ("elliptic_solver.T", "divergence.T", "gradient")},
        },
    ),
    "value without gradient": (
        value_only,
        U,
        {("inverse(-laplacian)", k): 1 for k in ("forward", "solve", "setup", "hierarchy")},
    ),
    "nothing to solve": (
        nothing_to_solve,
        U,
        {("inverse(-laplacian)", k): 1 for k in ("forward", "solve", "setup", "skipped")},
    ),
    "a hierarchy": (
        hierarchy,
        U,
        {("inverse(-laplacian)", k): 1 for k in ("forward", "vjp", "solve", "adjoint", "setup", "reused", "hierarchy")},
    ),
    "entries of a matrix": (
        entries,
        np.array([2.0, 1.0, 4.0]),
        {
            **{("matrix_solver", k): 1 for k in ("forward", "vjp", "solve", "adjoint", "setup", "reused")},
            ("matrix_solver.T", "forward"): 1,
            ("entries", "forward"): 2,
        },
    ),
}
EXACT = ("forward", "vjp", "jvp", "solve", "adjoint", "setup", "reused", "hierarchy", "skipped")


@pytest.mark.parametrize("name", SCENES)
def test_counts(name):
    loss, x, wanted = SCENES[name]
    plan = dp.explain(loss, x)
    assert {key: n for key, n in plan.counts.items() if key[1] in EXACT} == wanted
    assert plan.value == dp.value_and_grad(loss)(x)[0]
    assert plan.totals["adjoint solves"] == sum(n for (_, kind), n in wanted.items() if kind == "adjoint")


def plan_of(name):
    return dp.explain(*SCENES[name][:2])


def skipped(plan, words):
    return [sentence for sentence in plan.skipped if words in sentence]


def test_what_a_scene_does_not_need_is_skipped():
    plan = plan_of("one operator")
    assert plan.totals["hierarchies built"] == plan.totals["set-ups built"] == plan.totals["forward solves"] == 0
    assert skipped(plan, "solves: none") and skipped(plan, "JVPs")
    assert skipped(plan_of("not on the tape"), "VJP of laplacian: never called")
    assert skipped(plan_of("elliptic in k"), "elliptic_solver in b, shift: not asked")
    assert skipped(plan_of("elliptic in b"), "elliptic_solver in k, shift: not asked")
    assert not skipped(plan_of("elliptic in both: one adjoint"), "in k")
    assert skipped(plan_of("two branches"), "1 leaves of x, which are not floating")
    assert skipped(plan_of("value without gradient"), "adjoint solve of inverse(-laplacian): nothing asks for it")
    assert skipped(plan_of("nothing to solve"), "1 solves of inverse(-laplacian): the right-hand side is 0")
    assert skipped(plan_of("fixed operator, n steps"), "multigrid hierarchy for inverse")


def test_gradient_not_asked_nothing_taped():
    plan = dp.explain(one_operator, U, gradient=False)
    assert plan.tape_nodes == plan.tape_bytes == plan.counts["laplacian", "vjp"] == 0
    assert "the gradient: not asked, nothing taped" in plan.skipped


def test_no_matrix_for_constant_coefficients_on_a_box():
    solve = dp.inverse(-L.matrix_free(), "separable")
    plan = dp.explain(lambda b: anp.sum(solve(b) ** 2), U)
    assert plan.totals["matrices assembled"] == 0 and plan.totals["hierarchies built"] == 0
    assert skipped(plan, "set-up of inverse(-laplacian): built before, 2 solves reuse it")
    assert plan.counts["inverse(-laplacian)", "reused"] == 2
    free = dp.explain(lambda u: anp.sum(L.matrix_free()(u) ** 2), U)
    assert free.totals["matrices assembled"] == 0 and skipped(free, "matrix of laplacian: not assembled")
    listed = dp.laplacian(GRID).matrix_free()
    assert dp.explain(lambda u: anp.sum(listed.explicit()(u) ** 2), U).totals["matrices assembled"] == 1


def test_an_identity_is_no_arithmetic():
    plan = dp.explain(lambda u: anp.sum(dp.identity(GRID.cells)(u) ** 2), U)
    assert skipped(plan, "arithmetic of identity: an identity, 1 copies")


def test_bytes_on_the_tape():
    """u**2 keeps u; L(u) keeps nothing; each buffer once."""
    size = U.nbytes
    assert dp.explain(one_operator, U).tape_bytes == size
    assert dp.explain(lambda u: anp.sum(L(u)), U).tape_bytes == 0
    assert dp.explain(lambda u: anp.sum(u * u), U).tape_bytes == size
    assert dp.explain(lambda u: anp.sum(anp.sin(u) * anp.exp(u)), U).tape_bytes == 3 * size  # u, sin u, exp u
    assert plan_of("a loop").tape_bytes == size


def test_newton():
    plan = dp.explain(root_of_a_cubic, np.array([8.0, 27.0, 1.0]))
    (name,) = {name for name, kind in plan.counts if kind == "vjp" and name.startswith("implicit")}
    assert plan.counts[name, "forward"] == plan.counts[name, "vjp"] == 1
    assert plan.counts[f"{name}.jacobian", "adjoint"] == 1
    assert skipped(plan, f"derivative of {name} in guess: not asked")
    assert "Newton's method, Jacobian given" in str(plan)


def test_other_libraries_report_through_the_counters():
    """A time loop, or any rule, adds its own counts and reasons."""

    def advance(u):
        count("rollout.step", "forward", 10)
        count("rollout.step", "recomputed", 5)
        count("rollout", "bytes", 1000)
        note("rollout", "skipped", "nu = 0, no diffusion solve")
        return u**2

    square = dp.differentiable("rollout", advance, lambda nums, ans, u: lambda g: (2 * u * g,))
    plan = dp.explain(lambda u: anp.sum(square(u)), U)
    assert plan.recomputation == 1.5 and plan.totals["steps recomputed"] == 5
    assert plan.tape_bytes == 1000 + U.nbytes
    assert skipped(plan, "rollout: nu = 0, no diffusion solve (1 times)")


def test_text_and_data():
    plan = plan_of("fixed operator, n steps")
    text = str(plan)
    for words in ("recomputation factor 1.00", f"{N} forward solves", f"{N} adjoint solves", "skipped:", "1 set-ups"):
        assert words in text
    data = json.loads(json.dumps(plan.to_dict()))
    assert data["counts"]["inverse(identity + -0.01 * laplacian)"]["adjoint"] == N
    assert data["skipped"] == plan.skipped and repr(plan) == text
    with pytest.warns(DeprecationWarning, match="left_out is deprecated"):
        assert plan.left_out == data["left_out"] == plan.skipped
    assert all(row["seconds"] >= 0 for row in plan.rows)
    assert sum(row["seconds"] for row in plan.rows) <= sum(plan.seconds)
    with pytest.raises(AttributeError, match="Plan is frozen; make a new one instead of setting value"):
        plan.value = 1.0
    assert plan.counts["never", "called"] == 0


def test_extras_are_not_imported():
    code = (
        "import numpy as np, autograd.numpy as anp, sparsedp as dp; g = dp.Grid((4, 4)); L = dp.laplacian(g)\n"
        "print(*dp.explain(lambda u: anp.sum(L(u) ** 2), np.ones((4, 4))).skipped, sep='\\n')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for name in ("pyamg", "matplotlib", "tqdm"):
        assert f"not imported: {name}" in done.stdout
    assert not skipped(dp.explain(one_operator, U), "not imported: autograd")


def test_what_the_loss_raises_passes_through():
    with pytest.raises(dp.errors.ShapeError, match="the loss must be a scalar, got an array of shape"):
        dp.explain(L, U)
    with pytest.raises(ZeroDivisionError):
        dp.explain(lambda u: 1 / 0, U)
    from sparsedp._utils.counters import active, thread

    assert not active and not thread.calls and not thread.node_hooks


def test_held_arrays_are_found_in_any_container():
    from functools import partial
    from types import SimpleNamespace

    from sparsedp.check.nodes import bytes_held

    late = lambda g: unset + g  # a cell that is never filled
    if False:
        unset = 0.0
    kept = {"a": [np.ones(3), (np.ones(4),)], "b": np.ones((2, 2))[0]}
    nodes = [
        SimpleNamespace(vjp=partial(lambda g, k: g, k=kept), held=()),
        SimpleNamespace(vjp=late, held=(np.ones(5),)),
    ]
    assert bytes_held(nodes) == 8 * (3 + 4 + 4 + 5)
