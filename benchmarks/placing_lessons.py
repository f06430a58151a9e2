"""Demonstrations of placing at ever other places, as policies learn from them.

The state is the joints', the action the joints one frame later, and
`observation.environment_state` says where to.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hrc_learn.demos import DatasetWriter
from hrc_learn.kinematics import panda
from hrc_learn.sim import World
from hrc_learn.tasks.teach_placing import PlacingLesson, teach_placing_cleanly
from hrc_learn.tasks.teaching import Frame
from hrc_learn.tasks.workplace import Workplace

GOAL = "observation.environment_state"
LESSON = PlacingLesson(record_every=4, spread=0.03)
"""25 frames a second, starts 3 cm about home."""
ALONG_BOARD = (0.38, 0.50)
"""Where along the boards there is room to place without touching anything [m]."""


def placing_lessons(count: int, seed: int) -> Iterator[tuple[np.ndarray, list[Frame]]]:
    """Goals on all shelves, anywhere along them, and the frames of a demonstration each."""
    rng = np.random.default_rng(seed)
    world = World(Workplace().scene)
    for k in range(count):
        workplace = Workplace(shelf_x=rng.uniform(*ALONG_BOARD))
        names = workplace.shelf_names()
        shelf = names[k % len(names)]
        frames, _ = teach_placing_cleanly(world, workplace, shelf, LESSON, rng)
        yield workplace.shelf(shelf).position.numpy(), frames


def write_lessons_of_placing(
    path: Path, lessons: Iterator[tuple[np.ndarray, list[Frame]]]
) -> None:
    """Write them as a LeRobot dataset."""
    features = {GOAL: ("goal.x", "goal.y", "goal.z")}
    with DatasetWriter(
        path,
        fps=LESSON.fps,
        robot_type="panda",
        joint_names=panda.joint_names,
        features=features,
    ) as writer:
        for goal, frames in lessons:
            writer.start_episode("place the box")
            joints = [frame["joint_position"] for frame in frames]
            for now, ahead in zip(joints, [*joints[1:], joints[-1]], strict=True):
                writer.add_frame(joint_position=now, command_position=ahead, **{GOAL: goal})
            writer.save_episode()
