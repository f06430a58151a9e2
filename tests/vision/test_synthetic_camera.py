import numpy as np
import pytest
from marker_scenes import MARKER, camera_on, overhead, poses_in_view

from hrc_learn.protocols import Camera
from hrc_learn.vision import ImageNoise, Marker, MarkerDetector, SyntheticCamera

CLEAN = ImageNoise(blur=0.0, noise=0.0)


def facing(position, *, scale=(1.0, 1.0, 1.0)):
    pose = np.diag([*scale, 1.0])
    pose[:3, 3] = position
    return pose


def test_is_a_camera():
    assert isinstance(camera_on(overhead(), {}, MARKER), Camera)


def test_an_empty_scene_shows_the_background():
    background = np.full((1080, 1440, 3), 90, dtype=np.uint8)
    camera = camera_on(overhead(), {}, MARKER, noise=CLEAN, background=background)
    assert (camera.read() == background).all()


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


@pytest.mark.parametrize(
    ("markers", "background", "message"),
    [
        ([MARKER, Marker(7, 0.03)], None, "share id 7"),
        ([MARKER], np.zeros((10, 10, 3), dtype=np.uint8), "must be 1440x1080"),
    ],
)
def test_bad_scenes_are_refused(markers, background, message):
    with pytest.raises(ValueError, match=message):
        SyntheticCamera(
            overhead(), markers, dict, rng=np.random.default_rng(0), background=background
        )
