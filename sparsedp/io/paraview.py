"""Write fields to .vti, .vtr and .pvd files for ParaView. Only this module imports pyevtk (extra `files`)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from pyevtk.hl import gridToVTK, imageToVTK

from sparsedp.grid.grid import Grid, node_axes
from sparsedp.io.atomic_files import path_errors, write_file, write_through

__all__ = ["write_grid", "write_series"]


def write_series(path: Any, grid: Grid, times: Any, content: dict[str, Any]) -> None:
    """Write the fields at each time to a .vtr file in a folder named like `path` without .pvd; then write the index."""
    folder = Path(path).with_suffix("")
    with path_errors(path):
        folder.mkdir(exist_ok=True)
    entries = []
    for number, time in enumerate(times):
        place = f"{folder.name}/{number:04}.vtr"
        write_grid(
            folder.parent / place, grid, {name: (kind, values[number]) for name, (kind, values) in content.items()}
        )
        entries.append(f'<DataSet timestep="{time}" file={quoteattr(place)}/>\n')
    write_file(path, f'<VTKFile type="Collection"><Collection>\n{"".join(entries)}</Collection></VTKFile>\n')
    for old in folder.glob("*.vtr"):  # delete remaining files of a longer series that had the same name
        if re.fullmatch("[0-9]{4,}", old.stem) and int(old.stem) >= len(entries):
            old.unlink()


def write_grid(path: Any, grid: Grid, content: dict[str, Any]) -> None:
    """Write fields, as returned by `check_fields`, to a .vti file (uniform grid) or a .vtr file (any grid)."""
    cells: dict = {}
    points: dict = {}
    for field, (space, values) in content.items():
        (points if space.kind == "nodes" else cells).update(_arrays(field, space, values))
    missing = 3 - grid.dim  # each missing axis gets one cell, as wide as the first cell along x
    lines = [grid.coordinates(axis, "ends") for axis in range(grid.dim)]
    lines += [np.append(0.0, grid.widths[0][:1])] * missing

    def write(part):
        stem = str(part.with_suffix(""))
        if part.suffix == ".vtr":
            gridToVTK(stem, *lines, cells, points)
        else:
            spacing = [float(widths[0]) for widths in grid.widths + grid.widths[:1] * missing]
            imageToVTK(stem, grid.origin + (0.0,) * missing, spacing, cells or None, points or None)

    write_through(path, write)


def _arrays(field, space, values):
    """Yield (name, array) for a field or for each of its batch entries. A vector is a tuple of three arrays."""
    grid = space.grid
    kind = space.kind
    flat = (1,) * (3 - grid.dim)
    for index in np.ndindex(values.shape[: values.ndim - len(space.shape)]):
        parts = [part.reshape(part.shape + flat) for part in space.split(values[index])]
        if kind == "nodes":  # ParaView needs the last node of a periodic axis, which equals the first one
            parts = [np.pad(parts[0], [(0, int(more)) for more in grid.periodic + flat], mode="wrap")]
        elif kind != "cells":
            parts = [_means(part, node_axes(kind, number, grid.dim), grid.shape) for number, part in enumerate(parts)]
            parts += [np.zeros_like(parts[0])] * len(flat)
        blocks = tuple(map(np.ascontiguousarray, parts))
        yield "_".join(map(str, (field, *index))), blocks if len(blocks) == 3 else blocks[0]


def _means(part, on_nodes, shape):
    """Return for each cell the mean of a component over its faces or edges."""
    part = part.astype(np.result_type(part, np.float32))
    for axis in on_nodes:
        part = 0.5 * part + 0.5 * np.roll(part, -1, axis)
    return part[tuple(map(slice, shape))]  # drop the wrapped mean at the last face of a bounded axis
