"""Periodic flow of Mosaic: velocities on nodes of a square or a cube of side 2 pi, before and after a number of steps.

Two discretisations: `flow_step`, whose central differences on a staggered grid are of order 2, and a spectral step
written here with FFTs, as the stored reference was computed. Both run in `rollout`.
"""

import autograd.numpy as np

import sparsedp as dp

__all__ = ["SpectralFlow", "StaggeredFlow", "relative_error", "several_modes", "taylor_green"]

SIDE = 2.0 * np.pi
SPEED = 0.3  # the largest one of `several_modes`


def taylor_green(n, dim):
    """Return the vortices of Taylor and Green on n nodes along each axis, shape (n, ..., n, dim)."""
    axes = np.meshgrid(*[SIDE / n * np.arange(n)] * dim, indexing="ij")
    x, y = axes[:2]
    along_z = np.cos(axes[2]) if dim == 3 else 1.0
    parts = [np.sin(x) * np.cos(y) * along_z, -np.cos(x) * np.sin(y) * along_z]
    return np.stack([*parts, *[np.zeros(x.shape)] * (dim - 2)], axis=-1)


def several_modes(n, seed=42):
    """Return a random flow in 2-D with wave numbers around 2; its phases are drawn by jax.random."""
    import jax

    wave = n * np.fft.fftfreq(n)
    along, across = np.meshgrid(wave, wave, indexing="ij")
    amplitude = np.exp(-0.5 * ((np.hypot(along, across) - 2.0) / 0.5) ** 2)
    phases = jax.random.uniform(jax.random.PRNGKey(seed), (n, n), minval=0.0, maxval=2.0 * np.pi)
    stream = amplitude * np.exp(1j * np.asarray(phases, dtype=float))
    stream = 0.5 * (stream + np.conj(stream[::-1, ::-1]))
    stream[0, 0] = 0.0
    parts = [np.fft.ifft2(1j * across * stream).real, np.fft.ifft2(-1j * along * stream).real]
    v = np.stack(parts, axis=-1)
    return SPEED / np.max(np.linalg.norm(v, axis=-1)) * v


def relative_error(v, reference):
    """Return the root mean square of the difference divided by the root mean square of the reference."""
    return float(np.linalg.norm(v - reference) / np.linalg.norm(reference))


def _half_cell(n):
    """Return the matrix of the Fourier interpolation of n values at points half a cell further."""
    wave = n * np.fft.fftfreq(n)
    factor = np.exp(1j * np.pi * wave / n)
    if n % 2 == 0:
        factor[n // 2] = 0.0  # cos(pi / 2): the mode of alternating signs
    return np.fft.ifft(factor[:, None] * np.fft.fft(np.eye(n), axis=0), axis=0).real


def _along(matrix, values, axis):
    """Return the product of a matrix and the values along one axis."""
    return np.moveaxis(np.tensordot(matrix, values, (1, axis)), 0, axis)


class StaggeredFlow:
    """n steps of `flow_step`; velocities on nodes are moved to faces and back by Fourier interpolation.

    Parameters
    ----------
    n : int
        Cells along each axis.
    dim : int
    nu, dt : float
    steps : int
    side : float
        Of the square or the cube.
    """

    def __init__(self, n, dim, nu, dt, steps, side=SIDE):
        self.grid = dp.Grid((n,) * dim, size=side, periodic=True)
        self.dim, self.steps = dim, steps
        is_stiff = nu * dt * (n / side) ** 2 > 1 / (4 * dim)  # explicit viscosity would be unstable
        self.step = dp.flow_step(self.grid, dt, nu, implicit=is_stiff)
        self.forth = _half_cell(n)

    def to_faces(self, v):
        """Return the velocities on faces, whose centres are nodes moved along all axes but their own."""
        parts = [v[..., axis] for axis in range(self.dim)]
        return self.grid.join(*[self._moved(part, own, self.forth) for own, part in enumerate(parts)])

    def to_nodes(self, v):
        """Return the velocities on nodes."""
        parts = enumerate(self.grid.split(v))
        return np.stack([self._moved(part, own, self.forth.T) for own, part in parts], axis=-1)

    def _moved(self, part, own, matrix):
        for axis in range(self.dim):
            if axis != own:
                part = _along(matrix, part, axis)
        return part

    def __call__(self, v, **settings):
        """Return the velocity on nodes after the steps; settings go to `rollout`."""
        state = self.step.start(self.to_faces(v))
        return self.to_nodes(dp.rollout(self.step, state, None, self.steps, **settings)["v"])


class SpectralFlow:
    """n steps of order 4 (Runge-Kutta) with exact derivatives of trigonometric polynomials.

    Parameters
    ----------
    n : int
        Nodes along each axis.
    dim : int
    nu, dt : float
    steps : int
    """

    def __init__(self, n, dim, nu, dt, steps):
        self.dim, self.dt, self.steps = dim, dt, steps
        wave = n * np.fft.fftfreq(n)
        wave[n // 2] = 0.0  # the derivative of alternating signs
        self.waves = np.stack(np.meshgrid(*[wave] * dim, indexing="ij"), axis=-1)
        squares = np.sum(np.stack(np.meshgrid(*[(n * np.fft.fftfreq(n)) ** 2] * dim, indexing="ij")), axis=0)
        self.decay = np.exp(-0.5 * dt * nu * squares)[..., None]  # of each mode in half a step
        lengths = np.sum(self.waves**2, axis=-1)
        self.inverse_lengths = np.where(lengths == 0, 0.0, 1.0 / np.where(lengths == 0, 1.0, lengths))
        self.axes = tuple(range(dim))

    def _transform(self, values):
        return np.fft.fftn(values, axes=self.axes)

    def _back(self, values):
        return np.real(np.fft.ifftn(values, axes=self.axes))

    def project(self, spectrum):
        """Return a spectrum without divergence."""
        along = np.sum(self.waves * spectrum, axis=-1) * self.inverse_lengths
        return spectrum - self.waves * along[..., None]

    def advection(self, spectrum):
        """Return the spectrum of -(v . grad) v without its divergence."""
        v = self._back(spectrum)
        carried = 0.0
        for axis in range(self.dim):
            slope = self._back(1j * self.waves[..., axis : axis + 1] * spectrum)
            carried = carried + v[..., axis : axis + 1] * slope
        return self.project(self._transform(-carried))

    def step(self, v, params):
        """Return the velocity after one step: viscosity exact, advection by the scheme of Runge and Kutta."""
        dt = self.dt
        half = self.decay
        old = self._transform(v)
        first = self.advection(old)
        second = self.advection(half * (old + 0.5 * dt * first))
        third = self.advection(half * old + 0.5 * dt * second)
        fourth = self.advection(half**2 * old + dt * half * third)
        change = half**2 * first + 2.0 * half * (second + third) + fourth
        return self._back(half**2 * old + dt / 6.0 * change)

    def __call__(self, v, **settings):
        """Return the velocity on nodes after the steps; settings go to `rollout`."""
        start = self._back(self.project(self._transform(v)))
        return dp.rollout(self.step, start, None, self.steps, **settings)
