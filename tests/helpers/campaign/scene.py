"""A scene: a field, a chain of ingredients, a loss; by the library and by its twin, compared in every derivative."""

import re
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import autograd
import autograd.numpy as anp
import numpy as np

import sparsedp as dp
from campaign.boxes import Box, numbers
from campaign.ingredients import Discarded, constant_part

SMALLEST = 1e-3  # numbers of a scene are about 1: what is smaller than this may be what cancellation leaves


class Mismatch(AssertionError):
    """The library and the twin disagree."""


class Pair(NamedTuple):
    """A tree with fields that are no dict."""

    first: Any
    second: Any


@dataclass(frozen=True)
class Scene:
    """A program: the loss of a chain of ingredients, applied to a field with parameters.

    Parameters
    ----------
    box : Box
    chain : tuple of Ingredient
    batch : tuple of int
        Leading axes of the field.
    dtype : str
    loss : str
        A key of `LOSSES`.
    tree : str
        How the field and the parameters are arranged, a key of `TREES`.
    seed : int
        Of the field, of the weights of the loss, and of the tangents.
    ensemble : int
        Number of members over which `ensemble` sums the loss, or 0.
    layout : str
        How the field lies in memory, a key of `LAYOUTS`.
    bridge : str
        "none", or the library that differentiates the loss: "torch" or "jax".
    number : str
        What parameters that are numbers are: "float", "array" or "scalar".
    shared : bool
        Whether parameters that may have any value are the same array as the field, where it fits.
    unused : bool
        Whether there is an array that the loss does not use.
    """

    box: Box
    chain: tuple
    batch: tuple = ()
    dtype: str = "float64"
    loss: str = "sine"
    tree: str = "dict"
    seed: int = 0
    ensemble: int = 0
    layout: str = "C"
    bridge: str = "none"
    number: str = "float"
    shared: bool = False
    unused: bool = False

    @property
    def order(self):
        orders = [part.order for part in self.chain]
        if self.dtype == "complex128":
            return 1
        return min([2, *orders])

    @property
    def second_order(self):
        """Whether a Hessian product is asked, to be compared or refused."""
        return self.dtype != "complex128" and (self.order > 1 or bool(self.refusals))

    @property
    def tolerance(self):
        if self.dtype == "float32":
            return 3e-3
        return 10 * max([1e-9, *(part.tolerance for part in self.chain)])

    @property
    def refusals(self):
        return [refusal for part in self.chain for refusal in part.refusals]

    def leaves(self):
        """Return the values by name: the field, and the parameters of each ingredient."""
        shape = (*self.batch, *self.box.field_shape(self.chain[0].source))
        u = LAYOUTS[self.layout](numbers(5000 + self.seed, shape, self.dtype))
        values = {"u": u}
        for number, part in enumerate(self.chain):
            for name, value in part.parameters(self.box).items():
                value = in_precision(value, self.dtype)
                if isinstance(value, float):
                    value = self._as_number(value)
                elif self.shared and self.dtype != "complex128" and name in SHARABLE and value.shape == u.shape:
                    value = u
                values[f"{number} {name}"] = value
        if self.unused:
            values["unused"] = in_precision(np.ones((2, 3)), self.dtype)
        return values

    def _as_number(self, value):
        """Return a number of Python, or an array or scalar of NumPy in the precision of the scene."""
        precise = np.asarray(value, "float32" if self.dtype == "float32" else "float64")
        return {"float": float(value), "array": precise, "scalar": precise[()]}[self.number]

    def tangents(self):
        """Return a direction by name; its entries are in another order than those of `leaves`."""
        names = list(self.leaves().items())
        result = {}
        for number, (name, value) in reversed(list(enumerate(names))):
            tangent = numbers(7000 + self.seed + number, np.shape(value), np.asarray(value).dtype)
            result[name] = tangent if isinstance(value, np.ndarray) else type(value)(tangent)
        return result

    def _composed(self, parts, bounded=False):
        """Return loss(values by name). bounded: whether fields that grow discard the scene."""
        measure = LOSSES[self.loss]
        seed = 6000 + self.seed

        def loss(values):
            u = values["u"]
            for number, part in enumerate(parts):
                mine = {}
                for name, value in values.items():
                    place, _, own_name = name.partition(" ")
                    if place == str(number):
                        mine[own_name] = value
                u = part(u, mine)
                if bounded:
                    check_range(constant_part(u))
            return measure(u, in_precision(numbers(seed, anp.shape(u)), self.dtype))

        return loss

    def library(self):
        """Return the loss of a tree of all values, made by the library."""
        loss = self._composed([part.library(self.box) for part in self.chain])
        entries = TREES[self.tree][1]
        names = list(self.leaves())
        if not self.ensemble:
            return lambda x: loss(entries(x, names))

        def of_member(x, share):
            values = entries(x, names)
            return loss({**values, "u": values["u"] * share})

        return dp.ensemble(of_member, self.shares(), weights=self.shares())

    def twin(self):
        """Return the loss of a dict of all values, in plain autograd.numpy."""
        loss = self._composed([part.twin(self.box) for part in self.chain], bounded=True)
        if not self.ensemble:
            return loss

        def total(values):
            result = 0.0
            for share in self.shares():
                result = result + share * loss({**values, "u": values["u"] * share})
            return result

        return total

    def shares(self):
        """Return the scale of the field in each member of an ensemble."""
        return [1.0 - 0.25 * number for number in range(self.ensemble)]


def in_precision(value, dtype):
    """Return a value in the precision of a dtype; numbers of Python stay, parameters are real."""
    if isinstance(value, float):
        return value
    return np.asarray(value, "float32" if dtype == "float32" else "float64")


SHARABLE = ("f", "v", "w", "push")  # parameters that may have any value


# ---- layouts in memory --------------------------------------------------------------------------------------------


def in_every_second_place(u):
    wide = np.zeros((*u.shape[:-1], 2 * u.shape[-1]), u.dtype)
    wide[..., ::2] = u
    return wide[..., ::2]


def read_only(u):
    u = u.copy()
    u.flags.writeable = False
    return u


LAYOUTS = {
    "C": np.ascontiguousarray,
    "F": np.asfortranarray,
    "strided": in_every_second_place,
    "reversed": lambda u: u[..., ::-1],
    "read-only": read_only,
    "broadcast": lambda u: np.broadcast_to(u[:1], u.shape),
}


# ---- losses --------------------------------------------------------------------------------------------------------


LOSSES = {
    "sine": lambda u, w: anp.sum(w * anp.sin(u)) + 0.5 * anp.sum(u**2),
    "linear": lambda u, w: anp.sum(w * u),
    "logarithm": lambda u, w: anp.sum(anp.log(1 + u**2)) + anp.sum(w * u),
    "mean": lambda u, w: anp.mean(u) ** 2 + anp.mean((u - w) ** 2),
    "first": lambda u, w: anp.ravel(u)[0] ** 2 + anp.sum(u),
    "squares": lambda u, w: anp.sum(w**2 * anp.real(u * anp.conj(u))),
}


# ---- trees ---------------------------------------------------------------------------------------------------------
# Each is a pair: arrange(values by name) -> tree, entries(tree, names) -> values by name. Texts and whole numbers stand
# beside the values in some.


def arranged_in_list(values):
    return ["ink", *values.values()]


def entries_of_list(x, names):
    return dict(zip(names, x[1:]))


def arranged_in_pair(values):
    rest = {name: value for name, value in values.items() if name != "u"}
    return Pair((values["u"], None), {"b": last_name_first(rest), "a": [3, "ink"]})


def entries_of_pair(x, names):
    return {"u": x.first[0], **x.second["b"]}


def last_name_first(values):
    return {name: values[name] for name in sorted(values, reverse=True)}


def entries_of_dict(x, names):
    return dict(x)


TREES = {
    "dict": (dict, entries_of_dict),
    "reversed": (last_name_first, entries_of_dict),
    "list": (arranged_in_list, entries_of_list),
    "pair": (arranged_in_pair, entries_of_pair),
}


# ---- comparison ----------------------------------------------------------------------------------------------------


@dataclass
class Outcome:
    """What a comparison came to: how often each quantity was compared, and the refusals."""

    compared: list = field(default_factory=list)
    refused: list = field(default_factory=list)


def compare(scene):
    """Compare value, gradient, JVP and Hessian product of a scene with those of its twin.

    Returns
    -------
    Outcome

    Raises
    ------
    Discarded
        If the numbers of the twin grow beyond 1e4.
    Mismatch
        If a quantity differs by more than the tolerance, has another dtype or shape, or changes when it is computed
        twice; if an argument is modified; or if the library refuses what it should accept.
    """
    outcome = Outcome()
    values = scene.leaves()
    tangents = scene.tangents()
    names = list(values)
    arrange, entries = TREES[scene.tree]
    x = arrange(values)
    direction = arrange(order_of(tangents, values, scene.tree))
    before = {name: np.array(value) for name, value in values.items()}

    with np.errstate(all="ignore"):
        twin = Twin(scene, values, tangents)
        wanted_product = twin.hessian_product() if scene.second_order else None
    loss = attempt(scene, outcome, "set-up", scene.library)
    if loss is None:
        return outcome

    result = attempt(scene, outcome, "gradient", lambda: dp.value_and_grad(loss)(x))
    if result is not None:
        value = result[0]
        gradient = entries(result[1], names)
        check_close(scene, "value", value, twin.value, twin.value_scale)
        outcome.compared.append("value")
        check_gradient(scene, "gradient", gradient, twin.gradient, values)
        outcome.compared.append("gradient")
        plain = loss(x)
        exact = scene.dtype != "float32" and scene.layout == "C"  # NumPy's sums depend on the layout
        if not abs(plain - value) <= (0.0 if exact else scene.tolerance * (1 + abs(value))):
            raise Mismatch(f"value without derivative {plain!r}, with derivative {value!r}")

    pushed = attempt(scene, outcome, "jvp", lambda: dp.jvp(loss, x, direction))
    if pushed is not None:
        check_close(scene, "value of jvp", pushed[0], twin.value, twin.value_scale)
        check_close(scene, "jvp", pushed[1], twin.slope, twin.slope_scale)
        outcome.compared.append("jvp")

    if scene.second_order:
        product = attempt(scene, outcome, "hvp", lambda: dp.hvp(loss, x, direction))
        if product is not None:
            check_gradient(scene, "hvp", entries(product, names), wanted_product, values)
            outcome.compared.append("hvp")

    if scene.bridge == "jax":
        attempt(scene, outcome, "jax", lambda: compare_by_jax(scene, loss, values, twin, outcome))
    if scene.bridge == "torch":
        attempt(scene, outcome, "torch", lambda: compare_by_torch(scene, loss, values, twin, wanted_product, outcome))

    for name, value in values.items():
        if not np.array_equal(before[name], value):
            raise Mismatch(f"argument {name} was modified")
    return outcome


def compare_by_torch(scene, loss, values, twin, wanted_product, outcome):
    """Compare value, gradient and Hessian product that torch computes of the loss."""
    import torch

    arrange = TREES[scene.tree][0]
    arrays = arrays_of(scene, values)
    tensors = {name: torch.tensor(np.array(value), requires_grad=True) for name, value in arrays.items()}
    bridged = dp.interop.to_torch(loss)
    value = bridged(arrange(tensors))
    check_close(scene, "value by torch", value.detach(), twin.value, twin.value_scale)
    found = torch.autograd.grad(value, list(tensors.values()), create_graph=scene.order > 1, allow_unused=True)
    check_gradient(scene, "gradient by torch", of_tensors(tensors, found, arrays), twin.gradient, arrays)
    outcome.compared.append("gradient by torch")
    if scene.order > 1:
        slope = 0.0
        for gradient, tangent in zip(found, twin.tangents):
            if gradient is not None and gradient.requires_grad:
                slope = slope + torch.sum(gradient * torch.tensor(np.array(tangent)))
        if not isinstance(slope, float):
            found = torch.autograd.grad(slope, list(tensors.values()), allow_unused=True)
            check_gradient(scene, "hvp by torch", of_tensors(tensors, found, arrays), wanted_product, arrays)
            outcome.compared.append("hvp by torch")


def compare_by_jax(scene, loss, values, twin, outcome):
    """Compare value and gradient that JAX computes of the loss, compiled."""
    import jax

    arrays = arrays_of(scene, values)

    def of_dict(moving):  # JAX sorts the entries of dicts
        return loss(TREES[scene.tree][0]({name: moving[name] for name in values}))

    number = np.zeros((), "float32" if scene.dtype == "float32" else "float64")
    bridged = dp.interop.to_jax(of_dict, like=number)
    with jax.enable_x64(True):  # not for the process: other tests need the default of JAX
        value, found = jax.jit(jax.value_and_grad(bridged))(arrays)
        check_close(scene, "value by JAX", value, twin.value, twin.value_scale)
        check_gradient(scene, "gradient by JAX", found, twin.gradient, arrays)
    outcome.compared.append("gradient by JAX")


def arrays_of(scene, values):
    """Return the values as arrays; a number of Python, which has no precision, gets the precision of the scene."""
    arrays = {}
    for name, value in values.items():
        arrays[name] = in_precision(np.asarray(value), scene.dtype) if isinstance(value, float) else np.asarray(value)
    return arrays


def of_tensors(tensors, found, values):
    """Return arrays by name, zeros where torch has no gradient."""
    result = {}
    for (name, tensor), gradient in zip(tensors.items(), found):
        given = np.zeros(tuple(tensor.shape)) if gradient is None else gradient.detach().numpy()
        given = np.conj(given)  # torch returns dL/dRe + i dL/dIm
        result[name] = np.asarray(given, np.asarray(values[name]).dtype) if gradient is None else given
    return result


def order_of(tangents, values, tree):
    """Dicts are paired by name, so their entries come in another order; lists by position."""
    if tree in ("dict", "reversed"):
        return tangents
    return {name: tangents[name] for name in values}


class Twin:
    """Value, gradient, slope along a direction, and Hessian product of the twin, in double precision."""

    def __init__(self, scene, values, tangents):
        self.names = list(values)
        kind = "complex128" if scene.dtype == "complex128" else "float64"
        wide = {}
        for name, value in values.items():
            wide[name] = np.asarray(value, kind if name == "u" else "float64")[()]
        self.arguments = [wide[name] for name in self.names]
        self.tangents = [np.asarray(tangents[name])[()] for name in self.names]
        loss = scene.twin()
        self.loss = lambda *arguments: loss(dict(zip(self.names, arguments)))
        self.places = tuple(range(len(self.names)))
        value, found = autograd.value_and_grad(self.loss, self.places)(*self.arguments)
        self.value = value
        self.gradient = dict(zip(self.names, found))
        terms = [np.real(np.asarray(g) * t) for g, t in zip(found, self.tangents)]
        self.slope = float(sum(np.sum(term) for term in terms))
        self.slope_scale = float(sum(np.sum(np.abs(term)) for term in terms))
        check_range(value, *found)
        self.value_scale = abs(float(value)) + float(
            sum(np.sum(np.abs(np.asarray(g) * a)) for g, a in zip(found, self.arguments))
        )

    def hessian_product(self):
        """Return the derivative of the slope, by reverse mode over reverse mode."""
        gradient = autograd.grad(self.loss, self.places)

        def slope(*arguments):
            return sum(anp.sum(g * t) for g, t in zip(gradient(*arguments), self.tangents))

        found = autograd.grad(slope, self.places)(*self.arguments)
        check_range(*found)
        return dict(zip(self.names, found))


def check_range(*values):
    """Discard a scene whose numbers grow beyond 1e4."""
    for value in values:
        if not np.all(np.abs(value) < 1e4):
            raise Discarded


def attempt(scene, outcome, stage, act):
    """Return act(), or None where the library refuses for a reason that an ingredient announces."""
    try:
        return act()
    except Mismatch:
        raise
    except Exception as error:
        for kind, words in scene.refusals:
            refused = isinstance(error, kind) or stage == "jax"  # which raises errors of its own, with the message
            if refused and re.search(words, str(error)):
                outcome.refused.append(f"{stage}: {type(error).__name__}: {words}")
                return None
        raise Mismatch(f"{stage}: {type(error).__name__}: {error}") from error


def check_close(scene, what, found, wanted, scale):
    error = abs(float(found) - float(wanted))
    if not error <= scene.tolerance * (scale + SMALLEST):
        raise Mismatch(f"{what}: library {float(found)!r}, twin {float(wanted)!r}, scale {scale:.3g}")


def check_gradient(scene, what, found, wanted, values):
    """Compare leaf by leaf, relative to its largest entry plus a small part of the largest entry of all leaves."""
    if set(found) != set(wanted):
        raise Mismatch(f"{what}: leaves {sorted(found)} for {sorted(wanted)}")
    largest = max(np.max(np.abs(leaf), initial=0.0) for leaf in wanted.values())
    for name, leaf in wanted.items():
        own = np.asarray(found[name])
        if own.shape != np.shape(values[name]):
            raise Mismatch(f"{what}: {name} has shape {own.shape} for {np.shape(values[name])}")
        if own.dtype != np.asarray(values[name]).dtype:
            raise Mismatch(f"{what}: {name} has dtype {own.dtype} for {np.asarray(values[name]).dtype}")
        if not own.size:
            continue
        error = np.max(np.abs(own - leaf))
        scale = np.max(np.abs(leaf)) + 1e-3 * largest + SMALLEST
        if not error <= scene.tolerance * scale:
            place = np.unravel_index(np.argmax(np.abs(own - leaf)), own.shape)
            raise Mismatch(f"{what}: {name}{list(map(int, place))} is {own[place]!r}, twin {np.asarray(leaf)[place]!r}")
