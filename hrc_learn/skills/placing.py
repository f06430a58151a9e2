"""Placing an object on a shelf by a learned motion: candidate plans, checked before execution.

The motion was demonstrated for one shelf. For another one there are two spaces to plan in: the
joint-space primitive with a shifted goal, as in the paper, which bends the path into the shelf;
and the pose primitive with the learned arm angle tracked in the null space, which keeps it
straight.
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

from hrc_learn.controller.resolved_rate import resolved_rate
from hrc_learn.dmp import JointDMP, PoseDMP
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import (
    Arm,
    SerialChain,
    TaskSpace,
    UnreachableError,
    arm_angle,
    arm_angle_and_motion,
    task_basis,
    task_error,
    task_rank,
)
from hrc_learn.regions import JointRegion
from hrc_learn.skills.arm_motion import joint_line
from hrc_learn.skills.failures import BlockedPathError
from hrc_learn.skills.workplace import CollisionChecker, Workplace

PlanningSpace = Literal["joint", "pose"]

# Decay rates of the errors of pose (k_e) and arm angle (k_a) along a planned path [1/s].
_POSE_GAIN, _ANGLE_GAIN = 10.0, 4.0


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A motion of the joints, sampled at the control step."""

    goal: Pose
    """Where the end effector should end."""
    dt: float
    """[s]"""
    path: Float[np.ndarray, "steps joints"]
    """Joint positions [rad]."""
    chain: SerialChain
    """The arm."""

    @property
    def tool_pose(self) -> Pose:
        """Pose of the end effector along the path."""
        return self.chain.forward(torch.from_numpy(self.path))

    @property
    def duration(self) -> float:
        """[s]"""
        return self.dt * (len(self.path) - 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class PlaceCorrection:
    """How an arm's own readings differ from where places are said to be.

    Errors of base, tool and encoders are nearly the same at all places in one orientation. Read
    once at a place that is known, to which a person leads the arm, they can be taken out: what
    remains is the arm's repeatability.
    """

    shift: Float[Tensor, "3"]
    """Of positions, base frame [m]."""
    turn: Float[Tensor, "4"]
    """Of orientations, in the tool's frame."""

    @classmethod
    def of(cls, read: Pose, place: Pose) -> "PlaceCorrection":
        """From the pose that the arm reads where its tool is at a known place."""
        back = quaternion.conjugate(place.orientation)
        return cls(
            shift=read.position - place.position,
            turn=quaternion.multiply(back, read.orientation),
        )

    def apply(self, place: Pose) -> Pose:
        """What the arm will read with its tool at another place."""
        turned = quaternion.multiply(place.orientation, self.turn)
        return Pose(place.position + self.shift, turned)


@dataclass(frozen=True, kw_only=True)
class PlacingSkill:
    """Primitives learned from demonstrations of placing."""

    joint: JointDMP
    """Motion of the joints."""
    pose: PoseDMP
    """Motion of the end effector together with the arm angle, its null-space posture, of an arm
    that has one."""
    robot: Arm
    """The arm that they are of."""

    @classmethod
    def load(cls, folder: Path, robot: Arm) -> "PlacingSkill":
        """Read what `hrc fit` wrote.

        Args:
            folder: With the primitives.
            robot: The arm that is to do it.

        Raises:
            FileNotFoundError: If the folder holds no primitives.
            ValueError: If they are of another arm, or hold no poses.
        """
        joint = JointDMP.load(folder / "joint").double()
        names = robot.chain.joint_names
        if joint.joint_names != names:
            raise ValueError(
                f"{folder / 'joint'} moves the joints {joint.joint_names}, but the "
                f"{robot.name} has {names}: fit demonstrations of this arm, or name with "
                "--robot the one that they are of."
            )
        if not (folder / "pose").is_dir():
            raise ValueError(
                f"{folder} holds no pose primitive: its demonstrations had no end-effector "
                "pose. Record it (columns ee.x ... ee.wz), then fit again."
            )
        pose = PoseDMP.load(folder / "pose").double()
        return cls(joint=joint, pose=pose, robot=robot)

    def plan(
        self,
        start: Float[Tensor, " joints"],
        goal: Pose,
        *,
        space: PlanningSpace,
        dt: float,
        speed: float = 1.0,
    ) -> Plan:
        """Plan the motion from the arm's present position to a goal of the end effector.

        Args:
            start: Joint positions now [rad].
            goal: Where the end effector should release the object.
            space: Follow the primitive of the joints, or that of the pose.
            dt: Step of the plan [s].
            speed: How many times faster than demonstrated.

        Raises:
            UnreachableError: If no joint positions reach the goal.
        """
        # Of both spaces: a goal out of reach is refused before anything is planned.
        end = self.robot.inverse(goal, near=self.joint.goal)
        duration = float(self.joint.duration) / speed
        time = torch.arange(0.0, duration + dt / 2, dt, dtype=torch.float64)
        chain, has_angle = self.robot.chain, self.robot.null_space == "arm angle"
        with torch.no_grad():
            if space == "joint":
                still = torch.zeros_like(start)
                path = self.joint.rollout(
                    time, start=start, goal=end, duration=duration, start_velocity=still
                ).position
            else:
                motion = self.pose.rollout(
                    time,
                    start=chain.forward(start),
                    goal=goal,
                    duration=duration,
                    start_velocity=torch.zeros(6, dtype=time.dtype),
                    start_body=arm_angle(chain, start)[None] if has_angle else None,
                )
                angle = motion.body[:, 0] if has_angle else None
                path = follow_pose(chain, start, motion.pose, motion.twist, angle, dt)
        return Plan(goal=goal, dt=dt, path=path.numpy(), chain=chain)


def follow_pose(
    chain: SerialChain,
    start: Float[Tensor, " joints"],
    poses: Pose,
    twist: Float[Tensor, "steps 6"],
    angle: Float[Tensor, " steps"] | None,
    dt: float,
    *,
    task: TaskSpace = "pose",
) -> Float[Tensor, "steps joints"]:
    """Joint path that tracks poses of the end effector, and arm angles in the null space.

    u = J^+ (twist + k_e e) + N n (angle' + k_a (angle - angle(q))) - N xi_q, where
    n turns the arm angle at unit rate and xi_q is the gradient of the joint-limit region: the
    poses are met, the arm angle as far as the null space and the joint limits allow. Of a task
    of fewer dimensions than a pose, J and N are those of what it leads.

    Args:
        chain: The arm.
        start: Joint positions at the first pose [rad].
        poses: Desired poses of the end effector, (steps,).
        twist: Its desired motion (linear [m/s], angular [rad/s]).
        angle: Desired arm angles, continuous [rad]; None: the joint limits alone move the null
            space, if there is one.
        dt: Time between samples [s].
        task: What of the poses is followed: an arm of five joints has none for all of it.
    """
    limits = JointRegion.from_limits(chain.limits.lower, chain.limits.upper)
    rate = None if angle is None else torch.gradient(angle, spacing=dt)[0]
    q, path = start, [start]
    rank = task_rank(chain, task)
    for k in range(len(twist) - 1):
        pose, J = chain.forward_and_jacobian(q)
        if task == "pose":
            desired = twist[k] + _POSE_GAIN * pose.twist_to(poses[k])
        else:
            desired = twist[k] + _POSE_GAIN * task_error(pose.matrix()[:3], poses[k], task)
        null_velocity = -limits.gradient(q)
        if angle is not None and rate is not None:
            measured, motion = arm_angle_and_motion(chain, q, J)
            # The shorter way around the circle.
            error = torch.remainder(angle[k] - measured + torch.pi, 2 * torch.pi) - torch.pi
            null_velocity = motion * (rate[k] + _ANGLE_GAIN * error) + null_velocity
        if task != "pose":
            basis = task_basis(J, pose.orientation, task, rank)
            J, desired = basis @ J, basis @ desired
        task_velocity, null = resolved_rate(J, desired, null_velocity)
        q = q + dt * (task_velocity + null)
        path.append(q)
    return torch.stack(path)


def check_plan(plan: Plan, world: CollisionChecker, carried: str | None = None) -> None:
    """Make sure that a plan keeps the arm's limits and collides with nothing.

    Args:
        plan: The plan.
        world: Where it is to be executed, in its present state.
        carried: The object in the gripper.

    Raises:
        BlockedPathError: Otherwise; tells what and where.
    """
    limits, names = plan.chain.limits, plan.chain.joint_names
    path = torch.from_numpy(plan.path)
    outside = (path < limits.lower) | (path > limits.upper)
    if bool(outside.any()):
        k, joint = (int(i) for i in outside.nonzero()[0])
        raise BlockedPathError(
            f"the plan leaves the range of {names[joint]} after {k * plan.dt:.1f} "
            f"s, at {float(path[k, joint]):.3f} rad."
        )
    speed = path.diff(dim=0).abs() / plan.dt
    too_fast = speed > limits.velocity
    if bool(too_fast.any()):
        k, joint = (int(i) for i in too_fast.nonzero()[0])
        raise BlockedPathError(
            f"the plan asks {names[joint]} for {float(speed[k, joint]):.2f} rad/s "
            f"after {k * plan.dt:.1f} s, more than its {float(limits.velocity[joint]):.2f} "
            "rad/s: plan it slower."
        )
    # One sample in 40 ms: at most 2 cm of motion at the speed of a placing motion.
    every = max(1, round(0.04 / plan.dt))
    samples = np.concatenate([plan.path[:-1:every], plan.path[-1:]])
    touches = world.collisions_along(samples, carried)
    if touches:
        first = touches[0]
        raise BlockedPathError(
            f"after {first.start * every * plan.dt:.1f} s {first.first} would hit "
            f"{first.second}, {1e3 * first.depth:.0f} mm deep."
        )


# Offsets of via points from home [m]: around what may stand in the direct path.
_VIA_POINTS = {
    "higher": (0.0, 0.0, 0.12),
    "nearer to the robot": (-0.14, 0.0, 0.06),
    "further from the robot": (0.08, 0.0, 0.10),
}
# Changes of joint 7 at home, which turn the elbow about the line to the wrist [rad].
_ARM_ANGLES = {"with the elbow further out": -0.35, "with the elbow further in": 0.35}
# How much higher an object that sits low in the gripper is released [m].
_RAISED = 0.008


class CandidatePlan(NamedTuple):
    """A plan, and how it differs from the learned one."""

    name: str
    plan: Plan


def plan_candidates(
    goal: Pose,
    start: Float[Tensor, " joints"],
    skill: PlacingSkill,
    workplace: Workplace,
    *,
    space: PlanningSpace,
    dt: float,
    speed: float,
) -> Iterator[CandidatePlan]:
    """Candidate plans to a shelf, the learned one first; each is planned when asked for.

    The others end a little higher, as an object that sits low in the gripper needs it, or start
    at another via point or arm angle. The primitive returns to the learned pose and arm angle
    as it nears its goal: the path into the shelf stays as it is.

    Args:
        goal: Of the end effector.
        start: Joint positions now [rad].
        skill: The learned motion.
        workplace: Whose home the other candidates start near.
        space: In which the motion is planned.
        dt: Control step [s].
        speed: How many times faster than demonstrated.
    """

    def learned(start: Tensor, goal: Pose = goal) -> Plan:
        return skill.plan(start, goal, space=space, dt=dt, speed=speed)

    yield CandidatePlan("as learned", learned(start))
    up = goal.position.new_tensor([0.0, 0.0, _RAISED])
    with suppress(UnreachableError):
        raised = Pose(goal.position + up, goal.orientation)
        yield CandidatePlan("a little higher", learned(start, raised))
    for name, via in _via_postures(workplace):
        first = joint_line(start, via, speed=0.6, dt=dt).numpy()
        rest = learned(via)
        path = np.concatenate([first, rest.path[1:]])
        yield CandidatePlan(name, replace(rest, path=path))


def _via_postures(workplace: Workplace) -> Iterator[tuple[str, Float[Tensor, " joints"]]]:
    """Joint positions near home that can be reached."""
    for name, offset in _VIA_POINTS.items():
        with suppress(UnreachableError):
            yield name, workplace.home_joints(torch.tensor(offset, dtype=torch.float64))
    if workplace.robot.null_space != "arm angle":
        return
    for name, change in _ARM_ANGLES.items():
        with suppress(UnreachableError):
            yield name, workplace.home_joints(q7_offset=change)
