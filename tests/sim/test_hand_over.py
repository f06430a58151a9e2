"""What a worker does who hands a thing over."""

from dataclasses import replace

import numpy as np
import pytest

from hrc_learn.sim import Worker, WorkerConfig
from hrc_learn.sim.hand_over import BACK, BENCH, HAND_OVER, HELD_OUT, RIGHT, random_hand_over
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
        np.testing.assert_allclose(plan.thing_at(time), plan.thing_at(laid))
    assert plan.thing_at(laid)[2] - TOP == pytest.approx(THICKNESS, abs=0.01)
    # In his hand it goes along.
    for time in (plan.visit.begin, laid, taken, plan.visit.end, plan.visit.end + 5):
        np.testing.assert_allclose(plan.thing_at(time) - grip(plan, time), HELD_OUT)
    np.testing.assert_allclose(plan.thing_at(plan.visit.end), plan.place, atol=0.02)
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
    np.testing.assert_allclose(brought.thing_at(brought.visit.end), there, atol=5e-3)
    path = np.stack(
        [brought.thing_at(t) for t in np.arange(now - 0.1, brought.visit.end, 0.01).tolist()]
    )
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1) / 0.01
    assert speed.max() < plan.speeds.reaching
    gone = brought.left(brought.visit.end + 2.0)
    np.testing.assert_allclose(gone.thing_at(gone.visit.end + 9), there, atol=5e-3)
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
        np.testing.assert_allclose(later.thing_at(time + 10), plan.thing_at(time), atol=1e-12)
    assert later.reaches[-1].end == later.visit.end


def test_nobody_holds_a_thing_out_over_a_bench_above_their_head():
    x, y, z = TABLE.centre
    high = replace(TABLE, centre=(x, y, z + 1.2))
    with pytest.raises(ValueError, match="m cannot hold anything out"):
        random_hand_over(
            Worker(WorkerConfig()), np.random.default_rng(0), bench=high, thickness=0.03
        )
