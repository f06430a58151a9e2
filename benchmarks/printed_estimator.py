"""The paper's adaptation law with its initial weights exactly as printed."""

import torch
from torch import Tensor

from hrc_learn.jacobian import Measurement, PaperEstimator, RBFImageJacobian
from hrc_learn.jacobian.estimator import WeightState


class PrintedEstimator(PaperEstimator):
    """The paper's law with its initial weights as printed, set when the feature is first seen.

        W(i, j) = vec(J_s0)(i) / sum_k theta_k(r_t0)      (eq_w0)

    Until then the weights are zero. Away from r_t0 the estimate grows or fades with the sum of
    the unnormalised neurons.
    """

    column: Tensor
    """vec(J_s0), equal for all neurons, (12, 1)."""

    def __init__(self, network: RBFImageJacobian, gain: float = 0.25, *, mixed: bool = True):
        """Prepare the law.

        Args:
            network: Network made by `RBFImageJacobian.from_jacobian`, which gives the neurons
                and vec(J_s0^T).
            gain: Diagonal of L.
            mixed: True: vec(J_s0) as printed, which mixes the two image rows; False:
                vec(J_s0^T), as (approxNN_vec) requires.
        """
        neurons = RBFImageJacobian(
            network.centers,
            float(network.width),
            input_indices=network.input_indices,
            reference=network.reference,
            normalized=False,
        )
        super().__init__(neurons, gain)
        column = network.weight.detach()[:, 0]
        if mixed:
            column = column.unflatten(0, (-1, 6)).mT.flatten()
        self.register_buffer("column", column[:, None].clone())

    def update(self, state: WeightState, measurement: Measurement) -> WeightState:
        """Initial weights where the feature is first seen, then the law."""
        total = self.network.basis(measurement.pose).sum(-1)[..., None, None]
        waiting = (state.weight == 0).all(-1, keepdim=True).all(-2, keepdim=True)
        begins = waiting & measurement.valid[..., None, None]
        weight = torch.where(begins, self.column / total, state.weight)
        moved = super().update(WeightState(weight=weight), measurement).weight
        return WeightState(weight=torch.where(waiting & ~begins, weight, moved))
