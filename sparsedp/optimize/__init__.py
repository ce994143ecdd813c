"""Optimization over any nesting of arrays: minimize() and its methods."""

from sparsedp._utils.calls import describe_module

__all__: list[str] = []

describe_module(__name__, "dp.minimize(loss, start)")
