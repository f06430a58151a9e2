"""One object placed on a shelf in MuJoCo, from a start of one's own, and what came of it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.demos import Demonstration
from hrc_learn.experiments.collaboration.metrics import limit_violations
from hrc_learn.experiments.run_recording import Watch, unwatched
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import panda
from hrc_learn.learning.reproduction_metrics import dimensionless_jerk
from hrc_learn.sim import MotionLog, Touch, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.grasping import OPEN
from hrc_learn.skills.placing import PlacingSkill, Plan, PlanningSpace
from hrc_learn.skills.work_cell import WorkCell
from hrc_learn.teleoperation import ScriptedPerturbation

# One thing placed on a shelf in MuJoCo, from a start of one's own, and what came of it.
#
#     transfer -> release -> retreat
#
# The plan is carried out whether or not it is free: what it meets is counted, not foreseen.

TRANSFER, RELEASE, RETREAT = "transfer", "release", "retreat"

_SETTLE = 0.4  # rest before the hand lets go [s]
_LET_GO = 0.8  # time the fingers take [s]
_CLEAR = 0.08  # way back, until nothing of the thing is between the fingers [m]
_RETREAT_SPEED = 0.08  # at the usual one, the shoulder comes close to its limits [m/s]


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacingRun:
    """What happened."""

    shelf: str
    space: PlanningSpace
    plan: Plan
    cell: WorkCell
    motion: MotionLog
    released: Pose
    """True pose of the hand when it let go."""
    touches: tuple[Touch, ...]
    """Of the arm with cabinet, table or itself, and of what it carried with the cabinet."""
    placed: bool
    """Whether the thing stood on its board in the end, and the arm had let go of it."""

    @property
    def transfer(self) -> slice:
        """Steps in which the plan was carried out."""
        return slice(0, len(self.plan.path))

    @property
    def joint_position(self) -> Float[np.ndarray, "steps 7"]:
        """Measured on the way to the shelf [rad]."""
        return self.cell.log["joint_position"][self.transfer]

    @property
    def time(self) -> Float[np.ndarray, " steps"]:
        """From the start of the motion [s]."""
        time = self.cell.log["time"][self.transfer]
        return time - time[0]

    @property
    def path(self) -> Float[np.ndarray, "steps 3"]:
        """Of the tool centre point on the way to the shelf [m]."""
        return panda.forward(torch.from_numpy(self.joint_position)).position.numpy()


def place(
    skill: PlacingSkill,
    workplace: Workplace,
    shelf: str,
    start: Float[torch.Tensor, "7"],
    *,
    space: PlanningSpace,
    speed: float = 1.5,
    world: World | None = None,
    watch: Watch = unwatched,
) -> PlacingRun:
    """Carry the scene's first object, already in the hand, to a shelf and let go of it.

    Args:
        skill: Learned placing motion.
        workplace: Where.
        shelf: Which.
        start: Joint positions at the start [rad].
        space: Follow the primitive of the joints, as the paper does, or that of the pose.
        speed: How many times faster than demonstrated.
        world: Of that workplace, to be used again; a new one if None.
        watch: Watches from the side, such as `serving` a dashboard.

    Raises:
        ValueError: If there is no such shelf, or the arm cannot reach it.
    """
    goal = workplace.shelf(shelf)
    item = workplace.scene.objects[0]
    world = world or World(workplace.scene)
    world.hold(item.name, start.numpy())
    motion = MotionLog(world)
    cell = WorkCell(
        chain=panda,
        arm=world.arm,
        gripper=world.arm,
        human=ScriptedPerturbation(panda, ()),
        advance=motion.advance,
    )
    with torch.inference_mode(), watch(cell, world, motion):
        plan = skill.plan(cell.joints, goal, space=space, dt=cell.config.dt, speed=speed)
        cell.begin_phase(TRANSFER)
        cell.follow_path(plan.path)
        cell.hold_pose(_SETTLE)
        cell.begin_phase(RELEASE)
        released, release_time = _tool(world), world.time
        world.arm.move(OPEN)
        cell.hold_pose(_LET_GO)
        cell.begin_phase(RETREAT)
        cell.move_straight(_back(released), speed=_RETREAT_SPEED)
    return PlacingRun(
        shelf=shelf,
        space=space,
        plan=plan,
        cell=cell,
        motion=motion,
        released=released,
        touches=_unwanted(world, release_time),
        placed=world.rests_on(item.name, f"board_{shelf}"),
    )


def _tool(world: World) -> Pose:
    """True pose of the tool centre point."""
    matrix = torch.from_numpy(world.arm.tcp_pose())
    return Pose(matrix[:3, 3], quaternion.from_matrix(matrix[:3, :3]))


def _back(released: Pose) -> Pose:
    """Clear of the thing: the hand drawn straight back along its own axis."""
    offset = released.position.new_tensor([0.0, 0.0, -_CLEAR])
    return Pose(released.apply(offset), released.orientation)


def _unwanted(world: World, release_time: float) -> tuple[Touch, ...]:
    """Every touch but that of the thing with its board once it was let go."""
    arm = (world.cabinet_contacts, world.table_contacts, world.self_contacts)
    carried = [t for t in world.object_contacts.touches if t.start < release_time]
    return tuple([touch for monitor in arm for touch in monitor.touches] + carried)


# The way into a shelf: its last stretch, compared with the demonstrated one.


@dataclass(frozen=True, kw_only=True, eq=False)
class Insertion:
    """The last stretch of a path of the hand, from a plane across the way on.

    The way in runs against y, as boards that open towards +y want it.
    """

    offset: Float[np.ndarray, "samples 3"]
    """Of the hand from the goal [m]."""

    @classmethod
    def of(
        cls,
        path: Float[np.ndarray, "steps 3"],
        goal: Float[np.ndarray, "3"],
        edge: float,
    ) -> "Insertion":
        """Cut it off.

        Args:
            path: Of the hand [m].
            goal: Where it should end [m].
            edge: y at which the insertion begins, when it is crossed for the last time [m]. A
                path that ends in front of it has no samples.
        """
        outside = np.flatnonzero(path[:, 1] > edge)
        first = int(outside[-1]) + 1 if len(outside) else 0
        return cls(offset=path[first:] - goal)

    @property
    def left(self) -> Float[np.ndarray, " samples"]:
        """What is left of the way in [m]."""
        return self.offset[:, 1]

    def aside(self, other: "Insertion") -> Float[np.ndarray, " samples"]:
        """Distance from another way in, sideways and in height, where that is as deep [m].

        Both are taken relative to their goals, so that shelves can be compared.
        """
        # A hand that trembles goes back a little: count from where it first was that deep.
        progress = np.maximum.accumulate(-other.left)
        there = [np.interp(-self.left, progress, other.offset[:, k]) for k in (0, 2)]
        return np.hypot(self.offset[:, 0] - there[0], self.offset[:, 2] - there[1])

    def bend(self, other: "Insertion") -> float:
        """Largest of these distances [m]; infinite if the hand never got in."""
        return float(self.aside(other).max()) if len(self.offset) else np.inf


# What one placing motion came to, in numbers, and whether that is good enough.

GOAL_DISTANCE, GOAL_ANGLE, BEND = 2e-3, float(np.deg2rad(0.5)), 12e-3
"""Bounds of what is good enough [m], [rad], [m]."""


@dataclass(frozen=True, kw_only=True)
class PlacingFigures:
    """Of one run."""

    bend: float
    """Largest distance of the way in from the demonstrated one, moved to the goal [m]."""
    goal_distance: float
    """Of the hand when it let go [m]."""
    goal_angle: float
    """The same, of its orientation [rad]."""
    violations: int
    """Steps in which a joint was outside its range of position or velocity."""
    touches: Sequence[str]
    """What was met that should not have been, in words."""
    peak_speed: float
    """Largest joint velocity, as a share of that joint's limit."""
    jerk: float
    """Dimensionless jerk of the hand's path, as a share of the demonstration's."""
    placed: bool
    """Whether the thing stands on its board afterwards."""

    @property
    def faults(self) -> list[str]:
        """Why this is not good enough; none if it is."""
        tested = {
            f"{len(self.touches)} contacts, first {next(iter(self.touches), '')}": bool(
                self.touches
            ),
            f"{self.violations} steps beyond a joint limit": self.violations > 0,
            "the thing does not stand on the board": not self.placed,
            f"goal missed by {1e3 * self.goal_distance:.1f} mm": (
                self.goal_distance > GOAL_DISTANCE
            ),
            f"goal missed by {np.rad2deg(self.goal_angle):.2f} deg": (
                self.goal_angle > GOAL_ANGLE
            ),
            f"way in bent by {1e3 * self.bend:.1f} mm": self.bend > BEND,
        }
        return [fault for fault, found in tested.items() if found]

    def row(self) -> dict[str, float | int]:
        """As plain numbers, in the units that their names say."""
        return {
            "bend_mm": 1e3 * self.bend,
            "goal_error_mm": 1e3 * self.goal_distance,
            "goal_error_deg": float(np.rad2deg(self.goal_angle)),
            "limit_violations": self.violations,
            "contacts": len(self.touches),
            "peak_speed_share": self.peak_speed,
            "jerk_share": self.jerk,
            "placed": int(self.placed),
        }


def placing_figures(
    run: PlacingRun, workplace: Workplace, demonstration: Demonstration
) -> PlacingFigures:
    """Measure a run against a demonstration of any shelf."""
    miss = run.released.twist_to(run.plan.goal)
    speed = np.abs(run.cell.log["joint_velocity"]) / panda.limits.velocity.numpy()
    return PlacingFigures(
        bend=way_in(run.path, run.plan.goal, workplace).bend(
            demonstrated_way_in(demonstration, workplace)
        ),
        goal_distance=float(miss[:3].norm()),
        goal_angle=float(miss[3:].norm()),
        violations=limit_violations(run.cell),
        touches=[str(touch) for touch in run.touches],
        peak_speed=float(speed.max()),
        jerk=jerk_left(run, demonstration),
        placed=run.placed,
    )


def way_in(path: Float[np.ndarray, "steps 3"], goal: Pose, workplace: Workplace) -> Insertion:
    """What of a path of the hand lies behind the boards' front edge."""
    return Insertion.of(path, goal.position.numpy(), _edge(workplace))


def demonstrated_way_in(demonstration: Demonstration, workplace: Workplace) -> Insertion:
    """What was shown there, relative to where it ended.

    Raises:
        ValueError: If the hand was never led into the cabinet.
    """
    path = hand_path(demonstration)
    shown = Insertion.of(path, path[-1], _edge(workplace))
    if not len(shown.offset):
        raise ValueError(
            f"demonstration {demonstration.episode} ends at y = {path[-1, 1]:.3f} m, in front "
            f"of the cabinet at {_edge(workplace):.3f} m: give demonstrations of placing."
        )
    return shown


def _edge(workplace: Workplace) -> float:
    """Where along y the hand is when what it carries crosses the boards' front edge [m]."""
    return workplace.scene.cabinet.front + workplace.scene.objects[0].half_size[2]


def hand_path(demonstration: Demonstration) -> Float[np.ndarray, "frames 3"]:
    """Of the tool centre point, from the demonstrated joints [m].

    Raises:
        ValueError: If the demonstration holds no joints of a Panda.
    """
    joints = demonstration.joint_position
    if joints is None or demonstration.joint_names != panda.joint_names:
        raise ValueError(
            f"the demonstrations hold the joints {demonstration.joint_names}, but the arm has "
            f"{panda.joint_names}: give demonstrations of this arm."
        )
    return panda.forward(torch.from_numpy(joints)).position.numpy()


def jerk_left(run: PlacingRun, demonstration: Demonstration) -> float:
    """Dimensionless jerk of the hand's path over that of the demonstration."""
    done, shown = (
        dimensionless_jerk(torch.from_numpy(time), torch.from_numpy(path))
        for time, path in ((run.time, run.path), (demonstration.time, hand_path(demonstration)))
    )
    return float(done / shown)
