"""Skills taught and learned in a minute, for tests of whole jobs."""

from pathlib import Path

import numpy as np
from unchecked import shapes_unchecked

from hrc_learn.demos import DatasetWriter, DemonstrationSet, load_demos
from hrc_learn.kinematics import panda
from hrc_learn.learning.primitive_fitting import fit_primitives
from hrc_learn.learning.visual_servo_fitting import fit_visual_servo
from hrc_learn.sim import World, open_camera
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.marker_sensor import MarkerSensor
from hrc_learn.skills.placing import PlacingSkill
from hrc_learn.skills.visual_skill import OBJECT_FEATURE, OBJECT_FEATURE_NAMES, VisualServoSkill
from hrc_learn.teleoperation.scripted_demonstrations import (
    PlacingDemonstrationConfig,
    ServoDemonstrationConfig,
    demonstrate_placing,
    demonstrate_servoing,
)

WORKPLACE = Workplace()


def recorded(folder: Path, config, features, demonstrations) -> DemonstrationSet:
    """Lessons, written to disk and read again."""
    with DatasetWriter(
        folder, config.fps, "panda", panda.joint_names, features=features
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
    config, world = PlacingDemonstrationConfig(), World(WORKPLACE.scene)
    frames, _ = demonstrate_placing(
        world, WORKPLACE, "middle", config, np.random.default_rng(0)
    )
    fitted = fit_primitives(recorded(folder / "demos", config, {}, [frames]))
    fitted.save(folder / "model")
    return PlacingSkill.load(folder / "model"), fitted.metrics()


@shapes_unchecked()
def taught_aiming(folder: Path) -> VisualServoSkill:
    """Aiming, from five demonstrations."""
    config, rng, world = (
        ServoDemonstrationConfig(duration=5.0),
        np.random.default_rng(1),
        World(),
    )
    sensor = MarkerSensor(open_camera(world, "synthetic", rng=rng), WORKPLACE.scene.marker_ids)
    shown = [demonstrate_servoing(world, WORKPLACE, sensor, config, rng) for _ in range(5)]
    features = {OBJECT_FEATURE: OBJECT_FEATURE_NAMES}
    skill = fit_visual_servo(recorded(folder / "demos", config, features, shown))
    (folder / "model").mkdir()
    skill.save(folder / "model")
    assert skill.metrics()["held_out_relative"] < 0.15
    return VisualServoSkill.load(folder / "model")
