"""What the worker does: at human speeds, at the bench, each time in another way."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hrc_learn.kinematics.collision import segment_box_distance
from hrc_learn.sim import SceneConfig, Worker, WorkerConfig, random_visit
from hrc_learn.sim.worker import PARTS, WORKER_ITEM_HALF_SIZE
from hrc_learn.sim.worker_visit import (
    BenchScript,
    HumanSpeeds,
    PoseWriter,
    WorkerPose,
    WorkerVisit,
    direction,
    in_worker_frame,
    nearest_turn,
)

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


def handmade(*rows, time=(1.0, 3.0), step=0.7):
    """A visit of a few key postures: place, heading, lean and hands."""
    return WorkerVisit(
        worker=Worker(),
        time=np.array(time),
        poses=np.array(rows, dtype=float),
        step=step,
        side=0,
        released=np.inf,
        markers=np.empty((0, 3)),
        reaches=np.empty((0, 2)),
    )


HANDS = (0.2, 0.3, 0.9, 0.1, -0.3, 0.8)


@pytest.mark.parametrize(("length", "steps"), [(2.0, 3), (0.3, 1), (0.95, 1), (1.1, 2)])
def test_a_walk_is_a_minimum_jerk_motion_in_whole_steps(length, steps):
    visit = handmade((0.5, 1, 0.2, 0.1, *HANDS), (0.5, 1 - length, 0.2, 0.3, *HANDS))
    u = np.array([-0.3, 0.0, 0.2, 0.5, 0.7, 1.0, 1.2])
    posture = visit.posture(1.0 + 2.0 * u)
    inside = u.clip(0, 1)
    along = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
    slope = along.deriv()(inside) / along.deriv()(0.5)
    along = along(inside)
    np.testing.assert_allclose(posture.place[:, 1], 1 - length * along, atol=1e-12)
    np.testing.assert_allclose(posture.place[:, 0], 0.5)
    np.testing.assert_allclose(posture.lean, 0.1 + 0.2 * along, atol=1e-12)
    np.testing.assert_allclose(posture.heading, 0.2, atol=1e-12)
    # Steps grow with the speed, and are shorter on a way shorter than a step.
    size = slope * min(length / 0.7, 1.0)
    phase = np.pi * steps * along
    stride = size * 0.35 * np.sin(phase)
    np.testing.assert_allclose(posture.stride, stride, atol=1e-12)
    swing = size * np.cos(phase) * np.abs(np.cos(phase))
    np.testing.assert_allclose(posture.swing, swing, atol=1e-12)
    # The arm of the foot that is behind swings forward.
    expected = np.tile(np.reshape(HANDS, (2, 3)), (7, 1, 1))
    expected[:, 0, 0] -= 0.15 * stride
    expected[:, 1, 0] += 0.15 * stride
    np.testing.assert_allclose(posture.hands, expected, atol=1e-12)
    one = visit.posture(np.array(1.4))
    assert one.place.shape == (2,)
    np.testing.assert_allclose(one.stride, stride[2], atol=1e-12)


def test_who_turns_on_the_spot_lifts_the_feet_by_the_angle():
    for angle, lift in ((0.4, 0.4), (-0.4, 0.4), (2.5, 1.0)):
        row = (0.5, 1, 0.2, 0.0, *HANDS)
        visit = handmade(row, (0.5, 1, 0.2 + angle, 0.0, *HANDS))
        posture = visit.posture(np.array([1.5, 2.0]))
        assert not posture.stride.any()
        u = 0.25
        phase = np.pi * np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])(u)
        expected = 16 * u**2 * (1 - u) ** 2 * lift * np.cos(phase) ** 2
        np.testing.assert_allclose(posture.swing, (expected, 0.0), atol=1e-12)
        np.testing.assert_allclose(posture.heading[1], 0.2 + angle / 2)


def test_key_postures_follow_each_other():
    rows = [(x, 0, x, 0.1 * x, *HANDS) for x in (0.0, 1.0, 3.0)]
    visit = handmade(*rows, time=(0.0, 1.0, 4.0))
    posture = visit.posture(np.array([0.0, 0.5, 1.0, 2.5, 4.0, 9.0]))
    np.testing.assert_allclose(posture.place[:, 0], (0, 0.5, 1, 2, 3, 3), atol=1e-12)
    np.testing.assert_allclose(posture.lean, (0, 0.05, 0.1, 0.2, 0.3, 0.3), atol=1e-12)
    assert (visit.begin, visit.end) == (0.0, 4.0)


START = WorkerPose(np.array([0.0, 1.0]), 0.3, 0.1, np.reshape(HANDS, (2, 3)))
SPEEDS = HumanSpeeds(walking=1.2, reaching=1.5, turning=2.0)


@pytest.mark.parametrize(
    ("changes", "seconds"),
    [
        ({"place": np.array([3.0, -3.0])}, 5 / 1.2),
        ({"heading": -1.7}, 1.0),
        # The head is 0.47 of the stature above the hips.
        ({"lean": 0.7}, 0.6 * 0.47 * 1.6 / 1.2),
        ({"hands": np.add(START.hands, [[0.3, 0.4, 0], [0, 0, 0.2]])}, 0.5 / 1.5),
        ({"heading": 1.3, "place": np.array([0.0, 4.0])}, 3 / 1.2),
    ],
)
def test_a_movement_takes_as_long_as_its_fastest_part_allows(changes, seconds):
    """A minimum-jerk motion peaks at 15/8 of its mean speed."""
    writer = PoseWriter(START, 2.0, SPEEDS, 1.6)
    writer.go(**changes)
    assert writer.times == pytest.approx([2.0, 2.0 + 15 / 8 * seconds])
    expected = START._replace(**changes)
    np.testing.assert_allclose(
        writer.rows[1],
        [*expected.place, expected.heading, expected.lean, *expected.hands.ravel()],
    )
    writer.wait(0.4)
    assert writer.times[2] - writer.times[1] == pytest.approx(0.4)
    np.testing.assert_array_equal(writer.rows[2], writer.rows[1])
    writer.go(lean=expected.lean + 1e-3)
    assert writer.times[3] - writer.times[2] == pytest.approx(0.3)


def fills(values, low, high, part=0.15):
    """True if values are within a range and come near both of its ends."""
    values, slack = np.asarray(values), part * (high - low)
    inside = (values >= low - 1e-9) & (values <= high + 1e-9)
    return inside.all() and values.min() < low + slack and values.max() > high - slack


def test_speeds_of_a_visit_are_parts_of_the_largest():
    rng, most = np.random.default_rng(0), HumanSpeeds()
    drawn = [most.drawn(rng) for _ in range(200)]
    assert fills([one.walking for one in drawn], 0.96, 1.44)
    assert fills([one.reaching for one in drawn], 1.0, 1.7)
    assert fills([one.turning for one in drawn], 1.5, 2.375)


@pytest.fixture(scope="module")
def many():
    """Visits of one worker to one place, by many seeds."""
    worker = Worker(WorkerConfig(stature=1.75))
    return [
        random_visit(worker, np.random.default_rng(seed), bench=TABLE, under=UNDER)
        for seed in range(60)
    ]


def test_visits_vary_as_much_as_they_may(many):
    h, edge = 1.75, TABLE.centre[1] + TABLE.half_size[1]
    top = TABLE.centre[2] + TABLE.half_size[2]
    poses = [visit.poses for visit in many]
    stand = np.array([rows[1][:2] for rows in poses])
    assert fills([visit.begin for visit in many], 1.0, 8.0)
    assert fills(stand[:, 0], UNDER[0] - 0.18, UNDER[0] + 0.18)
    assert fills(stand[:, 1], edge + 0.1 * h, edge + 0.1 * h + 0.05)
    for row in (0, -1):  # entrance and exit
        place = np.array([rows[row][:2] for rows in poses])
        assert fills(place[:, 0], -1.0, 1.4)
        assert fills(place[:, 1], edge + 1.2, edge + 1.5)
    facing = np.array([rows[2][2] for rows in poses])
    assert fills(facing, -np.pi / 2 - 0.15, -np.pi / 2 + 0.15)
    assert 0.6 < np.mean([visit.side for visit in many]) < 0.95
    assert {len(visit.markers) for visit in many} == {2, 3, 4}
    for rows, there in zip(poses, stand, strict=True):
        # Ahead to the bench, then to the exit, whichever way is shorter.
        ways = (rows[0], there - rows[0][:2]), (rows[-1], rows[-1][:2] - there)
        for own, (x, y) in ways:
            assert np.cos(own[2] - np.arctan2(y, x)) == pytest.approx(1)
            assert abs(own[2] - rows[2][2]) <= np.pi
    held = [visit.released - visit.time[visit.time < visit.released][-1] for visit in many]
    assert fills(held, 0.2, 0.5)
    item = np.array([visit.item_at(visit.end) for visit in many])
    assert fills(item[:, 0] - stand[:, 0], -0.2, 0.2)
    assert fills(item[:, 1], edge - 0.16, edge - 0.10)
    np.testing.assert_allclose(item[:, 2], top + 0.025)
    off = np.concatenate([visit.markers for visit in many]) - [*UNDER, top]
    assert fills(np.abs(off[:, 0]), 0.11, 0.22)
    assert 0.3 < (off[:, 0] > 0).mean() < 0.7
    assert fills(off[:, 1], -0.10, 0.12)
    np.testing.assert_allclose(off[:, 2], 0.05)
    stays = np.concatenate([np.diff(visit.reaches, axis=1) for visit in many])
    assert fills(stays, 0.3, 1.2)


def test_hands_carry_reach_and_hang_by_turns(many):
    h = 1.75
    worker = Worker(WorkerConfig(stature=h))
    over = TABLE.centre[2] + TABLE.half_size[2] + 0.12 - WorkerConfig.floor
    ready = np.array([[0.16 * h, s * 0.13 * h, over] for s in (1, -1)])
    leans = []
    for visit in many:
        hands = visit.poses[:, 4:].reshape(-1, 2, 3)
        carried = np.array([0.20 * h, (0.05, -0.05)[visit.side] * h, 0.63 * h])
        for k in range(3):  # enter, arrive, face the bench
            np.testing.assert_allclose(hands[k, visit.side], carried)
            np.testing.assert_allclose(
                hands[k, 1 - visit.side], worker.hanging_hands()[1 - visit.side]
            )
            assert visit.poses[k, 3] == 0
        # Above the spot by 12 cm, then down.
        above, down = hands[3, visit.side], hands[4, visit.side]
        np.testing.assert_allclose(above - down, (0, 0, 0.12), atol=1e-9)
        other = [hands[k, 1 - visit.side] for k in (3, 4)]
        np.testing.assert_allclose(other, np.tile(ready[1 - visit.side], (2, 1)))
        np.testing.assert_allclose(hands[6], ready)
        assert visit.poses[6, 3] == 0.05
        for k in range(len(visit.markers)):
            # Reached by the hand on its side, with the least lean; then back.
            row, target = 7 + 3 * k, visit.markers[k]
            own = in_worker_frame(worker, visit.poses[1][:2], visit.poses[2][2], target)
            side = int(own[1] < 0)
            np.testing.assert_allclose(hands[row, side], own, atol=1e-9)
            np.testing.assert_allclose(hands[row, 1 - side], ready[1 - side])
            assert visit.poses[row, 3] == worker.lean_to(own, side)
            np.testing.assert_allclose(visit.time[[row, row + 1]], visit.reaches[k])
            np.testing.assert_allclose(hands[row + 2], ready)
            leans.append(visit.poses[row + 2, 3])
        np.testing.assert_allclose(hands[-3:], np.tile(worker.hanging_hands(), (3, 1, 1)))
        assert not visit.poses[-3:, 3].any()
        assert visit.step == pytest.approx(0.4 * h)
    assert fills(leans, 0.0, 0.15)


def test_visits_begin_and_reach_as_asked():
    options = {"bench": TABLE, "under": UNDER, "begin": (2.0, 2.5), "reaches": (1, 1)}
    visits = [random_visit(Worker(), np.random.default_rng(k), **options) for k in range(5)]
    assert all(2.0 <= visit.begin <= 2.5 for visit in visits)
    assert {len(visit.markers) for visit in visits} == {1}


def test_what_is_in_the_way_counts_from_four_tenths_of_the_reach_on():
    seen = []
    visit = drawn(1, is_clear=lambda ends: seen.append(ends) or True)
    assert len(seen) == len(visit.markers)
    h = visit.worker.config.stature
    over = TABLE.centre[2] + TABLE.half_size[2] + 0.12 - visit.worker.config.floor
    stand, facing = visit.poses[1][:2], visit.poses[2][2]
    for ends, marker in zip(seen, visit.markers, strict=True):
        assert ends.shape == (4, len(PARTS), 2, 3)
        own = in_worker_frame(visit.worker, stand, facing, marker)
        side = int(own[1] < 0)
        rest = np.array([0.16 * h, (0.13, -0.13)[side] * h, over])
        for k, part in enumerate((0.4, 0.6, 0.8, 1.0)):
            grip = visit.worker.grip(ends[k], side)
            wanted = rest + part * (own - rest)
            found = in_worker_frame(visit.worker, stand, facing, grip)
            np.testing.assert_allclose(found, wanted, atol=1e-9)


def test_a_point_in_a_workers_frame_is_turned_back_about_the_stand():
    worker, stand, facing = Worker(WorkerConfig(floor=-0.7)), np.array([0.3, 1.2]), -1.4
    point = np.array([0.5, 0.4, 0.1])
    own = in_worker_frame(worker, stand, facing, point)
    back = np.add(Rotation.from_euler("z", facing).apply(own), [0.3, 1.2, -0.7])
    np.testing.assert_allclose(back, point, atol=1e-12)
    before = np.append(stand + np.array([np.cos(facing), np.sin(facing)]), 0.0)
    ahead = in_worker_frame(worker, stand, facing, before)
    np.testing.assert_allclose(ahead, (1, 0, 0.7), atol=1e-12)


@pytest.mark.parametrize("other", [-4.0, 0.0, 2.0])
@pytest.mark.parametrize("angle", [-9.0, -1.0, 0.0, 3.0, 7.0])
def test_a_turn_is_never_more_than_half(angle, other):
    found = nearest_turn(angle, other)
    assert abs(found - other) <= np.pi
    assert np.exp(1j * found) == pytest.approx(np.exp(1j * angle))
    vector = np.array([np.cos(angle), np.sin(angle)])
    assert np.exp(1j * direction(3 * vector)) == pytest.approx(np.exp(1j * angle))


def test_an_object_is_carried_before_the_body_the_same_way_in_either_hand():
    """The right hand mirrors the left one; the other hand hangs."""
    worker, begun = Worker(), []
    for side in (0, 1):
        script = BenchScript(
            worker, np.random.default_rng(0), bench=TABLE, across=(0.3, 0.5), sway=0.2
        )
        script.enter(2.0, HumanSpeeds(), side)
        assert script.times[0] == 2.0
        begun.append(script.rows[0][4:].reshape(2, 3))
    hanging = worker.hanging_hands()
    np.testing.assert_allclose(begun[0][0] * [1, -1, 1], begun[1][1])
    for side in (0, 1):
        np.testing.assert_allclose(begun[side][1 - side], hanging[1 - side])
        carried = begun[side][side]
        # Before the body, within its breadth, and between the hips and the shoulders.
        assert 0.1 < carried[0] < worker.arm_length
        assert 0 < abs(carried[1]) < 0.5 * abs(hanging[side, 1])
        assert np.sign(carried[1]) == np.sign(hanging[side, 1])
        assert 0.5 < carried[2] / worker.config.stature < 0.75
