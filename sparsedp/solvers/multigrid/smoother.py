"""Gauss-Seidel by colours: which cells a cell is linked to, as tables for the loops.

Cells of one colour are not linked, so that they are relaxed together. On the finest level links run along the axes, and
two colours do, red and black; on the others a cell is linked to all cells around, and there are as many colours as
parities. The links of a level are rows of an array: number `m * colours + q` holds those of the cells of colour q
to the cells at `steps[m]` from them. Links of the other direction are those of the other cell.
"""

from itertools import product

import numpy as np

__all__ = ["axis_steps", "chess_board", "links_around", "steps_around"]


def axis_steps(dim):
    """Steps of the links on the finest level."""
    return [tuple(int(a == axis) for a in range(dim)) for axis in range(dim)]


def steps_around(dim):
    """Steps of the links on the other levels: half of the cells around."""
    return [step for step in product((-1, 0, 1), repeat=dim) if step > (0,) * dim]


def links_around(layout, steps):
    """Tables of the sums over neighbours, colour after colour; where those of a colour begin, and within them those of
    higher colours, and where they end; the step of each row."""
    count = len(layout.colours)
    table: list = []
    ends: list = []
    kept: list = []
    for q in range(count):
        rows = []
        for m, step in enumerate(steps):
            for sign in (1, -1):
                there = tuple(sign * d for d in step)
                colour, far = layout.neighbour(q, there)
                link = (m * count + q, 0) if sign > 0 else (m * count + colour, far)
                rows.append((*link, colour, far, there))
        rows.sort(key=lambda row: row[2])
        earlier = sum(row[2] < q for row in rows)
        ends.append((len(table), len(table) + earlier, len(table) + len(rows)))
        table += [row[:4] for row in rows]
        kept += [row[4] for row in rows]
    return np.array(table), np.array(ends), kept


def chess_board(layout):
    """Colours of the red cells, which have an even sum of indices, and of the black ones."""
    odd = [sum(colour) % 2 for colour in layout.colours]
    return [q for q, p in enumerate(odd) if not p], [q for q, p in enumerate(odd) if p]
