"""The periodic flow of Mosaic as a Tesseract: `flow_step` behind the interface of its solvers navier-stokes-grid.

It needs tesseract-core with its runtime (``pip install "tesseract-core[runtime]"``). To call it without a container::

    from tesseract_core import Tesseract

    flow = Tesseract.from_tesseract_api("benchmarks/mosaic/tesseract_api.py")
    flow.apply({"v0": v0, "viscosity": [0.01], "dt": [0.01], "steps": 50, "domain_extent": 6.2831853})["result"]
"""

import numpy as np
from pydantic import BaseModel, Field, field_validator
from tesseract_core.runtime import Array, Differentiable, Float32

import sparsedp as dp
from benchmarks.mosaic.flows import StaggeredFlow

__all__ = ["InputSchema", "OutputSchema", "abstract_eval", "apply", "vector_jacobian_product"]

Velocity = Array[(None, None, None, None), Float32]


class InputSchema(BaseModel):
    """A velocity on n x n (x n) nodes, and the settings of the steps."""

    v0: Differentiable[Velocity] = Field(description="shape (n, n, 1, 2) or (n, n, n, 3)")
    viscosity: Array[(None,), Float32] = Field(description="one number >= 0")
    dt: Array[(None,), Float32] = Field(description="one number > 0")
    steps: int = Field(ge=1)
    domain_extent: float = Field(default=2.0 * np.pi, gt=0.0, description="side of the periodic square or cube")

    @field_validator("v0")
    @classmethod
    def on_a_square_or_a_cube(cls, v0):
        """Refuse other shapes."""
        n = v0.shape[0]
        if v0.shape not in ((n, n, 1, 2), (n, n, n, 3)):
            raise ValueError(f"v0 must have the shape (n, n, 1, 2) or (n, n, n, 3), got {v0.shape}")
        return v0


class OutputSchema(BaseModel):
    """The velocity after the steps."""

    result: Differentiable[Velocity]


def _flow(inputs):
    """Return the function from the first velocity to the last one."""
    n, _, _, dim = inputs.v0.shape
    nu = float(inputs.viscosity[0])
    dt = float(inputs.dt[0])
    run = StaggeredFlow(n, dim, nu, dt, inputs.steps, side=inputs.domain_extent)

    def flow(v0):
        return run(v0.reshape((n,) * dim + (dim,))).reshape(v0.shape)

    return flow


def apply(inputs: InputSchema) -> OutputSchema:
    """Return the velocity after the steps."""
    result = _flow(inputs)(np.asarray(inputs.v0, dtype=float))
    return OutputSchema(result=result.astype(np.float32))


def vector_jacobian_product(inputs: InputSchema, vjp_inputs, vjp_outputs, cotangent_vector):
    """Return the cotangent of the first velocity."""
    if not vjp_inputs or not vjp_outputs:
        return {}
    _, pull = dp.vjp(_flow(inputs), np.asarray(inputs.v0, dtype=float))
    return {"v0": pull(np.asarray(cotangent_vector["result"], dtype=float)).astype(np.float32)}


def abstract_eval(abstract_inputs):
    """Return the shape and the dtype of the result."""
    shape = abstract_inputs.v0.shape
    return {"result": {"shape": shape, "dtype": "float32"}}
