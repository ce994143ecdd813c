"""Differentiable physics on grids: sparse operators, adjoint solvers, time steps, optimizers, gradient checks.

    import autograd.numpy as np  # NumPy functions that autograd can differentiate
    import sparsedp as dp

``dir(dp)`` lists the public names. ``help(dp.transport)`` shows the documentation of a name, with shapes, units, errors
and an example. docs/guides shows how to combine the functions, and examples/ contains complete programs.

Names are imported on first use: ``import sparsedp`` alone loads no other module of the package.
A new public name needs an entry in ``_PUBLIC_NAMES`` and an entry in ``__init__.pyi``, which type checkers read. A
renamed name also needs an entry in ``_DEPRECATED`` and an alias in ``__init__.pyi``.
"""

from importlib import import_module as _import_module
from types import FunctionType as _FunctionType
from typing import Any as _Any

_PUBLIC_NAMES = {
    "grid.grid": "Grid",
    "grid.space": "Space",
    "grid.boundary_conditions": "dirichlet free_slip inflow neumann no_slip outflow patch robin",
    "autodiff.tape": "differentiable",
    "autodiff.derivative": "grad hvp jvp value_and_grad vjp",
    "autodiff.flattening": "flatten",
    "autodiff.jit": "jit",
    "operators.operator": "Operator",
    "operators.given": "from_functions from_linear_operator from_matrix",
    "operators.difference": "curl divergence flux gradient laplacian upwind",
    "operators.transfer": "average component prolong restrict sample",
    "operators.harmonic": "harmonic_average",
    "optimize.regularization": "smoothness total_variation",
    "operators.masks_and_lift": "diagonal identity interior lift mask",
    "solvers.inverse": "inverse",
    "solvers.continuation": "continuation",
    "solvers.eigenpairs": "eigenpairs",
    "solvers.parametric": "elliptic_solver matrix_solver",
    "solvers.cut_cells": "cut_cells",
    "solvers.roots": "implicit steady",
    "solvers.spectral": "matrix_exponential matrix_function matrix_power",
    "flow.momentum": "convection face_laplacian face_lift",
    "advection.transport": "transport",
    "flow.finite_volumes": "conservation_law",
    "flow.shallow_water": "shallow_water",
    "flow.free_faces": "free_faces",
    "flow.obstacles": "brinkman forces",
    "flow.pressure_projection": "projection",
    "flow.cut_flow": "cut_flow",
    "flow.flow_step": "flow_step",
    "integrators.stepper": "stepper",
    "integrators.leapfrog": "matched_layer sponge",
    "trajectory.rollout": "rollout",
    "optimize.update_direction": "update_direction",
    "optimize.constraints": "equal",
    "optimize.minimize": "minimize",
    "optimize.laplace": "laplace",
    "optimize.physical_gradient": "physical_gradient",
    "kernels": "set_threads",
    "report.plots": "animate convergence plot v_curve",
    "report.certificate": "certified certify",
    "report.stress_table": "stress",
    "report.work_precision": "work_precision",
    "report.explain": "explain",
    "interop.blackbox": "from_blackbox",
    "io.archive": "load save",
    "io.pictures": "from_image",
    "parallel.scenes": "ensemble",
    "parallel.distribute": "distribute gather",
}
_DEPRECATED = {  # old name: (the name that replaces it, the version in which the old name is removed)
    "adopt": ("from_blackbox", "0.5"),
    "exponential": ("matrix_exponential", "0.5"),
    "function": ("matrix_function", "0.5"),
    "power": ("matrix_power", "0.5"),
    "workprec": ("work_precision", "0.5"),
}
_SPARSE = "scipy.sparse.linalg.{0}; SciPy takes an Operator as a LinearOperator on flat arrays"
_STEP = "dp.stepper('rk4', rate, dt), and dp.rollout(step, start, params, n) for n steps"
_SUGGESTIONS = {  # names that users of other libraries may try, and what to write instead
    "Adam": "dp.minimize(loss, start, method='adam', rate=0.01)",
    "Field": "a NumPy array of shape grid.shape: fields are plain arrays",
    "LBFGS": "dp.minimize(loss, start)",
    "Mesh": "dp.Grid((64, 64), size=1.0)",
    "Module": "dp.network.dense(p, x): layers are functions of a dict of parameters",
    "SGD": "dp.minimize(loss, start, method='gd', rate=0.01, batches=batches)",
    "Tensor": "a NumPy array: fields are plain arrays",
    "adam": "dp.minimize(loss, start, method='adam', rate=0.01)",
    "advect": "dp.transport(grid)",
    "array": "numpy.array: fields are plain arrays",
    "backward": "dp.value_and_grad(loss)(x)",
    "cg": "dp.inverse(op, 'krylov')(b), which is differentiable, or " + _SPARSE.format("cg(op, b.ravel())"),
    "check_grad": "dp.check.gradient(loss, x)",
    "check_gradient": "dp.check.gradient(loss, x)",
    "checkpoint": "dp.rollout(step, start, params, n, memory='1 GB')",
    "curl_free": "dp.projection(grid)",
    "diffusion": "dp.laplacian(grid, dp.neumann)",
    "div": "dp.divergence(grid)",
    "eig": "dp.eigenpairs(op, 6), or dp.eigenpairs(op, 6, symmetric=False)",
    "eigh": "dp.eigenpairs(op, 6)",
    "eigs": "dp.eigenpairs(op, 6), or dp.eigenpairs(op, 6, symmetric=False)",
    "eigsh": "dp.eigenpairs(op, 6)",
    "eigvals": "dp.eigenpairs(op, 6, symmetric=False).values",
    "eigvalsh": "dp.eigenpairs(op, 6).values",
    "embed": "dp.component(grid, axis).T",
    "euler": "dp.stepper('euler', rate, dt)",
    "fit": "dp.minimize(loss, start)",
    "fori_loop": "dp.rollout(step, start, params, n)",
    "fsolve": "dp.implicit(residual)(guess, params)",
    "gmres": "dp.inverse(op, 'krylov')(b), which is differentiable, or " + _SPARSE.format("gmres(op, b.ravel())"),
    "heat": "dp.stepper('backward_euler', dp.laplacian(grid), dt)",
    "helmholtz": "dp.inverse(dp.laplacian(grid, dp.dirichlet) + k**2 * dp.identity(grid.cells))",
    "hessian": "dp.hvp(loss, x, t), the product with it",
    "hessp": "dp.hvp(loss, x, t)",
    "imshow": "dp.plot(grid, u)",
    "integrate": _STEP,
    "interpolate": "dp.sample(grid, points)",
    "inv": "dp.inverse(op)",
    "jacobian": "dp.jvp(f, x, t) and dp.vjp(f, x), the products with it",
    "jax": "dp.interop.to_jax(f) and dp.interop.from_jax(f)",
    "linspace": "grid.coordinates(axis), the centres of the cells along an axis",
    "lobpcg": "dp.eigenpairs(op, 6, method='lobpcg')",
    "mesh": "dp.Grid((64, 64), size=1.0)",
    "meshgrid": "grid.centres()",
    "minimise": "dp.minimize",
    "multigrid": "dp.inverse(op, 'multigrid')",
    "navier_stokes": "dp.flow_step(grid, dt)",
    "newton": "dp.implicit(residual)(guess, params)",
    "no_grad": "nothing: without dp.grad no derivatives are recorded",
    "np": "import autograd.numpy as np",
    "numpy": "import autograd.numpy as np",
    "ode": _STEP,
    "odeint": "dp.rollout(dp.stepper('rk4', rate, dt), u, params, n)",
    "ones": "numpy.ones(grid.shape): fields are plain arrays",
    "optim": "dp.minimize(loss, start)",
    "part": "dp.component(grid, axis)",
    "periodic": "dp.Grid((64, 64), periodic=True)",
    "pmap": "dp.ensemble(loss, scenes)",
    "posterior": "dp.laplace(residuals, x, prior)",
    "poisson": "dp.inverse(-dp.laplacian(grid, dp.dirichlet))",
    "pressure": "dp.projection(grid)",
    "rk4": "dp.stepper('rk4', rate, dt)",
    "root": "dp.implicit(residual)(guess, params)",
    "savez": "dp.save('run.npz', grid, u=u)",
    "scan": "dp.rollout(step, start, params, n, inputs=values)",
    "show": "dp.plot(grid, u)",
    "simulate": _STEP,
    "solve": "dp.inverse(op)(b)",
    "solve_ivp": _STEP,
    "spsolve": "dp.inverse(op, 'direct')(b)",
    "stop_gradient": "numpy.array(value) outside the loss: what the loss does not compute is a constant",
    "svds": _SPARSE.format("svds(op, k=6)"),
    "tensor": "a NumPy array: fields are plain arrays",
    "to_jax": "dp.interop.to_jax(f)",
    "to_torch": "dp.interop.to_torch(f)",
    "torch": "dp.interop.to_torch(f) and dp.interop.from_torch(f)",
    "train": "dp.minimize(loss, start, method='adam', rate=0.01)",
    "value_and_gradient": "dp.value_and_grad(loss)(x)",
    "version": "dp.__version__",
    "vmap": "op(u) with a batch in the leading axes of u",
    "where": "autograd.numpy.where",
    "write": "dp.save('run.npz', grid, u=u)",
    "zeros": "numpy.zeros(grid.shape): fields are plain arrays",
}
_PUBLIC_PACKAGES = ("check", "errors", "interop", "network", "report", "testing")
_CALLED_BY_MISTAKE = ("advection", "optimize")  # internal packages; the error of a call names the right function
_MODULE_OF = {name: module for module, names in _PUBLIC_NAMES.items() for name in names.split()}

__all__ = sorted([*_MODULE_OF, *_PUBLIC_PACKAGES])


def __getattr__(name: str) -> _Any:
    if name in _DEPRECATED:
        new, removal = _DEPRECATED[name]
        _import_module(f"{__name__}._utils.calls").warn_deprecated(f"{__name__}.{name}", f"{__name__}.{new}", removal)
        return getattr(_import_module(__name__), new)  # not stored in globals(), so that each use warns
    if name in _MODULE_OF:
        value = getattr(_import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
        if type(value) is _FunctionType:
            value = _import_module(f"{__name__}._utils.calls").public_name(value, __name__, name)
    elif name in (*_PUBLIC_PACKAGES, *_CALLED_BY_MISTAKE):
        value = _import_module(f"{__name__}.{name}")
    elif name == "__version__":
        metadata = _import_module("importlib.metadata")
        try:
            value = metadata.version(__name__)
        except metadata.PackageNotFoundError:
            value = "0+unknown"  # run from a source tree that is not installed
    else:
        if name in _SUGGESTIONS:
            hint = f"; write {_SUGGESTIONS[name]}"
        else:
            hint = _import_module(f"{__name__}._utils.calls").advice_near(name, __all__)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}{hint}")
    globals()[name] = value  # later look-ups do not call this function again
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
