"""A law -> one rule of the tape: cotangents of all requested arguments in one pass, tangents, second order."""

import autograd.numpy as anp
import numpy as np

from sparsedp._utils.validation import check_finite, surely_finite
from sparsedp.advection.law import FIELD, INFLOW, STEP, VELOCITY
from sparsedp.advection.values import FLOAT, LETTERS, prepare, raised, result_like, unflatten
from sparsedp.autodiff.tape import Rule, dtype_of, isbox, linear, plain
from sparsedp.errors import DerivativeError

__all__ = ["rule_of"]


def rule_of(law):
    """Law -> Rule of (u, v, dt, inflow)."""

    def forward(u, v, dt, inflow):
        return result_like(u, law.forward(*prepare(law, u, v, dt, inflow)), law.setting.space.shape)

    def vjp(nums, ans, *args):
        def pull(g, *sums):
            flat = prepare(law, *args)
            g = raised(FIELD, law, g)
            traced = type(g) is not np.ndarray or any(map(isbox, flat))
            into = None if traced or STEP in nums or not sums else _sum_of(law, args, dict(zip(nums, sums)))
            if traced and not law.twice:
                found, fine = tuple(back(g) for back, _ in _turned(law, nums, flat)), False
            else:
                found, fine = _vjp(law, nums, g, flat, into)
                if not fine and into is not None and not surely_finite(into):  # what was there may not have been
                    _check_slope(law, "the gradient in v", law.vjp((VELOCITY,), g, *flat)[0][0], (g,))
            for num, back in zip(nums, found, strict=True):
                if not fine and back is not into:
                    _check_slope(law, "the gradient in " + LETTERS[num], back, (g,))
            shaped = [unflatten(args[num], back) for num, back in zip(nums, found, strict=True)]
            return [sums[k] if found[k] is into is not None else back for k, back in enumerate(shaped)]

        return pull

    def jvp(nums, tangents, ans, *args):
        flat = prepare(law, *args)
        along = {num: raised(num, law, tangent) for num, tangent in zip(nums, tangents, strict=True)}
        if any(map(isbox, (*args, *tangents))) and not law.twice:
            rules = zip(_turned(law, nums, flat), along.values(), strict=True)
            found = sum(ahead(tangent) for (_, ahead), tangent in rules)
        else:
            if STEP in along:
                along[VELOCITY] = along.get(VELOCITY, 0.0) + along.pop(STEP) / flat[STEP] * flat[VELOCITY]
            found = law.jvp(along, *flat)
        _check_slope(law, "the tangent", found, tangents)
        return unflatten(ans, found)

    rule = Rule(law.name, forward, vjp, jvp)
    rule.adds = law.adds
    return rule


def _sum_of(law, args, sums):
    """The sum of the cotangents of the velocity so far, flat, where that of a step can be added to it; else None."""
    total = sums.get(VELOCITY)
    fits = total is not None and total.dtype == FLOAT == dtype_of(args[VELOCITY]) and total.flags.c_contiguous
    return total.reshape(-1) if fits else None


def _vjp(law, nums, g, flat, into=None):
    """Cotangents of the arguments `nums`, and whether all are finite for sure.

    A step depends on the velocity times dt: the cotangent of dt follows from that of v.
    """
    asked = tuple({VELOCITY if num == STEP else num for num in nums})
    cotangents, fine = law.vjp(asked, g, *flat, *(() if into is None else (into,)))
    found = dict(zip(asked, cotangents, strict=True))
    if STEP in nums:
        found[STEP] = anp.dot(flat[VELOCITY], found[VELOCITY]) / flat[STEP]
    return [found[num] for num in nums], fine and STEP not in nums


def _check_slope(law, what, slope, given):
    """Refuse a derivative that overflows; NaN and infinity that were handed in are no fault of the step."""
    slope = plain(slope)
    if surely_finite(slope) or not all(np.all(np.isfinite(plain(value))) for value in given):
        return
    check_finite(law.name, np.asarray(slope), f"cannot represent {what}")


def _turned(law, nums, flat):
    """For each argument the rules from g to its cotangent, and back: linear, and free of u and inflow.

    A linear scheme has every derivative in u and inflow as long as v and dt are constant.
    """
    plain_flat = tuple(map(plain, flat))
    if not (law.linear and set(nums) <= {FIELD, INFLOW}) or isbox(flat[1]) or isbox(flat[2]):
        raise DerivativeError(f"{law.name} has first derivatives only; for second ones write scheme='upwind'")

    def rules(num):
        pull = lambda g: law.vjp((num,), np.asarray(g), *plain_flat)[0][0]
        return linear(f"{law.name}.T", pull, lambda tangent: law.jvp({num: tangent}, *plain_flat))

    return map(rules, nums)
