"""Errors of constraints of minimize: each whole message."""

import re
import sys
from types import ModuleType

import autograd.numpy as anp
import numpy as np
import pytest
from scipy.optimize import LinearConstraint, NonlinearConstraint

import sparsedp as dp
from sparsedp.errors import DerivativeError, NonFiniteError, ShapeError


def run(constraints, method="augmented_lagrangian", start=(0.5, 0.5), **options):
    return lambda: dp.minimize(lambda x: anp.sum(x**2), np.array(start), method, constraints=constraints, **options)


def growing():
    """A constraint whose value gets another shape in the second call."""
    calls = []

    def constraint(x):
        calls.append(1)
        return anp.concatenate([x - 1.0] * len(calls))

    return constraint


above = lambda x: 1.0 - anp.sum(x)
WRONG = [
    (
        run(above, "lbfgs"),
        ValueError,
        "lbfgs takes no constraints; write method= one of augmented_lagrangian, mma, slsqp, trust_constr, ipopt",
    ),
    (
        run(3.0),
        TypeError,
        "constraints must be a function, dp.equal(function) or a NonlinearConstraint, got float; "
        "write lambda x: np.sum(x) - 1.0",
    ),
    (
        run([above, None]),
        TypeError,
        "constraints[1] must be a function, dp.equal(function) or a NonlinearConstraint, got NoneType; "
        "write lambda x: np.sum(x) - 1.0",
    ),
    (
        run({"type": "ineq", "fun": above}),
        TypeError,
        "constraints takes functions that are <= 0 at a feasible point, got a dict of SciPy, whose fun is >= 0 there; "
        "write lambda x: -fun(x) for 'ineq' and dp.equal(fun) for 'eq'",
    ),
    (
        run(lambda x: anp.sum(x) <= 1.0),
        TypeError,
        "constraints must return numbers that are <= 0 at a feasible point, got bool; write x - 1 for x <= 1",
    ),
    (
        run({"a": lambda x: [x[0], x[1]]}),
        TypeError,
        "constraints['a'] must return one number or array, got list; write np.stack or np.concatenate, or a list of "
        "functions as constraints",
    ),
    (
        run(lambda x: x + 1j),
        DerivativeError,
        "constraints must be real, got complex values; write their real part or absolute value",
    ),
    (run(lambda x: x[:0]), ShapeError, "constraints returned an empty array; leave it out"),
    (
        run(lambda x: np.ones(2)),
        DerivativeError,
        "constraints does not depend on x; leave it out, or compute it from x with autograd.numpy",
    ),
    (
        run(lambda x: dp.equal(above)(x)),
        ValueError,
        "constraints calls dp.equal(function) inside another function, which does not require == 0; write "
        "dp.equal(lambda x: ...) around the whole function, or call the inner function itself",
    ),
    (
        run(lambda x: x * np.nan),
        NonFiniteError,
        "constraints must be finite; start where every constraint is, got 2 that are NaN or infinite",
    ),
    (
        run(growing()),
        ShapeError,
        "constraints must return the same shape in each call, got (2,) and (4,)",
    ),
    (
        run(NonlinearConstraint(lambda x: x, 1.0, 0.0)),
        ValueError,
        "constraints: lb must be <= ub, got 1 > 0",
    ),
    (
        run(LinearConstraint(np.ones((2, 3)), 0.0, 1.0)),
        ShapeError,
        "constraints: A must have a column for each of the 2 unknowns, got shape (2, 3)",
    ),
    (
        run(lambda x: anp.sum(anp.sqrt(x)) - 1.0, start=(0.0, 0.0)),
        NonFiniteError,
        "a derivative of constraints must be finite; start where every constraint has derivatives, got 2 that are NaN",
    ),
    (
        run(NonlinearConstraint(lambda x: x, np.nan, 0.0)),
        ValueError,
        "constraints: lb and ub must not be NaN; write -np.inf or np.inf for none",
    ),
    (
        run(NonlinearConstraint(lambda x: x, np.inf, np.inf)),
        ValueError,
        "constraints: no value is >= lb=inf or <= ub=-inf; write lb=-np.inf or ub=np.inf for none",
    ),
    (
        run(NonlinearConstraint(lambda x: x, 0.0, np.array([1.0, -np.inf]))),
        ValueError,
        "constraints: no value is >= lb=inf or <= ub=-inf; write lb=-np.inf or ub=np.inf for none",
    ),
    (
        run(NonlinearConstraint(lambda x: x, 0.0, 1j)),
        TypeError,
        "a limit of constraints must hold real numbers, got dtype complex128",
    ),
    (
        run(LinearConstraint([[1.0, 1.0]], 0.0, 1.0), start=(0.5j, 0.5)),
        TypeError,
        "constraints: a LinearConstraint takes real unknowns, got complex ones; write a function, such as "
        "lambda x: np.real(np.sum(x)) - 1.0",
    ),
    (
        run(NonlinearConstraint(lambda x: x, np.zeros(3), np.ones(3))),
        ShapeError,
        "constraints: lb and ub of shapes (3,) and (3,) do not fit a value of shape (2,)",
    ),
    (
        run(NonlinearConstraint(lambda x: x, 0.0, 1.0, keep_feasible=True)),
        ValueError,
        "constraints: keep_feasible is not available; write bounds, or leave it out",
    ),
    (
        run(NonlinearConstraint(lambda x: x, 0.0, 1.0, jac=lambda x: np.ones((3, 2)))),
        ShapeError,
        "the jac of constraints must have shape (2, 2), got (3, 2)",
    ),
    (
        run(above, "slsqp", checkpoint="folder"),
        TypeError,
        "slsqp cannot store its state, which is inside of a library; leave checkpoint out, or write "
        "method='augmented_lagrangian'",
    ),
    (run(above, batches=[1]), TypeError, "augmented_lagrangian does not use batches; leave it out"),
    (
        run(above, "slsqp", tolerance=dp.certified(0.1)),
        TypeError,
        "slsqp does not use the tolerance dp.certified; write a number",
    ),
    (
        run(above, "ipopt", settings=3),
        TypeError,
        "settings of ipopt must be a dict of Ipopt's options, got int; write {'linear_solver': 'mumps'}",
    ),
    (
        run(above, penalty=0.0),
        ValueError,
        "penalty of augmented_lagrangian must be > 0, got 0; the default is 1",
    ),
    (
        run(above, growth=1.0),
        ValueError,
        "growth of augmented_lagrangian must be > 1, got 1; the default is 10",
    ),
    (
        run({"a": above}, multipliers=1.0),
        ShapeError,
        "multipliers: expected a dict of a, got an array of shape (); write them as best.multipliers has them",
    ),
    (
        run([above], multipliers=[np.ones(2)]),
        ShapeError,
        "multipliers[0] must have the shape () of the constraint, got (2,)",
    ),
    (
        run(above, multipliers=-1.0),
        ValueError,
        "multipliers contains -1, and no limit there has a multiplier of this sign; those of function(x) <= 0 are >= 0",
    ),
    (run(above, "slsqp", multipliers=1.0), TypeError, "slsqp has no option 'multipliers'; it has none"),
    (
        run(None, multipliers=1.0),
        TypeError,
        "multipliers belong to constraints, and there are none; leave multipliers out",
    ),
    (lambda: dp.equal(3), TypeError, "equal takes a function, got int; write lambda x: np.sum(x) - 1.0"),
]


@pytest.mark.parametrize("call, error, message", WRONG)
def test_refusals(call, error, message):
    with pytest.raises(error, match="^" + re.escape(message)):
        call()


def test_equalities_are_refused_by_mma(monkeypatch):
    monkeypatch.setitem(sys.modules, "nlopt", ModuleType("nlopt"))  # whether it is installed or not
    message = "mma takes inequalities only, and there are equalities; write method='augmented_lagrangian'"
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        run([above, dp.equal(above)], "mma")()


@pytest.mark.parametrize(
    "method, library, message",
    [
        ("mma", "nlopt", "the method mma needs nlopt; install sparsedp[design]"),
        (
            "ipopt",
            "cyipopt",
            "the method ipopt needs cyipopt; install it with conda install -c conda-forge cyipopt",
        ),
    ],
)
def test_a_missing_library_is_named(monkeypatch, method, library, message):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ImportError, match="^" + re.escape(message)):
        run(above, method)()
