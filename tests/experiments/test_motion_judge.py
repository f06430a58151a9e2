"""Motions judged in a MuJoCo scene that a user brings."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from multiply_samples import END, block, demonstrations
from panda_environment import panda_and_block

from hrc_learn.experiments.motion_judge import JudgeConfig, Trial, judging
from hrc_learn.kinematics import ArmChoice

PLACE = block(0.45, 0.10, 0.0)


def block_is_lifted(model: mujoco.MjModel, data: mujoco.MjData) -> bool:
    """Success of the scene below: the block hangs between the fingers."""
    return data.body("block").xpos[2] > 0.1


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A Panda beside a block, as a file that any program can read."""
    spec = panda_and_block()
    spec.compile()
    file = tmp_path_factory.mktemp("scene") / "scene.xml"
    file.write_text(spec.to_xml(), encoding="utf-8")
    return file


def settings(scene, **more):
    success = "test_motion_judge:block_is_lifted"
    return JudgeConfig(scene=str(scene), success=success, processes=1, **more)


def trial(at):
    """The demonstrated motion with the block somewhere."""
    (demo,) = demonstrations([PLACE])
    pose = torch.cat([at.position, at.orientation]).numpy()
    return Trial(joints=demo.joint_position, gripper=demo.gripper, objects={"block": pose})


@pytest.mark.simulation
def test_only_what_the_success_function_accepts_succeeds(scene, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    with judging(settings(scene), ArmChoice(), 20.0, 0.08) as judge:
        good, bad = judge([trial(PLACE), trial(block(0.45, 0.20, 0.0))])
    assert good.failure == ""
    assert good.objects["block"][-1, 2] == pytest.approx(0.13, abs=0.01)
    assert good.joints.shape == (END, 7)
    assert "returned False" in bad.failure
    assert np.abs(bad.objects["block"][:, 1] - 0.20).max() < 0.01


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"success": "nowhere:function"}, "not a MODULE:FUNCTION"),
        ({"success": "math:nothing"}, "not a MODULE:FUNCTION"),
        ({"scene": "lost.xml"}, "no scene 'lost.xml'"),
    ],
)
def test_settings_that_do_not_exist_are_named(scene, change, message):
    given = {"scene": str(scene), "success": "math:floor", **change}
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        JudgeConfig(**given).open(ArmChoice(), 20.0, 0.08)


def test_the_scene_has_to_hold_the_arm(scene):
    with pytest.raises(ValueError, match="no position actuator moves shoulder_pan_joint"):
        settings(scene).open(ArmChoice("ur5e"), 20.0, 0.08)
