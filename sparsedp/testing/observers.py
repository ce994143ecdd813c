"""Observers of the checks of a test. The plugin of pytest adds one while a test runs; without it there is none.

This module is part of every run of pytest in an environment with sparsedp. It imports the standard library only.
"""

from __future__ import annotations

from typing import Any, Protocol

__all__ = ["OBSERVERS", "Observer", "are_complete"]


class Observer(Protocol):
    """An object that `assert_gradient` and `assert_transpose` call with each result.

    Attributes
    ----------
    is_complete : bool
        Whether checks examine all directions by default.
    """

    is_complete: bool

    def note(self, result: Any, seconds: float, is_accepted: bool, file: str, line: int) -> None:
        """Note the result of a check that the given line of a file has called."""


OBSERVERS: list[Observer] = []  # the last one belongs to the running test


def are_complete() -> bool:
    """Return whether checks examine all directions by default."""
    return any(observer.is_complete for observer in OBSERVERS)
