"""Optimization of losses whose argument is an array or a nested structure (pytree) of arrays."""

from sparsedp._utils.calls import describe_module

__all__: list[str] = []

describe_module(__name__, "dp.minimize(loss, start)")
