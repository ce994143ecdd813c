"""From the docstrings of the package, which are read in a terminal, to what Sphinx reads."""

import inspect
import re
from functools import reduce

import sparsedp

CODE = r"(``.*?``|`[^`]*`)"
VALUES = ("attribute", "data", "property")  # napoleon takes the text before a colon in their first line for a type


def plain(line):
    """Bars, stars and an underscore at the end of a word are text, outside of code; a page in docs/ is a link."""
    parts = re.split(CODE, line, flags=re.DOTALL)
    parts[::2] = [re.sub(r"([|*]|(?<=\w)_(?!\w))", r"\\\1", part) for part in parts[::2]]
    parts[::2] = [re.sub(r"\bdocs/(\w+)\.md\b", r":doc:`/\1`", part) for part in parts[::2]]
    return "".join(parts)


def rewrite(app, what, name, thing, options, lines):
    """Text is not markup, names of See Also are links with a summary. Examples and literal blocks stay as they are."""
    result = []
    example = literal = False
    for line in lines:
        example = line.lstrip().startswith(">>>") or (example and bool(line.strip()))
        literal = literal and (not line.strip() or line.startswith(" "))
        result.append(line if example or literal else plain(line))
        literal = literal or (line.endswith("::") and not example)
    if what in VALUES and ":" in lines[0]:
        result.insert(0, "\\ ")
    lines[:] = with_links(result)


def see_also(text):
    """Names in the section See Also of a docstring."""
    found = re.search(r"(?m)^See Also\n-{3,}\n((?:.+\n?)+)", text)
    return [name.strip() for name in found[1].replace("\n", " ").split(",")] if found else []


def with_links(lines):
    """Replace the section See Also by links, each with the first line of the docstring that it leads to."""
    if "See Also" not in lines:
        return lines
    start = lines.index("See Also")
    end = next((index for index in range(start, len(lines)) if not lines[index].strip()), len(lines))
    links = [".. seealso::", ""]
    for name in see_also("\n".join(lines[start:end])):
        links += [f"   :obj:`{name} <sparsedp.{name}>`", f"      {plain(summary(name))}", ""]
    return [*lines[:start], *links, *lines[end:]]


def summary(name):
    """First line of the docstring of a public name; of a bridge whose library is not installed, its name."""
    try:
        value = reduce(getattr, name.split("."), sparsedp)
    except ImportError:
        return name
    return inspect.getdoc(value).splitlines()[0]


def defined_in(app, module, name):
    """The module with the source of a public name, for the link to it; None leaves it to Sphinx.

    Public modules hold wrapped functions. Sphinx links the source of a module back to names of one module only, so a
    warning of `errors` that is public as dp.NAME as well has no link.
    """
    value = sparsedp if module == "sparsedp" else getattr(sparsedp, module.partition(".")[2], None)
    for part in name.split("."):
        value = getattr(value, part, None)
    if hasattr(value, "__wrapped__"):
        return inspect.unwrap(value).__module__
    if module == "sparsedp" and getattr(value, "__module__", None) == "sparsedp.errors":
        return module
    return None
