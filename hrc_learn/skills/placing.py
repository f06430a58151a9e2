"""Placing an object on a shelf by a learned motion: candidate plans, checked, then
carried out.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp import JointDMP, PoseDMP
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import (
    SerialChain,
    UnreachableError,
    arm_angle,
    arm_angle_and_motion,
    panda,
)
from hrc_learn.regions import JointRegion
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace, nearest_configuration
from hrc_learn.skills.cartesian_motion import joint_line, resolved_rate
from hrc_learn.skills.work_cell import BlockedPathError

# Placing a thing on a shelf by a learned motion: planned, checked, then carried out.
#
# The motion was taught for one shelf. For another one there are two ways: the joint-space
# primitive with a shifted goal, as in the paper, which bends the way into the shelf; and the
# pose primitive with the learned body shape followed in the null space, which keeps it
# straight.

PlanningSpace = Literal["joint", "pose"]


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A motion of the joints, sampled at the control step."""

    goal: Pose
    """Where the hand should end."""
    dt: float
    """[s]"""
    path: Float[np.ndarray, "steps 7"]
    """Joint positions [rad]."""

    @property
    def hand(self) -> Pose:
        """Pose of the hand along the path."""
        return panda.forward(torch.from_numpy(self.path))

    @property
    def duration(self) -> float:
        """[s]"""
        return self.dt * (len(self.path) - 1)


@dataclass(frozen=True, kw_only=True)
class PlacingSkill:
    """What was learned from demonstrations of placing."""

    joint: JointDMP
    """Motion of the joints."""
    pose: PoseDMP
    """Motion of the hand, with the arm angle as the body shape learned along."""

    @classmethod
    def load(cls, folder: Path) -> "PlacingSkill":
        """Read what `hrc fit` wrote.

        Raises:
            FileNotFoundError: If the folder holds no primitives.
            ValueError: If they are not of a Panda, or hold no poses.
        """
        joint = JointDMP.load(folder / "joint").double()
        if joint.joint_names != panda.joint_names:
            raise ValueError(
                f"{folder / 'joint'} moves the joints {joint.joint_names}, but the arm has "
                f"{panda.joint_names}: fit demonstrations of this arm."
            )
        if not (folder / "pose").is_dir():
            raise ValueError(
                f"{folder} holds no pose primitive: its demonstrations had no end-effector "
                "pose. Record it (columns ee.x ... ee.wz), then fit again."
            )
        return cls(joint=joint, pose=PoseDMP.load(folder / "pose").double())

    def plan(
        self,
        start: Float[Tensor, "7"],
        goal: Pose,
        *,
        space: PlanningSpace,
        dt: float,
        speed: float = 1.0,
    ) -> Plan:
        """Plan the motion from the arm's present position to a goal of the hand.

        Args:
            start: Joint positions now [rad].
            goal: Where the hand should let go.
            space: Follow the primitive of the joints, or that of the pose.
            dt: Step of the plan [s].
            speed: How many times faster than demonstrated.

        Raises:
            UnreachableError: If no joint positions reach the goal.
        """
        end = nearest_configuration(goal, near=self.joint.goal)
        duration = float(self.joint.duration) / speed
        time = torch.arange(0.0, duration + dt / 2, dt, dtype=torch.float64)
        with torch.no_grad():
            if space == "joint":
                path = self._plan_joints(start, end, time, duration)
            else:
                path = self._plan_pose(start, goal, time, duration)
        return Plan(goal=goal, dt=dt, path=path.numpy())

    def _plan_joints(self, start: Tensor, end: Tensor, time: Tensor, duration: float) -> Tensor:
        still = torch.zeros_like(start)
        motion = self.joint.rollout(
            time, start=start, goal=end, duration=duration, start_velocity=still
        )
        return motion.position

    def _plan_pose(self, start: Tensor, goal: Pose, time: Tensor, duration: float) -> Tensor:
        motion = self.pose.rollout(
            time,
            start=panda.forward(start),
            goal=goal,
            duration=duration,
            start_velocity=torch.zeros(6, dtype=time.dtype),
            start_body=arm_angle(panda, start)[None],
        )
        dt = float(time[1] - time[0])
        return follow_pose(panda, start, motion.pose, motion.twist, motion.body[:, 0], dt)


def follow_pose(
    chain: SerialChain,
    start: Float[Tensor, "7"],
    hand: Pose,
    twist: Float[Tensor, "steps 6"],
    angle: Float[Tensor, " steps"],
    dt: float,
    gain: float = 10.0,
    angle_gain: float = 4.0,
) -> Float[Tensor, "steps 7"]:
    """Joint path that keeps the hand on given poses and the arm angle near given values.

    u = J^+ (twist + gain e) + N n (angle' + angle_gain (angle - angle(q))) - N xi_q, where
    n turns the arm angle at unit rate: the hand's motion is met, the body's as far as the null
    space and the joint limits allow.

    Args:
        chain: The arm.
        start: Joint positions at the first pose [rad].
        hand: Wanted poses, (steps,).
        twist: Wanted motion of the hand (linear [m/s], angular [rad/s]).
        angle: Wanted arm angles, continuous [rad].
        dt: Time between samples [s].
        gain: Decay rate of the hand's error [1/s].
        angle_gain: Decay rate of the arm angle's error [1/s].
    """
    limits = JointRegion.from_limits(chain.limits.lower, chain.limits.upper)
    rate = torch.gradient(angle, spacing=dt)[0]
    q, path = start, [start]
    for k in range(len(angle) - 1):
        pose, J = chain.forward_and_jacobian(q)
        wanted = twist[k] + gain * pose.twist_to(hand[k])
        shown, motion = arm_angle_and_motion(chain, q, J)
        error = torch.remainder(angle[k] - shown + torch.pi, 2 * torch.pi) - torch.pi
        shape = motion * (rate[k] + angle_gain * error)
        q = q + dt * resolved_rate(J, wanted, shape - limits.gradient(q))
        path.append(q)
    return torch.stack(path)


def check_plan(plan: Plan, world: World, carried: str | None = None) -> None:
    """Make sure that a plan keeps the arm's limits and hits nothing.

    Args:
        plan: The plan.
        world: Where it is to be carried out, in its present state.
        carried: The thing in the hand.

    Raises:
        BlockedPathError: Otherwise; tells what and where.
    """
    limits = panda.limits
    path = torch.from_numpy(plan.path)
    outside = (path < limits.lower) | (path > limits.upper)
    if bool(outside.any()):
        k, joint = (int(i) for i in outside.nonzero()[0])
        raise BlockedPathError(
            f"the plan leaves the range of {panda.joint_names[joint]} after {k * plan.dt:.1f} "
            f"s, at {float(path[k, joint]):.3f} rad."
        )
    speed = path.diff(dim=0).abs() / plan.dt
    too_fast = speed > limits.velocity
    if bool(too_fast.any()):
        k, joint = (int(i) for i in too_fast.nonzero()[0])
        raise BlockedPathError(
            f"the plan asks {panda.joint_names[joint]} for {float(speed[k, joint]):.2f} rad/s "
            f"after {k * plan.dt:.1f} s, more than its {float(limits.velocity[joint]):.2f} "
            "rad/s: play it slower."
        )
    every = max(1, round(0.04 / plan.dt))
    samples = np.concatenate([plan.path[:-1:every], plan.path[-1:]])
    touches = world.collisions_along(samples, carried)
    if touches:
        first = touches[0]
        raise BlockedPathError(
            f"after {first.start * every * plan.dt:.1f} s {first.first} would hit "
            f"{first.second}, {1e3 * first.depth:.0f} mm deep."
        )


# Ways to a shelf: the learned one, and others for when that is blocked.

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
