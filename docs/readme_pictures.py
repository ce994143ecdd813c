"""The pictures of README.md and of the front page: what the demo and three examples draw, made small.

    python docs/readme_pictures.py

All of them together are at most 300 kB (tests/test_pages.py), because every clone contains them.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from sparsedp.__main__ import main

ROOT = Path(__file__).parent.parent
TARGET = ROOT / "docs" / "pictures"
NAMES = "recovery", "plume", "cylinder", "patterns"
SIZES = {"plume": "64", "cylinder": "20", "patterns": "48"}  # cells, the first argument of the examples
WIDTHS = {"plume": 1.0, "cylinder": 1.0, "patterns": 0.5}  # the part that is shown, from the left
CARD = 720, 368  # pixels of a picture of an example
MARGIN = 16  # pixels on each side of it
FONT_SIZES = {"plume": 14, "cylinder": 14, "patterns": 10}  # text that is readable on a card
COLOURS = 256


def resized(image, width):
    """Return an image of a given width, with the same proportions."""
    return image.resize((width, round(image.height * width / image.width)), Image.Resampling.LANCZOS)


def side_by_side(left, right):
    """Return one image of two of the same height."""
    both = Image.new("RGB", (left.width + right.width, left.height), "white")
    both.paste(left, (0, 0))
    both.paste(right, (left.width, 0))
    return both


def card(image, part):
    """Return the left part of an image on a white card."""
    shown = image.crop((0, 0, round(part * image.width), image.height))
    shown.thumbnail((CARD[0] - 2 * MARGIN, CARD[1] - 2 * MARGIN), Image.Resampling.LANCZOS)
    white = Image.new("RGB", CARD, "white")
    white.paste(shown, ((CARD[0] - shown.width) // 2, (CARD[1] - shown.height) // 2))
    return white


def save(image, name):
    """Write a picture with few colours."""
    image.quantize(COLOURS).save(TARGET / f"{name}.png", optimize=True)


def opened(path):
    """Return the image of a file without transparency."""
    return Image.open(path).convert("RGB")


def draw():
    """Run the demo and the examples, and write the pictures."""
    TARGET.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        main(["demo", "--out", folder])
        truth, recovery = (opened(Path(folder) / f"{name}.png") for name in ("truth", "recovery"))
        save(resized(side_by_side(truth, recovery), 1200), "recovery")
    for name, size in SIZES.items():
        with tempfile.TemporaryDirectory() as folder:
            script = ROOT / "examples" / f"{name}.py"
            style = Path(folder) / "matplotlibrc"
            lines = f"font.size: {FONT_SIZES[name]}", "figure.constrained_layout.use: True"
            style.write_text("\n".join(lines), encoding="utf-8")
            environment = {**os.environ, "MATPLOTLIBRC": str(style)}
            subprocess.run([sys.executable, script, size, "--out", folder], check=True, env=environment)
            save(card(opened(Path(folder) / f"{name}.png"), WIDTHS[name]), name)


if __name__ == "__main__":
    draw()
