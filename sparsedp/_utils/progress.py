"""Progress bars: the only file that asks for tqdm, and only when a bar is wanted."""

__all__ = ["bar", "shown_steps"]


def bar(steps=None, needed=True, **options):
    """Steps -> a bar of tqdm over them, on standard error; the steps as they are where it is neither there nor needed.

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


def shown_steps(wanted, steps, label):
    """Step numbers -> the same, with a bar when one is wanted (True, or its label)."""
    if not wanted:
        return steps
    return bar(steps, desc=f"{wanted} {label}" if isinstance(wanted, str) else label, leave=False)
