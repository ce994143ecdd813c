"""Checks of operators and gradients, beside the core.

Nothing else in the package imports it. Every check returns a value with `.verdict` (agrees, disagrees,
inconclusive), is true only when it agrees, and prints its table.
"""

from sparsedp._utils.calls import describe_module
from sparsedp.check.gradient_check import gradient
from sparsedp.check.operators import operator, transpose, twin
from sparsedp.check.refinement import order

__all__ = ["gradient", "operator", "order", "transpose", "twin"]

describe_module(__name__, "dp.check.gradient(loss, x)")
