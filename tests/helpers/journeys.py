"""What a call enters in the package: its journey, as a reader follows it."""

import gc
import sys
from pathlib import Path

import sparsedp as dp
from sparsedp.autodiff.backend import ARRAY_KINDS

PACKAGE = str(Path(dp.__file__).parent)


def journey(act):
    """Return the set of (file, line, function) of the package that a second call of ``act()`` enters."""
    kinds = dict(ARRAY_KINDS)
    ARRAY_KINDS.clear()  # another test of this process may have distributed fields, which the tape then looks for
    act()  # what is set up once is no part of it
    entered = set()

    def record(frame, event, argument):
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(PACKAGE):
            entered.add((code.co_filename, code.co_firstlineno, code.co_name))

    gc.disable()  # functions that it would call are not of the journey
    sys.setprofile(record)
    try:
        act()
    finally:
        sys.setprofile(None)
        gc.enable()
        ARRAY_KINDS.update(kinds)
    return entered


def check_journey(act, functions, files):
    """Assert that ``act()`` enters at most these numbers of functions and files."""
    entered = journey(act)
    assert len(entered) <= functions, (len(entered), sorted(entered))
    assert len({file for file, *_ in entered}) <= files, sorted(entered)
