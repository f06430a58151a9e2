"""The interface of regions: a region function, a potential and its gradient."""

from abc import ABC, abstractmethod
from typing import final

from jaxtyping import Float
from torch import Tensor


class Region(ABC):
    """A region f(x) <= 0 of some space and a potential energy P(x) that steers x by it.

    The controller moves against xi = dP/dx, the regional feedback vector, which is in closed
    form. Methods are pure and batched: the leading dimensions of `x` and of the region's own
    tensors broadcast.
    """

    @abstractmethod
    def value(self, x: Float[Tensor, "*batch n"]) -> Tensor:
        """Region function f, at most zero inside; one number or one for each side."""

    @abstractmethod
    def feedback(
        self, x: Float[Tensor, "*batch n"]
    ) -> tuple[Float[Tensor, "*both"], Float[Tensor, "*both m"]]:
        """Potential P of shape (*batch,) and its gradient of shape (*batch, n)."""

    @final
    def potential(self, x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*both"]:
        """Potential energy P."""
        return self.feedback(x)[0]

    @final
    def gradient(self, x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*both m"]:
        """Regional feedback xi = dP/dx."""
        return self.feedback(x)[1]
