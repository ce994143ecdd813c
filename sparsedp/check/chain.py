"""A program as a chain of stages, each with its own derivative."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

from sparsedp._utils.pytree import copied

__all__ = ["Chain", "Stage"]


class Stage(NamedTuple):
    """One stage of a program: its name, its function f(x), and its derivative, vjp(x, g) or jvp(x, t)."""

    name: str
    function: Callable[[Any], Any]
    derivative: Callable[[Any, Any], Any]


class Chain:
    """Stages in the order in which they run.

    Parameters
    ----------
    stages : sequence
        Pairs (function, derivative), triples (name, function, derivative), or objects with methods ``apply`` and
        `kind`.
    kind : "vjp" or "jvp"
    """

    def __init__(self, stages: Sequence[Any], kind: str) -> None:
        self.kind = kind
        if not isinstance(stages, (list, tuple)):
            raise TypeError(f"stages takes a list of stages, got {type(stages).__name__}; write stages=[(f, {kind})]")
        self.stages = [self._stage(number, stage) for number, stage in enumerate(stages, start=1)]
        if not self.stages:
            raise ValueError(f"stages must have at least one stage, got none; write stages=[(f, {kind})]")

    def _stage(self, number: int, stage: Any) -> Stage:
        """Return a stage from one of its forms."""
        name = ""
        if hasattr(stage, "apply") and hasattr(stage, self.kind):
            name = type(stage).__name__
            stage = stage.apply, getattr(stage, self.kind)
        elif isinstance(stage, tuple) and len(stage) == 3:
            name, *stage = stage
        if not (len(stage) == 2 and all(map(callable, stage))):
            raise TypeError(f"stage {number} must be a pair of functions; write (f, {self.kind})")
        function, derivative = stage
        name = name or getattr(function, "__name__", "")
        if name in ("", "<lambda>", "apply"):
            return Stage(f"stage {number}", function, derivative)
        return Stage(f"stage {number} ({name})", function, derivative)

    def inputs(self, x: Any) -> Iterator[tuple[Stage, Any]]:
        """Yield each stage with its input."""
        for stage in self.stages:
            yield stage, x
            x = stage.function(copied(x))

    def completed(self, f: Any, derivative: Any) -> tuple[Any, Any]:
        """Return function and derivative of the whole program, composed of the stages where they are None."""
        if f is None:
            f = self.apply
        if derivative is None:
            derivative = {"vjp": self.pull, "jvp": self.push}[self.kind]
        return f, derivative

    def apply(self, x: Any) -> Any:
        """Run all stages."""
        for stage in self.stages:
            x = stage.function(x)
        return x

    def pull(self, x: Any, g: Any) -> Any:
        """Return the VJP of all stages."""
        for stage, point in reversed([*self.inputs(x)]):
            g = stage.derivative(point, g)
        return g

    def push(self, x: Any, t: Any) -> Any:
        """Return the JVP of all stages."""
        for stage, point in self.inputs(x):
            t = stage.derivative(point, t)
        return t
