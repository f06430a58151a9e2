"""Closed-form inverse kinematics of Franka arms, with joint 7 as the free parameter.

The algorithm is He and Liu 2021, "Analytical inverse kinematics for Franka Emika Panda", as
`frankik` implements it: about 2 us a pose. It does not return the branch of the elbow with
q4 > -0.467 rad, where the forearm folds to the other side, nor, in one pose of 300, a valid
answer at the shoulder singularity (q2 = 0). What it returns is checked here.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.kinematics.chain import SerialChain

# A returned branch whose own forward kinematics is further off than this [m, rad] is wrong.
_TOLERANCE = 1e-6


class UnreachableError(ValueError):
    """No joint configuration within limits reaches a pose with the wanted joint 7."""


def solve_all(
    chain: SerialChain, pose: Pose, q7: Float[Tensor, "*#batch"] | float
) -> Float[Tensor, "*batch 4 7"]:
    """All branches within joint limits that reach a pose of the tool centre point.

    Args:
        chain: A Panda.
        pose: Of the tool centre point in the base frame, in any batch shape.
        q7: Position of joint 7 [rad].

    Returns:
        Up to four branches [rad] first, rows of NaN after them.
    """
    position = pose.position.detach().double().cpu()
    orientation = pose.orientation.detach().double().cpu()
    tip = Pose(position, orientation).matrix()
    flange = tip @ torch.linalg.inv(chain.tcp)
    q7 = torch.as_tensor(q7, dtype=torch.float64).cpu()
    # Not torch's: that one imports sympy when it is first called, which takes seconds.
    shape = np.broadcast_shapes(flange.shape[:-2], q7.shape)
    flanges = flange.expand(*shape, 4, 4).reshape(-1, 4, 4)
    angles = q7.expand(shape).reshape(-1)

    branches = [_branches(T, angle) for T, angle in zip(flanges.numpy(), angles, strict=True)]
    q = torch.from_numpy(np.stack(branches)).reshape(*shape, 4, 7)
    q = _keep_true_ones(chain, q, tip.expand(*shape, 4, 4))
    return q.to(pose.position)


def solve_nearest(
    chain: SerialChain,
    pose: Pose,
    q7: Float[Tensor, "*#batch"] | float,
    near: Float[Tensor, "*#batch 7"],
) -> Float[Tensor, "*batch 7"]:
    """The branch nearest to a configuration.

    Args:
        chain: A Panda.
        pose: Of the tool centre point in the base frame.
        q7: Position of joint 7 [rad].
        near: Configuration to stay close to [rad].

    Raises:
        UnreachableError: A pose has no branch within limits.
    """
    q = solve_all(chain, pose, q7)
    distance = (q - near.to(q)[..., None, :]).square().sum(-1)
    distance = torch.where(distance.isnan(), torch.inf, distance)
    best = distance.min(-1)
    if bool(best.values.isinf().any()):
        raise UnreachableError(_explain(pose, q7, best.values.isinf()))
    return torch.take_along_dim(q, best.indices[..., None, None], dim=-2).squeeze(-2)


def _branches(flange: np.ndarray, q7: Tensor) -> np.ndarray:
    """Frankik's four rows, NaN where there is no solution."""
    import frankik  # only here: the rest of the package works without it

    # The second argument only selects among branches when a joint is indeterminate.
    return frankik.ik_full(flange, frankik.kQDefault, float(q7), False)


def _keep_true_ones(
    chain: SerialChain, q: Float[Tensor, "*batch 4 7"], tip: Float[Tensor, "*batch 4 4"]
) -> Float[Tensor, "*batch 4 7"]:
    """Blank branches outside limits or at another pose, and move them to the end."""
    reached = chain.forward(q).matrix()
    error = (reached - tip[..., None, :, :]).abs().flatten(-2).amax(-1)
    good = chain.limits.contain(q) & (error < _TOLERANCE)  # False for rows of NaN
    q = torch.where(good[..., None], q, torch.nan)
    order = torch.argsort(~good, dim=-1, stable=True)
    return torch.take_along_dim(q, order[..., None], dim=-2)


def _explain(pose: Pose, q7: Tensor | float, missing: Tensor) -> str:
    first = tuple(missing.nonzero()[0].tolist())
    shape = missing.shape
    position = pose.position.expand(*shape, 3)[first].tolist()
    orientation = pose.orientation.expand(*shape, 4)[first].tolist()
    angle = torch.as_tensor(q7).expand(shape)[first].item()
    which = f"pose {list(first)} of {list(shape)}" if shape else "the pose"
    return (
        f"{which}, position ({_join(position)}) m, quaternion wxyz ({_join(orientation)}), "
        f"has no solution within joint limits with joint 7 at {angle:.4f} rad. "
        "Try other values of q7 (the range within limits, in steps of 0.1 rad, finds most "
        "solutions), or move the pose closer to the base."
    )


def _join(values: list[float]) -> str:
    return ", ".join(f"{value:.4f}" for value in values)
