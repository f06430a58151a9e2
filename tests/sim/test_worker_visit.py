"""What the worker does: at human speeds, at the bench, each time in another way."""

import numpy as np
import pytest
import torch

from hrc_learn.kinematics.collision import segment_box_distance
from hrc_learn.sim import SceneConfig, Worker, WorkerConfig, random_visit
from hrc_learn.sim.worker import PARTS, WORKER_ITEM_HALF_SIZE
from hrc_learn.sim.worker_visit import HumanSpeeds

TABLE = SceneConfig().table
UNDER = (0.24, 0.54)
LEGS = [i for i, name in enumerate(PARTS) if name.startswith(("thigh", "shank", "foot"))]
ARMS = [i for i, name in enumerate(PARTS) if name.startswith(("upper_arm", "forearm", "hand"))]
TRUNK = [i for i in range(len(PARTS)) if i not in LEGS + ARMS]


def drawn(seed, **options):
    rng = np.random.default_rng(seed)
    worker = Worker(WorkerConfig.draw(rng))
    return random_visit(worker, rng, bench=TABLE, under=UNDER, **options)


def every(visit, dt=0.01):
    return np.arange(visit.begin - 0.5, visit.end + 0.5, dt)


@pytest.mark.parametrize("seed", range(5))
def test_he_moves_at_human_speeds(seed):
    visit = drawn(seed)
    speed = np.linalg.norm(visit.capsules_at(every(visit)).velocity, axis=-1)
    assert 0.8 < speed[:, TRUNK].max() <= HumanSpeeds().walking
    assert 0.8 < speed[:, ARMS].max() <= HumanSpeeds().reaching
    assert speed[:, LEGS].max() < 5.0  # of a foot in its swing
    still = (every(visit) < visit.begin) | (every(visit) > visit.end)
    assert speed[still].max() < 1e-3


@pytest.mark.parametrize("seed", range(2))
def test_velocities_are_those_of_the_ends(seed):
    visit = drawn(seed)
    time = every(visit, dt=1e-3)[::7]
    later, before = (visit.capsules_at(time + s).ends for s in (1e-3, -1e-3))
    velocity = visit.capsules_at(time).velocity
    np.testing.assert_allclose(velocity, (later - before) / 2e-3, atol=0.02)


def test_one_time_is_like_many():
    visit = drawn(0)
    time = every(visit)[::40]
    many = visit.capsules_at(time)
    for k, t in enumerate(time.tolist()):
        one = visit.capsules_at(t)
        np.testing.assert_allclose(one.ends, many.ends[k], atol=1e-12)
        np.testing.assert_allclose(one.velocity, many.velocity[k], atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_he_reaches_every_marker_and_leaves_what_he_brought(seed):
    visit = drawn(seed)
    ends = visit.capsules_at(every(visit)).ends
    grips = np.stack([visit.worker.grip(ends, side) for side in (0, 1)])
    assert 2 <= len(visit.markers) <= 4
    for marker in visit.markers:
        assert np.linalg.norm(grips - marker, axis=-1).min() < 1e-3
        assert np.abs(marker[:2] - UNDER).max() <= 0.22
    x, y, z = visit.item_at(visit.end)
    a, b, c = WORKER_ITEM_HALF_SIZE
    assert z - c == pytest.approx(TABLE.centre[2] + TABLE.half_size[2], abs=1e-9)
    assert abs(x - TABLE.centre[0]) + a < TABLE.half_size[0]
    assert abs(y - TABLE.centre[1]) + b < TABLE.half_size[1]
    # Not where the robot's own objects are.
    assert y - b > UNDER[1] + 0.14
    # It comes with his hand.
    early = visit.begin + 0.5
    hand = visit.worker.grip(visit.capsules_at(early).ends, visit.side)
    assert np.linalg.norm(visit.item_at(early) - hand) == pytest.approx(c)


@pytest.mark.parametrize("seed", range(5))
def test_he_comes_from_outside_and_goes_there(seed):
    visit = drawn(seed)
    place = visit.posture(np.array([visit.begin - 1, visit.end + 1])).place
    assert (place[:, 1] > TABLE.centre[1] + TABLE.half_size[1] + 1.0).all()
    assert 1.0 <= visit.begin <= 8.0
    assert 8.0 < visit.end - visit.begin < 35.0


@pytest.mark.parametrize("seed", range(3))
def test_his_body_stays_out_of_the_bench(seed):
    visit = drawn(seed)
    body = [i for i in TRUNK + LEGS if not PARTS[i].startswith("foot")]
    ends = torch.from_numpy(visit.capsules_at(every(visit)[::5]).ends[:, body])
    centre, half = torch.tensor(TABLE.centre).double(), torch.tensor(TABLE.half_size).double()
    gap = segment_box_distance(ends, centre, half).numpy() - visit.worker.radius[body]
    assert gap.min() > 0


def test_no_visit_is_like_another():
    visits = [drawn(seed) for seed in range(6)]
    ends = {round(visit.end, 3) for visit in visits}
    assert len(ends) == 6
    assert len({len(visit.markers) for visit in visits}) > 1
    assert len({visit.side for visit in visits}) == 2
    again = drawn(2)
    np.testing.assert_array_equal(again.poses, visits[2].poses)


def test_what_is_out_of_reach_is_refused():
    worker = Worker()
    with pytest.raises(ValueError, match="cannot reach"):
        random_visit(worker, np.random.default_rng(0), bench=TABLE, under=(0.2, -0.5))


def test_a_turned_visit_is_the_same_seen_from_elsewhere():
    visit, angle = drawn(4), 0.7
    turned = visit.turned(angle)
    c, s = np.cos(angle), np.sin(angle)
    about = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    time = every(visit, 0.2)
    here, there = visit.capsules_at(time), turned.capsules_at(time)
    np.testing.assert_allclose(there.ends, here.ends @ about.T, atol=1e-9)
    np.testing.assert_allclose(there.velocity, here.velocity @ about.T, atol=1e-5)
    np.testing.assert_allclose(turned.markers, visit.markers @ about.T, atol=1e-12)
    item = visit.item_at(visit.released)
    np.testing.assert_allclose(turned.item_at(visit.released), about @ item, atol=1e-9)


def test_a_hand_is_at_each_marker_as_long_as_he_reaches():
    visit = drawn(5)
    assert visit.reaches.shape == (len(visit.markers), 2)
    for marker, (begin, end) in zip(visit.markers, visit.reaches, strict=True):
        ends = visit.capsules_at(np.linspace(begin, end, 5)).ends
        hands = np.stack([visit.worker.grip(ends, side) for side in (0, 1)])
        off = np.linalg.norm(hands - marker, axis=-1).min(axis=0)
        assert off.max() < 1e-6
    assert (visit.reaches[1:, 0] > visit.reaches[:-1, 1]).all()


def test_he_reaches_only_where_he_leaves_alone_what_he_sees():
    """A wall above the bench beyond which his hands must not come."""
    wall = 0.57

    def is_clear(ends):
        return bool((ends[..., 1] > wall).all())

    touching = drawn(1).reaches
    assert not is_clear(drawn(1).capsules_at(touching.mean(axis=1)).ends)
    careful = drawn(1, is_clear=is_clear)
    assert is_clear(careful.capsules_at(careful.reaches.mean(axis=1)).ends)
    with pytest.raises(ValueError, match="cannot reach"):
        drawn(1, is_clear=lambda ends: False)
