"""Write a scene as a program that stands alone: it needs Python, NumPy, autograd and the library, not this folder."""

import ast
import builtins
from pathlib import Path

HELPERS = Path(__file__).resolve().parent.parent
FILES = [
    HELPERS / "dense.py",
    HELPERS / "eulerian_reference.py",
    HELPERS / "semi_lagrangian_reference.py",
    *(HELPERS / "campaign" / f"{name}.py" for name in ("boxes", "operators", "ingredients", "physics", "scene")),
]
OWN = {path.stem for path in FILES} | {"campaign"}


def definitions(path):
    """Return (statements that import foreign modules, text of each top-level definition by name) of a file."""
    text = path.read_text(encoding="utf-8")
    foreign = []
    found = {}
    for node in ast.parse(text).body:
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            module = node.module if isinstance(node, ast.ImportFrom) else node.names[0].name
            if module.split(".")[0] not in OWN:
                foreign.append(node)
            continue
        names = []
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names = [node.name]
        elif isinstance(node, ast.Assign):
            names = [target.id for target in node.targets if isinstance(target, ast.Name)]
        for name in names:
            found[name] = with_decorators(text, node)
    return foreign, found


def with_decorators(text, node):
    lines = text.splitlines()
    first = min([node.lineno, *(one.lineno for one in getattr(node, "decorator_list", []))])
    return "\n".join(lines[first - 1 : node.end_lineno])


def names_in(text):
    """Return the names that a text reads, builtins left out."""
    read = {node.id for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Name)}
    return read - set(dir(builtins))


def aliases(path):
    """Return the names under which a file knows definitions of the other files: {own name: name there}."""
    found = {}
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] in OWN:
            found.update({one.asname: one.name for one in node.names if one.asname})
    return found


def bundle(start):
    """Return the source of all definitions that a text needs, in the order of the files."""
    imported = []
    defined = {}
    renamed = {}
    for path in FILES:
        foreign, found = definitions(path)
        double = set(found) & set(defined)
        if double:
            raise ValueError(f"{', '.join(sorted(double))} is defined in {path.name} and in another helper; rename it")
        imported += foreign
        defined.update(found)
        renamed.update(aliases(path))
    needed = set()
    waiting = names_in(start)
    while waiting:
        name = waiting.pop()
        if name in needed:
            continue
        needed.add(name)
        if name in renamed:
            waiting.add(renamed[name])
        if name in defined:
            waiting |= names_in(defined[name]) - needed
    parts = [text for name, text in defined.items() if name in needed]
    lines = [f"{own} = {name}" for own, name in renamed.items() if own in needed]
    for number, line in enumerate(lines):  # an alias follows its definition
        place = parts.index(defined[line.partition(" = ")[2]]) + 1
        parts.insert(place, lines[number])
    return used_imports(imported, needed), parts


def used_imports(nodes, needed):
    """Return the lines that import what is needed, each once."""
    lines = []
    for node in nodes:
        for one in node.names:
            name = (one.asname or one.name).split(".")[0]
            renaming = f" as {one.asname}" if one.asname else ""
            if name not in needed:
                continue
            if isinstance(node, ast.Import):
                lines.append(f"import {one.name}{renaming}")
            else:
                lines.append(f"from {node.module} import {one.name}{renaming}")
    return sorted(set(lines))


def script(scene, message):
    """Return the text of a program that compares one scene with its twin and fails as it failed here."""
    program = f"scene = {scene!r}\nprint(compare(scene))"
    imports, parts = bundle(program)
    reason = "\n".join(f"# {line}" for line in message.splitlines())
    return "\n".join([reason, *imports, "", "\n\n\n".join(parts), "", program, ""])
