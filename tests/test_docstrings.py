"""What a public docstring must have, and nothing about style: first line, parameters, result, errors, an example."""

import ast
import dataclasses
import doctest
import inspect
import pickle
import re
import textwrap
from importlib.util import find_spec

import pytest
from sources import FUNCTION, modules

import sparsedp
from sparsedp.advection.transport import CHOICES
from sparsedp.advection.transport import METHODS as SCHEMES
from sparsedp.integrators.stepper import UNUSED, WITH_OPTIONS
from sparsedp.optimize.minimize import METHODS
from sparsedp.solvers.choose_method import METHODS as ENGINES

EXTRAS = {"torch": "torch", "jax": "jax", "xarray": "xarray"}  # what the names of dp.interop that end so need
SECTION = r"(?m)^\s*(?:{numpydoc})\s*\n\s*-{{3,}}\s*$|^\s*{short}\s*:"


def has(doc, numpydoc, short):
    """True when the docstring has a numpydoc section, or a line that starts with the short form and a colon."""
    return re.search(SECTION.format(numpydoc=numpydoc, short=short), doc) is not None


def own_nodes(function):
    """All nodes of a function's body, without nodes of functions and classes inside it."""
    waiting = list(function.body)
    while waiting:
        node = waiting.pop()
        if not isinstance(node, (*FUNCTION, ast.ClassDef, ast.Lambda)):
            yield node
            waiting += ast.iter_child_nodes(node)


def bodies(thing):
    """Syntax trees of the function, or of what runs when the class is called."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(inspect.unwrap(thing)))).body[0]
    if isinstance(tree, FUNCTION):
        return [tree]
    return [
        n
        for n in getattr(tree, "body", ())
        if isinstance(n, FUNCTION) and n.name in ("__init__", "__new__", "__post_init__")
    ]


def parameters(thing):
    try:
        found = inspect.signature(thing).parameters
    except (TypeError, ValueError):
        return []
    return [name for name in found if not name.startswith("_")]


def missing(thing):
    """Mandatory entries that a public function or class does not have, in words."""
    doc = inspect.getdoc(thing) or ""
    if not doc.strip():
        return ["a docstring"]
    if not (inspect.isfunction(thing) or inspect.isclass(thing)):
        return []
    if inspect.isclass(thing) and issubclass(thing, Exception):
        return []
    nodes = [node for body in bodies(thing) for node in own_nodes(body)]
    lacks = [] if doc.splitlines()[0].strip() else ["a first line"]
    if parameters(thing) and not has(doc, "Parameters|Attributes", "in"):
        lacks.append("Parameters (or in:)")
    lacks += [f"the parameter {name}" for name in parameters(thing) if not re.search(rf"\b{name}\b", doc)]
    if any(isinstance(n, ast.Return) and n.value is not None for n in nodes) and not has(doc, "Returns|Yields", "out"):
        lacks.append("Returns (or out:)")
    if any(isinstance(n, ast.Raise) and n.exc is not None for n in nodes) and not has(doc, "Raises", "raises"):
        lacks.append("Raises (its body raises)")
    if ">>>" not in doc:
        lacks.append("an example that runs (>>>)")
    return lacks


@pytest.mark.parametrize("name", sorted(sparsedp._MODULE_OF))
def test_public_docstring(name):
    lacks = missing(getattr(sparsedp, name))
    assert not lacks, f"dp.{name} lacks: " + "; ".join(lacks)


@pytest.mark.xdist_group("docstrings of bridges")  # torch and JAX are imported on one worker
@pytest.mark.parametrize("room", sparsedp._PUBLIC_PACKAGES)
def test_docstrings_of_a_room(room):
    module = getattr(sparsedp, room)
    assert module.__all__, f"dp.{room} needs an __all__"
    there = [name for name in module.__all__ if find_spec(EXTRAS.get(name.split("_")[-1], "sparsedp"))]
    lacks = {f"dp.{room}.{name}": missing(getattr(module, name)) for name in there}
    assert not any(lacks.values()), {name: what for name, what in lacks.items() if what}


@pytest.mark.parametrize("name", sorted(sparsedp._MODULE_OF))
def test_public_methods_have_docstrings(name):
    thing = getattr(sparsedp, name)
    if inspect.isclass(thing):
        own = {
            k: v for k, v in vars(thing).items() if not k.startswith("_") and (callable(v) or isinstance(v, property))
        }
        assert not [k for k, v in own.items() if not inspect.getdoc(v)]


CONDITIONS = ("dirichlet", "neumann", "no_slip", "free_slip", "inflow", "outflow")


def test_conditions_have_docstrings_of_their_own():
    docs = {name: inspect.getdoc(getattr(sparsedp, name)) for name in (*CONDITIONS, "robin")}
    assert len({doc.splitlines()[0] for doc in docs.values()}) == len(docs)
    for name in CONDITIONS:
        condition = getattr(sparsedp, name)
        again = pickle.loads(pickle.dumps(condition))
        assert again == condition and again.__doc__ == condition.__doc__ and repr(again) == name
        examples = doctest.DocTestParser().get_doctest(docs[name], {}, name, None, None)
        assert examples.examples and not doctest.DocTestRunner(verbose=False).run(examples).failed, name


def names_with_a_page():
    """Return the functions and objects of the package by their public names, without errors and missing bridges."""
    names = {name: getattr(sparsedp, name) for name in sparsedp._MODULE_OF}
    for room in set(sparsedp._PUBLIC_PACKAGES) - {"errors", "report"}:  # those of `report` are public as dp.NAME
        module = getattr(sparsedp, room)
        there = [name for name in module.__all__ if find_spec(EXTRAS.get(name.split("_")[-1], "sparsedp"))]
        names.update({f"{room}.{name}": getattr(module, name) for name in there})
    return names


def see_also(doc):
    """Return the names in the section See Also of a docstring."""
    found = re.search(r"(?m)^See Also\n-{8}\n((?:.+\n?)+)", doc)
    return [name.strip() for name in found[1].replace("\n", " ").split(",")] if found else []


@pytest.mark.xdist_group("docstrings of bridges")
def test_see_also_holds_in_both_directions():
    """Every public function names others by their public names, and those name it."""
    links = {name: see_also(inspect.getdoc(value)) for name, value in names_with_a_page().items()}
    assert not [name for name, others in links.items() if not others]
    assert not [name for name, others in links.items() if len(set(others)) < len(others) or name in others]
    assert not [(a, b) for a in links for b in links[a] if b in links and a not in links[b]]
    bridges = {f"interop.{name}" for name in sparsedp.interop.__all__}
    assert {other for others in links.values() for other in others} <= {*links, *bridges}


def options_in_the_table(function):
    """Return the default of each option of each method, by the tables in a docstring."""
    found: dict = {}
    for line in inspect.getdoc(function).splitlines():
        cells = re.split(r"  +", line.strip(), maxsplit=3)
        if len(cells) == 4:
            method, options, default, _ = cells
            found.setdefault(method, {}).update(dict.fromkeys(options.split(", "), default))
    return found


def options_of(makers, position):
    """Return the default of each option of each method, by the signatures."""
    parameters = {method: list(inspect.signature(make).parameters.values()) for method, make in makers.items()}
    return {method: {p.name: p.default for p in found[position(method) :]} for method, found in parameters.items()}


def check_options(table, options):
    for method, wanted in options.items():
        assert set(table.get(method, {})) == set(wanted), method
        for option, default in wanted.items():
            told = table[method][option]
            if told == "required":
                assert default in (inspect.Parameter.empty, None)
            elif told not in ("same", "see right"):
                assert ast.literal_eval(told) == default, (method, option)


def test_options_of_minimize_are_those_of_its_table():
    options = options_of(METHODS, lambda method: 0)
    check_options(options_in_the_table(sparsedp.minimize), options)


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_methods_of_minimize_document_their_options(method):
    doc = inspect.getdoc(method)
    parameters = doc.partition("Parameters\n---")[2].partition("Notes\n---")[0]
    for field in dataclasses.fields(method):
        assert re.search(rf"(?m)^(\w+, )*{field.name}\b", parameters), field.name
    assert "References\n---" in doc


def test_options_of_inverse_are_those_of_its_table():
    check_options(options_in_the_table(sparsedp.inverse), options_of(ENGINES, lambda method: 1))


def rows_of_three(function):
    """Return the rows of three cells in the notes of a docstring, the head of the table among them."""
    notes = inspect.getdoc(function).partition("\nNotes\n")[2].partition("\nReferences\n")[0]
    lines = [re.split(r"  +", line.strip()) for line in notes.splitlines()]
    return [cells for cells in lines if len(cells) == 3 and not cells[0].startswith("=")]


def named_in(cell, methods):
    """Return the methods that a cell of a table stands for."""
    named = {method for method in methods if re.search(rf"\b{method}\b", cell)}
    if cell.startswith("all but "):
        return set(methods) - set(re.match(r"all but (\w+(?:, \w+)*)", cell)[1].split(", "))
    return set(methods) if cell.startswith("all") else named


def test_options_of_transport_are_those_of_its_table():
    table = {option: (values, schemes) for option, values, schemes in rows_of_three(sparsedp.transport)}
    assert table.pop("option") == ("values", "schemes")
    assert set(table) == set(CHOICES)
    for option, (values, schemes) in table.items():
        assert ast.literal_eval(f"({values})") == CHOICES[option]
        takers = {name for name, scheme in SCHEMES.items() if option in ("velocity", "of", *scheme.options)}
        assert named_in(schemes, SCHEMES) == takers, option


def test_arguments_of_stepper_are_those_of_its_table():
    rows = {words: (default, methods) for words, default, methods in rows_of_three(sparsedp.stepper)}
    assert rows.pop("arguments") == ("default", "methods")
    parameters = inspect.signature(sparsedp.stepper).parameters
    takers = {}
    for words, (defaults, methods) in rows.items():
        names = words.split(", ") if "options" not in words else ["options"]
        takers.update(dict.fromkeys(names, named_in(methods, UNUSED)))
        if names != ["options"]:
            wanted = ast.literal_eval(f"({defaults},)")
            assert [parameters[name].default for name in names] == list(wanted * len(names))[: len(names)], words
    assert set(takers) == set(parameters) - {"method", "rate", "dt"}
    assert takers.pop("options") == set(WITH_OPTIONS)
    for name, methods in takers.items():
        assert methods == {method for method in UNUSED if name not in UNUSED[method]}, name


def test_every_module_says_what_it_is():
    assert not [m.place for m in modules() if not ast.get_docstring(m.tree)]


def test_the_rule_sees_what_is_missing():
    def bare(u, b):
        """Do something.

        Parameters
        ----------
        u : array
        """
        if u is None:
            raise ValueError("no u")
        return b

    assert missing(bare) == [
        "the parameter b",
        "Returns (or out:)",
        "Raises (its body raises)",
        "an example that runs (>>>)",
    ]
