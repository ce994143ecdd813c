"""The interface of the methods of `minimize`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from collections.abc import Callable

    from sparsedp.optimize.objective import Objective
    from sparsedp.optimize.result import Evaluation

__all__ = ["Method"]


class Method(ABC):
    """A method of `minimize`: a dataclass whose fields are its options.

    A method keeps no state of a run. `begin` and `advance` return states: named tuples of plain arrays and numbers
    that hold everything the next step depends on, with the current point as their first field, `current`. A
    checkpoint stores the fields in their order.

    Attributes
    ----------
    name : str
        What a user writes as ``method=``.
    uses_residuals : bool
        Whether the loss returns residuals, of which half the sum of squares is minimized.
    """

    name: ClassVar[str]
    uses_residuals: ClassVar[bool] = False

    @property
    def compares_losses(self) -> bool:
        """Whether steps are accepted by comparing losses, which losses of different batches do not allow."""
        return True

    def composed(self, loss: Callable[..., Any]) -> Callable[..., Any]:
        """Return the loss as a function of the unknowns, given the loss that the user wrote."""
        return loss

    @abstractmethod
    def begin(self, first: Evaluation) -> Any:
        """Return the state at the start."""

    @abstractmethod
    def advance(self, state: Any, objective: Objective) -> Any:
        """Return the state after one iteration. Raises NoStepFound if no acceptable point is found."""
