"""Pages in Markdown whose code blocks run: README.md, those in docs/.

A python block is executed, after the ones before it. The text block that follows (at once, or after one line that
ends in a colon) is its real output: words are compared with white space normalised, numbers with a relative
tolerance, ``...`` stands for anything. A line ``<!-- rtol=1e-3 atol=1e-12 -->`` before the text block sets the
tolerances. A block that imports a library of an extra is skipped where that library is missing.
"""

import contextlib
import importlib.util
import io
import math
import re
import shlex
import sys
from dataclasses import dataclass

from sources import ROOT

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

SHELL = ("sh", "bash", "shell", "console")
NUMBER = r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w])"
LIBRARIES = ("PIL", "jax", "matplotlib", "nlopt", "pyevtk", "skfem", "torch", "xarray")  # of extras
MISSING = [name for name in LIBRARIES if importlib.util.find_spec(name) is None]


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, text, line number, and the text between it and the block before it."""

    language: str
    text: str
    line: int
    before: str


def blocks(page):
    found = []
    before = []
    inside = None
    for number, line in enumerate(page.splitlines(), 1):
        fence = re.match(r"\s*```\s*(\w*)", line)
        if inside is not None and fence:
            found.append(Block(inside[0], "\n".join(inside[2]), inside[1], "\n".join(before)))
            inside = None
            before = []
        elif inside is not None:
            inside[2].append(line)
        elif fence:
            inside = (fence[1].lower(), number, [])
        else:
            before.append(line)
    return found


# ---- python blocks and their output --------------------------------------------------------------------------------


def tolerances(text):
    found = dict(re.findall(r"\b(rtol|atol)=([-+.\deE]+)", text))
    return {"rel_tol": float(found.get("rtol", 1e-6)), "abs_tol": float(found.get("atol", 0.0))}


def same(wanted, got, **tolerance):
    """Whether a printed text is the wanted one, numbers within the tolerance and ``...`` for anything."""
    wanted = " ".join(wanted.split())
    got = " ".join(got.split())
    numbers = []
    rule = ""
    for part in re.split(rf"({NUMBER}|\.\.\.)", wanted):
        if part == "...":
            rule += ".*?"
        elif re.fullmatch(NUMBER, part):
            numbers.append(float(part))
            rule += r"\s*(" + NUMBER + ")"  # columns may shift by a sign
        else:
            rule += re.escape(part)
    found = re.fullmatch(rule, got)
    return found is not None and all(math.isclose(a, float(b), **tolerance) for a, b in zip(numbers, found.groups()))


def needs_missing_library(code):
    """Return whether a block imports a library of an extra that is not installed, or lets `minimize` import it."""
    imported = any(re.search(rf"^(import|from) {name}\b", code, re.MULTILINE) for name in MISSING)
    return imported or ("nlopt" in MISSING and '"mma"' in code)


def run_blocks(path):
    """Execute the python blocks of a page in order; the printed text must be the text of the page."""
    all_blocks = blocks(path.read_text(encoding="utf-8"))
    space = {"__name__": "__page__"}
    assert any(block.language == "python" for block in all_blocks), f"{path.name} has no python block"
    for block, following in zip(all_blocks, [*all_blocks[1:], Block("", "", 0, "")]):
        if block.language != "python" or needs_missing_library(block.text):
            continue
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(block.text, f"{path.name} block at line {block.line}", "exec"), space)
        prose = re.sub(r"<!--.*?-->", "", following.before, flags=re.DOTALL).strip()
        wanted = following.text if following.language == "text" and re.fullmatch(r"([^\n]*:)?", prose) else ""
        assert same(wanted, printed.getvalue(), **tolerances(following.before)), (
            f"{path.name} line {block.line}: the block prints\n{printed.getvalue()}\nthe page says\n{wanted}"
        )


# ---- shell blocks --------------------------------------------------------------------------------------------------


def commands(text):
    """Single commands of a shell block: continued lines joined, prompts and comments dropped, split at &&."""
    lines = text.replace("\\\n", " ").splitlines()
    words = [shlex.split(line.removeprefix("$ "), comments=True) for line in lines]
    for line in words:
        while "&&" in line:
            yield line[: line.index("&&")]
            line = line[line.index("&&") + 1 :]
        if line:
            yield line


def check_install(arguments):
    extras = set(
        tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    )
    targets = [word for word in arguments if word.startswith((".", "sparsedp"))]
    asked = {extra for word in targets for extra in re.findall(r"[\w-]+", "".join(re.findall(r"\[(.*?)\]", word)))}
    assert targets, f"pip {shlex.join(arguments)} does not install this package"
    assert asked <= extras, f"pyproject.toml has no extras {sorted(asked - extras)}"
