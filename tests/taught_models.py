"""Demonstrations and models of a small main job, made by the commands in half a minute."""

import json
from pathlib import Path

from commands import done
from unchecked import shapes_unchecked

from hrc_learn.kinematics import panda
from hrc_learn.skills.placing import PlacingSkill
from hrc_learn.skills.visual_skill import VisualServoSkill


@shapes_unchecked()  # minutes of simulation would be twice as many
def teach(folder: Path) -> tuple[VisualServoSkill, PlacingSkill]:
    """Record, fit and load; the models are in `folder/aiming` and `folder/placing`."""
    placing, servoing = folder / "placing_demos", folder / "servoing_demos"
    done(
        *("record", "placing", "--out", placing, "--episodes", 1),
        *("--config", "demonstration.duration=7", "demonstration.settle=0.5"),
    )
    done(
        *("record", "servoing", "--out", servoing, "--episodes", 3),
        *("--config", "demonstration.duration=3", "demonstration.settle=0.5"),
        *("--json", folder / "servoing.json"),
    )
    assert json.loads((folder / "servoing.json").read_text())["episodes"] == 3
    done("fit", "--dataset", placing, "--out", folder / "placing")
    done("fit", "image-jacobian", "--dataset", servoing, "--out", folder / "aiming")
    aiming = VisualServoSkill.load(folder / "aiming")
    return aiming, PlacingSkill.load(folder / "placing", panda)
