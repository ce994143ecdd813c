"""Interpolation of a component of a field at departure points, with ghost cells, and its derivatives."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp

from sparsedp._utils import buffers
from sparsedp._utils.validation import EPS
from sparsedp.advection.ghost_cells import ghost_sources, solid_filling
from sparsedp.advection.index_coordinates import IndexCoordinates
from sparsedp.advection.settings import wall_space
from sparsedp.kernels import interpolation_weights
from sparsedp.kernels.interpolation_weights import PAD

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sparsedp.advection.index_coordinates import Displacement
    from sparsedp.advection.settings import TransportSettings

__all__ = ["InterpolatedComponent", "Interpolant"]

# Numbers of samples up to which gathers of single entries are faster than copies of blocks.
GATHER_BELOW = 4096
GATHER_SUMS_BELOW = 512


class Interpolant:
    """The interpolation of a component of the field, linear or cubic.

    Parameters
    ----------
    settings : TransportSettings
    number : int
        Index of the component.
    closed : bool
        If True, interpolate linearly and use the value of the nearest point beyond walls, without inflow values and
        without filling the solid. The velocity is interpolated in this way.

    Attributes
    ----------
    span : slice
        Range of the entries of the component in the flat field.
    half_way : Interpolant or None
        Interpolant of the velocity at the midpoint of the path to a departure point. None for euler, which uses the
        velocity at the point itself.
    """

    def __init__(self, settings: TransportSettings, number: int, closed: bool = False) -> None:
        if closed:
            interpolation = "linear"
        else:
            interpolation = settings.interpolation
        self.settings = settings
        self.span = slice(*settings.space.offsets[number : number + 2])
        self.points = interpolation_weights.Points.of(
            settings.space.parts[number], settings.grid.periodic, interpolation
        )
        self.coordinates = IndexCoordinates(settings, number, interpolation)
        self.half_way: Interpolant | None = None
        if settings.backtrace == "midpoint" and not closed:
            self.half_way = Interpolant(settings, number, closed=True)
        self._inside = tuple(slice(PAD, PAD + n) for n in self.points.shape)
        self._ghosts, self._sources = ghost_sources(settings, number, self.points, closed)
        inflow_values = 0 if closed else wall_space(settings).size
        self.new_samples = buffers.allocator((self.points.samples + inflow_values,), filled=True)  # new zeros
        self._gathered = None
        self._scattered: tuple[NDArray, NDArray] | None = None
        if self.points.samples <= GATHER_BELOW:
            self._gathered = self._indices_of_samples(inflow_values)
        if self._gathered is not None and self.points.samples <= GATHER_SUMS_BELOW:
            is_ghost = np.zeros(self._gathered.size, bool)
            is_ghost[self._ghosts] = True
            order = np.concatenate([np.flatnonzero(~is_ghost), self._ghosts])
            self._scattered = order, self._gathered[order]
        self._filling: sp.csr_array | None = None
        if settings.of == "cells" and settings.solid is not None and not closed:  # faces of solids keep their value
            self._filling = solid_filling(settings.grid, settings.solid)
            self._filling_transpose = sp.csr_array(self._filling.T)

    @property
    def is_direct(self) -> bool:
        """Whether departure points follow from the velocity at the points alone, and no solid cell is filled."""
        return self.half_way is None and not self.coordinates.axes and self._filling is None

    def _indices_of_samples(self, inflow_values: int) -> NDArray:
        """Return for each sample its index in the component followed by the inflow values."""
        n = self.points.size
        return self._padded(np.arange(n), np.arange(n, n + inflow_values)).astype(np.intp)

    def fill_solid(self, u: NDArray) -> NDArray:
        """Return the component with its solid cells filled; see `solid_filling`."""
        if self._filling is None:
            return u
        return self._filling @ u

    def fill_solid_vjp(self, of_u: NDArray) -> None:
        """Apply the transpose of `fill_solid` to a cotangent, in place."""
        if self._filling is not None:
            of_u[:] = self._filling_transpose @ of_u

    def filled_matrix(self, matrix: sp.csr_array) -> sp.csr_array:
        """Return the product ``matrix @ F`` with the matrix F of `fill_solid`."""
        if self._filling is None:
            return matrix
        return matrix @ self._filling

    def pad(self, u: NDArray, inflow: NDArray) -> NDArray:
        """Return the samples: the component with its ghost cells, followed by the inflow values."""
        if self._gathered is None:
            return self._padded(u, inflow)
        if inflow.size:
            u = np.concatenate((u, inflow))
        return u.take(self._gathered)

    def _padded(self, u: NDArray, inflow: NDArray) -> NDArray:
        """Return the samples by copying blocks, which for large arrays is faster than gathering entries."""
        cells = self.points.samples
        samples = buffers.empty((cells + inflow.size,), float)
        samples[:cells].reshape(self.points.padded)[self._inside] = u.reshape(self.points.shape)
        samples[cells:] = inflow
        samples[self._ghosts] = samples[self._sources]
        return samples

    def pad_vjp(self, samples: NDArray, of_u: NDArray, of_inflow: NDArray) -> None:
        """Apply the transpose of `pad` to a cotangent of the samples: set `of_u` and add to `of_inflow`.

        The cotangent `samples` is overwritten.
        """
        cells = self.points.samples
        if self._scattered is not None:  # the same sums in the same order: each sample after the one in its own place
            order, targets = self._scattered
            sums = np.bincount(targets, samples.take(order), of_u.size + of_inflow.size)
            of_u[:] = sums[: of_u.size]
            if of_inflow.size:
                of_inflow += sums[of_u.size :]
            return
        np.add.at(samples, self._sources, samples.take(self._ghosts))
        of_u.reshape(self.points.shape)[...] = samples[:cells].reshape(self.points.padded)[self._inside]
        of_inflow += samples[cells:]


class InterpolatedComponent:
    """A component of a field at departure points, with its derivatives.

    Parameters
    ----------
    interpolant : Interpolant
    displacement : Displacement
    u : array
        The component as a flat array.
    inflow : array
        All inflow values.
    """

    __slots__ = ("_samples", "displacement", "inflow", "interpolant", "points", "u")

    def __init__(self, interpolant: Interpolant, displacement: Displacement, u: NDArray, inflow: NDArray) -> None:
        self.interpolant = interpolant
        self.displacement = displacement
        self.u = u
        self.inflow = inflow
        self.points = interpolant.points
        self._samples: NDArray | None = None

    @property
    def samples(self) -> NDArray:
        """The filled component with its ghost cells, followed by the inflow values."""
        if self._samples is None:
            self._samples = self.interpolant.pad(self.interpolant.fill_solid(self.u), self.inflow)
        return self._samples

    def with_field(self, u: NDArray, inflow: NDArray) -> InterpolatedComponent:
        """Return another field at the same departure points."""
        return InterpolatedComponent(self.interpolant, self.displacement, u, inflow)

    def value(self, out: NDArray | None = None, bounds: NDArray = interpolation_weights.NO_BOUNDS) -> NDArray:
        """Return the values at the departure points.

        If `bounds` is not empty, it is set to the least and the greatest sample of the cell of each departure point.
        """
        if out is None:
            out = buffers.empty((self.points.size,), float)
        values, scale, _ = self.displacement
        return interpolation_weights.interpolate(self.points, self.samples, values, scale, out, bounds=bounds)

    def vjp(
        self,
        g: NDArray,
        of_u: NDArray,
        of_inflow: NDArray,
        of_samples: tuple[NDArray, NDArray] | None = None,
    ) -> None:
        """Compute the cotangents of u and inflow from the cotangent g of the values: set `of_u`, add to `of_inflow`.

        `of_samples` is a pair (indices of samples, cotangents of these samples) with further contributions.
        """
        samples = self.interpolant.new_samples()
        if of_samples is not None:
            np.add.at(samples, *of_samples)
        values, scale, _ = self.displacement
        interpolation_weights.scatter(self.points, values, scale, g, samples)
        self.interpolant.pad_vjp(samples, of_u, of_inflow)
        self.interpolant.fill_solid_vjp(of_u)

    def velocity_slopes(self, g: NDArray, out: NDArray) -> NDArray:
        """Set `out` (axis, point) to g times the derivative of the values in the velocity along the step."""
        values, scale, slopes = self.displacement
        if not len(slopes):
            return interpolation_weights.interpolate(self.points, self.samples, values, scale, out, g)
        # If the slope jumps at a departure point, move the point slightly to the side for which the slope is valid.
        nudge = 32 * EPS * max(self.points.shape) * (slopes[0] != slopes[-1])
        total = 0.0
        for slope, shift in zip(slopes, (-nudge, nudge)):
            field_slope = buffers.empty(out.shape, float)
            interpolation_weights.interpolate(self.points, self.samples, values + shift, scale, field_slope, g)
            total += slope * field_slope
        return np.divide(total, len(slopes), out=out)

    def jvp(self, du: NDArray, dinflow: NDArray, dw: NDArray | None) -> NDArray:
        """Return the tangent of the values for tangents of u, inflow and the velocity along the step."""
        total = self.with_field(du, dinflow).value()
        if dw is None:
            return total
        return total + np.sum(self.velocity_slopes(np.ones(total.size), np.empty(dw.shape)) * dw, axis=0)

    def matrix(self) -> sp.csr_array:
        """Return the matrix that maps u to the values, for an inflow of 0."""
        n = self.points.size
        # Padding the array of point indices gives, for each sample, the point that it repeats; n stands for inflow.
        sources = self.interpolant.pad(np.arange(n), np.full(self.inflow.size, n)).astype(int)
        values, scale, _ = self.displacement
        total = sum(
            sp.csr_array((weight, sources[index], np.arange(n + 1)), (n, n + 1))
            for index, weight in interpolation_weights.entries(self.points, values, scale)
        )
        return self.interpolant.filled_matrix(total[:, :n])
