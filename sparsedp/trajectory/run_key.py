"""A hash of a rollout that is the same in every process, to recognise an interrupted run in a folder.

The hash covers the arguments, the options, and everything that the step refers to, see `sparsedp.io.description`.
The content of some objects cannot be hashed. The key says whether there are any.
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, NamedTuple

from sparsedp.io.description import PACKAGES, Description
from sparsedp.io.fingerprint import fingerprint

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from sparsedp.trajectory.specification import RolloutSpecification

__all__ = ["RunKey", "run_key"]


class RunKey(NamedTuple):
    """The hash of a rollout.

    Attributes
    ----------
    text : str
        32 hexadecimal digits.
    is_complete : bool
        Whether the hash covers everything that the step refers to.
    """

    text: str
    is_complete: bool


def run_key(specification: RolloutSpecification, args: Sequence) -> RunKey:
    """Return the hash of the step, the arguments and the options of a rollout."""
    statics = [form.statics for form in specification.forms]
    settings = (specification.n, specification.truncate, specification.differentiated, statics)
    description = Description(specification.step)
    texts = [fingerprint(settings), *map(fingerprint, args), *_versions(), *description.texts]
    text = hashlib.sha256("\n".join(texts).encode()).hexdigest()[:32]
    return RunKey(text, description.is_complete)


def _versions() -> Iterator[str]:
    """Yield the versions of the packages whose functions count by name."""
    from importlib import metadata  # slow to import

    for package in PACKAGES:
        try:
            yield f"{package} {metadata.version(package)}"
        except metadata.PackageNotFoundError:
            yield package
