"""The progress bar of a search."""

from contextlib import contextmanager

from sparsedp.progress import bar

__all__ = ["progress_bar"]


@contextmanager
def progress_bar(wanted, total):
    """True or a label -> a bar of `total` iterations on standard error: a function that shows a record; False: nothing.

    Raises
    ------
    ImportError
        If a bar is wanted and tqdm is not installed.
    """
    if not wanted:
        yield lambda record: None
        return
    with bar(total=total, desc=wanted if isinstance(wanted, str) else "minimize") as shown:

        def show(record):
            refused = f", {len(record.failed)} refused" if record.failed else ""
            shown.set_postfix_str(f"loss {record.value:.6g}, gradient {record.gradient_norm:.1e}{refused}")
            shown.update(1 if record.iteration else 0)

        yield show
