"""The expert shows how a thing is put on a shelf: hand and body shape at once."""

from dataclasses import dataclass

import numpy as np
import torch

from ..human import GuidedPath, PullSpell, ScriptedExpert, Tremor
from ..kinematics import panda
from ..sim import Touch, World
from .failure import TaskFailedError
from .teaching import Frame, TeachingConfig, teach
from .workplace import Workplace

# The elbow is led around the open door: first away from the cabinet, then over beside it.
BODY_SHAPE = (
    PullSpell(start=0.5, duration=5.0, towards=(0.20, 0.25, 0.58)),
    PullSpell(start=4.5, duration=11.0, towards=(0.25, -0.10, 0.65)),
)


@dataclass(frozen=True, kw_only=True)
class PlacingLesson(TeachingConfig):
    """How the expert teaches placing."""

    duration: float = 14.0
    """From home to the shelf [s]."""
    spread: float = 0.015
    """Standard deviation of where demonstrations start, around home [m]."""
    shape_body: bool = True
    """Whether the expert pulls the elbow past the cabinet's open door."""
    lift: float = 0.03
    """How far above its last height the hand crosses the board's front edge [m]."""


def placing_expert(
    workplace: Workplace, shelf: str, lesson: PlacingLesson, rng: np.random.Generator
) -> ScriptedExpert:
    """The expert who puts a thing on a shelf.

    Args:
        workplace: Where.
        shelf: Which.
        lesson: How.
        rng: Source of the hand's unsteadiness and of where it starts.
    """
    goal, mouth = workplace.shelf(shelf).position, workplace.mouth(shelf).position
    # The hand is not quite level yet at the edge: what it carries hangs a little lower.
    lifted = torch.tensor([0.0, 0.0, lesson.lift], dtype=torch.float64)
    inside = goal + 0.3 * (mouth - goal)
    start = workplace.home().position + lesson.spread * torch.from_numpy(rng.standard_normal(3))
    waypoints = torch.stack([start, mouth + lifted, inside + lifted, goal]).numpy()
    return ScriptedExpert(
        panda,
        GuidedPath(waypoints, lesson.duration),
        spells=BODY_SHAPE if lesson.shape_body else (),
        tremor=Tremor(lesson.tremor, rng),
    )


def teach_placing_cleanly(
    world: World,
    workplace: Workplace,
    shelf: str,
    lesson: PlacingLesson,
    rng: np.random.Generator,
    attempts: int = 3,
) -> tuple[list[Frame], int]:
    """Demonstrate until nothing is touched on the way, as a person would.

    Returns:
        The recorded frames, and how many demonstrations were thrown away.

    Raises:
        TaskFailedError: If something was touched each time.
    """
    for attempt in range(attempts):
        frames, touches = teach_placing(world, workplace, shelf, lesson, rng)
        if not touches:
            return frames, attempt
    raise TaskFailedError(f"{attempts} demonstrations in a row hit the cabinet: {touches[0]}")


def teach_placing(
    world: World,
    workplace: Workplace,
    shelf: str,
    lesson: PlacingLesson,
    rng: np.random.Generator,
) -> tuple[list[Frame], list[Touch]]:
    """Demonstrate one placing motion, from home to a shelf with the thing in hand.

    Returns:
        The recorded frames, and all touches of the cabinet by arm or thing on the way.
    """
    expert = placing_expert(workplace, shelf, lesson, rng)
    offset = torch.from_numpy(expert.path.position(0.0)) - workplace.home().position
    world.hold(workplace.scene.objects[0].name, workplace.home_joints(offset).numpy())
    frames = list(teach(world, expert, lesson.duration + lesson.settle, lesson))
    return frames, world.cabinet_contacts.touches + world.object_contacts.touches
