"""Rolling out a checkpoint in simulated time, with a person beside it."""

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from unchecked import shapes_unchecked

from hrc_learn.kinematics import panda
from hrc_learn.lerobot import episode_recording, person
from hrc_learn.lerobot.arm_values import GRIPPER, ArmValues
from hrc_learn.lerobot.episode_recording import (
    CheckpointPolicy,
    add_frame,
    new_dataset,
    record_rollouts,
    roll_out,
)
from hrc_learn.lerobot.mujoco_arm import MujocoArmRobotConfig
from hrc_learn.lerobot.person import PersonConfig
from hrc_learn.lerobot.policy.dmp_policy import write_closed_form_policy
from hrc_learn.lerobot.policy.policy_base import read_episodes
from hrc_learn.teleoperation import ScriptedForce
from hrc_learn.teleoperation.scenarios import Grasping

JOINTS = ArmValues(panda).joints
FPS = 20.0
PULL = ScriptedForce(start=0.2, duration=0.6, towards=(-0.4, 0.6, 0.2), max_force=60.0)
FAR = np.array([0.3, 0.1, 0.0, 0.1, 0.0, 0.1, 0.0])


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    """Fitted to two motions along a line."""
    from hrc_learn.lerobot.mujoco_arm import MujocoArmRobot

    home = tmp_path_factory.mktemp("home")
    robot = MujocoArmRobot(
        MujocoArmRobotConfig(calibration_dir=home, scenario="grasping", fps=FPS)
    )
    robot.connect()
    with shapes_unchecked(), new_dataset(home / "set", robot) as dataset:
        for seed in (0, 1):
            robot.begin(seed)
            start = robot.arm.read().joint_position
            for k in range(30):
                q = start + 0.5 * (1 - np.cos(np.pi * k / 29)) * FAR
                action = dict(zip(JOINTS, q.tolist(), strict=True)) | {GRIPPER: 0.06}
                seen = robot.get_observation()
                robot.send_action(action)
                add_frame(dataset, seen, action, "go there")
            dataset.save_episode()
    robot.disconnect()
    (home / "policy").mkdir()
    write_closed_form_policy(home / "set", home / "policy", n_basis=12)
    return home / "policy"


@pytest.mark.long
def test_a_checkpoint_is_rolled_out_and_recorded_with_what_the_person_does(
    policy, tmp_path, monkeypatch
):
    monkeypatch.setattr(person, "scripted_pulls", lambda seed: (PULL,) if seed == 8 else ())
    monkeypatch.setattr(Grasping, "duration", 1.0)
    who = PersonConfig(kind="scripted", record=True)
    config = MujocoArmRobotConfig(
        calibration_dir=tmp_path, scenario="grasping", fps=FPS, seed=7, person=who
    )
    with shapes_unchecked():
        done = list(record_rollouts(tmp_path / "set", policy, config, episodes=2))
    assert done == [False, False]  # it has learned to move, not to grasp
    keys = ["action", "observation.state", "observation.human_effort"]
    free, beside = read_episodes(tmp_path / "set", [*keys, "observation.pushed_aside"])
    assert len(free["action"]) == len(beside["action"]) == 30
    assert not free["observation.human_effort"].any()
    assert beside["observation.human_effort"].abs().max() > 1.0
    assert beside["observation.pushed_aside"].abs().max() > 0.05
    # Both do what was learned: the policy saw its own posture.
    for episode in (free, beside):
        way = episode["action"][-1, :7] - episode["observation.state"][0, :7]
        np.testing.assert_allclose(way, FAR, atol=0.03)
    torch.testing.assert_close(
        free["observation.state"], beside["observation.state"], rtol=0, atol=0.02
    )


def test_without_a_checkpoint_the_cure_is_named(simulated, tmp_path):
    with pytest.raises(FileNotFoundError, match="pretrained_model"):
        CheckpointPolicy(tmp_path, simulated(scenario="grasping", fps=FPS))


class Robot:
    """Counts its steps; its task lasts a number of seconds."""

    def __init__(self, duration, dt):
        self.dt, self.did = dt, []
        self.run = SimpleNamespace(
            scenario=SimpleNamespace(duration=duration, task="go there"),
            succeeded=lambda: len(self.did) > 20,
        )

    def begin(self, seed):
        self.did.append(f"begin {seed}")

    def get_observation(self):
        return {"at": len(self.did)}

    def send_action(self, action):
        self.did.append(action["to"])

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.did.append("left")


class Policy:
    """Answers each observation with itself."""

    def __init__(self, *_):
        self.resets = 0

    def reset(self):
        self.resets += 1

    def act(self, observation):
        return {"to": observation["at"]}


@pytest.mark.parametrize(("duration", "dt", "steps"), [(2.0, 0.5, 6), (1.1, 0.5, 3)])
def test_a_policy_has_half_as_long_again_as_a_demonstration(duration, dt, steps):
    robot, policy = Robot(duration, dt), Policy()
    with shapes_unchecked():
        shown = list(roll_out(robot, policy, 7))
    assert robot.did == ["begin 7", *range(1, steps + 1)]
    assert shown == [({"at": k}, {"to": k}) for k in range(1, steps + 1)]
    assert policy.resets == 1


def test_each_rollout_has_the_next_seed_and_says_if_it_succeeded(monkeypatch, tmp_path):
    robot = Robot(2.0, 0.5)
    written, saved = [], []
    dataset = SimpleNamespace(save_episode=lambda: saved.append(len(written)))
    monkeypatch.setattr(episode_recording, "MujocoArmRobot", lambda config: robot)
    monkeypatch.setattr(episode_recording, "CheckpointPolicy", Policy)
    monkeypatch.setattr(episode_recording, "new_dataset", lambda *_: nullcontext(dataset))
    monkeypatch.setattr(
        episode_recording, "add_frame", lambda *given: written.append(given[1:])
    )
    config = SimpleNamespace(seed=4)
    with shapes_unchecked():
        results = list(record_rollouts(tmp_path / "set", tmp_path, config, 3))
    assert results == [False, False, True]
    assert [word for word in robot.did if str(word).startswith("begin")] == [
        "begin 4",
        "begin 5",
        "begin 6",
    ]
    assert saved == [6, 12, 18]
    assert robot.did[-1] == "left"
    assert written[0] == ({"at": 1}, {"to": 1}, "go there")
