"""The progress bar. The only file below the side rooms that asks for tqdm, and only when a bar is wanted."""

__all__ = ["Bar", "Silence", "progress_bar"]


def progress_bar(wanted, total):
    """False -> a bar that shows nothing; True or a label -> a bar of `total` iterations on standard error.

    Raises
    ------
    ImportError
        If a bar is wanted and tqdm is not installed.
    """
    if not wanted:
        return Silence()
    try:
        from tqdm import tqdm
    except ImportError as error:
        raise ImportError("a progress bar needs tqdm; install sparsedp[plot], or leave progress out") from error
    return Bar(tqdm(total=total, desc=wanted if isinstance(wanted, str) else "minimize", leave=True))


class Silence:
    """A bar that shows nothing."""

    def show(self, record):
        """Nothing."""

    def close(self):
        """Nothing."""


class Bar:
    """A bar that moves by one for each iteration and shows loss and gradient."""

    def __init__(self, bar):
        self._bar = bar

    def show(self, record):
        """Move on, unless this is the start."""
        refused = f", {len(record.failed)} refused" if record.failed else ""
        self._bar.set_postfix_str(f"loss {record.value:.6g}, gradient {record.gradient_norm:.1e}{refused}")
        self._bar.update(1 if record.iteration else 0)

    def close(self):
        """Leave the line as it is."""
        self._bar.close()
