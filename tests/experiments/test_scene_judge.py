"""A scene that a user brings: where things are put, and what is commanded and read."""

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from hrc_learn.experiments.motion_judge import JudgeConfig, SceneJudge, Trial, replay

pytestmark = pytest.mark.simulation

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.

SCENE = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.004" gravity="0 0 0"/>
  <worldbody>
    <body name="cup" pos="1 0 0"><freejoint/><geom size="0.01" mass="1"/></body>
    <body name="mat" mocap="true" pos="0 2 0"><geom size="0.01"/></body>
    <body name="shelf" pos="0 0 3"><geom size="0.01"/></body>
    <body name="rod" pos="0 0 5">
      <joint name="finger" type="slide" axis="0 1 0" range="0.01 0.05"/>
      <geom size="0.01" mass="1"/>
    </body>
    <body name="one" pos="9 0 0">
      <joint name="turn" axis="0 0 1"/><geom size="0.1" mass="1"/>
      <body pos="1 0 0"><joint name="bend" axis="0 1 0"/><geom size="0.1" mass="1"/></body>
    </body>
  </worldbody>
  <actuator>
    <motor name="push" joint="turn"/>
    <position name="grip" joint="finger" kp="10" ctrlrange="0.2 0.6" ctrllimited="true"/>
    <position name="bender" joint="bend" kp="50"/>
    <position name="turner" joint="turn" kp="50"/>
    <position name="open" joint="finger" kp="10"/>
  </actuator>
</mujoco>
"""
ARM: Any = SimpleNamespace(arm=lambda: SimpleNamespace(joint_names=("turn", "bend")))
BASE = (0.5, -0.25, 0.125)


@pytest.fixture
def judge(tmp_path):
    file = tmp_path / "scene.xml"
    file.write_text(SCENE, encoding="utf-8")

    def made(fps=20.0, widest=0.08, **more):
        given = {"scene": str(file), "success": "builtins:bool", "base": BASE, **more}
        found = SceneJudge(JudgeConfig(**given), ARM, fps, widest)
        found.succeeded = lambda model, data: True
        return found

    return made


def pose(*place):
    return np.array([*place, 0.5, 0.5, 0.5, 0.5])


def trial(frames=4, **objects):
    joints = np.linspace(0.1, 0.4, frames)[:, None] * (1.0, -1.0)
    return Trial(joints=joints, gripper=np.full(frames, 0.02), objects=objects)


@pytest.mark.parametrize("name", ["cup", "mat", "shelf"])
def test_free_mocap_and_fixed_bodies_are_put_in_their_places_from_the_base(judge, name):
    found = judge()
    found.begin(trial(**{name: pose(0.1, 0.2, 0.3)}))
    body = found.data.body(name)
    np.testing.assert_allclose(body.xpos, np.add((0.1, 0.2, 0.3), BASE), atol=1e-12)
    np.testing.assert_allclose(body.xquat, [0.5] * 4, atol=1e-12)
    joints, width, objects = found.read()
    np.testing.assert_allclose(joints, (0.1, -0.1))
    assert np.isnan(width)
    np.testing.assert_allclose(objects[name], pose(0.1, 0.2, 0.3), atol=1e-12)
    # The others stay where the scene has them.
    rest = {"cup": (1, 0, 0), "mat": (0, 2, 0), "shelf": (0, 0, 3), "rod": (0, 0, 5)}
    for other in rest.keys() - {name}:
        np.testing.assert_allclose(found.data.body(other).xpos, rest[other], atol=1e-12)


@pytest.mark.parametrize(
    ("gripper", "commands"),
    [
        ((), {"grip": 0.2 + 0.4 / 4, "open": 0.01 + 0.04 / 4, "push": 0.0}),
        (("grip",), {"grip": 0.2 + 0.4 / 4, "open": 0.0}),
    ],
)
def test_a_quarter_of_the_opening_is_a_quarter_of_each_actuators_range(
    judge, gripper, commands
):
    found = judge(gripper=gripper)
    found.begin(trial())
    sent = np.array([0.7, -0.6])
    np.testing.assert_array_equal(found.command(sent, 0.02), sent)
    control = {found.model.actuator(k).name: found.data.ctrl[k] for k in range(5)}
    assert (control["turner"], control["bender"]) == (0.7, -0.6)
    for name, value in commands.items():
        assert control[name] == pytest.approx(value)


def test_a_gripper_that_closes_by_a_tendon_is_driven(tmp_path):
    # As the Franka hand of MuJoCo Menagerie: the tendon has the number of the first joint.
    text = """
    <mujoco>
      <worldbody>
        <body><joint name="turn" axis="0 0 1"/><geom size="0.1" mass="1"/>
          <body pos="1 0 0"><joint name="bend" axis="0 1 0"/><geom size="0.1" mass="1"/>
            <body><joint name="finger" type="slide"/><geom size="0.01" mass="1"/></body>
          </body>
        </body>
      </worldbody>
      <tendon><fixed name="split"><joint joint="finger" coef="1"/></fixed></tendon>
      <actuator>
        <position name="bender" joint="bend" kp="50"/>
        <position name="turner" joint="turn" kp="50"/>
        <general name="grip" tendon="split" ctrlrange="0 255" ctrllimited="true"/>
      </actuator>
    </mujoco>
    """
    file = tmp_path / "scene.xml"
    file.write_text(text, encoding="utf-8")
    found = SceneJudge(JudgeConfig(scene=str(file), success="builtins:bool"), ARM, 20.0, 0.08)
    assert found.model.tendon("split").id == found.model.joint("turn").id == 0
    found.begin(trial())
    found.command(np.array([0.7, -0.6]), 0.02)
    control = {found.model.actuator(k).name: found.data.ctrl[k] for k in range(3)}
    assert control == pytest.approx({"bender": -0.6, "turner": 0.7, "grip": 255 / 4})


@pytest.mark.parametrize(("fps", "steps"), [(20.0, 12), (50.0, 5), (1000.0, 1)])
def test_a_frame_takes_its_time_in_steps_of_the_scene(judge, fps, steps):
    found = judge(fps=fps)
    found.begin(trial())
    for _ in range(3):
        found.command(np.zeros(2), 0.0)
    assert found.data.time == pytest.approx(3 * steps * 0.004)


def test_a_gripper_that_was_never_open_has_unit_width(judge):
    found = judge(widest=0.0)
    found.begin(trial())
    found.command(np.zeros(2), 0.5)
    assert found.data.ctrl[found.model.actuator("grip").id] == pytest.approx(0.4)


def test_a_replay_commands_the_next_frame_and_reads_before_it(judge):
    found, given = judge(), trial(cup=pose(0.1, 0.2, 0.3))
    made = replay(found, given)
    np.testing.assert_array_equal(made.sent, [*given.joints[1:], given.joints[-1]])
    np.testing.assert_allclose(made.joints[0], given.joints[0])
    assert made.joints.shape == given.joints.shape
    assert made.gripper is None
    assert made.objects["cup"].shape == (4, 7)
    assert made.failure == ""
    found.succeeded = lambda model, data: False
    assert replay(found, given).failure == "builtins:bool returned False"
    # A second replay begins from the same state as the first one.
    found.succeeded = lambda model, data: data.time < 0.2
    again = replay(found, given)
    np.testing.assert_array_equal(again.joints, made.joints)
    assert isinstance(found.model, mujoco.MjModel)


def test_a_motion_whose_simulation_diverges_fails_whatever_the_function_says(judge):
    """MuJoCo would reset the scene, and the motion could look like a success."""
    found = judge()
    found.model.actuator_gainprm[3, 0] = 1e9
    diverged = replay(found, trial())
    assert diverged.failure.startswith("physics: physics failed at one")
    found.model.actuator_gainprm[3, 0] = 50.0
    assert replay(found, trial()).failure == ""
