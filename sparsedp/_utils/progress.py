"""Progress bars. Only this module imports tqdm, and only when a bar is shown."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable

__all__ = ["bar", "shown_steps"]


def bar(steps: Any = None, needed: bool = True, **options: Any) -> Any:
    """Return a progress bar of tqdm over some steps, on standard error.

    Parameters
    ----------
    steps : iterable, optional
    needed : bool
        Whether to raise an error if tqdm is not installed; otherwise the steps are returned without a bar.
    **options
        Options of tqdm.

    Raises
    ------
    ImportError
        If `needed` is True and tqdm is not installed.
    """
    try:
        from tqdm.auto import tqdm  # `auto` shows a widget in a notebook
    except ImportError as error:
        if needed:
            raise ImportError("a progress bar needs tqdm; install sparsedp[plot], or leave progress out") from error
        return steps
    return tqdm(steps, **options)


def shown_steps(progress: bool | str, steps: Iterable, label: str) -> Iterable:
    """Return an iterable over `steps`, with a progress bar if `progress` is True or a string (the title of the bar)."""
    if not progress:
        return steps
    title = f"{progress} {label}" if isinstance(progress, str) else label
    return bar(steps, desc=title, leave=False)
