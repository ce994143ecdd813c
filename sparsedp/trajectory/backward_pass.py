"""The backward pass over all steps of a loop."""

from sparsedp._utils.counters import count
from sparsedp._utils.progress import shown_steps
from sparsedp.autodiff.derivative import zero_like
from sparsedp.autodiff.tape import backward, fit
from sparsedp.trajectory.layout import refuse_lost, stacked
from sparsedp.trajectory.memory_budget import stride
from sparsedp.trajectory.record import growth, largest

__all__ = ["go_back"]

NONE = None, False  # no cotangent so far


def go_back(loop, steps, kept, g):
    """One backward pass over all steps: cotangents of the outputs -> those of all arguments, None where there is none.

    Parameters
    ----------
    loop : Loop
    steps : Steps
    kept : list of State
        The last one included; they are taken out of it.
    g : list
    """
    n, source, recomputed = loop.n, loop.keep.source(loop.n, g), 0
    sums: dict = {}  # of params: root -> (sum so far, whether it may be written to)
    pairs = zip(steps.x, steps.input_roots, strict=True)
    inputs = [list(zero_like(block)) if root else [] for block, root in pairs]  # for each row
    state = kept.pop()
    last = state if loop.reverse else None
    total = source(state)
    norms = [] if total is None else [(n, largest(total))]
    for i in shown_steps(loop.progress, range(n - 1, -1, -1), "backward"):
        if total is None and not loop.keep.along:
            break  # cut by truncation
        taped = kept and kept[-1].tape  # what is on a tape is not run again
        end = None if taped else state.marks()
        if loop.reverse:
            state = steps.back(state)
        else:
            state, again = _state_at(i, loop, steps, kept)
            recomputed += again
        if total is not None:
            if not taped:
                state = state.moved(state.values)  # the tape goes with it
                after = steps.after(state, True)
                if not loop.reverse:
                    loop.compare(after.marks(), end)
                del after
            total = _pulled(total, steps, state, sums, inputs)
            if not taped:
                state.tape = None
        if i % loop.every == 0 and total is not None:  # before anything enters here
            norms.append((i, largest(total)))
        if loop.keep.along and i >= loop.moving:
            total = _sum(total, source(state))
    if loop.reverse and state.i == 0:
        steps.check_start(state, last)
    count("rollout.step", "vjp", n)
    count("rollout.step", "recomputed", recomputed)
    record = growth(loop, norms, recomputed)
    if loop.record is not None:
        loop.record(record)
    params = [sums.get(root, NONE)[0] for root in steps.roots]
    rows = [stacked(rows) if rows else None for rows in inputs]
    return [*(total or [None] * len(loop.state.places)), *_fitted(params, steps.p), *rows]


def _pulled(g, steps, state, sums, inputs):
    """Cotangents of the state after a taped one -> those of the state itself, None if there are none."""
    roots, nodes, ends = state.tape
    steps.last = state
    backward(nodes, ends, g, sums)
    backs: list = []
    found = None
    for root, value in zip(roots, state.values):
        back = sums.pop(root, NONE)[0]
        if back is not None:
            back, found = fit("the step", value, back, back), backs
        backs.append(back)
    for rows, root in zip(inputs, roots[len(backs) :]):
        if root in sums:
            rows[state.i] = sums.pop(root)[0]
    if not sums.keys() <= steps.known:
        refuse_lost("the step")  # in a call of another step
    return found


def _state_at(i, loop, steps, kept):
    """State i, from the nearest kept state, and how many steps that took; states on the way are kept by the rule."""
    state, again = kept.pop(), 0
    while state.i < i:
        kept.append(state)
        stop = state.i + stride(i + 1 - state.i, max(loop.slots - len(kept) + 1, 1))
        again += stop - state.i
        while state.i < stop:
            state = steps.after(state, False)
        state = state.owned()
    return state, again


def _fitted(backs, values):
    """Cotangents in the dtypes of their values; None where there is none."""
    pairs = zip(backs, values)
    return [None if back is None else fit("the step", value, back, back) for back, value in pairs]


def _sum(total, entering):
    """Two lists of cotangents, or None, added leaf by leaf."""
    if total is None or entering is None:
        return entering if total is None else total
    return [b if a is None else a if b is None else a + b for a, b in zip(total, entering, strict=True)]
