"""Late actions are counted and told; pauses, and a few of them, are not. So are limits."""

import logging

import numpy as np
import pytest

from hrc_learn.kinematics import panda
from hrc_learn.lerobot.arm_robot import LoopWatch
from hrc_learn.protocols import ArmState

FPS = 20.0
HOME = np.array([0.0, -0.3, 0.0, -2.0, 0.0, 1.8, 0.5])


def watched(caplog, gaps):
    """What is said of actions that many periods apart."""
    clock = [7.0]
    watch = LoopWatch("arm", FPS, lambda: clock[0])
    with caplog.at_level(logging.WARNING):
        watch.tick()
        for gap in gaps:
            clock[0] += gap / FPS
            watch.tick()
        watch.end()
    return [record.getMessage() for record in caplog.records]


@pytest.mark.parametrize("gap", [0.5, 1.0, 1.45])
def test_a_loop_in_time_says_nothing(caplog, gap):
    assert watched(caplog, [gap] * 50) == []


def test_lost_frames_and_the_latest_action_are_told(caplog):
    (message,) = watched(caplog, [*[1.0] * 20, 1.6, 1.0, 4.0, *[1.0] * 7])
    assert message.startswith("arm: 2 of 31 actions came late, by 150 ms at most")
    assert "lacks about 4 frames" in message  # 1 and 3


@pytest.mark.parametrize(("actions", "told"), [(40, True), (60, False)])
def test_two_in_a_hundred_are_tolerated(caplog, actions, told):
    assert bool(watched(caplog, [2.0, *[1.0] * actions])) == told


def test_a_pause_parts_two_stretches_and_is_not_late(caplog):
    messages = watched(caplog, [1.0, 3.0, 2.1 * FPS, 1.0, 1.0])
    assert len(messages) == 1
    assert messages[0].startswith("arm: 1 of 3 actions")


def seen(caplog, path, touching=lambda k: ()):
    """What is said of actions at these joint positions (frames, joints) [rad]."""
    clock = [0.0]
    watch = LoopWatch("arm", FPS, lambda: clock[0], panda)
    with caplog.at_level(logging.WARNING):
        for k, q in enumerate(path):
            clock[0] = k / FPS
            state = ArmState(
                time=clock[0],
                joint_position=q,
                joint_velocity=np.zeros(7),
                gripper_width=0.04,
            )
            watch.tick(state, touching(k))
        watch.end()
        watch.end()  # says nothing twice
    return [record.getMessage() for record in caplog.records]


def reach(joint, amount, frames=40):
    """A joint moves by an amount [rad], the others stay."""
    path = np.repeat(HOME[None], frames, axis=0)
    path[:, joint] += np.linspace(0, amount, frames)
    return path


def test_a_good_demonstration_is_kept_without_a_word(caplog):
    assert seen(caplog, reach(0, 0.8)) == []


def test_an_arm_that_stays_is_told(caplog):
    assert seen(caplog, reach(0, 0.004)) == ["arm: in the recording, the arm has not moved"]


def test_a_moment_is_no_episode(caplog):
    assert seen(caplog, reach(0, 0.0, frames=19)) == []


@pytest.mark.parametrize(("frames", "told"), [(10, False), (11, True)])
def test_a_joint_that_stays_at_its_limit_is_told(caplog, frames, told):
    path = reach(0, 0.8)
    path[-frames:, 3] = float(panda.limits.upper[3]) - 0.029
    path[:, 5] = float(panda.limits.upper[5]) - 0.031  # near, but not there
    messages = seen(caplog, path)
    assert len(messages) == told
    assert not told or "panda_joint4 was at its limit for 0.6 s" in messages[0]


def test_what_was_touched_is_told_with_how_long(caplog):
    (message,) = seen(caplog, reach(0, 0.8), lambda k: ("hand touched shelf",) * (4 <= k < 9))
    assert message == "arm: in the recording, hand touched shelf for 0.25 s"
