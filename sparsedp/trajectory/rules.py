"""The rollout and its pullback as two rules, each with VJP and JVP, so that derivatives of every order follow.

Let y = R(z) be the outputs as a function of all variables z, and D(z, w) = (R(z), R'(z) w) the rollout of the
dual step, which carries a tangent beside every state. Then

    JVP of R along w              the tangent part of D(z, w)
    VJP of R                      B(z, g) = R'(z)^T g, one sweep from the last step to the first
    JVP of B along (w, h)         B(z, h) + grad_z <g, R'(z) w>, the last one the z-part of the VJP of D
    VJP of B for a cotangent c    in g: R'(z) c;  in z: grad_z <g, R'(z) c>

since B is linear in g and <c, B(z, g)> = <g, R'(z) c>.
"""

from sparsedp.tape import Rule, isbox, plain
from sparsedp.trajectory.duality import dual
from sparsedp.trajectory.layout import dense

__all__ = ["rollout_rule"]


class Pull:
    """Which arguments of a run want a cotangent, and how many arguments it has."""

    def __init__(self, run, wanted, many):
        self.run, self.wanted, self.many = run, wanted, many


def _one(values):
    """A rule with one result returns the array, with several a tuple."""
    return values[0] if len(values) == 1 else values


def _list(values, many):
    """The other way round, traced or not."""
    return [values] if many == 1 else [values[number] for number in range(many)]


# ---------------------------------------------------------------- the rollout


def _forward(run, *args):
    return _one(run.forward([dense(arg) for arg in args]))


def _vjp(nums, ans, run, *args):
    wanted = [num - 1 for num in nums]
    many = _count(ans)

    def pull(g):
        found = pull_rule(Pull(run, wanted, len(args)), *args, *_list(g, many))
        return tuple(_list(found, len(wanted)))

    return pull


def _jvp(nums, tangents, ans, run, *args):
    wanted = [num - 1 for num in nums]
    twin, arrange = dual(run, args, wanted)
    moved = arrange(args, tangents)
    twin.store = any(map(isbox, moved))
    return rollout_rule(twin, *moved)


def _count(ans):
    ans = plain(ans)
    return len(ans) if isinstance(ans, tuple) else 1


# ---------------------------------------------------------------- its pullback


def _pull_forward(pull, *rest):
    args, g = tuple(map(dense, rest[: pull.many])), rest[pull.many :]  # numbers as on the way forward
    return _one(pull.run.backward(args, pull.wanted, g))


def _pull_vjp(nums, ans, pull, *rest):
    many, run = pull.many, pull.run
    args, g = rest[:many], rest[many:]
    wanted = [num - 1 for num in nums]
    slopes = [number for number in wanted if number < many]

    def pull_back(c):
        c = _list(c, len(pull.wanted))
        twin, arrange = dual(run, args, pull.wanted)
        moved = arrange(args, c)
        twin.store = bool(slopes) or any(map(isbox, moved))
        forward = len(slopes) < len(wanted)
        tangents = _list(rollout_rule(twin, *moved), len(g)) if forward else []
        backs = _second(twin, slopes, moved, g)
        return tuple(backs[number] if number < many else tangents[number - many] for number in wanted)

    return pull_back


def _pull_jvp(nums, tangents, ans, pull, *rest):
    many, run = pull.many, pull.run
    args, g = rest[:many], rest[many:]
    moves = dict(zip([num - 1 for num in nums], tangents, strict=True))
    changed = [number for number in moves if number < many]
    total: list | None = None
    if len(changed) < len(moves):
        h = [moves[many + k] if many + k in moves else 0.0 * g[k] for k in range(len(g))]
        total = _list(pull_rule(pull, *args, *h), len(pull.wanted))
    if changed:
        twin, arrange = dual(run, args, changed)
        backs = _second(twin, pull.wanted, arrange(args, [moves[number] for number in changed]), g)
        parts = [backs[number] for number in pull.wanted]
        total = parts if total is None else [a + b for a, b in zip(total, parts, strict=True)]
    return _one(tuple(total or ()))


def _second(twin, numbers, moved, g):
    """Number of an argument of the run -> its part of the VJP of the dual run."""
    if not numbers:
        return {}
    places = [twin.place_of[number] for number in numbers]
    found = pull_rule(Pull(twin, places, len(moved)), *moved, *g)
    return dict(zip(numbers, _list(found, len(numbers)), strict=True))


rollout_rule = Rule("rollout", _forward, _vjp, _jvp)
pull_rule = Rule("rollout.T", _pull_forward, _pull_vjp, _pull_jvp)
