"""What a scene is composed of. Each class builds one function twice: by the library, and by plain autograd.numpy.

`library(box)` and `twin(box)` return functions of a field and of the dict of its parameters, which `parameters(box)`
lists with their values. Twins use dense matrices that are filled by loops, closed formulas, and Newton steps on the
tape; nothing of the library but the grid and the names of its conditions.
"""

from dataclasses import dataclass
from functools import lru_cache

import autograd.numpy as anp
import numpy as np
from autograd.tracer import getval, isbox
from eulerian_reference import twin as transport_twin

import sparsedp as dp
from campaign.boxes import boundary, dense, numbers, obstacle
from campaign.operators import bound, matrix, operator


class Discarded(Exception):
    """The numbers of the scene leave the range in which a comparison says something."""


class Ingredient:
    """One part of a scene: a map from a field of kind `source` to one of kind `target`."""

    order = 2  # highest order of derivatives
    batched = True  # whether leading axes are a batch
    complex = False  # whether complex fields pass
    tolerance = 1e-9  # of the comparison, relative
    refusals = ()  # (type of error, words of its message) with which the library may refuse

    def parameters(self, box):
        """Return the parameters, a dict of arrays and numbers."""
        return {}


class OnCells(Ingredient):
    """From a field on cells to one on cells."""

    source = "cells"
    target = "cells"


def flat_product(dense_matrix, u, shape, result_shape):
    """Return the product of a dense matrix with each field of a batch."""
    batch = anp.shape(u)[: anp.ndim(u) - len(shape)]
    rows = anp.reshape(u, (int(np.prod(batch)), dense_matrix.shape[1]))
    return anp.reshape(anp.dot(rows, dense_matrix.T), (*batch, *result_shape))


def constant_part(x):
    """Return the value of a traced array, without its derivatives of any order."""
    while isbox(x):
        x = getval(x)
    return x


# ---- linear --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Linear(Ingredient):
    """Map u to keep u + A(u), where A is an expression, scaled to size 1."""

    expression: tuple
    keep: float
    source: str
    target: str
    complex = True

    def library(self, box):
        scaled = (1 / bound(box, self.expression)) * operator(box, self.expression)
        if not self.keep:
            return lambda u, p: scaled(u)
        return lambda u, p: self.keep * u + scaled(u)

    def twin(self, box):
        scaled = matrix(box, self.expression) / bound(box, self.expression)
        shape = box.field_shape(self.source)
        result_shape = box.field_shape(self.target)
        if not self.keep:
            return lambda u, p: flat_product(scaled, u, shape, result_shape)
        return lambda u, p: self.keep * u + flat_product(scaled, u, shape, result_shape)


@dataclass(frozen=True)
class WallValues(OnCells):
    """Map u to u + D(G(u) + B(values)) / scale, values given on the walls."""

    sides: tuple
    seed: int

    def parameters(self, box):
        size = dense(box, self.sides).lift().shape[1]
        return {"values": numbers(self.seed, size)}

    def _scale(self, box):
        return bound(box, ("laplacian", self.sides, None, "neumann"))

    def library(self, box):
        grid = box.grid()
        scale = self._scale(box)
        D = dp.divergence(grid)
        G = dp.gradient(grid, boundary(box, self.sides))
        B = dp.lift(grid, boundary(box, self.sides))
        return lambda u, p: u + D(G(u) + B(p["values"])) / scale

    def twin(self, box):
        table = dense(box, self.sides)
        scale = self._scale(box)
        D = table.divergence()
        laplacian = D @ table.gradient() / scale
        lifted = D @ table.lift() / scale

        def act(u, p):
            values = anp.reshape(anp.dot(lifted, p["values"]), box.shape)
            return u + flat_product(laplacian, u, box.shape, box.shape) + values

        return act


@dataclass(frozen=True)
class Solve(Ingredient):
    """Map u to the solution x of A x = u, or of the transposed system, scaled to size 1."""

    expression: tuple
    shift: float
    method: str
    transposed: bool
    source: str
    complex = True
    tolerance = 1e-7

    @property
    def target(self):
        return self.source

    def _system(self):
        kind = self.source
        if self.shift:
            return ("sum", ("scale", self.shift, ("identity", kind)), self.expression)
        return self.expression

    def _scale(self, box):
        return bound(box, self.expression) + abs(self.shift)

    def library(self, box):
        solve = dp.inverse(operator(box, self._system()), self.method, rtol=1e-12, nullspace="project")
        solve = solve.T if self.transposed else solve
        weight = self.shift or 1.0
        return lambda u, p: weight * solve(u)

    def twin(self, box):
        system = matrix(box, self._system())
        inverse = np.linalg.inv(system) if self.shift else inverse_without_mean(system, cell_volumes(box))
        inverse = inverse.T if self.transposed else inverse
        weight = self.shift or 1.0
        shape = box.field_shape(self.source)
        return lambda u, p: flat_product(weight * inverse, u, shape, shape)


def cell_volumes(box):
    volumes = np.ones(box.shape)
    for axis, widths in enumerate(box.widths()):
        volumes = volumes * widths.reshape([-1 if a == axis else 1 for a in range(box.dim)])
    return volumes.ravel()


def inverse_without_mean(system, volumes):
    """Return the inverse; of a closed system, from data without mean to solutions without mean, by volume."""
    if np.linalg.cond(system) < 1e12:
        return np.linalg.inv(system)
    size = len(system)
    bordered = np.block([[system, np.ones((size, 1))], [volumes[None], np.zeros((1, 1))]])
    without_mean = np.eye(size) - np.outer(np.ones(size), volumes) / volumes.sum()
    return np.linalg.inv(bordered)[:size, :size] @ without_mean


# ---- solves with coefficients --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Elliptic(OnCells):
    """Map u to x of (shift - D diag(k) G) x = u; k on faces from a field on cells, on faces, or one number."""

    sides: tuple
    solid: int | None
    coefficient: str  # "number", "faces", "average" or "harmonic"
    shift: str  # "none", "number" or "cells"
    method: str
    seed: int
    batched = False
    tolerance = 1e-7

    def parameters(self, box):
        values = {}
        if self.coefficient == "number":
            values["k"] = 0.3
        elif self.coefficient == "faces":
            values["k"] = 0.3 * numbers(self.seed, box.field_shape("faces"))
        else:
            values["k"] = 0.3 * numbers(self.seed, box.shape)
        if self.shift == "number":
            values["shift"] = 0.7
        elif self.shift == "cells":
            values["shift"] = 0.7 + 0.2 * np.sin(numbers(self.seed + 1, box.shape))
        return values

    def library(self, box):
        grid = box.grid()
        D = dp.divergence(grid)
        G = dp.gradient(grid, boundary(box, self.sides), obstacle(box, self.solid))
        solve = dp.elliptic_solver(D, G, self.method, rtol=1e-12, nullspace="project")
        to_faces = {"average": dp.average(grid), "harmonic": dp.harmonic_average(grid)}.get(self.coefficient)

        def act(u, p):
            k = anp.exp(p["k"])
            k = k if to_faces is None else to_faces(k)
            if "shift" in p:
                return solve(k, u, p["shift"])
            return solve(k, u)

        return act

    def twin(self, box):
        table = dense(box, self.sides, self.solid)
        D = table.divergence()
        G = table.gradient()
        plain = dense(box)
        average = plain.average()
        pairs, shares = face_neighbours(plain)
        volumes = cell_volumes(box)
        size = len(volumes)
        faces = D.shape[1]
        singular = self.shift == "none" and np.linalg.cond(D @ G) > 1e12
        without_mean = np.eye(size) - np.outer(np.ones(size), volumes) / volumes.sum()

        def act(u, p):
            k = anp.exp(p["k"])
            if self.coefficient == "number":
                k = k * np.ones(faces)
            elif self.coefficient == "average":
                k = anp.dot(average, anp.ravel(k))
            elif self.coefficient == "harmonic":
                cells = anp.ravel(k)
                k = 1 / (shares / cells[pairs[:, 0]] + (1 - shares) / cells[pairs[:, 1]])
            shift = p["shift"] if "shift" in p else 0.0
            system = anp.diag(anp.ravel(shift * np.ones(box.shape))) - anp.dot(D * k, G)
            b = anp.ravel(u)
            if singular:
                ones = np.ones((size, 1))
                top = anp.concatenate([system, ones], axis=1)
                bottom = np.concatenate([volumes[None], np.zeros((1, 1))], axis=1)
                bordered = anp.concatenate([top, bottom], axis=0)
                data = anp.concatenate([anp.dot(without_mean, b), np.zeros(1)])
                return anp.reshape(anp.linalg.solve(bordered, data)[:size], box.shape)
            return anp.reshape(anp.linalg.solve(system, b), box.shape)

        return act


def face_neighbours(table):
    """Return the numbers of the cells below and above each face, and the share of the distance in the lower one.

    At a wall both are the cell beside it.
    """
    pairs = []
    shares = []
    for axis, place in table.faces:
        low, high = table.beside(axis, place)
        low, high = (high if low is None else low), (low if high is None else high)
        low_width = table.width(low, axis)
        high_width = table.width(high, axis)
        pairs.append((table.cells[low], table.cells[high]))
        shares.append(low_width / (low_width + high_width))
    return np.array(pairs), np.array(shares)


@dataclass(frozen=True)
class Entries(OnCells):
    """Map u to x of A x = u, where the entries of A on a given pattern are parameters."""

    seed: int
    method: str
    batched = False
    tolerance = 1e-7

    def _pattern(self, box):
        size = int(np.prod(box.shape))
        pattern = np.random.default_rng(self.seed).random((size, size)) < 0.25
        return pattern | np.eye(size, dtype=bool)

    def parameters(self, box):
        pattern = self._pattern(box)
        entries = numbers(self.seed, pattern.shape) * pattern / len(pattern) + 2 * np.eye(len(pattern))
        rows, columns = np.nonzero(pattern)
        return {"entries": entries[rows, columns]}

    def library(self, box):
        solve = dp.matrix_solver(self._pattern(box).astype(float), self.method, rtol=1e-12, domain=box.grid().cells)
        return lambda u, p: solve(p["entries"], u)

    def twin(self, box):
        pattern = self._pattern(box)
        rows, columns = np.nonzero(pattern)
        size = len(pattern)
        place = np.zeros((size * size, len(rows)))
        place[rows * size + columns, np.arange(len(rows))] = 1.0

        def act(u, p):
            system = anp.reshape(anp.dot(place, p["entries"]), (size, size))
            return anp.reshape(anp.linalg.solve(system, anp.ravel(u)), box.shape)

        return act


# ---- pointwise and in divergence form ------------------------------------------------------------------------------


POINTWISE = {
    "sine": lambda u, p: anp.sin(u) + 0.1 * u**2,
    "tanh": lambda u, p: anp.tanh(p["a"] * u) + 0.5 * u,
    "product": lambda u, p: u * p["a"] + p["a"] ** 2,
    "quotient": lambda u, p: u / (1 + p["a"] ** 2) + 0.1 * anp.exp(-(u**2)),
    "where": lambda u, p: anp.where(u > 0, u + 0.2 * u**2 / (1 + u**2), anp.sin(u)),
    "stacked": lambda u, p: anp.sum(anp.stack([u, u**2 * p["a"], anp.cos(u)]) * 0.5, axis=0),
    "moved": lambda u, p: 0.5 * u + p["a"] * anp.concatenate([u[..., 1:], u[..., :1]], axis=-1) * u,
}


@dataclass(frozen=True)
class Pointwise(Ingredient):
    """A function written with autograd.numpy; "rule" and "adopted" are made by `differentiable` and `adopt`."""

    formula: str
    source: str
    size: str  # of the parameter: "number" or "field"
    seed: int

    @property
    def target(self):
        return self.source

    def parameters(self, box):
        if self.formula in ("sine", "where"):
            return {}
        shape = () if self.size == "number" else box.field_shape(self.source)
        values = 0.5 + 0.3 * np.sin(numbers(self.seed, shape))
        return {"a": float(values) if self.size == "number" else values}

    def library(self, box):
        return POINTWISE[self.formula]

    twin = library


@dataclass(frozen=True)
class Rule(Ingredient):
    """A rule of the user, `differentiable`, with a VJP and perhaps a JVP."""

    source: str
    forward: bool  # whether the rule gives a JVP
    seed: int

    @property
    def target(self):
        return self.source

    def parameters(self, box):
        return {"a": 0.5 + 0.3 * np.sin(numbers(self.seed, box.field_shape(self.source)))}

    def library(self, box):
        def vjp(nums, ans, u, a):
            def pull(g):
                slopes = {0: lambda: g * a * anp.cos(a * u), 1: lambda: g * u * anp.cos(a * u)}
                found = []
                for num in nums:
                    slope = slopes[num]()
                    if num == 1:
                        slope = anp.sum(anp.reshape(slope, (-1, *anp.shape(a))), axis=0)
                    found.append(slope)
                return tuple(found)

            return pull

        def jvp(nums, tangents, ans, u, a):
            total = 0.0
            for num, tangent in zip(nums, tangents):
                total = total + tangent * (a if num == 0 else u) * anp.cos(a * u)
            return total

        rule = dp.differentiable("sine of a product", lambda u, a: np.sin(a * u), vjp, jvp if self.forward else None)
        return lambda u, p: rule(u, p["a"])

    def twin(self, box):
        return lambda u, p: anp.sin(p["a"] * u)


@dataclass(frozen=True)
class BlackBox(OnCells):
    """Plain NumPy, differentiated by `adopt` with coloured complex steps or differences."""

    derivative: str
    order = 1
    batched = False
    tolerance = 1e-6
    refusals = ((dp.errors.DerivativeError, "is a black box without second derivatives"),)

    def library(self, box):
        def plain(u):
            return np.roll(u, 1, axis=0) ** 2 * 0.3 + np.sin(u)

        adopted = dp.from_blackbox(plain, derivative=self.derivative)
        return lambda u, p: adopted(u)

    def twin(self, box):
        return lambda u, p: anp.concatenate([u[-1:], u[:-1]], axis=0) ** 2 * 0.3 + anp.sin(u)


@dataclass(frozen=True)
class Diffusion(OnCells):
    """Map u to u + D((1 + sin(A(u))^2) k G(u)) / scale."""

    sides: tuple
    solid: int | None
    seed: int

    def parameters(self, box):
        return {"k": 1 + 0.3 * np.sin(numbers(self.seed, box.field_shape("faces")))}

    def _scale(self, box):
        return 5 * bound(box, ("laplacian", self.sides, None, "neumann"))

    def library(self, box):
        grid = box.grid()
        sides = boundary(box, self.sides)
        scale = self._scale(box)
        D = dp.divergence(grid)
        G = dp.gradient(grid, sides, obstacle(box, self.solid))
        A = dp.average(grid, sides)
        return lambda u, p: u + D((1 + anp.sin(A(u)) ** 2) * p["k"] * G(u)) / scale

    def twin(self, box):
        table = dense(box, self.sides, self.solid)
        scale = self._scale(box)
        faces = box.field_shape("faces")
        D = table.divergence() / scale
        G = table.gradient()
        A = table.average()

        def act(u, p):
            flow = (1 + anp.sin(flat_product(A, u, box.shape, faces)) ** 2) * p["k"]
            flow = flow * flat_product(G, u, box.shape, faces)
            return u + flat_product(D, flow, faces, box.shape)

        return act


# ---- transport -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Transport(Ingredient):
    """One step of transport of a field on cells or faces, by a velocity that is a parameter."""

    scheme: str
    sides: tuple
    velocity: str
    of: str
    form: str
    still: bool  # whether the velocity is 0 in places
    seed: int
    solid: int | None = None  # for "upwind" of a field on cells, with a velocity on faces
    batched = False

    @property
    def order(self):
        if self.scheme == "upwind":
            return 2
        return 1

    @property
    def refusals(self):
        if self.scheme == "upwind":
            return ()
        return ((dp.errors.DerivativeError, "second order|first"),)

    @property
    def source(self):
        return self.of

    @property
    def target(self):
        return self.of

    def _boundary(self, box):
        return boundary(box, self.sides)

    def _move(self, box):
        return dp.transport(
            box.grid(),
            self.scheme,
            self._boundary(box),
            self.velocity,
            self.of,
            form=self.form,
            solid=obstacle(box, self.solid),
        )

    def parameters(self, box):
        move = self._move(box)
        shape = box.field_shape("faces") if self.velocity == "faces" else (box.dim, *box.shape)
        v = numbers(self.seed, shape)
        if self.still:
            v = v * (np.random.default_rng(self.seed).random(shape) < 0.5)
        return {"v": v, "dt": 0.02, "inflow": numbers(self.seed + 1, move.walls.size)}

    def library(self, box):
        step = self._move(box)._rule  # the object itself refuses an inflow that no side uses
        return lambda u, p: step(u, p["v"], p["dt"], p["inflow"])

    def twin(self, box):
        move = transport_twin(box.grid(), self.scheme, self._boundary(box), self.velocity, self.of, self.form)
        if self.solid is None:
            return lambda u, p: move(u, p["v"], p["dt"], p["inflow"])
        words = tuple(None if periodic else ("outflow", "outflow") for periodic in box.periodic)
        passing = 1.0 * dense(box, words, self.solid).flags((dp.outflow,))
        return lambda u, p: move(u, p["v"] * passing, p["dt"], p["inflow"])


# ---- flow ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Convection(Ingredient):
    """Map v to v - dt div(w v), with w a parameter or v itself."""

    sides: tuple
    solid: int | None
    own: bool
    seed: int
    source = "faces"
    target = "faces"

    def parameters(self, box):
        if self.own:
            return {"dt": 0.1}
        return {"dt": 0.1, "w": numbers(self.seed, box.field_shape("faces"))}

    def library(self, box):
        convect = dp.convection(box.grid(), boundary(box, self.sides), obstacle(box, self.solid))
        return lambda v, p: v - p["dt"] * convect(v, v if self.own else p["w"])

    def twin(self, box):
        carried, carrying, balance = convection_factors(box, self.sides, self.solid)
        faces = box.field_shape("faces")
        sides = (len(carried),)

        def act(v, p):
            w = v if self.own else p["w"]
            momentum = flat_product(carried, v, faces, sides) * flat_product(carrying, w, faces, sides)
            return v - p["dt"] * flat_product(balance, momentum, sides, faces)

        return act


@lru_cache(maxsize=64)
def convection_factors(box, sides, solid):
    """Return the matrices of C((A v) (B w)): what is carried and what carries on the sides of the control volumes.

    One row of A and B for each side of the control volume of each free face, by loops over them.
    """
    table = dense(box, sides, solid)
    units = np.eye(len(table.faces))
    free = table.flags((dp.outflow,))
    carried = []
    carrying = []
    balance = []

    def add(row, weight, carried_row, carrying_row):
        carried.append(carried_row)
        carrying.append(carrying_row)
        balance.append(weight * units[row])

    for (component, place), row in table.faces.items():
        for axis in range(box.dim) if free[row] else ():
            if axis == component:
                low, high = table.beside(component, place)
                length = 0.5 * sum(table.width(cell, component) for cell in (low, high) if cell is not None)
                for cell, step in ((low, -1), (high, 1)):
                    other = row if cell is None else table.face(component, place, place[component] + step)
                    mean = 0.5 * (units[row] + units[other])
                    add(row, step / length, mean, mean)
            else:
                width = table.h[axis][place[axis]]
                for step, node in ((-1, place[axis]), (1, place[axis] + 1)):
                    along = mean_of_two(table, axis, node, component, place, units)
                    across = mean_of_two(table, component, place[component], axis, at_index(place, axis, node), units)
                    add(row, step / width, along, across)
    if not carried:
        nothing = np.zeros((0, len(units)))
        return nothing, nothing, nothing.T
    return np.array(carried), np.array(carrying), np.array(balance).T


def at_index(place, axis, index):
    return (*place[:axis], index, *place[axis + 1 :])


def mean_of_two(table, axis, node, component, place, units):
    """Return the weights of faces of a component whose linear interpolation along an axis is taken at a node.

    Beyond a wall the value is 0 (no_slip) or the value of the last cell (free_slip).
    """
    cells = table.shape[axis]
    widths = table.h[axis]

    def weights(index):
        at = at_index(place, axis, index)
        if table.periodic[component]:
            at = at_index(at, component, at[component] % table.shape[component])
        return units[table.faces[component, at]]

    if table.periodic[axis]:
        low = (node - 1) % cells
        high = node % cells
    elif 0 < node < cells:
        low = node - 1
        high = node
    else:
        side = int(node > 0)
        sticks = table.sides[axis][side] in (dp.no_slip, dp.inflow)
        if sticks:
            return np.zeros(len(units))
        return weights((cells - 1) * side)
    return (weights(low) * widths[high] + weights(high) * widths[low]) / (widths[low] + widths[high])


# ---- time steps and roots ------------------------------------------------------------------------------------------


def newton(residual, jacobian, start):
    """Return the root: iterations on numbers, then two on the tape, which make its derivatives exact to order 3."""
    x = start
    for _ in range(100):
        change = np.linalg.solve(jacobian(x, constant_part), residual(x, constant_part))
        x = x - change
        if np.max(np.abs(change), initial=0.0) <= 1e-12 * (1 + np.max(np.abs(x), initial=0.0)):
            break
    else:
        raise Discarded
    for _ in range(2):
        x = x - anp.linalg.solve(jacobian(x, traced), residual(x, traced))
    return x


def traced(x):
    return x


def phi(order, z):
    """Return the function phi of a matrix of size below 2, by its power series: sum of z^j / (j + order)!."""
    term = np.eye(len(z)) / float(np.prod(np.arange(1.0, order + 1)))
    result = term
    for j in range(1, 26):
        term = anp.dot(term, z) / (j + order)
        result = result + term
    return result


class Equation:
    """u' = nu A u + n(u), the reaction n(u) = r u - u^3 + f, on flat arrays of the twin."""

    def __init__(self, A, p):
        self.A, self.p, self.eye = A, p, np.eye(len(A))

    def reaction(self, u, of=traced):
        p = {name: of(value) for name, value in self.p.items()}
        return p["r"] * u - u**3 + p["f"]

    def rate(self, u, of=traced):
        return of(self.p["nu"]) * anp.dot(self.A, u) + self.reaction(u, of)

    def slope(self, u, of=traced):
        return of(self.p["nu"]) * self.A + anp.diag(of(self.p["r"]) - 3 * u**2)

    def linear_solve(self, z, b):
        return anp.linalg.solve(self.eye - z * self.A, b)

    def stage(self, weight, b, guess):
        """Return x of x - weight rate(x) = b."""

        def residual(x, of):
            return x - of(weight) * self.rate(x, of) - of(b)

        def jacobian(x, of):
            return self.eye - of(weight) * self.slope(x, of)

        return newton(residual, jacobian, constant_part(guess))


def euler(equation, u, h):
    return u + h * equation.rate(u)


def heun(equation, u, h):
    first = equation.rate(u)
    return u + h / 2 * (first + equation.rate(u + h * first))


def ssprk3(equation, u, h):
    one = u + h * equation.rate(u)
    two = 3 / 4 * u + (one + h * equation.rate(one)) / 4
    return u / 3 + 2 / 3 * (two + h * equation.rate(two))


def rk4(equation, u, h):
    k1 = equation.rate(u)
    k2 = equation.rate(u + h / 2 * k1)
    k3 = equation.rate(u + h / 2 * k2)
    k4 = equation.rate(u + h * k3)
    return u + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def backward_euler(equation, u, h):
    return equation.stage(h, u, u)


def crank_nicolson(equation, u, h):
    return equation.stage(h / 2, u + h / 2 * equation.rate(u), u)


def tr_bdf2(equation, u, h):
    g = 2 - np.sqrt(2)
    middle = equation.stage(g / 2 * h, u + g / 2 * h * equation.rate(u), u)
    known = middle / (g * (2 - g)) - (1 - g) ** 2 / (g * (2 - g)) * u
    return equation.stage((1 - g) / (2 - g) * h, known, middle)


def imex(equation, u, h):
    d = 1 - np.sqrt(0.5)
    e = -np.sqrt(0.5)
    z = h * equation.p["nu"]
    first = equation.reaction(u)
    x = equation.linear_solve(d * z, u + h * d * first)
    explicit = h * (e * first + (1 - e) * equation.reaction(x))
    return equation.linear_solve(d * z, u + explicit + (1 - d) * z * anp.dot(equation.A, x))


def etdrk4(equation, u, h):
    """Formulas 26 to 29 of Cox and Matthews, J. Comput. Phys. 176 (2002), with functions phi."""
    z = h * equation.p["nu"] * equation.A
    n = equation.reaction
    half = phi(0, z / 2)
    whole = phi(0, z)
    weight = h / 2 * phi(1, z / 2)
    p1 = phi(1, z)
    p2 = phi(2, z)
    p3 = phi(3, z)
    a = anp.dot(half, u) + anp.dot(weight, n(u))
    b = anp.dot(half, u) + anp.dot(weight, n(a))
    c = anp.dot(half, a) + anp.dot(weight, 2 * n(b) - n(u))
    change = anp.dot(p1 - 3 * p2 + 4 * p3, n(u))
    change = change + anp.dot(2 * p2 - 4 * p3, n(a) + n(b)) + anp.dot(4 * p3 - p2, n(c))
    return anp.dot(whole, u) + h * change


def radau(equation, u, h):
    """Three stages U_i = u + h sum of a_ij f(U_j), the last of which is the new state (Hairer and Wanner)."""
    root = np.sqrt(6.0)
    weights = np.array(
        [
            [(88 - 7 * root) / 360, (296 - 169 * root) / 1800, (-2 + 3 * root) / 225],
            [(296 + 169 * root) / 1800, (88 + 7 * root) / 360, (-2 - 3 * root) / 225],
            [(16 - root) / 36, (16 + root) / 36, 1 / 9],
        ]
    )
    size = len(equation.A)

    def residual(stages, of):
        parts = [stages[i * size : (i + 1) * size] for i in range(3)]
        rates = [equation.rate(stage, of) for stage in parts]
        found = []
        for i in range(3):
            change = sum(weights[i, j] * rates[j] for j in range(3))
            found.append(parts[i] - of(u) - of(h) * change)
        return anp.concatenate(found)

    def jacobian(stages, of):
        slopes = [equation.slope(stages[i * size : (i + 1) * size], of) for i in range(3)]
        rows = []
        for i in range(3):
            rows.append(anp.concatenate([-of(h) * weights[i, j] * slopes[j] for j in range(3)], axis=1))
        return np.eye(3 * size) + anp.concatenate(rows, axis=0)

    start = np.concatenate([constant_part(u)] * 3)
    return newton(residual, jacobian, start)[2 * size :]


TIME_STEPS = {
    "radau": radau,
    "euler": euler,
    "heun": heun,
    "ssprk3": ssprk3,
    "rk4": rk4,
    "backward_euler": backward_euler,
    "crank_nicolson": crank_nicolson,
    "tr_bdf2": tr_bdf2,
    "imex": imex,
    "etdrk4": etdrk4,
}


def reaction(u, p):
    return p["r"] * u - u**3 + p["f"]


@dataclass(frozen=True)
class TimeStep(OnCells):
    """Map u to the state after one step of u' = nu L u + r u - u^3 + f."""

    method: str
    sides: tuple
    seed: int
    tolerance = 1e-7

    @property
    def batched(self):
        return self.method in ("euler", "heun", "ssprk3", "rk4")

    @property
    def refusals(self):
        if self.method != "radau":
            return ()
        return ((dp.errors.ConvergenceError, "does not converge in a step of .*; take a smaller dt"),)

    def _expression(self):
        return ("laplacian", self.sides, None, "neumann")

    def parameters(self, box):
        size = bound(box, self._expression())
        f = numbers(self.seed, box.shape)
        return {"nu": 0.4 / size, "r": 0.8, "f": f, "dt": 0.1 if self.method == "radau" else 0.3}

    def library(self, box):
        L = operator(box, self._expression())
        if self.method == "radau":

            def rate(u, p):
                return p["nu"] * L(u) + reaction(u, p)

            return dp.stepper("radau", rate, time_step_of, rtol=1e-12)
        return dp.stepper(self.method, reaction, time_step_of, linear=(L, viscosity_of), rtol=1e-12)

    def twin(self, box):
        A = matrix(box, self._expression())
        formula = TIME_STEPS[self.method]

        def act(u, p):
            p = {**p, "f": anp.ravel(p["f"])}
            equation = Equation(A, p)
            rows = anp.reshape(u, (-1, len(A)))
            moved = [formula(equation, rows[n], p["dt"]) for n in range(rows.shape[0])]
            return anp.reshape(anp.stack(moved), anp.shape(u))

        return act


def time_step_of(p):
    return p["dt"]


def viscosity_of(p):
    return p["nu"]


@dataclass(frozen=True)
class Root(OnCells):
    """Map u to x of x - nu L x + r x^3 = u, by `implicit` or `steady`."""

    sides: tuple
    entry: str  # "implicit" or "steady"
    method: str
    seed: int
    batched = False
    tolerance = 1e-7

    def _expression(self):
        return ("laplacian", self.sides, None, "neumann")

    def parameters(self, box):
        size = bound(box, self._expression())
        return {"nu": 0.5 / size, "r": 0.3 + 0.1 * np.sin(numbers(self.seed, box.shape))}

    def library(self, box):
        L = operator(box, self._expression())

        def guess(u):  # a root has the dtype of its guess
            return np.zeros(box.shape, constant_part(u).dtype)

        def residual(x, u, p):
            return x - p["nu"] * L(x) + p["r"] * x**3 - u

        if self.entry == "steady":
            return lambda u, p: dp.steady(residual, guess(u), u, p, method=self.method, rtol=1e-12)
        root = dp.implicit(residual, method=self.method, rtol=1e-12)
        return lambda u, p: root(guess(u), u, p)

    def twin(self, box):
        A = matrix(box, self._expression())
        eye = np.eye(len(A))

        def act(u, p):
            r = anp.ravel(p["r"])
            b = anp.ravel(u)

            def residual(x, of):
                return x - of(p["nu"]) * anp.dot(A, x) + of(r) * x**3 - of(b)

            def jacobian(x, of):
                return eye - of(p["nu"]) * A + anp.diag(3 * of(r) * x**2)

            return anp.reshape(newton(residual, jacobian, np.zeros(len(A))), box.shape)

        return act


# ---- composition ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sum(Ingredient):
    """Map u to a weighted sum of two ingredients of the same field, or one times the sine of the other."""

    one: Ingredient
    other: Ingredient
    multiplied: bool

    @property
    def source(self):
        return self.one.source

    @property
    def target(self):
        return self.one.target

    @property
    def order(self):
        return min(self.one.order, self.other.order)

    @property
    def batched(self):
        return self.one.batched and self.other.batched

    @property
    def complex(self):
        return self.one.complex and self.other.complex

    @property
    def tolerance(self):
        return max(self.one.tolerance, self.other.tolerance)

    @property
    def refusals(self):
        return (*self.one.refusals, *self.other.refusals)

    def parameters(self, box):
        return {**prefixed("one", self.one, box), **prefixed("other", self.other, box)}

    def _combined(self, one, other):
        def act(u, p):
            left = one(u, part_of(p, "one"))
            right = other(u, part_of(p, "other"))
            if self.multiplied:
                return anp.sin(left) * right
            return 0.7 * (left + right)

        return act

    def library(self, box):
        return self._combined(self.one.library(box), self.other.library(box))

    def twin(self, box):
        return self._combined(self.one.twin(box), self.other.twin(box))


def prefixed(prefix, ingredient, box):
    """Return the parameters of a part of an ingredient, under names that begin with a prefix."""
    return {f"{prefix} {name}": value for name, value in ingredient.parameters(box).items()}


def part_of(p, prefix):
    """Return the parameters whose names begin with a prefix, without it."""
    start = len(prefix) + 1
    return {name[start:]: value for name, value in p.items() if name.startswith(prefix + " ")}


@dataclass(frozen=True)
class Rollout(Ingredient):
    """Map u to the state after n steps, each a chain of ingredients with the same parameters."""

    chain: tuple
    n: int
    memory: object  # None, a text, or a number of states for which there is room
    keep: object  # "last", "all", "function", or a tuple of numbers of steps
    truncate: int | None
    inputs: bool
    tree: bool  # whether the state is a dict of the field, a number and a text
    seed: int

    @property
    def source(self):
        return self.chain[0].source

    @property
    def target(self):
        return self.source

    @property
    def order(self):
        return min(part.order for part in self.chain)

    @property
    def batched(self):
        return all(part.batched for part in self.chain)

    @property
    def complex(self):
        return all(part.complex for part in self.chain)

    @property
    def tolerance(self):
        return 10 * max(part.tolerance for part in self.chain)

    @property
    def refusals(self):
        small_budget = (ValueError, "rollout cannot work within memory=")
        return (small_budget, *(refusal for part in self.chain for refusal in part.refusals))

    def parameters(self, box):
        values = {}
        for number, part in enumerate(self.chain):
            values.update(prefixed(f"part {number}", part, box))
        if self.inputs:
            values["inputs"] = 0.1 * numbers(self.seed, (self.n, *box.field_shape(self.source)))
            values["scales"] = 0.1 * numbers(self.seed, self.n)
        return values

    def _weights(self):
        count = self.n + 1 if self.keep in ("all", "function") else len(self.keep)
        return 1.0 / (1.0 + np.arange(count))

    def _summed(self, states):
        """Return the weighted sum over the kept states."""
        total = 0.0
        for weight, number in zip(self._weights(), range(len(self._weights()))):
            total = total + float(weight) * states[number]
        return total

    def _budget(self, u, p, inputs):
        """Return the argument `memory`: states are kept beside parameters, inputs and their gradients."""
        if not isinstance(self.memory, int):
            return self.memory
        beside = sum(constant_part(value).nbytes for value in p.values() if anp.ndim(value))
        beside += sum(constant_part(value).nbytes for value in (inputs or {}).values())
        return self.memory * constant_part(u).nbytes + 2 * beside + 800

    def _advance(self, parts):
        def advance(u, p):
            for number, part in enumerate(parts):
                u = part(u, part_of(p, f"part {number}"))
            return u

        return advance

    def library(self, box):
        advance = self._advance([part.library(box) for part in self.chain])
        keep = list(self.keep) if isinstance(self.keep, tuple) else self.keep

        def kept(index, state):
            u = state["field"] if self.tree else state
            return {"at": index, "sine": anp.sin(u)}

        if keep == "function":
            keep = kept

        def step(state, p, *added):
            u = state["field"] if self.tree else state
            u = advance(u, p)
            if added:
                u = u + added[0]["inputs"] * added[0]["scales"]
            if self.tree:
                return {"time": state["time"] + 0.5, "field": u, "name": "ink"}
            return u

        def act(u, p):
            p = dict(p)
            inputs = None
            if self.inputs:
                inputs = {"scales": p.pop("scales"), "inputs": p.pop("inputs")}
            state = {"field": u, "time": 0.0, "name": "ink"} if self.tree else u
            memory = self._budget(u, p, inputs)
            end = dp.rollout(step, state, p, self.n, inputs, memory=memory, keep=keep, truncate=self.truncate)
            if self.keep == "function":
                return self._summed([one["sine"] for one in end])
            end = end["field"] if self.tree else end
            if self.keep == "last":
                return end
            return self._summed(end)

        return act

    def twin(self, box):
        advance = self._advance([part.twin(box) for part in self.chain])

        def act(u, p):
            states = [u]
            for step in range(self.n):
                if self.truncate and 0 < step and (self.n - step) % self.truncate == 0:
                    u = constant_part(u)
                u = advance(u, p)
                if self.inputs:
                    u = u + p["inputs"][step] * p["scales"][step]
                states.append(u)
            if self.keep == "last":
                return u
            if self.keep == "function":
                return self._summed([anp.sin(state) for state in states])
            chosen = states if self.keep == "all" else [states[number] for number in self.keep]
            return self._summed(chosen)

        return act
