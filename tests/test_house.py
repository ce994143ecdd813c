"""The rules of the house: layers, doors of foreign libraries, names, the public window, the catalogue."""

import ast
import importlib.util
import os
import re
import subprocess
import sys

import pytest
from sources import (
    FUNCTION,
    PACKAGE,
    ROOT,
    Module,
    definitions,
    exported,
    imports,
    jitted,
    modules,
    names,
    trees_of_tests,
    within,
)

import sparsedp

FLOORS = [
    ("errors", -1),
    ("_utils", 0),
    ("kernels", 0),
    ("autodiff", 1),
    ("grid", 2),
    ("io", 3),
    ("operators", 3),
    ("solvers", 4),
    ("advection", 4),
    ("flow", 5),
    ("integrators", 5),
    ("trajectory", 6),
    ("optimize", 7),
    ("network", 7),
    ("parallel", 8),
    ("interop", 8),
]
FLOOR = dict(FLOORS)
SIDE = {
    "check": {"check"},
    "report": {"report", "check"},
    "testing": {"testing", "check"},
}  # side room: the side rooms it may import
ROOF = {"__init__", "__main__"}

# A foreign name, the places in the package that may import it, and the names under it that are open to all.
DOORS = [
    ("autograd", r"autodiff/(tape|program_trace)\.py", ("autograd.numpy",)),
    ("autograd.extend", r"autodiff/tape\.py", ()),
    ("autograd.numpy.numpy_boxes", r"autodiff/tape\.py", ()),
    ("autograd.numpy.numpy_vspaces", r"autodiff/tape\.py", ()),
    ("autograd.numpy.numpy_wrapper", r"autodiff/tape\.py", ()),
    ("pyamg", r"solvers/algebraic_multigrid\.py", ()),
    ("llvmlite", r"autodiff/compiled_program\.py", ()),
    ("numba", r"kernels/.*|solvers/structured_multigrid/loops\.py", ()),
    ("matplotlib", r"report/plots\.py", ()),
    ("tqdm", r"_utils/progress\.py", ()),
    ("mpi4py", r"parallel/.*", ()),
    ("petsc4py", r"parallel/.*", ()),
    ("cloudpickle", r"parallel/.*", ()),
    ("nlopt", r"optimize/mma\.py", ()),
    ("cyipopt", r"optimize/ipopt\.py", ()),
    ("torch", r"interop/torch_bridge\.py", ()),
    ("jax", r"interop/jax_bridge\.py", ()),
    ("pint", r"interop/units\.py", ()),
    ("PIL", r"io/pictures\.py|report/plots\.py", ()),
    ("xarray", r"io/labelled\.py", ()),
    ("h5netcdf", r"io/labelled\.py", ()),
    ("pyevtk", r"io/paraview\.py", ()),
    ("pytest", r"testing/plugin\.py", ()),
    ("hypothesis", r"testing/strategies\.py", ()),
]
TALKS = r"report/.*|__main__\.py"  # may print
NOWHERE = {"utils.py", "util.py", "helpers.py", "helper.py", "misc.py", "common.py"}
OURS = ("sparsedp", "tests", "benchmarks", "examples")  # folders of Python files that belong to the project
CLOSURES = {"integrators.stepper": 49, "solvers.inverse": 39, "operators.difference": 26}  # files an import loads
EXTRAS = (
    "numba",
    "matplotlib",
    "tqdm",
    "mpi4py",
    "petsc4py",
    "nlopt",
    "cyipopt",
    "torch",
    "jax",
    "pint",
    "PIL",
    "xarray",
    "pyevtk",
    "llvmlite",
)  # foreign libraries that need not be there
LAZY = (
    "pyamg",
    "numba",
    "matplotlib",
    "tqdm",
    "mpi4py",
    "petsc4py",
    "nlopt",
    "cyipopt",
    "torch",
    "jax",
    "pint",
    "xarray",
    "pyevtk",
    "scipy",
    "autograd",
    "numpy",
)  # not touched by `import sparsedp`
UNFINISHED = r"\b(?:TO" + r"DO|FIX" + r"ME|X" + r"XX|NotImplemented" + r"Error)\b"


def none(wrong):
    """Fail with one line for each thing that is wrong."""
    wrong = list(wrong)
    assert not wrong, "\n" + "\n".join(wrong)


def room(name):
    """First part of a module's name inside the package; "__init__" for the package itself."""
    return (name.split(".") + ["__init__"])[1]


def may_import(importer, target):
    """Whether a module may import another module of the package, both by dotted name."""
    here = room(importer)
    there = room(target)
    if here in ROOF or here == there:
        return True
    if there in ROOF:
        return there == "__init__" and here in SIDE  # the shop window is lazy: side rooms may use it as a user does
    if there in SIDE:
        return there in SIDE.get(here, ())
    return here in SIDE or FLOOR.get(there, 99) < FLOOR.get(here, -1)


# ---- floors and doors ----------------------------------------------------------------------------------------------


def test_every_module_has_a_floor():
    none(f"{m.place}: give it a floor in FLOORS" for m in modules() if room(m.name) not in {*FLOOR, *SIDE, *ROOF})


def test_the_floors_are_those_of_the_page():
    """Every floor exists, and CONTRIBUTING.md and docs/where.md have the same packages on it."""
    none(f"{name} is no room of the package" for name in FLOOR if not any(room(m.name) == name for m in modules()))
    rows = re.findall(r"^\| (-?\d+) \| (.*?) \|$", (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"), re.MULTILINE)
    told = {name: int(number) for number, names in rows for name in re.findall(r"`(\w+)/?`", names)}
    assert told == FLOOR
    assert layers_of_where() == FLOOR


def layers_of_where():
    """Return the layer of each package in the text block of docs/where.md; a line without a number repeats it."""
    text = (ROOT / "docs" / "where.md").read_text(encoding="utf-8").split("```text\n")[1].split("```")[0]
    layers = {}
    layer = None
    for number, package in re.findall(r"^ *(-?\d*) +(\w+)/? ", text, re.MULTILINE):
        if number:
            layer = int(number)
        layers[package] = layer
    return layers


def test_every_folder_is_a_package():
    folders = sorted({path.parent for path in PACKAGE.rglob("*.py")})
    none(
        f"{folder.relative_to(ROOT)} has no __init__.py" for folder in folders if not (folder / "__init__.py").exists()
    )


def test_imports_go_to_lower_floors():
    none(
        f"{m.place}:{line} imports {target}, which is not below it"
        for m in modules()
        for target, line in imports(m)
        if within(target, "sparsedp") and not may_import(m.name, target)
    )


def test_no_import_cycles():
    graph = {m.name: {target for target, _ in imports(m) if target in names()} for m in modules()}
    while True:  # what imports nothing, or is imported by nothing, is in no cycle
        imported = set().union(*graph.values())
        inner = {name for name, targets in graph.items() if targets and name in imported}
        if len(inner) == len(graph):
            break
        graph = {name: graph[name] & inner for name in inner}
    none(f"{name} is in an import cycle with {', '.join(sorted(targets))}" for name, targets in graph.items())


@pytest.mark.parametrize("name", CLOSURES)
def test_importing_one_thing_does_not_load_everything(name):
    """Counted are the files of our own at the top of whose importers they stand."""
    files = {m.name: m for m in modules()}
    found = set()
    waiting = [f"sparsedp.{name}"]
    while waiting:
        module = waiting.pop()
        if module in files and module not in found:
            found.add(module)
            top = {node.lineno for node in files[module].tree.body}
            waiting += [target for target, line in imports(files[module]) if line in top]
    assert len(found) <= CLOSURES[name], sorted(found)


PRIVATE = {("kernels/__init__.py", "scipy.sparse._sparsetools.csr_matvec")}


def test_foreign_libraries_come_through_their_door():
    none(
        f"{m.place}:{line} imports {target}; only {place} may"
        for m in modules()
        for target, line in imports(m)
        for foreign, place, open_to_all in DOORS
        if within(target, foreign) and not any(within(target, name) for name in open_to_all)
        if not re.fullmatch(place, m.place)
    )


def test_no_private_names_of_foreign_libraries():
    """They may change with any release; what autograd's tape needs stands behind its door.

    `PRIVATE` has the exceptions: each import is guarded, its result is tested at run time, and public names replace it.
    """
    none(
        f"{m.place}:{line} imports {target}"
        for m in modules()
        for target, line in imports(m)
        if not within(target, "sparsedp") and m.place != "autodiff/tape.py"
        if any(part.startswith("_") and not part.endswith("__") for part in target.split("."))
        if (m.place, target) not in PRIVATE
    )


def test_traced_values_are_opened_in_few_places():
    """What `tape.py` shows of autograd has names; these attributes have none."""
    doors = (
        "autodiff/backend.py",
        "autodiff/fast_derivatives.py",
        "autodiff/jit.py",
        "autodiff/program_trace.py",
        "autodiff/tape.py",
        "check/nodes.py",
        "trajectory/rollout.py",
    )
    none(
        f"{m.place}:{node.lineno} reads {ast.unparse(node)}"
        for m in modules()
        for node in m.nodes(ast.Attribute)
        if node.attr in ("_value", "_trace", "_node") and ast.unparse(node.value) != "self"
        if m.place not in doors
    )


def test_floors_rule_sees_a_wrong_import():
    assert not may_import("sparsedp.autodiff.tape", "sparsedp.grid.grid")
    assert not may_import("sparsedp.solvers.choose_method", "sparsedp.advection")
    assert not may_import("sparsedp.operators.operator", "sparsedp")
    assert not may_import("sparsedp.solvers.choose_method", "sparsedp.check")
    assert not may_import("sparsedp.check.operators", "sparsedp.report.plots")
    assert may_import("sparsedp.solvers.choose_method", "sparsedp.solvers.direct")
    assert may_import("sparsedp.report.explain", "sparsedp.check.operators")


# ---- files and names -------------------------------------------------------------------------------------------------


def test_no_rooms_for_leftovers():
    # only what is ours: a virtual environment in the checkout holds the files of others
    found = [*ROOT.glob("*.py"), *(path for folder in OURS for path in (ROOT / folder).rglob("*.py"))]
    none(f"{path}: name it after what it does" for path in found if path.name in NOWHERE)


def test_no_star_imports():
    none(
        f"{m.place}:{node.lineno} imports *"
        for m in modules()
        for node in m.nodes(ast.ImportFrom)
        if any(alias.name == "*" for alias in node.names)
    )


def test_no_print_in_the_library():
    none(
        f"{m.place}:{node.lineno} prints"
        for m in modules()
        if not re.fullmatch(TALKS, m.place)
        for node in m.nodes(ast.Call)
        if getattr(node.func, "id", None) in ("print", "pprint")
    )


def test_nothing_unfinished():
    texts = [
        (m.place, re.sub(r"except [^:]*:|NO_JVP = .*", "", m.text)) for m in modules()
    ]  # SciPy's own may be caught
    none(f"{place}: {word}" for place, text in texts for word in re.findall(UNFINISHED, text))


def test_no_setters_and_no_caches_of_a_module():
    decorators = [(m, d) for m in modules() for f in m.nodes((*FUNCTION, ast.ClassDef)) for d in f.decorator_list]
    words = [(m, d, (ast.unparse(d).split("(")[0]).split(".")[-1]) for m, d in decorators]
    # A compiled kernel belongs to the process, like the code itself; so does what a worker of a pool has unpacked.
    words = [(m, d, word) for m, d, word in words if word == "setter" or room(m.name) not in ("kernels", "parallel")]
    none(f"{m.place}:{d.lineno} @{word}" for m, d, word in words if word in ("setter", "cache", "lru_cache"))


def test_no_settings_of_the_process_are_changed():
    """Thresholds of the garbage collector and hooks of the interpreter belong to the program that uses the library."""
    calls = "gc.set_threshold", "gc.disable", "gc.freeze", "sys.setrecursionlimit", "sys.settrace", "sys.setprofile"
    none(
        f"{m.place}:{node.lineno} changes {ast.unparse(node)}"
        for m in modules()
        for node in m.nodes(ast.Attribute)
        if ast.unparse(node) in calls or (isinstance(node.ctx, ast.Store) and ast.unparse(node) == "sys.excepthook")
    )


def test_no_package_shows_a_function_with_the_name_of_its_module():
    """The function would be replaced by the module as soon as that is imported."""
    none(
        f"{m.place}: {name} is also a module of {m.name}"
        for m in modules()
        if m.path.name == "__init__.py"
        for name in exported(m)
        if f"{m.name}.{name}" in names() and m.name != "sparsedp"
    )


def test_no_public_name_is_a_module():
    none(f"dp.{name} is also a module" for name in sparsedp._MODULE_OF if f"sparsedp.{name}" in names())


def test_a_new_decorator_does_not_hide_a_compiled_function():
    text = """
from numba import njit
fast = njit(cache=True)
@fast
def f(): pass
def g(): pass
def h(): pass
def plain(): return 1
fast(g)
table = {"h": (h, plain())}
fast(lambda: 0)
"""
    assert jitted(Module(PACKAGE / "kernels" / "new.py", text, ast.parse(text))) == {"f", "g", "h", "lambda:11"}


def test_the_table_of_places_is_true():
    """docs/where.md, "Where do I change X?": the file is there, and has the name."""
    text = (ROOT / "docs" / "where.md").read_text(encoding="utf-8").split("## Where do I change X?")[1].split("## ")[0]
    rows = re.findall(r"^\| .* \| `(.*)` \| `(.*)` \|$", text, re.MULTILINE)
    assert len(rows) >= 70
    for path, name in rows:
        assert re.search(rf"^(def|class)? ?{name}\b", (ROOT / path).read_text(encoding="utf-8"), re.MULTILINE), (
            path,
            name,
        )


# ---- types ---------------------------------------------------------------------------------------------------------


def public_functions(module):
    """Return the functions and methods without an underscore in their name or in the name of their class."""
    found = []
    for node in definitions(module):
        if isinstance(node, FUNCTION):
            found.append(node)
        else:
            found += [one for one in node.body if isinstance(one, FUNCTION) and not one.name.startswith("_")]
    return found


def is_annotated(function):
    arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
    annotations = [one.annotation for one in arguments if one.arg not in ("self", "cls")]
    return None not in annotations and function.returns is not None


def test_public_functions_are_annotated():
    none(
        f"{m.place}:{node.lineno} {node.name} needs types for its parameters and its result"
        for m in modules()
        for node in public_functions(m)
        if not is_annotated(node)
    )


# ---- the shop window -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sparsedp.__all__)
def test_every_public_name_resolves(name):
    assert getattr(sparsedp, name) is not None
    assert name in dir(sparsedp)


@pytest.mark.parametrize("name", sorted(m.name for m in modules() if room(m.name) != "__main__"))
def test_every_module_imports(name):
    try:
        importlib.import_module(name)
    except ImportError as error:
        cause = error.__cause__ if isinstance(error.__cause__, ImportError) else error
        if (cause.name or "").split(".")[0] not in EXTRAS:
            raise
        pytest.skip(f"{cause.name} is not installed")


@pytest.mark.xdist_group("sources")
def test_the_tests_import_what_is_there():
    """A file of tests whose import fails is skipped without an error (--doctest-ignore-import-errors)."""
    wrong = []
    without_ranks = importlib.util.find_spec("mpi4py") is None
    for path, tree in trees_of_tests():
        if without_ranks and path.parent.name == "ranks":
            continue
        for node in tree.body:
            if isinstance(node, ast.Import):
                wrong += [f"{path.name}: no module {one.name}" for one in node.names if not can_be_found(one.name)]
            if not isinstance(node, ast.ImportFrom):
                continue
            if not within(node.module or "", "sparsedp"):
                if not can_be_found(node.module):
                    wrong.append(f"{path.name}: no module {node.module}")
                continue
            try:
                module = importlib.import_module(node.module)
                missing = [a.name for a in node.names if f"{node.module}.{a.name}" not in names()]
                wrong += [f"{path.name}: no {name} in {node.module}" for name in missing if not hasattr(module, name)]
            except ImportError as error:
                if (error.name or "").split(".")[0] not in EXTRAS:
                    wrong.append(f"{path.name}: {error}")
    none(wrong)


def can_be_found(name):
    """Whether a module of a test is installed or stands beside the tests; optional packages need not be installed."""
    top = name.split(".")[0]
    beside = (ROOT / "tests" / "ranks" / f"{top}.py").exists()  # scripts there import each other
    return top in EXTRAS or beside or importlib.util.find_spec(top) is not None


def test_stub_and_window_agree():
    stub = ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8"))
    imported = {
        alias.asname: f"{node.module or ''}"
        for node in ast.walk(stub)
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert imported == {**sparsedp._MODULE_OF, **dict.fromkeys(sparsedp._PUBLIC_PACKAGES, "")}
    aliases = {
        ast.unparse(node.targets[0]): ast.unparse(node.value) for node in stub.body if isinstance(node, ast.Assign)
    }
    assert aliases == {old: new for old, (new, _) in sparsedp._DEPRECATED.items()}


def test_unknown_name():
    with pytest.raises(AttributeError, match="module 'sparsedp' has no attribute 'nonsense'"):
        sparsedp.nonsense


@pytest.mark.parametrize("old", sparsedp._DEPRECATED)
def test_deprecated_names_work_and_warn(old):
    new, removal = sparsedp._DEPRECATED[old]
    message = f"sparsedp.{old} is deprecated and will be removed in version {removal}; write sparsedp.{new}"
    for _ in range(2):  # each use warns, and names the line of the user
        with pytest.warns(DeprecationWarning, match=re.escape(message)) as warned:
            assert getattr(sparsedp, old) is getattr(sparsedp, new)
        assert [warning.filename for warning in warned] == [__file__]
    assert old not in dir(sparsedp) and new in dir(sparsedp)


def test_deprecated_names_warn_where_they_are_imported():
    with pytest.warns(DeprecationWarning, match="write sparsedp.from_blackbox") as warned:
        from sparsedp import adopt
    assert adopt is sparsedp.from_blackbox
    assert {warning.filename for warning in warned} == {__file__}


def test_deprecated_names_are_removed_in_time():
    """An alias works for two minor releases, and is removed in the third."""
    version = tuple(int(part) for part in re.findall(r"\d+", sparsedp.__version__)[:2])
    overdue = [
        old for old, (_, removal) in sparsedp._DEPRECATED.items() if version >= tuple(map(int, removal.split(".")))
    ]
    none(f"sparsedp.{old}: remove it" for old in overdue)


@pytest.mark.parametrize(("name", "hint"), sparsedp._SUGGESTIONS.items())
def test_names_from_elsewhere_get_a_hint(name, hint):
    with pytest.raises(AttributeError, match=re.escape(f"module 'sparsedp' has no attribute {name!r}; write {hint}")):
        getattr(sparsedp, name)
    assert all(word in dir(sparsedp) for word in re.findall(r"dp\.(\w+)", hint))


def test_version():
    assert re.match(r"\d+[.+]", sparsedp.__version__)


def test_import_is_light():
    code = f"import sys, sparsedp; print(*(name for name in {LAZY} if name in sys.modules))"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


# ---- the catalogue -------------------------------------------------------------------------------------------------


def test_every_builder_is_in_the_catalogue():
    path = ROOT / "tests" / "helpers" / "catalogue.py"
    assert path.exists(), "tests/helpers/catalogue.py is missing"
    tree = ast.parse(path.read_text(encoding="utf-8"))  # identifiers and strings count, comments do not
    words = {
        getattr(n, "id", None) or getattr(n, "attr", None) or getattr(n, "value", None)
        for n in ast.walk(tree)
        if isinstance(n, (ast.Name, ast.Attribute)) or (isinstance(n, ast.Constant) and isinstance(n.value, str))
    }
    none(
        f"{m.place}: {name} is not in tests/helpers/catalogue.py"
        for m in modules()
        if m.package == "sparsedp.operators" and m.place != "operators/operator.py"
        for name in exported(m)
        if name in sparsedp._MODULE_OF and name not in words  # the rest serves the builders
    )
