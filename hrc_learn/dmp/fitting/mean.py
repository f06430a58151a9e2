"""One primitive from several: the mean of what a person showed more than once."""

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp.joint import JointDMP
from hrc_learn.dmp.orientation import OrientationDMP
from hrc_learn.dmp.pose import PoseDMP


def mean_primitive[Primitive: (JointDMP, OrientationDMP, PoseDMP)](
    primitives: Primitive,
) -> Primitive:
    """The mean over all batch dimensions of a primitive.

    A rollout is linear in weights, start, goal and start velocity. So for one duration, and
    forcing that does not scale with start and goal, its mean is the rollout of the means.

    Args:
        primitives: Fitted to several demonstrations of one motion.

    Returns:
        A primitive without batch dimensions, and without a fit report.

    Raises:
        ValueError: Primitives whose scaling turns them, each with the way of its own.
    """
    if isinstance(primitives, JointDMP):
        return _mean_of_joints(primitives)
    motion = _mean_of_joints(primitives.motion)
    if isinstance(primitives, OrientationDMP):
        return OrientationDMP(motion, _mean_goal(primitives.goal), primitives.formulation)
    return PoseDMP(motion, _mean_goal(primitives.goal_orientation))


def _mean_goal(goals: Float[Tensor, "*batch 4"]) -> Float[Tensor, "4"]:
    goals = goals.reshape(-1, 4)
    # Both signs are the same orientation: bring all to the side of the first.
    goals = goals * torch.where((goals @ goals[0])[:, None] < 0, -1.0, 1.0).to(goals)
    return torch.nn.functional.normalize(goals.mean(dim=0), dim=-1)


def _mean_of_joints(primitives: JointDMP) -> JointDMP:
    if primitives.forcing_scale.turns and primitives.weights.ndim > 2:
        raise ValueError(
            f"scaling {primitives.scaling!r} gives each primitive a frame of its own: fit with "
            "'none' to average them"
        )
    x, stamps = primitives.coordinates().detach(), primitives.stamps
    batch = x.ndim - 2

    def mean(tensor: torch.Tensor) -> torch.Tensor:
        return tensor.flatten(0, batch - 1).mean(dim=0) if batch else tensor

    return primitives.with_coordinates(
        mean(x),
        mean(primitives.duration),
        amplitude=mean(primitives.amplitude),
        stamps=torch.linspace(0, 1, stamps.shape[-1], dtype=stamps.dtype, device=stamps.device),
    )
