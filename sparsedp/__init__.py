"""Physics that can be differentiated, on grids: operators, solvers, time steps, optimizers, checks of gradients.

    import autograd.numpy as np  # NumPy that the library can look through
    import sparsedp as dp

``dir(dp)`` lists the public names, ``help(dp.transport)`` explains one: shapes, units, errors, an example. README.md
shows how they work together, examples/ what they are for.

Every name is imported when it is first used: ``import sparsedp`` loads nothing else.
A new public name is one word in ``_WINDOW`` and one in ``__init__.pyi``, the copy that type checkers read.
"""

from importlib import import_module as _import_module

_WINDOW = {
    "grid": "Grid",
    "space": "Space",
    "boundary_conditions": "dirichlet free_slip inflow neumann no_slip outflow robin",
    "tape": "differentiable",
    "derivative": "grad hvp jvp value_and_grad vjp",
    "packing": "flatten",
    "operator": "Operator",
    "operators.given": "from_functions from_linear_operator from_matrix",
    "operators.difference": "curl divergence flux gradient laplacian upwind",
    "operators.transfer": "average component prolong restrict sample",
    "operators.harmonic": "harmonic_average",
    "optimize.regularization": "smoothness total_variation",
    "operators.masks_and_lift": "diagonal identity interior lift mask",
    "solvers.choose_method": "inverse",
    "solvers.parametric": "elliptic_solver matrix_solver",
    "solvers.roots": "implicit steady",
    "solvers.spectral": "exponential function power",
    "flow.momentum": "convection face_laplacian face_lift",
    "advection.front": "transport",
    "flow.finite_volumes": "conservation_law",
    "flow.obstacles": "brinkman forces",
    "flow.pressure_projection": "projection",
    "flow.stepping": "flow_step",
    "integrators.front": "stepper",
    "integrators.leapfrog": "sponge",
    "trajectory.front": "rollout",
    "optimize.directions": "update_direction",
    "optimize.loop": "minimize",
    "optimize.physical": "physical_gradient",
    "kernels": "set_threads",
    "report.plots": "animate convergence plot v_curve",
    "report.certificate": "certified certify",
    "report.stress_table": "stress",
    "report.work_precision": "workprec",
    "report.plan": "explain",
    "blackbox": "adopt",
    "storage.archive": "load save",
    "storage.pictures": "from_image",
    "parallel.scenes": "ensemble",
    "parallel.front": "distribute gather",
}
_MEANT = {  # what people write, coming from the first edition or from elsewhere -> what to write here
    "minimise": "dp.minimize",
    "part": "dp.component(grid, axis)",
    "embed": "dp.component(grid, axis).T",
    "solve": "dp.inverse(op)(b)",
    "poisson": "dp.inverse(-dp.laplacian(grid, dp.dirichlet))",
    "advect": "dp.transport(grid)",
    "odeint": "dp.rollout(dp.stepper('rk4', rate, dt), u, params, n)",
    "jacobian": "dp.jvp(f, x, t) and dp.vjp(f, x), the products with it",
    "hessian": "dp.hvp(loss, x, t), the product with it",
    "tensor": "a NumPy array: fields are plain arrays",
    "vmap": "op(u) with a batch in the leading axes of u",
}
_ROOMS = ("check", "errors", "interop", "network", "report")
_HOME = {name: module for module, names in _WINDOW.items() for name in names.split()}

__all__ = sorted([*_HOME, *_ROOMS])


def __getattr__(name):
    if name in _HOME:
        value = getattr(_import_module(f"{__name__}.{_HOME[name]}"), name)
    elif name in _ROOMS:
        value = _import_module(f"{__name__}.{name}")
    elif name == "__version__":
        metadata = _import_module("importlib.metadata")
        try:
            value = metadata.version(__name__)
        except metadata.PackageNotFoundError:
            value = "0+unknown"  # run from a tree that was never installed
    else:
        near = _import_module(f"{__name__}.fields").advice_near
        hint = f"; write {_MEANT[name]}" if name in _MEANT else near(name, __all__)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}{hint}")
    globals()[name] = value  # the next look-up does not come here
    return value


def __dir__():
    return [*__all__, "__version__"]
