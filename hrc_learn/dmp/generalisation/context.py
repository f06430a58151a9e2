"""Features of a task parameter: what primitives are regressed on."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations_with_replacement

import torch
from jaxtyping import Float
from torch import Tensor

type FeatureMap = Callable[[Tensor], Tensor]
"""Maps contexts (*batch, C) to features (*batch, F); a constant one is not needed."""


@dataclass(frozen=True, kw_only=True)
class PolynomialFeatures:
    """All products of up to `degree` coordinates of the context; 1: the context itself."""

    degree: int = 1

    def __post_init__(self):
        if self.degree < 1:
            raise ValueError(f"degree must be at least 1, got {self.degree}")

    def __call__(self, context: Float[Tensor, "*batch C"]) -> Float[Tensor, "*batch F"]:
        """Features of a context."""
        columns = context.unbind(-1)
        products = [
            torch.stack(factors).prod(0)
            for degree in range(1, self.degree + 1)
            for factors in combinations_with_replacement(columns, degree)
        ]
        return torch.stack(products, dim=-1)
