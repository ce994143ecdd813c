"""Tables of benchmarks with one row a scene: their command line, and the lines of a scene."""

import argparse
import ast
import inspect
import textwrap


def lines(scene):
    """Return the number of lines of code of a scene, without its signature and its docstrings.

    Parameters
    ----------
    scene : function or class
        A function gives the lines of its body, a class all lines below ``class``.
    """
    source = textwrap.dedent(inspect.getsource(scene))
    definition = ast.parse(source).body[0]
    code = {number for number, line in enumerate(source.splitlines(), 1) if line.strip()}
    for node in ast.walk(definition):
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and ast.get_docstring(node) is not None:
            docstring = node.body[0]
            code -= set(range(docstring.lineno, docstring.end_lineno + 1))
    return sum(number >= definition.body[0].lineno for number in code)


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
