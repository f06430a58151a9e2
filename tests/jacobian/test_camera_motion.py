"""A camera that was moved is noticed and measured; one that stood still is left in peace.

The camera that is moved is OpenCV's.
"""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from unchecked import shapes_unchecked

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import (
    CameraCorrection,
    CameraReference,
    CameraWatch,
    ImageDemonstration,
    camera_motion,
    camera_placements,
    fit_camera,
    object_height,
)
from hrc_learn.jacobian.camera_motion import (
    CameraMotion,
    _displacement,
    _explained,
    from_moved,
    refined_twist,
)
from hrc_learn.jacobian.perspective import (
    FOCAL,
    RADIAL,
    from_base,
    marker_pixels,
    marker_points,
    motion_jacobian,
    pixels_and_depth,
)
from hrc_learn.jacobian.perspective import (
    MARKER as MARKER_PART,
)
from hrc_learn.jacobian.perspective import (
    moved as moved_camera,
)
from hrc_learn.store import json_text, parse_json

IMAGE, FPS, MARKER = (1440, 1080), 25.0, np.array([0.0, 0.06, 0.03])
ROTATION, SHIFT = np.array([np.pi - 0.2, 0.1, 0.05]), np.array([-0.4, 0.05, 1.1])
INTRINSICS = np.array([[1700.0, 0, 731.0], [0, 1700.0, 530.0], [0, 0, 1.0]])
LENS = np.array([-0.06, 0.0, 0.0, 0.0])


def moved(turn, shift):
    """Rotation vector and translation of the camera after a motion along its own axes."""
    back = cv2.Rodrigues(np.asarray(turn, float))[0].T
    return cv2.Rodrigues(back @ cv2.Rodrigues(ROTATION)[0])[0][:, 0], back @ (SHIFT - shift)


def demonstration(rng, place=(ROTATION, SHIFT), frames=150, noise=0.1, middle=(0.45, 0.0, 0.2)):
    """A tool that wanders and turns before the camera, its marker unseen now and then."""
    time = np.linspace(0, 1, frames)[:, None]
    wave = sum(rng.normal(0, 0.06, 3) * np.sin(2 * np.pi * k * time) for k in (0.5, 1.0, 1.5))
    turn = quaternion.exp(torch.from_numpy(np.sin(2 * np.pi * time) * rng.normal(0, 0.25, 3)))
    pose = Pose(torch.from_numpy(np.array(middle) + wave), turn)
    points = pose.apply(torch.from_numpy(MARKER)).numpy()
    pixels = cv2.projectPoints(points, *place, INTRINSICS, LENS)[0][:, 0]
    visible = torch.from_numpy(rng.random(frames) > 0.1)
    pixels[~visible.numpy()] = np.nan
    feature = torch.from_numpy(pixels + rng.normal(0, noise, pixels.shape))
    return ImageDemonstration(pose=pose, feature=feature, visible=visible)


def run(watch, demo, frames=None):
    """What a watch says, frame by frame."""
    watch.clear()
    return [
        watch.update(frame / FPS, demo.pose[frame], demo.feature[frame])
        for frame in demo.visible[:frames].nonzero()[:, 0].tolist()
    ]


@pytest.fixture(scope="module")
def demonstrations():
    rng = np.random.default_rng(0)
    return [demonstration(rng) for _ in range(6)]


@pytest.fixture(scope="module")
def reference(demonstrations):
    return CameraReference.fit(demonstrations, FPS, IMAGE)


@pytest.fixture(scope="module")
def camera(demonstrations):
    return fit_camera(demonstrations, IMAGE).camera


def test_the_camera_is_found_with_its_lens(camera):
    rng = np.random.default_rng(5)
    fresh = demonstration(rng, noise=0.0)
    error = (marker_pixels(camera, fresh.pose)[0] - fresh.feature).numpy()
    assert np.nanmax(np.abs(error)) < 0.5
    assert float(camera[FOCAL].exp()) == pytest.approx(1700.0, rel=0.02)
    assert float(camera[RADIAL]) == pytest.approx(-0.06, abs=0.03)
    # The marker is at the place that OpenCV put it, not only somewhere that fits.
    np.testing.assert_allclose(camera[MARKER_PART], MARKER, atol=2e-3)


def test_the_interaction_matrix_is_the_derivative_of_the_moved_camera(camera):
    pose = demonstration(np.random.default_rng(1)).pose[:5]
    derivative = motion_jacobian(camera, marker_points(camera, pose))
    for axis, step in enumerate(1e-6 * torch.eye(6, dtype=torch.float64)):
        ahead, behind = moved_camera(camera, step), moved_camera(camera, -step)
        change = marker_pixels(ahead, pose)[0] - marker_pixels(behind, pose)[0]
        np.testing.assert_allclose(derivative[..., axis], change / 2e-6, rtol=1e-4, atol=1e-3)


def test_a_moved_camera_is_that_of_opencv():
    turn, shift = np.array([0.1, -0.2, 0.15]), np.array([0.03, 0.02, -0.05])
    optics = [np.log(1700.0), 731.0, 530.0, -0.06]
    home = torch.from_numpy(np.concatenate([optics, ROTATION, SHIFT, MARKER]))
    there = moved_camera(home, torch.from_numpy(np.concatenate([turn, shift])))
    pose = demonstration(np.random.default_rng(2)).pose
    points = pose.apply(torch.from_numpy(MARKER)).numpy()
    expected = cv2.projectPoints(points, *moved(turn, shift), INTRINSICS, LENS)[0][:, 0]
    np.testing.assert_allclose(marker_pixels(there, pose)[0], expected, atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize(
    ("turn", "shift"),
    [
        *((np.deg2rad(0.1) * axis, np.zeros(3)) for axis in np.eye(3)[:2]),
        *((np.zeros(3), 2e-3 * axis) for axis in np.eye(3)[:2]),
        (np.deg2rad([0.0, 0.0, 1.0]), np.zeros(3)),
    ],
)
def test_small_motions_are_noticed(reference, turn, shift):
    demo = demonstration(np.random.default_rng(3), moved(turn, shift))
    assert any(run(CameraWatch(reference), demo, frames=int(2 * FPS)))


@pytest.mark.simulation
@pytest.mark.long
def test_a_camera_that_stood_still_is_left_in_peace(reference):
    rng = np.random.default_rng(4)
    for _ in range(2):
        assert not any(run(CameraWatch(reference), demonstration(rng)))


def test_a_large_motion_is_measured(reference):
    turn, shift = np.deg2rad([4.0, -6.0, 7.0]), np.array([0.05, -0.06, 0.04])
    fresh = demonstration(np.random.default_rng(6), moved(turn, shift))
    motion = run(CameraWatch(reference), fresh)[-1]
    there = moved_camera(reference.vector, motion.twist)
    last = slice(-25, None)
    error = (marker_pixels(there, fresh.pose)[0] - fresh.feature).numpy()
    # A second of motion tells where the marker is seen, not how much of it was a turn.
    assert np.nanmax(np.abs(error[last])) < 3.0
    assert motion.angle == pytest.approx(np.linalg.norm(turn), rel=0.5)
    assert str(motion).startswith(f"camera moved by {np.rad2deg(motion.angle):.1f} degrees")


def test_a_marker_half_covered_is_no_motion(reference):
    rng = np.random.default_rng(7)
    fresh = demonstration(rng)
    fresh.feature[::20] += 15.0
    assert not any(run(CameraWatch(reference), fresh))


def test_frames_where_no_demonstration_went_do_not_count(reference, demonstrations):
    rng = np.random.default_rng(11)
    knocked = moved(np.deg2rad([2.0, 0.0, 0.0]), np.zeros(3))
    outside = demonstration(rng, knocked, middle=(2.0, 0.0, 0.2))
    watch = CameraWatch(reference)
    assert not any(run(watch, outside))
    assert watch.displacement == 0.0
    everywhere = torch.cat(
        [marker_points(reference.vector, demo.pose[demo.visible]) for demo in demonstrations]
    )
    assert all(map(reference.covers, everywhere))
    lower, upper = (torch.from_numpy(np.array(x)) for x in (reference.lower, reference.upper))
    for axis in torch.eye(3):
        for corner, away in ((lower, -1e-6), (upper, 1e-6)):
            assert reference.covers(corner)
            assert not reference.covers(corner + away * (upper - lower) * axis)


def test_what_was_seen_before_a_pause_is_forgotten(reference):
    watch = CameraWatch(reference)
    knocked = demonstration(
        np.random.default_rng(8), moved(np.deg2rad([1.0, 0, 0]), np.zeros(3))
    )
    assert run(watch, knocked)[-1]
    assert not any(run(watch, demonstration(np.random.default_rng(9))))


def test_frames_out_of_order_and_without_numbers_are_refused(reference):
    watch, pose = CameraWatch(reference), demonstration(np.random.default_rng(0)).pose[0]
    watch.update(1.0, pose, torch.tensor([700.0, 500.0]))
    with pytest.raises(ValueError, match="clear"):
        watch.update(1.0, pose, torch.tensor([700.0, 500.0]))
    with pytest.raises(ValueError, match="finite"):
        watch.update(2.0, pose, torch.tensor([torch.nan, 500.0]))


def test_a_reference_survives_json(reference):
    assert parse_json(json_text(reference), CameraReference, "a camera") == reference
    with pytest.raises(ValueError, match="threshold"):
        parse_json(json_text({"camera": reference.camera}), CameraReference, "a camera")


def test_one_demonstration_is_not_enough(demonstrations):
    with pytest.raises(ValueError, match="two demonstrations"):
        CameraReference.fit(demonstrations[:1], FPS, IMAGE)
    with pytest.raises(ValueError, match=r"fps must be positive, got 0\.0"):
        CameraReference.fit(demonstrations, 0.0, IMAGE)
    with pytest.raises(ValueError, match="camera must have 13 numbers, but has 2"):
        CameraReference(camera=(0.0, 1.0), threshold=1.0, lower=(0,) * 3, upper=(1,) * 3)
    assert camera_placements(demonstrations[:1], IMAGE) == []


def test_a_marker_never_seen_is_said(demonstrations):
    hidden = [
        ImageDemonstration(
            pose=demo.pose,
            feature=demo.feature,
            # Enough to fit a camera, never enough within a second.
            visible=demo.visible & (torch.arange(len(demo.visible)) % 10 == 0),
        )
        for demo in demonstrations[:3]
    ]
    with pytest.raises(ValueError, match="no demonstration shows"):
        CameraReference.fit(hidden, FPS, IMAGE)


@pytest.mark.long
@pytest.mark.simulation
def test_placements_tell_episodes_of_a_moved_camera_apart():
    rng = np.random.default_rng(10)
    knocked = moved(np.deg2rad([0.3, -0.4, 0.0]), np.array([0.004, 0.0, 0.0]))
    places = 4 * [(ROTATION, SHIFT)] + 3 * [knocked] + 2 * [(ROTATION, SHIFT)]
    demos = [demonstration(rng, place, frames=60) for place in places]
    first, second = camera_placements(demos, IMAGE)
    assert first.episodes == (0, 1, 2, 3, 7, 8)
    assert second.episodes == (4, 5, 6)
    assert first.motion.displacement == pytest.approx(0.0, abs=1.0)
    # Of 0.5 degrees and 4 mm: 1700 px times about 9 mrad, and what the shift adds.
    assert 8.0 < second.motion.displacement < 25.0


@pytest.mark.long
@pytest.mark.simulation
def test_a_camera_that_stood_still_has_one_placement(demonstrations):
    (only,) = camera_placements(demonstrations[:4], IMAGE)
    assert only.episodes == (0, 1, 2, 3)


def shown_at(points, place=(ROTATION, SHIFT)):
    """Where OpenCV sees points of the base frame."""
    return cv2.projectPoints(np.asarray(points), *place, INTRINSICS, LENS)[0][:, 0]


def objects(rng, count=12):
    """On a table, and the places that the tool takes them from: 3 cm above, 1 cm beside."""
    there = np.array([0.45, 0.0, 0.02]) + rng.uniform(-0.1, 0.1, (count, 3)) * [1, 1, 0]
    return there, there + np.array([0.01, 0.0, 0.03]) + rng.normal(0, 5e-4, (count, 3))


@pytest.fixture(scope="module")
def plane(reference):
    rng = np.random.default_rng(11)
    there, taken = objects(rng)
    pixels = shown_at(there) + rng.normal(0, 0.1, (12, 2))
    return object_height(reference, torch.from_numpy(taken), torch.from_numpy(pixels))


def objects_found(correction, plane, there, place):
    """Corrected pixels of objects that a moved camera sees."""
    pixels = torch.from_numpy(shown_at(there, place))
    return np.stack([correction.object(plane, pixel).numpy() for pixel in pixels])


def corrected(correction, demo):
    """What becomes of the marker's pixels, and how often a motion is noticed."""
    pixels, noticed = [], 0
    with shapes_unchecked():
        for frame in demo.visible.nonzero()[:, 0].tolist():
            pose, pixel = demo.pose[frame], demo.feature[frame]
            noticed += correction.update(frame / FPS, pose, pixel) is not None
            pixels.append(correction.marker(pose, pixel))
    return torch.stack(pixels).numpy(), noticed


KNOCKS = [
    moved(np.deg2rad(angle) * np.array(axis), shift)
    for angle, axis, shift in (
        (10.0, (1.0, 0.0, 0.0), np.array([0.0, 0.1, 0.0])),
        (10.0, (0.0, 0.6, 0.8), np.array([0.06, 0.0, -0.08])),
        (2.0, (0.0, 1.0, 0.0), np.array([0.0, 0.0, 0.0])),
    )
]


@pytest.mark.long
@pytest.mark.parametrize("place", KNOCKS[:2])
def test_a_moved_camera_shows_things_where_it_would_have_seen_them(reference, plane, place):
    rng = np.random.default_rng(12)
    correction = CameraCorrection(reference)
    correction.clear()
    pixels, noticed = corrected(correction, demonstration(rng, place))
    assert noticed == 1
    correction.clear()  # another episode, with the camera where it is now
    demo = demonstration(rng, place)
    pixels, noticed = corrected(correction, demo)
    assert noticed == 0
    seen = demo.visible.numpy()
    points = demo.pose.apply(torch.from_numpy(MARKER)).numpy()[seen]
    assert np.abs(pixels - shown_at(points)).max() < 2.0
    there, _ = objects(rng)
    found = objects_found(correction, plane, there, place)
    np.testing.assert_allclose(found, shown_at(there), rtol=0, atol=3.0)
    assert np.abs(shown_at(there, place) - shown_at(there)).max() > 50.0


def test_a_camera_that_stands_still_is_not_corrected(reference, plane):
    correction = CameraCorrection(reference)
    demo = demonstration(np.random.default_rng(13))
    pixels, noticed = corrected(correction, demo)
    assert noticed == 0
    assert correction.motion is None
    np.testing.assert_array_equal(pixels, demo.feature.numpy()[demo.visible.numpy()])
    pixel = torch.tensor([700.0, 500.0])
    assert torch.equal(correction.object(plane, pixel), pixel)


@pytest.mark.parametrize("place", KNOCKS[:2])
def test_a_single_frame_tells_most_of_a_large_motion(reference, plane, place):
    """So that nobody acts on what a moved camera shows until a second has passed."""
    rng = np.random.default_rng(16)
    correction = CameraCorrection(reference)
    demo = demonstration(rng, place)
    first = int(demo.visible.nonzero()[0])
    pose, pixel = demo.pose[first], demo.feature[first]
    assert correction.update(0.0, pose, pixel) is not None
    marker = shown_at(pose.apply(torch.from_numpy(MARKER)).numpy()[None])[0]
    np.testing.assert_allclose(correction.marker(pose, pixel), marker, rtol=0, atol=2.0)
    there, _ = objects(rng)
    found = objects_found(correction, plane, there, place)
    left = np.linalg.norm(found - shown_at(there), axis=-1)
    assert np.median(left) < 0.5 * np.median(
        np.linalg.norm(shown_at(there, place) - shown_at(there), axis=-1)
    )


def test_few_frames_lead_to_the_likeliest_motion_and_never_far(camera):
    """Of errors [px] and a prior spread of 0.1 rad and 0.1 m, the most probable motion."""
    prior, points = 0.1, torch.tensor([[0.05, -0.1, 0.9], [0.06, -0.1, 0.9]]).double()
    still = torch.zeros(6, dtype=torch.float64)
    there, _ = pixels_and_depth(camera, points)
    pixels = there + torch.tensor([100.0, 60.0])
    twist = refined_twist(camera, points, pixels, still, steps=60)
    seen = from_moved(points, twist)
    errors, jacobian = pixels - pixels_and_depth(camera, seen)[0], motion_jacobian(camera, seen)
    slope = prior * torch.einsum("fij,fi->j", jacobian, errors) - twist / prior
    # The turn composes, so that the prior is exact to first order only.
    assert slope.norm() < 0.2 * (twist / prior).norm()
    # Two frames of the same place that contradict each other.
    pixels = there + torch.tensor([[400.0, 300.0], [-400.0, 100.0]])
    twist = refined_twist(camera, points, pixels, still, steps=60)
    assert (twist / prior).norm() <= 5.0 + 1e-9


def test_a_wrong_marker_in_one_frame_is_undone_by_those_after_it(reference):
    correction, demo = CameraCorrection(reference), demonstration(np.random.default_rng(18))
    seen = demo.visible.nonzero()[:, 0].tolist()
    wrong = demo.feature[seen[0]] + torch.tensor([150.0, -80.0])
    assert correction.update(seen[0] / FPS, demo.pose[seen[0]], wrong) is not None
    for k in seen[1:]:
        correction.update(k / FPS, demo.pose[k], demo.feature[k])
    for k in seen[1:]:
        found = correction.marker(demo.pose[k], demo.feature[k])
        assert (found - demo.feature[k]).abs().max() < 2.0


@pytest.mark.parametrize(("frames", "thresholds"), [(1, 10), (4, 2.5), (10, 1), (20, 1)])
def test_the_fewer_frames_the_more_they_must_show(reference, frames, thresholds):
    demo = demonstration(np.random.default_rng(17), noise=0.0)
    seen = demo.visible.nonzero()[:frames, 0]
    for share, expected in ((0.8, False), (1.3, True)):
        correction = CameraCorrection(reference)
        for k in map(int, seen):
            # All pixels are off alike, as when the camera is turned a little.
            off = torch.tensor([share * thresholds * reference.threshold, 0.0])
            pixel = demo.feature[k] + off
            correction.update(k / FPS, demo.pose[k], pixel)
        assert (correction.motion is not None) == expected


@pytest.mark.long
def test_a_camera_may_be_moved_again_and_put_back(reference, plane):
    rng = np.random.default_rng(14)
    correction = CameraCorrection(reference)
    there, _ = objects(rng)
    for place in (KNOCKS[0], KNOCKS[2], (ROTATION, SHIFT)):
        correction.clear()
        _, noticed = corrected(correction, demonstration(rng, place))
        assert noticed >= 1
        found = objects_found(correction, plane, there, place)
        assert np.abs(found - shown_at(there)).max() < 3.0


def test_an_objects_plane_says_what_it_takes(reference):
    there, taken = objects(np.random.default_rng(15))
    taken, pixels = torch.from_numpy(taken), torch.from_numpy(shown_at(there))
    with pytest.raises(ValueError, match="four"):
        object_height(reference, taken[:3], pixels[:3])
    with pytest.raises(ValueError, match="disagree"):
        object_height(reference, taken, pixels.flip(0))


# A camera that sees exactly as the model has it, one metre above the tool.
EXACT = torch.tensor(
    [np.log(1700.0), 731.0, 530.0, -0.06, *ROTATION, *SHIFT, *MARKER], dtype=torch.float64
)


def exact_reference(threshold=1.0):
    return CameraReference(
        camera=tuple(EXACT.tolist()), threshold=threshold, lower=(-9,) * 3, upper=(9,) * 3
    )


def scattered(rng, count=12):
    """Points before the camera, in its frame [m]."""
    return torch.from_numpy(rng.uniform([-0.2, -0.2, 0.8], [0.2, 0.2, 1.2], (count, 3)))


@pytest.mark.parametrize("already", [None, (0.02, -0.05, 0.01, 0.03, 0.0, -0.04)])
def test_a_motion_is_the_most_plausible_one_for_its_errors(already):
    """Least squares by NumPy, with a prior of 0.1 rad and 0.1 m."""
    points = scattered(np.random.default_rng(0))
    slope = motion_jacobian(EXACT, points).flatten(0, 1).numpy()
    truth = np.array([3e-3, -2e-3, 4e-3, 1e-3, 2e-3, -5e-3])
    pixels = pixels_and_depth(EXACT, points)[0] + torch.from_numpy(slope @ truth).reshape(-1, 2)
    errors = (pixels - pixels_and_depth(EXACT, points)[0]).flatten().numpy()
    moved_by = None if already is None else torch.tensor(already).double()
    twist, displacement = _explained(EXACT, points, pixels, moved_by)
    pull = np.zeros(6) if already is None else -np.array(already)
    rows, right = np.vstack([slope, 10 * np.eye(6)]), np.append(errors, 10 * pull)
    expected = np.linalg.lstsq(rows, right)[0]
    np.testing.assert_allclose(twist, expected, atol=1e-9)
    explained = (slope @ expected).reshape(-1, 2)
    assert displacement == pytest.approx(np.sqrt((explained**2).sum(1).mean()))


@pytest.mark.parametrize(("size", "counts"), [(2.0, 6.0), (0.01, 0.1)])
def test_an_error_counts_up_to_three_times_the_median_or_a_tenth_of_a_pixel(size, counts):
    rng = np.random.default_rng(1)
    points = scattered(rng)
    turns = rng.uniform(0, 2 * np.pi, 12)
    directions = torch.from_numpy(np.stack([np.cos(turns), np.sin(turns)], -1))
    sizes = torch.full((12, 1), size).double()
    sizes[3] = 100.0
    clipped = sizes.clone()
    clipped[3] = counts
    there = pixels_and_depth(EXACT, points)[0]
    found, expected = (
        _explained(EXACT, points, there + s * directions) for s in (sizes, clipped)
    )
    torch.testing.assert_close(found[0], expected[0], rtol=1e-9, atol=1e-12)


def test_a_motion_says_its_angle_distance_and_displacement():
    points = scattered(np.random.default_rng(2))
    twist = torch.tensor([0.03, 0.0, -0.04, 0.0, 0.012, 0.005]).double()
    motion = CameraMotion.of(EXACT, twist, points)
    assert motion.angle == pytest.approx(0.05)
    assert motion.distance == pytest.approx(0.013)
    shift = (motion_jacobian(EXACT, points) @ twist).numpy()
    assert motion.displacement == pytest.approx(np.sqrt((shift**2).sum(1).mean()))
    assert str(motion) == (
        f"camera moved by {np.rad2deg(0.05):.1f} degrees and 13 mm "
        f"({motion.displacement:.1f} px in the image)"
    )


def wandering(count, place=EXACT, seed=3):
    """Poses of the tool, and its exact pixels by a camera of the model."""
    pose = demonstration(np.random.default_rng(seed), frames=count).pose
    return pose, marker_pixels(place, pose)[0]


@pytest.mark.parametrize(("interval", "most"), [(1 / 16, 17), (7 / 64, 10), (1 / 8, 9)])
def test_a_watch_compares_the_last_second_once_it_has_ten_frames(interval, most):
    pose, pixels = wandering(24, moved_camera(EXACT, torch.full((6,), 1e-3).double()))
    watch = CameraWatch(exact_reference(np.inf))
    for k in range(24):
        assert watch.update(k * interval, pose[k], pixels[k]) is None
        window = slice(max(0, k - int(1 / interval)), k + 1)
        frames = window.stop - window.start
        assert frames <= most
        if frames < 10:
            assert watch.displacement == 0
            continue
        points = marker_points(EXACT, pose[window])
        expected = _explained(EXACT, points, pixels[window])[1]
        assert watch.displacement == pytest.approx(expected, rel=1e-9)
    assert (watch.displacement > 0) == (most >= 10)
    watch.clear()
    assert watch.displacement == 0
    watch.update(0.0, pose[0], pixels[0])  # the clock may begin again


@pytest.mark.parametrize(("factor", "noticed"), [(0.999, False), (1.001, True)])
def test_a_motion_is_told_above_the_threshold(factor, noticed):
    twist = torch.tensor([2e-3, 1e-3, 0, 0, 0, 3e-3]).double()
    pose, pixels = wandering(12, moved_camera(EXACT, twist))
    points = marker_points(EXACT, pose)
    displacement = _explained(EXACT, points, pixels)[1]
    watch = CameraWatch(exact_reference(displacement / factor))
    found = [watch.update(0.01 * k, pose[k], pixels[k]) for k in range(12)]
    assert (found[-1] is not None) == noticed
    if noticed:
        # Exact pixels leave the prior alone to pull it from the truth.
        torch.testing.assert_close(found[-1].twist, twist, rtol=0, atol=1e-3)
        there = marker_pixels(moved_camera(EXACT, found[-1].twist), pose)[0]
        assert (there - pixels).abs().max() < 0.05


def test_points_and_pixels_move_as_those_of_the_moved_camera():
    points = scattered(np.random.default_rng(4))
    twist = torch.tensor([0.1, -0.2, 0.3, 0.02, -0.03, 0.04]).double()
    turn = Rotation.from_rotvec(twist[:3])
    expected = turn.inv().apply(points - twist[3:])
    np.testing.assert_allclose(from_moved(points, twist), expected, atol=1e-12)
    change = _displacement(EXACT, points, twist)
    after = pixels_and_depth(EXACT, torch.from_numpy(expected))[0]
    np.testing.assert_allclose(change, after - pixels_and_depth(EXACT, points)[0], atol=1e-9)


@pytest.mark.parametrize("steps", [1, 5])
def test_steps_to_a_motion_compose_in_the_frame_of_the_camera_as_moved(steps):
    points = scattered(np.random.default_rng(5), 40)
    truth = torch.tensor([0.1, -0.08, 0.15, 0.05, -0.04, 0.06]).double()
    pixels = pixels_and_depth(EXACT, from_moved(points, truth))[0]
    start = torch.tensor([0.05, 0.0, 0.1, 0.0, -0.05, 0.0]).double()
    found = refined_twist(EXACT, points, pixels, start, steps=steps)
    if steps == 1:
        seen = from_moved(points, start)
        step = _explained(EXACT, seen, pixels, start)[0].numpy()
        turn = Rotation.from_rotvec(start[:3])
        both = turn * Rotation.from_rotvec(step[:3])
        expected = np.append(both.as_rotvec(), start[3:] + turn.apply(step[3:]))
        np.testing.assert_allclose(found.numpy(), expected, atol=1e-9)
    else:
        torch.testing.assert_close(found, truth, rtol=0, atol=2e-3)


@pytest.mark.parametrize(("noise", "agree"), [(9.5, True), (10.5, False)])
def test_the_plane_of_objects_is_that_on_which_they_lie(noise, agree):
    """With the same offset of all grasps, which alone tells the height of the tool."""
    rng = np.random.default_rng(6)
    there = np.array([0.45, 0.0, 0.07]) + rng.uniform(-0.1, 0.1, (9, 3)) * [1, 1, 0]
    taken = torch.from_numpy(there + np.array([0.02, -0.03, 0.05]))
    pixels = pixels_and_depth(EXACT, from_base(EXACT, torch.from_numpy(there)))[0]
    assert object_height(exact_reference(), taken, pixels) == pytest.approx(0.07, abs=1e-6)
    assert object_height(exact_reference(), taken[:4], pixels[:4]) == pytest.approx(0.07)
    # Errors that no offset explains: their part along the derivatives is taken out.
    slope = pixels_and_depth(EXACT, from_base(EXACT, torch.from_numpy(there)))[1]
    slope = (slope @ torch.from_numpy(cv2.Rodrigues(ROTATION)[0])).flatten(0, 1)
    error = torch.from_numpy(rng.normal(0, 1, 18))
    error = error - slope @ torch.linalg.lstsq(slope, error[:, None]).solution[:, 0]
    error = error.reshape(9, 2)
    error = noise * error / error.square().sum(-1).mean().sqrt()
    if agree:
        object_height(exact_reference(), taken, pixels + error)
    else:
        with pytest.raises(ValueError, match=r"disagree by 1[01] px"):
            object_height(exact_reference(), taken, pixels + error)


def test_a_correction_keeps_what_it_knows_for_the_next_episode():
    """Exact pixels: what it corrects them to is what the camera saw before."""
    twist = torch.tensor([0.05, -0.03, 0.08, 0.02, 0.03, -0.04]).double()
    moved_to = moved_camera(EXACT, twist)
    pose, pixels = wandering(50, moved_to)
    before = marker_pixels(EXACT, pose)[0]
    correction = CameraCorrection(exact_reference())
    assert torch.equal(correction.marker(pose[0], pixels[0]), pixels[0])
    for k in range(25):
        correction.update(k / FPS, pose[k], pixels[k])
    for start in (25, 40):
        correction.clear()
        for k in range(start, start + 10):
            assert correction.update(k / FPS - 1, pose[k], pixels[k]) is None
    off = torch.stack([correction.marker(p, x) for p, x in zip(pose, pixels, strict=True)])
    assert (off - before).abs().max() < 0.3
    assert correction.motion is not None
    torch.testing.assert_close(correction.motion.twist, twist, rtol=0, atol=5e-3)
    # Points of a plane, seen by both.
    place = torch.tensor([[0.45, 0.05, 0.1]]).double()
    seen, expected = (
        pixels_and_depth(view, from_base(view, place))[0][0] for view in (moved_to, EXACT)
    )
    torch.testing.assert_close(correction.object(0.1, seen), expected, rtol=0, atol=1.0)


def test_a_further_knock_is_reported_and_corrected():
    """Exact pixels of a camera that is knocked while the tool moves, then put back."""
    twist = torch.tensor([0.05, -0.03, 0.08, 0.02, 0.03, -0.04]).double()
    correction = CameraCorrection(exact_reference())
    for n, fraction in enumerate((1.0, 0.0)):
        pose, pixels = wandering(20, moved_camera(EXACT, fraction * twist))
        with shapes_unchecked():
            shown = [
                correction.update(n + k / 20, pose[k], pixels[k]) is not None for k in range(20)
            ]
            assert any(shown)
            found = correction.marker(pose[-1], pixels[-1])
        assert (found - marker_pixels(EXACT, pose)[0][-1]).abs().max() < 0.3


def test_a_correction_without_a_motion_forgets_frames_before_its_last_second():
    pose, pixels = wandering(40)
    correction = CameraCorrection(exact_reference())
    for k in range(40):
        correction.update(k / 16, pose[k], pixels[k])
        times = [frame[0] for frame in correction._frames]
        assert times[0] >= k / 16 - 1.0
        assert len(times) == min(k + 1, 17)
    correction.clear()
    assert not correction._frames
    assert correction.motion is None


def placed(monkeypatch, places, frames=None, near=()):
    """Placements of episodes whose camera stands at places along its x axis [mm].

    All points are 1 m before the camera, in episodes `near` 0.5 m: there, the image moves
    twice as far. `frames`: frames with the marker in each episode.
    """
    frames = frames or [12] * len(places)
    twists = torch.zeros(len(places), 6, dtype=torch.float64)
    twists[:, 3] = torch.tensor(places, dtype=torch.float64) / 1e3
    camera = torch.zeros(13).double()
    kept = [k for k, count in enumerate(frames) if count >= 10]
    monkeypatch.setattr(camera_motion, "_camera_of_episodes", lambda *_: (camera, twists[kept]))
    monkeypatch.setattr(camera_motion, "marker_points", lambda camera, points: points)

    def episode(k):
        points = torch.tensor([[0.0, 0.0, 0.5 if k in near else 1.0]]).double()
        points = points.expand(frames[k], 3)
        return SimpleNamespace(seen=lambda: (points, points[:, :2]))

    with shapes_unchecked():
        return camera_placements([episode(k) for k in range(len(places))], IMAGE)


@pytest.mark.parametrize(
    ("places", "near", "groups"),
    [
        ([0, 1, 0, 1, 5.9], (), [(0, 1, 2, 3, 4)]),
        ([0, 1, 0, 1, 6.1], (), [(0, 1, 2, 3), (4,)]),
        # The larger displacement counts, of the points of either episode.
        ([0, 1, 0, 1, 4], (4,), [(0, 1, 2, 3), (4,)]),
        ([0, 1, 0, 1, 0, 4, 3, 4], (), [(0, 1, 2, 3, 4, 5, 6, 7)]),
        # Each is compared with the first episode of a placement, and joins the first that fits.
        ([0, 1, 2, 3, 4, 5, 6.9, 7, 6.9, 0], (), [(0, 1, 2, 3, 4, 5, 9), (6, 7, 8)]),
        ([9, 9, 9, 0, 0, 0, 9, 9], (), [(0, 1, 2, 6, 7), (3, 4, 5)]),
    ],
)
def test_an_episode_joins_the_first_placement_within_six_median_differences(
    monkeypatch, places, near, groups
):
    found = placed(monkeypatch, places, near=near)
    assert [placement.episodes for placement in found] == groups


def test_a_placement_has_the_median_motion_of_its_episodes(monkeypatch):
    first, second = placed(monkeypatch, [0, 1, 3, 50, 51, 53, 52])
    assert (first.episodes, second.episodes) == ((0, 1, 2), (3, 4, 5, 6))
    assert first.motion.distance == first.motion.displacement == 0.0
    assert float(second.motion.twist[3]) == pytest.approx((51.5 - 1.0) / 1e3)
    # A focal length of 1 px and points at 1 m: as many pixels as metres.
    assert second.motion.displacement == pytest.approx(0.0505)
    assert float(second.motion.twist.norm()) == pytest.approx(0.0505)


def test_episodes_that_show_too_little_belong_to_no_placement(monkeypatch):
    first, second = placed(
        monkeypatch, [0, 1, 2, 90, 1, 0, 2], frames=[10, 9, 12, 11, 12, 12, 12]
    )
    assert (first.episodes, second.episodes) == ((0, 2, 4, 5, 6), (3,))
    assert placed(monkeypatch, [0, 1, 2], frames=[10, 9, 9]) == []
    assert len(placed(monkeypatch, [0, 1, 2], frames=[10, 9, 10])) == 1


@pytest.mark.simulation
def test_the_motion_of_each_episode_is_undone_before_the_next_fit(monkeypatch):
    """With a true camera, later fits see the images of a camera that stood still."""
    true = torch.tensor(
        [np.log(1700.0), 731.0, 530.0, LENS[0], *ROTATION, *SHIFT, *MARKER]
    ).double()
    fits = []

    def fit(demos, image_size):
        fits.append([demo.feature for demo in demos])
        return SimpleNamespace(camera=true)

    monkeypatch.setattr(camera_motion, "fit_camera", fit)
    knocks = [np.deg2rad([0.4, 0.0, 0.0]), np.zeros(3), np.deg2rad([-0.2, 0.3, 0.0])]
    demos = [
        demonstration(np.random.default_rng(3), moved(turn, np.zeros(3)), frames=40, noise=0.0)
        for turn in knocks
    ]
    camera, twists = camera_motion._camera_of_episodes(demos, IMAGE)
    assert torch.equal(camera, true)
    # Each is relative to the median: of the second, which did not move.
    np.testing.assert_allclose(twists[:, :3], knocks, atol=2e-5)
    np.testing.assert_allclose(twists[:, 3:], np.zeros((3, 3)), atol=2e-5)
    # The same motion in all three: their images agree once the camera's motion is undone.
    seen = demos[1].visible
    assert float((fits[0][0] - fits[0][1])[seen].abs().max()) > 5.0
    for episodes in fits[1:]:
        for feature in episodes:
            np.testing.assert_allclose(feature[seen], demos[1].feature[seen], atol=0.05)
