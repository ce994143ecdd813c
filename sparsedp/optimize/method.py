"""The base class of the methods of `minimize`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar

from sparsedp.optimize.metric import EUCLIDEAN, Euclidean

if TYPE_CHECKING:
    from collections.abc import Callable

    from sparsedp.optimize.objective import Objective
    from sparsedp.optimize.result import Evaluation

__all__ = ["Method"]


class Method(ABC):
    """Base class of the methods of `minimize`. A method is a dataclass whose fields are its options.

    A method object does not store the state of a run. Instead, `begin` and `advance` return the state, a named tuple of
    arrays and numbers that contains everything that the next step depends on. Its first field, `current`, is the
    current point. Checkpoints store the fields of the state in their order.

    Attributes
    ----------
    name : str
        The value of the argument `method` of `minimize`.
    uses_residuals : bool
        True for least-squares methods: the loss returns residuals, and half the sum of their squares is minimized.
    uses_metric : bool
        Whether steps depend on the inner product of the unknowns.
    metric : Euclidean or Metric
        This inner product. `minimize` sets it.
    """

    name: ClassVar[str]
    uses_residuals: ClassVar[bool] = False
    uses_metric: ClassVar[bool] = False
    metric: Euclidean = EUCLIDEAN

    @property
    def compares_losses(self) -> bool:
        """Whether steps are accepted by comparing losses; if so, batches cannot be used, as their losses differ."""
        return True

    def composed(self, loss: Callable[..., Any]) -> Callable[..., Any]:
        """Return the loss as a function of the unknowns, given the user's loss."""
        return loss

    @abstractmethod
    def begin(self, first: Evaluation) -> Any:
        """Return the state at the start."""

    @abstractmethod
    def advance(self, state: Any, objective: Objective) -> Any:
        """Return the state after one iteration. Raises NoStepFound if no acceptable point is found."""
