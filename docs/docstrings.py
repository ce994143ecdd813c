"""From the docstrings of the package, which are read in a terminal, to what Sphinx reads."""

import re

CODE = r"(``.*?``|`[^`]*`)"


def plain(line):
    """Bars, stars and an underscore at the end of a word are text, outside of code."""
    parts = re.split(CODE, line, flags=re.DOTALL)
    parts[::2] = [re.sub(r"([|*]|(?<=\w)_(?!\w))", r"\\\1", part) for part in parts[::2]]
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
