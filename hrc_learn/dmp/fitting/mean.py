"""One primitive from several: the mean of what a person showed more than once."""

from typing import Any

import torch

from hrc_learn.dmp.joint import JointDMP
from hrc_learn.dmp.pose import PoseDMP
from hrc_learn.dmp.saved_joint import TENSORS


def mean_primitive[Primitive: (JointDMP, PoseDMP)](primitives: Primitive) -> Primitive:
    """The mean over all batch dimensions of a primitive.

    A rollout is linear in weights, start, goal and start velocity. So for one duration, and
    forcing that does not scale with start and goal, its mean is the rollout of the means.

    Args:
        primitives: Fitted to several demonstrations of one motion.

    Returns:
        A primitive without batch dimensions, and without a fit report.
    """
    if isinstance(primitives, JointDMP):
        return _mean_of_joints(primitives)
    goals = primitives.goal_orientation.reshape(-1, 4)
    # Both signs are the same orientation: bring all to the side of the first.
    goals = goals * torch.where((goals @ goals[0])[:, None] < 0, -1.0, 1.0).to(goals)
    goal = torch.nn.functional.normalize(goals.mean(dim=0), dim=-1)
    return PoseDMP(_mean_of_joints(primitives.motion), goal)


def _mean_of_joints(primitives: JointDMP) -> JointDMP:
    weights = primitives.weights.detach()
    batch = weights.ndim - 2

    def mean(tensor: torch.Tensor) -> torch.Tensor:
        return tensor.flatten(0, batch - 1).mean(dim=0) if batch else tensor

    buffers: dict[str, Any] = {name: mean(getattr(primitives, name)) for name in TENSORS[1:-1]}
    samples = primitives.stamps.shape[-1]
    return JointDMP(
        weights=mean(weights),
        stamps=torch.linspace(0.0, 1.0, samples, dtype=primitives.stamps.dtype),
        basis=primitives.basis,
        spring=primitives.spring,
        scaling=primitives.scaling,
        approach=primitives.response.approach,
        joint_names=primitives.joint_names,
        units=primitives.units,
        **buffers,
    )
