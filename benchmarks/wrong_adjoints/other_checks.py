"""The programs of the collection in the checks of torch and JAX, and in a Taylor test with one step."""

import warnings

import numpy as np

from sparsedp._utils.pytree import TreeStructure

__all__ = ["check_grads", "gradcheck", "taylor"]

STEP = 1e-6  # of the Taylor test
TOLERANCE = 1e-4


def is_differentiable(leaf):
    """Return whether a leaf of x has a derivative."""
    return np.asarray(leaf).dtype.kind in "fc"


def flat_functions(program):
    """Return f and vjp as functions of lists of arrays, and the arrays of x. Integers are constants."""
    structure = TreeStructure(program.x, "x", is_differentiable)
    results = TreeStructure(program.f(program.x), "f(x)")

    def f(arrays):
        return [np.array(leaf) for leaf in results.variables(program.f(structure.build(arrays)))]

    def vjp(arrays, cotangents):
        slopes = program.vjp(structure.build(arrays), results.build(cotangents))
        return [np.array(leaf) for leaf in structure.variables(slopes)]

    return f, vjp, [np.array(leaf) for leaf in structure.variables(program.x)]


def gradcheck(program):
    """Return the verdict of torch.autograd.gradcheck with its default options."""
    import torch

    f, vjp, start = flat_functions(program)

    class Wrapped(torch.autograd.Function):
        """The program as a function of torch. Cotangents of torch are conjugates of cotangents of the collection."""

        @staticmethod
        def forward(ctx, *tensors):
            ctx.save_for_backward(*tensors)
            return tuple(torch.from_numpy(value) for value in f([tensor.numpy() for tensor in tensors]))

        @staticmethod
        def backward(ctx, *cotangents):
            arrays = [tensor.numpy() for tensor in ctx.saved_tensors]
            slopes = vjp(arrays, [np.array(np.conj(g.resolve_conj().numpy())) for g in cotangents])
            return tuple(torch.from_numpy(np.array(np.conj(slope))) for slope in slopes)

    inputs = [torch.from_numpy(array).requires_grad_() for array in start]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # one for each input in single precision
        passes = torch.autograd.gradcheck(Wrapped.apply, inputs, raise_exception=False)
    return "agrees" if passes else "disagrees"


def check_grads(program):
    """Return the verdict of jax.test_util.check_grads in reverse mode, with its default options."""
    import jax
    from jax.test_util import check_grads as check

    jax.config.update("jax_enable_x64", True)
    f, vjp, start = flat_functions(program)

    def shapes(arrays):
        return [jax.ShapeDtypeStruct(array.shape, array.dtype) for array in arrays]

    def on_host(function, like, *arguments):
        return jax.pure_callback(function, shapes(like), *arguments)

    results = f(start)

    def host_f(arrays):
        return f([np.array(array) for array in arrays])

    def host_vjp(arrays, cotangents):
        slopes = vjp([np.array(array) for array in arrays], [np.array(g) for g in cotangents])
        return [np.asarray(slope, dtype=array.dtype) for slope, array in zip(slopes, arrays)]

    @jax.custom_vjp
    def wrapped(arrays):
        return on_host(host_f, results, arrays)

    def forward(arrays):
        return wrapped(arrays), arrays

    def backward(arrays, cotangents):
        return (on_host(host_vjp, arrays, arrays, cotangents),)

    wrapped.defvjp(forward, backward)
    try:
        check(wrapped, ([jax.numpy.asarray(array) for array in start],), order=1, modes=["rev"])
    except AssertionError:
        return "disagrees"
    return "agrees"


def taylor(program):
    """Return the verdict of one central difference along one random direction."""
    f, vjp, start = flat_functions(program)
    rng = np.random.default_rng(0)

    def random(arrays):
        vectors = []
        for array in arrays:
            vector = rng.standard_normal(array.shape)
            if np.iscomplexobj(array):
                vector = vector + 1j * rng.standard_normal(array.shape)
            vectors.append(vector)
        return vectors

    def product(left, right):
        return sum(np.sum(a * b).real for a, b in zip(left, right))

    direction = random(start)
    weights = random(f(start))
    slope = product(vjp(start, weights), direction)

    def functional(step):
        return product(weights, f([(x + step * d).astype(x.dtype) for x, d in zip(start, direction)]))

    difference = (functional(STEP) - functional(-STEP)) / (2 * STEP)
    return "agrees" if abs(difference - slope) <= TOLERANCE * abs(difference) else "disagrees"
