"""Which of the many postures for a tool pose to approach."""

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.kinematics import FrankaArm, UnreachableError

# Beyond these a posture is as good as any [1], [rad].
_GOOD_SINGULAR_VALUE = 0.2
_GOOD_DISTANCE = 0.5


def comfortable_posture(
    chain: FrankaArm, pose: Pose, *, candidates: int = 29
) -> Float[Tensor, "n"]:
    """Inverse-kinematics solution furthest from singularities and joint limits.

    An arm that servoes round a pose keeps its posture but for small motions, so the posture
    it arrives in decides whether it meets a limit there.

    Args:
        chain: The arm.
        pose: Of the tool, without batch dimensions.
        candidates: Values tried for the last joint, the redundant parameter.

    Returns:
        Joint position [rad].

    Raises:
        UnreachableError: No candidate reaches the pose within the limits.
    """
    lower, upper = chain.limits.lower, chain.limits.upper
    q7 = torch.linspace(float(lower[-1]), float(upper[-1]), candidates, dtype=torch.float64)
    many = Pose(
        pose.position.double().expand(candidates, 3),
        pose.orientation.double().expand(candidates, 4),
    )
    solutions = chain.inverse_all(many, q7).flatten(0, 1)
    solutions = solutions[solutions.isfinite().all(-1)]
    if len(solutions) == 0:
        raise UnreachableError(
            f"no posture within the joint limits brings the tool to {pose.position.tolist()} m "
            f"with orientation {pose.orientation.tolist()}; move the goal towards the arm"
        )
    distance = torch.minimum(solutions - lower, upper - solutions).amin(-1)
    smallest = torch.linalg.svdvals(chain.jacobian(solutions))[:, -1]
    score = (distance / _GOOD_DISTANCE).clamp(max=1) + (smallest / _GOOD_SINGULAR_VALUE).clamp(
        max=1
    )
    return solutions[score.argmax()].to(pose.position)
