"""Speed of joint paths relative to the limits of an arm."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.kinematics import Arm

ORDERS = {"velocity": 1, "acceleration": 2, "jerk": 3}
"""Limits by name, with the order of the derivative that each one bounds."""


def speed_excess(
    robot: Arm,
    paths: Float[Tensor, "B T joints"],
    dt: float,
    kinds: Sequence[str] = tuple(ORDERS),
    usable: float = 1.0,
) -> tuple[Float[Tensor, "B"], list[str]]:
    """Factor by which each path is too fast, and the limit that it breaks most.

    A path that takes that many times as long keeps all limits; below 1 it keeps them already.

    Args:
        robot: The arm.
        paths: Joint positions [rad].
        dt: Time between samples [s].
        kinds: Limits to keep, by their names in `ORDERS`.
        usable: Fraction of the limits that a path may use.
    """
    factors, names = [], []
    for kind in kinds:
        order = ORDERS[kind]
        rate = torch.diff(paths, n=order, dim=1).abs() / dt**order
        ratio = (rate / (usable * getattr(robot.limits, kind))).amax(1)
        factors.append(ratio ** (1 / order))
        names += [f"{kind} of {joint}" for joint in robot.joint_names]
    worst, at = torch.cat(factors, -1).max(-1)
    return worst, [names[k] for k in at.tolist()]
