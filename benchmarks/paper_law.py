"""The paper's law as printed: regions of Table I, and the adaptation with its initial
weights.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller import GRIPPER_DOWN, Goals
from hrc_learn.geometry import quaternion
from hrc_learn.jacobian import Measurement, PaperEstimator, RBFImageJacobian
from hrc_learn.jacobian.estimators import WeightState
from hrc_learn.kinematics import JointLimits
from hrc_learn.regions import JointRegion, OrientationRegion, PositionRegion, VisionRegion


def paper_joint_region(limits: JointLimits) -> JointRegion:
    """The paper's joint-space region in its printed, symmetric form, with default gains."""
    return JointRegion.from_limits(limits.lower, limits.upper, formulation="paper")


def paper_goals(
    centre: Float[Tensor, "*#batch 3"],
    half_size: Float[Tensor, "*#batch 3"],
    target: Float[Tensor, "*#batch 2"],
    stiffness: tuple[float, float, float] = (4e-4, 4e-4, 4e-5),
) -> Goals:
    """The paper's regions with their printed gains and gradients.

    Args:
        centre: Centre of the box, chosen by the expert in the paper [m].
        half_size: Half edges of the box, chosen by the expert in the paper [m].
        target: Target in the image [px].
        stiffness: k_c of the box; default: as printed.
    """
    goal = quaternion.normalize(centre.new_tensor(GRIPPER_DOWN))
    return Goals(
        position=PositionRegion(centre=centre, half_size=half_size, stiffness=stiffness),
        orientation=OrientationRegion(goal=goal, stiffness=1.0, formulation="paper"),
        vision=VisionRegion(
            target=target,
            half_size=target.new_tensor((1440.0, 1080.0)),
            formulation="paper",
        ),
        vision_enabled=torch.tensor(True, device=centre.device),
    )


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
        """Set the initial weights when the feature is first seen, then apply the law."""
        total = self.network.basis(measurement.pose).sum(-1)[..., None, None]
        waiting = (state.weight == 0).all(-1, keepdim=True).all(-2, keepdim=True)
        begins = waiting & measurement.valid[..., None, None]
        weight = torch.where(begins, self.column / total, state.weight)
        moved = super().update(WeightState(weight=weight), measurement).weight
        return WeightState(weight=torch.where(waiting & ~begins, weight, moved))
