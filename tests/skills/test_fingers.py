"""Fingers that begin late and take their time, and how long an arm waits for them."""

import math
from dataclasses import replace

import pytest
from obedient_arm import ObedientArm

from hrc_learn.kinematics import panda
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.grasping import CLOSED, CLOSING_TIME, OPEN, holds, move_fingers

pytestmark = pytest.mark.simulation

ITEM = Workplace().scene.objects[0]
WIDTH = 2 * ITEM.half_size[0]


class SlowHand(ObedientArm):
    """Fingers that begin late, stop at what is between them, and may tell only where they end.

    Such is a driver whose calls return when the fingers have arrived.
    """

    def __init__(self, width, *, late=0.0, speed=0.1, between=0.0, tells_on_the_way=True):
        super().__init__(panda.ready.numpy())
        self.width = self.told = width
        self.goal, self.begin = width, math.inf
        self.late, self.speed, self.between = late, speed, between
        self.tells_on_the_way = tells_on_the_way

    def read(self):
        return replace(super().read(), gripper_width=self.told)

    def move(self, width):
        self.goal, self.begin = max(width, self.between), self.time + self.late

    @property
    def arrived(self):
        return abs(self.goal - self.width) < 1e-9

    def advance(self, duration):
        super().advance(duration)
        if self.time > self.begin:
            step = self.speed * duration
            self.width += min(max(self.goal - self.width, -step), step)
        if self.tells_on_the_way or self.arrived:
            self.told = self.width


class Cell:
    """A work cell that only lets time pass while it holds the arm still."""

    def __init__(self, hand, chain=panda):
        self.gripper, self.chain = hand, chain

    state = property(lambda self: self.gripper.read())
    time = property(lambda self: self.gripper.time)

    def hold_pose(self, duration):
        for _ in range(round(duration / 0.01)):
            self.gripper.advance(0.01)


@pytest.mark.parametrize(
    ("start", "goal", "late", "tells_on_the_way"),
    [
        (OPEN, CLOSED, 0.0, True),
        (OPEN, CLOSED, 1.5, False),
        (WIDTH, OPEN, 0.5, True),
        (WIDTH, OPEN, 0.0, False),
    ],
)
def test_the_arm_waits_until_the_fingers_have_arrived(start, goal, late, tells_on_the_way):
    between = WIDTH if goal == CLOSED else 0.0
    hand = SlowHand(start, late=late, between=between, tells_on_the_way=tells_on_the_way)
    cell = Cell(hand)
    move_fingers(cell, goal, CLOSING_TIME)
    assert hand.arrived
    assert holds(cell, ITEM) == (goal == CLOSED)
    # Two looks, 0.1 s apart each, may pass until it is clear that they rest.
    arrival = late + abs(hand.width - start) / hand.speed
    assert cell.time < max(CLOSING_TIME, arrival + 0.2) + 0.02


def test_fingers_that_are_quick_cost_no_time():
    cell = Cell(SlowHand(OPEN, between=WIDTH))
    move_fingers(cell, CLOSED, CLOSING_TIME)
    assert cell.time == pytest.approx(CLOSING_TIME)


@pytest.mark.parametrize("width", [OPEN, math.nan])
def test_nobody_waits_for_fingers_that_are_there_or_that_are_none(width):
    cell = Cell(SlowHand(width))
    move_fingers(cell, OPEN, 0.3)
    assert cell.time == pytest.approx(0.3)


def test_fingers_that_never_move_hold_nothing_and_are_given_up():
    cell = Cell(SlowHand(OPEN, late=math.inf))
    move_fingers(cell, CLOSED, CLOSING_TIME)
    # The stroke of 0.08 m at a quarter of the Franka Hand's 0.1 m/s, and then some.
    assert 3.2 < cell.time < 5.0
    assert not holds(cell, ITEM)


@pytest.mark.parametrize(
    ("width", "held"), [(0.0, False), (WIDTH, True), (0.8 * WIDTH, True), (OPEN, False)]
)
@pytest.mark.parametrize("size", [1.0, 0.7, 0.4])
def test_only_fingers_about_as_far_apart_as_the_object_is_wide_hold_it(size, width, held):
    cell = Cell(SlowHand(size * width), panda.with_hand(size))
    assert holds(cell, ITEM.scaled(size)) == held


def test_open_fingers_of_a_small_hand_are_not_expected_to_open_further():
    hand = SlowHand(0.4 * OPEN)
    cell = Cell(hand, panda.with_hand(0.4))
    move_fingers(cell, OPEN, 0.3)
    assert cell.time == pytest.approx(0.3)
    assert hand.goal == 0.4 * OPEN
