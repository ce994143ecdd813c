"""Every error message of the package is printed by a test.

The messages are collected from the source; each must be matched, whole, by an expected message: a string in
tests/test_errors*.py (the table, whose tests print the messages) or a ``match=`` in any test.
"""

import ast
import re
from functools import cache

import pytest
from sources import FUNCTION, called, enclosing, modules, trees_of_tests, walked

pytestmark = pytest.mark.xdist_group("sources")  # of the tests that parse all files

HOLE = "\0"  # stands for what is put in at run time
LEAST = 8  # letters that a message must have written out
SILENT = {"SystemExit", "StopIteration", "KeyboardInterrupt"}  # carry no sentence


def sentences(node, scope):
    """All constant texts an expression can give, with HOLE for each part known only at run time."""
    if isinstance(node, ast.Constant):
        if isinstance(node.value, str):
            return [node.value]
        return [HOLE]
    if isinstance(node, ast.JoinedStr):
        return join([sentences(v, scope) if isinstance(v, ast.Constant) else [HOLE] for v in node.values])
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return join([sentences(node.left, scope), sentences(node.right, scope)])
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mod):
        return [re.sub(r"%[-+ #0-9.]*[a-zA-Z]", HOLE, text) for text in sentences(node.left, scope)]
    if isinstance(node, ast.IfExp):
        return sentences(node.body, scope) + sentences(node.orelse, scope)
    if isinstance(node, ast.Call) and getattr(node.func, "attr", None) == "format":
        return [re.sub(r"\{[^{}]*\}", HOLE, text) for text in sentences(node.func.value, scope)]
    if isinstance(node, (ast.Name, ast.Call)):
        found = scope.get(node.id if isinstance(node, ast.Name) else called(node), [])
        inner = {name: value for name, value in scope.items() if value is not found}  # no name is followed twice
        return [text for value in found for text in sentences(value, inner)] or [HOLE]
    return [HOLE]


def join(parts):
    """Every way to put one text of each part after another."""
    texts = [""]
    for part in parts:
        texts = [head + tail for head in texts for tail in part]
    return texts


@cache
def assigned(tree):
    """Return the expressions that each name stands for: strings given to variables, results of functions."""
    scope = {}
    for node in walked(tree):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            scope.setdefault(node.targets[0].id, []).append(node.value)
        elif isinstance(node, FUNCTION):
            scope.setdefault(node.name, [])
        elif isinstance(node, ast.Return) and node.value is not None:
            for function in enclosing(node, tree):
                scope.setdefault(function.name, []).append(node.value)
    return scope


def makes_error(call):
    name = called(call) or ""
    return name[:1].isupper() and name.endswith(("Error", "Exception", "Warning")) and bool(call.args)


def errors_in(tree):
    """Pairs (line, text) of every error that is made, raised on the spot or not."""
    outer = assigned(tree)
    for node in walked(tree):
        if isinstance(node, ast.Call) and makes_error(node):
            owner = next(enclosing(node, tree), None)
            scope = {**outer, **assigned(owner)} if owner else outer
            for text in sentences(node.args[0], scope):
                yield node.lineno, text
        elif isinstance(node, ast.Raise) and isinstance(node.exc, ast.Name):
            name = node.exc.id  # raise ValueError, without a sentence
            if name[:1].isupper() and name.endswith(("Error", "Exception")) and name not in SILENT:
                yield node.lineno, HOLE


def pattern(text):
    return re.compile(".*".join(re.escape(part) for part in text.split(HOLE)), re.DOTALL)


def plain(text):
    """An expected message as it is printed: no class in front, no regular-expression escapes."""
    return re.sub(r"^[A-Za-z.]*Error: ", "", re.sub(r"\\([^\w\s])", r"\1", text)).strip("^$")


def expected():
    """Every expected message the tests state."""
    found = set()
    for path, tree in trees_of_tests():
        nodes = walked(tree)
        if path.name.startswith("test_errors"):
            found |= {n.value for n in nodes if isinstance(n, ast.Constant) and isinstance(n.value, str)}
        keywords = [n for n in nodes if isinstance(n, ast.keyword) and n.arg == "match"]
        found |= {
            n.value.value for n in keywords if isinstance(n.value, ast.Constant) and isinstance(n.value.value, str)
        }
        calls = [n.value for n in keywords if isinstance(n.value, ast.Call) and called(n.value) == "escape"]
        found |= {call.args[0].value for call in calls if isinstance(call.args[0], ast.Constant)}
    return {plain(text) for text in found}


@cache
def collected():
    return [(f"{m.place}:{line}", text) for m in modules() for line, text in errors_in(m.tree)]


def is_printed(text, known):
    """Whether an expected message is this one; only those that hold its longest part are looked at closely."""
    longest = max(text.split(HOLE), key=len)
    return any(map(pattern(text).fullmatch, (message for message in known if longest in message)))


def shown(text):
    return text.replace(HOLE, "{}")


def test_every_message_is_a_sentence_written_at_its_place():
    vague = [f"{at} {shown(text)}" for at, text in collected() if sum(c.isalpha() for c in text) < LEAST]
    assert not vague, "write the sentence where the error is raised:\n" + "\n".join(vague)


def test_every_message_is_printed_by_a_test():
    known = expected()
    silent = [f"{at} {shown(text)}" for at, text in collected() if not is_printed(text, known)]
    assert not silent, f"{len(silent)} messages are in no test:\n" + "\n".join(silent)


def test_the_collector_reads_all_ways_to_write_a_message():
    source = """
def reason(n):
    return f"too many cells: {n}"
def check(u, n):
    if n:
        raise ValueError(f"got {n} values, " "needs" + f" {u}")
    message = "one cell" if u else "no cells at all"
    error = ShapeError(message)
    raise ValueError(reason(n)) from error
"""
    texts = {shown(text) for _, text in errors_in(ast.parse(source))}
    assert texts == {"got {} values, needs {}", "one cell", "no cells at all", "too many cells: {}"}
    assert pattern("got \0 values").fullmatch(plain(r"ValueError: got \(3, 4\) values"))
    assert not pattern("got \0 values").fullmatch("got 3 value")
