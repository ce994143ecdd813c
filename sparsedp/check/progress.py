"""What an audit shows while it runs, to those who watch a terminal: how much is to come, and a bar where tqdm is."""

import sys
from contextlib import contextmanager

__all__ = ["shown"]


@contextmanager
def shown(total):
    """A `with` block of about `total` evaluations of a loss; yields what is to be called at each."""
    if not sys.stderr.isatty():
        yield lambda: None
        return
    sys.stderr.write(f"check.gradient: about {total} evaluations of the loss to come\n")
    try:
        from tqdm import tqdm
    except ImportError:
        yield lambda: None
        return
    with tqdm(total=total, desc="check.gradient", unit="evaluation", leave=False) as bar:
        yield bar.update
