"""Taking a thing from a person's hand, whose motion says when and where."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from unchecked import shapes_unchecked

from hrc_learn.dmp import InteractionPrimitive
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import gripper_down, panda
from hrc_learn.protocols import PersonObservation
from hrc_learn.sim import ObjectConfig
from hrc_learn.skills.receiving import MovementWatch, Receiving, ReceivingConfig, _eased
from hrc_learn.skills.work_cell import MissedGraspError

pytestmark = pytest.mark.simulation

PARTS = ("pelvis", "hand_right")
RATE, REST = 30.0, np.array([0.2, 0.8, 0.1])
BESIDE = np.array([0.0, 0.15, 0.1])
"""Of the person's hand from the robot's, at a hand-over."""
START = torch.tensor([0.3, 0.3, 0.4], dtype=torch.float64)
ITEM = ObjectConfig(half_size=(0.02, 0.03, 0.03))
ELSEWHERE = np.array([0.1, 0.75, -0.25])


def quintic(u):
    u = np.clip(u, 0, 1)
    return u**3 * (10 - 15 * u + 6 * u**2)


def hand_at(time, moves):
    """Rests, then goes from one place to the next: moves are (begin, duration, place)."""
    place = REST
    for begin, duration, to in moves:
        place = place + quintic((time - begin) / duration) * (to - place)
    return place


def seen(time, hand, body=(0.0, 1.1, 0.0)):
    ends = np.stack([np.stack([np.asarray(body)] * 2), np.stack([hand - 0.05, hand + 0.05])])
    return PersonObservation(
        time=time, ends=ends, radius=np.full(2, 0.05), velocity=np.zeros_like(ends)
    )


def place(rng):
    return np.array([0.25, 0.45, 0.3]) + rng.uniform(-0.1, 0.1, 3)


@pytest.fixture(scope="module")
@shapes_unchecked()
def model():
    rng, shown = np.random.default_rng(0), []
    for k in range(24):
        met, s = place(rng), np.linspace(0, 1, 30)
        duration, handed = rng.uniform(0.8, 1.4), k % 2 == 0
        goal = met + BESIDE if handed else ELSEWHERE + rng.normal(0, 0.03, 3)
        hand = REST + quintic(s)[:, None] * (goal - REST)
        robot = START.numpy() + quintic(s)[:, None] * (met - START.numpy()) * handed
        shown.append((duration * s, hand, robot, "hand over" if handed else "elsewhere"))
    time, hand, robot, kinds = zip(*shown, strict=True)
    columns = ([torch.from_numpy(x) for x in one] for one in (time, hand, robot))
    return InteractionPrimitive.fit(
        next(columns), next(columns), next(columns), kinds, n_basis=5
    )


class Cell:
    """An arm that is at once where it is told, and a gripper that closes on what is there."""

    def __init__(self, moves, brings=True):
        self.config, self.chain = SimpleNamespace(dt=0.02), panda
        self.time, self.load, self.closed, self.path = 0.0, None, [], []
        self.pose = Pose(START.clone(), gripper_down())
        self.gripper = SimpleNamespace(move=self._grip)
        self._moves, self._brings = list(moves), brings
        self._width = 0.08

    @property
    def state(self):
        return SimpleNamespace(gripper_width=self._width)

    def _grip(self, width):
        if width == 0:
            self.closed.append(self.time)
        there = np.linalg.norm(self.hand() - BESIDE - self.pose.position.numpy()) < 0.02
        self._width = 0.04 if width == 0 and there else width

    def hand(self):
        return hand_at(self.time, self._moves)

    def read(self):
        return seen(np.floor(self.time * RATE) / RATE, self.hand())

    def track_pose(self, goal, twist):
        before, self.pose = self.pose, goal
        self.path.append(goal.position.numpy())
        self.time += self.config.dt
        still = torch.equal(before.position, goal.position)
        over = self.time > self._moves[-1][0] + self._moves[-1][1] + 1.5
        if self._brings and still and over:
            # The thing comes on to the robot's hand.
            to = self.pose.position.numpy() + BESIDE
            self._moves.append((self.time, 0.8, to))
            self._brings = False

    def hold_pose(self, duration):
        for _ in range(round(duration / self.config.dt)):
            self.track_pose(self.pose, None)


def receiving(cell, model, **config):
    with shapes_unchecked():
        return Receiving(cell, cell, model, PARTS, cell.pose, ReceivingConfig(**config))


@shapes_unchecked()
@pytest.mark.long
def test_passes_over_another_movement_and_meets_the_hand(model):
    met = np.array([0.3, 0.4, 0.33])
    moves = [(1.0, 1.0, ELSEWHERE), (3.0, 1.0, REST), (5.0, 1.1, met + BESIDE)]
    cell = Cell(moves)
    receipt = receiving(cell, model).receive(ITEM)
    assert receipt.passed_over >= 1
    # Before half of the movement had passed, and not before it had begun.
    assert 5.0 < receipt.recognised < 5.0 + 0.8
    assert np.linalg.norm(cell.pose.position.numpy() - met) < 0.03
    # On the way it keeps the limits of speed and acceleration, and uses them.
    config, dt = ReceivingConfig(), cell.config.dt
    velocity = np.diff(cell.path, axis=0) / dt
    speed = np.linalg.norm(velocity, axis=1).max()
    acceleration = np.linalg.norm(np.diff(velocity, axis=0), axis=1).max() / dt
    assert 0.1 < speed < config.speed
    assert acceleration == pytest.approx(config.acceleration)
    assert receipt.attempts == 1
    assert cell.closed == [pytest.approx(receipt.taken - 0.7)]
    assert cell.load is not None


def test_two_images_in_a_row_make_a_hand_over_certain_and_twice_its_duration_is_seen(model):
    certain, duration, observed = [True, False, True, True], 0.6, []

    class Told:
        kinds = model.kinds

        def observe(self, times, *others):
            observed.append(times[-1])
            sure = certain[min(len(observed), len(certain)) - 1]
            # A probability that equals the required one is not above it.
            handed = 1.0 if sure else ReceivingConfig().certainty
            each = [handed if kind == "hand over" else 1 - handed for kind in self.kinds]
            estimate = model.observe(times, *others)
            probability = torch.tensor(each, dtype=torch.float64)
            return replace(estimate, probability=probability, duration=duration)

    class Wandering(Cell):
        """A hand that never rests."""

        def hand(self):
            return REST + max(self.time - 1.0, 0.0) * np.array([0.2, -0.2, 0.2])

    taker = receiving(Wandering([(0.0, 0.1, REST)], brings=False), Told(), timeout=3.0)
    with pytest.raises(MissedGraspError):
        taker.receive(ITEM)
    receipt = taker.receipt
    assert receipt.seen - receipt.set_off == pytest.approx(observed[3])
    assert receipt.passed_over == 0
    last = receipt.set_off + observed[-1]
    assert last == pytest.approx(receipt.seen + 2 * duration, abs=2 / RATE)


@shapes_unchecked()
def test_closes_on_nothing_as_often_as_told(model):
    met = np.array([0.2, 0.5, 0.25])
    cell = Cell([(1.0, 1.0, met + BESIDE)])
    cell._grip = lambda width: cell.closed.append(cell.time) if width == 0 else None
    cell.gripper.move, cell._width = cell._grip, 0.0
    taker = receiving(cell, model, attempts=2)
    with pytest.raises(MissedGraspError, match="closed on nothing"):
        taker.receive(ITEM)
    assert len(cell.closed) == taker.receipt.attempts == 2
    # The next hand-over has a record of its own.
    before = taker.receipt
    with pytest.raises(MissedGraspError, match="no hand-over"):
        taker.receive(ITEM)
    assert taker.receipt.attempts == 0
    assert before.attempts == 2


@shapes_unchecked()
def test_nobody_hands_anything_over(model):
    cell = Cell([(1.0, 1.0, ELSEWHERE)], brings=False)
    with pytest.raises(MissedGraspError, match="no hand-over"):
        receiving(cell, model, timeout=4.0).receive(ITEM)
    assert cell.time == pytest.approx(4.0, abs=0.05)
    assert torch.equal(cell.pose.position, START)
    assert cell.closed == []


@shapes_unchecked()
def test_waits_no_longer_than_it_is_told_for_the_hand(model):
    met = np.array([0.2, 0.5, 0.25])
    cell = Cell([(1.0, 1.0, met + BESIDE), (2.5, 1.0, REST)], brings=False)
    with pytest.raises(MissedGraspError, match="did not reach"):
        receiving(cell, model, timeout=8.0).receive(ITEM)
    assert np.linalg.norm(cell.pose.position.numpy() - met) < 0.05


def test_movements_are_cut_from_rest_to_rest_of_a_body_that_stands():
    watch = MovementWatch(ReceivingConfig(), 0, 1)
    rng = np.random.default_rng(1)
    moving = []
    for time in np.arange(0, 8, 1 / RATE):
        hand = hand_at(time, [(2.0, 1.0, REST + np.array([0.4, 0, 0]))])
        # From 5 s on all of them walks.
        way = np.array([max(time - 5.0, 0.0), 0.0, 0.0])
        noise = rng.normal(0, 0.007, 3)
        if watch.see(seen(time, hand + way + noise, np.array([0, 1.1, 0]) + way)):
            moving.append(time)
            assert watch.times[-1] == time
            assert len(watch.times) == len(watch.hand)
    # Seen once it has gone some way, and until its last images are a window old.
    assert 2.0 < moving[0] < 2.45
    assert 2.8 < moving[-1] < 3.4
    assert np.ptp(np.diff(moving)) < 1e-9
    assert watch.times == []


def test_a_movement_ends_where_images_are_missing():
    watch = MovementWatch(ReceivingConfig(), 0, 1)
    moves = [(0.5, 1.0, REST + np.array([0.4, 0, 0])), (4.5, 1.0, REST)]
    for begin in (0.0, 4.0):
        for time in begin + np.arange(30) / RATE:
            moving = watch.see(seen(time, hand_at(time, moves)))
            assert moving == bool(watch.times)
        assert begin + 0.2 < watch.times[0] < watch.times[-1] == time


@pytest.mark.parametrize("images", [4, 5])
@pytest.mark.parametrize(
    ("hand", "body", "moves"),
    [(1.02, 0.0, True), (0.98, 0.0, False), (3.0, 0.98, True), (3.0, 1.02, False)],
)
def test_a_displacement_is_twice_that_of_the_mean_of_half_the_images(images, hand, body, moves):
    """The middle one of an odd number of images counts in neither half."""
    config = ReceivingConfig()
    watch, along = MovementWatch(config, 0, 1), np.array([0.0, 0.0, config.motion_threshold])
    steps = np.arange(images)
    shift = np.where(2 * steps == images - 1, 0.9, 0.5 * (2 * steps > images - 1))
    for time, part in zip(config.window * steps / (images - 1), shift, strict=True):
        seen_now = seen(time, REST + part * hand * along, REST + part * body * along)
        moving = watch.see(seen_now)
    assert moving == moves


@pytest.mark.parametrize("leaves", [True, False])
def test_arm_waits_until_hand_is_away_but_not_for_ever(model, leaves):
    near = START.numpy() + BESIDE
    moves = [(-1.0, 0.5, near), (1.0, 1.0, near + np.array([0.5, 0.0, 0.0]) * leaves)]
    cell = Cell(moves, brings=False)
    receiving(cell, model).wait_until_away(distance=0.25, longest=3.0)
    if leaves:
        times = np.arange(0.0, 3.0, 0.001)
        apart = [np.linalg.norm(hand_at(t, moves) - START.numpy()) for t in times]
        gone = times[np.argmax(np.array(apart) > 0.25)]
        assert gone <= cell.time < gone + 1 / RATE + 2 * cell.config.dt
    else:
        assert cell.time == pytest.approx(3.0, abs=1e-6)


def test_command_waits_for_an_arm_that_lags_behind(model):
    class SlowCell(Cell):
        lag = 0.0

        def track_pose(self, goal, twist):
            before = self.pose.position
            ahead = goal.position - before
            self.lag = max(self.lag, float(ahead.norm()))
            step = 0.05 * self.config.dt / max(float(ahead.norm()), 1e-9)
            position = before + min(step, 1.0) * ahead
            super().track_pose(Pose(position, goal.orientation), twist)

    cell = SlowCell([(1.0, 1.0, np.array([0.3, 0.4, 0.33]) + BESIDE)], brings=False)
    receiving(cell, model).receive(ITEM)
    # 4 cm, and what one step adds at 0.5 m/s.
    assert 0.03 < cell.lag < 0.04 + 0.5 * cell.config.dt + 1e-3


TOWARDS = torch.tensor([2.0, -1.0, 2.0], dtype=torch.float64) / 3


@pytest.mark.parametrize(
    ("distance", "speed"),
    [
        (1.0, 0.5),  # the speed asked for
        (0.2601, 0.5),
        (0.16, 0.4),  # slow enough to stop: v^2 = a d
        (0.04, 0.2),
        (0.0025, 0.025),  # a fifth of the distance in each step of 20 ms
        (0.0, 0.0),
    ],
)
def test_the_hand_nears_its_goal_at_a_speed_at_which_it_can_stop(distance, speed):
    config, dt = ReceivingConfig(acceleration=1.0), 0.02
    at, zero = torch.tensor([0.3, -0.2, 0.4], dtype=torch.float64), torch.zeros(3).double()
    goal = at + distance * TOWARDS
    expected = speed * TOWARDS
    kept = _eased(at, expected, goal, 0.5, config, dt)
    torch.testing.assert_close(kept, expected, atol=1e-9, rtol=0)
    # From rest or from another direction, the change is that of the acceleration at most.
    for velocity in (zero, 0.3 * TOWARDS.flip(0)):
        change, wanted = _eased(at, velocity, goal, 0.5, config, dt) - velocity, expected
        size = float((wanted - velocity).norm())
        asked = (wanted - velocity) * min(1.0, 0.02 / max(size, 1e-300))
        torch.testing.assert_close(change, asked, atol=1e-9, rtol=0)


def test_the_hand_comes_to_rest_at_its_goal():
    config, dt = ReceivingConfig(acceleration=0.8), 0.02
    at, velocity = torch.zeros(3).double(), torch.zeros(3).double()
    speeds, goal = [], 0.4 * TOWARDS
    for _ in range(150):
        velocity = _eased(at, velocity, goal, 0.3, config, dt)
        at = at + dt * velocity
        speeds.append(float(velocity.norm()))
        assert at @ TOWARDS < 0.4 + 2e-3
        assert float((at - (at @ TOWARDS) * TOWARDS).norm()) < 1e-12
    assert max(speeds) == pytest.approx(0.3, abs=0.02)
    assert np.abs(np.diff(speeds)).max() <= 0.8 * dt + 1e-12
    assert float((at - goal).norm()) < 1e-4
    assert speeds[-1] < 1e-3


@pytest.mark.parametrize(
    ("away", "sway", "rests"),
    [
        (0.0, 0.0, True),
        (0.089, 0.0, True),
        (0.091, 0.0, False),
        (0.0, 0.044, True),
        (0.0, 0.046, False),
        (0.05, 0.04, True),
    ],
)
def test_fingers_close_once_a_hand_rests_about_its_place(model, away, sway, rests):
    """By images each eighth of a second: half a second of them has five."""
    cell = Cell([(-1.0, 0.5, REST)], brings=False)
    cell.time = 4.0
    offset = np.array([0.1, 0.2, -0.1])
    middle = START.numpy() + offset + away * np.array([0.6, 0.0, 0.8])
    shown = []

    def read():
        k = int(cell.time * 8 + 1e-9)
        # Every other image to one side and to the other, by the same distance.
        side = (0.0 if k == 32 else 1.0) * sway * (1 if k % 2 else -1)
        shown.append(k / 8)
        return seen(k / 8, middle + np.array([0.0, side, 0.0]))

    cell.read = read
    taker = receiving(cell, model, near=0.09, still=0.5)
    if rests:
        taker._await_hand(offset, 7.0)
        assert shown[-1] == 4.5
        assert torch.equal(cell.pose.position, START)
    else:
        with pytest.raises(MissedGraspError, match="did not reach the gripper"):
            taker._await_hand(offset, 7.0)
        assert 7.0 <= cell.time < 7.05
