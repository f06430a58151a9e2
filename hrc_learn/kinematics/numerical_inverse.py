"""Inverse kinematics of any serial arm by damped least squares, from many starts at once."""

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.kinematics.chain import SerialChain

_ITERATIONS = 60
"""Enough for nine in ten of the starts that get there at all."""
_LONGEST_STEP = 0.4
"""Of a joint in one iteration [rad]: the Jacobian holds no further."""
_DAMPING = 0.02
"""Of the step while the error is of the size of one [m, rad]; it goes down with the error, so
the last iterations are Newton's."""
_TOLERANCE = 1e-9
"""Largest error of a solution [m, rad]."""


def solutions_from(
    chain: SerialChain, pose: Pose, starts: Float[Tensor, "starts joints"]
) -> Float[Tensor, "solutions joints"]:
    """Joint positions that reach a pose within the limits, from each start that leads there.

    dq = J^T (J J^T + d^2 I)^-1 e with d in proportion to the error e, held within the limits
    (Chan and Lawrence 1988, "General inverse kinematics with the error damped pseudoinverse").

    Args:
        chain: The arm, with six joints or more.
        pose: Of the tool centre point, without batch dimensions.
        starts: Joint positions [rad].

    Returns:
        In the order of the starts; none if the pose is out of reach of all.
    """
    limits = chain.limits
    q = starts.double().clamp(limits.lower, limits.upper)
    goal = Pose(pose.position.double(), pose.orientation.double())
    eye = torch.eye(6, dtype=torch.float64)
    for _ in range(_ITERATIONS):
        now, J = chain.forward_and_jacobian(q)
        error = now.twist_to(goal)
        size = error.norm(dim=-1).clamp(max=1.0)[:, None, None]
        damped = J @ J.mT + ((_DAMPING * size) ** 2 + 1e-12) * eye
        step = (J.mT @ torch.linalg.solve(damped, error.unsqueeze(-1))).squeeze(-1)
        longest = step.abs().amax(-1, keepdim=True)
        step = step * (_LONGEST_STEP / longest.clamp(min=_LONGEST_STEP))
        q = (q + step).clamp(limits.lower, limits.upper)
    error = chain.forward(q).twist_to(goal).abs().amax(-1)
    return q[error < _TOLERANCE]
