"""Wrong derivatives of complex fields and Fourier transforms: conjugates, half spectra.

The cotangent g of a complex y follows the convention of JAX and autograd: a real loss changes by Re(sum(g * dy)).
"""

import numpy as np

from benchmarks.wrong_adjoints.cases import chained, wrong


@wrong("missing conjugate", culprit="delay")
def spectral_filter():
    """The energy of a periodic signal that is delayed and damped in Fourier space."""
    frequencies = np.fft.rfftfreq(10)
    multiplier = np.exp(-5j * frequencies) / (1 + frequencies)
    multiplier[-1] = multiplier[-1].real

    def delay(u):
        return np.fft.irfft(multiplier * np.fft.rfft(u), 10)

    def delay_vjp(u, g):
        return np.fft.irfft(multiplier * np.fft.rfft(g), 10)  # fault: np.conj(multiplier)

    def energy(u):
        return u**2 / 2

    def energy_vjp(u, g):
        return u * g

    return chained(np.sin(np.arange(10.0) ** 2), (delay, delay_vjp), (energy, energy_vjp))


@wrong("conjugate too many", culprit="waves")
def helmholtz_equation():
    """The sound field of complex sources in a duct with absorption, at two microphones."""
    n = 12
    matrix = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1) - (0.5 + 0.2j) * np.eye(n)

    def waves(source):
        return np.linalg.solve(matrix, source)

    def waves_vjp(source, g):
        return np.linalg.solve(matrix.conj().T, g)  # fault: matrix.T

    def microphones(field):
        return field[[3, 8]]

    def microphones_vjp(field, g):
        out = np.zeros_like(field)
        out[[3, 8]] = g
        return out

    return chained(np.exp(1j * np.arange(12.0)), (waves, waves_vjp), (microphones, microphones_vjp))


@wrong("missing conjugate", diagnosis="convention")
def intensity_of_light():
    """The intensity of a complex wave."""

    def f(z):
        return z.real**2 + z.imag**2

    def vjp(z, g):
        return 2 * g * z  # fault: np.conj(z)

    return f, vjp, np.linspace(1.0, 2.0, 6) * np.exp(0.7j * np.arange(1, 7))


@wrong("dropped term")
def nonlinear_schroedinger_equation():
    """One explicit step of a wave whose phase velocity depends on its intensity."""
    dt = 0.1

    def f(z):
        return z + 1j * dt * (z * np.conj(z)) * z

    def vjp(z, g):
        holomorphic = g * (1 + 2j * dt * z * np.conj(z))
        return holomorphic  # fault: + np.conj(g * 1j * dt * z**2), by the factor conj(z)

    return f, vjp, np.linspace(0.5, 1.5, 5) * np.exp(1j * np.arange(5.0))
