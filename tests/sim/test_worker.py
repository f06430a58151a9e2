"""The worker's body: sizes of people, rigid parts that hang together, hands in their places."""

from dataclasses import replace

import numpy as np
import pytest

from hrc_learn.sim import Worker, WorkerConfig
from hrc_learn.sim.worker import PARTS, STATURES, Posture

FLOOR = WorkerConfig.floor


def part(ends: np.ndarray, name: str) -> np.ndarray:
    return ends[..., PARTS.index(name), :, :]


def random_postures(worker: Worker, count: int, seed: int = 0) -> Posture:
    rng = np.random.default_rng(seed)
    h = worker.config.stature
    hands = worker.hanging_hands() + h * rng.uniform(-0.05, 0.3, (count, 2, 3))
    return Posture(
        place=rng.uniform(-2, 2, (count, 2)),
        heading=rng.uniform(-4, 4, count),
        lean=rng.uniform(0, 0.9, count),
        stride=rng.uniform(-0.2, 0.2, count) * h,
        swing=rng.uniform(-1, 1, count),
        hands=hands,
    )


@pytest.mark.parametrize("stature", [1.518, 1.75, 1.869])
def test_a_standing_worker_is_as_tall_and_as_long_armed_as_people_are(stature):
    worker = Worker(WorkerConfig(stature=stature))
    ends = worker.ends(worker.standing())
    tops = ends[..., 2].max(axis=1) + worker.radius
    lows = ends[..., 2].min(axis=1) - worker.radius
    assert tops.max() - FLOOR == pytest.approx(stature, rel=0.01)
    assert lows.min() == pytest.approx(FLOOR, abs=2e-3)
    # Checks from elsewhere: a span about as long as the body, in Winter (2009) 1.03 of it.
    arm = sum(
        np.linalg.norm(np.diff(part(ends, f"{name}_left"), axis=0))
        for name in ("upper_arm", "forearm", "hand")
    )
    fingertips = arm + worker.radius[PARTS.index("hand_left")]
    shoulders = np.linalg.norm(np.diff(part(ends, "shoulders"), axis=0))
    assert 0.98 * stature < 2 * fingertips + shoulders < 1.12 * stature
    # And the elbow at 0.63 of the height, the hips at about half of it.
    elbow = part(ends, "upper_arm_left")[1, 2] - FLOOR
    assert elbow == pytest.approx(0.63 * stature, abs=0.02 * stature)
    assert part(ends, "thigh_left")[0, 2] - FLOOR == pytest.approx(0.53 * stature, rel=0.02)


def test_a_quarter_of_the_foot_is_behind_the_ankle():
    worker = Worker()
    ends = worker.ends(worker.standing())
    foot, radius = part(ends, "foot_left"), worker.radius[PARTS.index("foot_left")]
    ankle = part(ends, "shank_left")[1]
    back, front = (np.linalg.norm((end - ankle)[:2]) + radius for end in foot)
    assert front == pytest.approx(3 * back)
    # Winter (2009): a foot of 0.152 of the stature.
    assert back + front == pytest.approx(0.152 * worker.config.stature, rel=0.02)


def test_parts_are_rigid_and_hang_together():
    worker = Worker()
    ends = worker.ends(random_postures(worker, 200))
    lengths = np.linalg.norm(ends[..., 1, :] - ends[..., 0, :], axis=-1)
    np.testing.assert_allclose(lengths, np.broadcast_to(worker.lengths, lengths.shape))
    for side in ("left", "right"):
        for inner, outer in (("upper_arm", "forearm"), ("forearm", "hand"), ("thigh", "shank")):
            joint = part(ends, f"{inner}_{side}")[:, 1]
            np.testing.assert_allclose(joint, part(ends, f"{outer}_{side}")[:, 0], atol=1e-12)
    left = part(ends, "upper_arm_left")[:, 0]
    np.testing.assert_allclose(part(ends, "shoulders")[:, 0], left, atol=1e-12)


def test_hands_are_where_they_are_wanted():
    worker = Worker(WorkerConfig(stature=1.6))
    postures = random_postures(worker, 100)
    zero = np.zeros(100)
    still = replace(postures, place=np.zeros((100, 2)), heading=zero, stride=zero)
    ends = worker.ends(still)
    for k, side in enumerate(("left", "right")):
        wanted = still.hands[:, k] + [0, 0, FLOOR]
        shoulder = part(ends, f"upper_arm_{side}")[:, 0]
        far = np.linalg.norm(wanted - shoulder, axis=-1)
        # A hand that is folded onto the shoulder cannot be had.
        within = (far < worker.arm_length) & (far > 0.25)
        assert within.sum() > 60
        np.testing.assert_allclose(worker.grip(ends, k)[within], wanted[within], atol=1e-9)
        # Beyond reach it stretches towards the place.
        beyond = far > worker.arm_length
        reached = np.linalg.norm(worker.grip(ends, k) - shoulder, axis=-1)
        np.testing.assert_allclose(reached[beyond], worker.arm_length, rtol=0.01)


def test_elbows_bend_backwards_and_knees_forwards():
    worker = Worker()
    posture = random_postures(worker, 50)
    c, s = np.cos(posture.heading), np.sin(posture.heading)
    forward = np.stack([c, s, 0 * c], axis=-1)
    ends = worker.ends(posture)
    # Arms that hang: raised ones bend their elbows downwards.
    hanging = worker.ends(replace(posture, hands=np.tile(worker.hanging_hands(), (50, 1, 1))))
    for side in ("left", "right"):
        knee = bend(part(ends, f"thigh_{side}"), part(ends, f"shank_{side}"))
        assert ((knee * forward).sum(-1) > 0).all()
        elbow = bend(part(hanging, f"upper_arm_{side}"), part(hanging, f"forearm_{side}"))
        upright = posture.lean < 0.3
        assert ((elbow * forward).sum(-1) < 0)[upright].all()


def bend(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """From the straight line between the ends of two links to their joint, (n, 3)."""
    chord, out = second[:, 1] - first[:, 0], first[:, 1] - first[:, 0]
    along = (out * chord).sum(-1) / (chord * chord).sum(-1)
    return out - along[:, None] * chord


def test_the_hips_go_back_as_the_trunk_leans_forward():
    worker = Worker()
    standing = worker.standing()
    leaning = worker.ends(replace(standing, lean=np.array(0.8)))
    feet = part(leaning, "foot_left").mean(axis=0)[0]
    assert part(leaning, "pelvis")[0, 0] < -0.05 < 0 < feet < 0.1
    assert part(leaning, "head")[0, 0] > 0.4


def test_he_turns_and_walks_as_a_whole():
    worker = Worker()
    here = worker.standing()
    there = replace(here, place=np.array([1.0, 2.0]), heading=np.array(0.7))
    c, s = np.cos(0.7), np.sin(0.7)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    np.testing.assert_allclose(
        worker.ends(there), worker.ends(here) @ R.T + [1, 2, 0], atol=1e-12
    )


@pytest.mark.parametrize("side", [0, 1])
def test_he_leans_no_more_than_he_must(side):
    worker = Worker()
    h = worker.config.stature
    sign = (1, -1)[side]
    found = []
    for x in np.linspace(0.1, 1.4, 27):
        target = np.array([x, sign * 0.1, 0.45 * h])
        lean = worker.lean_to(target, side)
        found.append(lean)
        for angle, reaches in ((lean, True), (None if not lean else lean - 0.03, False)):
            if angle is not None:
                hands = worker.hanging_hands()
                hands[side] = target
                posture = replace(worker.standing(), lean=np.array(angle), hands=hands)
                grip = worker.grip(worker.ends(posture), side) - [0, 0, FLOOR]
                # What is left for comfort is 3 % of the arm, so 3 cm less of lean may do.
                miss = np.linalg.norm(grip - target)
                shoulder = part(worker.ends(posture), f"upper_arm_{('left', 'right')[side]}")[0]
                far = np.linalg.norm(target + np.array([0, 0, FLOOR]) - shoulder)
                assert (far <= 0.97 * worker.arm_length) == reaches
                assert miss < 1e-6 or not reaches
    assert found[0] == 0.0
    assert found[-1] is None
    bent = [lean for lean in found if lean is not None]
    assert bent == sorted(bent)
    assert max(bent) > 0.5


def test_statures_are_those_of_adults():
    rng = np.random.default_rng(0)
    drawn = np.array([WorkerConfig.draw(rng).stature for _ in range(4000)])
    low, high = STATURES["women"][0], STATURES["men"][1]
    assert drawn.min() >= low
    assert drawn.max() <= high
    assert drawn.min() < low + 0.01
    assert drawn.max() > high - 0.01
    mean = np.mean([np.mean(STATURES["women"]), np.mean(STATURES["men"])])
    assert drawn.mean() == pytest.approx(mean, abs=0.005)
