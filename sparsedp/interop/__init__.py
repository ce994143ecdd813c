"""Bridges to PyTorch, JAX, xarray and pint. Functions can be differentiated to every order across a bridge.

to_torch, from_torch     torch_bridge.py, the extra `torch`
to_jax, from_jax         jax_bridge.py, the extra `jax`
to_xarray, from_xarray   fields with coordinates: ../io/labelled.py, the extra `files`
with_units               scenes of quantities with units: units.py, the extra `units`

PyTorch, JAX, xarray or pint is imported when one of its functions is first used.
"""

from importlib import import_module

from sparsedp._utils.calls import describe_module, public_name

__all__ = ["from_jax", "from_torch", "from_xarray", "to_jax", "to_torch", "to_xarray", "with_units"]

EXTRAS = {  # for each library: the extra that installs it, and the module with its functions
    "torch": ("torch", "sparsedp.interop.torch_bridge"),
    "jax": ("jax", "sparsedp.interop.jax_bridge"),
    "xarray": ("files", "sparsedp.io.labelled"),
    "pint": ("units", "sparsedp.interop.units"),
}


def __getattr__(name):
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}")
    library = "pint" if name == "with_units" else name.partition("_")[2]
    extra, module = EXTRAS[library]
    try:
        function = getattr(import_module(module), name)
    except ImportError as error:
        raise ImportError(f"dp.interop.{name} needs {library}; install sparsedp[{extra}]") from error
    globals()[name] = public_name(function, __name__, name)
    return globals()[name]


describe_module(__name__, "dp.interop.to_torch(f)")
