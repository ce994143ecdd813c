"""Programs of autograd without sparsedp: importing and using it changes neither their tapes nor their results."""

import subprocess
import sys

PROGRAM = '''
import gc
import sys

import autograd
import autograd.numpy as np
from autograd.core import JVPNode, VJPNode
from autograd.tracer import Node, trace
import numpy

X = numpy.random.default_rng(0).uniform(0.5, 1.5, (3, 4))


def arithmetic(x):
    y = 2.0 + x * 3 - x / (x + 1.0) - (-x) ** 2 + x ** 2.5 + 1.0 / x - 2 ** x + x ** x
    return y + y * numpy.ones(4) + [1.0, 2.0, 3.0, 4.0] * x


def entries(x):
    row = x[0] * x[1:2] + x[[0, 0, 2]] + x[..., -1:] + x[x > 1.0][0]
    return np.sum(row) * np.array([x[0, 0], 2.0, x[1, 1] * x[2, 3], np.array(x[0, 1])]) / x.shape[0]


def filled(x):
    return x * np.full_like(x, x[0, 0]) + np.full_like(x, 2.0)


def of_numbers(x):
    a = x[0, 0]
    others = np.arctan2(a, 2.0) + np.reciprocal(a) + np.divide(a, x[0, 1])
    return np.array([-a, a * a, 1.0 / a, a - 2.0, 3.0 - a]) + others


def complexes(x):
    z = x * (1.0 + 2.0j)
    return np.real(z * z / (z + 1.0) - z ** 2 + np.angle(z))


def curvature(x):
    return autograd.elementwise_grad(lambda y: autograd.elementwise_grad(arithmetic)(y) * y)(x)


PROGRAMS = arithmetic, entries, filled, of_numbers, complexes, curvature


def name(function):
    code = getattr(function, "__code__", None)
    place = code and (code.co_filename.rpartition("autograd")[2], code.co_firstlineno)
    return function.__module__, function.__qualname__, place


class Call(Node):
    """A node that keeps its call."""

    def __init__(self, value, fun, args, options, nums, parents):
        types = [type(arg).__name__ for arg in args], type(args).__name__, type(nums).__name__, type(parents).__name__
        self.facts = name(fun), types, options, nums, bits(value)
        self.parents = parents

    def initialize_root(self):
        self.facts, self.parents = (), ()


def described(node, seen):
    """All that a node of a reverse-mode trace, or a call, knows."""
    if node in seen:
        return seen[node]
    seen[node] = len(seen)
    if isinstance(node, Call):
        facts = [node.facts]
    else:
        facts = [type(node).__name__, type(node.parents).__name__, name(node.vjp)]
        for cell in node.vjp.__closure__ or ():
            held = cell.cell_contents
            facts.append(name(held) if callable(held) else type(held).__name__)
    return [*facts, [described(parent, seen) for parent in node.parents]]


def bits(value):
    while hasattr(value, "_value"):
        value = value._value
    return type(value).__name__, numpy.asarray(value).tobytes().hex()


def tape(kind, program, *root):
    """The types of boxes, the bits of the result, and the last node of a program."""
    boxes = []

    def watched(x):
        result = program(x)
        boxes.extend([type(x).__name__, type(result).__name__])
        return result

    value, node = trace(kind.new_root(*root), watched, X)
    return boxes, bits(value), node


def facts():
    found = []
    for program in PROGRAMS:
        boxes, value, node = tape(VJPNode, program)
        found += [boxes, value, described(node, {})]
        boxes, value, node = tape(JVPNode, program, X)
        found += [boxes, value, bits(node.g)]
        boxes, value, node = tape(Call, program)
        found += [boxes, value, described(node, {})]
        found.append(bits(autograd.grad(lambda x: np.sum(program(x)))(X)))
        found.append(bits(autograd.jacobian(program)(X)))
    found.append(bits(autograd.hessian(lambda x: np.sum(arithmetic(x[0])))(X[:1])))
    return repr(found)


def state():
    """What a library could change for the whole process."""
    return gc.isenabled(), gc.get_threshold(), gc.get_freeze_count(), sys.excepthook, sys.getrecursionlimit()


before, process = facts(), state()
import sparsedp as dp

assert facts() == before, "import"
assert state() == process

step = dp.stepper("rk4", lambda u, p: p * u - u ** 3, 0.1)


def loss(p):
    u = dp.rollout(step, numpy.ones(4), p, 5)
    return np.sum(dp.laplacian(dp.Grid(4))(u) ** 2) + u[0] / p + autograd.grad(lambda q: q ** 3)(p)


dp.value_and_grad(loss)(0.7)
dp.hvp(loss, 0.7, 1.0)
try:
    dp.grad(lambda x: np.sum(x) + 1 / 0)(X)
except ZeroDivisionError:
    pass
assert facts() == before, "use"
assert state() == process
print("same", len(before))
'''


def test_their_tapes_and_results_stay_as_they_are():
    run = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert run.stdout.startswith("same") and int(run.stdout.split()[1]) > 10_000
