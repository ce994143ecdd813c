"""The verdicts of four checks on the collection of wrong and right derivatives.

Run ``python -m benchmarks.wrong_adjoints [--markdown]`` in the root of the repository. It needs torch and jax.
"""

import re
import sys
import time

import numpy as np

import sparsedp as dp
from benchmarks.wrong_adjoints import RIGHT, WRONG
from benchmarks.wrong_adjoints.other_checks import check_grads, gradcheck, taylor

CHECKS = ("check.vjp", "gradcheck", "check_grads", "Taylor")
OTHERS = {"gradcheck": gradcheck, "check_grads": check_grads, "Taylor": taylor}


def own_check(case):
    """Return the result of `check.vjp` for a case."""
    program = case.program()
    return dp.check.vjp(program.f, program.vjp, program.x, stages=program.stages or None)


def other_verdict(case, name):
    """Return the verdict of another check, or the type of the error that it raises."""
    try:
        return OTHERS[name](case.program())
    except Exception as error:
        return type(error).__name__


def finding_of(result):
    """Return the culprit, or a reason that tells more than the size of the gap."""
    if result.culprit:
        return result.culprit
    if result.verdict == "disagrees" and result.reason.startswith("along"):
        return ""
    return result.reason.partition(", w 1: ")[2] or result.reason


def place_of(result):
    """Return the name of the entry with the largest gap, or of the region of all wrong entries."""
    if not result.gaps:
        return ""
    entry = result.gaps[0]
    if result.culprit:
        entry = entry.removeprefix(f"{result.culprit}: ")
    region = re.search(r"all of the gap in .* lies in (\S+\[.*?\])|as in all of (\S+\[.*?\])", entry)
    if region:
        return region[1] or region[2]
    return entry.partition(":")[0]


def row_of(case):
    """Return the row of a case: the case, four verdicts, finding, entry, runs, and seconds of the four checks."""
    verdicts = []
    seconds = []
    with np.errstate(all="ignore"):
        begin = time.perf_counter()
        result = own_check(case)
        seconds.append(time.perf_counter() - begin)
        verdicts.append(result.verdict)
        for name in OTHERS:
            begin = time.perf_counter()
            verdicts.append(other_verdict(case, name))
            seconds.append(time.perf_counter() - begin)
    return case, verdicts, finding_of(result), place_of(result), result.evaluations, seconds


def is_false(case, verdict):
    """Return whether a verdict is false: "agrees" for a wrong derivative, or "disagrees" for a right one."""
    return verdict == ("agrees" if case.is_wrong else "disagrees")


def text_of(row):
    """Return the cells of a row as text."""
    case, verdicts, finding, entry, runs, seconds = row
    marked = [f"{verdict} (false)" if is_false(case, verdict) else verdict for verdict in verdicts]
    times = " ".join(f"{value:.2f}" for value in seconds)
    return [case.name, case.kind, *marked, finding, entry, str(runs), times]


def totals(rows):
    """Return for each check the numbers of false "agrees", false "disagrees", inconclusive verdicts and errors."""
    lines = []
    for number, name in enumerate(CHECKS):
        verdicts = [(case, words[number]) for case, words, *_ in rows]
        false = [case for case, verdict in verdicts if is_false(case, verdict)]
        wrong = sum(case.is_wrong for case in false)
        open_ones = sum(verdict == "inconclusive" for _, verdict in verdicts)
        errors = sum(verdict not in ("agrees", "disagrees", "inconclusive") for _, verdict in verdicts)
        seconds = sum(row[-1][number] for row in rows)
        cells = (wrong, len(false) - wrong, open_ones, errors)
        lines.append([name, *map(str, cells), f"{seconds:.1f}"])
    return lines


def print_table(titles, rows, is_markdown):
    """Print rows of text in columns, or as a table of Markdown."""
    if is_markdown:
        print("|", " | ".join(titles), "|")
        print("|---" * len(titles) + "|")
        for row in rows:
            print("|", " | ".join(f"`{cell}`" if "[" in cell else cell for cell in row), "|")
        return
    widths = [max(map(len, column)) for column in zip(titles, *rows)]
    for row in [titles, *rows]:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip())


def main(is_markdown):
    """Print the tables of wrong and of right derivatives, and the totals."""
    row_of(RIGHT[0])  # imports
    titles = ["program", "fault", *CHECKS, "culprit or reason", "entry", "runs", "seconds"]
    rows = []
    for cases in (WRONG, RIGHT):
        new = [row_of(case) for case in cases]
        print_table(titles, [text_of(row) for row in new], is_markdown)
        print()
        titles[1] = "difficulty"
        rows += new
    titles = ["check", 'false "agrees"', 'false "disagrees"', "inconclusive", "errors", "seconds"]
    print_table(titles, totals(rows), is_markdown)


if __name__ == "__main__":
    main("--markdown" in sys.argv[1:])
