"""The field that plays the hidden ground: real terrain, the reader's own file, or a generated one."""

from dataclasses import dataclass

import numpy as np

import sparsedp as dp
from sparsedp.report import plots
from sparsedp.report.demo.files import read_field

__all__ = ["Terrain", "hidden_ground", "load", "remap"]

SAMPLE = "jacksboro_fault_dem.npz"
FINEST = 8  # points along an axis that are averaged into one cell
STEEPEST = 3.5  # bound on |log k|: conductivities then span a factor of at most 1000


@dataclass(frozen=True, eq=False)
class Terrain:
    """A 2-D array, axis 0 is x, and where it came from."""

    field: np.ndarray
    source: str


def load(path=None):
    """Path of a file, or None -> Terrain. None: the sample data of matplotlib, or a generated terrain.

    Parameters
    ----------
    path : pathlib.Path or None

    Returns
    -------
    Terrain

    Raises
    ------
    ValueError, FileNotFoundError, ImportError
        From `read_field`, when `path` does not hold a usable field.
    """
    if path is not None:
        return Terrain(read_field(path), f"your file {path}")
    try:
        with np.load(plots.sample_file(SAMPLE), allow_pickle=False) as archive:
            rows = archive["elevation"]
    except (ImportError, OSError, KeyError, ValueError):
        return Terrain(generated((403, 344)), "a generated terrain (the real one comes with matplotlib)")
    # Rows run from north to south; a field has axis 0 to the east and axis 1 to the north.
    return Terrain(rows[::-1].T.astype(float), f"elevation model {SAMPLE} from matplotlib's sample data")


def generated(shape, seed=1):
    """Shape -> crests and hollows, the same in every run.

    Waves with random phases and the spectrum of relief, amplitude (4 + w^2)^-1.2 for w waves per box;
    minus their absolute value has a crest wherever the sum changes sign. The waves are laid over
    twice the box and cut, since their sum is periodic.
    """
    double = tuple(2 * n for n in shape)
    per_box = [np.fft.fftfreq(n, 1 / max(shape)) for n in double]
    waves = np.add.outer(*map(np.square, per_box))
    phases = np.random.default_rng(seed).random(double)  # uniform numbers: their stream never changes
    relief = np.fft.ifft2((4 + waves) ** -1.2 * np.exp(2j * np.pi * phases)).real
    return -np.abs(relief[: shape[0], : shape[1]])


def remap(source, grid):
    """Two grids over the same box -> Operator from cells of the one to cells of the other: the mean over each cell.

    Each cell is cut into `FINEST` parts or fewer along each axis, the field is interpolated there
    (`sample`), and the parts are averaged (`restrict`). Linear fields are exact.

    Parameters
    ----------
    source, grid : Grid

    Returns
    -------
    Operator
        in: cells of `source` [unit]; out: cells of `grid` [unit].

    Examples
    --------
    >>> remap(dp.Grid(4, size=1.0), dp.Grid(2, size=1.0))(np.array([1.0, 2.0, 3.0, 4.0]))
    array([1.5, 3.5])
    """
    ratio = max(n / m for n, m in zip(source.shape, grid.shape, strict=True))
    parts = int(np.clip(np.ceil(ratio), 1, FINEST))
    fine = dp.Grid(tuple(parts * m for m in grid.shape), size=grid.size)
    points = np.stack([centre.ravel() for centre in fine.centres()], axis=1)
    return dp.restrict(fine, parts) @ dp.sample(source, points)


def hidden_ground(grid, terrain):
    """Terrain -> log-conductivity of the ground on a grid: mean 0, standard deviation 1 (or a little less).

    Parameters
    ----------
    grid : Grid
    terrain : Terrain

    Returns
    -------
    array, shape `grid.shape`: log of the conductivity, relative to its geometric mean

    Raises
    ------
    ValueError
        If the field is constant once it is averaged over the cells.
    """
    heights = remap(dp.Grid(terrain.field.shape, size=grid.size), grid)(terrain.field)
    heights = heights - heights.mean()
    spread = heights.std()
    if spread <= 1e-12 * np.abs(terrain.field).max():
        raise ValueError(f"{terrain.source} is constant once averaged over {grid}; give a field with larger features")
    logk = heights / spread
    return logk * min(1.0, STEEPEST / np.abs(logk).max())
