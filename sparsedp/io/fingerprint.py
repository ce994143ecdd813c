"""Hashes of trees of arrays that are the same in every process, to recognise an interrupted run in a folder."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np

from sparsedp._utils.pytree import flatten
from sparsedp.autodiff.backend import gathered

__all__ = ["digest", "fingerprint"]


def fingerprint(tree: Any) -> str:
    """Return a hash of the structure of a tree, and of the type and content of its leaves; functions count by name."""
    entries, rebuild = flatten(tree)
    structure = repr(rebuild(range(len(entries))))
    return digest("\n".join([structure, *map(_description, entries)]).encode())


def digest(content: bytes) -> str:
    """Return the SHA-256 hash of bytes."""
    return hashlib.sha256(content).hexdigest()


def _description(leaf: Any) -> str:
    """Return a text that describes the type and content of a leaf and is the same in every process."""
    leaf = gathered(leaf)
    kind = type(leaf).__qualname__
    if isinstance(leaf, (np.ndarray, np.generic)) and leaf.dtype != object:
        return f"{kind} {leaf.dtype} {leaf.shape} {digest(leaf.tobytes())}"
    if callable(leaf):
        return f"{getattr(leaf, '__module__', '')} {getattr(leaf, '__qualname__', kind)}"
    if " at 0x" in repr(leaf):  # a memory address, which differs between processes
        return kind
    return f"{kind} {leaf!r}"
