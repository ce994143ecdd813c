"""Read images as fields. This needs Pillow, which the extra `plot` installs."""

from __future__ import annotations

import os

import numpy as np

from sparsedp.io.atomic_files import path_errors

__all__ = ["from_image"]

SHADES = {
    "1": 1,
    "L": 255,
    "P": 255,
    "RGB": 255,
    "I;16": 65535,
    "I;16L": 65535,
    "I;16B": 65535,
}  # value of white for each mode of Pillow


def from_image(path: str | os.PathLike) -> np.ndarray:
    """Read an image as an array with values from 0 (black) to 1 (white).

    Axis 0 is x, which points to the right; axis 1 is y, which points upwards.

    Parameters
    ----------
    path : str or path
        A .png or .jpg file, or any other format that Pillow reads. The image may be black and white, grey or colour.

    Returns
    -------
    array, shape (width, height) or (3, width, height)
        The first axis of a colour image is a batch of red, green and blue. ``dp.Grid(u.shape[-2:])`` is a grid with
        one cell for each pixel.

    Raises
    ------
    ValueError
        If the image has transparency, or a mode for which the value of white is unknown.
    ImportError
        If Pillow is missing; the extra `plot` installs it.
    OSError
        If the file does not exist, or is not an image.

    See Also
    --------
    plot

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> path = Path(tempfile.mkdtemp(), "corner.pgm")
    >>> _ = path.write_bytes(b"P5 3 2 255 " + bytes([0, 0, 255, 0, 0, 0]))  # white: the upper right corner
    >>> from_image(path)
    array([[0., 0.],
           [0., 0.],
           [0., 1.]])
    """
    try:
        from PIL import Image, ImageOps
    except ImportError as error:
        raise ImportError("from_image needs Pillow; install sparsedp[plot]") from error
    with path_errors(path, reading=True):
        picture = Image.open(path)
    with picture as stored:
        image = ImageOps.exif_transpose(stored)
        if image.mode not in SHADES or "transparency" in image.info:
            raise ValueError(
                f"from_image takes grey or RGB pictures without transparency, {path} has mode {image.mode}; "
                "save it as RGB"
            )
        white = SHADES[image.mode]
        if image.mode == "P":
            image = image.convert("RGB")
        pixels = np.asarray(image)
    return np.moveaxis(pixels[::-1], (0, 1), (-1, -2)) / white
