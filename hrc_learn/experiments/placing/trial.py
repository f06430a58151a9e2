"""One object placed on a shelf in MuJoCo, from any start, and what is measured of it.

    transfer -> release -> retreat

The plan is carried out whether or not it is free: contacts are counted, not foreseen.
"""

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.demos import Demonstration
from hrc_learn.experiments.arm_access import SIMULATED, ArmAccess
from hrc_learn.experiments.grip import place_angle
from hrc_learn.experiments.placing.arm_angle_ablation import Ablation
from hrc_learn.experiments.run_recording import (
    LiveView,
    limit_violations,
    no_live_view,
    true_tool,
    unwanted_contacts,
)
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import SerialChain
from hrc_learn.learning.channels import dimensionless_jerk
from hrc_learn.sim import MotionLog, Touch, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.failures import TaskFailedError
from hrc_learn.skills.pick_and_place import place_along
from hrc_learn.skills.placing import PlaceCorrection, PlacingSkill, Plan, PlanningSpace
from hrc_learn.skills.work_cell import WorkCell, WorkCellConfig
from hrc_learn.teleoperation import ScriptedPerturbation

SPACES: dict[PlanningSpace, str] = {"pose": "task space", "joint": "joint space"}
"""Spaces in which motions to other shelves are planned: ours, and the paper's."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SimulatedPlacing:
    """One placing, from the start of the transfer until the retreat is over."""

    shelf: str
    goal: Pose
    """Where the end effector should truly release the object."""
    space: PlanningSpace
    plan: Plan
    """To what the arm should read there."""
    world: World
    """Maybe used again since."""
    cell: WorkCell
    motion: MotionLog
    object_pose: Float[np.ndarray, "4 4"]
    """In the end."""
    contacts: tuple[Touch, ...]
    """Of the arm with cabinet, table or itself, and of what it carried with the cabinet."""
    placed: bool
    """Whether the object stands on its board in the end, touching nothing of the arm."""

    @property
    def transfer(self) -> slice:
        """Steps in which the plan was carried out."""
        return slice(0, len(self.plan.path))

    @property
    def joint_position(self) -> Float[np.ndarray, "steps joints"]:
        """True ones during the transfer, but for the encoders' noise [rad]."""
        offset = self.world.imperfections.encoder_offset
        return self.cell.log["joint_position"][self.transfer] - offset

    @property
    def time(self) -> Float[np.ndarray, " steps"]:
        """From the start of the transfer [s]."""
        time = self.cell.log["time"][self.transfer]
        return time - time[0]

    @property
    def path(self) -> Float[np.ndarray, "steps 3"]:
        """True path of the tool centre point during the transfer [m]."""
        return true_tool(self.motion, self.world, len(self.plan.path)).position.numpy()


def place(
    skill: PlacingSkill,
    workplace: Workplace,
    shelf: str,
    start: Float[Tensor, " joints"],
    *,
    space: PlanningSpace,
    speed: float = 1.5,
    world: World | None = None,
    correction: PlaceCorrection | None = None,
    access: ArmAccess = SIMULATED,
    view: LiveView = no_live_view,
) -> SimulatedPlacing:
    """Carry the scene's first object, already in the gripper, to a shelf and release it.

    Args:
        skill: Learned placing motion.
        workplace: Where.
        shelf: Which.
        start: True joint positions at the start [rad].
        space: Follow the primitive of the joints, as the paper does, or that of the pose.
        speed: How many times faster than demonstrated.
        world: Of that workplace, to be used again, with its imperfections; a new one without
            any if None.
        correction: Of the arm's readings; None: the arm believes them.
        access: How the arm is led.
        view: Dashboard of the run while it goes on.

    Raises:
        ValueError: If there is no such shelf, or the arm cannot reach it.
    """
    goal = workplace.shelf(shelf)
    read = goal if correction is None else correction.apply(goal)
    item = workplace.scene.objects[0]
    world = world or World(workplace.scene)
    world.hold(item.name, start.numpy())
    plant = access.told(world.imperfections.sizes)
    with torch.inference_mode(), ExitStack() as stack:
        driven = stack.enter_context(access.open(world))
        motion = MotionLog(world, driven.advance)
        cell = WorkCell(
            chain=workplace.robot.chain,
            arm=driven.arm,
            gripper=driven.gripper,
            human=ScriptedPerturbation(workplace.robot.chain, ()),
            advance=motion.advance,
            config=WorkCellConfig(
                safety=plant.plant(WorkCellConfig().safety),
                command_delay=plant.following_delay,
            ),
        )
        stack.enter_context(view(cell, world, motion))
        plan = skill.plan(cell.joints, read, space=space, dt=cell.config.dt, speed=speed)
        release_time = place_along(cell, plan, read, workplace.lowering(item.half_size))
    return SimulatedPlacing(
        shelf=shelf,
        goal=goal,
        space=space,
        plan=plan,
        world=world,
        cell=cell,
        motion=motion,
        object_pose=world.object_pose(item.name),
        contacts=sum(
            unwanted_contacts(world, cell.log, {item.name: release_time}).values(), ()
        ),
        placed=world.rests_on(item.name, f"board_{shelf}"),
    )


_SHOWN_ITERATIONS = 4
"""Errors of milliradians shrink a thousandfold in each."""


def taught_correction(
    world: World, place: Pose, near: Float[Tensor, " joints"], rng: np.random.Generator
) -> PlaceCorrection:
    """What the arm reads where a person has led its tool to a known place.

    Resets the world.

    Args:
        world: With the arm's imperfections.
        place: The place.
        near: Joint positions near which the arm is led there [rad].
        rng: Of the person's error.

    Raises:
        UnreachableError: If the arm cannot reach it.
    """
    errors = world.imperfections
    aside = errors.sizes.teaching_error * torch.from_numpy(rng.uniform(-1, 1, 3))
    led = Pose(place.position + aside, place.orientation)
    read = led
    for _ in range(_SHOWN_ITERATIONS):
        # Where the tool truly is, and by how much it misses.
        joints = world.arm.robot.inverse(read, near=near).numpy()
        world.reset(joints - errors.encoder_offset)
        matrix = torch.from_numpy(world.arm.tcp_pose())
        tool = Pose(matrix[:3, 3], quaternion.from_matrix(matrix[:3, :3]))
        missed = quaternion.multiply(quaternion.conjugate(tool.orientation), led.orientation)
        read = Pose(
            read.position + led.position - tool.position,
            quaternion.multiply(read.orientation, missed),
        )
    measured = world.arm.robot.chain.forward(torch.from_numpy(world.arm.read().joint_position))
    return PlaceCorrection.of(measured, place)


_DRAWS = 100
"""Starts drawn before it is taken that there is no free one."""


def random_start(
    world: World, workplace: Workplace, noise: float, rng: np.random.Generator
) -> Float[Tensor, " joints"]:
    """Joint positions about home that are within the limits and touch nothing.

    Leaves the world there, with its first object in the gripper.

    Args:
        world: Of the workplace.
        workplace: Where.
        noise: Standard deviation of each joint [rad].
        rng: Source of the noise.

    Raises:
        TaskFailedError: If no start drawn is free.
    """
    home, item = workplace.home_joints(), workplace.scene.objects[0].name
    for _ in range(_DRAWS):
        start = home + noise * torch.from_numpy(rng.standard_normal(len(home)))
        if not workplace.robot.chain.limits.contain(start):
            continue
        world.hold(item, start.numpy())
        if not world.collisions_along(start.numpy()[None], item):
            return start
    raise TaskFailedError(f"no free start in {_DRAWS} draws with noise of {noise:g} rad")


@dataclass(frozen=True, kw_only=True, eq=False)
class ApproachPath:
    """The last part of a path of the end effector, from the boards' front edge on.

    It runs against y, as boards that open towards +y want it.
    """

    offset: Float[np.ndarray, "samples 3"]
    """Of the end effector from the goal [m]."""

    @classmethod
    def of(
        cls, path: Float[np.ndarray, "steps 3"], goal: Float[np.ndarray, "3"], edge: float
    ) -> "ApproachPath":
        """Cut it off.

        Args:
            path: Of the end effector [m].
            goal: Where it should end [m].
            edge: y at which the approach begins, when it is crossed for the last time [m]. A
                path that ends in front of it has no samples.
        """
        outside = np.flatnonzero(path[:, 1] > edge)
        first = int(outside[-1]) + 1 if len(outside) else 0
        return cls(offset=path[first:] - goal)

    @property
    def remaining(self) -> Float[np.ndarray, " samples"]:
        """Distance left to the goal, along y [m]."""
        return self.offset[:, 1]

    def distance(self, other: "ApproachPath") -> Float[np.ndarray, " samples"]:
        """Distance from another approach, sideways and in height, at the same depth [m].

        Both are taken relative to their goals, so that shelves can be compared.
        """
        # Tremor takes a demonstration back a little: count from where it first was that deep.
        progress = np.maximum.accumulate(-other.remaining)
        there = [np.interp(-self.remaining, progress, other.offset[:, k]) for k in (0, 2)]
        return np.hypot(self.offset[:, 0] - there[0], self.offset[:, 2] - there[1])

    def deviation(self, other: "ApproachPath") -> float:
        """Largest of these distances [m]; infinite if the end effector never got in."""
        return float(self.distance(other).max()) if len(self.offset) else np.inf


def approach_path(
    path: Float[np.ndarray, "steps 3"], goal: Pose, workplace: Workplace
) -> ApproachPath:
    """The part of a path of the end effector behind the boards' front edge."""
    return ApproachPath.of(path, goal.position.numpy(), _edge(workplace))


def demonstrated_approach(demonstration: Demonstration, workplace: Workplace) -> ApproachPath:
    """The demonstrated approach, relative to where it ended.

    Raises:
        ValueError: If the end effector was never led into the cabinet.
    """
    path = demonstrated_path(demonstration, workplace.robot.chain)
    approach = ApproachPath.of(path, path[-1], _edge(workplace))
    if not len(approach.offset):
        raise ValueError(
            f"demonstration {demonstration.episode} ends at y = {path[-1, 1]:.3f} m, in front "
            f"of the cabinet at {_edge(workplace):.3f} m: give demonstrations of placing."
        )
    return approach


def _edge(workplace: Workplace) -> float:
    """Y of the end effector when what it carries crosses the boards' front edge [m]."""
    return workplace.scene.cabinet.front + workplace.scene.objects[0].half_size[2]


def demonstrated_path(
    demonstration: Demonstration, chain: SerialChain
) -> Float[np.ndarray, "frames 3"]:
    """Of the tool centre point, from the demonstrated joints [m].

    Raises:
        ValueError: If the demonstration holds no joints of this arm.
    """
    joints = demonstration.joint_position
    if joints is None or demonstration.joint_names != chain.joint_names:
        raise ValueError(
            f"the demonstrations hold the joints {demonstration.joint_names}, but the arm has "
            f"{chain.joint_names}: give demonstrations of this arm."
        )
    return chain.forward(torch.from_numpy(joints)).position.numpy()


@dataclass(frozen=True, kw_only=True)
class PlacingOutcome:
    """What one placing came to."""

    deviation: float
    """Of the approach path from the demonstrated one, moved to the goal [m]."""
    place_error: float
    """Horizontal distance of the object on its board from where it should stand [m]."""
    place_tilt: float
    """Its angle from how it should stand [rad]."""
    violations: int
    """Steps in which a joint was outside its range of position or velocity."""
    contacts: tuple[Touch, ...]
    """That should not have been."""
    peak_speed: float
    """Largest joint velocity, as a fraction of that joint's limit."""
    jerk: float
    """Dimensionless jerk of the end effector's path over that of the demonstration."""
    placed: bool
    """Whether the object stands on its board afterwards."""

    @classmethod
    def of(
        cls, run: SimulatedPlacing, workplace: Workplace, demonstration: Demonstration
    ) -> "PlacingOutcome":
        """Measure a placing against a demonstration for any shelf."""
        approach = approach_path(run.path, run.goal, workplace)
        aside = run.object_pose[:3, 3] - run.goal.position.numpy()
        speed = np.abs(run.cell.log["joint_velocity"]) / run.cell.chain.limits.velocity.numpy()
        done, demonstrated = (
            dimensionless_jerk(torch.from_numpy(time), torch.from_numpy(path))
            for time, path in (
                (run.time, run.path),
                (demonstration.time, demonstrated_path(demonstration, run.cell.chain)),
            )
        )
        return cls(
            deviation=approach.deviation(demonstrated_approach(demonstration, workplace)),
            place_error=float(np.linalg.norm(aside[:2])),
            place_tilt=place_angle(run.object_pose, run.goal.orientation),
            violations=limit_violations(run.cell),
            contacts=run.contacts,
            peak_speed=float(speed.max()),
            jerk=float(done / demonstrated),
            placed=run.placed,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacingRun:
    """Placings on every shelf, planned in every space, and the arm-angle ablation."""

    workplace: Workplace
    demonstration: Demonstration
    demonstrated_shelf: str
    placings: Mapping[tuple[PlanningSpace, str], SimulatedPlacing]
    """By space and shelf, from the start of the demonstration."""
    outcomes: Mapping[PlanningSpace, Mapping[str, PlacingOutcome]]
    """By space, then by shelf."""
    ablation: Ablation
    same_joint7: tuple[str, ...]
    """Shelves within reach with joint 7 where the demonstration left it."""

    @property
    def reproduction(self) -> SimulatedPlacing:
        """The demonstrated motion, reproduced as the paper does it."""
        return self.placings["joint", self.demonstrated_shelf]
