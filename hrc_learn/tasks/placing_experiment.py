"""Experiment 1 of the paper: the demonstrated shelf, then the others, in two ways.

As the paper does it, with a primitive of the joints whose goal is shifted, and with the
primitive of the hand's pose and the body's shape.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from ..demos import Demonstration
from ..kinematics import UnreachableError, panda
from ..sim import World
from .body_shape import ShownWay, demonstrate
from .placing import PlacingSkill, PlanningSpace
from .placing_figures import PlacingFigures, hand_path, placing_figures
from .placing_run import PlacingRun, place
from .watching import Watch, unwatched
from .workplace import Workplace

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
            "demonstrations of placing, by datasets/record_placing.py."
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
