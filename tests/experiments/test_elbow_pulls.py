"""Pulls at any moment, and what is measured of them, on made-up logs."""

import numpy as np
import pytest
import torch

from hrc_learn.experiments.run_measures import Deviation, path_distance, pull_effects
from hrc_learn.geometry.numerics import null_projection
from hrc_learn.kinematics import panda
from hrc_learn.log import StepLog
from hrc_learn.teleoperation import ScriptedForce, random_pulls

TIME = 0.01 * np.arange(300)


def arc(time):
    """A goal that moves along an arc, then stops."""
    angle = np.minimum(0.5 * time, 1.0)[:, None]
    return 0.4 * np.hstack([np.cos(angle), np.sin(angle), 0 * angle])


@pytest.mark.parametrize("lag", [0, 5, 20])
def test_lagging_on_the_path_is_no_distance_from_it(lag):
    position = np.vstack([np.repeat(arc(TIME)[:1], lag, axis=0), arc(TIME)])[: len(TIME)]
    # A chord of 10 ms leaves the arc by a micrometre.
    np.testing.assert_allclose(path_distance(position, arc(TIME), TIME)[1:], 0, atol=2e-6)


def test_what_is_across_the_path_counts_and_what_overshoots_its_end_does_not():
    goal = np.column_stack([np.minimum(0.2 * TIME, 0.4), 0 * TIME, 0 * TIME])
    beside = goal + np.array([0.0, 0.003, 0.004])
    np.testing.assert_allclose(path_distance(beside, goal, TIME)[60:], 0.005, atol=1e-9)
    ahead = goal + np.outer(TIME > 1.9, [0.004, 0.0, 0.0])
    stopping = (TIME > 1.95) & (TIME < 2.4)
    np.testing.assert_allclose(path_distance(ahead, goal, TIME)[stopping], 0, atol=1e-9)


def test_where_there_is_no_path_there_is_no_distance():
    goal = arc(TIME)
    goal[100:150] = np.nan
    off = path_distance(arc(TIME), goal, TIME)
    assert np.isnan(off[100:150]).all()
    assert np.isfinite(off[151:]).all()
    held = np.zeros((300, 3))
    np.testing.assert_allclose(path_distance(held + np.array([0, 0, 0.002]), held, TIME), 0.002)
    assert np.isnan(path_distance(held[:1], np.full((1, 3), np.nan), TIME[:1])).all()


def test_a_clock_that_stalls_does_not_end_the_measurement():
    time = np.repeat(TIME[::4], 4)
    beside = arc(TIME) + np.array([0.0, 0.0, 0.003])
    np.testing.assert_allclose(path_distance(beside, arc(TIME), time), 0.003, atol=1e-5)
    assert np.isfinite(path_distance(beside, arc(TIME), np.zeros(300))).all()


def pushed_aside(planned):
    """Joints that go along their null space for a second and a half; a log of it."""
    q, log = panda.ready.clone(), StepLog()
    wanted = torch.tensor([0.5, 0.0, -0.5, 0.0, 0.4, 0.0, 0.0], dtype=torch.float64)
    hand = panda.forward(q).position.numpy()
    log.event(0.0, "home")
    log.event(1.5, "transfer")
    for t in TIME:
        d = wanted.numpy() if 0.5 <= t < 2.0 else np.zeros(7)
        if d.any():
            q = q + 0.01 * null_projection(panda.jacobian(q), wanted)
        log.append(
            time=t,
            joint_position=q.numpy(),
            nullspace_input=d,
            goal_position=hand,
            path_joints=panda.ready.numpy() if planned else np.full(7, np.nan),
        )
    return log


@pytest.mark.parametrize("planned", [True, False])
def test_the_elbow_moved_as_far_as_it_is_from_where_it_was(planned):
    log = pushed_aside(planned)
    pull = ScriptedForce(start=0.5, duration=1.5, towards=(0.0, 0.0, 0.0))
    (effect,) = pull_effects(log, [pull], panda)
    elbows = panda.link_poses(torch.from_numpy(log["joint_position"])).position[:, 3].numpy()
    home, transfer = TIME < 1.5, TIME >= 1.5
    # Without a plan it was where it was when the pull reached into each phase.
    since = elbows[50] if planned else elbows[transfer][0]
    expected = max(
        np.linalg.norm(elbows[home] - elbows[50], axis=1).max(),
        np.linalg.norm(elbows[transfer] - since, axis=1).max(),
    )
    assert expected > 0.05
    # The hand drifts by a millimetre in such steps, and what goes along with it.
    assert effect.elbow == pytest.approx(expected, abs=3e-3)
    hand = panda.forward(torch.from_numpy(log["joint_position"])).position.numpy()
    away = np.linalg.norm(hand - log["goal_position"], axis=1)
    assert effect.tool == pytest.approx(away.max(), rel=1e-6)
    # Joints pushed aside have another error at the end effector than those of the path.
    offset = np.array([2.0, -1.0, 1.5, 0.5, -2.0, 1.0, 0.0]) * 1e-2
    unseen = [
        panda.forward(torch.from_numpy(log["joint_position"]) - zero).position
        for zero in (torch.zeros(7), torch.from_numpy(offset))
    ]
    shift = (unseen[1] - unseen[0]).numpy()
    away = np.linalg.norm(hand + shift - shift[0] - log["goal_position"], axis=1)
    assert np.linalg.norm(shift - shift[0], axis=1).max() > 1e-3
    (true,) = pull_effects(log, [pull], panda, encoder_offset=offset)
    assert true.tool == pytest.approx(away[TIME >= 0.5].max(), rel=1e-3)
    assert true.elbow == effect.elbow
    # A pull that is not followed counts as well; one after the run does not.
    refused = ScriptedForce(start=2.5, duration=0.2, towards=(0.0, 0.0, 0.0))
    after = ScriptedForce(start=3.5, duration=0.2, towards=(0.0, 0.0, 0.0))
    assert len(pull_effects(log, [refused, after], panda)) == 1


@pytest.mark.parametrize("planned", [True, False])
def test_a_recording_shows_what_a_push_moves_beside_the_path(planned):
    log = pushed_aside(planned)
    shown, pushed = Deviation.from_path(log, panda), (TIME >= 0.5) & (TIME < 2.0)
    q = torch.from_numpy(log["joint_position"])
    away = np.linalg.norm(panda.forward(q).position.numpy() - log["goal_position"], axis=1)
    np.testing.assert_allclose(shown.position[pushed], away[pushed], rtol=1e-6)
    elbows = panda.link_poses(q).position[:, 3].numpy()
    aside = np.linalg.norm(elbows - elbows[0], axis=1)
    expected = aside if planned else np.full(len(TIME), np.nan)
    np.testing.assert_allclose(shown.elbow[pushed], expected[pushed], atol=1e-9)
    for values in (shown.position, shown.elbow):
        assert np.isnan(values[~pushed]).all()
    assert np.isnan(shown.rotation).all()


def test_random_pulls_come_one_after_the_other_from_all_sides():
    pulls = random_pulls(np.random.default_rng(3), 300.0)
    assert random_pulls(np.random.default_rng(3), 300.0) == pulls
    assert random_pulls(np.random.default_rng(4), 300.0) != pulls
    starts, ends = (np.array([getattr(p, n) for p in pulls]) for n in ("start", "end"))
    assert (starts[1:] - ends[:-1] >= 1.0).all()
    assert 0 <= starts[0] < 6
    assert starts[-1] > 280
    hands = np.array([pull.towards for pull in pulls])
    assert (hands.std(axis=0) > 0.1).all()


def test_a_position_between_two_goals_before_a_corner_is_on_the_path():
    """Goals a decimetre apart, along x and then along y."""
    goal = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 1, 0], [2, 2, 0]]) / 10
    position = goal.copy()
    position[-1] = [0.15, 0.0, 0.02]
    found = path_distance(position, goal, 0.02 * np.arange(5))
    np.testing.assert_allclose(found, [0, 0, 0, 0, 0.02], atol=1e-12)
