"""The pictures in README.md: what the demo draws, made small.

    python docs/readme_pictures.py

All of them together are at most 300 kB (tests/test_pages.py), for every clone carries them.
"""

import tempfile
from pathlib import Path

from PIL import Image

from sparsedp.__main__ import main

NAMES = "truth", "recovery", "convergence"
WIDTH = 640  # pixels
COLOURS = 96  # as many serve maps of one hue and text

if __name__ == "__main__":
    target = Path(__file__).parent / "pictures"
    target.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        main(["demo", "--out", folder])
        for name in NAMES:
            whole = Image.open(Path(folder) / f"{name}.png").convert("RGB")
            small = whole.resize((WIDTH, round(whole.height * WIDTH / whole.width)), Image.Resampling.LANCZOS)
            small.quantize(COLOURS).save(target / f"{name}.png", optimize=True)
