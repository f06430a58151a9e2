"""One object placed on a shelf in MuJoCo from any start.

    transfer -> release -> retreat

The plan is carried out even if it collides: contacts are counted, not prevented.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.demos import Demonstration
from hrc_learn.experiments.run_measures import true_tool, unwanted_contacts
from hrc_learn.experiments.simulated_cell import (
    SIMULATED,
    UNOBSERVED,
    ArmAccess,
    CellRun,
    Observer,
    simulated_cell,
)
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import SerialChain
from hrc_learn.sim import Touch, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.pick_and_place import place_along
from hrc_learn.skills.placing import PlaceCorrection, PlacingSkill, Plan, PlanningSpace
from hrc_learn.skills.work_cell import TaskFailedError
from hrc_learn.teleoperation import ScriptedPerturbation

SPACES: dict[PlanningSpace, str] = {"pose": "task space", "joint": "joint space"}
"""Spaces in which motions to other shelves are planned; the paper uses joint space."""

# Iterations of the taught correction: each reduces errors of milliradians a thousandfold.
_TEACHING_ITERATIONS = 4
# Largest distance of the end of a demonstration from a shelf [m]. Shelves are 24 cm apart. A
# careless demonstration may miss its shelf by 5 cm.
_SHELF_DISTANCE = 0.05
# Number of starts that are drawn before the search for a collision-free start fails.
_DRAWS = 100


@dataclass(frozen=True, kw_only=True, eq=False)
class SimulatedPlacing(CellRun):
    """One placing, from the start of the transfer to the end of the retreat.

    Later placings may have changed the world since then.
    """

    goal: Pose
    """True pose at which the end effector should release the object."""
    plan: Plan
    """Plan; it ends at the pose that the encoders should show at the goal."""
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


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacingScene:
    """World of placings, the placing skill, and the demonstration that it was learned from."""

    skill: PlacingSkill
    workplace: Workplace
    world: World
    """World of `workplace`; all placings use this world, with the same imperfections."""
    demonstration: Demonstration
    demonstrated_shelf: str
    correction: PlaceCorrection | None = None
    """Correction of the arm's measured poses; None: they are not corrected."""

    def place(
        self,
        shelf: str,
        start: Float[Tensor, " joints"],
        *,
        space: PlanningSpace,
        speed: float = 1.5,
        access: ArmAccess = SIMULATED,
        observer: Observer = UNOBSERVED,
    ) -> SimulatedPlacing:
        """Carry the scene's first object, which is in the gripper, to a shelf and release it.

        Args:
            shelf: Name of the shelf.
            start: True joint positions at the start [rad].
            space: Space in which the motion is planned: joints, as in the paper, or pose.
            speed: Speed relative to the demonstration.
            access: Access to the arm.
            observer: Live dashboard of the run.

        Raises:
            ValueError: If there is no such shelf, or the arm cannot reach it.
        """
        world, workplace = self.world, self.workplace
        goal, item = workplace.shelf(shelf), workplace.scene.objects[0]
        measured_goal = goal if self.correction is None else self.correction.apply(goal)
        world.hold(item.name, start.numpy())
        human = ScriptedPerturbation(workplace.robot.chain, ())
        with simulated_cell(world, human=human, access=access, observer=observer) as connected:
            cell, motion = connected
            plan = self.skill.plan(
                cell.joints, measured_goal, space=space, dt=cell.config.dt, speed=speed
            )
            lowering, size = workplace.lowering(item.half_size), workplace.robot.hand_size
            release_time = place_along(cell, plan, measured_goal, lowering, size)
        contacts = unwanted_contacts(world, cell.log, {item.name: release_time})
        return SimulatedPlacing(
            goal=goal,
            plan=plan,
            world=world,
            cell=cell,
            motion=motion,
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
        place: Known pose of the tool, to which the person guides it.
        near: Joint positions near which the arm reaches the place [rad].
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
        # True pose of the tool, and rotation from there to the guided pose.
        tool = Pose.from_matrix(world.arm.tcp_pose())
        back = quaternion.conjugate(tool.orientation)
        rotation = quaternion.multiply(back, guided.orientation)
        measured = Pose(
            measured.position + guided.position - tool.position,
            quaternion.multiply(measured.orientation, rotation),
        )
    encoders = torch.from_numpy(world.arm.read().joint_position)
    return PlaceCorrection(read=world.arm.robot.chain.forward(encoders), place=place)


def random_start(
    world: World, workplace: Workplace, noise: float, rng: np.random.Generator
) -> Float[Tensor, " joints"]:
    """Random joint positions around home, within the limits and free of contacts [rad].

    Afterwards, the world is in this state, with its first object in the gripper.

    Args:
        world: World of the workplace.
        workplace: Workplace with the home posture.
        noise: Standard deviation of each joint [rad].
        rng: Source of the noise.

    Raises:
        TaskFailedError: If every drawn start collides or exceeds a limit.
    """
    home, item = workplace.home_joints(), workplace.scene.objects[0].name
    for _ in range(_DRAWS):
        start = home + noise * torch.from_numpy(rng.standard_normal(len(home)))
        if not workplace.robot.chain.limits.contain(start):
            continue
        world.hold(item, start.numpy())
        if not world.collisions_along(start.numpy()[None], item):
            return start
    raise TaskFailedError(f"no collision-free start in {_DRAWS} draws, noise {noise:g} rad")


def demonstrated_path(
    demonstration: Demonstration, chain: SerialChain
) -> Float[np.ndarray, "frames 3"]:
    """Path of the tool centre point, from the demonstrated joints [m].

    Raises:
        ValueError: If the demonstration has no joints of this arm.
    """
    joints = demonstration.joint_position
    if joints is None or demonstration.joint_names != chain.joint_names:
        text = f"the demonstrations have the joints {demonstration.joint_names}, but the arm"
        raise ValueError(f"{text} has {chain.joint_names}: give demonstrations of this arm.")
    return chain.forward(torch.from_numpy(joints)).position.numpy()


def demonstrated_shelf(end: Float[np.ndarray, "3"], workplace: Workplace) -> str:
    """Shelf at which a path of the end effector ends.

    Raises:
        ValueError: If the path ends more than 5 cm from the place on any shelf.
    """
    distance = {
        shelf: float(np.linalg.norm(workplace.shelf(shelf).position.numpy() - end))
        for shelf in workplace.shelf_names()
    }
    nearest = min(distance, key=distance.__getitem__)
    if distance[nearest] > _SHELF_DISTANCE:
        x, y, z = end.tolist()
        raise ValueError(
            f"the demonstration ends at ({x:.2f}, {y:.2f}, {z:.2f}) m, "
            f"{100 * distance[nearest]:.0f} cm from the nearest shelf ({nearest}): give "
            "demonstrations of placing (hrc record placing)."
        )
    return nearest
