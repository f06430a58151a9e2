"""What a worker does who hands a thing over."""

from dataclasses import replace

import numpy as np
import pytest

from hrc_learn.sim import Worker, WorkerConfig
from hrc_learn.sim.hand_over import BACK, BENCH, HAND_OVER, HELD_OUT, RIGHT, random_hand_over
from hrc_learn.sim.worker_visit import in_worker_frame
from hrc_learn.sim.workplace import Workplace

TABLE = Workplace().scene.table
TOP = TABLE.centre[2] + TABLE.half_size[2]
EDGE = TABLE.centre[1] + TABLE.half_size[1]
THICKNESS = 0.028


def drawn(seed):
    rng = np.random.default_rng(seed)
    worker = Worker(WorkerConfig.draw(rng))
    return random_hand_over(worker, rng, bench=TABLE, thickness=THICKNESS)


def grip(plan, time):
    return plan.visit.worker.grip(plan.visit.ends_at(time), RIGHT)


@pytest.mark.parametrize("seed", range(8))
def test_lays_it_down_takes_it_up_and_holds_it_out(seed):
    plan = drawn(seed)
    kinds = [reach.kind for reach in plan.reaches]
    assert kinds == [BACK, BENCH, BACK, BENCH, BACK, HAND_OVER]
    (_, laid), (taken, _) = plan.carried
    assert plan.reaches[1].end < laid < plan.reaches[2].begin + 1e-9
    assert plan.reaches[3].end < taken < plan.reaches[4].begin + 1e-9
    # On the bench it rests where he left it, its lower side on the top.
    for time in np.linspace(laid, taken - 1e-6, 4).tolist():
        np.testing.assert_allclose(plan.object_position(time), plan.object_position(laid))
    assert plan.object_position(laid)[2] - TOP == pytest.approx(THICKNESS, abs=0.01)
    # In his hand it goes along.
    for time in (plan.visit.begin, laid, taken, plan.visit.end, plan.visit.end + 5):
        np.testing.assert_allclose(plan.object_position(time) - grip(plan, time), HELD_OUT)
    np.testing.assert_allclose(plan.object_position(plan.visit.end), plan.place, atol=0.02)
    assert 0.2 < EDGE - plan.place[1] < 0.45
    # A movement that can be watched: a dozen images of an ordinary camera.
    last = plan.reaches[-1]
    assert last.end == plan.visit.end
    assert 0.4 < last.end - last.begin < 2.5


def test_brings_it_to_the_robot_lets_go_and_leaves():
    plan = drawn(3)
    now, there = plan.visit.end + 1.0, plan.place + np.array([0.03, -0.08, 0.02])
    brought = plan.brought_to(there, now)
    # Nothing that he has done is otherwise.
    for time in np.linspace(0, now, 40).tolist():
        np.testing.assert_allclose(brought.visit.ends_at(time), plan.visit.ends_at(time))
    np.testing.assert_allclose(brought.object_position(brought.visit.end), there, atol=5e-3)
    path = np.stack(
        [
            brought.object_position(t)
            for t in np.arange(now - 0.1, brought.visit.end, 0.01).tolist()
        ]
    )
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1) / 0.01
    assert speed.max() < plan.speeds.reaching
    gone = brought.left(brought.visit.end + 2.0)
    np.testing.assert_allclose(gone.object_position(gone.visit.end + 9), there, atol=5e-3)
    there_at_last = gone.visit.posture(np.array(gone.visit.end)).place
    np.testing.assert_allclose(there_at_last, plan.leaving)
    assert gone.visit.end > brought.visit.end + 3.0


def test_may_begin_later():
    plan = drawn(1)
    later = plan.starting(10.0)
    for time in np.linspace(0, plan.visit.end + 1, 15).tolist():
        np.testing.assert_allclose(
            later.visit.ends_at(time + 10), plan.visit.ends_at(time), atol=1e-12
        )
        np.testing.assert_allclose(
            later.object_position(time + 10), plan.object_position(time), atol=1e-12
        )
    assert later.reaches[-1].end == later.visit.end


def test_nobody_holds_a_thing_out_over_a_bench_above_their_head():
    x, y, z = TABLE.centre
    high = replace(TABLE, centre=(x, y, z + 1.2))
    with pytest.raises(ValueError, match="m cannot hold anything out"):
        random_hand_over(
            Worker(WorkerConfig()), np.random.default_rng(0), bench=high, thickness=0.03
        )


def fills(values, low, high, part=0.15):
    """True if values are within a range and come near both of its ends."""
    values, slack = np.asarray(values), part * (high - low)
    inside = (values >= low - 1e-9) & (values <= high + 1e-9)
    return inside.all() and values.min() < low + slack and values.max() > high - slack


def test_handovers_vary_as_much_as_they_may():
    worker, h = Worker(WorkerConfig(stature=1.75)), 1.75
    plans = [
        random_hand_over(worker, np.random.default_rng(k), bench=TABLE, thickness=THICKNESS)
        for k in range(50)
    ]
    assert fills([plan.visit.begin for plan in plans], 1.0, 3.0)
    stand = np.array([plan.visit.poses[1, :2] for plan in plans])
    assert fills(stand[:, 0], 0.15, 0.45)
    facing = np.array([plan.visit.poses[2, 2] for plan in plans])
    assert fills(facing, -np.pi / 2 - 0.1, -np.pi / 2 + 0.1)
    place = np.array([plan.place for plan in plans])
    assert fills(EDGE - place[:, 1], 0.26, 0.42)
    assert fills(place[:, 2] - TOP, 0.24, 0.36)
    aside = place[:, 0] - stand[:, 0]
    assert (aside >= -0.22).all()
    assert (aside[place[:, 0] > 0.081] <= 0.04).all()
    assert ((place[:, 0] >= 0.08) & (place[:, 0] <= 0.42)).all()
    laid = np.array([plan.object_position(plan.carried[0][1]) for plan in plans])
    assert fills(laid[:, 0] - stand[:, 0], -0.25, 0.0)
    assert fills(EDGE - laid[:, 1], 0.10, 0.16)
    np.testing.assert_allclose(laid[:, 2], TOP + THICKNESS)
    rests, holds, leans = [], [], []
    for plan in plans:
        for before, after in zip(plan.reaches[::2], plan.reaches[1::2], strict=True):
            rests.append(after.begin - before.end)
        for down, up in zip(plan.reaches[1::2], plan.reaches[2::2], strict=False):
            holds.append(up.begin - down.end)
        (_, first), (second, last) = plan.carried
        # It is laid down and taken up as the hand leaves again.
        assert (first, second) == (plan.reaches[2].begin, plan.reaches[4].begin)
        assert last == np.inf
        leans.append(plan.visit.poses[-1, 3])
        assert plan.visit.poses[6, 3] == 0.05
        target = in_worker_frame(
            worker, plan.visit.poses[1, :2], plan.visit.poses[2, 2], plan.place - HELD_OUT
        )
        np.testing.assert_allclose(plan.visit.poses[-1, 7:], target, atol=1e-9)
        assert leans[-1] == worker.lean_to(target, RIGHT)
    assert fills(rests, 0.6, 1.5)
    assert fills(holds, 0.2, 0.5)
    assert max(leans) <= 0.45
    assert plans[0].visit.step == pytest.approx(0.4 * h)


def test_the_last_way_to_the_gripper_is_a_third_as_fast_and_leans_no_further_than_it_may():
    plan = drawn(2)
    now = plan.visit.end + 1.0
    near = plan.brought_to(plan.place + np.array([0.0, -0.05, 0.0]), now)
    begin, end = near.visit.time[-2:]
    assert begin == now
    hands = near.visit.poses[-2:, 7:]
    way = np.linalg.norm(hands[1] - hands[0])
    # A minimum-jerk motion peaks at 15/8 of its mean speed; the trunk may take longer.
    assert end - begin >= 15 / 8 * way / (0.3 * plan.speeds.reaching) - 1e-9
    assert end - begin == pytest.approx(
        max(
            15 / 8 * way / (0.3 * plan.speeds.reaching),
            15
            / 8
            * 0.47
            * plan.visit.worker.config.stature
            * abs(near.visit.poses[-1, 3] - near.visit.poses[-2, 3])
            / plan.speeds.walking,
            0.3,
        )
    )
    far = plan.brought_to(plan.place + np.array([0.0, -2.0, 0.0]), now)
    assert far.visit.poses[-1, 3] == 0.45
    gone = near.left(near.visit.end + 1.0)
    assert gone.carried[-1] == (plan.carried[-1][0], near.visit.end + 1.0)
    rows = gone.visit.poses[-3:]
    np.testing.assert_allclose(rows[0, 4:], plan.visit.worker.hanging_hands().ravel())
    assert not rows[:, 3].any()
    x, y = plan.leaving - rows[0, :2]
    assert np.cos(rows[1, 2] - np.arctan2(y, x)) == pytest.approx(1)
    assert abs(rows[1, 2] - rows[0, 2]) <= np.pi
