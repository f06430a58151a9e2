"""A workplace with shelves, and plans to place an object on a shelf by a learned motion.

The motion was demonstrated for one shelf. For another shelf it is planned in one of two spaces.
In joint space, the goal of the joint primitive is shifted, as in the paper; the path into the
shelf is then bent. In pose space, the pose primitive moves the end effector, and the learned
arm angle (of the elbow about the line from shoulder to wrist) moves the null space; the path
then stays straight.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Protocol, get_args, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller.resolved_rate import resolved_rate
from hrc_learn.dmp import JointDMP, PoseDMP
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.geometry.numerics import check_choice
from hrc_learn.kinematics import (
    Arm,
    SerialChain,
    UnreachableError,
    arm_angle,
    arm_angle_and_motion,
)
from hrc_learn.protocols import Touch
from hrc_learn.regions import JointRegion
from hrc_learn.skills.arm_motion import joint_line
from hrc_learn.skills.work_cell import BlockedPathError
from hrc_learn.vision import Marker

PlanningSpace = Literal["joint", "pose"]

# Decay rates of the errors of pose (k_e) and arm angle (k_a) along a planned path [1/s].
_POSE_GAIN, _ANGLE_GAIN = 10.0, 4.0


@runtime_checkable
class GraspObject(Protocol):
    """A box to grasp, with a marker on top."""

    @property
    def name(self) -> str:
        """Name of the object."""
        ...

    @property
    def half_size(self) -> tuple[float, float, float]:
        """Half edges [m]; the gripper closes along x."""
        ...

    @property
    def marker(self) -> Marker:
        """Marker by which the camera finds the object."""
        ...


@runtime_checkable
class Workplace(Protocol):
    """Approximate poses of a task in the base frame: table, home and shelves."""

    @property
    def robot(self) -> Arm:
        """The arm of the workplace."""
        ...

    @property
    def tool_marker(self) -> int:
        """ArUco number of the marker on the end effector."""
        ...

    @property
    def hover_height(self) -> float:
        """Height of the tool centre point during visual servoing [m]."""
        ...

    @property
    def fingertip(self) -> float:
        """Distance of the fingertips beyond the tool centre point [m]."""
        ...

    @property
    def palm(self) -> float:
        """Distance of the palm behind the tool centre point [m]."""
        ...

    def lowering(self, half_size: tuple[float, float, float]) -> float:
        """Largest distance by which an object may be lowered at its release [m].

        If the object were lowered further, the gripper itself would touch the shelf.

        Args:
            half_size: Half edges of the object [m].
        """
        ...

    @property
    def hover_turns(self) -> tuple[float, float]:
        """Smallest and largest turn of the hover pose about the vertical [rad]."""
        ...

    def hover(self) -> Pose:
        """Pose of the end effector above the middle of the table."""
        ...

    def hover_joints(self) -> Float[Tensor, " joints"]:
        """Preferred joint positions at the hover pose [rad]."""
        ...

    def hover_postures(self) -> Sequence[Float[Tensor, " joints"]]:
        """Several joint positions at the hover pose, the preferred positions first [rad]."""
        ...

    def home_joints(
        self, offset: Float[Tensor, "3"] | None = None, q7_offset: float = 0.0
    ) -> Float[Tensor, " joints"]:
        """Joint positions at home, the start of a placing motion [rad].

        Args:
            offset: Offset of the end effector from home [m].
            q7_offset: Change of joint 7, which moves the elbow about the line to the wrist
                [rad].

        Raises:
            UnreachableError: No joint positions reach the pose.
        """
        ...

    def object_region(self) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        """Box of the objects on the table: centre and half edges [m]."""
        ...

    def shelf(self, name: str, half_size: tuple[float, float, float] | None = None) -> Pose:
        """Pose of the end effector at the release of an object on a shelf.

        Args:
            name: Name of the shelf.
            half_size: Half edges of the object [m]; None: half edges of the scene's first
                object.

        Raises:
            ValueError: There is no such shelf.
        """
        ...


@runtime_checkable
class CollisionChecker(Protocol):
    """A geometric model of the workplace."""

    def collisions_along(
        self, path: Float[np.ndarray, "steps joints"], carried: str | None = None
    ) -> Sequence[Touch]:
        """Contacts along a path of joint positions; `Touch.start` is the index of a sample.

        Args:
            path: Joint positions [rad].
            carried: Name of the object in the gripper; None: no object.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Motion of the joints, sampled at the control step."""

    goal: Pose
    """Pose of the end effector at the end."""
    dt: float
    """Time between samples [s]."""
    path: Float[np.ndarray, "steps joints"]
    """Joint positions [rad]."""
    chain: SerialChain
    """Kinematics of the arm."""

    @property
    def tool_pose(self) -> Pose:
        """Pose of the end effector along the path."""
        return self.chain.forward(torch.from_numpy(self.path))

    @property
    def duration(self) -> float:
        """Duration of the path [s]."""
        return self.dt * (len(self.path) - 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class PlaceCorrection:
    """Corrects poses by the difference between a known pose and the arm's reading at this pose.

    Errors of base, tool and encoders are nearly equal at all poses with the same orientation of
    the tool. A person guides the arm to one known pose, and the difference measured there
    corrects all poses. The arm's repeatability error remains.
    """

    read: Pose
    """Pose that the arm reads with its tool at the known pose."""
    place: Pose
    """The known pose."""

    def apply(self, place: Pose) -> Pose:
        """Pose that the arm reads with its tool at another known pose."""
        shift = self.read.position - self.place.position
        back = quaternion.conjugate(self.place.orientation)
        turn = quaternion.multiply(back, self.read.orientation)
        turned = quaternion.multiply(place.orientation, turn)
        return Pose(place.position + shift, turned)


@dataclass(frozen=True, kw_only=True)
class PlacingSkill:
    """Primitives learned from demonstrations of placing."""

    joint: JointDMP
    """Motion of the joints."""
    pose: PoseDMP
    """Motion of the end effector; for Franka's arms, also of the arm angle, which sets the
    posture in the null space."""
    robot: Arm
    """Arm of the primitives."""

    @classmethod
    def load(cls, folder: str | Path, robot: Arm) -> "PlacingSkill":
        """Read the primitives written by `hrc fit`.

        Args:
            folder: Folder of the primitives.
            robot: Arm that executes them.

        Raises:
            FileNotFoundError: The folder holds no primitives.
            ValueError: The primitives are for another arm, or lack a pose primitive.
        """
        folder = Path(folder)
        joint = JointDMP.load(folder / "joint").double()
        names = robot.chain.joint_names
        if joint.joint_names != names:
            raise ValueError(
                f"{folder / 'joint'} moves the joints {joint.joint_names}, but the "
                f"{robot.name} has {names}: fit demonstrations of this arm, or choose the arm "
                "of the demonstrations with --robot."
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
        """Plan the motion from the present joint positions to a goal of the end effector.

        Args:
            start: Present joint positions [rad].
            goal: Pose of the end effector at the release.
            space: Space of the primitive: joints or pose.
            dt: Step of the plan [s].
            speed: Speed relative to the demonstration.

        Raises:
            UnreachableError: No joint positions reach the goal.
        """
        check_choice("space", space, get_args(PlanningSpace))
        # Refuse an unreachable goal before planning, in both spaces.
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
) -> Float[Tensor, "steps joints"]:
    """Joint path that tracks poses of the end effector, and arm angles in the null space.

    The joint velocity is

        u = J^+ (twist + k_e e) + N n (angle' + k_a (angle - angle(q))) - N xi_q

    Here J^+ is the pseudo-inverse of the Jacobian, e the pose error, N the projector on the
    null space, n the joint motion that turns the arm angle at unit rate, and xi_q the gradient
    of the joint-limit region. The poses are tracked exactly, and the arm angle is tracked as
    closely as null space and joint limits permit.

    Args:
        chain: Kinematics of the arm.
        start: Joint positions at the first pose [rad].
        poses: Desired poses of the end effector, (steps,).
        twist: Desired twists (linear [m/s], angular [rad/s]).
        angle: Desired arm angles, continuous [rad]; None: only the joint limits move the null
            space, if the arm has one.
        dt: Time between samples [s].
    """
    limits = JointRegion.from_limits(chain.limits.lower, chain.limits.upper)
    rate = None if angle is None else torch.gradient(angle, spacing=dt)[0]
    q, path = start, [start]
    for k in range(len(twist) - 1):
        pose, J = chain.forward_and_jacobian(q)
        desired = twist[k] + _POSE_GAIN * pose.twist_to(poses[k])
        null_velocity = -limits.gradient(q)
        if angle is not None and rate is not None:
            measured, motion = arm_angle_and_motion(chain, q, J)
            # Take the shorter direction around the circle.
            error = torch.remainder(angle[k] - measured + torch.pi, 2 * torch.pi) - torch.pi
            null_velocity = motion * (rate[k] + _ANGLE_GAIN * error) + null_velocity
        task_velocity, null = resolved_rate(J, desired, null_velocity)
        q = q + dt * (task_velocity + null)
        path.append(q)
    return torch.stack(path)


def check_plan(plan: Plan, world: CollisionChecker, carried: str | None = None) -> None:
    """Check that a plan keeps the limits of the arm and avoids collisions.

    Args:
        plan: The plan.
        world: Scene of the execution in its present state.
        carried: Object in the gripper.

    Raises:
        BlockedPathError: The plan exceeds a limit or collides; the message says where.
    """
    limits, names = plan.chain.limits, plan.chain.joint_names
    path = torch.from_numpy(plan.path)
    outside = ~((path >= limits.lower) & (path <= limits.upper))  # also NaN
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
            f"the plan needs {float(speed[k, joint]):.2f} rad/s of {names[joint]} after "
            f"{k * plan.dt:.1f} s, above its limit of {float(limits.velocity[joint]):.2f} "
            "rad/s: plan it slower."
        )
    # Check one sample every 40 ms: a placing motion moves at most 2 cm in this time.
    every = max(1, round(0.04 / plan.dt))
    samples = np.concatenate([plan.path[:-1:every], plan.path[-1:]])
    touches = world.collisions_along(samples, carried)
    if touches:
        first = touches[0]
        time = min(first.start * every * plan.dt, plan.duration)
        raise BlockedPathError(
            f"after {time:.1f} s {first.first} would hit {first.second}, "
            f"{1e3 * first.depth:.0f} mm deep."
        )


# Offsets of via points from home, to go around objects in the direct path [m]: the points lie
# higher than home, nearer to the robot, and further from the robot.
_VIA_POINTS = ((0.0, 0.0, 0.12), (-0.14, 0.0, 0.06), (0.08, 0.0, 0.10))
# Changes of joint 7 at home [rad]: the elbow moves out or in, about the line to the wrist.
_ARM_ANGLES = (-0.35, 0.35)
# Height added to the release of an object that sits low in the gripper [m].
_RAISED = 0.008


def plan_candidates(
    goal: Pose,
    start: Float[Tensor, " joints"],
    skill: PlacingSkill,
    workplace: Workplace,
    *,
    dt: float,
    speed: float,
) -> Iterator[Plan]:
    """Candidate plans to a shelf, the learned plan first; each plan is computed on demand.

    The other plans end a little higher, for an object that sits low in the gripper, or first go
    to a via point or another arm angle near home. Near its goal, the primitive returns to the
    learned pose and arm angle, so the path into the shelf stays the same.

    Args:
        goal: Pose of the end effector at the release.
        start: Present joint positions [rad].
        skill: Learned motion.
        workplace: Workplace; the via points lie near its home.
        dt: Control step [s].
        speed: Speed relative to the demonstration.
    """

    def learned(start: Tensor, goal: Pose = goal) -> Plan:
        return skill.plan(start, goal, space="pose", dt=dt, speed=speed)

    yield learned(start)
    size = workplace.robot.hand_size
    up = goal.position.new_tensor([0.0, 0.0, size * _RAISED])
    with suppress(UnreachableError):
        raised = Pose(goal.position + up, goal.orientation)
        yield learned(start, raised)
    for via in _via_postures(workplace):
        first = joint_line(start, via, speed=0.6, dt=dt).numpy()
        rest = learned(via)
        yield replace(rest, path=np.concatenate([first, rest.path[1:]]))


def _via_postures(workplace: Workplace) -> Iterator[Float[Tensor, " joints"]]:
    """Reachable joint positions at via points and arm angles near home [rad]."""
    for offset in workplace.robot.hand_size * torch.tensor(_VIA_POINTS, dtype=torch.float64):
        with suppress(UnreachableError):
            yield workplace.home_joints(offset)
    if workplace.robot.null_space == "arm angle":
        for change in _ARM_ANGLES:
            with suppress(UnreachableError):
                yield workplace.home_joints(q7_offset=change)
