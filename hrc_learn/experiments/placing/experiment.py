"""Experiment 1 of the paper: the demonstrated shelf, then the others, in joint space and
in task space.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.demos import Demonstration, load_demos
from hrc_learn.experiments.placing.trial import (
    PlacingFigures,
    PlacingRun,
    hand_path,
    place,
    placing_figures,
)
from hrc_learn.experiments.run_recording import Watch, unwatched
from hrc_learn.kinematics import UnreachableError, panda
from hrc_learn.sim import Touch, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.placing import PlacingSkill, Plan, PlanningSpace, check_plan
from hrc_learn.skills.work_cell import BlockedPathError, TaskFailedError
from hrc_learn.teleoperation.scripted_demonstrations import (
    PlacingDemonstrationConfig,
    demonstrate_placing,
)

# What it is worth that the expert shows the body's shape along with the hand's motion.


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownWay:
    """One demonstration, of an arm that a cabinet in the way stops."""

    time: Float[np.ndarray, " frames"]
    """[s]"""
    joint_position: Float[np.ndarray, "frames 7"]
    """[rad]"""
    touches: tuple[Touch, ...]
    """Of the cabinet by the arm or what it carried."""
    goal_distance: float
    """Of the hand from its goal at the end [m]."""

    @property
    def met_by_arm(self) -> list[Touch]:
        """Those by links of the arm."""
        return [touch for touch in self.touches if touch.first.startswith("link")]


def demonstrate(
    world: World, workplace: Workplace, shelf: str, *, shape_body: bool, seed: int
) -> ShownWay:
    """Let the expert show the way to a shelf, with or without pulling the elbow aside.

    The hand's motion is the same with the same seed.

    Args:
        world: Of the workplace.
        workplace: Where.
        shelf: Which.
        shape_body: Whether the elbow is pulled.
        seed: Of the hand's unsteadiness and of where it starts.
    """
    config = PlacingDemonstrationConfig(pull_elbow=shape_body)
    rng = np.random.default_rng(seed)
    frames, touches = demonstrate_placing(world, workplace, shelf, config, rng)
    goal = workplace.shelf(shelf).position.numpy()
    return ShownWay(
        time=np.array([frame["time"] for frame in frames]),
        joint_position=np.array([frame["joint_position"] for frame in frames]),
        touches=tuple(touches),
        goal_distance=float(np.linalg.norm(frames[-1]["position"] - goal)),
    )


@dataclass(frozen=True, kw_only=True)
class BodyShapeTrials:
    """Tries once with a seed: the same way, shown with the body's shape and without."""

    shelf: str
    """Where the way leads."""

    def __call__(self, seed: int) -> Mapping[str, Any]:
        """Values by name, with "failure" if the way with the body's shape was not free."""
        workplace = Workplace()
        world = World(workplace.scene)
        taught, untaught = (
            demonstrate(world, workplace, self.shelf, shape_body=shape_body, seed=seed)
            for shape_body in (True, False)
        )
        return {
            "taught_hit": int(bool(taught.touches)),
            "taught_goal_error_mm": 1e3 * taught.goal_distance,
            "untaught_hit": int(bool(untaught.met_by_arm)),
            "untaught_goal_error_mm": 1e3 * untaught.goal_distance,
            "failure": "; ".join(map(str, taught.touches)),
        }


# Experiment 1 of the paper: the demonstrated shelf, then the others, in two ways.
#
# As the paper does it, with a primitive of the joints whose goal is shifted, and with the
# primitive of the hand's pose and the body's shape.

SPACES: dict[PlanningSpace, str] = {"joint": "joint space", "pose": "task space"}
"""Ways to get to other shelves, the paper's first."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacingExperiment:
    """What was done, and what it came to."""

    workplace: Workplace
    demonstration: Demonstration
    shown_shelf: str
    runs: Mapping[tuple[PlanningSpace, str], PlacingRun]
    """By space and shelf, from the start of the demonstration."""
    figures: Mapping[tuple[PlanningSpace, str], PlacingFigures]
    taught: ShownWay
    """Hand and body shown at once."""
    untaught: ShownWay
    """The same motion of the hand, nobody pulling at the body."""
    same_joint7: tuple[str, ...]
    """Shelves that can be reached with joint 7 where the demonstration left it."""

    @property
    def reproduction(self) -> PlacingRun:
        """The demonstrated motion once more, as the paper plays it."""
        return self.runs["joint", self.shown_shelf]

    @property
    def joint_rmse(self) -> float:
        """Of the reproduction, from the demonstration at the same share of the motion [rad]."""
        run = self.reproduction
        shown = shown_joints(self.demonstration, run.time / run.time[-1])
        return float(np.sqrt(np.square(run.joint_position - shown).mean()))


def shown_joints(
    demonstration: Demonstration, share: Float[np.ndarray, " samples"]
) -> Float[np.ndarray, "samples 7"]:
    """Demonstrated joint positions at shares of the motion, 0 to 1 [rad]."""
    assert demonstration.joint_position is not None
    time = demonstration.time[0] + share * demonstration.duration
    columns = demonstration.joint_position.T
    return np.column_stack([np.interp(time, demonstration.time, joint) for joint in columns])


def run_placing_experiment(
    skill: PlacingSkill,
    demonstration: Demonstration,
    workplace: Workplace,
    *,
    speed: float = 1.5,
    seed: int = 0,
    on_step: Callable[[str], None] = lambda what: None,
    watch: Watch = unwatched,
) -> PlacingExperiment:
    """Do it once, in MuJoCo.

    Args:
        skill: What was learned from the demonstrations.
        demonstration: One of them.
        workplace: Where.
        speed: How many times faster than demonstrated.
        seed: Of the demonstrations with and without body shape.
        on_step: Told what comes next.
        watch: Watches the reproduction of the demonstration from the side.

    Raises:
        ValueError: If the demonstration is not of this arm or ends at none of the shelves.
    """
    path = hand_path(demonstration)
    shown_shelf = demonstrated_shelf(path[-1], workplace)
    assert demonstration.joint_position is not None
    start = torch.from_numpy(demonstration.joint_position[0])
    runs, figures, shown = {}, {}, {}
    for space, name in SPACES.items():
        for shelf in workplace.shelf_names():
            on_step(f"{shelf} shelf in {name}")
            watched = watch if (space, shelf) == ("joint", shown_shelf) else unwatched
            run = place(skill, workplace, shelf, start, space=space, speed=speed, watch=watched)
            runs[space, shelf] = run
            figures[space, shelf] = placing_figures(run, workplace, demonstration)
    for shape_body in (True, False):
        on_step(f"demonstration {'with' if shape_body else 'without'} body shape")
        world = World(workplace.scene)
        shown[shape_body] = demonstrate(
            world, workplace, shown_shelf, shape_body=shape_body, seed=seed
        )
    return PlacingExperiment(
        workplace=workplace,
        demonstration=demonstration,
        shown_shelf=shown_shelf,
        runs=runs,
        figures=figures,
        taught=shown[True],
        untaught=shown[False],
        same_joint7=_reached_with_joint7(workplace, demonstration.joint_position[-1]),
    )


def demonstrated_shelf(end: Float[np.ndarray, "3"], workplace: Workplace) -> str:
    """The shelf at which a path of the hand ends.

    Raises:
        ValueError: If it ends more than 5 cm from where things are put on any shelf.
    """
    distance = {
        shelf: float(np.linalg.norm(workplace.shelf(shelf).position.numpy() - end))
        for shelf in workplace.shelf_names()
    }
    nearest = min(distance, key=distance.__getitem__)
    if distance[nearest] > 0.05:
        x, y, z = end.tolist()
        raise ValueError(
            f"the demonstration ends at ({x:.2f}, {y:.2f}, {z:.2f}) m, "
            f"{100 * distance[nearest]:.0f} cm from the nearest shelf ({nearest}): give "
            "demonstrations of placing, by hrc record placing."
        )
    return nearest


def _reached_with_joint7(workplace: Workplace, end: np.ndarray) -> tuple[str, ...]:
    """Shelves that need no other position of joint 7 than the demonstration ended with."""
    near = torch.from_numpy(end)
    reached = []
    for shelf in workplace.shelf_names():
        try:
            panda.inverse(workplace.shelf(shelf), near[6], near=near)
        except UnreachableError:
            continue
        reached.append(shelf)
    return tuple(reached)


# Placing from starts drawn at random, again and again.

_DT = 0.01  # of plans that are only looked at [s]
_DRAWS = 100  # of a start, before it is taken that there is no free one


@dataclass(frozen=True, kw_only=True)
class PlacingTrials:
    """Tries once with a seed: places on each shelf from a start of its own."""

    placing: Path
    """Folder of the learned motion."""
    demonstrations: Path
    """Dataset that it was learned from."""
    speed: float = 1.5
    """How many times faster than demonstrated."""
    noise: float = 0.1
    """Standard deviation of each joint at the start, about home [rad]."""

    def __call__(self, seed: int) -> Mapping[str, Any]:
        """Values by name, with "failure" where a placing in task space was not good enough."""
        skill = PlacingSkill.load(self.placing)
        demonstration = load_demos(self.demonstrations, episodes=[0])[0]
        workplace, rng = Workplace(), np.random.default_rng(seed)
        world = World(workplace.scene)
        values, faults = {}, []
        for shelf in workplace.shelf_names():
            start = perturbed_start(world, workplace, self.noise, rng)
            plan = skill.plan(
                start, workplace.shelf(shelf), space="joint", dt=_DT, speed=self.speed
            )
            values[f"{shelf}_joint_space_blocked"] = _blocked(plan, world)
            run = place(
                skill, workplace, shelf, start, space="pose", speed=self.speed, world=world
            )
            figures = placing_figures(run, workplace, demonstration)
            values |= {f"{shelf}_{name}": value for name, value in figures.row().items()}
            faults += [f"{shelf} shelf: {fault}" for fault in figures.faults]
        return values | {"failure": "; ".join(faults)}


def perturbed_start(
    world: World, workplace: Workplace, noise: float, rng: np.random.Generator
) -> Float[torch.Tensor, "7"]:
    """Joint positions about home that are within the limits and touch nothing.

    Leaves the world there, with its first object in the hand.

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
        if not panda.limits.contain(start):
            continue
        world.hold(item, start.numpy())
        if not world.collisions_along(start.numpy()[None], item):
            return start
    raise TaskFailedError(f"no free start in {_DRAWS} draws with noise of {noise:g} rad")


def _blocked(plan: Plan, world: World) -> bool:
    """Whether a plan leaves the arm's limits or hits something, by geometry alone."""
    try:
        check_plan(plan, world, world.config.objects[0].name)
    except BlockedPathError:
        return True
    return False
