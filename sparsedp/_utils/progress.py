"""Progress bars. Only this module imports tqdm, and only if a bar is asked for."""

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
        Whether a missing tqdm is an error; if not, the steps are returned as they are.
    **options
        Of tqdm.

    Raises
    ------
    ImportError
        If a bar is needed and tqdm is not installed.
    """
    try:
        from tqdm.auto import tqdm  # a widget in a notebook
    except ImportError as error:
        if needed:
            raise ImportError("a progress bar needs tqdm; install sparsedp[plot], or leave progress out") from error
        return steps
    return tqdm(steps, **options)


def shown_steps(progress: bool | str, steps: Iterable, label: str) -> Iterable:
    """Return the numbers of steps, with a progress bar if `progress` is True or the title of a bar."""
    if not progress:
        return steps
    title = f"{progress} {label}" if isinstance(progress, str) else label
    return bar(steps, desc=title, leave=False)
