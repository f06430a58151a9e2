"""Lens, noise and the camera without OpenGL."""

from dataclasses import replace

import numpy as np
import pytest
from marker_scenes import MARKER, camera_on, corners_of, overhead, poses_in_view
from scipy.spatial.transform import Rotation

from hrc_learn.protocols import Camera
from hrc_learn.vision import (
    CameraModel,
    ImageNoise,
    Lens,
    Marker,
    MarkerDetector,
    SyntheticCamera,
)
from hrc_learn.vision.imaging import (
    _octave,
    _octaves,
    carton,
    pixel_rays,
    table_top,
    wood_grain,
)
from hrc_learn.vision.markers import marker_texture

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


@pytest.mark.parametrize(("lower", "drawn"), [(0.04, False), (0.08, True)])
def test_a_plate_that_reaches_behind_the_camera_is_not_drawn(lower, drawn):
    """Tilted, one corner up: the projection of a plate through the camera's plane diverges."""
    pose = np.eye(4)
    turn = Rotation.from_euler("y", -75, degrees=True) * Rotation.from_euler("z", np.pi / 4)
    pose[:3, :3] = turn.as_matrix()
    pose[:3, 3] = [0.53, 0.0, 1.3 - lower]
    plate = Marker(7, 0.06)
    corners = plate.plate_corners @ pose[:3, :3].T + pose[:3, 3]
    assert (corners[:, 2].max() > 1.28) == (not drawn)
    small = replace(
        overhead(), width=320, height=240, focal=(320.0, 320.0), principal=(160.0, 120.0)
    )
    assert small.in_view(corners).any()
    camera = camera_on(small, {7: pose}, plate, noise=CLEAN)
    assert (camera.read() != table_top(320, 240)).any() == drawn


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


def test_rows_of_a_large_noisy_image_differ_and_their_noise_has_its_size():
    """Of one pool of samples at random shifts; small images have samples of their own."""
    large = np.full((300, 400, 3), 128, dtype=np.uint8)
    error = ImageNoise(blur=0.0, noise=3.0).degrade(large, np.random.default_rng(0)) - 128.0
    assert error.std() == pytest.approx(np.sqrt(9 + 1 / 12), rel=0.02)
    assert abs(error.mean()) < 0.1
    rows = error.reshape(300, -1)
    assert len(np.unique(rows, axis=0)) > 290
    # No two neighbours are shifted by one pixel, and colours are independent.
    assert abs(np.corrcoef(rows[:-1, 3:].ravel(), rows[1:, :-3].ravel())[0, 1]) < 0.02
    assert abs(np.corrcoef(error[..., 0].ravel(), error[..., 1].ravel())[0, 1]) < 0.02
    small = ImageNoise(blur=0.0, noise=3.0).degrade(large[:80, :90], np.random.default_rng(0))
    samples = small.astype(int).ravel() - 128
    repeated = np.lib.stride_tricks.sliding_window_view(samples, 12)
    assert len(np.unique(repeated, axis=0)) > 0.999 * len(repeated)


def test_a_pinhole_for_a_lens_is_as_large_as_its_widest_ray():
    model = CameraModel(
        width=320,
        height=240,
        focal=(260.0, 250.0),
        principal=(150.0, 125.0),
        distortion=(-0.2, 0.02, 1e-3, 0.0, 0.0),
    )
    pinhole = Lens(model).pinhole
    assert pinhole.focal == (260.0, 260.0)
    assert pinhole.principal == ((pinhole.width - 1) / 2, (pinhole.height - 1) / 2)
    assert not any(pinhole.distortion)
    assert pinhole.width % 2 == pinhole.height % 2 == 0
    u, v = np.meshgrid(np.arange(-0.5, 320, 1), np.arange(-0.5, 240, 1))
    rays = model.to_normalised(np.stack([u, v], axis=-1).reshape(-1, 2))
    widest = 260.0 * np.abs(rays).max(axis=0)
    spare = np.array([pinhole.width, pinhole.height]) / 2 - widest
    # Two pixels for the interpolation, rounded up to whole ones.
    assert (spare >= 1.99).all()
    assert (spare < 3.01).all()


def test_the_table_is_lit_from_its_upper_left():
    image = table_top(201, 101).astype(float)
    colour = np.array([168.0, 148.0, 124.0])
    for (v, u), light in {
        (0, 0): 1.0,
        (0, 200): 0.76,
        (100, 0): 0.84,
        (100, 200): 0.6,
        (50, 100): 1.0,
        (50, 0): 1.02,
        (50, 150): 0.915,
        (25, 100): 1.015,
    }.items():
        np.testing.assert_allclose(image[v, u], light * colour, atol=0.51)


def test_grain_runs_along_the_wood():
    image = wood_grain(np.random.default_rng(0)).astype(float)
    np.testing.assert_allclose(image.mean(axis=(0, 1)), (205, 185, 160), rtol=0.01)
    np.testing.assert_allclose(
        image.std(axis=(0, 1)) / image.mean(axis=(0, 1)), 0.06, atol=3e-3
    )
    grey = image[..., 0] - image[..., 0].mean()
    along = (grey[:, :-20] * grey[:, 20:]).mean() / grey.var()
    across = (grey[:-3] * grey[3:]).mean() / grey.var()
    # Blurred by s, noise a distance d apart correlates by exp(-d^2 / 4 s^2).
    assert along == pytest.approx(np.exp(-(20**2) / (4 * 40**2)), abs=0.03)
    assert across == pytest.approx(np.exp(-(3**2) / (4 * 1.5**2)), abs=0.05)


def test_a_carton_has_its_colour_and_print_by_its_name():
    red = (0.8, 0.2, 0.1, 1.0)
    one, again, other = carton("a", red), carton("a", red), carton("b", red)
    assert one.shape == (512, 256, 3)
    np.testing.assert_array_equal(one, again)
    assert (one != other).any(axis=-1).mean() > 0.2
    base = np.array([204, 51, 25])
    for image in (one, other):
        assert 0.2 < (image == base).all(axis=-1).mean() < 0.9
    # All is printed on the base colour: another one shows in the same places.
    blue = carton("a", (0.1, 0.2, 0.8, 1.0))
    differs, plain = (one != blue).any(axis=-1), (one == base).all(axis=-1)
    assert differs[plain].all()
    assert differs[~plain].mean() < 0.1  # OpenCV 5 blends the edges of letters
    # Words in white and black, in five rows of the height.
    for ink in ((250, 250, 245), (20, 20, 25)):
        rows = np.flatnonzero((one == ink).all(axis=-1).any(axis=1))
        assert np.ptp(rows) > 100


@pytest.mark.parametrize(
    ("edge", "module"),
    [(3.0, 1), (8.0, 1), (11.0, 1), (11.6, 2), (60.0, 8), (130.0, 16), (4000.0, 64)],
)
def test_a_plates_texture_is_the_octave_of_its_size_in_the_image(edge, module):
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    for angle in (0.0, 0.5):
        c, s = np.cos(angle), np.sin(angle)
        pixels = 100 + edge * square @ np.array([[c, s], [-s, c]])
        assert 2 ** _octave(pixels) == module
    # The mean of all edges counts.
    wide = pixels + 0.2 * (pixels - pixels[0]) * [1, 0]
    assert 2 ** _octave(wide) >= module


def test_textures_of_a_plate_have_a_clear_border_and_grey_between_ink_and_paper():
    for k, texture in enumerate(_octaves(7)):
        size = 8 * 2**k + 2
        assert texture.shape == (size, size, 2)
        alpha = np.zeros((size, size))
        alpha[1:-1, 1:-1] = 1
        np.testing.assert_array_equal(texture[..., 1], alpha)
        np.testing.assert_array_equal(texture[..., 0][alpha == 0], 0)
        inner = texture[1:-1, 1:-1, 0]
        np.testing.assert_allclose(inner, 25 + 210 * (marker_texture(7, size - 2) / 255.0))
        assert inner[0, 0] == 235  # paper
        assert inner.min() == 25  # ink


def test_a_plates_region_has_room_for_the_blur_of_its_edge():
    pixels = np.array([[100.4, 50.6], [140.2, 52.0], [139.0, 90.9], [101.0, 88.0]])
    small = CameraModel(width=64, height=48)
    for blur, room in ((0.0, 2), (0.7, 5), (2.0, 8)):
        noise = ImageNoise(blur=blur, noise=0.0)
        rows, columns = camera_on(small, {}, MARKER, noise=noise)._around(pixels)
        assert (rows.start, rows.stop) == (50 - room, 91 + room + 1)
        assert (columns.start, columns.stop) == (100 - room, 141 + room + 1)
        cut = camera_on(small, {}, MARKER, noise=noise)._around(pixels - [139, 200])
        assert (cut[1].start, cut[0].start, cut[0].stop) == (0, 0, 0)


@pytest.mark.parametrize(("height", "drawn"), [(1.27, True), (1.285, False)])
def test_a_plate_two_centimetres_before_the_lens_is_no_longer_drawn(height, drawn):
    camera = camera_on(overhead(), {7: facing([0.5, 0.0, height])}, Marker(7, 0.001))
    assert len(camera._visible()) == drawn
