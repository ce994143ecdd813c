"""Tables of benchmarks with one row a scene: their command line, and the lines of a scene."""

import argparse
import inspect


def lines(scene):
    """Return the number of lines of code of a scene, without its docstring."""
    body = inspect.getsource(scene).replace(f'"""{scene.__doc__}"""', "").splitlines()[1:]
    return sum(bool(line.strip()) for line in body)


def print_rows(description, columns, cases, row):
    """Print the rows of the cases that are named on the command line, by default of all.

    Parameters
    ----------
    description : str
        What the command line describes, of which the first line is shown.
    columns : str
        The names of the columns, separated by " | ".
    cases : iterable of str
        Names of cases.
    row : callable
        ``row(name, quick)`` returns the other cells of a row, separated by " | ".
    """
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    parser.add_argument("names", nargs="*")
    parser.add_argument("--quick", action="store_true")
    given = parser.parse_args()
    print(f"| {columns} |\n|{'---|' * len(columns.split(' | '))}")
    for name in cases:
        if not given.names or any(part.lower() in name.lower() for part in given.names):
            print(f"| {name} | {row(name, given.quick)} |", flush=True)
