"""Late actions are counted and told; pauses, and a few of them, are not."""

import logging

import pytest

from hrc_learn.lerobot.loop_watch import LoopWatch

FPS = 20.0


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
