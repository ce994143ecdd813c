"""The progress bar. The only file below the side rooms that asks for tqdm, and only when a bar is wanted."""

from contextlib import contextmanager

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
    try:
        from tqdm import tqdm
    except ImportError as error:
        raise ImportError("a progress bar needs tqdm; install sparsedp[plot], or leave progress out") from error
    with tqdm(total=total, desc=wanted if isinstance(wanted, str) else "minimize") as bar:

        def show(record):
            refused = f", {len(record.failed)} refused" if record.failed else ""
            bar.set_postfix_str(f"loss {record.value:.6g}, gradient {record.gradient_norm:.1e}{refused}")
            bar.update(1 if record.iteration else 0)

        yield show
