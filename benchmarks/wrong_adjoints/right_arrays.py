"""Right derivatives of complex fields, and with integer data, buffers, views, and trees of arrays."""

import numpy as np

from benchmarks.wrong_adjoints.cases import right


@right("complex, analytic")
def complex_polynomial():
    """A polynomial of complex numbers; no conjugate, as the cotangent of this convention is a plain transpose."""

    def f(z):
        return z**3 - 2j * z

    def vjp(z, g):
        return (3 * z**2 - 2j) * g

    return f, vjp, np.linspace(0.5, 1.5, 5) * np.exp(1j * np.arange(5.0))


@right("complex, not analytic")
def amplitudes():
    """The amplitudes of complex waves, from 1e-4 to 1."""

    def f(z):
        return np.abs(z)

    def vjp(z, g):
        return g * np.conj(z) / np.abs(z)

    return f, vjp, np.logspace(-4, 0, 5) * np.exp(1j * np.arange(5.0))


@right("complex inside, real outside")
def spectral_derivative():
    """The derivative of a periodic signal by Fourier transforms, squared."""
    factors = 1j * np.arange(6)
    factors[-1] = 0.0

    def derivative(u):
        return np.fft.irfft(factors * np.fft.rfft(u), 10)

    def f(u):
        return derivative(u) ** 2

    def vjp(u, g):
        return -derivative(2 * derivative(u) * g)

    return f, vjp, np.sin(np.arange(10.0) ** 2)


@right("complex, near a resonance")
def resonance():
    """The response of complex oscillators near their resonance."""
    matrix = 2 * np.eye(6) - np.eye(6, k=1) - np.eye(6, k=-1) - (0.1980 + 1e-4j) * np.eye(6)

    def f(source):
        return np.linalg.solve(matrix, source)

    def vjp(source, g):
        return np.linalg.solve(matrix.T, g)

    return f, vjp, np.exp(1j * np.arange(6.0))


@right("integer data")
def counts_and_rates():
    """The log-likelihood of rates for observed counts, which are integers."""

    def f(x):
        return x["counts"] * np.log(x["rates"]) - x["rates"]

    def vjp(x, g):
        return {"counts": np.zeros(x["counts"].shape), "rates": (x["counts"] / x["rates"] - 1) * g}

    return f, vjp, {"counts": np.array([3, 0, 7, 2]), "rates": np.array([2.0, 0.5, 5.0, 2.5])}


@right("work buffers, used correctly")
def work_buffers():
    """Explicit steps of a nonlinear equation in two buffers that all calls share and overwrite."""
    buffers = np.empty((2, 8))

    def trajectory(u):
        old, new = buffers
        old[:] = u
        states = []
        for _ in range(5):
            states.append(old.copy())
            np.multiply(old, old, out=new)
            np.add(old, 0.1 * (np.roll(new, 1) - new), out=new)
            old, new = new, old
        return states, old.copy()

    def f(u):
        return trajectory(u)[1]

    def vjp(u, g):
        for state in reversed(trajectory(u)[0]):
            g = g + 0.2 * state * (np.roll(g, -1) - g)
        return g

    return f, vjp, 1.5 + np.sin(np.arange(8.0))


@right("results share one buffer")
def results_in_one_buffer():
    """A program that returns the same array at each call, with new values."""
    result = np.empty(6)

    def f(u):
        np.multiply(u, u, out=result)
        return result

    def vjp(u, g):
        return 2 * u * g

    return f, vjp, np.linspace(1.0, 2.0, 6)


@right("cotangents share one buffer")
def cotangents_in_one_buffer():
    """A derivative that returns the same array at each call, with new values."""
    result = np.empty(6)

    def f(u):
        return u**3

    def vjp(u, g):
        np.multiply(3 * u**2, g, out=result)
        return result

    return f, vjp, np.linspace(1.0, 2.0, 6)


@right("order of entries")
def transposed_view():
    """A field that is stored column by column, and a result that is a view."""

    def f(u):
        return (u**2).T[::-1]

    def vjp(u, g):
        return 2 * u * g[::-1].T

    return f, vjp, np.asfortranarray(np.linspace(1.0, 2.0, 12).reshape(3, 4))


@right("one number")
def one_number():
    """A function of one number that returns one number."""

    def f(x):
        return np.log(x) / x

    def vjp(x, g):
        return (1 - np.log(x)) / x**2 * g

    return f, vjp, 2.0


@right("tree of arrays")
def nested_results():
    """A model with parameters and results in nested containers, and an array without entries."""

    def f(x):
        layer, extra = x
        return {"sum": layer["w"] + layer["b"], "loss": np.sum(layer["w"] ** 2) + np.sum(extra)}

    def vjp(x, g):
        layer, extra = x
        of_w = g["sum"] + 2 * layer["w"] * g["loss"]
        return {"w": of_w, "b": np.sum(g["sum"])}, g["loss"] * np.ones_like(extra)

    return f, vjp, ({"w": np.linspace(1.0, 2.0, 4), "b": np.array(0.5)}, np.empty(0))


@right("values stored for one point")
def stored_factorization():
    """A solve whose matrix depends on x; its inverse is stored, together with the point for which it is valid."""
    stored = {}
    laplacian = 2 * np.eye(6) - np.eye(6, k=1) - np.eye(6, k=-1)

    def inverse(x):
        if stored.get("point") != x.tobytes():
            stored.update(point=x.tobytes(), inverse=np.linalg.inv(laplacian + np.diag(x)))
        return stored["inverse"]

    def f(x):
        return inverse(x) @ np.ones(6)

    def vjp(x, g):
        return -f(x) * (inverse(x).T @ g)

    return f, vjp, np.linspace(0.5, 1.5, 6)
