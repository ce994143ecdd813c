"""Assertions about derivatives and transposes for test suites, and strategies of hypothesis for grids and fields.

`assert_gradient` and `assert_transpose` are in assertions.py, `grids` and `fields` in strategies.py; these two need
hypothesis. plugin.py is the plugin of pytest: fixtures of the same names, and the options ``--gradients`` and
``--gradients-annotations``.

The functions work in projects that use no other part of sparsedp. Each is imported when it is first used, because
pytest imports the plugin, and with it this file, in every project of an environment in which sparsedp is installed.

Unlike other public modules, this one is not callable: pytest would take ``from sparsedp import testing`` for a test.
"""

from importlib import import_module

from sparsedp._utils.calls import advice_near, public_name

__all__ = ["assert_gradient", "assert_transpose", "fields", "grids"]

_MODULE_OF = {
    "assert_gradient": "assertions",
    "assert_transpose": "assertions",
    "fields": "strategies",
    "grids": "strategies",
}


def __getattr__(name):
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}{advice_near(name, __all__)}")
    function = getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    globals()[name] = public_name(function, __name__, name)
    return globals()[name]
