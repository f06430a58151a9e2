"""Skills taught and learned in a minute, for tests of whole jobs."""

from pathlib import Path

import numpy as np
from unchecked import shapes_unchecked

from hrc_learn.demos import DatasetWriter, DemonstrationSet, load_demos
from hrc_learn.kinematics import panda
from hrc_learn.learning.fit_primitives import fit_primitives
from hrc_learn.learning.fit_visual_servo import fit_visual_servo
from hrc_learn.sim import World, open_camera
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.marker_sensor import MarkerSensor
from hrc_learn.skills.placing import PlacingSkill
from hrc_learn.skills.visual_servoing import VisualServoSkill
from hrc_learn.skills.visual_target import OBJECT_FEATURE, OBJECT_FEATURE_NAMES
from hrc_learn.teleoperation.scripted_demonstrations import (
    AimingLesson,
    PlacingLesson,
    teach_aiming,
    teach_placing,
)

WORKPLACE = Workplace()


def recorded(folder: Path, lesson, features, demonstrations) -> DemonstrationSet:
    """Lessons, written to disk and read again."""
    with DatasetWriter(
        folder, lesson.fps, "panda", panda.joint_names, features=features
    ) as writer:
        for frames in demonstrations:
            writer.start_episode("show")
            for frame in frames:
                writer.add_frame(images=None, **frame)
            writer.save_episode()
    return load_demos(folder)


@shapes_unchecked()
def taught_placing(folder: Path) -> tuple[PlacingSkill, dict[str, float]]:
    """Placing, from one demonstration, and the errors of the fit."""
    lesson, world = PlacingLesson(), World(WORKPLACE.scene)
    frames, _ = teach_placing(world, WORKPLACE, "middle", lesson, np.random.default_rng(0))
    fitted = fit_primitives(recorded(folder / "demos", lesson, {}, [frames]))
    fitted.save(folder / "model")
    return PlacingSkill.load(folder / "model"), fitted.metrics()


@shapes_unchecked()
def taught_aiming(folder: Path) -> VisualServoSkill:
    """Aiming, from five demonstrations."""
    lesson, rng, world = AimingLesson(duration=5.0), np.random.default_rng(1), World()
    sensor = MarkerSensor(open_camera(world, "synthetic", rng=rng), WORKPLACE.scene.marker_ids)
    shown = [teach_aiming(world, WORKPLACE, sensor, lesson, rng) for _ in range(5)]
    features = {OBJECT_FEATURE: OBJECT_FEATURE_NAMES}
    skill = fit_visual_servo(recorded(folder / "demos", lesson, features, shown))
    (folder / "model").mkdir()
    skill.save(folder / "model")
    assert skill.metrics()["held_out_relative"] < 0.15
    return VisualServoSkill.load(folder / "model")
