"""From the docstrings of the package, which are read in a terminal, to what Sphinx reads."""

import inspect
import re
from functools import reduce

import sparsedp

CODE = r"(``.*?``|`[^`]*`)"
LABEL = re.compile(r"[A-Z][\w ,]{2,24}: ")  # of a paragraph in the notes
BORDER = re.compile(r" *=+( +=+)+$")  # of a table
PUBLIC = {name for name in dir(sparsedp) if not name.startswith("_")}
PUBLIC |= {f"{room}.{name}" for room in sparsedp._PUBLIC_PACKAGES for name in getattr(sparsedp, room).__all__}
PUBLIC -= {f"report.{name}" for name in sparsedp.report.__all__}  # these are public without the room


def plain(line):
    """Bars, stars and an underscore at the end of a word are text, outside of code; a page in docs/ is a link."""
    parts = re.split(CODE, line, flags=re.DOTALL)
    parts[::2] = [re.sub(r"([|*]|(?<=\w)_(?!\w))", r"\\\1", part) for part in parts[::2]]
    parts[::2] = [re.sub(r"\bdocs/([\w/]+)\.md\b", r":doc:`/\1`", part) for part in parts[::2]]
    return "".join(parts)


def linked(line, own_names):
    """Names of the package between backquotes are links, if they are not arguments of the function itself."""

    def role(match):
        name = match[1]
        return f":obj:`{name} <sparsedp.{name}>`" if name in PUBLIC - own_names else match[0]

    return re.sub(r"(?<![`:\w])`([\w.]+)`(?![`_])", role, line)


def names_of_arguments(thing, lines):
    """Names of the arguments of a function or class, and of those that its docstring shows as ``name=``."""
    shown = set(re.findall(r"\b(\w+)=", "\n".join(lines)))
    try:
        return shown | set(inspect.signature(thing).parameters)
    except (TypeError, ValueError):
        return shown


def rewrite(app, what, name, thing, options, lines):
    """Text is not markup, public names are links, See Also gets summaries, and paragraphs with a label are apart.

    Examples, literal blocks and tables stay as they are. Napoleon takes the text before a colon in the first line of a
    property for its type: an empty word in front makes it a part of the text.
    """
    own_names = names_of_arguments(thing, lines) | {name.removeprefix("sparsedp.")}
    result = []
    example = literal = table = False
    for line in lines:
        example = line.lstrip().startswith(">>>") or (example and bool(line.strip()))
        literal = literal and (not line.strip() or line.startswith(" "))
        table = bool(line.strip()) and (table or BORDER.match(line) is not None)
        if LABEL.match(line) and result and result[-1].endswith((".", ":")):
            result.append("")
        if example or literal:
            result.append(line)
        elif table:
            result.append(plain(line))
        else:
            result.append(plain(linked(line, own_names)))
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
