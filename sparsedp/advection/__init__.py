"""Transport of a field by a velocity: one differentiable rule for each scheme."""

from sparsedp._utils.calls import describe_module

__all__: list[str] = []

describe_module(__name__, "dp.transport(grid)")
