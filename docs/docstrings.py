"""From the docstrings of the package, which are read in a terminal, to what Sphinx reads."""

import re
from inspect import unwrap

import sparsedp

CODE = r"(``.*?``|`[^`]*`)"


def plain(line):
    """Bars, stars and an underscore at the end of a word are text, outside of code; a page in docs/ is a link."""
    parts = re.split(CODE, line, flags=re.DOTALL)
    parts[::2] = [re.sub(r"([|*]|(?<=\w)_(?!\w))", r"\\\1", part) for part in parts[::2]]
    parts[::2] = [re.sub(r"\bdocs/(\w+)\.md\b", r":doc:`/\1`", part) for part in parts[::2]]
    return "".join(parts)


def rewrite(app, what, name, thing, options, lines):
    """Text is no markup; each line of a `Source` stays a line. Examples stay as they are."""
    example = source = False
    for index, line in enumerate(lines):
        example = line.lstrip().startswith(">>>") or (example and bool(line.strip()))
        if not line.strip():
            source = False
        if source and set(line) != {"-"}:
            lines[index] = "| " + plain(line)
        elif not example:
            lines[index] = plain(line)
        source = source or line == "Source"


def defined_in(app, module, name):
    """The module with the source of a public name, for the link to it; None leaves it to Sphinx.

    Public modules hold wrapped functions. Sphinx links the source of a module back to names of one module only, so a
    warning of `errors` that is public as dp.NAME as well has no link.
    """
    value = sparsedp if module == "sparsedp" else getattr(sparsedp, module.partition(".")[2], None)
    for part in name.split("."):
        value = getattr(value, part, None)
    if hasattr(value, "__wrapped__"):
        return unwrap(value).__module__
    if module == "sparsedp" and getattr(value, "__module__", None) == "sparsedp.errors":
        return module
    return None
