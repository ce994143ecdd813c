"""The package as text: its modules, what they import, what they define. Nothing is executed."""

import ast
import gc
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
PACKAGE = ROOT / "sparsedp"
FUNCTION = (ast.FunctionDef, ast.AsyncFunctionDef)
LOADERS = ("import_module", "__import__", "find_spec")


@dataclass(frozen=True, eq=False)
class Module:
    """One file of the package."""

    path: Path
    text: str
    tree: ast.Module

    @property
    def place(self):
        """Path inside the package, such as "solvers/solve.py"."""
        return self.path.relative_to(PACKAGE).as_posix()

    @property
    def name(self):
        """Dotted name, such as "sparsedp.solvers.structured_multigrid"."""
        parts = self.path.relative_to(ROOT).with_suffix("").parts
        return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)

    @property
    def package(self):
        """Dotted name of the folder that holds the file."""
        return ".".join(self.path.parent.relative_to(ROOT).parts)

    def nodes(self, kind):
        return [node for node in walked(self.tree) if isinstance(node, kind)]


@cache
def walked(tree):
    """All nodes of a tree, in the order of ast.walk, which takes three times as long."""
    return tuple(parents(tree))


@cache
def parents(tree):
    """The parent of every node of a tree, None for the tree, in the order of ast.walk."""
    found = {tree: None}
    nodes = [tree]
    for node in nodes:
        children = []
        for name in node._fields:
            value = getattr(node, name, None)
            if isinstance(value, list):
                children += [part for part in value if isinstance(part, ast.AST)]
            elif isinstance(value, ast.AST):
                children.append(value)
        found.update(dict.fromkeys(children, node))
        nodes += children
    return found


def enclosing(node, tree):
    """Yield the functions of a tree in which a node stands, the innermost first; not the node itself."""
    above = parents(tree)
    while (node := above[node]) is not None:
        if isinstance(node, FUNCTION):
            yield node


@cache
def modules():
    """All modules of the package, in the order of their paths."""
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        found.append(Module(path, text, ast.parse(text, filename=str(path))))
    return tuple(found)


@cache
def trees_of_tests():
    """Pairs (path, syntax tree) of all files of the tests, in the order of their paths."""
    paths = sorted((ROOT / "tests").rglob("*.py"))
    gc.disable()  # a million objects that stay: looking through them again and again takes four times the parsing
    try:
        return tuple((path, ast.parse(path.read_text(encoding="utf-8"))) for path in paths)
    finally:
        gc.freeze()
        gc.enable()


@cache
def names():
    """Dotted names of all modules and folders of modules."""
    return {module.name for module in modules()} | {module.package for module in modules()}


def resolve(package, node):
    """Absolute name of what an ImportFrom node imports from."""
    if not node.level:
        return node.module
    base = package.split(".")[: len(package.split(".")) - node.level + 1]
    return ".".join([*base, *([node.module] if node.module else [])])


def called(node):
    """Last name of what a Call node calls: "f" for f(x) and for a.f(x)."""
    return getattr(node.func, "id", None) or getattr(node.func, "attr", None)


@cache
def imports(module):
    """Pairs (absolute dotted name, line) of all a module imports, at its top or inside functions.

    ``from a import b`` counts as ``a.b``, except that a name of our own package that is no module
    counts as the module it is taken from.
    """
    ours = names()
    found = []
    for node in walked(module.tree):
        if isinstance(node, ast.Import):
            found += [(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            source = resolve(module.package, node)
            for full in (f"{source}.{alias.name}" for alias in node.names):
                found.append((full if full in ours or not within(source, "sparsedp") else source, node.lineno))
        elif isinstance(node, ast.Call) and called(node) in LOADERS and node.args:
            target = node.args[0]
            if isinstance(target, ast.Constant) and isinstance(target.value, str):
                name = target.value
                found.append((f"{module.package}.{name.lstrip('.')}" if name.startswith(".") else name, node.lineno))
    return found


KEEPERS = ("__main__.py", "kernels/__init__.py", "kernels/team.py")  # know of numba, have nothing to compile


def jitted(module):
    """Names of the functions of a module that go, or could go, through numba's compiler.

    In a module that imports numba or the maker of kernels these are all that are decorated, by whatever name, and all
    that are handed on as a value: to njit, to Kernel, in `uses`, in `given`, in a table. Only what is called plainly is
    Python's. A lambda has no name and counts by its line.
    """
    compiles = any(within(name, "numba") or within(name, "sparsedp.kernels.team") for name, _ in imports(module))
    if not compiles or module.place in KEEPERS:
        return set()
    methods = {id(node) for kind in module.nodes(ast.ClassDef) for node in kind.body}
    called_ones = {id(node.func) for node in module.nodes(ast.Call)}
    values = {n.id for n in module.nodes(ast.Name) if isinstance(n.ctx, ast.Load) and id(n) not in called_ones}
    handed_on = {f.name for f in module.nodes(FUNCTION) if f.name in values and id(f) not in methods}
    decorated = {f.name for f in module.nodes(FUNCTION) if f.decorator_list}
    return handed_on | decorated | {f"lambda:{node.lineno}" for node in module.nodes(ast.Lambda)}


def within(name, prefix):
    """True when a dotted name is the prefix or lies under it."""
    return name == prefix or name.startswith(prefix + ".")


def definitions(module):
    """Public functions and classes at the top level of a module."""
    return [n for n in module.tree.body if isinstance(n, (*FUNCTION, ast.ClassDef)) and not n.name.startswith("_")]


def exported(module):
    """Names in ``__all__`` when the module has one written out, else its public definitions."""
    for node in module.tree.body:
        if isinstance(node, ast.Assign) and any(getattr(t, "id", None) == "__all__" for t in node.targets):
            if isinstance(node.value, (ast.List, ast.Tuple)):
                return [ast.literal_eval(item) for item in node.value.elts]
    return [node.name for node in definitions(module)]
