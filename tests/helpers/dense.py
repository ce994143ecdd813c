"""The staggered grid as dense matrices filled by loops over faces and cells: slow, plain, the reference."""

from itertools import product

import numpy as np

import sparsedp as dp

OPPOSITE = {dp.no_slip: dp.dirichlet, dp.inflow: dp.dirichlet, dp.free_slip: dp.neumann, dp.outflow: dp.neumann}


class Dense:
    """Matrices on one grid.

    Parameters
    ----------
    grid : Grid
        Only its shape, widths and periodic flags are read.
    sides : for each axis None (periodic), or a pair (lower, upper): conditions, or words of a flow
    solid : bool array or None
    """

    def __init__(self, grid, sides, solid=None):
        self.shape = grid.shape
        self.h = grid.widths
        self.periodic = grid.periodic
        self.sides = sides
        self.dim = len(self.shape)
        self.solid = np.zeros(self.shape, bool) if solid is None else solid
        self.cells = {place: number for number, place in enumerate(product(*map(range, self.shape)))}
        self.faces = {}
        for axis in range(self.dim):
            counts = [n + (a == axis and not self.periodic[a]) for a, n in enumerate(self.shape)]
            for place in product(*map(range, counts)):
                self.faces[axis, place] = len(self.faces)

    def beyond(self, place, axis, step):
        """The neighbour of a cell along an axis, or None beyond a wall."""
        n = self.shape[axis]
        there = place[axis] + step
        if not 0 <= there < n:
            if not self.periodic[axis]:
                return None
            there %= n
        return (*place[:axis], there, *place[axis + 1 :])

    def face(self, axis, place, index):
        """Number of the face across `axis`, with the place of a cell and an index along the axis; None: no face."""
        count = self.shape[axis] + (not self.periodic[axis])
        if not 0 <= index < count:
            if not self.periodic[axis]:
                return None
            index %= count
        return self.faces[axis, (*place[:axis], index, *place[axis + 1 :])]

    def beside(self, axis, place):
        """The cells below and above a face; None beyond a wall."""
        i = place[axis]
        n = self.shape[axis]
        cell = lambda j: (*place[:axis], j, *place[axis + 1 :])
        if self.periodic[axis]:
            return cell((i - 1) % n), cell(i)
        return (cell(i - 1) if i > 0 else None), (cell(i) if i < n else None)

    def width(self, cell, axis):
        return self.h[axis][cell[axis]]

    # ------------------------------------------------------------ between cells and faces

    def divergence(self):
        D = np.zeros((len(self.cells), len(self.faces)))
        for place, row in self.cells.items():
            for axis in range(self.dim):
                D[row, self.face(axis, place, place[axis])] -= 1 / self.width(place, axis)
                D[row, self.face(axis, place, place[axis] + 1)] += 1 / self.width(place, axis)
        return D

    def gradient(self, solid_boundary=dp.neumann):
        G = np.zeros((len(self.faces), len(self.cells)))
        for (axis, place), row in self.faces.items():
            low, high = self.beside(axis, place)
            open_low, open_high = (cell is not None and not self.solid[cell] for cell in (low, high))
            if open_low and open_high:
                d = 0.5 * (self.width(low, axis) + self.width(high, axis))
                G[row, self.cells[high]] += 1 / d
                G[row, self.cells[low]] -= 1 / d
            elif open_low or open_high:
                wall = self.sides[axis][int(open_low)] if low is None or high is None else solid_boundary
                cell, sign = (low, -1.0) if open_low else (high, 1.0)
                G[row, self.cells[cell]] += sign * wall.a / (0.5 * wall.a * self.width(cell, axis) + wall.b)
        return G

    def lift(self):
        """One column for each wall face, wall after wall."""
        columns = []
        for axis, pair in enumerate(self.sides):
            for side, wall in enumerate(pair or ()):
                edge = self.shape[axis] * side
                for (a, place), row in self.faces.items():
                    if a == axis and place[axis] == edge:
                        cell = self.beside(axis, place)[1 - side]
                        column = np.zeros(len(self.faces))
                        column[row] = (2 * side - 1) / (0.5 * wall.a * self.width(cell, axis) + wall.b)
                        columns.append(column)
        if columns:
            return np.stack(columns, axis=1)
        return np.zeros((len(self.faces), 0))

    def average(self):
        A = np.zeros((len(self.faces), len(self.cells)))
        for (axis, place), row in self.faces.items():
            low, high = self.beside(axis, place)
            if low is None or high is None:
                wall = self.sides[axis][int(high is None)]
                cell = low or high
                A[row, self.cells[cell]] = wall.b / (0.5 * wall.a * self.width(cell, axis) + wall.b)
            else:
                both = self.width(low, axis) + self.width(high, axis)
                A[row, self.cells[low]] += self.width(high, axis) / both
                A[row, self.cells[high]] += self.width(low, axis) / both
        return A

    # ------------------------------------------------------------ flow: `sides` are words

    def pressure(self):
        """The same grid with what the pressure meets at its walls."""
        of = lambda word: dp.dirichlet if word == dp.outflow else dp.neumann
        found = Dense.__new__(Dense)
        found.__dict__.update(self.__dict__, sides=[pair and tuple(map(of, pair)) for pair in self.sides])
        return found

    def flags(self, open_words):
        """For each face whether it is free: not at an obstacle, and at a wall only for one of the words."""
        found = np.zeros(len(self.faces), bool)
        for (axis, place), row in self.faces.items():
            low, high = self.beside(axis, place)
            touched = any(cell is not None and self.solid[cell] for cell in (low, high))
            wall = low is None or high is None
            found[row] = not touched and (not wall or self.sides[axis][int(high is None)] in open_words)
        return found

    def regions(self, A):
        """Flags of the cells of each singular part of A: linked cells whose rows sum to 0."""
        left = set(range(len(A)))
        found = []
        while left:
            part = set()
            new = {left.pop()}
            while new:
                part |= new
                new = {j for i in new for j in np.flatnonzero(A[i])} - part
            left -= part
            rows = np.array(sorted(part))
            if len(part) > 1 and np.abs(A[rows].sum(1)).max() < 1e-9 * np.abs(A[rows]).max():
                found.append(rows)
        return found

    def projection(self):
        """(P, pressure) as matrices: v + G p without divergence, p of mean 0 on each closed part."""
        D = self.divergence()
        G = self.pressure().gradient()
        K = np.diag(1.0 * self.flags((dp.inflow, dp.outflow)))
        G = self.flags((dp.outflow, dp.inflow))[:, None] * G
        p = -np.linalg.pinv(D @ G, rcond=1e-12) @ D @ K
        volumes = np.array([np.prod([self.width(cell, a) for a in range(self.dim)]) for cell in self.cells])
        for rows in self.regions(D @ G):
            p[rows] -= volumes[rows] @ p[rows] / volumes[rows].sum()
        return K + G @ p, p

    def viscous(self, solid_boundary=dp.no_slip):
        """The Laplacian of a velocity, 0 on faces that are not free."""
        L = np.zeros((len(self.faces),) * 2)
        free = self.flags((dp.outflow,))
        for (c, place), row in self.faces.items():
            for a in range(self.dim) if free[row] else ():
                i = place[a]
                if a == c:
                    low, high = self.beside(c, place)
                    d = 0.5 * sum(self.width(cell, c) for cell in (low, high) if cell is not None)
                    for cell, step in ((low, -1), (high, 1)):
                        if cell is not None:
                            L[row, self.face(c, place, i + step)] += 1 / (self.width(cell, c) * d)
                            L[row, row] -= 1 / (self.width(cell, c) * d)
                    continue
                h = self.h[a]
                n = self.shape[a]
                for step in (-1, 1):
                    j = i + step
                    inside = 0 <= j < n or self.periodic[a]
                    if inside:
                        other = self.faces[c, (*place[:a], j % n, *place[a + 1 :])]
                        touched = any(
                            cell is not None and self.solid[cell]
                            for cell in self.beside(c, (*place[:a], j % n, *place[a + 1 :]))
                        )
                        if not touched:
                            d = 0.5 * (h[i] + h[j % n])
                            L[row, other] += 1 / (d * h[i])
                            L[row, row] -= 1 / (d * h[i])
                    if not inside or touched:
                        word = solid_boundary if inside else self.sides[a][int(step > 0)]
                        if OPPOSITE[word] is dp.dirichlet:
                            L[row, row] -= 2 / h[i] ** 2
        return L

    def convection(self, v, w):
        """div(w v) by loops over the sides of each control volume."""
        out = np.zeros(len(self.faces))
        free = self.flags((dp.outflow,))
        for (c, place), row in self.faces.items():
            for a in range(self.dim) if free[row] else ():
                if a == c:
                    low, high = self.beside(c, place)
                    d = 0.5 * sum(self.width(cell, c) for cell in (low, high) if cell is not None)
                    flux = []
                    for cell, step in ((low, -1), (high, 1)):
                        other = row if cell is None else self.face(c, place, place[c] + step)
                        flux.append(0.25 * (v[row] + v[other]) * (w[row] + w[other]))
                    out[row] += (flux[1] - flux[0]) / d
                else:
                    flux = [self._corner(c, a, place, place[a] + up, v, w) for up in (0, 1)]
                    out[row] += (flux[1] - flux[0]) / self.h[a][place[a]]
        return out

    def _corner(self, c, a, place, node, v, w):
        """Component c of v times component a of w on the edge of face (c, place) at `node` along a."""
        at = lambda axis, i: (*place[:axis], i, *place[axis + 1 :])
        carried = self._mean(a, node, lambda j: v[self.faces[c, at(a, j)]])
        i = place[c]
        m = self.shape[a] + (not self.periodic[a])
        on = lambda j: w[
            self.faces[a, tuple(j if b == c else node % m if b == a else place[b] for b in range(self.dim))]
        ]
        return carried * self._mean(c, i, on)

    def _mean(self, axis, node, value):
        """Of what stands at the cells along an axis, at a node."""
        n = self.shape[axis]
        h = self.h[axis]
        if self.periodic[axis]:
            low = (node - 1) % n
            high = node % n
        elif 0 < node < n:
            low = node - 1
            high = node
        else:
            side = int(node > 0)
            if OPPOSITE[self.sides[axis][side]] is dp.dirichlet:
                return 0.0
            return value((n - 1) * side)
        return (value(low) * h[high] + value(high) * h[low]) / (h[low] + h[high])
