"""Ways to a shelf: the learned one, and others for when that is blocked."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import Pose
from ..kinematics import UnreachableError
from .motion import joint_line
from .placing import PlacingSkill, Plan, PlanningSpace
from .workplace import Workplace

_VIA_POINTS = {
    "higher": (0.0, 0.0, 0.12),
    "nearer to the robot": (-0.14, 0.0, 0.06),
    "further from the robot": (0.08, 0.0, 0.10),
}
"""Offsets from home [m]."""
_ARM_ANGLES = {"with the elbow further out": -0.35, "with the elbow further in": 0.35}
"""Changes of joint 7 at home, which turn the elbow about the line to the wrist [rad]."""
_RAISED = 0.008
"""How much higher a thing that sits low in the hand is put down [m]."""


class Way(NamedTuple):
    """A plan, and how it differs from the learned one."""

    name: str
    plan: Plan


def ways_to(
    goal: Pose,
    start: Float[Tensor, "7"],
    skill: PlacingSkill,
    workplace: Workplace,
    *,
    space: PlanningSpace,
    dt: float,
    speed: float,
) -> Iterator[Way]:
    """Ways from where the arm is to a shelf, the learned one first, planned when asked for.

    Another way ends a little higher, as a thing that sits low in the hand needs it, or begins
    at another via point or arm angle. The primitive brings hand and body back to what was
    learned as it nears its goal: the way into the shelf stays as it is.

    Args:
        goal: Of the hand.
        start: Joint positions now [rad].
        skill: The learned motion.
        workplace: Whose home the other ways begin about.
        space: In which the motion is planned.
        dt: Control step [s].
        speed: How many times faster than demonstrated.
    """

    def learned(begin: Tensor, goal: Pose = goal) -> Plan:
        return skill.plan(begin, goal, space=space, dt=dt, speed=speed)

    yield Way("as learned", learned(start))
    up = goal.position.new_tensor([0.0, 0.0, _RAISED])
    with suppress(UnreachableError):
        raised = Pose(goal.position + up, goal.orientation)
        yield Way("a little higher", learned(start, raised))
    for name, via in _vias(workplace):
        first = joint_line(start, via, speed=0.6, dt=dt).numpy()
        rest = learned(via)
        yield Way(name, replace(rest, path=np.concatenate([first, rest.path[1:]])))


def _vias(workplace: Workplace) -> Iterator[tuple[str, Float[Tensor, "7"]]]:
    """Joint positions to begin from that can be reached."""
    for name, offset in _VIA_POINTS.items():
        try:
            yield name, workplace.home_joints(torch.tensor(offset, dtype=torch.float64))
        except UnreachableError:
            continue
    for name, change in _ARM_ANGLES.items():
        try:
            turned = replace(workplace, home_q7=workplace.home_q7 + change)
            yield name, turned.home_joints()
        except UnreachableError:
            continue
