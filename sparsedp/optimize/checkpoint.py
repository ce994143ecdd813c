"""States of an optimization on disk: written whole or not at all, checked when read."""

import hashlib
import io
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sparsedp.files import UNFINISHED, write_file
from sparsedp.tree import flatten

__all__ = ["Checkpoint", "Found", "digest", "fingerprint"]

FORMAT = "sparsedp optimization 1"
KEPT = 2


class Found(NamedTuple):
    """What was read: the number of the iteration, the leaves, the words beside them, and files that were skipped."""

    iteration: int
    leaves: list
    words: dict
    skipped: tuple


class Checkpoint:
    """A folder with the last two states, each a .npz without pickle and a JSON manifest with its hash.

    The manifest is written last, and a state counts only when its manifest and the hash in it are right.

    Parameters
    ----------
    folder : path
    settings : dict
        What the run depends on: name -> hash. A folder of another run is refused.
    """

    def __init__(self, folder, settings):
        self._folder, self._settings = Path(folder), settings
        self._folder.mkdir(parents=True, exist_ok=True)

    def save(self, iteration, state, words):
        """A tree of arrays and numbers, and words that JSON can hold."""
        leaves = [np.asarray(leaf) for leaf in flatten(state)[0]]
        buffer = io.BytesIO()
        np.savez(buffer, *leaves)
        content, name = buffer.getvalue(), f"state-{iteration:09d}"
        manifest = {
            "format": FORMAT, "iteration": iteration, "file": name + ".npz", "leaves": len(leaves),
            "sha256": digest(content), "settings": self._settings, "words": words,
        }  # fmt: skip
        manifest["seal"] = digest(_text(manifest))
        write_file(self._folder / f"{name}.npz", content)
        write_file(self._folder / f"{name}.json", _text(manifest))
        self._forget()

    def _forget(self):
        for manifest in self._manifests()[KEPT:]:
            for path in (manifest, manifest.with_suffix(".npz")):
                path.unlink(missing_ok=True)

    def _manifests(self):
        return sorted(self._folder.glob("state-*.json"), reverse=True)

    def load(self):
        """The newest state that is whole, or None.

        Raises
        ------
        ValueError
            If a whole state belongs to a run with other settings.
        """
        skipped = [f"{path.name}: an unfinished write" for path in sorted(self._folder.glob(f"*{UNFINISHED}"))]
        for path in self._manifests():
            manifest, leaves, reason = _read(path)
            if reason:
                skipped.append(f"{path.name}: {reason}")
                continue
            self._compare(manifest["settings"])
            return Found(manifest["iteration"], leaves, manifest["words"], tuple(skipped))
        return Found(-1, [], {}, tuple(skipped))

    def _compare(self, settings):
        for name in {**self._settings, **settings}:
            self.check(name, settings.get(name) == self._settings.get(name))

    def check(self, name, same):
        """Refuse the folder unless what it holds is the same.

        Raises
        ------
        ValueError
            If it is not.
        """
        if not same:
            raise ValueError(
                f"{self._folder} holds a run with another {name} than the one given; give what it was begun with, or "
                "write another checkpoint folder"
            )


def digest(content):
    """Bytes -> SHA-256 in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def fingerprint(tree):
    """Any value -> a hash of its kind and content: of every leaf of a tree, of a function its name."""
    return digest("\n".join(_words(tree)).encode())


def _words(value):
    kind = type(value).__qualname__
    if isinstance(value, dict):
        yield from (word for item in value.items() for word in _words(item))
    elif isinstance(value, (tuple, list)):
        yield from (word for item in value for word in _words(item))
    elif isinstance(value, (np.ndarray, np.generic)) and value.dtype != object:
        kind = f"{kind} {value.dtype} {value.shape} {digest(np.ascontiguousarray(value).tobytes())}"
    elif callable(value):
        kind = f"{getattr(value, '__module__', '')} {getattr(value, '__qualname__', kind)}"
    elif " at 0x" not in repr(value):  # an address is another one in the next process
        kind = f"{kind} {value!r}"
    yield f"{kind} ends"


def _text(manifest):
    return json.dumps(manifest, indent=1, sort_keys=True).encode()


def _read(path):
    """(manifest, leaves, None), or (None, None, what is wrong)."""
    try:
        manifest = json.loads(path.read_bytes())
        seal = manifest.pop("seal")
    except (OSError, ValueError, KeyError, AttributeError, TypeError):
        return None, None, "not a manifest of sparsedp"
    if manifest.get("format") != FORMAT or digest(_text(manifest)) != seal:
        return None, None, "not a manifest of sparsedp"
    try:
        content = (path.parent / manifest["file"]).read_bytes()
    except OSError:
        return None, None, f"{manifest['file']} is missing"
    if digest(content) != manifest["sha256"]:
        return None, None, f"{manifest['file']} is truncated or changed"
    with np.load(io.BytesIO(content), allow_pickle=False) as stored:
        return manifest, [stored[f"arr_{place}"] for place in range(manifest["leaves"])], None
