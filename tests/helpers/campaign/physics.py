"""Ingredients of physics: semi-Lagrangian transport, conservation laws, flows, waves, several fields, networks."""

from dataclasses import dataclass

import autograd.numpy as anp
import numpy as np
from semi_lagrangian_reference import moved as lagrangian_twin

import sparsedp as dp
from campaign.boxes import boundary, condition, dense, numbers, obstacle
from campaign.ingredients import (
    Equation,
    Ingredient,
    OnCells,
    cell_volumes,
    convection_factors,
    flat_product,
    newton,
    phi,
    reaction,
    rk4,
    time_step_of,
)
from campaign.operators import bound, matrix, operator

FIRST_ORDER = ((dp.errors.DerivativeError, "second order|first derivatives|of a derivative"),)


# ---- transport that looks back -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Lagrangian(Ingredient):
    """One step of semi-Lagrangian or MacCormack transport."""

    scheme: str
    side: str
    velocity: str
    of: str
    interpolation: str
    backtrace: str
    clamp: bool
    seed: int
    batched = False
    order = 1
    refusals = FIRST_ORDER

    @property
    def source(self):
        return self.of

    @property
    def target(self):
        return self.of

    def _move(self, box):
        options = {"clamp": self.clamp} if self.scheme == "maccormack" else {}
        return dp.transport(
            box.grid(),
            self.scheme,
            condition(self.side),
            self.velocity,
            self.of,
            interpolation=self.interpolation,
            backtrace=self.backtrace,
            **options,
        )

    def parameters(self, box):
        shape = box.field_shape("faces") if self.velocity == "faces" else (box.dim, *box.shape)
        return {"v": 0.8 * numbers(self.seed, shape), "dt": 0.37, "inflow": 0.4}

    def library(self, box):
        move = self._move(box)
        step = move._rule  # move itself refuses an inflow that no side uses
        return lambda u, p: step(u, p["v"], p["dt"], p["inflow"])

    def twin(self, box):
        move = self._move(box)
        return lambda u, p: lagrangian_twin(move, u, p["v"], p["dt"], p["inflow"])


# ---- conservation laws ---------------------------------------------------------------------------------------------


def water_flux(u, p, axis):
    velocity = u[1 + axis] / u[0]
    rows = []
    for number in range(len(u)):
        row = u[number] * velocity
        rows.append(row + 0.5 * p["a"] * u[0] ** 2 if number == 1 + axis else row)
    return anp.stack(rows)


def water_speed(u, p, axis):
    velocity = u[1 + axis] / u[0]
    wave = anp.sqrt(p["a"] * u[0])
    return velocity - wave, velocity + wave


def largest_water_speed(u, p, axis):
    return anp.abs(u[1 + axis] / u[0]) + anp.sqrt(p["a"] * u[0])


@dataclass(frozen=True)
class Law(OnCells):
    """Map u to u + dt times the sum of the rates of shallow water whose depth and momenta are made of u."""

    scheme: str
    sides: tuple  # for each axis None or a pair of "outflow", "free_slip", "inflow"
    pair: bool  # whether the speed is a pair (HLL), or one number (Rusanov)
    pushed: bool  # whether there is a source term
    seed: int
    batched = False

    @property
    def order(self):
        if self.scheme == "van_leer":
            return 1
        return 2

    def parameters(self, box):
        return {"a": 1.3, "dt": 0.05, "push": 0.2 * numbers(self.seed, box.shape)}

    def _entering(self, box):
        return np.array([1.7, *([0.3] * box.dim)]).reshape(-1, *[1] * box.dim)

    def _state(self, u, box):
        depth = 1.5 + 0.3 * anp.tanh(u)
        return anp.stack([depth, *(0.4 * anp.sin((1 + axis) * u + axis) for axis in range(box.dim))])

    def _push(self, u, p):
        return anp.stack([0.0 * u[0], *(p["push"] * u[0] for _ in range(len(u) - 1))])

    def library(self, box):
        words = {side for pair in self.sides for side in pair or ()}
        law = dp.conservation_law(
            box.grid(),
            water_flux,
            water_speed if self.pair else largest_water_speed,
            scheme=self.scheme,
            boundary=boundary(box, self.sides),
            momentum=tuple(range(1, 1 + box.dim)) if "free_slip" in words else None,
            inflow=self._entering(box) if "inflow" in words else None,
            source=self._push if self.pushed else None,
        )
        return lambda u, p: self._changed(u, p, law(self._state(u, box), p), box)

    def _changed(self, u, p, rate, box):
        weights = (1.0 + np.arange(1 + box.dim)).reshape(-1, *[1] * box.dim)
        return u + p["dt"] * anp.sum(weights * rate, axis=0)

    def twin(self, box):
        speed = water_speed if self.pair else largest_water_speed
        widths = box.widths()

        def act(u, p):
            state = self._state(u, box)
            rate = self._push(state, p) if self.pushed else 0.0
            for axis in range(box.dim):
                wide, h = with_ghosts(state, axis, self.sides[axis], widths[axis], self._entering(box))
                below, above = values_at_faces(wide, axis + 1, h, self.scheme == "van_leer")
                flow = flux_between(below, above, lambda x: water_flux(x, p, axis), lambda x: speed(x, p, axis))
                cells = widths[axis].reshape([-1 if a == axis else 1 for a in range(box.dim)])
                rate = rate - (part(flow, axis + 1, 1, None) - part(flow, axis + 1, 0, -1)) / cells
            return self._changed(u, p, rate, box)

        return act


def part(x, axis, start, stop):
    return x[tuple(slice(start, stop) if a == axis else slice(None) for a in range(anp.ndim(x)))]


def with_ghosts(state, axis, sides, widths, entering):
    """Return the state and the widths with two further cells at both ends of an axis."""
    cells = len(widths)
    ends = []
    for side in range(2):
        word = None if sides is None else sides[side]
        for step in (2, 1) if side == 0 else (1, 2):
            inside = step - 1 if side == 0 else cells - step  # the cell as far from the wall
            if word is None:
                inside = (-step if side == 0 else step - 1) % cells
            if word in ("outflow", "inflow"):
                inside = 0 if side == 0 else cells - 1
            if word == "free_slip":  # cells are mirrored again where the axis is short
                inside = mirrored(-step if side == 0 else cells + step - 1, cells)
            ghost = part(state, axis + 1, inside, inside + 1)
            if word == "free_slip" and flips(-step if side == 0 else cells + step - 1, cells):
                signs = np.where(np.arange(state.shape[0]) == 1 + axis, -1.0, 1.0)
                ghost = ghost * signs.reshape(-1, *[1] * (anp.ndim(state) - 1))
            if word == "inflow":
                ghost = 0.0 * ghost + entering
            ends.append((ghost, widths[inside]))
    wide = anp.concatenate([ends[0][0], ends[1][0], state, ends[2][0], ends[3][0]], axis + 1)
    return wide, np.concatenate([[ends[0][1], ends[1][1]], widths, [ends[2][1], ends[3][1]]])


def mirrored(index, cells):
    """Return the cell that an index beyond the walls mirrors."""
    while not 0 <= index < cells:
        index = -1 - index if index < 0 else 2 * cells - 1 - index
    return index


def flips(index, cells):
    """Return whether an index is mirrored an odd number of times."""
    count = 0
    while not 0 <= index < cells:
        index = -1 - index if index < 0 else 2 * cells - 1 - index
        count += 1
    return count % 2 == 1


def values_at_faces(wide, axis, h, limited):
    """Return the values below and above each face, from limited slopes in the cells."""
    inner = part(wide, axis, 1, -1)
    slope = 0.0 * inner
    if limited:
        line = [-1 if a == axis else 1 for a in range(anp.ndim(wide))]
        c = ((h[1:-1] + h[:-2]) / h[1:-1]).reshape(line)
        e = ((h[1:-1] + h[2:]) / h[1:-1]).reshape(line)
        a = inner - part(wide, axis, 0, -2)
        b = part(wide, axis, 2, None) - inner
        same = a * b > 0
        a = anp.where(same, a, 1.0)
        b = anp.where(same, b, 1.0)
        top = a * b * (a * e**2 + b * c**2)
        slope = anp.where(same, top / (a**2 * e**2 + (c + e - 2) * c * e * a * b + b**2 * c**2), 0.0)
    return part(inner + slope, axis, 0, -1), part(inner - slope, axis, 1, None)


def flux_between(below, above, flux, speed):
    """Return the flux of Harten, Lax and van Leer."""
    slow_below, fast_below = pair_of(speed(below))
    slow_above, fast_above = pair_of(speed(above))
    a = anp.minimum(anp.minimum(slow_below, slow_above), 0.0)
    b = anp.maximum(anp.maximum(fast_below, fast_above), 0.0)
    return (b * flux(below) - a * flux(above) + a * b * (above - below)) / (b - a)


def pair_of(speed):
    if isinstance(speed, tuple):
        return speed
    return (-speed, speed)


# ---- flow ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Flow(Ingredient):
    """Map v to the velocity after steps of `flow_step`, started from v, with a force and a viscosity."""

    sides: tuple
    solid: int | None
    viscosity: str  # "none", "explicit", "implicit" or "params"
    convective: bool
    heat: bool
    steps: int
    seed: int
    source = "faces"
    target = "faces"
    batched = False
    tolerance = 1e-7

    def parameters(self, box):
        values = {"push": 0.2 * numbers(self.seed, box.field_shape("faces"))}
        if self.viscosity == "params":
            values["nu"] = self._viscosity(box)
        if self.heat:
            values["heat"] = numbers(self.seed + 1, box.shape)
        return values

    def _dt(self):
        return 0.02

    def _viscosity(self, box):
        size = bound(box, ("face_laplacian", self.sides, self.solid, "no_slip"))
        walls = tuple(pair and ("dirichlet", "dirichlet") for pair in self.sides)
        size = max(size, bound(box, ("laplacian", walls, None, "neumann")))
        if self.viscosity != "implicit":
            return 0.1 / (size * self._dt())
        return 5.0 / (size * self._dt())

    def library(self, box):
        grid = box.grid()
        options = {}
        if self.viscosity == "params":
            options["viscosity"] = viscosity_in
        elif self.viscosity != "none":
            options["viscosity"] = self._viscosity(box)
        if self.heat:
            options["scalars"] = {"heat": {"diffusivity": 0.05 * self._diffusivity(box), "source": cooling}}
            up = dp.average(grid)
            options["force"] = lambda v, s, p: p["push"] * anp.cos(v) + 0.1 * up(s["heat"])
        else:
            options["force"] = lambda v, p: p["push"] * anp.cos(v)
        step = dp.flow_step(
            grid,
            self._dt(),
            boundary=boundary(box, self.sides),
            solid=obstacle(box, self.solid),
            implicit=self.viscosity == "implicit",
            convective=self.convective,
            unstable="allow",
            **options,
        )

        def act(v, p):
            state = step.start(v, p, {"heat": p["heat"]}) if self.heat else step.start(v, p)
            state = dp.rollout(step, state, p, self.steps)
            v = state["v"] + 0.1 * dp.average(grid)(state["p"])
            if self.heat:
                return v + 0.1 * dp.average(grid)(state["s"]["heat"])
            return v

        return act

    def _diffusivity(self, box):
        neumann = tuple(pair and ("neumann", "neumann") for pair in self.sides)
        return 1 / (self._dt() * bound(box, ("laplacian", neumann, None, "neumann")))

    def twin(self, box):
        table = dense(box, self.sides, self.solid)
        dt = self._dt()
        plain = dense(box)
        projector, pressure = table.projection()
        opened = np.diag(1.0 * table.flags((dp.inflow, dp.outflow)))
        slope = (table.flags((dp.outflow, dp.inflow))[:, None]) * table.pressure().gradient()
        free = np.diag(1.0 * table.flags((dp.outflow,)))
        viscous = table.viscous()
        carried, carrying, balance = convection_factors(box, self.sides, self.solid)
        average = plain.average()
        divergence = plain.divergence()
        closed = dense(box, None, self.solid)
        heat_diffusion = 0.05 * self._diffusivity(box) * divergence @ closed.gradient()

        def rates(v, heat, p):
            a = -anp.dot(balance, anp.dot(carried, v) * anp.dot(carrying, v)) if self.convective else 0.0 * v
            force = p["push"] * anp.cos(v)
            if self.heat:
                force = force + 0.1 * anp.dot(average, heat)
            a = a + anp.dot(free, force)
            if self.viscosity in ("explicit", "params"):
                nu = p["nu"] if self.viscosity == "params" else self._viscosity(box)
                a = a + nu * anp.dot(viscous, v)
            r = None
            if self.heat:
                flow = v * anp.dot(average, heat)
                r = -anp.dot(divergence, flow) - 0.3 * heat
                if self.viscosity != "implicit":
                    r = r + anp.dot(heat_diffusion, heat)
            return a, r

        def act(v, p):
            v = anp.dot(projector, v)
            heat = anp.ravel(p["heat"]) if self.heat else None
            q = np.zeros(divergence.shape[0])
            a_before, r_before = rates(v, heat, p)
            for _ in range(self.steps):
                a, r = rates(v, heat, p)
                ahead = v + dt * (1.5 * a - 0.5 * a_before - anp.dot(slope, q))
                if self.viscosity == "implicit":
                    nu = self._viscosity(box)
                    ahead = trapezoidal(nu * viscous, dt, ahead, v)
                correction = anp.dot(pressure, ahead)
                if self.heat:
                    changed = heat + dt * (1.5 * r - 0.5 * r_before)
                    if self.viscosity == "implicit":
                        changed = trapezoidal(heat_diffusion, dt, changed, heat)
                    heat = changed
                v = anp.dot(opened, ahead) + anp.dot(slope, correction)
                q = q - correction / dt
                a_before = a
                r_before = r
            result = v + 0.1 * anp.dot(average, q)
            if self.heat:
                return result + 0.1 * anp.dot(average, heat)
            return result

        return act


def trapezoidal(L, dt, ahead, before):
    """Return x of x = ahead + dt L (before + x) / 2."""
    return anp.dot(np.linalg.inv(np.eye(len(L)) - 0.5 * dt * L), ahead + 0.5 * dt * anp.dot(L, before))


def viscosity_in(p):
    return p["nu"]


def cooling(s, p):
    return -0.3 * s["heat"]


# ---- several fields and waves --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TwoFields(OnCells):
    """Map u to u + w after one step of two fields that react and diffuse, as a dict."""

    method: str
    sides: tuple
    seed: int
    batched = False
    tolerance = 1e-7

    def _expression(self):
        return ("laplacian", self.sides, None, "neumann")

    def parameters(self, box):
        return {"w": numbers(self.seed, box.shape), "k": 0.4, "dt": 0.3, "nu": 0.4 / bound(box, self._expression())}

    def _react(self, u, w, p):
        return p["k"] * u * w - u**3, u - p["k"] * w

    def library(self, box):
        L = operator(box, self._expression())

        def rate(state, p):
            of_u, of_w = self._react(state["u"], state["w"], p)
            return {"w": of_w, "u": of_u}

        linear = {"u": (L, lambda p: p["nu"]), "w": None}
        step = dp.stepper(self.method, rate, lambda p: p["dt"], linear=linear, rtol=1e-12)

        def act(u, p):
            end = step({"u": u, "w": p["w"]}, p)
            return end["u"] + 0.5 * end["w"]

        return act

    def twin(self, box):
        A = matrix(box, self._expression())
        size = len(A)
        eye = np.eye(size)
        zero = np.zeros((size, size))

        def act(u, p):
            z = anp.concatenate([anp.ravel(u), anp.ravel(p["w"])])
            h = p["dt"]

            def reaction(z):
                of_u, of_w = self._react(z[:size], z[size:], p)
                return anp.concatenate([of_u, of_w])

            def diffusion(z):
                return p["nu"] * anp.concatenate([anp.dot(A, z[:size]), 0.0 * z[size:]])

            def whole(z):
                return reaction(z) + diffusion(z)

            if self.method == "rk4":
                k1 = whole(z)
                k2 = whole(z + h / 2 * k1)
                k3 = whole(z + h / 2 * k2)
                k4 = whole(z + h * k3)
                z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            elif self.method == "imex":
                d = 1 - np.sqrt(0.5)
                e = -np.sqrt(0.5)
                top = anp.concatenate([eye - d * h * p["nu"] * A, zero], axis=1)
                system = anp.concatenate([top, np.concatenate([zero, eye], axis=1)], axis=0)
                first = reaction(z)
                x = anp.linalg.solve(system, z + h * d * first)
                explicit = h * (e * first + (1 - e) * reaction(x))
                z = anp.linalg.solve(system, z + explicit + h * (1 - d) * diffusion(x))
            else:
                z = self._backward_euler(z, A, p)
            return anp.reshape(z[:size] + 0.5 * z[size:], box.shape)

        return act

    def _backward_euler(self, z, A, p):
        size = len(A)

        def residual(x, of):
            k = of(p["k"])
            h = of(p["dt"])
            nu = of(p["nu"])
            u = x[:size]
            w = x[size:]
            of_u, of_w = self._react(u, w, {"k": k})
            return x - h * anp.concatenate([of_u + nu * anp.dot(A, u), of_w]) - of(z)

        def jacobian(x, of):
            k = of(p["k"])
            h = of(p["dt"])
            nu = of(p["nu"])
            u = x[:size]
            w = x[size:]
            eye = np.eye(size)
            top = anp.concatenate([anp.diag(k * w - 3 * u**2) + nu * A, anp.diag(k * u)], axis=1)
            bottom = anp.concatenate([eye, -k * eye], axis=1)
            return np.eye(2 * size) - h * anp.concatenate([top, bottom], axis=0)

        start = np.zeros(2 * size) + 0.1
        return newton(residual, jacobian, start)


@dataclass(frozen=True)
class Waves(OnCells):
    """Map p to p after steps of leapfrog of p' = -c D v, v' = -G p, with damping or without."""

    damped: bool
    memory: object
    steps: int
    seed: int
    batched = False
    refusals = ((dp.errors.DerivativeError, "reversed steps end"),)

    def parameters(self, box):
        return {"v": numbers(self.seed, box.field_shape("faces")), "c": 0.8, "dt": 0.3 / np.sqrt(self._size(box))}

    def _size(self, box):
        neumann = tuple(None if periodic else ("neumann", "neumann") for periodic in box.periodic)
        return bound(box, ("laplacian", neumann, None, "neumann"))

    def library(self, box):
        D = dp.divergence(box.grid())
        G = dp.gradient(box.grid())
        damping = (0.2, 0.3) if self.damped else None
        step = dp.stepper(
            "leapfrog", (lambda v, p: -p["c"] * D(v), lambda q, p: -G(q)), lambda p: p["dt"], damping=damping
        )

        def act(u, p):
            state = (u, p["v"])
            end = dp.rollout(step, state, {"c": p["c"], "dt": p["dt"]}, self.steps, memory=self.memory)
            return end[0] + D(end[1])

        return act

    def twin(self, box):
        table = dense(box)
        D = table.divergence()
        G = table.gradient()
        a, b = (0.2, 0.3) if self.damped else (0.0, 0.0)

        def act(u, p):
            q = anp.ravel(u)
            v = p["v"]
            h = p["dt"]
            for _ in range(self.steps):
                v = ((1 - b * h / 2) * v - h * anp.dot(G, q)) / (1 + b * h / 2)
                q = ((1 - a * h / 2) * q - h * p["c"] * anp.dot(D, v)) / (1 + a * h / 2)
            return anp.reshape(q + anp.dot(D, v), box.shape)

        return act


TOO_SHARP_FOR_FLOAT32 = ((ValueError, "cannot meet the tolerance 1e-08 with a state of float32"),)


class ErrorControlled(OnCells):
    """A step with error control, whose derivative may be refused where the tolerance is too coarse for it."""

    own_refusals = ()

    @property
    def refusals(self):
        return ((dp.errors.DerivativeError, "tolerance"), *self.own_refusals)


@dataclass(frozen=True)
class Adaptive(ErrorControlled):
    """Map u to the state after an interval that is crossed with error control, beside many small steps of rk4."""

    method: str
    sides: tuple
    seed: int
    batched = False
    tolerance = 1e-3

    def _expression(self):
        return ("laplacian", self.sides, None, "neumann")

    def parameters(self, box):
        size = bound(box, self._expression())
        return {"nu": 0.6 / size, "r": 0.8, "f": numbers(self.seed, box.shape), "dt": 0.4}

    def library(self, box):
        L = operator(box, self._expression())

        def rate(u, p):
            return p["nu"] * L(u) + reaction(u, p)

        return dp.stepper(self.method, rate, time_step_of, tolerance=1e-6 if self.method in SHARP else 1e-5)

    def twin(self, box):
        A = matrix(box, self._expression())

        def act(u, p):
            equation = Equation(A, {**p, "f": anp.ravel(p["f"])})
            u = anp.ravel(u)
            for _ in range(24):
                u = rk4(equation, u, p["dt"] / 24)
            return anp.reshape(u, box.shape)

        return act


SHARP = ("rk4", "ssprk3", "radau")


@dataclass(frozen=True)
class Switched(ErrorControlled):
    """Map u to the state after an interval in which a source is switched off, beside the closed form.

    u' = -k u + f until the time `off`, u' = -k u after it.
    """

    method: str
    seed: int
    batched = False
    tolerance = 1e-4
    own_refusals = TOO_SHARP_FOR_FLOAT32

    def parameters(self, box):
        return {"k": 0.9, "f": 1 + 0.3 * np.sin(numbers(self.seed, box.shape)), "off": 0.23}

    def library(self, box):
        def rate(u, p, t):
            return -p["k"] * u + p["f"] * np.where(t < p["off"], 1.0, 0.0)

        step = dp.stepper(self.method, rate, 0.6, tolerance=1e-8, breaks=switch_of)
        return lambda u, p: step((u, 0.0), p)[0]

    def twin(self, box):
        def act(u, p):
            k = p["k"]
            off = p["off"]
            at_switch = u * anp.exp(-k * off) + p["f"] / k * (1 - anp.exp(-k * off))
            return at_switch * anp.exp(-k * (0.6 - off))

        return act


def switch_of(p):
    return [p["off"]]


@dataclass(frozen=True)
class Ball(ErrorControlled):
    """Map u to u h + v of a ball that bounces once, started from a height that depends on the mean of u."""

    method: str
    batched = False
    tolerance = 1e-4
    own_refusals = TOO_SHARP_FOR_FLOAT32

    def parameters(self, box):
        return {"g": 9.81, "e": 0.8}

    def _start(self, u):
        return 0.5 + 0.1 * anp.tanh(anp.mean(u)), 0.3 * anp.sin(anp.sum(u))

    def library(self, box):
        def rate(state, p):
            return anp.stack([state[1], -p["g"] + 0.0 * state[1]])

        def touches(state, p):
            return state[0]

        def bounced(state, p):
            return anp.stack([0.0 * state[0], -p["e"] * state[1]])

        touches.direction = -1
        step = dp.stepper(self.method, rate, 0.6, tolerance=1e-8, events=(touches, bounced))

        def act(u, p):
            end = step((anp.stack(self._start(u)), 0.0), p)[0]
            return u * end[0] + end[1]

        return act

    def twin(self, box):
        def act(u, p):
            height, speed = self._start(u)
            impact = anp.sqrt(speed**2 + 2 * p["g"] * height)
            rest = 0.6 - (speed + impact) / p["g"]
            after = p["e"] * impact
            return u * (after * rest - 0.5 * p["g"] * rest**2) + after - p["g"] * rest

        return act


@dataclass(frozen=True)
class Damped(OnCells):
    """Map u to real and imaginary parts of x of (shift - D k G) x = u, k and the shift complex."""

    sides: tuple
    method: str
    seed: int
    batched = False
    tolerance = 1e-7

    def parameters(self, box):
        return {"k": 1 + 0.3 * np.sin(numbers(self.seed, box.field_shape("faces"))), "shift": 0.7}

    def library(self, box):
        grid = box.grid()
        solve = dp.elliptic_solver(
            dp.divergence(grid), dp.gradient(grid, boundary(box, self.sides)), self.method, rtol=1e-12
        )

        def act(u, p):
            x = solve(p["k"] * (1.0 + 0.2j), u, p["shift"] * (0.5 - 1.0j))
            return anp.real(x) + 0.5 * anp.imag(x)

        return act

    def twin(self, box):
        table = dense(box, self.sides)
        D = table.divergence()
        G = table.gradient()
        eye = np.eye(len(D))

        def act(u, p):
            diffusion = -anp.dot(D * p["k"], G)
            real = diffusion + 0.5 * p["shift"] * eye
            imaginary = 0.2 * diffusion - p["shift"] * eye
            top = anp.concatenate([real, -imaginary], axis=1)
            bottom = anp.concatenate([imaginary, real], axis=1)
            data = anp.concatenate([anp.ravel(u), 0.0 * anp.ravel(u)])
            x = anp.linalg.solve(anp.concatenate([top, bottom], axis=0), data)
            return anp.reshape(x[: len(eye)] + 0.5 * x[len(eye) :], box.shape)

        return act


# ---- functions of operators, networks, readings ----------------------------------------------------------


@dataclass(frozen=True)
class Spectral(OnCells):
    """Map u to f(-L / scale) u, f the exponential, a power or a function."""

    sides: tuple
    kind: str  # "exponential", "power" or "function"
    complex = True

    def _expression(self):
        return ("laplacian", self.sides, None, "neumann")

    def library(self, box):
        scaled = (1 / bound(box, self._expression())) * operator(box, self._expression())
        if self.kind == "exponential":
            acts = dp.matrix_exponential(scaled, 0.7)
        elif self.kind == "power":
            acts = dp.matrix_power(dp.identity(box.grid().cells) - scaled, 0.5)
        else:
            acts = dp.matrix_function(scaled, np.cos)
        return lambda u, p: acts(u)

    def twin(self, box):
        scaled = matrix(box, self._expression()) / bound(box, self._expression())
        values, vectors = np.linalg.eig(scaled)
        if self.kind == "exponential":
            result = phi(0, 0.7 * scaled)
        else:
            new = np.sqrt(1 - values) if self.kind == "power" else np.cos(values)
            result = np.real(vectors @ np.diag(new) @ np.linalg.inv(vectors))
        return lambda u, p: flat_product(result, u, box.shape, box.shape)


ACTIVATIONS = {
    "tanh": anp.tanh,
    "relu": lambda x: anp.maximum(x, 0.0),
    "softplus": lambda x: anp.log1p(anp.exp(x)),
}


@dataclass(frozen=True)
class Network(OnCells):
    """Map u to u + a layer of convolution, an activation, and one back to one channel."""

    padding: str
    activation: str
    seed: int
    batched = False

    def parameters(self, box):
        widths = (3,) * box.dim
        return {
            "weight": 0.3 * numbers(self.seed, (2, 1, *widths)),
            "bias": 0.1 * numbers(self.seed + 1, (2,)),
            "mix": 0.5 * numbers(self.seed + 2, (1, 2, *((1,) * box.dim))),
            "shift": 0.1 * numbers(self.seed + 3, (1,)),
        }

    def library(self, box):
        activation = getattr(dp.network, self.activation)

        def act(u, p):
            x = anp.reshape(u, (1, 1, *box.shape))
            x = activation(dp.network.convolution({"weight": p["weight"], "bias": p["bias"]}, x, self.padding))
            x = dp.network.convolution({"weight": p["mix"], "bias": p["shift"]}, x, self.padding)
            return u + x[0, 0]

        return act

    def twin(self, box):
        activation = ACTIVATIONS[self.activation]

        def act(u, p):
            hidden = []
            for channel in range(2):
                total = correlated(u, p["weight"][channel, 0], self.padding) + p["bias"][channel]
                hidden.append(activation(total))
            mixed = sum(hidden[channel] * anp.ravel(p["mix"][0, channel])[0] for channel in range(2))
            return u + mixed + p["shift"][0]

        return act


def correlated(u, weight, padding):
    """Return the sum of shifted fields, one for each entry of a filter of odd widths."""
    total = 0.0
    for place in np.ndindex(*anp.shape(weight)):
        shifted = u
        for axis, index in enumerate(place):
            cells = u.shape[axis]
            at = np.arange(cells) + index - anp.shape(weight)[axis] // 2
            inside = ((at >= 0) & (at < cells)).astype(float) if padding == "zero" else np.ones(cells)
            at = at % cells if padding == "periodic" else np.clip(at, 0, cells - 1)
            chosen = tuple(at if a == axis else slice(None) for a in range(anp.ndim(u)))
            shifted = shifted[chosen] * inside.reshape([-1 if a == axis else 1 for a in range(anp.ndim(u))])
        total = total + weight[place] * shifted
    return total


@dataclass(frozen=True)
class Reading(Ingredient):
    """The last part of a chain: numbers that are read off a field: "flux", "sample", "component" or "restrict"."""

    name: str
    source: str
    seed: int
    target = "values"
    complex = True

    def library(self, box):
        grid = box.grid()
        if self.name == "flux":
            acts = dp.flux(grid, self._cells(box))
        elif self.name == "component":
            acts = dp.component(grid, self.seed % box.dim)
        elif self.name == "restrict":
            acts = dp.restrict(grid, self._factors(box))
        else:
            acts = operator(box, ("probe", self.seed))
        return lambda u, p: acts(u)

    def _cells(self, box):
        return np.random.default_rng(self.seed).random(box.shape) < 0.5

    def _factors(self, box):
        return tuple(2 if cells % 2 == 0 else 1 for cells in box.shape)

    def twin(self, box):
        shape = box.field_shape(self.source)
        if self.name == "flux":
            volumes = cell_volumes(box) * self._cells(box).ravel()
            row = (volumes @ dense(box).divergence())[None]
            return lambda u, p: flat_product(row, u, shape, ())
        if self.name == "component":
            axis = self.seed % box.dim
            faces = dense(box).faces
            chosen = [number for (a, _), number in faces.items() if a == axis]
            result_shape = [n + (a == axis and not box.periodic[a]) for a, n in enumerate(box.shape)]
            return lambda u, p: flat_product(np.eye(len(faces))[chosen], u, shape, tuple(result_shape))
        if self.name == "restrict":
            factors = self._factors(box)
            means = matrix(box, ("blocks", factors))
            starts = [slice(None, None, factor) for factor in factors]
            rows = means.reshape(*box.shape, -1)[tuple(starts)]
            coarse = rows.shape[:-1]
            return lambda u, p: flat_product(rows.reshape(-1, rows.shape[-1]), u, shape, coarse)
        return lambda u, p: flat_product(matrix(box, ("probe", self.seed)), u, shape, (3,))
