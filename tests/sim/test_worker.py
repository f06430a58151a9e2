"""The worker's body: sizes of people, rigid parts that hang together, hands in their places."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

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


@pytest.mark.parametrize(
    ("lean", "stride", "swing"),
    [(0.0, 0.0, 0.0), (0.7, 0.0, 0.0), (0.3, 0.25, 0.6), (0.2, -0.3, -0.8), (0.0, 0.9, 0.0)],
)
def test_trunk_head_and_feet_are_where_the_tables_of_the_body_put_them(lean, stride, swing):
    """From fractions of the stature (Winter 2009) and breadths of men of 1.756 m."""
    h, size = 1.6, 1.6 / 1.756
    worker = Worker(WorkerConfig(stature=h, floor=0.0))
    hands = worker.hanging_hands()
    here = Posture(
        place=np.zeros(2),
        heading=np.zeros(()),
        lean=np.array(lean),
        stride=np.array(stride),
        swing=np.array(swing),
        hands=hands,
    )
    ends = worker.ends(here)
    radius = dict(zip(PARTS, worker.radius, strict=True))
    up, forward = Rotation.from_euler("y", lean).apply([[0, 0, 1], [1, 0, 0]])
    # Straight legs, all but half a percent, over feet before and behind the pelvis.
    back, leg = 0.06 * h * np.sin(lean), 0.995 * 0.491 * h
    apart = min(abs(stride) + back, 0.8 * leg)
    pelvis = np.array([-back, 0.0, 0.039 * h + np.sqrt(leg**2 - apart**2)])
    np.testing.assert_allclose(part(ends, "pelvis").mean(axis=0), pelvis, atol=1e-12)
    neck = pelvis + 0.288 * h * up
    np.testing.assert_allclose(part(ends, "shoulders").mean(axis=0), neck, atol=1e-12)
    for name, breadth, width in (
        ("pelvis", 0.346 * size, radius["pelvis"]),
        ("shoulders", 0.510 * size, radius["upper_arm_left"]),
    ):
        left, right = part(ends, name)
        np.testing.assert_allclose(left - right, [0, breadth - 2 * width, 0], atol=1e-12)
    for name, side in (("chest_left", 1), ("chest_right", -1)):
        aside = side * np.array([0, 0.150 * size - radius["chest_left"], 0])
        low, top = part(ends, name)
        np.testing.assert_allclose(low, pelvis + 0.05 * h * up + aside, atol=1e-12)
        expected = neck + (0.015 * h - radius["chest_left"]) * up + aside
        np.testing.assert_allclose(top, expected, atol=1e-12)
    # The head leans less, so that the worker looks ahead, and its top is where the stature is.
    head_up = Rotation.from_euler("y", 0.7 * lean).apply([0, 0, 1])
    chin = neck + 0.052 * h * head_up
    np.testing.assert_allclose(part(ends, "neck"), [neck, chin], atol=1e-12)
    face = chin + 0.02 * h * forward
    low, high = part(ends, "head")
    np.testing.assert_allclose(low, face + radius["head"] * head_up, atol=1e-12)
    top = face + 0.13 * h * head_up
    np.testing.assert_allclose(high + radius["head"] * head_up, top, atol=1e-12)
    for name, side in (("left", 1), ("right", -1)):
        hip = part(ends, f"thigh_{name}")[0]
        np.testing.assert_allclose(hip, part(ends, "pelvis")[(1 - side) // 2], atol=1e-12)
        lifted = 0.04 * h * max(side * swing, 0.0)
        heel, toe = part(ends, f"foot_{name}")
        np.testing.assert_allclose((heel - toe)[1:], 0, atol=1e-12)
        if abs(stride) < 0.5:  # no leg is longer than that
            assert heel[2] - radius[f"foot_{name}"] == pytest.approx(lifted)
            ankle = part(ends, f"shank_{name}")[1]
            np.testing.assert_allclose(ankle, [side * stride, hip[1], 0.039 * h + lifted])
    # Hands sink with the pelvis in a stride, not with a lean.
    sunk = np.sqrt(leg**2 - min(abs(stride), 0.8 * leg) ** 2) - leg
    for k, side in enumerate(("left", "right")):
        shoulder, elbow, wrist = (
            part(ends, f"{name}_{side}")[0] for name in ("upper_arm", "forearm", "hand")
        )
        wanted = hands[k] + [0, 0, sunk]
        far = np.linalg.norm(wanted - shoulder)
        if far < worker.arm_length:
            np.testing.assert_allclose(worker.grip(ends, k), wanted, atol=1e-9)
        assert np.linalg.norm(elbow - shoulder) == pytest.approx(0.186 * h)
        assert np.linalg.norm(wrist - elbow) == pytest.approx(0.146 * h)
        tip = part(ends, f"hand_{side}")[1]
        reach = np.linalg.norm(tip - wrist) + radius[f"hand_{side}"]
        assert reach == pytest.approx(0.108 * h)


def test_elbows_and_knees_point_where_people_bend_them():
    """The part of a fixed direction that is across the line from shoulder to wrist."""
    worker = Worker(WorkerConfig(stature=1.7, floor=0.0))
    posture = random_postures(worker, 40, seed=3)
    posture = replace(posture, heading=np.zeros(40), place=np.zeros((40, 2)))
    ends = worker.ends(posture)
    for first, second, towards in (
        ("upper_arm", "forearm", (-0.8, 0.2, -0.7)),
        ("thigh", "shank", (1.0, 0.1, 0.0)),
    ):
        for side, sign in (("left", 1), ("right", -1)):
            limb = part(ends, f"{first}_{side}"), part(ends, f"{second}_{side}")
            out = bend(*limb)
            chord = limb[1][:, 1] - limb[0][:, 0]
            chord /= np.linalg.norm(chord, axis=-1, keepdims=True)
            wanted = np.array(towards) * (1, sign, 1)
            across = wanted - (chord @ wanted)[:, None] * chord
            across *= (np.linalg.norm(out, axis=-1) / np.linalg.norm(across, axis=-1))[:, None]
            np.testing.assert_allclose(out, across, atol=1e-9)
            # A limb is never straighter than 99.5 % of its length.
            length = sum(np.linalg.norm(np.diff(x, axis=1), axis=-1) for x in limb)[:, 0]
            distance = np.linalg.norm(limb[1][:, 1] - limb[0][:, 0], axis=-1)
            assert (distance <= 0.995 * length + 1e-9).all()


def test_arms_hang_beside_the_body_and_fold_no_further_than_their_links_allow():
    h = 1.7
    worker = Worker(WorkerConfig(stature=h, floor=0.0))
    reach = 0.995 * (0.186 + 0.146 + 0.9 * 0.108) * h
    assert worker.arm_length == pytest.approx(reach)
    shoulder = part(worker.ends(worker.standing()), "upper_arm_left")[0]
    left, right = worker.hanging_hands()
    np.testing.assert_allclose(left, (0.03 * h, shoulder[1] + 0.02, 0.818 * h - 0.98 * reach))
    np.testing.assert_allclose(right, left * (1, -1, 1))
    # The grip at a tenth of the stature would put the wrist into the shoulder.
    hands = np.stack([shoulder + np.array([0.1 * h, 0, 0]), right])
    ends = worker.ends(replace(worker.standing(), hands=hands))
    least = (0.186 - 0.146) * h + 0.05 * 0.995 * (0.186 + 0.146) * h
    wrist = part(ends, "hand_left")[0]
    assert np.linalg.norm(wrist - part(ends, "upper_arm_left")[0]) == pytest.approx(least)


def test_statures_of_women_and_men_are_normal_distributions_without_their_tails():
    rng = np.random.default_rng(1)
    drawn = np.array([WorkerConfig.draw(rng).stature for _ in range(3000)])
    women, men = (stats.truncnorm(-1.645, 1.645) for _ in "ab")
    places = []
    for (low, high), kind in zip(STATURES.values(), (women, men), strict=True):
        places.append(kind.cdf((drawn - (low + high) / 2) / ((high - low) / 2) * 1.645))
    # A mixture of both in halves is uniform over its own distribution function.
    assert stats.kstest(np.mean(places, axis=0), "uniform").pvalue > 0.01
