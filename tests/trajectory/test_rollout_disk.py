"""rollout with states in files: the same bits, files that disappear, and runs that continue after an interruption."""

import errno
import os
import signal
import subprocess
import sys
import time
import warnings
from functools import partial
from pathlib import Path

import autograd.numpy as anp
import numpy as np
import pytest
import scipy.sparse as sp

import sparsedp as dp
from sparsedp._utils.pytree import leaves
from sparsedp.errors import DiskWarning
from sparsedp.trajectory import disk_states
from sparsedp.trajectory.checkpoint_plan import CheckpointPlan
from sparsedp.trajectory.run_key import run_key

N = 30
U = np.random.default_rng(0).random(40)
P = np.random.default_rng(1).random(40)
FORCES = np.random.default_rng(2).random((N, 40))
MEMORY = 11 * U.nbytes  # five states beside params and the arrays in use


def bend(u, p):
    return u + 0.1 * anp.sin(p * u) * anp.roll(u, 1)


def push(u, p, force):
    return bend(u, p) + 0.01 * force


class Interrupted:
    """A step that is interrupted at one of its calls."""

    def __init__(self, step=bend, at=None, error=KeyboardInterrupt):
        self.step = step
        self.at = at
        self.error = error
        self.calls = 0

    def __call__(self, *args):
        self.calls += 1
        if self.calls == self.at:
            raise self.error
        return self.step(*args)


def gradient(folder, step=bend, n=N, **options):
    """Return the value and the gradient in state and params as one list of arrays."""
    settings = {"memory": MEMORY, "disk": folder, **options}
    loss = lambda x: anp.sum(dp.rollout(step, *x, n, **settings) ** 2)
    value, (first, params) = dp.value_and_grad(loss)((U, P))
    return [value, first, params]


def same(one, other):
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


WANTED = gradient(None, memory=None)


@pytest.mark.parametrize("keep", ["last", [3, 7, N], lambda i, u: anp.sum(u**2)], ids=["last", "some", "each"])
@pytest.mark.parametrize("limit", [None, 1, 5])
def test_the_gradient_has_the_bits_of_a_run_in_memory(tmp_path, limit, keep):
    disk = tmp_path if limit is None else (tmp_path, limit * U.nbytes)

    def loss(x, **options):
        result = dp.rollout(bend, *x, N, keep=keep, **options)
        return sum(result) if isinstance(result, tuple) else anp.sum(result**2)

    records = []
    wanted = dp.value_and_grad(loss)((U, P))
    value, slopes = dp.value_and_grad(lambda x: loss(x, memory=MEMORY, disk=disk, record=records.append))((U, P))
    assert value == wanted[0] and same(slopes, wanted[1])
    assert records[0].on_disk == (limit or N - 5)
    assert (records[1].recomputed == 0) == (limit is None)
    assert not os.listdir(tmp_path)


def test_no_file_is_written_if_all_states_fit_into_the_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(disk_states, "write_state", None)
    assert same(gradient(tmp_path, memory="1 MB"), WANTED)


def test_no_file_is_written_without_a_gradient(tmp_path, monkeypatch):
    monkeypatch.setattr(disk_states, "write_state", None)
    dp.rollout(bend, U, P, N, memory=MEMORY, disk=tmp_path)


def test_files_disappear_with_a_result_that_nobody_differentiates(tmp_path):
    _, pull = dp.vjp(lambda u: dp.rollout(bend, u, P, N, memory=MEMORY, disk=tmp_path), U)
    assert len(list(tmp_path.glob("rollout-*/state-*"))) > 20
    del pull
    assert not os.listdir(tmp_path)


def test_files_disappear_after_an_error_of_the_step(tmp_path):
    calls = []

    def step(u, p):
        calls.append(1)
        if len(calls) == 12:
            raise ZeroDivisionError
        return bend(u, p)

    with pytest.raises(ZeroDivisionError):
        gradient(tmp_path, step)
    assert not os.listdir(tmp_path)


def test_files_disappear_after_a_state_that_is_not_finite(tmp_path):
    growing = lambda u, p: np.inf * u
    with pytest.raises(dp.errors.NonFiniteError) as caught:
        gradient(tmp_path, growing)
    assert caught.traceback and not os.listdir(tmp_path)  # although the traceback refers to the run


STATES = {
    "tree": ({"a": U, "b": (np.float32(2.0), 1.5)}, lambda s, p: {"a": bend(s["a"], p), "b": s["b"]}),
    "integers": ((U, 0, "name"), lambda s, p: (bend(s[0], p), s[1] + 1, s[2])),
    "complex": (U + 1j * P, lambda u, p: u + 0.1 * p * u * anp.roll(u, 1)),
    "single": (U.astype(np.float32), lambda u, p: anp.float32(0.5) * u + 0.1 * anp.sin(u)),
    "empty": ((U, np.zeros((0, 2))), lambda s, p: (bend(s[0], p), s[1])),
    "number": (0.3, lambda u, p: u + 0.1 * anp.sin(u) * p[0]),
}


@pytest.mark.parametrize("name", STATES)
def test_states_of_every_kind(tmp_path, name):
    state, step = STATES[name]

    def loss(x, **options):
        end = dp.rollout(step, x, P, N, **options)
        while isinstance(end, (tuple, dict)):
            end = end["a"] if isinstance(end, dict) else end[0]
        return anp.sum(anp.abs(end) ** 2)

    memory = P.nbytes + 9 * (sum(np.asarray(leaf).nbytes for leaf in leaves(state) if not isinstance(leaf, (int, str))))
    records = []
    options = {"memory": memory, "disk": tmp_path, "record": records.append}
    wanted, slope = dp.value_and_grad(loss)(state)
    value, other = dp.value_and_grad(lambda x: loss(x, **options))(state)
    assert value == wanted and records[0].on_disk > 0
    assert repr(other) == repr(slope)


def test_a_jitted_step(tmp_path):
    jitted = dp.jit(bend)
    assert same(gradient(tmp_path, jitted), gradient(None, jitted, memory=None))
    assert not os.listdir(tmp_path)


@pytest.mark.parametrize("limit", [4, pytest.param(None, marks=pytest.mark.whole)])
@pytest.mark.parametrize("options", [{}, {"inputs": FORCES}, {"truncate": 7}], ids=["plain", "inputs", "truncated"])
def test_an_interrupted_run_continues(tmp_path, limit, options, monkeypatch):
    monkeypatch.setattr(disk_states, "INTERVAL", 0.0)
    monkeypatch.setattr(disk_states, "SHARE", np.inf)
    monkeypatch.setattr(os, "fsync", lambda handle: None)  # slow, and this test stops no machine
    disk = tmp_path if limit is None else (tmp_path, limit * U.nbytes)
    if "inputs" in options:
        options = {**options, "memory": MEMORY + FORCES.nbytes}
    step = Interrupted(push if "inputs" in options else bend)
    wanted = gradient(None, step, **{**options, "memory": None})
    step.calls = 0
    assert same(gradient(disk, step, **options), wanted)
    whole = step.calls
    saved = 0
    for at in range(3, whole, 23):
        step.calls, step.at = 0, at
        with pytest.raises(KeyboardInterrupt):
            gradient(disk, step, **options)
        step.calls, step.at = 0, None
        records = []
        assert same(gradient(disk, step, record=records.append, **options), wanted)
        assert not os.listdir(tmp_path)
        saved += whole - step.calls
        assert (records[0].resumed_at or 0) > 0 or at < N
    assert saved > 0


def test_a_second_interruption_and_another_cotangent(tmp_path, monkeypatch):
    monkeypatch.setattr(disk_states, "INTERVAL", 0.0)
    monkeypatch.setattr(disk_states, "SHARE", np.inf)
    monkeypatch.setattr(os, "fsync", lambda handle: None)  # slow, and this test stops no machine
    step = Interrupted()
    loss = lambda weight: lambda u: weight * anp.sum(dp.rollout(step, u, P, N, memory=MEMORY, disk=tmp_path) ** 2)
    for at in (20, 25, 15):
        step.calls, step.at = 0, at
        with pytest.raises(KeyboardInterrupt):
            dp.grad(loss(1.0))(U)
    step.at = None
    assert np.array_equal(dp.grad(loss(3.0))(U), dp.grad(lambda u: 3.0 * anp.sum(dp.rollout(bend, u, P, N) ** 2))(U))
    assert not os.listdir(tmp_path)


def test_an_interruption_after_the_last_step(tmp_path, monkeypatch):
    monkeypatch.setattr(disk_states, "INTERVAL", 0.0)
    monkeypatch.setattr(disk_states, "SHARE", np.inf)
    monkeypatch.setattr(os, "fsync", lambda handle: None)  # slow, and this test stops no machine
    save = Interrupted(disk_states.save_tree)
    monkeypatch.setattr(disk_states, "save_tree", save)
    gradient(tmp_path)
    save.calls, save.at = 0, save.calls
    with pytest.raises(KeyboardInterrupt):
        gradient(tmp_path)
    assert same(gradient(tmp_path), WANTED)
    assert not os.listdir(tmp_path)


def test_an_interruption_while_cotangents_are_written(tmp_path, monkeypatch):
    """zipfile then raises an error of its own, because it cannot close the unfinished file."""

    def savez(*args):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt:
            raise ValueError("Can't close the ZIP file")  # noqa: B904

    monkeypatch.setattr(disk_states, "INTERVAL", 0.0)
    with monkeypatch.context() as patched:
        patched.setattr(np, "savez", savez)
        with pytest.raises(KeyboardInterrupt):
            gradient(tmp_path)
    monkeypatch.setattr(disk_states, "INTERVAL", np.inf)
    records = []
    assert same(gradient(tmp_path, record=records.append), WANTED)
    assert records[0].resumed_at == N
    assert not os.listdir(tmp_path)


def test_a_run_that_exits_continues(tmp_path):
    step = Interrupted(at=20, error=SystemExit)
    with pytest.raises(SystemExit):
        gradient(tmp_path, step)
    step.at = None
    records = []
    assert same(gradient(tmp_path, step, record=records.append), WANTED)
    assert records[0].resumed_at > 10
    assert not os.listdir(tmp_path)


def test_a_run_continues_with_its_last_state(tmp_path, monkeypatch):
    """If the key of the run covers the step, no step of the forward pass is run again."""
    with monkeypatch.context() as patched:
        patched.setattr(disk_states.DiskStates, "saved_progress", Interrupted(at=1))
        with pytest.raises(KeyboardInterrupt):
            gradient(tmp_path)
    records = []
    assert same(gradient(tmp_path, record=records.append), WANTED)
    assert records[0].resumed_at == N
    assert not os.listdir(tmp_path)


@pytest.mark.parametrize("at", [20, N + 10])
def test_a_changed_step_does_not_continue_the_old_run(tmp_path, at):
    step = Interrupted(at=at)
    with pytest.raises(KeyboardInterrupt):
        gradient(tmp_path, step)
    step.at = None
    step.step = lambda u, p: 0.99 * bend(u, p)  # an attribute of an object: not part of the hash
    wanted = gradient(None, step, memory=None)
    assert same(gradient(tmp_path, step), wanted)
    assert not os.listdir(tmp_path)


class Measured:
    """A step with measurements, one row for each step; the key of a run cannot cover objects of such a class."""

    def __init__(self, rows):
        self.rows = rows

    def __call__(self, state, p):
        u, i = state
        return bend(u, p) + self.rows[int(value_of(i))], i + 1.0


def value_of(number):
    return getattr(number, "_value", number)


def with_method(rows):
    return Measured(rows).__call__


def with_inner_function(rows):
    row = lambda i: rows[int(value_of(i))]
    return lambda state, p: (bend(state[0], p) + row(state[1]), state[1] + 1.0)


def with_argument(rows):
    return partial(lambda rows, state, p: (bend(state[0], p) + rows[int(value_of(state[1]))], state[1] + 1.0), rows)


@pytest.mark.parametrize(
    "make",
    [
        Measured,
        with_argument,
        *(pytest.param(make, marks=pytest.mark.whole) for make in (with_method, with_inner_function)),
    ],
)
def test_measurements_that_change_late_do_not_continue_the_old_run(tmp_path, make, monkeypatch):
    """The steps before the change give the same states; those after it have been differentiated."""
    monkeypatch.setattr(disk_states, "INTERVAL", 0.0)
    monkeypatch.setattr(disk_states, "SHARE", np.inf)
    monkeypatch.setattr(os, "fsync", lambda handle: None)  # slow, and this test stops no machine
    save_tree = disk_states.save_tree
    is_interrupted = True

    def save(path, content, kind):
        if is_interrupted and content["progress"][0] == 12:
            save_tree(path, content, kind)
            raise KeyboardInterrupt

    monkeypatch.setattr(disk_states, "save_tree", save)

    def slope(rows, **options):
        run = lambda u: dp.rollout(make(rows), (u, 0.0), P, N, **options)[0]
        return dp.value_and_grad(lambda u: anp.sum(run(u)))(U)  # linear: with the same cotangents for both runs

    on_disk = {"memory": 13 * U.nbytes, "disk": tmp_path}
    rows = np.zeros((N, 40))
    with pytest.raises(KeyboardInterrupt):
        slope(rows, **on_disk)
    is_interrupted = False
    assert len(list(tmp_path.glob("rollout-*/backward.npz"))) == 1
    other = rows.copy()
    other[-2] = 1.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DiskWarning)  # of the files of the first run, if it has another key
        assert same(slope(other, **on_disk), slope(other))
    records = []
    assert same(slope(rows, record=records.append, **on_disk), slope(rows))
    assert (records[0].resumed_at is None) == (make in (Measured, with_method))  # the others have two keys
    assert not os.listdir(tmp_path)


GAIN = 1.0


def amplified(u):
    return GAIN * u


def test_what_the_step_refers_to_belongs_to_the_run(monkeypatch):
    specification = lambda step: type(
        "S", (), {"step": step, "n": 1, "truncate": None, "differentiated": [0], "forms": []}
    )
    key = lambda step: run_key(specification(step), [U])

    def make(factor):
        return lambda u, p: factor * u

    def other(factor):
        return lambda u, p: factor * u * u

    assert key(make(1.0)) == key(make(1.0)) == key(dp.jit(make(1.0)))
    assert len({key(make(1.0)), key(make(2.0)), key(make(U)), key(other(1.0))}) == 4
    grid = dp.Grid(8)
    diffusion = lambda dt: dp.inverse(dp.identity(grid.cells) - dt * dp.laplacian(grid))
    using = lambda solve: lambda u, p: solve(amplified(u))
    solve = diffusion(0.1)
    wanted = key(using(solve))
    solve(np.ones(8))  # records of solves are no part of it
    assert wanted == key(using(solve)) == key(using(diffusion(0.1))) and wanted.is_complete
    assert wanted != key(using(diffusion(0.2)))
    monkeypatch.setitem(globals(), "GAIN", 2.0)
    assert wanted != key(using(solve))
    monkeypatch.setitem(globals(), "GAIN", 1.0)
    assert wanted == key(using(solve))
    with monkeypatch.context() as patched:
        patched.setattr("importlib.metadata.version", lambda package: "another version")
        assert wanted != key(using(solve))
    assert key(dp.stepper("rk4", make(1.0), 0.1)) != key(dp.stepper("rk4", make(1.0), 0.2))
    matrix = lambda factor: factor * sp.eye_array(3, format="csr")
    assert len({key(make(matrix(1.0))), key(make(matrix(2.0))), key(make({1.0})), key(make({"a": 1.0}))}) == 4
    nested = make(1.0)
    for _ in range(sys.getrecursionlimit()):
        nested = (lambda inner: lambda u, p: inner(u, p))(nested)
    assert key(nested).is_complete
    assert not key(Measured(U)).is_complete and not key(make(np.random.default_rng(0))).is_complete
    assert key(make(os)).is_complete and not key(make(pytest)).is_complete


def test_files_of_other_arguments_are_kept_and_reported(tmp_path):
    step = Interrupted(at=20)
    with pytest.raises(KeyboardInterrupt):
        gradient(tmp_path, step)
    before = os.listdir(tmp_path)
    with pytest.warns(
        DiskWarning,
        match=".* holds 1 rollout folders of .* MB, of runs that were interrupted; repeat the interrupted call to "
        "continue it, or delete the folders",
    ):
        gradient(tmp_path, step, n=N - 1)
    assert os.listdir(tmp_path) == before


def test_a_relative_path_is_that_of_the_call(tmp_path, monkeypatch):
    for name in ("begin", "end"):
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path / "begin")
    end, pull = dp.vjp(lambda u: dp.rollout(bend, u, P, N, memory=MEMORY, disk="states"), U)
    monkeypatch.chdir(tmp_path / "end")
    wanted = pull(end)
    assert np.array_equal(pull(end), wanted)  # runs the forward pass again
    assert os.listdir(tmp_path / "begin") == ["states"] and not os.listdir("../begin/states")
    assert not os.listdir(tmp_path / "end")


def test_folders_of_the_user_are_not_touched(tmp_path):
    link = f"rollout-{'0' * 32}-{'0' * 8}"
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "lock").write_text("mine")
    (tmp_path / link).symlink_to(tmp_path / "elsewhere")
    (tmp_path / "rollout-results").mkdir()
    (tmp_path / "rollout-notes").write_text("mine")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert same(gradient(tmp_path), WANTED)
    assert sorted(os.listdir(tmp_path)) == sorted(["elsewhere", link, "rollout-notes", "rollout-results"])
    assert not os.listdir(tmp_path / "rollout-results") and os.listdir(tmp_path / "elsewhere") == ["lock"]


def test_other_files_in_the_folder_of_a_run(tmp_path):
    step = Interrupted(at=25)
    with pytest.raises(KeyboardInterrupt):
        gradient(tmp_path, step)
    [folder] = tmp_path.iterdir()
    for name in ("state-", "state-000000000005 (copy)", "state-000000000099", "notes"):
        (folder / name).write_text("")
    (folder / "state-000000000028").mkdir()
    step.at = None
    records = []
    assert same(gradient(tmp_path, step, record=records.append), WANTED)
    assert records[0].resumed_at > 10
    assert not os.listdir(tmp_path)


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX locks")
def test_a_disk_without_locks_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr("fcntl.flock", lambda *args: (_ for _ in ()).throw(OSError(errno.ENOLCK, "no locks")))
    with pytest.raises(
        OSError, match="no file can be created and locked in .*; name a folder on a local disk with free space"
    ):
        gradient(tmp_path)
    assert not os.listdir(tmp_path)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs os.fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_process_does_not_remove_the_files(tmp_path):
    end, pull = dp.vjp(lambda u: dp.rollout(bend, u, P, N, memory=MEMORY, disk=tmp_path), U)
    child = os.fork()
    if child == 0:
        del pull
        os._exit(0)
    os.waitpid(child, 0)
    assert np.array_equal(pull(end), dp.vjp(lambda u: dp.rollout(bend, u, P, N), U)[1](end))
    assert not os.listdir(tmp_path)


def test_two_runs_with_the_same_arguments_at_the_same_time(tmp_path):
    run = lambda: dp.vjp(lambda u: dp.rollout(bend, u, P, N, memory=MEMORY, disk=tmp_path), U)
    (end, pull), (_, other) = run(), run()
    assert len(os.listdir(tmp_path)) == 2
    assert np.array_equal(pull(end), other(end))
    assert not os.listdir(tmp_path)


def test_a_pullback_that_is_called_twice(tmp_path):
    end, pull = dp.vjp(lambda u: dp.rollout(bend, u, P, N, memory=MEMORY, disk=tmp_path), U)
    assert np.array_equal(pull(end), pull(end))
    assert not os.listdir(tmp_path)


@pytest.mark.parametrize("at", [0, 3, 20])
def test_a_full_disk_costs_time_only(tmp_path, at, monkeypatch):
    write = disk_states.write_state
    calls = []

    def limited(path, state):
        calls.append(path)
        if len(calls) > at:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(path, state)

    monkeypatch.setattr(disk_states, "write_state", limited)
    records = []
    with pytest.warns(
        DiskWarning,
        match="the disk is full: .* holds .* states of this rollout, the other steps will be run again; free space "
        "there, or name a folder on another disk",
    ):
        found = gradient(tmp_path, record=records.append)
    assert same(found, WANTED) and records[1].recomputed > 0
    assert not os.listdir(tmp_path)


def test_a_partial_write_leaves_no_file(tmp_path, monkeypatch):
    monkeypatch.setattr(disk_states, "_bytes_of", lambda value: (_ for _ in ()).throw(OSError(errno.ENOSPC, "full")))
    monkeypatch.setattr(disk_states, "state_digest", lambda values: "")
    with pytest.raises(OSError):
        disk_states.write_state(tmp_path / "state-1", disk_states.State(1, [U], ()))
    assert not os.listdir(tmp_path)


def test_a_file_that_was_changed_is_an_error(tmp_path):
    end, pull = dp.vjp(lambda u: dp.rollout(bend, u, P, N, memory=MEMORY, disk=tmp_path), U)
    [file] = tmp_path.glob("rollout-*/state-000000000009")
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    with pytest.raises(OSError, match="state-000000000009 was changed or removed during the rollout; run it again"):
        pull(end)
    assert not os.listdir(tmp_path)


def test_a_damaged_file_of_an_interrupted_run_is_not_used(tmp_path):
    step = Interrupted(at=N + 10)
    with pytest.raises(KeyboardInterrupt):
        gradient(tmp_path, step)
    file = max(tmp_path.glob("rollout-*/state-*"))
    file.write_bytes(file.read_bytes()[:-8])
    step.at = None
    assert same(gradient(tmp_path, step), WANTED)


def test_plan_with_files():
    plan = CheckpointPlan(100, 10, -1).with_files(20)
    assert plan.disk_slots == 20 and [*plan.disk_indices()] == [*range(5, 91, 5)]
    assert plan.stored_indices() == {0, *range(5, 91, 5), *range(90, 101)}
    plan = CheckpointPlan(100, 10, -1).with_files(15)
    assert [*plan.disk_indices()] == [*range(6, 91, 6)]
    assert plan.stored_indices() == {0, *range(6, 91, 6), *range(90, 101)}
    assert CheckpointPlan(100, 10, -1).with_files(1000).stored_indices() == {*range(101)}
    assert CheckpointPlan(5, 5, -1).with_files(1000).disk_slots == 0
    assert not CheckpointPlan(5, 5, -1).with_files(0).disk_indices()


KILLED = """
import sys
import numpy as np, autograd.numpy as anp, sparsedp as dp
from sparsedp.trajectory import disk_states
disk_states.INTERVAL, disk_states.SHARE = 0.02, 1.0
rng = np.random.default_rng(0)
u, p = rng.random(2000), rng.random(2000)
def step(u, p):
    return u + 0.01 * anp.sin(p * u) * anp.roll(u, 1)
records = []
disk = None if len(sys.argv) < 2 else (sys.argv[1], 1500 * u.nbytes)
loss = lambda x: anp.sum(dp.rollout(step, *x, 4000, memory="1 MB" if disk else None, disk=disk,
                                    record=records.append) ** 2)
print("ready", flush=True)
value, (a, b) = dp.value_and_grad(loss)((u, p))
print(value.hex(), a.tobytes().hex()[:4000], float(np.sum(b)).hex(), records[0].resumed_at)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_killed_at_random_moments(tmp_path):
    """20 times, each run continued by the next one: no result changes, and no file remains."""
    command = [sys.executable, "-c", KILLED]
    begin = time.perf_counter()
    wanted = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()[1:-1]
    seconds = time.perf_counter() - begin
    rng = np.random.default_rng(0)
    killed = 0
    continued = 0
    while killed < 20:
        child = subprocess.Popen([*command, tmp_path], stdout=subprocess.PIPE, text=True)
        assert child.stdout.readline() == "ready\n"
        time.sleep(rng.uniform(0.0, 0.4 * seconds))
        child.send_signal(signal.SIGKILL)
        words = child.stdout.read().split()
        child.wait()
        if words:  # it ended before
            assert words[:-1] == wanted
            assert not os.listdir(tmp_path)
            continued += words[-1] != "None"
        else:
            killed += 1
            assert len(os.listdir(tmp_path)) <= 1
    last = subprocess.run([*command, tmp_path], capture_output=True, text=True, check=True).stdout.split()[1:]
    assert last[:-1] == wanted
    assert continued or last[-1] != "None"
    assert not os.listdir(tmp_path)


def test_a_file_instead_of_a_folder(tmp_path):
    path = Path(tmp_path, "file")
    path.write_text("")
    with pytest.raises(OSError, match="give the path of a folder, this is a file"):
        gradient(path)


def test_forward_derivatives_need_no_files(tmp_path):
    loss = lambda u: anp.sum(dp.rollout(bend, u, P, N, memory=MEMORY, disk=tmp_path) ** 2)
    assert dp.jvp(loss, U, U) == dp.jvp(lambda u: anp.sum(dp.rollout(bend, u, P, N) ** 2), U, U)
    assert not os.listdir(tmp_path)
