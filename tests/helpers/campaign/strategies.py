"""What Hypothesis draws: boxes, expressions of operators, ingredients, and whole scenes."""

from importlib.util import find_spec

import numpy as np
from hypothesis import strategies as st

from campaign import ingredients as parts
from campaign import physics
from campaign.boxes import Box
from campaign.operators import matrix, total
from campaign.scene import LAYOUTS, LOSSES, TREES, Scene
from sparsedp.kernels import compiled

BRIDGES = [name for name in ("torch", "jax") if find_spec(name)]
SEEDS = st.integers(0, 999)
MOST_STEPS_OF_A_MEMBER = 4  # of an ensemble: a few scenes with more would take half the time of a campaign
SIDES = st.sampled_from(["neumann", "dirichlet", (2.0, 0.5), (1.0, 2.0)])
WORDS = st.sampled_from(["no_slip", "free_slip"])
FLOW_WORDS = st.sampled_from(["no_slip", "free_slip", "outflow"])
SOLIDS = st.one_of(st.none(), SEEDS)


@st.composite
def boxes(draw, most=24, least_dim=1):
    """Small grids of one to three axes; axes of one cell, periodic and stretched ones among them."""
    dim = draw(st.integers(least_dim, 3))
    shape = []
    left = most
    for _ in range(dim):
        cells = draw(st.integers(1, max(1, min(6 if dim > 1 else 9, left))))
        shape.append(cells)
        left //= cells
    flags = st.tuples(*[st.booleans()] * dim)
    return Box(tuple(shape), draw(flags), draw(flags), draw(SEEDS))


@st.composite
def sides_of(draw, box, sides=SIDES):
    """A pair of conditions for each axis that has walls."""
    return tuple(None if periodic else (draw(sides), draw(sides)) for periodic in box.periodic)


def flow_sides(box):
    return sides_of(box, FLOW_WORDS)


# ---- operators -----------------------------------------------------------------------------------------------------


@st.composite
def expressions(draw, box, source, target, depth=2):
    """An expression of operators from one kind of field to another."""
    if source == target:
        names = ["diagonal", "mask", "matrix", "functions", "identity"]
        if source == "cells":
            names += ["laplacian", "laplacian", "upwind", "upwind", "blocks", "probe", "turn"]
        else:
            names += ["interior", "face_laplacian", "face_laplacian", "projection", "projection", "turn"]
    else:
        names = ["gradient", "average", "turned divergence"] if source == "cells" else ["divergence", "turned"]
    if depth:
        names += ["sum", "transpose", "product", "scale"]
    name = draw(st.sampled_from(names))
    other = "faces" if source == "cells" else "cells"
    inner = lambda one, two: draw(expressions(box, one, two, max(0, depth - 1)))
    if name == "sum":
        return ("sum", inner(source, target), inner(source, target))
    if name == "transpose":
        return ("transpose", inner(target, source))
    if name == "scale":
        return ("scale", draw(st.sampled_from([-1.0, 0.5, 2.0])), inner(source, target))
    if name == "product":
        middle = draw(st.sampled_from(["cells", "faces"]))
        return ("product", inner(middle, target), inner(source, middle))
    if name == "turn":
        return ("product", draw(expressions(box, other, source, 0)), draw(expressions(box, source, other, 0)))
    if name in ("diagonal", "mask", "matrix", "functions"):
        return (name, source, draw(SEEDS))
    if name == "identity":
        return (name, source)
    if name in ("gradient", "laplacian"):
        return (name, draw(sides_of(box)), draw(SOLIDS), draw(SIDES))
    if name == "average":
        return (name, draw(sides_of(box)))
    if name == "turned divergence":
        return ("transpose", ("divergence",))
    if name == "turned":
        one = draw(st.sampled_from(["gradient", "average"]))
        sides = draw(sides_of(box))
        return ("transpose", (one, sides) if one == "average" else (one, sides, draw(SOLIDS), draw(SIDES)))
    if name == "upwind":
        axis = draw(st.integers(0, box.dim - 1))
        return (name, draw(sides_of(box)), axis, draw(st.sampled_from([1, -1])))
    if name == "blocks":
        factors = []
        for cells in box.shape:
            factors.append(draw(st.sampled_from([f for f in (1, 2, 3) if cells % f == 0])))
        return (name, tuple(factors))
    if name == "probe":
        return ("product", ("transpose", (name, draw(SEEDS))), (name, draw(SEEDS)))
    if name == "interior":
        return (name, draw(SOLIDS))
    if name == "face_laplacian":
        return (name, draw(flow_sides(box)), draw(SOLIDS), draw(WORDS))
    if name == "projection":
        return (name, draw(flow_sides(box)), draw(SOLIDS))
    return (name,)


# ---- ingredients ---------------------------------------------------------------------------------------------------


@st.composite
def linears(draw, box, source, same):
    target = source if same else draw(st.sampled_from([source, source, "cells", "faces"]))
    keep = draw(st.sampled_from([0.0, 1.0])) if source == target else 0.0
    return parts.Linear(draw(expressions(box, source, target)), keep, source, target)


@st.composite
def solves(draw, box, source):
    """A system of a known kind, so that the method fits it."""
    kind = draw(st.sampled_from(["poisson", "closed", "wind", "any"])) if source == "cells" else "any"
    shift = draw(st.sampled_from([1.0, 3.0]))
    methods = ["auto", "direct", "krylov"]
    structured = ["multigrid", *structured_methods(box)]
    if kind == "poisson":
        solid = draw(SOLIDS)
        expression = ("scale", -1.0, ("laplacian", draw(sides_of(box)), solid, "neumann"))
        methods += structured + ([] if solid is not None else ["separable"])
    elif kind == "closed":
        walls = st.sampled_from(["neumann", "neumann", "dirichlet"])
        expression = ("scale", -1.0, ("laplacian", draw(sides_of(box, walls)), None, "neumann"))
        shift = 0.0
        methods += [*structured, "separable"]
    elif kind == "wind":
        sides = draw(sides_of(box))
        members = [("scale", -1.0, ("laplacian", sides, None, "neumann"))]
        for axis in range(box.dim):
            direction = draw(st.sampled_from([1, -1]))
            members.append(("scale", 2.0 * direction, ("upwind", sides, axis, direction)))
        expression = total(members)
        methods += ["multigrid"]
    else:
        expression = draw(expressions(box, source, source))
        size = np.abs(matrix(box, expression)).sum(1).max()
        shift = float(2 * np.ceil(size + 1))
    return parts.Solve(expression, shift, draw(st.sampled_from(methods)), draw(st.booleans()), source)


def structured_methods(box):
    """Structured multigrid needs two axes and compiled loops."""
    if box.dim > 1 and compiled():
        return ["structured"]
    return []


@st.composite
def elliptics(draw, box):
    shift = draw(st.sampled_from(["none", "number", "cells"]))
    solid = draw(SOLIDS) if shift != "none" else None
    coefficient = draw(st.sampled_from(["number", "faces", "average", "harmonic"]))
    method = draw(st.sampled_from(["auto", "direct", "krylov", "multigrid", *structured_methods(box)]))
    return parts.Elliptic(draw(sides_of(box)), solid, coefficient, shift, method, draw(SEEDS))


@st.composite
def transports(draw, box, of):
    scheme = draw(st.sampled_from(["upwind", "van_leer"]))
    sides = draw(sides_of(box, st.sampled_from(["neumann", "dirichlet"])))
    velocity = draw(st.sampled_from(["faces", "cells"]))
    form = draw(st.sampled_from(["flux", "advective"]))
    solid = draw(SOLIDS) if (scheme, velocity, of) == ("upwind", "faces", "cells") else None
    return parts.Transport(scheme, sides, velocity, of, form, draw(st.booleans()), draw(SEEDS), solid)


@st.composite
def simple(draw, box, source, batched, complex_field, same=False):
    """One ingredient that is no composition; same: with a result of the kind of its argument."""
    choices = ["linear", "solve"]
    if not complex_field:
        choices += ["pointwise", "pointwise", "rule"]
        if source == "cells":
            choices += ["step", "step", "diffusion", "walls"]
        if source == "faces":
            choices += ["convection"]
        if not batched:
            choices += ["transport"]
            choices += ["lagrangian"]
        if source == "faces" and not batched:
            choices += ["flow"]
        if source == "cells":
            choices += ["spectral"]
        if source == "cells" and not batched:
            choices += ["law", "fields", "waves", "adaptive", "damped", "switched"] + ["network"] * (box.dim < 3)
            choices += ["elliptic", "elliptic", "entries", "root", "adopted"]
    name = draw(st.sampled_from(choices))
    if name == "linear":
        return draw(linears(box, source, same))
    if name == "solve":
        return draw(solves(box, source))
    if name == "pointwise":
        formula = draw(st.sampled_from(sorted(parts.POINTWISE)))
        size = draw(st.sampled_from(["number", "field"]))
        return parts.Pointwise(formula, source, size, draw(SEEDS))
    if name == "rule":
        return parts.Rule(source, draw(st.booleans()), draw(SEEDS))
    if name == "step":
        methods = list(parts.TIME_STEPS)
        methods = ["euler", "heun", "ssprk3", "rk4"] if batched else methods
        return parts.TimeStep(draw(st.sampled_from(methods)), draw(sides_of(box)), draw(SEEDS))
    if name == "diffusion":
        return parts.Diffusion(draw(sides_of(box)), draw(SOLIDS), draw(SEEDS))
    if name == "walls":
        return parts.WallValues(draw(sides_of(box)), draw(SEEDS))
    if name == "convection":
        return parts.Convection(draw(flow_sides(box)), draw(SOLIDS), draw(st.booleans()), draw(SEEDS))
    if name == "transport":
        return draw(transports(box, source))
    if name == "elliptic":
        return draw(elliptics(box))
    if name == "entries":
        return parts.Entries(draw(SEEDS), draw(st.sampled_from(["auto", "direct", "krylov"])))
    if name == "root":
        entry = draw(st.sampled_from(["implicit", "steady"]))
        method = draw(st.sampled_from(["auto", "krylov"]))
        return parts.Root(draw(sides_of(box)), entry, method, draw(SEEDS))
    if name == "adopted":
        return parts.BlackBox(draw(st.sampled_from(["auto", "complex", "difference"])))
    return draw(physical(name, box, source))


@st.composite
def physical(draw, name, box, source):
    """One ingredient of `physics`."""
    seed = draw(SEEDS)
    flag = draw(st.booleans())
    if name == "lagrangian":
        return physics.Lagrangian(
            draw(st.sampled_from(["semi_lagrangian", "maccormack"])),
            draw(st.sampled_from(["neumann", "dirichlet"])),
            draw(st.sampled_from(["faces", "cells"])),
            source,
            draw(st.sampled_from(["linear", "cubic"])),
            draw(st.sampled_from(["euler", "midpoint"])),
            flag,
            seed,
        )
    if name == "law":
        sides = draw(sides_of(box, st.sampled_from(["outflow", "free_slip", "inflow"])))
        return physics.Law(draw(st.sampled_from(["upwind", "van_leer"])), sides, flag, draw(st.booleans()), seed)
    if name == "flow":
        viscosity = draw(st.sampled_from(["none", "explicit", "implicit", "params"]))
        sides = draw(flow_sides(box))
        steps = draw(st.integers(1, 3))
        return physics.Flow(sides, draw(SOLIDS), viscosity, flag, draw(st.booleans()), steps, seed)
    if name == "fields":
        return physics.TwoFields(draw(st.sampled_from(["rk4", "imex", "backward_euler"])), draw(sides_of(box)), seed)
    if name == "waves":
        memory = draw(st.sampled_from([None, 6000, "1 MB"] if flag else [None, "reverse", "1 MB"]))
        return physics.Waves(flag, memory, draw(st.integers(1, 6)), seed)
    if name == "adaptive" and draw(st.booleans()):  # it takes seconds
        method = draw(st.sampled_from(["ssprk3", "rk4", "tr_bdf2", "radau"]))
        return physics.Adaptive(method, draw(sides_of(box)), seed)
    if name == "switched":
        method = draw(st.sampled_from(["ssprk3", "rk4", "radau"]))
        return draw(st.sampled_from([physics.Switched(method, seed), physics.Ball(method)]))
    if name == "damped":
        return physics.Damped(draw(sides_of(box)), draw(st.sampled_from(["auto", "direct", "krylov"])), seed)
    if name == "spectral":
        return physics.Spectral(draw(sides_of(box)), draw(st.sampled_from(["exponential", "power", "function"])))
    padding = draw(st.sampled_from(["periodic", "zero", "replicate"]))
    if name == "adaptive" or box.dim == 3:
        return physics.TwoFields("imex", draw(sides_of(box)), seed)
    return physics.Network(padding, draw(st.sampled_from(["tanh", "relu", "softplus"])), seed)


@st.composite
def readings(draw, source):
    names = ["flux", "component"] if source == "faces" else ["sample", "restrict"]
    return physics.Reading(draw(st.sampled_from(names)), source, draw(SEEDS))


@st.composite
def rollouts(draw, box, source, batched, complex_field, nested=True, most=9):
    """A rollout of at most `most` steps."""
    chain = []
    for _ in range(draw(st.integers(1, 2))):
        if nested and most > 4 and draw(st.integers(0, 7)) == 7:
            chain.append(draw(rollouts(box, source, batched, complex_field, nested=False, most=2)))
            most = 4
            continue
        chain.append(draw(simple(box, source, batched, complex_field, same=True)))
    if any(isinstance(part, physics.Lagrangian) for part in chain):
        most = 2  # the second derivative of its twin takes seconds
    n = draw(st.integers(1, most))
    numbers_kept = draw(st.sets(st.integers(0, n), min_size=1))
    keep = draw(st.sampled_from(["last", "last", "all", tuple(sorted(numbers_kept)), "function"]))
    keep = "all" if keep == "function" and complex_field else keep
    memory = draw(st.sampled_from([None, None, 3, 5, 7, "1 MB"]))
    truncate = draw(st.sampled_from([None, None, None, 1, 2, 3]))
    inputs = draw(st.booleans()) and not complex_field
    return parts.Rollout(tuple(chain), n, memory, keep, truncate, inputs, draw(st.booleans()), draw(SEEDS))


@st.composite
def scenes(draw):
    """A whole scene."""
    dtype = draw(st.sampled_from(["float64"] * 7 + ["float32", "complex128"]))
    complex_field = dtype == "complex128"
    box = draw(boxes())
    batch = draw(st.sampled_from([(), (), (), (), (), (2,), (3,), (2, 2)]))
    kind = draw(st.sampled_from(["cells", "cells", "faces"]))
    chain = []
    steps = 0
    for _ in range(draw(st.integers(1, 4))):
        source = chain[-1].target if chain else kind
        form = draw(st.sampled_from(["simple", "simple", "simple", "rollout", "sum"]))
        if form == "rollout":
            most = 9 if steps == 0 else 3
            part = draw(rollouts(box, source, bool(batch), complex_field, most=most))
            steps += part.n
            chain.append(part)
            continue
        part = draw(simple(box, source, bool(batch), complex_field))
        if form == "sum":
            other = draw(simple(box, source, bool(batch), complex_field, same=part.target == source))
            if part.target == other.target:
                multiplied = draw(st.booleans()) and not complex_field
                part = parts.Sum(part, other, multiplied)
        chain.append(part)
    if draw(st.integers(0, 4)) == 4:
        chain.append(draw(readings(chain[-1].target)))
    loss = "squares" if complex_field else draw(st.sampled_from(sorted(LOSSES)))
    members = draw(st.sampled_from([0, 0, 0, 0, 2, 3]))
    if steps > MOST_STEPS_OF_A_MEMBER or "Lagrangian(" in repr(chain):
        members = 0
    layouts = sorted(set(LAYOUTS) - (set() if batch else {"broadcast"}))
    return Scene(
        box,
        tuple(chain),
        batch,
        dtype,
        loss,
        draw(st.sampled_from(sorted(TREES))),
        draw(SEEDS),
        members,
        draw(st.sampled_from(["C", "C", *layouts])),
        draw(st.sampled_from(["none"] * 14 + BRIDGES)),
        draw(st.sampled_from(["float", "float", "array", "scalar"])),
        draw(st.booleans()),
        draw(st.booleans()),
    )
