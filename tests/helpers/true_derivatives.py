"""Derivatives of the programs of benchmarks.wrong_adjoints by other means than their VJPs, exact to rounding.

Most are computed by a complex step, or column by column for linear programs. The others have a formula here that is
analytic, or are differentiated by extrapolated differences in extended precision.
"""

import math

import numpy as np

from sparsedp._utils.pytree import leaves, mapped

__all__ = ["true_vjp"]

STEP = 1e-30

# Programs that are linear: column j of the Jacobian is f(e_j) - f(0).
LINEAR = {"helmholtz equation", "resonance"}

# Programs of complex numbers, whose f computes in the precision of its argument.
EXTENDED = {"intensity of light", "nonlinear schroedinger equation", "complex polynomial", "amplitudes"}


def absolute(z):
    """Return the absolute value, continued to complex numbers."""
    return np.where(z.real < 0, -z, z)


def real_matrix(multiplier, n):
    """Return the matrix of a filter in Fourier space."""
    return np.stack([np.fft.irfft(multiplier * np.fft.rfft(column), n) for column in np.eye(n)], axis=1)


def spectral_derivative(u):
    factors = 1j * np.arange(6)
    factors[-1] = 0.0
    return (real_matrix(factors, 10) @ u) ** 2


def cancelling(u):
    """The series of (1 - cos u) / u^2."""
    return sum((-1) ** (k + 1) * u ** (2 * k - 2) / math.factorial(2 * k) for k in range(1, 8))


def solved_chain(force):
    matrix = 2 * np.eye(30) - np.eye(30, k=1) - np.eye(30, k=-1) + np.diag(np.linspace(0.0, 0.5, 30))
    return np.linalg.solve(matrix, force**2)


def newton(residual, slope, start):
    u = start
    for _ in range(60):
        u = u - residual(u) / slope(u)
    return u


def kepler(anomaly):
    return newton(lambda e: e - 0.6 * np.sin(e) - anomaly, lambda e: 1 - 0.6 * np.cos(e), anomaly + 0.5)


def contraction(b):
    return newton(lambda u: u - 0.7 * np.cos(u) - b, lambda u: 1 + 0.7 * np.sin(u), b + 0.3)


def gas(pressure):
    return newton(lambda u: u + u**3 - pressure, lambda u: 1 + 3 * u**2, 1.0 + 0 * pressure)


def diffusion(u):
    """In double precision; the VJP under test is in single precision."""
    for _ in range(10):
        square = u**2
        u = u + np.float32(0.1) * (np.roll(square, 1) - 2 * square + np.roll(square, -1))
    return u


def table(x):
    values = np.sin(np.arange(11.0))
    cell = np.clip(np.floor(x.real).astype(int), 0, 9)
    return values[cell] + (x - cell) * (values[cell + 1] - values[cell])


ANALYTIC = {
    "spectral derivative": spectral_derivative,
    "nearly cancelling terms": cancelling,
    "conjugate gradients": solved_chain,
    "keplers equation": kepler,
    "contraction": contraction,
    "gas law by bisection": gas,
    "diffusion in single precision": diffusion,
    "table of properties": table,
    "noisy simulator": lambda u: u**2,
    "single precision inside": np.exp,
    "printed digits": np.sin,
    "constant result": lambda u: 0 * u[:3],
    "absolute values": lambda u: absolute(u - np.linspace(1.0, 2.0, 6)),
    "absolute values at zero": lambda u: (
        np.where(u.real == np.linspace(1.0, 2.0, 5), 0.0, absolute(u - np.linspace(1.0, 2.0, 5))) + u
    ),
    "friction": lambda u: np.where(u.real == 0, 0.0, absolute(u)) + u**2,
    "angles": lambda u: u + np.sin(u),
    "upwind near stagnation": lambda u: np.where(u.real > 0, u * u, u * np.roll(u, -1)),
    "results in one buffer": lambda u: u**2,
    "stored factorization": lambda x: np.linalg.solve(
        2 * np.eye(6) - np.eye(6, k=1) - np.eye(6, k=-1) + np.diag(x), np.ones(6)
    ),
}


def limited_slopes(u):
    d = np.diff(u)
    smaller = np.where(np.abs(d.real[:-1]) < np.abs(d.real[1:]), d[:-1], d[1:])
    return np.where(d.real[:-1] * d.real[1:] > 0, smaller, 0.0)


def explicit_steps(u):
    for _ in range(5):
        u = u + 0.1 * (np.roll(u**2, 1) - u**2)
    return u


def limited_fluxes(u):
    slopes = limited_slopes(u)
    return slopes + slopes**2 / 2


def filtered_energy(u):
    frequencies = np.fft.rfftfreq(10)
    multiplier = np.exp(-5j * frequencies) / (1 + frequencies)
    multiplier[-1] = multiplier[-1].real
    return (real_matrix(multiplier, 10) @ u) ** 2 / 2


ANALYTIC["spectral filter"] = filtered_energy
ANALYTIC["limited slopes"] = limited_fluxes
ANALYTIC["minmod near its switch"] = limited_slopes
ANALYTIC["work buffers"] = explicit_steps


def moved(x, leaf_number, entry, step, dtype):
    """Return x with all floating leaves in another dtype, and one entry moved."""
    number = iter(range(len(leaves(x))))

    def of_leaf(leaf):
        n = next(number)
        array = np.array(leaf, order="C")
        if array.dtype.kind in "fc":
            array = array.astype(dtype)
        if n == leaf_number:
            array.reshape(-1)[entry] += step
        return array

    return mapped(of_leaf, x)


def derivative(name, f, x, leaf_number, entry, unit):
    """Return the leaves of the derivative of f in the direction of an entry of x; unit: 1, or 1j for complex x."""

    def at(step, dtype):
        return [np.array(leaf) for leaf in leaves(f(moved(x, leaf_number, entry, step, dtype)))]

    if name in LINEAR:
        zero = mapped(lambda leaf: 0 * np.asarray(leaf), x)
        ahead = leaves(f(moved(zero, leaf_number, entry, unit, np.result_type(float, *leaves(x)))))
        return [np.array(leaf) for leaf in ahead]
    if name in EXTENDED:
        size = abs(np.asarray(leaves(x)[leaf_number]).reshape(-1)[entry])
        rows = []
        for level in range(5):
            h = np.longdouble(size) * np.longdouble(2.0) ** -(level + 7)
            both = zip(at(unit * h, np.clongdouble), at(-unit * h, np.clongdouble))
            row = [[(ahead - behind) / (2 * h) for ahead, behind in both]]
            for k in range(1, level + 1):
                factor = np.longdouble(4.0) ** k
                row.append([(factor * fine - coarse) / (factor - 1) for fine, coarse in zip(row[-1], rows[-1][k - 1])])
            rows.append(row)
        return rows[-1][-1]
    return [leaf.imag / STEP for leaf in at(1j * STEP, complex)]


def true_vjp(name, f, x, g):
    """Return the leaves of the product of g with the Jacobian of a program at x."""
    f = ANALYTIC.get(name, f)
    products = []
    for number, leaf in enumerate(leaves(x)):
        values = np.asarray(leaf)
        product = np.zeros(values.shape, dtype=complex if values.dtype.kind == "c" else float)
        if values.dtype.kind in "fc":
            for entry in range(values.size):
                for unit in (1, 1j) if values.dtype.kind == "c" else (1,):
                    change = derivative(name, f, x, number, entry, unit)
                    slope = sum(np.sum(w * c) for w, c in zip(leaves(g), change)).real
                    product.reshape(-1)[entry] += np.conj(unit) * slope if unit == 1j else slope
        products.append(product)
    return products
