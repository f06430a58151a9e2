"""A hand that is led without jumps."""

import numpy as np
import pytest

from hrc_learn.protocols import ArmState, HumanInput
from hrc_learn.teleoperation import InputFilter, InputFilterConfig

CONFIG = InputFilterConfig(linear=1.5, angular=5.0)
LED = np.array([0.25, 0.0, 0.0, 0.0, 0.4, 0.3])


class Person:
    twist = LED

    def read(self, state):
        return HumanInput(nullspace_input=np.ones(7), twist=self.twist, gripper=0.05)


def at(time):
    still = np.zeros(7)
    return ArmState(time=time, joint_position=still, joint_velocity=still, gripper_width=0.08)


def motion(person, times):
    eased = InputFilter(person, CONFIG)
    return np.stack([eased.read(at(time)).twist for time in times])


@pytest.mark.parametrize("dt", [0.001, 0.01, 0.04])
def test_speed_comes_up_at_the_rate_allowed_and_stays(dt):
    times = np.arange(0.0, 0.5, dt)
    twist = motion(Person(), times)
    linear, angular = LED[:3], LED[3:]
    ramp = np.minimum(times * CONFIG.linear / np.linalg.norm(linear), 1.0)
    np.testing.assert_allclose(twist[:, :3], ramp[:, None] * linear, atol=1e-12)
    ramp = np.minimum(times * CONFIG.angular / np.linalg.norm(angular), 1.0)
    np.testing.assert_allclose(twist[:, 3:], ramp[:, None] * angular, atol=1e-12)
    assert (twist[-1] == LED).all()  # to the last bit: nothing creeps on


def test_a_hand_that_is_let_go_comes_to_rest():
    person = Person()
    eased = InputFilter(person, CONFIG)
    for time in (0.0, 0.2):
        eased.read(at(time))
    person.twist = np.zeros(6)
    assert eased.read(at(0.21)).twist.any()
    assert not eased.read(at(0.41)).twist.any()


def test_all_else_is_handed_on_as_it_is():
    asked = InputFilter(Person()).read(at(3.0))
    assert not asked.twist.any()  # how long it has been asked for is not known yet
    np.testing.assert_array_equal(asked.nullspace_input, np.ones(7))
    assert asked.gripper == 0.05


def test_a_clock_that_is_set_back_stops_nothing_and_starts_nothing():
    eased = InputFilter(Person(), CONFIG)
    eased.read(at(5.0))
    before = eased.read(at(5.1)).twist
    np.testing.assert_array_equal(eased.read(at(0.0)).twist, before)
    assert np.linalg.norm(eased.read(at(0.05)).twist[:3]) > np.linalg.norm(before[:3])


@pytest.mark.parametrize("name", ["linear", "angular"])
def test_an_acceleration_that_is_none_is_refused(name):
    with pytest.raises(ValueError, match=f"{name} must be positive"):
        InputFilterConfig(**{name: 0.0})
