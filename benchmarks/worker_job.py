"""Plan one cycle of the pick-and-place job as a joint path, with the job's own planner.

home -> above the object -> down, close -> lift -> home -> shelf -> release -> home
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.kinematics import GraspedBox, panda
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.arm_motion import (
    StraightLine,
    joint_line,
    joints_near,
)
from hrc_learn.skills.grasping import (
    CLOSING_TIME,
    DESCENT_SPEED,
    JOINT_SPEED,
    GraspingConfig,
    as_load,
    raised,
)
from hrc_learn.skills.pick_and_place import RELEASE_TIME, PickAndPlaceConfig
from hrc_learn.skills.placing import PlacingSkill, Plan, check_plan, plan_candidates
from hrc_learn.skills.work_cell import BlockedPathError

# Duration of servoing above the object: the median of grasping (docs/benchmarks/experiments.md)
# [s].
_SERVOING = 1.5
# Speed of the final descent to the board, which ends at contact [m/s]:
# `WorkCell.move_until_contact`.
_FEELING_SPEED = 0.02
# Default speed of straight lines [m/s]: `WorkCell.move_straight`.
_LIFTING_SPEED = 0.15
# Number of object places tried for each cycle.
_ATTEMPTS = 20


@dataclass(frozen=True, kw_only=True, eq=False)
class JobCycle:
    """One cycle of the job, without people near the arm."""

    shelf: str
    dt: float
    """Control step [s]."""
    path: Float[np.ndarray, "steps 7"]
    """Joint positions, a sample for each control step, from rest to rest [rad]."""
    holding: Bool[np.ndarray, " steps"]
    """True while the arm holds the object."""
    load: GraspedBox
    """Object in the gripper during that time."""

    @property
    def duration(self) -> float:
        """[s]"""
        return self.dt * (len(self.path) - 1)


def plan_cycle(
    workplace: Workplace,
    placing: PlacingSkill,
    world: World,
    shelf: str,
    position: Float[np.ndarray, "2"],
    dt: float,
    config: PickAndPlaceConfig | None = None,
) -> JobCycle:
    """Plan a cycle with the scene's first object.

    Args:
        workplace: Table, shelves and arm.
        placing: Learned motion to the shelf.
        world: Simulation in which plans are checked for collisions; it is used up.
        shelf: Goal of the object.
        position: Position of the object on the table [m].
        dt: Control step [s].
        config: Settings of the job.

    Raises:
        UnreachableError: The arm reaches the object or the shelf nowhere within its limits.
        BlockedPathError: Every plan would collide.
    """
    config, item = config or PickAndPlaceConfig(), workplace.scene.objects[0]
    home, goal = workplace.home_joints(), workplace.shelf(shelf, item.half_size)
    hover = workplace.hover()
    over = Pose(
        hover.position.new_tensor([*position, workplace.hover_height]), hover.orientation
    )
    above = panda.inverse(over, near=workplace.hover_joints())
    table = hover.position.new_tensor([*position, item.half_size[2]])
    picked_up = Pose(table, over.orientation)

    there = joint_line(home, above, JOINT_SPEED, dt)
    down = _straight(above, picked_up, DESCENT_SPEED, dt)
    grasping: GraspingConfig = config.grasping
    up = _straight(down[-1], raised(picked_up, grasping.lift), _LIFTING_SPEED, dt)
    back = joint_line(up[-1], home, JOINT_SPEED, dt)
    for way in (there, back):
        check_plan(
            Plan(goal=panda.forward(way[-1]), dt=dt, path=way.numpy(), chain=panda), world
        )
    world.hold(item.name, home.numpy())
    plan = _free_plan(workplace, placing, world, goal, config, dt)
    transfer = torch.from_numpy(plan.path)
    below = Pose(goal.position.clone(), goal.orientation)
    below.position[2] -= workplace.lowering(item.half_size)
    onto = _straight(transfer[-1], below, _FEELING_SPEED, dt)
    parts = [
        (there, False),
        (_rest(above, _SERVOING, dt), False),
        (down, False),
        (_rest(down[-1], CLOSING_TIME, dt), False),
        (up, True),
        (back, True),
        (transfer, True),
        (onto, True),
        (_rest(onto[-1], RELEASE_TIME, dt), True),
        (onto.flip(0), False),
        (transfer.flip(0), False),
    ]
    return JobCycle(
        shelf=shelf,
        dt=dt,
        path=torch.cat([way for way, _ in parts]).numpy(),
        holding=np.concatenate([np.full(len(way), held) for way, held in parts]),
        load=as_load(item),
    )


def random_cycles(
    workplace: Workplace,
    placing: PlacingSkill,
    count: int,
    reach: tuple[float, float],
    rng: np.random.Generator,
    dt: float,
) -> Iterator[JobCycle]:
    """Cycles with the object anywhere on the table, to one shelf after the other.

    Positions from which every plan would collide are drawn again.

    Args:
        workplace: Table, shelves and arm.
        placing: Learned motion to the shelves.
        count: Number of cycles.
        reach: Largest distance of the object from the middle of the table, along x and y [m].
        rng: Source of its position.
        dt: Control step [s].
    """
    names = workplace.shelf_names()
    for k in range(count):
        for _ in range(_ATTEMPTS):
            position = np.array(workplace.table_centre) + rng.uniform(-1, 1, 2) * reach
            try:
                yield plan_cycle(
                    workplace,
                    placing,
                    World(workplace.scene),
                    names[k % len(names)],
                    position,
                    dt,
                )
            except BlockedPathError:
                continue
            break
        else:
            raise BlockedPathError(
                f"no object within {reach[0]:g} and {reach[1]:g} m of the middle of the table "
                f"can be carried to the {names[k % len(names)]} shelf without a collision."
            )


def _free_plan(
    workplace: Workplace,
    placing: PlacingSkill,
    world: World,
    goal: Pose,
    config: PickAndPlaceConfig,
    dt: float,
) -> Plan:
    """The first of the job's candidates that collides with nothing."""
    failure = BlockedPathError("no plan")
    for candidate in plan_candidates(
        goal,
        workplace.home_joints(),
        placing,
        workplace,
        dt=dt,
        speed=config.speed,
    ):
        try:
            check_plan(candidate, world, workplace.scene.objects[0].name)
        except BlockedPathError as error:
            failure = error
        else:
            return candidate
    raise failure


def _straight(start: Tensor, goal: Pose, speed: float, dt: float) -> Float[Tensor, "steps 7"]:
    """Joint positions on a straight line of the end effector, with the least motion."""
    line = StraightLine(panda.forward(start), goal, speed)
    path = [start]
    for k in range(1, round(line.duration / dt) + 1):
        path.append(joints_near(panda, line.at(k * dt)[0], path[-1]))
    return torch.stack(path)


def _rest(joints: Tensor, duration: float, dt: float) -> Float[Tensor, "steps 7"]:
    return joints.expand(round(duration / dt), -1)
