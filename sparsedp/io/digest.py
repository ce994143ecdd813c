"""Hashes of bytes and of arrays that are the same in every process."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

__all__ = ["array_description", "digest"]


def digest(content: bytes) -> str:
    """Return the SHA-256 hash of bytes."""
    return hashlib.sha256(content).hexdigest()


def array_description(array: NDArray | np.generic) -> str:
    """Return a text with the type, the shape and the hash of the content of an array of numbers."""
    return f"{type(array).__qualname__} {array.dtype} {array.shape} {digest(array.tobytes())}"
