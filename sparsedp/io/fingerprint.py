"""Hashes of trees of arrays that are the same in every process, to recognise an interrupted run in a folder."""

from __future__ import annotations

from typing import Any

import numpy as np

from sparsedp._utils.pytree import flatten
from sparsedp.autodiff.backend import gathered
from sparsedp.io.digest import array_description, digest

__all__ = ["fingerprint"]


def fingerprint(tree: Any) -> str:
    """Return a hash of the structure of a tree, and of the type and content of its leaves.

    Functions count by their code, defaults and closure, and other objects by their attributes, as
    `sparsedp.io.description` describes them.
    """
    entries, rebuild = flatten(tree)
    structure = repr(rebuild(range(len(entries))))
    return digest("\n".join([structure, *map(_description, entries)]).encode())


def _description(leaf: Any) -> str:
    """Return a text that describes the type and content of a leaf and is the same in every process."""
    leaf = gathered(leaf)
    kind = type(leaf).__qualname__
    if isinstance(leaf, (np.ndarray, np.generic)) and leaf.dtype != object:
        return array_description(leaf)
    if callable(leaf) or " at 0x" in repr(leaf):  # a memory address, which differs between processes
        from sparsedp.io.description import Description

        return "\n".join(Description(leaf, with_attributes=True).texts)
    return f"{kind} {leaf!r}"
