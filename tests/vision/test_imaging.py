"""Lens, noise and the camera without OpenGL."""

import numpy as np
import pytest
from marker_scenes import MARKER, camera_on, corners_of, overhead, poses_in_view

from hrc_learn.protocols import Camera
from hrc_learn.vision import (
    CameraModel,
    ImageNoise,
    Lens,
    Marker,
    MarkerDetector,
    SyntheticCamera,
)
from hrc_learn.vision.imaging import pixel_rays, table_top

GREY = np.full((90, 120, 3), 128, dtype=np.uint8)


def test_noise_has_the_standard_deviation_asked_for():
    image = ImageNoise(blur=0.0, noise=3.0).degrade(GREY, np.random.default_rng(0))
    error = image.astype(float) - 128
    # Rounding to whole grey levels adds a variance of 1/12.
    assert error.std() == pytest.approx(np.sqrt(9 + 1 / 12), rel=0.03)
    assert abs(error.mean()) < 0.1
    assert np.corrcoef(error[0].ravel(), error[1].ravel())[0, 1] == pytest.approx(0, abs=0.15)


def test_noise_saturates_instead_of_wrapping():
    white = np.full((40, 40, 3), 255, dtype=np.uint8)
    image = ImageNoise(blur=0.0, noise=5.0).degrade(white, np.random.default_rng(0))
    assert image.min() > 200


def test_degrading_is_seeded_and_leaves_its_input_alone():
    first, again = (ImageNoise().degrade(GREY, np.random.default_rng(4)) for _ in range(2))
    other = ImageNoise().degrade(GREY, np.random.default_rng(5))
    assert (first == again).all()
    assert (first != other).any()
    assert (GREY == 128).all()


def test_switched_off_noise_returns_an_equal_copy():
    image = ImageNoise(blur=0.0, noise=0.0).degrade(GREY, np.random.default_rng(0))
    assert (image == GREY).all()
    assert image is not GREY


def test_blur_softens_an_edge_by_its_standard_deviation():
    edge = np.zeros((20, 40, 3), dtype=np.uint8)
    edge[:, 20:] = 255
    image = ImageNoise(blur=1.5, noise=0.0).degrade(edge, np.random.default_rng(0))
    slope = np.diff(image[10, :, 0].astype(float)) / 255
    offset = np.arange(39) - 19
    # Grey levels are whole numbers, which cuts the tails.
    assert slope.sum() == 1
    assert slope @ offset**2 == pytest.approx(1.5**2, rel=0.05)


@pytest.mark.parametrize("field", ["blur", "noise"])
def test_negative_amounts_are_refused(field):
    with pytest.raises(ValueError, match="must not be negative"):
        ImageNoise(**{field: -0.1})


@pytest.mark.parametrize("k1", [-0.2, 0.0, 0.1])
def test_lens_fills_the_image_from_the_pinhole(k1):
    model = CameraModel(width=320, height=240, focal=(260.0, 250.0), principal=(150.0, 125.0))
    model = CameraModel(
        width=320,
        height=240,
        focal=model.focal,
        principal=model.principal,
        distortion=(k1, 0.02, 1e-3, 0.0, 0.0),
    )
    lens = Lens(model)
    white = np.full((lens.pinhole.height, lens.pinhole.width, 3), 255, dtype=np.uint8)
    assert lens.apply(white).min() == 255  # nowhere does the black outside show
    assert lens.apply(white).shape == (240, 320, 3)


def test_every_pixel_knows_its_ray():
    model = overhead()
    u, v = np.meshgrid(np.arange(1440), np.arange(1080))
    pixels = model.to_pixels(pixel_rays(model).astype(np.float64))
    # Rays are in single precision.
    np.testing.assert_allclose(pixels, np.stack([u, v], axis=-1), atol=1e-3)


def test_a_marker_seen_through_the_lens_lies_where_the_model_says():
    model = overhead()
    lens = Lens(model)
    for pose in poses_in_view(model, MARKER, 10, seed=3):
        rendered = SyntheticCamera(
            lens.pinhole,
            [MARKER],
            lambda pose=pose: {7: pose},
            rng=np.random.default_rng(0),
            noise=ImageNoise(blur=0.0, noise=0.0),
        ).read()
        corners = MarkerDetector([7]).detect(lens.apply(rendered))[7]
        error = corners - model.project(corners_of(MARKER, pose))
        assert np.linalg.norm(error, axis=1).max() < 1.0


CLEAN = ImageNoise(blur=0.0, noise=0.0)


def facing(position, *, scale=(1.0, 1.0, 1.0)):
    pose = np.diag([*scale, 1.0])
    pose[:3, 3] = position
    return pose


def test_is_a_camera():
    assert isinstance(camera_on(overhead(), {}, MARKER), Camera)


def test_an_empty_scene_shows_the_table_top():
    camera = camera_on(overhead(), {}, MARKER, noise=CLEAN)
    assert (camera.read() == table_top(1440, 1080)).all()


def test_frames_do_not_remember_earlier_ones():
    model, shown = overhead(), {}
    camera = camera_on(model, shown, MARKER, noise=CLEAN)
    empty = camera.read()
    for pose in poses_in_view(model, MARKER, 5, seed=0):
        shown[7] = pose
        assert (camera.read() != empty).any()
    shown.clear()
    assert (camera.read() == empty).all()


def test_the_same_seed_gives_the_same_film():
    shown = {7: facing([0.5, 0.1, 0.2])}
    a, b = (camera_on(overhead(), shown, MARKER) for _ in range(2))
    for _ in range(2):
        assert (a.read() == b.read()).all()


def test_a_plate_seen_from_behind_is_not_drawn():
    shown = {7: facing([0.5, 0.0, 0.2], scale=(1.0, -1.0, -1.0))}
    camera = camera_on(overhead(), shown, MARKER, noise=CLEAN)
    shown_back = camera.read()
    shown.clear()
    assert (shown_back == camera.read()).all()


def test_hidden_and_unknown_markers_are_not_drawn():
    shown = {7: facing([0.4, 0.0, 0.2]), 9: facing([0.6, 0.0, 0.2]), 30: facing([0.5, 0.2, 0])}
    covers = iter([set(), {7}, {7, 9}])
    camera = camera_on(overhead(), shown, MARKER, Marker(9, 0.06), hidden=lambda: next(covers))
    seen = [set(MarkerDetector(range(50)).detect(camera.read())) for _ in range(3)]
    assert seen == [{7, 9}, {9}, set()]


def test_the_nearer_plate_covers_the_farther():
    near, far = facing([0.5, 0.0, 0.6]), facing([0.5, 0.0, 0.2])
    for order in ({7: near, 9: far}, {9: far, 7: near}):
        camera = camera_on(overhead(), order, MARKER, Marker(9, 0.02))
        assert set(MarkerDetector([7, 9]).detect(camera.read())) == {7}


@pytest.mark.parametrize(
    "position",
    [
        pytest.param([0.5, 0.0, 1.29], id="against the lens"),
        pytest.param([0.5, 0.0, 1.8], id="behind the camera"),
        pytest.param([3.0, 0.0, 0.0], id="outside the image"),
        pytest.param([0.5, 0.0, 1.25], id="larger than the image"),
        pytest.param([0.5 - 0.585 * 1.3 + 0.01, 0.0, 0.0], id="cut by the edge"),
    ],
)
def test_extreme_positions_are_drawn_or_left_out_without_error(position):
    image = camera_on(overhead(), {7: facing(position)}, MARKER).read()
    assert image.shape == (1080, 1440, 3)


def test_a_marker_cut_by_the_edge_reaches_it():
    model = overhead()
    # A point whose pixel is in the middle of the left edge.
    x, y = model.to_normalised(np.array([0.0, 540.0]))
    position = model.pose[:3, :3] @ (1.3 * np.array([x, y, 1.0])) + model.pose[:3, 3]
    shown = {7: facing(position)}
    camera = camera_on(model, shown, MARKER, noise=CLEAN)
    cut = camera.read()
    shown.clear()
    changed = (cut != camera.read()).any(axis=-1)
    assert changed[:, 0].sum() > 20
    assert changed.sum() > 500


def test_only_what_changes_is_drawn_anew():
    """A whole frame blurred and made noisy takes twenty times as long."""
    model, shown = overhead(), {}
    camera = camera_on(model, shown, MARKER)
    empty = camera.read()
    for pose in poses_in_view(model, MARKER, 5, seed=1):
        shown[7] = pose
        changed = (camera.read() != empty).any(axis=-1)
        inside = model.project(MARKER.plate_corners @ pose[:3, :3].T + pose[:3, 3])
        low, high = inside.min(axis=0) - 8, inside.max(axis=0) + 8
        v, u = np.nonzero(changed)
        assert ((low[0] < u) & (u < high[0]) & (low[1] < v) & (v < high[1])).all()


def test_markers_of_one_id_are_refused():
    with pytest.raises(ValueError, match="both have id 7"):
        SyntheticCamera(
            overhead(), [MARKER, Marker(7, 0.03)], dict, rng=np.random.default_rng(0)
        )
