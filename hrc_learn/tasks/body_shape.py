"""What it is worth that the expert shows the body's shape along with the hand's motion."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ..sim import Touch, World
from .teach_placing import PlacingLesson, teach_placing
from .workplace import Workplace


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
    lesson = PlacingLesson(shape_body=shape_body)
    rng = np.random.default_rng(seed)
    frames, touches = teach_placing(world, workplace, shelf, lesson, rng)
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
