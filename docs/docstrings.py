"""From the docstrings of the package, which are read in a terminal, to what Sphinx reads."""

import inspect
import re
from functools import reduce

import sparsedp

CODE = r"(``.*?``|`[^`]*`)"
LABEL = re.compile(r"[A-Z][\w ,]{2,24}: ")  # of a paragraph in the notes


def plain(line):
    """Bars, stars and an underscore at the end of a word are text, outside of code; a page in docs/ is a link."""
    parts = re.split(CODE, line, flags=re.DOTALL)
    parts[::2] = [re.sub(r"([|*]|(?<=\w)_(?!\w))", r"\\\1", part) for part in parts[::2]]
    parts[::2] = [re.sub(r"\bdocs/([\w/]+)\.md\b", r":doc:`/\1`", part) for part in parts[::2]]
    return "".join(parts)


def rewrite(app, what, name, thing, options, lines):
    """Text is not markup, See Also gets summaries, and paragraphs with a label are apart.

    Examples and literal blocks stay as they are. Napoleon takes the text before a colon in the first line of a property
    for its type: an empty word in front makes it a part of the text.
    """
    result = []
    example = literal = False
    for line in lines:
        example = line.lstrip().startswith(">>>") or (example and bool(line.strip()))
        literal = literal and (not line.strip() or line.startswith(" "))
        if LABEL.match(line) and result and result[-1].endswith((".", ":")):
            result.append("")
        result.append(line if example or literal else plain(line))
        literal = literal or (line.endswith("::") and not example)
    if what in ("attribute", "property") and lines and ":" in lines[0]:
        result.insert(0, "\\ ")
    lines[:] = with_summaries(result)


def see_also(lines):
    """Return where the names in the section See Also begin and end, and the names."""
    if "See Also" not in lines:
        return 0, 0, []
    start = lines.index("See Also") + 2
    end = next((index for index in range(start, len(lines)) if not lines[index].strip()), len(lines))
    return start, end, [name.strip() for name in " ".join(lines[start:end]).split(",")]


def with_summaries(lines):
    """Give each name of the section See Also the first line of the docstring that it leads to."""
    start, end, names = see_also(lines)
    return [*lines[:start], *(f"{name} : {plain(summary(name))}" for name in names), *lines[end:]]


def link(app, what, name, thing, options, lines):
    """Let the names of See Also, which are public names, lead to their pages from every module; after napoleon."""
    if ".. seealso::" not in lines:
        return
    start = lines.index(".. seealso::")
    for index in range(start, len(lines)):
        lines[index] = re.sub(r"^ +:(?:py:)?obj:`([\w.]+)`$", r"   :obj:`\1 <sparsedp.\1>`", lines[index])


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
