"""How well a fit reproduces its demonstration."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class FitReport:
    """Residuals of a reproduction, in the units of the demonstration.

    Those of a robust fit count by the trust in each sample.
    """

    rmse: Float[Tensor, "*batch D"]
    """Root mean square error of each coordinate."""
    peak: Float[Tensor, "*batch D"]
    """Largest absolute error of each coordinate."""
    span: Float[Tensor, "*batch D"]
    """Range that the demonstration covers in each coordinate."""
    trust: Float[Tensor, "*batch T D"] | None = None
    """In each sample, 0 to 1, that a robust fit came to."""

    @property
    def nrmse(self) -> Float[Tensor, "*batch"]:
        """RMSE over all samples and coordinates, relative to the largest range."""
        return self.rmse.square().mean(-1).sqrt() / self.span.amax(-1)

    def select(self, columns: slice) -> "FitReport":
        """Report of some of the coordinates."""
        return FitReport(**{k: values[..., columns] for k, values in self.tensors().items()})

    def tensors(self) -> dict[str, Tensor]:
        """What there is, by name."""
        return {name: values for name, values in vars(self).items() if values is not None}
