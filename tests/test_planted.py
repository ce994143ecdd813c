"""The test of the tests: bugs in every part of the package, each planted in a copy, each caught by tests named here.

They are caught by what runs by default. All of it:  python -m pytest -m slow tests/test_planted.py
"""

import itertools
import os
import shutil
from functools import cache
from typing import NamedTuple

import pytest
from fresh_process import run_python
from launch import MISSING
from planted_on_ranks import BUGS_ON_RANKS
from sources import ROOT

PARTS = 8  # of the tests that must pass without a bug
TIMES = itertools.count(1_000_000_000)  # in seconds, for write_as_changed


class Bug(NamedTuple):
    """What stands once in a file or a folder, what stands there instead, and the tests that must fail then."""

    place: str
    right: str
    wrong: str
    tests: str
    compiled: bool = False  # whether it is in what runs with numba only
    on_ranks: bool = False  # whether it is seen on several processes only


BUGS = {
    "a free constant of cut cells that is not weighted by volumes": Bug(
        "solvers/parametric.py",
        "        return x - self._component_sums(weights * x, entries) / total\n",
        "        return x\n",
        "tests/solvers/test_cut_cells.py::test_the_free_constant_is_that_of_inverse",
    ),
    "data of cut cells that are projected without weights": Bug(
        "solvers/parametric.py",
        "b - weights * self._component_sums(b, entries) / total, 0.0)",
        "b - self._component_sums(b, entries) / total, 0.0)",
        "tests/solvers/test_cut_cells.py::test_the_free_constant_is_that_of_inverse",
    ),
    "diffusion in cut cells without the flux through the wall": Bug(
        "operators/cut_operators.py",
        "        total = self._outflow(through_faces) + self._flux_into_walls(field, values, k, wall_k, walls)\n",
        "        total = self._outflow(through_faces)\n",
        "tests/solvers/test_cut_cells.py::test_linear_solutions_are_exact",
    ),
    "a slope at the wall without the derivative of its place in the level": Bug(
        "operators/cut_wall_slope.py",
        "        (positions[axis][is_near] - walls.centroids[axis][numbers])",
        "        (positions[axis][is_near] - np.asarray(sample(walls.centroids[axis]))[numbers])",
        "tests/solvers/test_cut_cells.py::test_derivatives_agree_with_differences",
    ),
    "values of order 2 on faces that are extrapolated to the wrong side": Bug(
        "operators/cut_face_values.py",
        "            below = below + axis.to_below(change)\n",
        "            below = below - axis.to_below(change)\n",
        "tests/operators/test_cut_operators.py::test_advection_of_order_2_is_exact_for_linear_fields",
    ),
    "a projection around a body whose pressure ignores the density": Bug(
        "solvers/cut_cells.py",
        '        return self._solve(-self.divergence(v), k=mobility, nullspace="project")\n',
        '        return self._solve(-self.divergence(v), nullspace="project")\n',
        "tests/flow/test_cut_projection.py::test_without_a_wall_it_is_the_projection_of_the_grid",
    ),
    "two walls in a gap whose values are taken as equal": Bug(
        "operators/cut_wall_slope.py",
        "        terms = self.of_difference * (",
        "        terms = 0.0 * self.of_difference * (",
        "tests/operators/test_cut_operators.py::test_linear_fields_in_gaps_are_exact",
    ),
    "a wall in a gap at the distance of its whole width": Bug(
        "operators/cut_wall_slope.py",
        "half = anp.sqrt(half**2 + ",
        "half = anp.sqrt((6.0 * half) ** 2 + ",
        "tests/operators/test_cut_operators.py::test_solutions_in_gaps_of_one_cell",
    ),
    "a gap between a body and a wall of the grid that is no gap": Bug(
        "operators/cut_wall_slope.py",
        "        closeness = facing * ",
        "        closeness = 0.0 * facing * ",
        "tests/operators/test_cut_operators.py::test_gaps_between_the_body_and_a_wall_of_the_grid",
    ),
    "a bound step that takes a mixed wall for an inflow": Bug(
        "advection/eulerian.py",
        "len(self.settings.space.parts) == 1 and not self._repeated[0].size\n",
        "len(self.settings.space.parts) == 1\n",
        "tests/advection/test_patches.py",
        compiled=True,
    ),
    "one number as a value and as a slope on a wall": Bug(
        "operators/masks_and_lift.py",
        "                if np.size(sample(part)) == 1 and (isbox(part) or np.any(part != 0)):\n",
        "                if False:\n",
        "tests/operators/test_patches.py",
    ),
    "a wall that is open as its first line is": Bug(
        "flow/projection_passes.py",
        "        if np.any(lines_of_mask != kept):",
        "        if False:",
        "tests/flow/test_openings.py",
        compiled=True,
    ),
    "the points of a face field beside a patch": Bug(
        "advection/settings.py",
        "        if not isinstance(wall, MixedWall) or axis == number:\n            return wall\n",
        "        if not isinstance(wall, MixedWall) or axis != number:\n            return wall\n",
        "tests/advection/test_patches.py",
    ),
    "wall values of the end of a step at its beginning": Bug(
        "flow/scalars.py",
        "self._parts(before + after, dtype)",
        "self._parts(after + after, dtype)",
        "tests/flow/test_flow_scalars.py::test_wall_values_that_are_a_function",
    ),
    "wall values that turn a field into double precision": Bug(
        "flow/scalars.py",
        "None if part is None else cast(part, dtype) for",
        "None if part is None else part for",
        "tests/flow/test_flow_scalars.py::test_wall_values_that_are_a_function",
    ),
    "eigenpairs: missing copies of a multiple eigenvalue": Bug(
        "solvers/eigensolver.py",
        "    for _ in range(MOST_RESTARTS):\n        new_values",
        "    for _ in range(1):\n        new_values",
        "tests/solvers/test_eigenpairs.py",
    ),
    "eigenpairs: the largest in the order of their distances": Bug(
        "solvers/eigensolver.py",
        '    chosen = order[:k][np.argsort(values[order[:k]], kind="stable")]\n',
        "    chosen = np.sort(order[:k])\n",
        "tests/solvers/test_eigenpairs.py",
    ),
    "eigenpairs: vectors of any sign": Bug(
        "solvers/eigensolver.py",
        "return vector * (np.conj(first) / np.abs(first))",
        "return vector",
        "tests/solvers/test_eigenpairs.py",
    ),
    "eigenpairs: the normalisation is not differentiated": Bug(
        "solvers/eigen_rules.py",
        "_combined(block, y) + 0.5 * _combined(c.T, ans), ans)",
        "_combined(block, y), ans)",
        "tests/solvers/test_eigenpairs.py",
    ),
    "eigenpairs: the mass in the derivative of a value": Bug(
        "solvers/eigen_rules.py",
        "                weights = -0.5 * (anp.dot(g, ans) + anp.dot(ans, g))\n",
        "                weights = -0.5 * anp.dot(g, ans)\n",
        "tests/solvers/test_eigenpairs.py",
    ),
    "eigenpairs: vectors are constant in the second derivative": Bug(
        "solvers/eigen_rules.py",
        "                gradients[1] = weights * self.mass.product(crossed, of_mass)\n",
        "                gradients[1] = 0.0 * self.mass.product(crossed, of_mass)\n",
        "tests/solvers/test_eigenpairs.py",
    ),
    "eigenpairs: a member of a cluster has a derivative": Bug(
        "solvers/eigen_rules.py",
        "            if np.max(g) - np.min(g) > tolerance * np.max(np.abs(g)):\n                raise refusal()\n",
        "",
        "tests/solvers/test_eigenpairs.py",
    ),
    "eigenpairs: a cut cluster is not seen": Bug(
        "solvers/eigenpairs.py",
        "            cut.append(any(self._are_equal(end, value) for end in ends for value in spectrum.beyond))\n",
        "            cut.append(False)\n",
        "tests/solvers/test_eigenpairs.py",
    ),
    "eigenpairs: coefficients are not copied": Bug(
        "solvers/eigen_rules.py",
        "    copy = np.array(value, np.result_type(value, float))\n    copy.flags.writeable = False\n    return copy\n",
        "    return value\n",
        "tests/solvers/test_eigenpairs.py",
    ),
    "the first field beyond a wall in all stages": Bug(
        "advection/eulerian.py",
        "                beyond = self._values_beyond_walls(x, inflow)\n                slopes",
        "                beyond = self._values_beyond_walls(u, inflow)\n                slopes",
        "tests/advection/test_patches.py",
        compiled=True,
    ),
    "a cotangent of inflow where no inflow is": Bug(
        "advection/eulerian.py",
        "                of_inflow[repeated] = 0.0\n",
        "",
        "tests/advection/test_patches.py",
        compiled=True,
    ),
    "inflow on the whole of a wall, in the matrices": Bug(
        "advection/control_volumes.py",
        "        return sides._replace(wall=np.where(is_repeated, -1, sides.wall))\n",
        "        return sides\n",
        "tests/advection/test_patches.py",
    ),
    "inflow on the whole of a wall, in ghost cells": Bug(
        "advection/ghost_cells.py",
        "where=chosen)",
        "where=True)",
        "tests/advection/test_patches.py",
    ),
    "an opening that is the whole wall": Bug(
        "flow/projection_setup.py",
        "            is_open: Any = wall.faces_with(open_side)\n",
        "            is_open: Any = open_side(wall.regions[0][0])\n",
        "tests/flow/test_openings.py",
    ),
    "the pressure of an opening on the whole wall": Bug(
        "grid/boundary_conditions.py",
        "        return wall.map(change)\n",
        "        return change(wall.regions[0][0])\n",
        "tests/flow/test_openings.py",
    ),
    "an inflow on part of a wall that counts as one on the whole wall": Bug(
        "flow/projection_setup.py",
        "                enters = enters & wall.faces_with(lambda condition: condition == inflow)\n",
        "                pass\n",
        "tests/flow/test_openings.py::test_rules_for_openings",
    ),
    "the end of an opening that is free": Bug(
        "grid/boundary_conditions.py",
        "np.moveaxis(padded[:-1] | padded[1:], 0, position)",
        "np.moveaxis(padded[:-1] & padded[1:], 0, position)",
        "tests/flow/test_openings.py",
    ),
    "a wall velocity in an opening": Bug(
        "flow/momentum.py",
        "        return tuple(on_faces(entry.axis, factor, wall.faces_with(",
        "        return tuple(on_faces(entry.axis, factor, ~wall.faces_with(",
        "tests/flow/test_openings.py",
    ),
    "the angle of a flow through an inlet dropped": Bug(
        "flow/momentum.py",
        "            masks.append(touching.reshape(-1))\n",
        "            masks.append(False & touching.reshape(-1))\n",
        "tests/flow/test_openings.py",
    ),
    "a patch that is ignored by a function without patches": Bug(
        "grid/boundary_conditions.py",
        "    if not accepted:\n        for axis, side, wall",
        "    if False:\n        for axis, side, wall",
        "tests/operators/test_patches.py",
    ),
    "both ends of an interval that belong to a patch": Bug(
        "grid/boundary_conditions.py",
        "(centres < stop - ON_END * widths)",
        "(centres < stop + ON_END * widths)",
        "tests/operators/test_patches.py::test_which_faces_belong_to_an_interval",
    ),
    "patches that overlap": Bug(
        "grid/boundary_conditions.py",
        "        if overlap:\n",
        "        if False:\n",
        "tests/operators/test_errors_patches.py",
    ),
    "values of a patch on the rest of its wall": Bug(
        "grid/boundary_conditions.py",
        "anp.where(faces, _spread",
        "anp.where(~faces, _spread",
        "tests/operators/test_patches.py",
    ),
    "the condition of a patch on the rest of its wall": Bug(
        "operators/stencils.py",
        "*entries), faces)\n",
        "*entries), ~faces)\n",
        "tests/operators/test_patches.py",
    ),
    "one condition for the values of all faces of a wall": Bug(
        "operators/stencils.py",
        "        terms += on_faces(axis, wall_slopes(grid, axis, side, condition), faces)\n",
        "        terms += on_faces(axis, wall_slopes(grid, axis, side, wall.regions[0][0]), faces)\n",
        "tests/operators/test_patches.py",
    ),
    "a patch that overwrites what other terms computed": Bug(
        "operators/structure/kronecker.py",
        "        if not accumulate:\n            out[...] = 0\n        out.reshape(-1)[row]",
        "        if True:\n            out[...] = 0\n        out.reshape(-1)[row]",
        "tests/operators/test_patches.py",
    ),
    "memory of a compiled program that the open loop still reads": Bug(
        "autodiff/compiled_program.py",
        "            start = min(start, self._group_start)\n",
        "            pass\n",
        "tests/autodiff/test_jit_compile.py",
    ),
    "entries of a movement that come from the wrong argument": Bug(
        "autodiff/compiled_program.py",
        'np.searchsorted(ends, places, side="right")',
        'np.searchsorted(ends, places, side="left")',
        "tests/autodiff/test_jit_compile.py",
    ),
    "a compiled loop that cuts the cotangent one step late": Bug(
        "autodiff/compiled_program.py",
        "builder.srem(builder.sub(n, step), period), zero)",
        "builder.srem(builder.sub(builder.sub(n, step), ir.Constant(INDEX, 1)), period), zero)",
        "tests/trajectory/test_rollout_compile.py",
    ),
    "cotangents of params of a compiled loop that are not added": Bug(
        "autodiff/compiled_program.py",
        "self.store(self.builder.fadd(self.load(pointer, i, dtype), entry), pointer, i, dtype)",
        "self.store(entry, pointer, i, dtype)",
        "tests/trajectory/test_rollout_compile.py",
    ),
    "a compiled program that differs and is used": Bug(
        "autodiff/compiled_program.py",
        "            if not all(map(self._agree, expected, results)):\n",
        "            if False:\n",
        "tests/autodiff/test_jit_compile.py::test_a_wrong_translation_is_not_used",
    ),
    "a compiled loop that is not compared": Bug(
        "trajectory/recorded_steps.py",
        "            if not self._agrees(loop):\n",
        "            if False:\n",
        "tests/autodiff/test_jit_compile.py::test_a_wrong_translation_is_not_used",
    ),
    "NaN that a compiled program returns without its recorded program": Bug(
        "autodiff/compiled_program.py",
        "        if not self._run(memory):\n            return self._recorded(*values)\n",
        "        self._run(memory)\n",
        "tests/autodiff/test_jit_compile.py::test_values_that_are_not_finite_are_those_of_numpy",
    ),
    "constants of a program that the caller can still change": Bug(
        "autodiff/program_trace.py",
        "        kept = tuple(arg if type(arg) is Slot else constant(arg) for arg in args)\n",
        "        kept = tuple(args)\n",
        "tests/autodiff/test_jit.py::test_constants_are_copied",
    ),
    "a decision frozen in a program": Bug(
        "autodiff/program_trace.py",
        "    if type(box._node) is ProgramNode:\n        error = ",
        "    if False:\n        error = ",
        "tests/autodiff/test_errors_jit.py",
    ),
    "a constant sum of cotangents that a program adds to in place": Bug(
        "autodiff/tape.py",
        "        return total[0] + g, True\n    return add_outgrads((total[0], False), g)[0], False\n",
        "        return add_outgrads((total[0], True), g)\n    return add_outgrads((total[0], False), g)[0], False\n",
        "tests/autodiff/test_jit.py",
    ),
    "a comparison that failed and counts as passed": Bug(
        "autodiff/jit.py",
        "            program.compare([sample(variable) for variable in variables])\n",
        "            program.is_checked = True\n"
        "            program.compare([sample(variable) for variable in variables])\n",
        "tests/autodiff/test_errors_jit.py",
    ),
    "values read from a program's recording": Bug(
        "autodiff/tape.py",
        "        if type(value._node) is ProgramNode:\n            frame",
        "        if False:\n            frame",
        "tests/autodiff/test_errors_jit.py",
    ),
    "an array of a program overwritten while a view of it is in use": Bug(
        "autodiff/program.py",
        "            self._private -= used  # the result may be a view of an argument\n",
        "",
        "tests/autodiff/test_jit.py",
    ),
    "a check dropped from a program because its result is not used": Bug(
        "autodiff/program.py",
        "        if call.result.number in numbers or call.has_effect:\n",
        "        if call.result.number in numbers:\n",
        "tests/autodiff/test_jit.py::test_checks_are_calls_of_the_program",
    ),
    "results of a program that share memory": Bug(
        "autodiff/jit.py",
        "    if is_new and all(slot.number != other.number for other in others):\n",
        "    if is_new:\n",
        "tests/autodiff/test_jit.py::test_results_share_no_memory",
    ),
    "a sum of cotangents added in place while a program of second order is recorded": Bug(
        "autodiff/tape.py",
        "    if open_traces and recording_trace((g, total and total[0])) is not None:\n",
        "    if open_traces and is_recorded(g):\n",
        "tests/autodiff/test_jit.py::test_second_order_and_forward_mode",
    ),
    "a mask of a conservation law that a program keeps": Bug(
        "flow",
        "no_waves = a == b",
        "no_waves = sample(a) == sample(b)",
        "tests/autodiff/test_jit_scenes.py",
    ),
    "a coefficient that a program does not check": Bug(
        "operators",
        "check_values(_check_coefficient, k)",
        "_check_coefficient(sample(k))",
        "tests/autodiff/test_jit_checks.py",
    ),
    "Newton's method that a program repeats with the values of the recording": Bug(
        "solvers",
        '    @opaque\n    @public("dp.implicit(residual)")\n',
        '    @public("dp.implicit(residual)")\n',
        "tests/autodiff/test_jit_scenes.py",
    ),
    "cotangents of a jitted step in the order of its result": Bug(
        "trajectory/recorded_steps.py",
        "        cotangents = [g[place] for place in self._places]\n",
        "        cotangents = list(g)\n",
        "tests/trajectory/test_rollout_jit.py",
    ),
    "a state before a cut of truncation that gets a cotangent from a jitted step": Bug(
        "trajectory/recorded_steps.py",
        "        if state.i < specification.first_traced or state.i in specification.cuts:\n",
        "        if state.i < specification.first_traced:\n",
        "tests/trajectory/test_rollout_jit.py",
    ),
    "a program that is not compared with its function": Bug(
        "autodiff/jit.py",
        "        return self._check and not all(map(_same, variables, self.first))\n",
        "        return self._check and all(map(_same, variables, self.first))\n",
        "tests/autodiff/test_errors_jit.py",
    ),
    "a cotangent added to an array that others hold": Bug(
        "autodiff/tape.py",
        "    if total is not None and total[1] and type(total[0]) is np.ndarray:\n        return total[0]\n",
        "    if total is not None and type(total[0]) is np.ndarray:\n        return total[0]\n",
        "tests/advection/test_transport_rules.py",
        compiled=True,
    ),
    "A for the transpose of A": Bug(
        "solvers",
        'factors.solve(b, trans="T" if transposed else "N")',
        "factors.solve(b)",
        "tests/solvers/test_solvers.py tests/solvers/test_solvers_methods.py",
    ),
    "one face flux with the wrong sign": Bug(
        "operators",
        "    blocks = {(0, a): along(a, grid.dim, factor(grid, a)) for a in axes}",
        "    blocks = {(0, a): along(a, grid.dim, factor(grid, a), 1.0 - 2 * (a == 1)) for a in axes}",
        "tests/operators/test_operators.py::test_discrete_identities",
    ),
    "a flat vector whose complex numbers come back conjugated": Bug(
        "autodiff/flattening.py",
        "part[::2] + 1j * part[1::2]",
        "part[::2] - 1j * part[1::2]",
        "tests/interop/test_interop.py",
    ),
    "a field in a file that lives elsewhere than its call says": Bug(
        "io", "if at.get(field, space.kind) == space.kind and shape", "if shape", "tests/io/test_errors_storage.py"
    ),
    "a tensor whose gradient is cut without a word": Bug(
        "_utils/validation.py",
        "        if library in LIBRARIES:",
        "        if False:",
        "tests/interop/test_interop.py",
    ),
    "an ensemble whose gradient has no weights": Bug(
        "parallel",
        "[weight * part for part in parts]",
        "[weight * parts[0], *parts[1:]]",
        "tests/parallel/test_ensemble.py",
    ),
    "a scene that a worker takes for another": Bug(
        "parallel",
        "(n, weight, unpickled[key])",
        "(n, weight, unpickled[scenes[0][2]])",
        "tests/parallel/test_ensemble.py",
    ),
    "momentum that passes through a wall": Bug(
        "flow",
        "1.0 - 2.0 * (np.arange(len(u)) == self.momentum)",
        "1.0 - 0.0 * (np.arange(len(u)) == self.momentum)",
        "tests/flow/test_conservation_law.py::test_lake_at_rest",
    ),
    "slopes at which a pressure is negative": Bug(
        "flow/finite_volumes.py",
        "            too_small = least < floor\n",
        "            too_small = least < -1e300 * in_cell\n",
        "tests/flow/test_positivity.py::test_two_rarefactions",
    ),
    "one end of a cell kept positive, its mean changed": Bug(
        "flow/finite_volumes.py",
        "cells + theta * (at_upper_end - cells)",
        "cells + 0.0 * theta * (at_upper_end - cells)",
        "tests/flow/test_positivity.py::test_values_and_derivatives_of_limited_states_agree_with_the_reference",
    ),
    "a time step for the speeds in the cells only": Bug(
        "flow/finite_volumes.py",
        "            speeds = np.maximum(speeds, at_ends)\n",
        "",
        "tests/flow/test_positivity.py::test_time_step_knows_the_waves_at_the_ends_of_the_cells",
    ),
    "water that flows through a step of the ground": Bug(
        "flow/shallow_water.py",
        "lower_depth - anp.maximum(step, 0.0)",
        "lower_depth - anp.maximum(0.5 * step, 0.0)",
        "tests/flow/test_shallow_water.py::test_a_lake_with_islands_stays_at_rest",
    ),
    "the weight of water on a slope": Bug(
        "flow/shallow_water.py",
        "2.0 * axis.part(slopes[1:2], 1, -1)",
        "1.0 * axis.part(slopes[1:2], 1, -1)",
        "tests/flow/test_shallow_water.py::test_flat_ground_has_the_rate_of_the_law_of_water",
    ),
    "slopes of the velocity that change the discharge": Bug(
        "flow/shallow_water.py",
        "slopes[2:] * (1.0 - share)",
        "slopes[2:] * (1.0 + share)",
        "tests/flow/test_shallow_water.py::test_values_and_derivatives_agree_with_the_reference",
    ),
    "the pressure of a face on the wrong cell": Bug(
        "flow/shallow_water.py",
        "carried + normal * (upper_share * pressure_jump)",
        "carried + normal * (lower_share * pressure_jump)",
        "tests/flow/test_shallow_water.py::test_a_moving_shore_line",
    ),
    "leapfrog with a limit of Euler's method": Bug(
        "integrators",
        "if fastest > 4 * (1 + SLACK):",
        "if fastest > 8 * (1 + SLACK):",
        "tests/integrators/test_leapfrog.py",
    ),
    "a transposed substitution in the order of the forward one": Bug(
        "kernels",
        "for number in range(stop - 1, start - 1, -1):\n        i = order[number]",
        "for number in range(start, stop):\n        i = order[number]",
        "tests/solvers/test_solvers_triangular.py",
        compiled=True,
    ),
    "a friction whose share in the acceleration before has no derivative": Bug(
        "flow",
        "a = a + friction * v",
        "a = a + plain(friction) * v",
        "tests/flow/test_flow_friction.py",
    ),
    "a wall that is felt beside the place where it stands": Bug(
        "flow",
        "reduce(add, terms) / anp.log1p(anp.exp(s))",
        "reduce(add, terms) / anp.log1p(anp.exp(s + 1.0))",
        "tests/flow/test_forces.py",
    ),
    "a force that forgets the momentum that arrives": Bug(
        "flow",
        "total = stress - momentum",
        "total = stress - 0 * momentum",
        "tests/flow/test_forces.py",
    ),
    "a flux that enters through one side": Bug(
        "operators",
        "np.concatenate(areas) * (below.astype(float) - above)",
        "np.concatenate(areas) * (below.astype(float) + above)",
        "tests/flow/test_forces.py",
    ),
    "factors of a matrix nearby taken for those of the matrix itself": Bug(
        "solvers",
        "            self.lu = direct_engine(self.system)\n",
        "",
        "tests/solvers/test_steady.py::test_factors_of_an_earlier_jacobian_precondition_the_next",
    ),
    "a culprit that is not where the derivative is infinite": Bug(
        "autodiff/derivative.py",
        "[np.argmin(finite)]",
        "[np.argmax(finite)]",
        "tests/optimize/test_minimize_errors.py",
    ),
    "a step back with the wrong sign": Bug(
        "integrators",
        "        p = combine(p, (-h, f(q, params)))",
        "        p = combine(p, (h, f(q, params)))",
        "tests/integrators/test_leapfrog.py::test_a_reversed_step",
    ),
    "a leapfrog that uses the old velocity": Bug(
        "integrators",
        '        q = _advanced(q, g(p, params), h, z, "damping[1]")\n'
        '        return _advanced(p, f(q, params), h, s, "damping[0]"), q',
        '        new = _advanced(q, g(p, params), h, z, "damping[1]")\n'
        '        return _advanced(p, f(q, params), h, s, "damping[0]"), new',
        "tests/integrators/test_leapfrog.py",
    ),
    "a force that acts on walls": Bug(
        "flow",
        "a = a + self._free_faces(self._force(",
        "a = a + (self._force(",
        "tests/flow/test_flow.py::test_a_force_on_walls_and_inflows_does_nothing",
    ),
    "a stress without the transposed gradient": Bug(
        "flow",
        "self._velocity_slopes + self._transposed_slopes()",
        "self._velocity_slopes",
        "tests/flow/test_variable_media.py::test_stress_and_shear_rate_of_a_strain",
    ),
    "a shear rate without walls": Bug(
        "flow",
        "            slopes_of_v = slopes_of_v + self.wall_slopes(walls)\n",
        "            pass\n",
        "tests/flow/test_variable_media.py::test_shear_rate_beside_a_moving_wall",
    ),
    "an implicit viscosity without the wall velocities at the end of a step": Bug(
        "flow",
        "wall_part = partial(self.walls.laplacian_part_sum, walls, walls_after)",
        "wall_part = partial(self.walls.laplacian_part_sum, walls, walls)",
        "tests/flow/test_variable_media.py::test_oscillating_wall",
    ),
    "steps of different length that are extrapolated like equal ones": Bug(
        "flow",
        'half_ratio = 0.5 * dt / state["dt"]',
        "half_ratio = 0.5",
        "tests/flow/test_variable_media.py::test_step_length_of_params",
    ),
    "a gradient of the pressure that is not divided by the density": Bug(
        "flow",
        "            slope_of_p = slope_of_p / density\n",
        "            pass\n",
        "tests/flow/test_variable_media.py::test_two_layers_at_rest",
    ),
    "a stress with a weight for solid cells": Bug(
        "flow/fluid_cells.py",
        "            areas[above] = weight * (first * lower + (1 - first) * upper)\n",
        "            areas[above] = weight\n",
        "tests/flow/test_media_beside_solids.py::test_the_stress_has_a_twin",
    ),
    "a law of the shear rate with the trapezoidal rule": Bug(
        "flow",
        "for_stress, density, dt, middle)",
        "for_stress, density, dt)",
        "tests/flow/test_variable_media.py::test_long_steps_of_laws_of_the_shear_rate",
    ),
    "an implicit diffusivity at the beginning of the step": Bug(
        "flow",
        'self._half_step_ahead(u, state["s_before"][name], state, dt)',
        "u",
        "tests/flow/test_variable_media.py::test_implicit_diffusivity_of_a_scalar",
    ),
    "the rate of a scalar that is not carried on": Bug(
        "flow",
        'self._half_step_ahead(rates[name], state["r"][name], state, dt)',
        "rates[name]",
        "tests/flow/test_flow_scalars.py::test_second_order_in_time",
    ),
    "a variation that counts walls": Bug(
        "optimize",
        "abs(divergence(grid).matrix) @ open_faces.matrix != 0",
        "abs(divergence(grid).matrix) != 0",
        "tests/optimize/test_regularization.py",
    ),
    "a threshold that pushes the wrong way": Bug(
        "optimize",
        "np.maximum(size - t, 0.0)",
        "np.maximum(size + t, 0.0)",
        "tests/optimize/test_regularization.py",
    ),
    "a posterior whose variance is reduced by the wrong share": Bug(
        "optimize/posterior.py",
        "np.sum(vectors**2 / (1 + self._pairs.values)[:, None], axis=0)",
        "np.sum(vectors**2 / (2 + self._pairs.values)[:, None], axis=0)",
        "tests/optimize/test_laplace.py",
    ),
    "samples of a posterior with the square of their reduction": Bug(
        "optimize/posterior.py",
        "-np.expm1(-0.5 * np.log1p(values))",
        "-np.expm1(-np.log1p(values))",
        "tests/optimize/test_laplace.py",
    ),
    "samples of a posterior that ignore the seed": Bug(
        "optimize/posterior.py",
        "np.random.default_rng(seed), count",
        "np.random.default_rng(0), count",
        "tests/optimize/test_laplace.py",
    ),
    "samples of a posterior by the prior in place of its root": Bug(
        "optimize/prior_covariance.py",
        "weights = vectors @ (np.sqrt(np.maximum(eigenvalues, 0.0)) * vectors[0])",
        "weights = vectors @ (np.maximum(eigenvalues, 0.0) * vectors[0])",
        "tests/optimize/test_laplace.py",
    ),
    "eigenvectors that are not normalized in the metric of the prior": Bug(
        "optimize/misfit_eigenpairs.py",
        "scaled = (first / np.sqrt(squares[is_first])).T[::-1]",
        "scaled = (first / squares[is_first]).T[::-1]",
        "tests/optimize/test_laplace.py",
    ),
    "multiple eigenvalues of a posterior that are missed": Bug(
        "optimize/misfit_eigenpairs.py",
        "        if space.count_above(threshold) == previous_count:  # new",
        "        if True:  # new",
        "tests/optimize/test_laplace.py",
    ),
    "eigenpairs of a posterior that have not converged": Bug(
        "optimize/misfit_eigenpairs.py",
        "self.residuals = np.sqrt(squares / (1 + self.values))",
        "self.residuals = 0.0 * squares",
        "tests/optimize/test_laplace.py",
    ),
    "a distance from the mode without the prior mean": Bug(
        "optimize/laplace.py",
        "offset=vector - mean",
        "offset=vector",
        "tests/optimize/test_laplace.py",
    ),
    "an information gain without the distance from the prior mean": Bug(
        "optimize/posterior.py",
        "np.sum(divergence) + max(_product(gradient, preconditioned), 0.0)",
        "np.sum(divergence)",
        "tests/optimize/test_laplace.py",
    ),
    "estimated variances with a bias": Bug(
        "optimize/posterior.py",
        " - left_out * (images @ directions)",
        "",
        "tests/optimize/test_laplace.py",
    ),
    "a diagonal of sines with two halves of one wave": Bug(
        "solvers/separable.py",
        "np.where(doubled % (2 * n) == 0, 0.5, 1.0)",
        "np.where(doubled % (2 * n) == 0, 1.0, 1.0)",
        "tests/optimize/test_laplace.py",
    ),
    "a missing 1/h": Bug(
        "operators",
        "    step = 1 / grid.spacings(axis)[face]",
        "    step = np.ones(face.size)",
        "tests/operators/test_operators.py::test_linear_fields_are_exact",
    ),
    "a boundary row that is not transposed": Bug(
        "operators/structure",
        "        transposed = Factor(self.matrix.T)",
        "        rows = self.matrix.T.tolil()\n"
        "        if rows.shape[0] == rows.shape[1] and rows.shape[0]:\n"
        "            rows[[0]] = self.matrix.tolil()[[0]]\n"
        "        transposed = Factor(rows.tocsr())",
        "tests/operators/test_operators.py",
    ),
    "waves damped to the wrong side": Bug(
        "solvers",
        "    turn = -1.0 if np.sum(row_sums.imag) > 0 else 1.0",
        "    turn = 1.0 if np.sum(row_sums.imag) > 0 else -1.0",
        "tests/solvers/test_elliptic_complex.py::test_shifted_laplace_preconditions_waves_and_their_adjoint",
    ),
    "factors too poor to refine": Bug(
        "solvers", "not reduction < LARGEST_REDUCTION", "False", "tests/solvers/test_elliptic_complex.py"
    ),
    "flux of a tensor through closed walls": Bug(
        "operators",
        "        if np.any(shut):",
        "        if False:",
        "tests/solvers/test_elliptic_tensor.py::test_no_flux_through_closed_walls_at_any_angle",
    ),
    "an adjoint without mean removal": Bug(
        "solvers",
        "        part = self._sides[transposed]",
        "        if transposed:\n            return b, norm(b)\n        part = self._sides[transposed]",
        "tests/solvers/test_solvers_singular.py",
    ),
    "the mean removed over all components together": Bug(
        "solvers",
        "        part = self._sides[transposed]",
        "        shares = np.full_like(shares, np.sum(shares * self._products) / np.sum(self._products))\n"
        "        part = self._sides[transposed]",
        "tests/solvers/test_solvers_singular.py",
    ),
    "1 as the derivative at a kink": Bug(
        "advection",
        "anp.heaviside(recorded_level(courant), 0.5)",
        "anp.heaviside(recorded_level(courant), 1.0)",
        "tests/advection/test_transport_rules.py::test_kinks_get_the_mean_of_both_sides",
    ),
    "a stale set-up after a change of the coefficient": Bug(
        "solvers",
        "inverse = self._cache.find((k, shift))",
        "inverse = self._cache.last",
        "tests/solvers/test_elliptic.py",
    ),
    "a residual tested before unscaling": Bug(
        "solvers",
        "        goal = run.rtol * data",
        "        goal = run.rtol * max(data, 1.0)",
        "tests/solvers/test_solvers_use.py::test_a_small_right_hand_side_gives_the_same_bits",
    ),
    "off by one in the last step": Bug(
        "trajectory",
        'range(first, -1, -1), "backward"',
        'range(first - 1, -1, -1), "backward"',
        "tests/trajectory/test_rollout.py",
    ),
    "an interrupted rollout that continues without its last state": Bug(
        "trajectory",
        "        if self._entries[-1].i != last.i:  #",
        "        if False:  #",
        "tests/trajectory/test_rollout_disk.py",
    ),
    "cotangents of an interrupted rollout for another loss": Bug(
        "trajectory",
        ' or content[0]["cotangents"] != self._cotangents:',
        ":",
        "tests/trajectory/test_rollout_disk.py",
    ),
    "a changed step that continues an interrupted rollout": Bug(
        "trajectory",
        "            if newest is not None and state_digest(before.values) != state_digest(newest.values):",
        "            if False:",
        "tests/trajectory/test_rollout_disk.py",
    ),
    "a step whose measurements changed that continues an interrupted rollout": Bug(
        "trajectory",
        "                self._earlier_last = last",
        "                pass",
        "tests/trajectory/test_rollout_disk.py",
    ),
    "a cotangent of the wrong dtype": Bug(
        "autodiff/tape.py",
        "    return cast(cotangent, precise)",
        "    return cotangent",
        "tests/autodiff/test_tape.py tests/autodiff/test_rules.py tests/check/test_check_operators.py",
    ),
    "a VJP that holds an array which changes later": Bug(
        "autodiff/tape.py",
        "values = constant_args(args[1:], nums)",
        "values = args[1:]",
        "tests/solvers/test_solvers_use.py::test_a_coefficient_may_be_reused_before_the_pullback",
    ),
    "a product that holds an array which changes later": Bug(
        "autodiff/tape.py",
        "                held = constant_args(held, nums)",
        "                pass",
        "tests/autodiff/test_reused_arrays.py::test_views_of_what_is_written_into",
    ),
    "a rule of a user that may write into a cotangent": Bug(
        "autodiff/tape.py",
        "copied(function(*map(frozen, args)))",
        "copied(function(*args))",
        "tests/autodiff/test_reused_buffers.py::test_rules_of_users_cannot_write_into_what_they_are_given",
    ),
    "x and y swapped on a grid that is not square": Bug(
        "grid/grid.py",
        '        return self._mesh(["cells"] * self.dim)',
        '        return self._mesh(["cells"] * self.dim)[::-1]',
        "tests/grid/test_grid.py",
    ),
    "a wall value without a derivative": Bug(
        "advection",
        "values = anp.concatenate([u, inflow])",
        "values = anp.concatenate([u, plain(inflow)])",
        "tests/advection/test_transport_rules.py",
    ),
    "a rate of version 0.2 that keeps its old unit": Bug(
        "optimize",
        "rate * template.gradient_unit, share",
        "rate, share",
        "tests/optimize/test_checkpoints.py",
    ),
    "a checkpoint that misses a vector of the optimizer": Bug(
        "optimize",
        '            state = flatten(template)[1](content["state"])',
        '            state = flatten(template)[1](content["state"])\n'
        "            state = state._replace(**{state._fields[1]: template[1]})",
        "tests/optimize/test_checkpoints.py",
    ),
    "a tolerance that the adjoint ignores": Bug(
        "solvers",
        "        goal = run.rtol * data",
        "        goal = (1e-2 if transposed else run.rtol) * data",
        "tests/solvers/test_solvers.py tests/solvers/test_solvers_methods.py tests/solvers/test_solvers_use.py",
    ),
    # ---- grid, space, conditions
    "a wall as far away as the next cell": Bug(
        "grid/grid.py",
        "return 0.5 * (np.append(widths, 0.0) + np.append(0.0, widths))",
        "return np.maximum(np.append(widths, 0.0), np.append(0.0, widths))",
        "tests/grid/test_grid.py tests/operators/test_operators.py::test_discrete_identities",
    ),
    "components of a face field in the wrong order": Bug(
        "grid/space.py",
        "ends = accumulate(map(prod, parts))",
        "ends = accumulate(map(prod, parts[::-1]))",
        "tests/grid/test_grid.py",
    ),
    "the lower wall for the upper one": Bug(
        "grid/boundary_conditions.py",
        "    return tuple(sides)\n",
        "    return tuple(sides[::-1])\n",
        "tests/grid/test_thin_axes.py::test_what_acts_on_a_velocity",
    ),
    # ---- tape, operator, structure, operators
    "the cotangent of one field for a batch of them": Bug(
        "autodiff/derivative.py",
        "cotangent = anp.sum(cotangent, axis=0)",
        "cotangent = cotangent[0]",
        "tests/autodiff/test_batch.py",
    ),
    "an adjoint that does not conjugate": Bug(
        "operators/operator.py",
        "return np.conj(self.T @ np.conj(np.asarray(y).reshape(-1)))",
        "return self.T @ np.asarray(y).reshape(-1)",
        "tests/operators/test_operators.py::test_the_border_to_scipy_conjugates",
    ),
    "a product transposed in the order of its factors": Bug(
        "operators/structure",
        "Chain([member.transpose() for member in reversed(self.members)])",
        "Chain([member.transpose() for member in self.members])",
        "tests/operators/test_operators.py",
    ),
    "the weights of two cells exchanged": Bug(
        "operators",
        "return share * from_high**2, (1 - share) * from_low**2",
        "return (1 - share) * from_high**2, share * from_low**2",
        "tests/autodiff/test_rules.py tests/solvers/test_elliptic.py",
    ),
    # ---- kernels
    "a ghost cell that gives nothing back": Bug(
        "network",
        "np.add.at(core, sources[ghosts], padded[ghosts])",
        "pass",
        "tests/network/test_network.py",
    ),
    "a pass that writes over the sum": Bug(
        "kernels",
        "total[1:] += lower[1:] * field[:-1]",
        "total[1:] = lower[1:] * field[:-1]",
        "tests/operators/test_operators.py::test_transpose_and_twin_in_every_dtype",
    ),
    # ---- solvers
    "an equation whose own unknown no row uses is ignored": Bug(
        "solvers",
        "    if all_rows:\n        check_unknowns(system)\n",
        "",
        "tests/solvers/test_solvers_singular.py",
    ),
    "masked unknowns taken for unused ones": Bug(
        "solvers",
        "            unused &= self.structure_of(op.T).magnitude()(np.ones(self.local_size)) == 0\n",
        "",
        "tests/solvers/test_solvers_singular.py",
    ),
    "an adjoint solve with the operator itself": Bug(
        "solvers",
        "system.product(precondition(r), transposed)",
        "system.product(precondition(r))",
        "tests/solvers/test_solvers.py tests/solvers/test_solvers_methods.py",
    ),
    "a transposed cycle with the sweeps of the forward one": Bug(
        "solvers",
        "_mirrored(self.after), _mirrored(self.before), coarse)",
        "_mirrored(self.before), _mirrored(self.after), coarse)",
        "tests/solvers/test_solvers_methods.py",
    ),
    "a function of an operator that is not transposed": Bug(
        "solvers",
        "spectrum.apply(weights, x, self.transposed)",
        "spectrum.apply(weights, x, False)",
        "tests/solvers/test_spectral.py",
    ),
    "the wrong sign in the derivative of a shift": Bug(
        "solvers",
        "gradient = -y * x",
        "gradient = y * x",
        "tests/solvers/test_elliptic.py",
    ),
    "the derivative of an entry at the place of its mirror image": Bug(
        "solvers",
        "super().__init__(self._picking(self.rows, -1.0).T, self._picking(self.columns, 1.0)",
        "super().__init__(self._picking(self.columns, -1.0).T, self._picking(self.rows, 1.0)",
        "tests/autodiff/test_entries.py",
    ),
    "the derivative of a root with the wrong sign": Bug(
        "solvers",
        "-push(varied, chosen, tangents)[1], equation, ans, *leaves)",
        "push(varied, chosen, tangents)[1], equation, ans, *leaves)",
        "tests/solvers/test_implicit.py",
    ),
    "Newton steps that end early": Bug(
        "solvers",
        "is_converged = residual <= share * self.rtol * data",
        "is_converged = residual <= 1e6 * share * self.rtol * data",
        "tests/solvers/test_newton.py tests/solvers/test_implicit.py",
    ),
    "fields of a tree judged together": Bug(
        "solvers",
        "terms = norms(self.J.magnitude(np.abs(self.x))) + data",
        "terms = length(self.J.magnitude(np.abs(self.x))) + data",
        "tests/solvers/test_steady.py::test_each_field_meets_the_tolerance_by_itself",
    ),
    "pseudo-time that goes away from the steady state": Bug(
        "solvers",
        "_rates(op.matrix, equation.unknowns) / time_step",
        "-_rates(op.matrix, equation.unknowns) / time_step",
        "tests/solvers/test_steady.py::test_convection_at_32_needs_pseudo_time",
    ),
    "what the weights miss of the constant, with the wrong sign": Bug(
        "solvers",
        "image = self.inverse_root * self.extra - self.apply_scaled(",
        "image = self.inverse_root * self.extra + self.apply_scaled(",
        "tests/solvers/test_multigrid_loops.py::test_the_coarse_matrix_is_the_galerkin_product",
        compiled=True,
    ),
    # ---- advection
    "a limiter with a derivative of its own": Bug(
        "kernels",
        "p * (2.0 * high + low)",
        "p * (high + low)",
        "tests/advection/test_transport_rules.py::test_taylor",
    ),
    "a departure point as far as the whole step at half of it": Bug(
        "advection",
        "Trajectory(interpolant.half_way, w, 0.5 * step)",
        "Trajectory(interpolant.half_way, w, step)",
        "tests/advection/test_semi_lagrangian.py",
    ),
    "a MacCormack step that adds all that it misses": Bug(
        "advection",
        "        self.unclamped *= 0.5\n",
        "        self.unclamped *= 1.0\n",
        "tests/advection/test_semi_lagrangian.py",
    ),
    "a displacement with the time step of the call before": Bug(
        "advection/index_coordinates.py",
        "        if last_step != step:\n",
        "        if last_step == 0.0:\n",
        "tests/advection/test_bound_rules.py",
    ),
    "a bound rule that takes arguments of another shape": Bug(
        "autodiff/tape.py",
        "            form.append((value.shape, value.dtype, value.flags.c_contiguous))\n",
        "            form.append((value.ndim, value.dtype, value.flags.c_contiguous))\n",
        "tests/advection/test_bound_rules.py",
    ),
    "a bound rule that takes strided arguments": Bug(
        "autodiff/tape.py",
        "            form.append((value.shape, value.dtype, value.flags.c_contiguous))\n",
        "            form.append((value.shape, value.dtype))\n",
        "tests/advection/test_bound_rules.py",
        compiled=True,
    ),
    "a bound pullback that returns what is not finite": Bug(
        "advection/rule.py",
        "            if finite or all(map(surely_finite, cotangents)):\n",
        "            if finite or cotangents:\n",
        "tests/advection/test_bound_rules.py",
    ),
    "a bound pullback for other arguments": Bug(
        "autodiff/tape.py",
        "        key = nums, form_of(values)\n",
        "        key = (nums,)\n",
        "tests/advection/test_bound_rules.py",
    ),
    "ghost cells added before the cell itself": Bug(
        "advection/interpolant.py",
        "order = np.concatenate([np.flatnonzero(~is_ghost), self._ghosts])",
        "order = np.concatenate([self._ghosts, np.flatnonzero(~is_ghost)])",
        "tests/advection/test_bound_rules.py",
    ),
    "a matrix product added to what the memory held": Bug(
        "operators/operator.py",
        "buffers.allocator(shape, result_dtype(self.structure, dtype), zeros)",
        "buffers.allocator(shape, result_dtype(self.structure, dtype), False)",
        "tests/operators/test_bound.py",
    ),
    # ---- flow, integrators, trajectory
    "a flow step that forgets the acceleration before": Bug(
        "flow",
        'self._half_step_ahead(a, state["a"], state, dt)',
        "a",
        "tests/flow/test_flow.py::test_order_two_in_time",
    ),
    "a divergence that is left at openings": Bug(
        "flow",
        "tuple(mapped_wall(wall, _pressure_condition) for wall in pair) for axis, pair in pairs",
        "tuple(mapped_wall(pair[0], _pressure_condition) for wall in pair) for axis, pair in pairs",
        "tests/flow/test_projection.py::test_openings",
    ),
    "a stage of the wrong weight": Bug(
        "integrators",
        "((0.5,), (0.0, 0.5), (0.0, 0.0, 1.0))",
        "((0.5,), (0.0, 0.5), (0.0, 0.5, 0.5))",
        "tests/integrators/test_integrators.py",
    ),
    "a derivative of an exponential in the step": Bug(
        "integrators",
        "weights[k + 1] -= k * weight",
        "weights[k + 1] += k * weight",
        "tests/integrators/test_integrators.py::test_gradient_jvp_and_second_order",
    ),
    "a coefficient of the field before": Bug(
        "integrators",
        "h * term.coefficient(params)",
        "h * self.stiff[0].coefficient(params)",
        "tests/integrators/test_integrators_fields.py",
    ),
    "dicts that are paired by position": Bug(
        "_utils/pytree.py",
        "        return reference.keys()",
        "        return tree.keys()",
        "tests/integrators/test_leapfrog.py",
    ),
    "eigenvalues of a factor without its scale": Bug(
        "solvers",
        "term.scale * basis.eigenvalues",
        "basis.eigenvalues",
        "tests/solvers/test_spectral.py",
    ),
    "cotangents of a trajectory at the step before": Bug(
        "trajectory",
        "[block[row] for block in blocks]",
        "[block[row - 1] for block in blocks]",
        "tests/trajectory/test_rollout.py tests/trajectory/test_rollout_kinds.py",
    ),
    "a field that counts as unused where it has a zero": Bug(
        "trajectory",
        "not back.any()",
        "not back.all()",
        "tests/trajectory/test_rollout.py tests/trajectory/test_rollout_kinds.py",
    ),
    # ---- optimize, blackbox, network
    "backward passes of constraints that are repeated": Bug(
        "optimize/constrained_problem.py",
        "product = self._products.find((v,))",
        "product = None",
        "tests/optimize/test_minimize_constraints.py",
    ),
    "a failed adjoint solve of a constraint that ends the run": Bug(
        "optimize/constrained_problem.py",
        "            if point is self.start:\n                raise\n",
        "            raise\n",
        "tests/optimize/test_minimize_constraints.py",
    ),
    "a penalty that grows faster than the inner searches converge": Bug(
        "optimize/augmented_lagrangian.py",
        "has_not_fallen and violation > inaccuracy and",
        "has_not_fallen and",
        "tests/optimize/test_minimize_constraints.py",
    ),
    "a penalty that grows after inner searches that have not converged": Bug(
        "optimize/augmented_lagrangian.py",
        "is_solved = inaccuracy <= state.accuracy or state.steps < self.inner\n",
        "is_solved = True\n",
        "tests/optimize/test_minimize_constraints.py",
    ),
    "an equality behind a wrapper as an inequality": Bug(
        "optimize/constraints.py",
        "    if any(isinstance(function, Equality) for function in wrapped_functions(entry)):\n",
        "    if False:\n",
        "tests/optimize/test_minimize_constraints.py",
    ),
    "eigenpairs: the same start in the complement of known vectors": Bug(
        "solvers/eigensolver.py",
        "        seed = 1 + count\n",
        "        seed = 1\n",
        "tests/solvers/test_eigenpairs.py",
    ),
    "eigenpairs: a range of pairs cluster by cluster": Bug(
        "solvers/eigenpairs.py",
        "        spaces = [problem.vectors(whole)] if whole else []\n",
        "        spaces = [problem.vectors(range(i, i + 1)) for i in whole]\n",
        "tests/solvers/test_eigenpairs.py",
    ),
    "eigenpairs: lobpcg does not count the eigenvalues below": Bug(
        "solvers/eigensolver.py",
        "    if missing > 0:\n",
        "    if False:\n",
        "tests/solvers/test_errors_eigenpairs.py",
    ),
    "where of a number without the sum of its cotangents": Bug(
        "autodiff/tape.py",
        "slopes=(None, _chosen_slope, _other_slope)",
        "slopes=(None, None, None)",
        "tests/autodiff/test_shortcuts.py",
    ),
    "initial multipliers without their unit": Bug(
        "optimize/augmented_lagrangian.py",
        "rows_of_multipliers(self.multipliers) / problem.loss_unit",
        "rows_of_multipliers(self.multipliers)",
        "tests/optimize/test_minimize_constraints.py",
    ),
    "multipliers with the wrong sign": Bug(
        "optimize/constraints.py",
        "function.in_shape(function.cotangent(part)) for",
        "function.in_shape(-function.cotangent(part)) for",
        "tests/optimize/test_minimize_constraints.py",
    ),
    "a row of the Jacobian of the constraints is missing": Bug(
        "optimize/constraints.py",
        "        return np.concatenate(blocks)\n",
        "        return np.concatenate(blocks) * (np.arange(self.rows.size) > 0)[:, None]\n",
        "tests/optimize/test_minimize_constraints.py",
    ),
    "converged without being feasible": Bug(
        "optimize/constrained_run.py",
        "return max(record.feasibility, record.optimality) <= self._tolerance",
        "return record.optimality <= self._tolerance",
        "tests/optimize/test_minimize_constraints.py",
    ),
    "a lower limit with the sign of an upper one": Bug(
        "optimize/constraints.py",
        "-np.ones(below.size)",
        "np.ones(below.size)",
        "tests/optimize/test_minimize_constraints.py",
    ),
    "a gradient lost in the rounding of x counts as 0": Bug(
        "optimize/constrained_problem.py",
        "return np.clip(gradient, point.z - self.box.upper, point.z - self.box.lower)",
        "return point.z - self.box.nearest(point.z - gradient)",
        "tests/optimize/test_minimize_constraints.py",
    ),
    "an exception of a function that NLopt swallows": Bug(
        "optimize/mma.py",
        "        if errors:\n            raise errors[0]\n",
        "",
        "tests/optimize/test_minimize_constraints.py",
    ),
    "constraints that are not divided by their units": Bug(
        "optimize/constraints.py",
        "            units.append(np.full(rows.size, power_of_two(size)))",
        "            units.append(np.ones(rows.size))",
        "tests/optimize/test_minimize_constraints.py",
    ),
    "a negative multiplier of an inequality": Bug(
        "optimize/augmented_lagrangian.py",
        "np.where(self._problem.equality, shifted, np.maximum(shifted, 0.0))",
        "shifted",
        "tests/optimize/test_minimize_constraints.py",
    ),
    "a resumed run that forgets the multipliers": Bug(
        "optimize/constrained_run.py",
        "            state = resumed.state\n",
        "            state = resumed.state._replace(multipliers=0 * resumed.state.multipliers)\n",
        "tests/optimize/test_minimize_constraints.py",
    ),
    "a running mean without the correction of its start": Bug(
        "optimize",
        "np.sqrt(mean_square / (1 - b2**count))",
        "np.sqrt(mean_square)",
        "tests/optimize/test_minimize.py",
    ),
    "a product with a transpose that is taken for a symmetric one": Bug(
        "solvers",
        "return not np.iscomplexobj(weights) and all(axis.matrices is None for axis in spectrum.axes)",
        "return True",
        "tests/optimize/test_data_assimilation.py",
    ),
    "steps of a given accuracy that are exact": Bug(
        "optimize",
        "atol=accuracy, btol=accuracy",
        "atol=LSMR_ACCURACY, btol=LSMR_ACCURACY",
        "tests/optimize/test_minimize_squares.py",
    ),
    "tangents of a program in the wrong order": Bug(
        "autodiff",
        "len(entries), places, tangents)",
        "len(entries), places[::-1], tangents)",
        "tests/autodiff/test_jit.py",
    ),
    "a first curvature that is not measured in the metric": Bug(
        "optimize",
        "metric.square(changes[-1], metric.representer(changes[-1]))",
        "np.dot(changes[-1], changes[-1])",
        "tests/optimize/test_metric.py",
    ),
    "a recursion that begins without the metric": Bug(
        "optimize",
        "direction = metric.representer(remainder)",
        "direction = remainder",
        "tests/optimize/test_metric.py",
    ),
    "a trust region that is not measured in the metric": Bug(
        "optimize",
        "direction_image = -residual + next_square",
        "direction_image = -representer + next_square",
        "tests/optimize/test_metric.py",
    ),
    "a dual norm with the metric in place of its inverse": Bug(
        "optimize",
        "self.length(scaled, self.representer(scaled))",
        'self.length(scaled, self._mapped(scaled, "apply"))',
        "tests/optimize/test_metric.py",
    ),
    "a checkpoint that does not compare the metric": Bug(
        "optimize",
        'for name in {**self._settings, "metric": None}:',
        'for name in {**self._settings, "method": None}:',
        "tests/optimize/test_metric.py",
    ),
    "a metric of free entries that takes the place of others": Bug(
        "optimize",
        "return self._metric.representer(whole)[self._free]",
        "return self._metric.representer(whole)[: len(gradient)]",
        "tests/optimize/test_metric.py",
    ),
    "a wrong derivative that passes for rounding": Bug(
        "optimize",
        "lost_in_rounding = decreases[0] <= ROUNDINGS",
        "lost_in_rounding = decreases[-1] <= ROUNDINGS",
        "tests/optimize/test_minimize_errors.py",
    ),
    "a step across a bound": Bug(
        "optimize",
        "np.clip(vector, self.lower, self.upper)",
        "np.maximum(vector, self.lower)",
        "tests/optimize/test_constraints.py",
    ),
    "central differences over one step for two": Bug(
        "interop/blackbox.py",
        "(self._flat(x + v) - self._flat(x - v)) / 2",
        "self._flat(x + v) - self._flat(x - v)",
        "tests/interop/test_blackbox.py",
    ),
    "a kink of relu with the slope of one side": Bug(
        "network",
        "return anp.maximum(x, 0.0)",
        "return anp.where(plain(x) > 0, x, 0.0)",
        "tests/network/test_network.py",
    ),
    "lengths of radau that are held where a jump moves": Bug(
        "integrators",
        "M[..., :n] += stretch[..., None] * section[:, None, None]",
        "M[..., :n] += 0.0 * section[:, None, None]",
        "tests/integrators/test_integrators_radau.py::test_stiff_problems_with_their_gradients",
    ),
    "second derivatives of radau from one iteration": Bug(
        "integrators",
        "for _ in traces_of([v, *leaves(params), t, h]):",
        "for _ in range(1):",
        "tests/integrators/test_integrators_radau.py::test_second_derivatives_in_everything",
    ),
    "derivatives of rodas5p without those of the Jacobian": Bug(
        "integrators",
        "of_point += joined([tape.pull([part for y in ys for part in split(y)]) for ys in zip(*adjoints)], base)",
        "pass",
        "tests/integrators/test_integrators_rosenbrock.py::test_the_backward_pass_is_the_transpose",
    ),
    "adjoint solves of rodas5p that are not transposed": Bug(
        "integrators",
        "return self._solved(True, g, self.equation, v, variables)",
        "return self._solved(False, g, self.equation, v, variables)",
        "tests/integrators/test_integrators_rosenbrock.py::test_the_backward_pass_is_the_transpose",
    ),
    "derivatives of radau at the wrong stage": Bug(
        "integrators",
        "[(u + z[:, i], done + C[i] * length) for i in (0, 1)]",
        "[(u + z[:, i], done + C[i] * length) for i in (1, 0)]",
        "tests/integrators/test_integrators_radau.py::test_one_step_against_a_root",
    ),
    # ---- check, report
    "a checker that takes a wrong gradient for a right one": Bug(
        "check",
        '(WRONG_WORDS, "disagrees")',
        '(("disagrees", "outside"), "agrees")',
        "tests/check/test_check_gradient.py",
    ),
    "a VJP that is examined at one point only": Bug(
        "check/derivative_audit.py",
        "        if self.options.beside:\n",
        "        if False:\n",
        "tests/check/test_foreign_derivatives.py",
    ),
    "a derivative that is not compared with itself again": Bug(
        "check/derivative_audit.py",
        "        gap = self.relative_gap(self.derivative(vector), [first], vector)\n",
        "        gap = self.relative_gap(first, [first], vector)\n",
        "tests/check/test_foreign_derivatives.py",
    ),
    "an inexact adjoint solve that counts as noise": Bug(
        "check/derivative_review.py",
        "    if is_visible and is_exact:\n",
        "    if False:\n",
        "tests/check/test_foreign_derivatives.py",
    ),
    "single precision of a VJP that nobody notices": Bug(
        "check/derivative_review.py",
        "    if audit.linear_gap > REVIEW.single_precision_gap and is_smooth and _roughness(audit) is None:\n",
        "    if False:\n",
        "tests/check/test_foreign_derivatives.py",
    ),
    "a change in place that nobody notices": Bug(
        "check/programs.py",
        "                if _bytes_of(self.library.arrays(argument)) != bytes_before:\n",
        "                if False:\n",
        "tests/check/test_foreign_derivatives.py",
    ),
    "small entries of a derivative that are not examined": Bug(
        "check/derivative_audit.py",
        "        while np.any(hidden) and len(parts) < MOST_HIDDEN_PARTS:\n",
        "        while False:\n",
        "tests/check/test_foreign_derivatives.py::test_small_entries_hide_no_error",
    ),
    "entries of many sizes that are moved by one step": Bug(
        "check/balanced_directions.py",
        "            unit = np.minimum(np.where(sizes > 0, sizes, np.median(sizes[sizes > 0])), unit)\n",
        "            pass\n",
        "tests/check/test_foreign_derivatives.py",
    ),
    "the convention of torch for our own complex numbers": Bug(
        "check/programs.py",
        'NUMPY = Library("numpy", _unchanged, _unchanged, _tape_vjp, _tape_jvp, "transpose")',
        'NUMPY = Library("numpy", _unchanged, _unchanged, _tape_vjp, _tape_jvp, "adjoint")',
        "tests/check/test_foreign_derivatives.py",
    ),
    "an inexact solve that is taken for an error": Bug(
        "check/derivative_review.py",
        "        if direction.word in WRONG_WORDS and direction.share <= REVIEW.inexact_shares * gap\n",
        "        if False\n",
        "tests/check/test_foreign_derivatives.py",
    ),
    "a Hessian whose symmetry is not tested": Bug(
        "check/hessian_audit.py",
        '    audit.compare("<u, H v> = <v, H u>", gap, allowed, asymmetry, size, reason)\n',
        "    pass\n",
        "tests/check/test_foreign_derivatives.py::test_a_hessian_that_is_not_symmetric",
    ),
    "a wall with two wrong entries for one that is all wrong": Bug(
        "check/entries.py",
        "                if all(abs(part) > visible for part in self._part_gaps(leaf, slab(position))):\n",
        "                if True:\n",
        "tests/check/test_check_entries.py",
    ),
    "a gradient of complex numbers as the tape has it": Bug(
        "autodiff/flattening.py",
        "np.conj(g).astype(complex)",
        "g.astype(complex)",
        "tests/check/test_check_audit.py tests/optimize/test_minimize.py",
    ),
    "a plan that counts no step that is run again": Bug(
        "report",
        'recomputation=1.0 + totals["steps recomputed"] / steps if steps else 1.0',
        "recomputation=1.0",
        "tests/report/test_explain.py tests/report/test_explain_loops.py",
    ),
    "a stress case that passes a gradient of 0": Bug(
        "report",
        'return FAILED, gap, "the gradient is 0',
        'return PASSED, gap, "the gradient is 0',
        "tests/report/test_stress.py::test_a_wrong_gradient_and_a_swallowed_nan_fail",
    ),
    "a table that leaves a bar in a cell": Bug(
        "check", '.replace("|", "\\\\|")', "", "tests/report/test_report_tables.py"
    ),
    "rates that are paired with fields by position": Bug(
        "integrators",
        'return paired(tree, u, name, advice="; return a tree like the state", shapes=True)',
        "return [*tree.values()]",
        "tests/integrators/test_integrators_fields.py",
    ),
    "lengths of complex vectors without a conjugate": Bug(
        "solvers",
        "return sqrt(np.vdot(x, x).real)",
        "return sqrt(abs(x @ x))",
        "tests/solvers/test_elliptic_complex.py",
    ),
    "conjugate gradients in an inner product without volumes": Bug(
        "solvers", "x if is_uniform else measure * x", "x", "tests/solvers/test_solvers_methods.py"
    ),
    **{name: Bug("parallel", *lines, on_ranks=True) for name, lines in BUGS_ON_RANKS.items()},
}


@cache
def text_of(path, time):
    """Return the text of a file that was written at a time."""
    return path.read_text(encoding="utf-8")


def planted(folder, bug):
    """Return the file of a copy of the package that holds the bug, and its text with the bug."""
    place = folder / "sparsedp" / bug.place
    files = [place] if place.is_file() else sorted(place.rglob("*.py"))
    found = [(path, text) for path in files for text in [text_of(path, path.stat().st_mtime_ns)] if bug.right in text]
    count = sum(text.count(bug.right) for _, text in found)
    assert count == 1, f"{count} times in {bug.place}, once is needed: {bug.right}"
    return next((path, text.replace(bug.right, bug.wrong)) for path, text in found)


@pytest.fixture(scope="session")
def copied(tmp_path_factory):
    """A copy of the package and its tests; what is compiled of it serves all bugs."""
    folder = tmp_path_factory.mktemp("copy")
    for name in ("sparsedp", "tests"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("setup.cfg", "pyproject.toml"):
        shutil.copy(ROOT / name, folder / name)
    return folder


def write_as_changed(path, text):
    """Write a file with a time of its own: bytecode of a text of the same length and second would be taken for its."""
    path.write_text(text, encoding="utf-8")
    time = next(TIMES)
    os.utime(path, (time, time))


def failures(folder, tests, compiled=False):
    """Run tests in a copy; return (exit code, output). With the plain kernels nothing is compiled again."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "SPARSEDP_NUMBA": str(int(compiled))}
    for name in ("PYTHONDONTWRITEBYTECODE", "PYTHONPYCACHEPREFIX"):  # bytecode goes with the copy
        environment.pop(name, None)
    arguments = ["-n0", "-x", "-p", "no:cacheprovider", "--tb=line", *tests.split()]
    done = run_python("pytest", arguments, folder, environment)
    return done.returncode, done.stdout


def test_every_bug_fits_its_line():
    assert len(BUGS) >= 40
    for bug in BUGS.values():
        path, text = planted(ROOT, bug)
        compile(text, path.name, "exec")
        assert all((ROOT / file.split("::")[0]).exists() for file in bug.tests.split())


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS))
def test_without_a_bug_nothing_fails(copied, part):
    """In parts, which run on several workers; the longest ones, so the first."""
    tests = sorted({test for bug in BUGS.values() for test in bug.tests.split()})
    code, printed = failures(copied, " ".join(tests[part::PARTS]))
    assert code == 0, printed[-2000:]


@pytest.mark.slow
@pytest.mark.parametrize("name", BUGS)
def test_it_is_caught(copied, name):
    bug = BUGS[name]
    if bug.on_ranks and MISSING:
        pytest.skip(f"not here: {', '.join(MISSING)}")
    path, text = planted(copied, bug)
    right = path.read_text(encoding="utf-8")
    write_as_changed(path, text)
    try:
        code, printed = failures(copied, bug.tests, bug.compiled)
    finally:
        write_as_changed(path, right)
    assert code == 1 and " failed" in printed, f"not caught:\n{printed[-2000:]}"
