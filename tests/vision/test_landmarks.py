"""Tools and objects found among features whose true places are known."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hrc_learn.vision.landmarks import (
    FEWEST_POINTS,
    Features,
    Finding,
    LandmarkDetector,
    Landmarks,
    Object,
    Tool,
    changed_features,
    draw_finding,
    match_view,
    nearest,
)

WIDTH, HEIGHT, FOCUS = 1440, 1080, 1500.0
OPTICS = (FOCUS, 720.0, 540.0, -0.1)
MATRIX = np.array([[FOCUS, 0, 720.0], [0, FOCUS, 540.0], [0, 0, 1]])
LENS = np.array([-0.1, 0, 0, 0])
PLACE = np.array([0.01, -0.02, 0.08])


def descriptors(count, seed=0):
    return np.random.default_rng(seed).integers(0, 200, (count, 128)).astype(np.uint8)


def seen_as(pixels, names):
    return Features(pixels=np.asarray(pixels, float), descriptors=names)


@pytest.mark.parametrize("count", [1, 3, 12])
def test_the_nearest_descriptors_are_those_of_a_full_search(count):
    own, others = descriptors(7), descriptors(9, seed=1)
    apart = np.linalg.norm(own[:, None].astype(float) - others.astype(float), axis=-1)
    order = np.argsort(apart, axis=1)
    padded = np.concatenate([order, np.repeat(order[:, -1:], 3, axis=1)], axis=1)[:, :count]
    index, distance = nearest(own, others, count)
    np.testing.assert_array_equal(index, padded)
    expected = np.take_along_axis(apart, padded, axis=1)
    np.testing.assert_allclose(distance, expected, rtol=1e-4)  # in float32
    same, none = nearest(own, own, 1)
    np.testing.assert_array_equal(same[:, 0], np.arange(7))
    np.testing.assert_allclose(none, 0, atol=1)


def view(count=30, seed=0):
    """A view of an object: its features within 100 px of its middle."""
    pixels = np.random.default_rng(seed).uniform(-100, 100, (count, 2))
    return seen_as(pixels, descriptors(count, seed))


def placed(features, middle, angle, scale, noise=0.0, seed=5):
    """The features turned, scaled and moved, with noise."""
    turn = scale * Rotation.from_euler("z", angle).as_matrix()[:2, :2]
    moved = features.pixels @ turn.T + middle
    moved = moved + np.random.default_rng(seed).normal(0, noise, moved.shape)
    return seen_as(moved, features.descriptors)


@pytest.mark.parametrize(("angle", "scale"), [(0.0, 1.0), (2.5, 0.7), (-1.2, 1.8)])
def test_an_object_is_found_with_middle_direction_and_size(angle, scale):
    found = match_view(view(), placed(view(), (600, 400), angle, scale), WIDTH)
    assert found is not None
    np.testing.assert_allclose(found.pixel, (600, 400), atol=1e-6)
    assert found.angle == pytest.approx(angle, abs=1e-9)
    assert found.scale == pytest.approx(scale, rel=1e-6)
    assert len(found.points) == 30
    # However exact the match, no feature is known better than by 0.15 px.
    assert found.deviation == pytest.approx(0.15 / np.sqrt(30), rel=0.2)


@pytest.mark.parametrize(
    ("scale", "there"), [(0.45, False), (0.55, True), (1.9, True), (2.1, False)]
)
def test_an_object_of_half_to_twice_its_size_counts(scale, there):
    found = match_view(view(), placed(view(), (600, 400), 0.3, scale), WIDTH)
    assert (found is not None) == there


@pytest.mark.parametrize(("count", "there"), [(5, False), (6, True)])
def test_six_features_make_an_object(count, there):
    small = view(count)
    assert (match_view(small, placed(small, (600, 400), 0.3, 1.0), WIDTH) is not None) == there
    clutter = placed(view(30, seed=3), (900, 300), 1.0, 1.0)
    assert match_view(small, clutter, WIDTH) is None


def test_one_feature_that_matches_many_is_one():
    same = view()
    names = np.repeat(same.descriptors[:1], 30, axis=0)
    names[:, 0] += np.arange(30, dtype=np.uint8)
    alike = seen_as(np.full((2, 2), 50.0), descriptors(2))
    assert match_view(seen_as(same.pixels, names), alike, WIDTH) is None


def test_the_covariance_is_that_of_repeated_findings():
    """Noise of 1 px at every feature: 400 images against what one of them tells."""
    rng, findings = np.random.default_rng(0), []
    for _ in range(400):
        noisy = placed(view(20), (600, 400), 0.4, 1.2, noise=1.0, seed=int(rng.integers(1e9)))
        findings.append(match_view(view(20), noisy, WIDTH))
    assert all(found is not None for found in findings)
    pixels = np.array([found.pixel for found in findings])
    told = np.mean([found.covariance for found in findings], axis=0)
    # 400 samples of a variance scatter by 7 %.
    np.testing.assert_allclose(np.cov(pixels.T), told, atol=0.25 * np.trace(told) / 2)


def test_points_that_look_alike_are_told_apart_by_where_they_must_be():
    """Half of the points have a twin elsewhere on the tool, so no match of theirs is clear."""
    own = tool()
    names = own.descriptors.copy()
    names[20:30] = names[30:]
    alike = Tool(points=own.points, descriptors=names, place=PLACE, optics=OPTICS)
    found = alike.find(seen_as(imaged(own.points), names), WIDTH)
    assert found is not None
    assert len(found.points) == 40
    np.testing.assert_allclose(found.pixel, imaged(PLACE[None])[0], atol=1e-3)


def test_the_view_with_most_features_is_taken():
    views = (view(12, seed=1), view(25, seed=2))
    places = ((300, 300), (900, 700))
    both = [placed(v, place, 0.0, 1.0) for v, place in zip(views, places, strict=True)]
    pixels = np.concatenate([one.pixels for one in both])
    names = np.concatenate([one.descriptors for one in both])
    found = Object(views=views).find(seen_as(pixels, names), WIDTH)
    assert found is not None
    np.testing.assert_allclose(found.pixel, (900, 700), atol=1e-6)
    assert Object(views=()).find(seen_as(pixels, names), WIDTH) is None


def tool(count=40):
    points = np.random.default_rng(0).uniform(-0.06, 0.06, (count, 3))
    return Tool(points=points, descriptors=descriptors(count), place=PLACE, optics=OPTICS)


def imaged(points, distance=0.8):
    """Pixels of points of the link by OpenCV."""
    turn, shift = np.array([0.3, -0.5, 0.2]), np.array([0.05, -0.03, distance])
    return cv2.projectPoints(points, turn, shift, MATRIX, LENS)[0][:, 0]


@pytest.mark.parametrize("wrong", [0, 10])
def test_the_place_on_a_tool_is_where_its_points_put_it(wrong):
    """Also where a quarter of the matches is of something else."""
    own = tool()
    pixels = imaged(own.points)
    pixels[:wrong] += np.random.default_rng(1).uniform(60, 200, (wrong, 2))
    found = own.find(seen_as(pixels, own.descriptors), WIDTH)
    assert found is not None
    np.testing.assert_allclose(found.pixel, imaged(PLACE[None])[0], atol=1e-3)
    assert len(found.points) == 40 - wrong
    assert 0 < found.deviation < 0.5
    assert np.isnan(found.angle)


@pytest.mark.parametrize(
    ("count", "there"), [(FEWEST_POINTS - 1, False), (FEWEST_POINTS, True)]
)
def test_eight_points_make_a_tool(count, there):
    own = tool()
    few = seen_as(imaged(own.points)[:count], own.descriptors[:count])
    assert (own.find(few, WIDTH) is not None) == there


@pytest.mark.long
def test_points_that_lie_as_on_no_rigid_tool_are_none():
    elsewhere = np.random.default_rng(2).uniform(0, 1000, (20, 2))
    assert tool().find(seen_as(elsewhere, tool().descriptors[:20]), WIDTH) is None


def scene(width=WIDTH, height=HEIGHT, at=(700, 500)):
    """A grey image with a print of random blocks, and the print's box."""
    image = np.full((height, width, 3), 128, np.uint8)
    blocks = np.random.default_rng(4).integers(0, 255, (12, 12), dtype=np.uint8)
    print_ = cv2.resize(blocks, (180, 180), interpolation=cv2.INTER_CUBIC)
    u, v = at
    image[v : v + 180, u : u + 180] = print_[..., None]
    return image


def test_features_of_a_part_are_at_their_place_in_the_whole_image():
    part = Features.of(scene(), (650, 450, 950, 750))
    assert len(part.pixels) > 20
    assert (part.pixels > (695, 495)).all()
    assert (part.pixels < (890, 690)).all()
    assert len(Features.of(scene(), (0, 0, 200, 200)).pixels) == 0


def learned(image, middle):
    """The print's features about its middle as an object."""
    seen = Features.of(image)
    return Object(views=(seen_as(seen.pixels - middle, seen.descriptors),))


def test_an_object_is_followed_and_found_again_after_it_was_gone():
    size = (1000, 600)
    first = scene(*size, at=(500, 300))
    landmarks = Landmarks(
        tool=tool(), objects={"box": learned(first, (590, 390))}, image_size=size
    )
    detector, empty = LandmarkDetector(landmarks), np.full_like(first, 128)
    assert detector.find(empty, ["box", "tool"]) == {}
    for at in ((500, 300), (515, 310), (200, 100)):  # the last one jumps out of the margin
        for _ in range(3 if at == (200, 100) else 1):
            found = detector.find(scene(*size, at=at), ["box"])
        expected = np.add(at, 90)
        np.testing.assert_allclose(found["box"].pixel, expected, atol=0.5)
    with pytest.raises(ValueError, match=r"images are 640x480, but .* learned from 1000x600"):
        detector.find(np.zeros((480, 640, 3), np.uint8), ["box"])


def test_features_are_of_what_changed_and_near_the_line_that_is_given():
    grey = scene()[..., 0]
    usual = np.full_like(grey, 128)
    everywhere = changed_features(grey, usual)
    assert len(everywhere.pixels) > 20
    assert ((everywhere.pixels > (690, 490)) & (everywhere.pixels < (890, 690))).all()
    assert len(changed_features(grey, grey).pixels) == 0
    faint = np.where(np.arange(WIDTH) % 40 < 20, 128 + 14, 128).astype(np.uint8)
    assert len(changed_features(np.broadcast_to(faint, grey.shape).copy(), usual).pixels) == 0
    far = np.array([[100.0, 100.0], [100.0, 900.0]])
    assert len(changed_features(grey, usual, far).pixels) == 0
    near = np.array([[790.0, 0.0], [790.0, 1000.0]])
    assert len(changed_features(grey, usual, near).pixels) > 20


def test_features_between_two_changes_do_not_count():
    rng = np.random.default_rng(0)
    usual = cv2.GaussianBlur(rng.integers(0, 256, (300, 400), np.uint8), (0, 0), 2.0)
    usual = cv2.normalize(usual, None, 0, 255, cv2.NORM_MINMAX)
    image = usual.copy()
    corners = ((30, 40), (200, 300))
    for v, u in corners:
        image[v : v + 60, u : u + 60] = usual[v : v + 60, u : u + 60].T
    found = changed_features(image, usual).pixels
    from_changes = [np.abs(found - (u + 30, v + 30)).max(axis=1) < 30 + 10 for v, u in corners]
    assert np.logical_or(*from_changes).all()
    assert all(of.sum() > 3 for of in from_changes)


def test_a_finding_is_drawn_about_its_place():
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    points = np.array([[500.0, 400.0], [700.0, 400.0], [600.0, 500.0]])
    cov = np.diag([400.0, 25.0])
    found = Finding(pixel=np.array([600.0, 430.0]), covariance=cov, angle=0.0, points=points)
    draw_finding(image, found)
    drawn = np.argwhere(image.any(-1))
    np.testing.assert_allclose(drawn.min(0)[::-1], (497, 397), atol=3)
    # The arrow is 120 px long; the ellipse of two deviations is 80 px wide.
    assert image[430, 715].any()
    assert image[430, 640].any()
    assert not image[470, 600].any()


def test_a_finding_without_direction_has_no_arrow_and_an_ellipse_of_two_deviations():
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    turn = Rotation.from_euler("z", 0.5).as_matrix()[:2, :2]
    covariance = turn @ np.diag([900.0, 100.0]) @ turn.T
    points = np.array([[100.0, 100.0], [160.0, 100.0], [130.0, 150.0]])
    place = np.array([700.0, 500.0])
    draw_finding(image, Finding(pixel=place, covariance=covariance, points=points))
    red = (image == (255, 40, 40)).all(axis=-1)
    for angle in np.linspace(0, 2 * np.pi, 24):
        on = place + turn @ (60 * np.cos(angle), 20 * np.sin(angle))
        u, v = np.rint(on).astype(int)
        assert red[v - 2 : v + 3, u - 2 : u + 3].any()
    assert not (image == (40, 120, 255)).all(axis=-1).any()
    yellow = (image == (255, 220, 0)).all(axis=-1)
    for u, v in points.astype(int):
        assert yellow[v, u]
        assert yellow[v, u + 3]
        assert not yellow[v, u + 5]
    # The outline of the points is closed.
    green = (image == (40, 220, 60)).all(axis=-1)
    for middle in ((130, 100), (115, 125), (145, 125)):
        assert green[middle[1] - 2 : middle[1] + 3, middle[0] - 2 : middle[0] + 3].any()
    # The cross at the place is 36 px wide in an image of 1440 px.
    assert red[500, 700]
    across = np.flatnonzero(red[500, 670:730]) + 670
    assert 34 <= np.ptp(across[np.abs(across - 700) < 25]) <= 42


def test_an_arrow_of_forty_pixels_per_480_shows_the_direction():
    image = np.zeros((360, 480, 3), np.uint8)
    points = np.array([[10.0, 10.0], [20.0, 10.0], [10.0, 20.0]])
    place, angle = np.array([200.0, 180.0]), -0.7
    found = Finding(pixel=place, covariance=np.eye(2) * 1e-6, angle=angle, points=points)
    draw_finding(image, found)
    blue = np.argwhere((image == (40, 120, 255)).all(axis=-1))[:, ::-1]
    end = place + 40 * np.array([np.cos(angle), np.sin(angle)])
    along = (blue - place) @ (end - place) / 40
    assert along.max() == pytest.approx(40, abs=1.5)
    assert along.min() > -1.5
    # Its head is a tenth of its length.
    across = (blue - place) @ ((end - place)[::-1] * (-1, 1)) / 40
    assert np.abs(across).max() < 5
    red = np.argwhere((image == (255, 40, 40)).all(axis=-1))[:, ::-1]
    # The smallest ellipse has half axes of 2 px, the cross arms of 6 px.
    assert np.abs(red - place).max() == 6


@pytest.mark.parametrize("at", [(0, 0), (WIDTH - 180, HEIGHT - 180)])
def test_what_changed_at_the_edge_of_an_image_has_features_too(at):
    grey = scene(at=at)[..., 0]
    found = changed_features(grey, np.full_like(grey, 128))
    assert len(found.pixels) > 20
    inside = (found.pixels > np.subtract(at, 6)) & (found.pixels < np.add(at, 186))
    assert inside.all()


def test_a_line_counts_up_to_six_hundredths_of_the_width_aside():
    grey, usual = scene()[..., 0], np.full((HEIGHT, WIDTH), 128, np.uint8)
    everywhere = changed_features(grey, usual).pixels
    line = np.array([[650.0, 0.0], [650.0, 1000.0]])
    near = changed_features(grey, usual, line).pixels
    reach = 0.06 * WIDTH
    assert 5 < len(near) < len(everywhere)
    assert near[:, 0].max() < 650 + reach + 2
    left_out = everywhere[everywhere[:, 0] > 650 + reach + 2]
    assert len(left_out) > 5
    inside = everywhere[everywhere[:, 0] < 650 + reach - 9]
    apart = np.linalg.norm(inside[:, None] - near, axis=-1).min(axis=1)
    assert (apart < 0.5).mean() > 0.8


def test_a_change_of_14_grey_levels_is_none_and_one_of_15_is():
    rng = np.random.default_rng(0)
    usual = np.full((HEIGHT, WIDTH), 100, np.uint8)
    blocks = np.kron(rng.integers(0, 2, (12, 12)), np.ones((15, 15))).astype(np.uint8)
    for level, there in ((14, False), (15, True)):
        image = usual.copy()
        image[500:680, 700:880] += np.uint8(level) * blocks
        assert (len(changed_features(image, usual).pixels) > 0) == there
    noise = usual.copy()
    noise[rng.integers(0, HEIGHT, 300), rng.integers(0, WIDTH, 300)] = 255
    assert len(changed_features(noise, usual).pixels) == 0


def test_features_of_a_flat_image_are_none_in_the_shape_of_some():
    none = Features.of(np.full((200, 300, 3), 77, np.uint8))
    assert none.pixels.shape == (0, 2)
    assert none.descriptors.shape == (0, 128)
    grey = scene()[..., 0]
    same = changed_features(grey, grey)
    assert (same.pixels.shape, same.descriptors.shape) == ((0, 2), (0, 128))
