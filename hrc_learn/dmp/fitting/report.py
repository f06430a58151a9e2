"""How well a fit reproduces its demonstration."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class FitReport:
    """Residuals of a reproduction, in the units of the demonstration."""

    rmse: Float[Tensor, "*batch D"]
    """Root mean square error of each coordinate."""
    peak: Float[Tensor, "*batch D"]
    """Largest absolute error of each coordinate."""
    span: Float[Tensor, "*batch D"]
    """Range that the demonstration covers in each coordinate."""

    @property
    def nrmse(self) -> Float[Tensor, "*batch"]:
        """RMSE over all samples and coordinates, relative to the largest range."""
        return self.rmse.square().mean(-1).sqrt() / self.span.amax(-1)

    def select(self, columns: slice) -> "FitReport":
        """Report of some of the coordinates."""
        return FitReport(**{name: values[..., columns] for name, values in vars(self).items()})
