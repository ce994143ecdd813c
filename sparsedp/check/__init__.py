"""Checks of operators, gradients and recorded programs.

No other part of sparsedp imports this package. Every check returns a result object. Its `.verdict` is "agrees",
"disagrees" or "inconclusive", bool(result) is True only for "agrees", and print(result) shows a table.
"""

from sparsedp._utils.calls import describe_module
from sparsedp.check.derivatives import hessian, jacobian, jvp, vjp
from sparsedp.check.gradient_check import gradient
from sparsedp.check.jit_check import jit
from sparsedp.check.operators import operator, transpose, twin
from sparsedp.check.refinement import order

__all__ = ["gradient", "hessian", "jacobian", "jit", "jvp", "operator", "order", "transpose", "twin", "vjp"]

describe_module(__name__, "dp.check.gradient(loss, x)")
