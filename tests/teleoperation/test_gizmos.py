"""Who holds the arm, under a clock that the tests turn."""

import numpy as np
import pytest

from hrc_learn.teleoperation.page.gizmos import HeldGizmo, HeldGizmos


class Clock:
    def __init__(self):
        self.time = 100.0

    def __call__(self):
        return self.time


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def grips(clock):
    return HeldGizmos(timeout=0.5, clock=clock)


def elbow(x=0.0):
    return HeldGizmo(joint=4, held_at=np.zeros(3), pointer=np.array([x, 0.0, 0.0]))


def test_a_handle_is_held_until_it_is_let_go(grips):
    grips.take(1, "elbow", elbow())
    grips.move(1, "elbow", np.array([0.3, 0.0, 0.0]))
    (grip,) = grips.held().values()
    assert grip.pointer.tolist() == [0.3, 0.0, 0.0]
    assert grips.holders == {1}
    grips.release(1, "elbow")
    assert not grips.held()
    assert not grips.holders


def test_whoever_is_not_heard_of_loses_all_grips_for_good(grips, clock):
    grips.take(1, "elbow", elbow())
    grips.take(1, "wrist", elbow())
    clock.time += 0.49
    assert len(grips.held()) == 2
    clock.time += 0.02
    assert not grips.held()
    # A connection that comes back must not move the arm before the handle is taken anew.
    grips.hear(1)
    grips.move(1, "elbow", np.array([0.5, 0.0, 0.0]))
    assert not grips.held()
    grips.take(1, "elbow", elbow())
    assert grips.held()


@pytest.mark.parametrize("sign_of_life", ["hear", "move"])
def test_a_hand_at_rest_goes_on_holding_while_it_is_heard(grips, clock, sign_of_life):
    grips.take(1, "elbow", elbow())
    for _ in range(10):
        clock.time += 0.4
        if sign_of_life == "hear":
            grips.hear(1)
        else:
            grips.move(1, "elbow", np.zeros(3))
        assert grips.held()


def test_people_hold_independently_of_each_other(grips, clock):
    grips.take(1, "elbow", elbow(0.1))
    grips.take(2, "elbow", elbow(0.2))
    assert len(grips.held()) == 2
    clock.time += 0.4
    grips.hear(2)
    clock.time += 0.2
    assert [holder for holder, _ in grips.held()] == [2]
    grips.take(1, "wrist", elbow())
    grips.release_all(2)
    assert [holder for holder, _ in grips.held()] == [1]


def test_impatience_without_end_is_refused():
    with pytest.raises(ValueError, match="timeout must be positive"):
        HeldGizmos(timeout=0.0)
