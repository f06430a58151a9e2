"""The memory between the loop of a Franka arm and who commands it, and its settings."""

import math
import multiprocessing
import time
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import pytest
from unchecked import shapes_unchecked

from hrc_learn.hardware import CollisionConfig, FrankaConfig, FrankyConfig, Load
from hrc_learn.hardware.franka_loop import Punctuality, answer_was_lost
from hrc_learn.hardware.franka_memory import Mailbox, Numbers, Orders, Phase, Report, Shared

LONG = 50_000
"""Numbers that take so long to copy that writer and reader meet."""


@dataclass
class Long(Numbers):
    values: np.ndarray = field(default_factory=lambda: np.zeros(LONG))


def write_lines(mailbox: Mailbox, seconds: float) -> None:
    end, k = time.monotonic() + seconds, 0
    while time.monotonic() < end:
        k += 1
        mailbox.write(Long(np.full(LONG, float(k))))
        time.sleep(1e-4)


def test_a_line_is_read_whole_while_another_process_writes():
    mailbox = Mailbox(Long())
    writer = multiprocessing.get_context("fork").Process(
        target=write_lines, args=(mailbox, 0.3)
    )
    writer.start()
    seen = set()
    while writer.is_alive():
        line = mailbox.read()
        assert np.ptp(line.values) == 0, "half of one line, half of another"
        seen.add(line.values[0])
    writer.join()
    assert len(seen) > 10


def test_a_line_is_read_while_its_writer_is_suspended_in_the_middle_of_the_next():
    mailbox = Mailbox(Long(np.full(LONG, 1.0)))
    newest = int(mailbox._written[0]) % 2
    mailbox._lines[1 - newest, : LONG // 2] = 7.0  # as after half of a line
    np.testing.assert_array_equal(mailbox.read().values, np.full(LONG, 1.0))
    mailbox.write(Long(np.full(LONG, 2.0)))
    np.testing.assert_array_equal(mailbox.read().values, np.full(LONG, 2.0))


def test_orders_and_reports_come_out_as_they_went_in():
    rng = np.random.default_rng(0)
    orders = Orders(12.5, True, 3, True, rng.normal(size=7))
    report = Report(
        phase=Phase.RECOVERING,
        stamp=1.5,
        time=2.5,
        recoveries=3,
        faults=4,
        cycles=5,
        lost=6,
        cost=1e-4,
        resting=False,
        joint_position=rng.normal(size=7),
        joint_velocity=rng.normal(size=7),
        external_torque=rng.normal(size=7),
    )
    for said in (orders, report):
        again = type(said).of(said.line())
        assert vars(again).keys() == vars(said).keys()
        for name, value in vars(said).items():
            np.testing.assert_array_equal(getattr(again, name), value, err_msg=name)


def test_a_message_of_any_length_arrives():
    shared = Shared()
    assert shared.message == ""
    shared.message = "the stop button is pressed"
    assert shared.message == "the stop button is pressed"
    shared.message = "x" * 10_000
    assert set(shared.message) == {"x"}
    assert len(shared.message) == 1999  # and its end
    shared.message = 999 * "ä"  # two bytes each
    assert shared.message == 999 * "ä"


class TestLostAnswers:
    """The box had a velocity v and an acceleration a; v + d was the last answer."""

    v, a = np.full(7, 0.3), np.full(7, 4.0)
    d = 1e-3 * a + 1.5e-3
    still, nothing = np.zeros(7), np.full(7, np.nan)

    def test_an_answer_that_came_back_was_not_lost(self):
        single = (self.v + self.d).astype(np.float32).astype(float)
        assert not answer_was_lost(single, self.a, self.v, self.v + self.d)

    def test_a_box_that_went_on_by_itself_has_lost_it(self):
        assert answer_was_lost(self.v + 1e-3 * self.a, self.a, self.v, self.v + self.d)
        assert answer_was_lost(self.v, self.still, self.v, self.v + self.d)

    def test_a_report_from_before_the_answer_says_nothing(self):
        assert not answer_was_lost(self.v, self.a, self.v, self.v + self.d)

    def test_one_joint_is_enough(self):
        one = np.eye(7)[3]
        assert answer_was_lost(self.v + 1e-7, self.a, self.v, self.v + 1e-4 * one)
        assert not answer_was_lost(self.v, 4.0 * one, self.v, self.v + self.d)

    def test_a_motion_begins_with_what_the_box_has(self):
        assert answer_was_lost(self.v, self.a, self.nothing, self.nothing)

    def test_nothing_is_begun_with_no_number(self):
        assert not answer_was_lost(self.nothing, self.a, self.v, self.v)
        assert not answer_was_lost(self.nothing, self.a, self.nothing, self.nothing)
        one = np.where(np.arange(7) == 3, np.nan, self.v)
        assert not answer_was_lost(one, self.a, self.v, self.v + self.d)


class TestPunctuality:
    def test_a_loop_in_time_answers_each_cycle(self):
        punctuality = Punctuality()
        # Now and then one comes late and the next early, or a state is lost.
        moments = [0.0, 1.0, 2.4, 3.0, 5.0, 6.9, 7.1]
        periods = [1, 1, 1, 1, 2, 1, 1]
        for moment, period in zip(moments, periods, strict=True):
            assert not punctuality.late(1e-3 * moment, 1e-3 * period)

    def test_a_state_that_was_found_after_a_stall_is_not_answered_but_the_newest_is(self):
        punctuality = Punctuality()
        for k in range(10):
            assert not punctuality.late(1e-3 * k, 1e-3)
        assert punctuality.late(19e-3, 1e-3)
        assert not punctuality.late(19.3e-3, 9e-3)
        assert not punctuality.late(20e-3, 1e-3)

    def test_an_answer_that_has_taken_longer_than_a_cycle_is_not_given(self):
        punctuality = Punctuality()
        for k in range(3):
            assert not punctuality.late(1e-3 * k, 1e-3)
            assert not punctuality.overdue(0.9e-3)
        assert punctuality.overdue(1.1e-3)
        # But the next is, so that the robot goes on.
        assert not punctuality.late(7e-3, 1e-3)
        assert not punctuality.overdue(0.2e-3)

    def test_a_machine_too_slow_for_each_cycle_answers_every_second_one(self):
        punctuality = Punctuality()
        answered = []
        for k in range(100):
            late = punctuality.late(2e-3 * k, 2e-3)
            answered.append(not late and not punctuality.overdue(1.3e-3))
        assert not any(first == second for first, second in pairwise(answered))

    def test_a_robot_that_is_slower_than_its_clock_is_answered(self):
        punctuality = Punctuality()
        late = [punctuality.late(2.5e-3 * k, 1e-3) for k in range(300)]
        assert not any(first and second for first, second in pairwise(late))
        assert not any(late[60:])
        # Held up for 5 ms more, it is late all the same.
        assert punctuality.late(2.5e-3 * 300 + 5e-3, 1e-3)

    def test_a_simulator_that_waits_is_answered_however_late(self):
        punctuality = Punctuality(lockstep=True)
        for moment in (0.0, 1e-3, 19e-3, 2.0):
            assert not punctuality.late(moment, 1e-3)
            assert not punctuality.overdue(1.1e-3)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FrankaConfig(timeout=0.0), "timeout must be positive"),
        (lambda: FrankaConfig(timeout=np.inf), "timeout must be finite"),
        (lambda: FrankaConfig(dynamics=1.1), "dynamics must be in"),
        (lambda: FrankaConfig(dynamics=0.0), "dynamics must be in"),
        (lambda: FrankaConfig(grip_force=-1.0), "grip_force must be positive"),
        (lambda: FrankaConfig(grip_speed=np.nan), "grip_speed must be positive"),
        (lambda: FrankyConfig(timeout=0.0), "timeout must be positive"),
        (lambda: Load(far_end=(0.0, np.nan, 0.0)), "far_end must be finite"),
        (lambda: Load(mass=np.inf), "mass must be finite"),
        (lambda: CollisionConfig(torque=(20.0,) * 6), "torque of a collision must be 7"),
        (lambda: CollisionConfig(force=(0.0,) * 6), "force of a collision must be 6 positive"),
        (lambda: Load(mass=-0.1), "mass must not be negative"),
        (lambda: Load(centre=(0.0, 0.0, float("inf"))), "centre must be finite"),
        (
            lambda: Load(inertia=((1.0, 0.0, 0.0), (0.1, 1.0, 0.0), (0.0, 0.0, 1.0))),
            "symmetric matrix",
        ),
        (
            lambda: Load(inertia=((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))),
            "not be negative about",
        ),
        (lambda: Load(inertia=((1.0, 0.0), (0.0, 1.0))), "3 by 3"),
    ],
)
def test_settings_that_make_no_sense_are_refused(make, message):
    with shapes_unchecked(), pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(("off", "refused"), [(0.9e-9, False), (1.1e-9, True)])
def test_an_inertia_is_symmetric_to_nine_digits(off, refused):
    tensor = ((1.0, 0.1, 0.0), (0.1 * (1 + off), 1.0, 0.0), (0.0, 0.0, 1.0))
    if refused:
        with pytest.raises(ValueError, match="symmetric matrix"):
            Load(inertia=tensor)
    else:
        Load(inertia=tensor)


class CountsAtEachLook(list):
    def __getitem__(self, k):
        return self.pop(0)


def test_a_line_that_is_replaced_while_it_is_read_is_read_again():
    mailbox = Mailbox(Orders(stamp=1.0))
    mailbox.write(Orders(stamp=2.0))
    assert mailbox.read().stamp == 2.0
    # The writer has counted the second line while the first one was being copied.
    mailbox._written = CountsAtEachLook([1.0, 2.0, 2.0, 2.0])
    assert mailbox.read().stamp == 2.0


def test_settings_at_their_ends_are_taken():
    FrankaConfig(dynamics=1.0)
    rod = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.0))  # without a width
    assert Load(mass=0.0, inertia=rod, far_end=(0.0, 0.0, 0.3)).centre == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("cost", [0.9e-3, 1e-3])
def test_an_answer_within_a_cycle_is_given(cost):
    punctuality = Punctuality()
    punctuality.late(0.0, 1e-3)
    assert not punctuality.overdue(cost)
    assert punctuality.overdue(1.000001e-3)


@pytest.mark.parametrize(("moment", "late"), [(2e-3, False), (2.000001e-3, True)])
def test_a_state_is_late_a_cycle_after_its_period(moment, late):
    punctuality = Punctuality()
    assert not punctuality.late(0.0, 1e-3)
    assert punctuality.late(moment, 1e-3) == late


@pytest.mark.parametrize("period", [0.0, -1e-3])
def test_a_state_without_a_period_is_not_judged(period):
    punctuality = Punctuality()
    assert not punctuality.late(0.0, period)
    assert not punctuality.late(0.5, period)
    assert not punctuality.late(0.501, 1e-3)
    assert punctuality.overdue(1.001e-3)  # nothing was learned of the pace


@pytest.mark.parametrize(("slowness", "learned"), [(0.5, 1.0), (2.5, 2.5), (10.0, 4.0)])
@pytest.mark.parametrize("cycles", [40, 300])
def test_the_pace_of_a_slow_robot_is_learned_by_two_percent_a_cycle(slowness, learned, cycles):
    punctuality = Punctuality()
    for k in range(cycles + 1):
        punctuality.late(1e-3 * slowness * k, 1e-3)
    pace = 1e-3 * (1 + (learned - 1) * (1 - 0.98**cycles))
    while punctuality.late(math.nan, 0.0) or punctuality.overdue(0.0):
        pass  # of two in a row one is answered
    assert not punctuality.overdue(pace * (1 - 1e-9))
    assert punctuality.overdue(pace * (1 + 1e-9))


def test_a_velocity_that_differs_by_single_precision_came_back():
    v, one = np.full(7, 0.3), np.eye(7)[2]
    for off, lost in ((0.99e-5, False), (1.01e-5, True)):
        assert answer_was_lost(v + off * one, np.zeros(7), v - 1, v) == lost
        assert answer_was_lost(v - off * one, np.zeros(7), v - 1, v) == lost
    # The report of before again, by an acceleration that would be seen in a cycle.
    for off, lost in ((0.5e-9, False), (2e-9, True)):
        assert answer_was_lost(v, 4.0 * one, v - off * one, v + 0.1) == lost
    for acceleration, lost in ((0.0101, False), (-0.0101, False), (0.0099, True)):
        assert answer_was_lost(v, acceleration * one, v, v + 0.1) == lost
