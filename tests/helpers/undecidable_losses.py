"""Random scenes at which no difference can prove a gradient: at a kink, and in noise."""

import zlib

import autograd.numpy as anp
import numpy as np
from planted import scene

import sparsedp as dp

KINKS = ("abs", "max", "clip", "norm", "power", "min", "one", "near")
NOISES = ("hash", "stairs", "single", "beside")


def kinked(seed):
    """Return (loss, x) of a right gradient, whatever its convention, at one or many kinks of any size."""
    rng = np.random.default_rng(seed)
    loss, x, _ = scene(seed)
    kind = KINKS[seed % len(KINKS)]
    where = rng.random(x.shape) < rng.choice([0.1, 0.5, 1.0])
    where.flat[0] = True
    size = 10.0 ** rng.uniform(-4, 0.3) * np.linalg.norm(dp.value_and_grad(loss)(x)[1])
    weights = rng.standard_normal(x.shape) * where
    weights *= size / np.linalg.norm(weights)
    unit = np.sqrt(np.mean(x**2))
    bends = {
        "abs": lambda d: anp.sum(weights * anp.abs(d)),
        "max": lambda d: anp.sum(weights * anp.maximum(d, 0.0)),
        "clip": lambda d: anp.sum(weights * anp.clip(d, -1e3, 0.0)),
        "norm": lambda d: size * anp.sqrt(anp.sum((d * where) ** 2)),
        "power": lambda d: anp.sum(weights * (anp.abs(d) + 1e-300) ** 1.3),
        "min": lambda d: anp.sum(weights * anp.minimum(d, 2 * d)),
        "one": lambda d: size * anp.abs(anp.sum(d * weights) / size),
        "near": lambda d: anp.sum(weights * anp.maximum(d - 1e-8 * unit, 0.0)),
    }
    return lambda u: loss(u) + bends[kind](u - x), x


def bits(u):
    """Return a number between -1 and 1 that differs wherever u differs."""
    return zlib.crc32(np.asarray(u).tobytes()) / 2**31 - 1


def noisy(seed):
    """Return (loss, x) of a right gradient of the smooth part, with noise of 3e-8 to 1e-2 of it."""
    rng = np.random.default_rng(10000 + seed)
    loss, x, _ = scene(seed)
    size = 10.0 ** rng.uniform(-7.5, -2)
    kind = NOISES[seed % len(NOISES)]
    base = abs(loss(x))

    def rough(u):
        value = loss(u)
        place = getattr(u, "_value", u)
        plain = getattr(value, "_value", value)
        if kind == "hash":
            return value * (1 + size * bits(place))
        if kind == "stairs":
            return value + (np.round(plain / (size * base)) * size * base - plain)
        if kind == "single":
            return value + (float(np.float32(plain)) - plain)
        return value + size * base * bits(np.round(place, 12))

    return rough, x
