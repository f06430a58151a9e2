"""A person who leads the body of a LeRobot arm while actions lead its hand."""

from dataclasses import astuple
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from served_franka import served_franka
from unchecked import shapes_unchecked

from hrc_learn.demos import load_demos
from hrc_learn.kinematics import panda
from hrc_learn.lerobot import person
from hrc_learn.lerobot.arm_teleoperators import GuidedRobot
from hrc_learn.lerobot.arm_values import GRIPPER, HAND, ArmValues
from hrc_learn.lerobot.driven_arms import FrankaPandaConfig
from hrc_learn.lerobot.episode_recording import add_frame, new_dataset
from hrc_learn.lerobot.person import PersonConfig, nullspace_inputs, offsets
from hrc_learn.lerobot.policy.policy_base import read_episodes
from hrc_learn.protocols import HumanInput
from hrc_learn.skills import complementary_motion
from hrc_learn.teleoperation import ScriptedForce

pytestmark = pytest.mark.simulation

JOINTS, VELOCITIES = ArmValues(panda).joints, ArmValues(panda).velocities
NULLSPACE_INPUTS, OFFSETS = nullspace_inputs(panda), offsets(panda)
FPS = 20.0
PULL = ScriptedForce(start=0.5, duration=2.5, towards=(-0.4, 0.6, 0.2), max_force=60.0)


@pytest.fixture
def pulled(simulated, monkeypatch):
    """A simulated arm whose elbow is pulled aside, or not at all."""
    # Two steps of the loop for one action in place of five.
    monkeypatch.setattr(complementary_motion, "_STEP", 0.5 / FPS)

    def robot(*pulls, **settings):
        monkeypatch.setattr(person, "scripted_pulls", lambda seed: pulls)
        extra = {
            name: settings.pop(name)
            for name in ("observed", "record", "after_push")
            if name in settings
        }
        who = PersonConfig(kind="scripted", **extra)
        settings = {"scenario": "grasping"} | settings
        return simulated(fps=FPS, person=who, **settings)

    return robot


def wishes(robot, seconds):
    """Actions along a line of the joints, there and back, from where the arm is."""
    start = robot.arm.read().joint_position
    far = np.array([0.3, 0.1, 0.0, 0.1, 0.0, 0.1, 0.0])
    steps = round(seconds * FPS)
    for k in range(steps):
        q = start + 0.5 * (1 - np.cos(2 * np.pi * k / steps)) * far
        yield q, dict(zip(JOINTS, q.tolist(), strict=True)) | {GRIPPER: 0.06}


def carried_out(robot, seconds=8.0):
    """Wished and read joints, and what was observed, of every step."""
    wished, read, seen = [], [], []
    with shapes_unchecked():
        for q, action in wishes(robot, seconds):
            seen.append(robot.get_observation())
            robot.send_action(action)
            wished.append(q)
            read.append(robot.arm.read().joint_position)
    return torch.tensor(np.array(wished)), torch.tensor(np.array(read)), seen


def values_of(seen, names):
    return torch.tensor(
        [[values[name] for name in names] for values in seen], dtype=torch.float64
    )


def elbow(joints):
    return panda.joint_origins(joints)[:, 3]


def test_with_a_person_who_does_nothing_the_robot_does_as_without(simulated, pulled):
    alone = carried_out(simulated(scenario="grasping", fps=FPS), seconds=1.0)
    beside = carried_out(pulled(), seconds=1.0)
    assert torch.equal(alone[1], beside[1])
    assert alone[2] == beside[2]


@pytest.mark.long
def test_the_elbow_goes_aside_and_back_while_the_hand_follows_the_actions(pulled):
    robot = pulled(PULL)
    wished, read, seen = carried_out(robot)
    aside = (elbow(read) - elbow(wished)).norm(dim=-1)
    assert aside.max() > 0.15
    assert aside[-1] < 0.02
    off = panda.forward(read).position - panda.forward(wished).position
    assert off.norm(dim=-1).max() < 2e-3
    # The policy sees its own posture, and the hand where it is.
    observed = values_of(seen, JOINTS)
    assert (observed[1:] - wished[:-1]).abs().max() < 0.02
    assert not robot.world.self_contacts.touches
    assert not robot.world.cabinet_contacts.touches
    robot.begin(5)
    assert not robot.complement.offset.any()


@pytest.mark.long
def test_joints_as_they_are_are_observed_if_wanted(pulled):
    robot = pulled(PULL, observed="joints", velocity=True)
    wished, read, seen = carried_out(robot, seconds=2.0)
    observed = values_of(seen, JOINTS)
    assert (observed[1:] - read[:-1]).abs().max() < 1e-12
    assert (observed[1:] - wished[:-1]).abs().max() > 0.2
    assert values_of(seen, VELOCITIES).abs().max() > 0.3


@pytest.mark.long
def test_poses_of_the_hand_are_followed_likewise(pulled):
    robot = pulled(PULL, action_space="ee")
    start = robot.get_observation()
    with shapes_unchecked():
        for k in range(round(3 * FPS)):
            action = {name: start[name] for name in HAND} | {GRIPPER: 0.06}
            action["ee.x.pos"] += 0.02 * k / FPS
            robot.send_action(action)
    there = robot.get_observation()
    for name in HAND:
        assert there[name] == pytest.approx(action[name], abs=5e-3)
    assert np.abs(robot.complement.offset).max() > 0.2


@pytest.mark.long
def test_what_the_person_does_is_recorded_in_columns_of_its_own(pulled, tmp_path):
    robot = pulled(PULL, record=True)
    names = [*NULLSPACE_INPUTS, *OFFSETS]
    assert list(robot.observation_features) == [*JOINTS, GRIPPER, *names]
    # Those lerobot-rollout hands on to a policy, which knows nothing of the person.
    assert not any(name.endswith((".pos", ".vel")) for name in names)
    folder, inputs, aside = tmp_path / "set", [], []
    with shapes_unchecked(), new_dataset(folder, robot) as dataset:
        for _, action in wishes(robot, 2.0):
            seen = robot.get_observation()
            inputs.append([seen[name] for name in NULLSPACE_INPUTS])
            aside.append([seen[name] for name in OFFSETS])
            robot.send_action(action)
            add_frame(dataset, seen, action, "go there and back")
        dataset.save_episode()
    keys = ["observation.human_effort", "observation.pushed_aside", "observation.state"]
    (episode,) = read_episodes(folder, keys)
    assert episode["observation.state"].shape == (40, 8)
    np.testing.assert_allclose(episode[keys[0]], inputs, atol=1e-5)
    np.testing.assert_allclose(episode[keys[1]], aside, atol=1e-6)
    (demo,) = load_demos(folder)
    assert np.abs(demo.human_effort).max() > 1.0


def test_a_person_who_is_not_recorded_adds_nothing(pulled):
    assert list(pulled(PULL).get_observation()) == [*JOINTS, GRIPPER]


@pytest.mark.parametrize("kind", ["scripted", "page", "gamepad", "keyboard", "none"])
@pytest.mark.parametrize("record", [False, True])
def test_the_persons_values_are_observed_if_there_is_one_and_wanted(kind, record):
    names = PersonConfig(kind=kind, record=record).names(panda)
    assert names == ((*NULLSPACE_INPUTS, *OFFSETS) if record and kind != "none" else ())


def test_each_kind_of_person_has_a_device_and_only_the_page_is_shown(monkeypatch):
    served = []

    class RobotPage:
        def __init__(self, *given, **how):
            served.append((given, how))
            self.page = SimpleNamespace(human="at the page")

    monkeypatch.setattr(person, "RobotPage", RobotPage)
    for name in ("Gamepad", "TerminalKeyboard"):
        device = SimpleNamespace(open=lambda chain, name=name: (name, chain))
        monkeypatch.setattr(f"hrc_learn.teleoperation.devices.{name}", device)
    guide = "hrc_learn.teleoperation.hand_guiding.LinkGuide"
    monkeypatch.setattr(guide, lambda device, chain: ("link", device, chain))
    arm = SimpleNamespace(chain=panda)
    for kind, name in {"gamepad": "Gamepad", "keyboard": "TerminalKeyboard"}.items():
        opened = person.open_device(PersonConfig(kind=kind), arm)
        assert opened == (("link", (name, panda), panda), None)
    script, page = person.open_device(PersonConfig(kind="scripted"), arm)
    assert page is None
    state = SimpleNamespace(time=1.0, joint_position=panda.ready.numpy())
    assert not script.read(state).nullspace_input.any()
    human, page = person.open_device(PersonConfig(kind="page", host="h", port=7), arm)
    assert human == "at the page"
    assert isinstance(page, RobotPage)
    (((shown, host, port, _), how),) = served
    assert (shown, host, port, how) == (arm, "h", 7, {"guides": False})
    listed = "none, scripted, page, gamepad, keyboard, but is "
    with pytest.raises(ValueError, match=f"person.kind must be one of {listed}'none'"):
        person.open_device(PersonConfig(kind="none"), arm)
    with pytest.raises(ValueError, match=r"kind must be none or .* keyboard, but is 'robot'"):
        PersonConfig(kind="robot")


def test_a_page_shows_the_world_or_the_arm_alone_as_it_is_read():
    placed, reset = [], []
    page = object.__new__(person.RobotPage)
    page.page = SimpleNamespace(place=placed.append)
    page._ghost = SimpleNamespace(reset=lambda *at, **with_: reset.append((at, with_)))
    page.show(None, "world")  # its driver is not read
    assert (placed, reset) == (["world"], [])
    state = SimpleNamespace(joint_position=np.ones(7), gripper_width=0.03)
    page.show(SimpleNamespace(read=lambda: state), None)
    assert placed[1] is page._ghost
    assert reset == [((state.joint_position,), {"gripper_width": 0.03})]


def test_pulls_belong_to_their_seed():
    def drawn(seed):
        return [astuple(pull) for pull in person.scripted_pulls(seed)]

    assert drawn(3) == drawn(3)
    assert len({repr(drawn(seed)) for seed in range(20)}) > 15


@pytest.mark.realtime
def test_the_real_panda_yields_to_a_device_too(tmp_path, monkeypatch):
    settings = {"calibration_dir": tmp_path, "ip": "x", "fps": FPS, "timeout": 600.0}
    with pytest.raises(ValueError, match="person"):
        FrankaPandaConfig(person=PersonConfig(kind="scripted"), **settings)

    class Device(person.Human):
        closed = False

        def read(self, state):
            return HumanInput(nullspace_input=np.array([4.0, 0, -4, 0, 3, 0, 0]))

        def show(self, driver, world):
            self.shown = driver

        def close(self):
            self.closed = True

    device = Device()  # and its page
    opened = lambda config, arm: (device, device)  # noqa: E731
    monkeypatch.setattr("hrc_learn.lerobot.arm_robot.open_device", opened)
    with served_franka(
        tmp_path, person=PersonConfig(kind="gamepad"), fps=FPS, dynamics=1.0
    ) as served:
        robot = served.robot
        start = served.read().joint_position
        with shapes_unchecked():
            served.drive(dict(zip(JOINTS, start.tolist(), strict=True)), 20)
        read = torch.from_numpy(np.stack([start, served.read().joint_position]))
        # The elbow is guided at 0.15 m/s at most, below the cap of 0.25 m/s.
        assert (elbow(read)[1] - elbow(read)[0]).norm() > 0.08
        # Actions that come late, by 0.6 s on a busy machine, find the elbow farther on.
        hand = panda.forward(read).position
        assert (hand[1] - hand[0]).norm() < 1e-2
        assert device.shown is robot.arm
    assert device.closed


@pytest.mark.slow
def test_an_elbow_that_is_pulled_over_its_pole_on_the_way_comes_back(pulled):
    """On the way to the shelf the null space comes to lead elsewhere than back."""
    hand_of = ScriptedForce(
        start=0.5, duration=4.4, towards=(-0.33, -0.51, 0.41), max_force=60.0
    )
    robot = pulled(scenario="placing")
    actions = []
    with shapes_unchecked():
        expert = GuidedRobot(robot, robot.run.expert)
        for _ in range(round(11 * FPS)):
            actions.append(expert.next()[0])
            robot.send_action(actions[-1])
        robot.disconnect()
        robot = pulled(hand_of, scenario="placing")
        wished, read = [], []
        for action in actions:
            robot.send_action(action)
            wished.append(robot.complement.posture.numpy().copy())
            read.append(robot.arm.read().joint_position)
    wished, read = (torch.from_numpy(np.array(rows)) for rows in (wished, read))
    aside = (elbow(read) - elbow(wished)).norm(dim=-1)
    assert aside.max() > 0.15
    assert aside[-1] < 0.01
    assert not robot.complement.waits
    off = panda.forward(read).position - panda.forward(wished).position
    assert off.norm(dim=-1).quantile(0.95) < 6e-3  # servos lag by half a step
    assert not robot.world.cabinet_contacts.touches
