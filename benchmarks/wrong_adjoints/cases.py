"""The records of the collection: programs with a derivative written by hand, and what is known of it."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

__all__ = ["EVERY", "Case", "Program", "chained", "right", "wrong"]

EVERY = ...  # an index that selects all entries


class Program(NamedTuple):
    """A program with its derivative: ``f(x)`` and ``vjp(x, g)``, the product of g with the Jacobian at x."""

    f: Callable[[Any], Any]
    vjp: Callable[[Any, Any], Any]
    x: Any
    stages: tuple = ()


@dataclass(frozen=True)
class Case:
    """A program of the collection.

    Attributes
    ----------
    name, summary : str
    build : callable
        Return f, vjp, x, and the stages if the program has stages.
    kind : str
        The planted fault; of a right derivative what makes it hard to check.
    entries : index, or dict of indices by leaf of x
        The entries of x in which the VJP is wrong.
    culprit : str
        The stage whose VJP is wrong.
    diagnosis : str
        Words by which `check.vjp` describes the mistake, if it is one that it recognizes.
    undecidable : str
        Why values of f cannot show that the derivative is right.
    """

    name: str
    summary: str
    build: Callable[[], tuple]
    kind: str
    is_wrong: bool
    entries: Any = None
    culprit: str = ""
    diagnosis: str = ""
    undecidable: str = ""

    def program(self) -> Program:
        """Return a new copy of the program."""
        return Program(*self.build())


def _case(build, kind, is_wrong, **known):
    """Return the record of a program, whose name and summary are those of the function that builds it."""
    summary = build.__doc__.strip().removesuffix(".")
    return Case(build.__name__.replace("_", " "), summary, build, kind, is_wrong, **known)


def wrong(fault, entries=EVERY, culprit="", diagnosis=""):
    """Return a decorator for a program with a planted fault."""
    return lambda build: _case(build, fault, True, entries=entries, culprit=culprit, diagnosis=diagnosis)


def right(difficulty, undecidable=""):
    """Return a decorator for a program with a right derivative that is hard to check."""
    return lambda build: _case(build, difficulty, False, undecidable=undecidable)


def chained(x, *stages):
    """Return the program that runs some stages in turn. A stage is a pair of a function and its VJP."""

    def f(u):
        return functools.reduce(lambda value, stage: stage[0](value), stages, u)

    def vjp(u, g):
        values = [u]
        for function, _ in stages[:-1]:
            values.append(function(values[-1]))
        for value, (_, pullback) in zip(reversed(values), reversed(stages)):
            g = pullback(value, g)
        return g

    return f, vjp, x, stages
