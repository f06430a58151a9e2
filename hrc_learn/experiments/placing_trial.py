"""One object placed on a shelf in MuJoCo from any start, and its outcome.

    transfer -> release -> retreat

The plan is carried out even if it collides: contacts are counted, not prevented.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.demos import Demonstration
from hrc_learn.experiments.arm_access import SIMULATED, ArmAccess
from hrc_learn.experiments.run_measures import (
    limit_violations,
    place_angle,
    true_tool,
    unwanted_contacts,
)
from hrc_learn.experiments.simulated_cell import UNOBSERVED, Observer, simulated_cell
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import SerialChain
from hrc_learn.learning.channels import dimensionless_jerk
from hrc_learn.sim import MotionLog, Touch, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.failures import TaskFailedError
from hrc_learn.skills.pick_and_place import place_along
from hrc_learn.skills.placing import PlaceCorrection, PlacingSkill, Plan, PlanningSpace
from hrc_learn.skills.work_cell import WorkCell
from hrc_learn.teleoperation import ScriptedPerturbation

SPACES: dict[PlanningSpace, str] = {"pose": "task space", "joint": "joint space"}
"""Spaces in which motions to other shelves are planned: ours, and the paper's."""

DEVIATION_MM, PLACE_ERROR_MM, PLACE_TILT_DEG = 12.0, 3.0, 3.0
"""Bounds of a good placing. Approach paths planned in task space deviate by 2 mm, those planned
in joint space with a shifted goal by 100 mm. Errors are those of the object on its board."""

# Iterations of the taught correction: each reduces errors of milliradians a thousandfold.
_TEACHING_ITERATIONS = 4
# Starts drawn before the search for a collision-free one fails.
_DRAWS = 100


@dataclass(frozen=True, kw_only=True, eq=False)
class SimulatedPlacing:
    """One placing, from the start of the transfer to the end of the retreat."""

    shelf: str
    goal: Pose
    """True pose at which the end effector should release the object."""
    space: PlanningSpace
    plan: Plan
    """Plan to the measured pose at the goal."""
    world: World
    """World of the placing; later placings may have reused it."""
    cell: WorkCell
    motion: MotionLog
    object_pose: Float[np.ndarray, "4 4"]
    """Final pose of the object."""
    contacts: tuple[Touch, ...]
    """Contacts of the arm with cabinet, table or itself, and of its load with the cabinet."""
    placed: bool
    """True if the object stands on its board in the end, clear of the arm."""

    @property
    def transfer(self) -> slice:
        """Steps in which the plan was carried out."""
        return slice(0, len(self.plan.path))

    @property
    def joint_position(self) -> Float[np.ndarray, "steps joints"]:
        """True joint positions during the transfer, up to encoder noise [rad]."""
        offset = self.world.imperfections.encoder_offset
        return self.cell.log["joint_position"][self.transfer] - offset

    @property
    def time(self) -> Float[np.ndarray, " steps"]:
        """Time since the start of the transfer [s]."""
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
    observer: Observer = UNOBSERVED,
) -> SimulatedPlacing:
    """Carry the first object of the scene, already in the gripper, to a shelf; release it.

    Args:
        skill: Learned placing motion.
        workplace: Workplace with the shelves.
        shelf: Name of the shelf.
        start: True joint positions at the start [rad].
        space: Planning space: the primitive of the joints, as in the paper, or of the pose.
        speed: Speed relative to the demonstration.
        world: World of that workplace, to be reused with its imperfections; by default a new
            one without imperfections.
        correction: Correction of the arm's measured poses; None: they are taken as true.
        access: Access to the arm.
        observer: Live dashboard of the run.

    Raises:
        ValueError: If there is no such shelf, or the arm cannot reach it.
    """
    goal = workplace.shelf(shelf)
    measured_goal = goal if correction is None else correction.apply(goal)
    item = workplace.scene.objects[0]
    world = world or World(workplace.scene)
    world.hold(item.name, start.numpy())
    human = ScriptedPerturbation(workplace.robot.chain, ())
    with simulated_cell(world, human=human, access=access, observer=observer) as simulated:
        cell = simulated.cell
        plan = skill.plan(
            cell.joints, measured_goal, space=space, dt=cell.config.dt, speed=speed
        )
        lowering = workplace.lowering(item.half_size)
        release_time = place_along(cell, plan, measured_goal, lowering)
    contacts = unwanted_contacts(world, cell.log, {item.name: release_time})
    return SimulatedPlacing(
        shelf=shelf,
        goal=goal,
        space=space,
        plan=plan,
        world=world,
        cell=cell,
        motion=simulated.motion,
        object_pose=world.object_pose(item.name),
        contacts=sum(contacts.values(), ()),
        placed=world.rests_on(item.name, f"board_{shelf}"),
    )


def taught_correction(
    world: World, place: Pose, near: Float[Tensor, " joints"], rng: np.random.Generator
) -> PlaceCorrection:
    """Correction from the measured pose after a person has guided the tool to a known place.

    Resets the world.

    Args:
        world: World with the imperfections of the arm.
        place: Known place.
        near: Joint positions near which the arm is guided there [rad].
        rng: Source of the person's error.

    Raises:
        UnreachableError: If the arm cannot reach the place.
    """
    errors = world.imperfections
    miss = errors.sizes.teaching_error * torch.from_numpy(rng.uniform(-1, 1, 3))
    guided = Pose(place.position + miss, place.orientation)
    measured = guided
    for _ in range(_TEACHING_ITERATIONS):
        joints = world.arm.robot.inverse(measured, near=near).numpy()
        world.reset(joints - errors.encoder_offset)
        matrix = torch.from_numpy(world.arm.tcp_pose())
        # True pose of the tool, and its error from the guided one.
        tool = Pose(matrix[:3, 3], quaternion.from_matrix(matrix[:3, :3]))
        back = quaternion.conjugate(tool.orientation)
        rotation = quaternion.multiply(back, guided.orientation)
        measured = Pose(
            measured.position + guided.position - tool.position,
            quaternion.multiply(measured.orientation, rotation),
        )
    encoders = torch.from_numpy(world.arm.read().joint_position)
    return PlaceCorrection.of(world.arm.robot.chain.forward(encoders), place)


def random_start(
    world: World, workplace: Workplace, noise: float, rng: np.random.Generator
) -> Float[Tensor, " joints"]:
    """Random joint positions about home, within the limits and free of contacts [rad].

    Leaves the world there, with its first object in the gripper.

    Args:
        world: World of the workplace.
        workplace: Workplace with the home posture.
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
    """Last part of a path of the end effector, from the front edge of the boards on.

    It runs against y, as boards that open towards +y require.
    """

    offset: Float[np.ndarray, "samples 3"]
    """Offset of the end effector from the goal [m]."""

    @classmethod
    def of(
        cls, path: Float[np.ndarray, "steps 3"], goal: Float[np.ndarray, "3"], edge: float
    ) -> "ApproachPath":
        """Cut the approach off a path.

        Args:
            path: Path of the end effector [m].
            goal: Intended end of the path [m].
            edge: y at which the approach begins, when it is crossed for the last time [m]. A
                path that ends in front of it has no samples.
        """
        outside = np.flatnonzero(path[:, 1] > edge)
        first = int(outside[-1]) + 1 if len(outside) else 0
        return cls(offset=path[first:] - goal)

    @property
    def remaining(self) -> Float[np.ndarray, " samples"]:
        """Remaining distance to the goal along y [m]."""
        return self.offset[:, 1]

    def distance(self, other: "ApproachPath") -> Float[np.ndarray, " samples"]:
        """Distance from another approach, sideways and in height, at the same depth [m].

        Both are relative to their goals, so that different shelves can be compared.
        """
        # Tremor moves a demonstration back a little: use the first time at each depth.
        progress = np.maximum.accumulate(-other.remaining)
        there = [np.interp(-self.remaining, progress, other.offset[:, k]) for k in (0, 2)]
        return np.hypot(self.offset[:, 0] - there[0], self.offset[:, 2] - there[1])

    def deviation(self, other: "ApproachPath") -> float:
        """Largest distance from another approach [m]; infinite without samples."""
        return float(self.distance(other).max()) if len(self.offset) else np.inf


def approach_path(
    path: Float[np.ndarray, "steps 3"], goal: Pose, workplace: Workplace
) -> ApproachPath:
    """Part of a path of the end effector behind the front edge of the boards."""
    return ApproachPath.of(path, goal.position.numpy(), _edge(workplace))


def demonstrated_approach(demonstration: Demonstration, workplace: Workplace) -> ApproachPath:
    """Demonstrated approach relative to its end.

    Raises:
        ValueError: If the demonstration ends in front of the cabinet.
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
    """Y of the end effector when its load crosses the front edge of the boards [m]."""
    return workplace.scene.cabinet.front + workplace.scene.objects[0].half_size[2]


def demonstrated_path(
    demonstration: Demonstration, chain: SerialChain
) -> Float[np.ndarray, "frames 3"]:
    """Path of the tool centre point, from the demonstrated joints [m].

    Raises:
        ValueError: If the demonstration has no joints of this arm.
    """
    joints = demonstration.joint_position
    if joints is None or demonstration.joint_names != chain.joint_names:
        raise ValueError(
            f"the demonstrations have the joints {demonstration.joint_names}, but the arm has "
            f"{chain.joint_names}: give demonstrations of this arm."
        )
    return chain.forward(torch.from_numpy(joints)).position.numpy()


@dataclass(frozen=True, kw_only=True)
class PlacingOutcome:
    """Measured outcome of one placing."""

    deviation: float
    """Deviation of the approach path from the demonstrated one, moved to the goal [m]."""
    place_error: float
    """Horizontal distance of the object on its board from its intended place [m]."""
    place_tilt: float
    """Angle of the object from its intended orientation [rad]."""
    violations: int
    """Steps in which a joint was outside its range of position or velocity."""
    contacts: tuple[Touch, ...]
    """Unwanted contacts."""
    peak_speed: float
    """Largest joint velocity as a fraction of the limit of that joint."""
    jerk: float
    """Dimensionless jerk of the end effector's path over that of the demonstration."""
    placed: bool
    """True if the object stands on its board afterwards."""

    @classmethod
    def of(
        cls, run: SimulatedPlacing, workplace: Workplace, demonstration: Demonstration
    ) -> "PlacingOutcome":
        """Measure a placing on any shelf against a demonstration."""
        approach = approach_path(run.path, run.goal, workplace)
        error = run.object_pose[:3, 3] - run.goal.position.numpy()
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
            place_error=float(np.linalg.norm(error[:2])),
            place_tilt=place_angle(run.object_pose, run.goal.orientation),
            violations=limit_violations(run.cell),
            contacts=run.contacts,
            peak_speed=float(speed.max()),
            jerk=float(done / demonstrated),
            placed=run.placed,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacingRun:
    """Placings on every shelf, planned in both spaces."""

    workplace: Workplace
    demonstration: Demonstration
    demonstrated_shelf: str
    placings: Mapping[tuple[PlanningSpace, str], SimulatedPlacing]
    """Placings from the start of the demonstration, by space and shelf."""
    outcomes: Mapping[PlanningSpace, Mapping[str, PlacingOutcome]]
    """Outcomes by space, then by shelf."""
    same_joint7: tuple[str, ...]
    """Shelves within reach with joint 7 as at the end of the demonstration."""

    @property
    def reproduction(self) -> SimulatedPlacing:
        """Demonstrated motion, reproduced in joint space as in the paper."""
        return self.placings["joint", self.demonstrated_shelf]
