"""Films: what is written over pictures, drawings without OpenGL, the file itself."""

from io import BytesIO

import av
import numpy as np
import pytest
from sample_runs import sample_run

from hrc_learn.geometry import Body, Box, Capsule
from hrc_learn.geometry.shapes import Line
from hrc_learn.vision import CameraModel
from hrc_learn.viz import palette
from hrc_learn.viz.film import annotated, camera_inset, draw_run, film_mp4


@pytest.fixture
def camera():
    model = CameraModel(width=200, height=100, focal=(120.0, 120.0), principal=(99.5, 49.5))
    return model.look_at(np.array([2.0, 0.0, 0.5]), np.zeros(3))


def run_of(bodies=(), boxes=()):
    return sample_run(bodies=bodies, boxes=boxes, region=None, camera=None)


def still(**shapes):
    steps = len(sample_run().time)
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (steps, 1))
    return Body(name="it", position=np.zeros((steps, 3)), orientation=upright, **shapes)


def pixel(picture, camera, point):
    u, v = camera.project(np.array(point)).round().astype(int)
    return picture[v, u].tolist()


def test_a_film_is_decoded_with_its_rate_size_and_order():
    levels = (20, 120, 220)
    pictures = [np.full((48, 64, 3), level, np.uint8) for level in levels]
    with av.open(BytesIO(film_mp4(pictures, 12.5))) as file:
        stream = file.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt) == ("h264", "yuv420p")
        assert float(stream.average_rate) == 12.5
        shown = [frame.to_ndarray(format="rgb24") for frame in file.decode(stream)]
    assert [image.shape for image in shown] == [(48, 64, 3)] * 3
    np.testing.assert_allclose([image.mean() for image in shown], levels, atol=6)


def test_the_caption_is_below_the_inset():
    plain = np.full((300, 400, 3), 200, np.uint8)
    inset = np.full((40, 60, 3), 90, np.uint8)
    shown = annotated(plain, "Grasps", "3 s", [("plan", palette.GREEN)], inset)
    assert shown.shape == plain.shape
    assert (shown[-20:, :100] == 255).any()  # white letters
    assert (shown[-20:, -60:] == 255).any()
    np.testing.assert_array_equal(shown[214:254, 330:390], inset)
    green = palette.rgba(palette.GREEN)[:3]
    assert (shown[:40, :100] == green).all(-1).any()
    np.testing.assert_array_equal(shown[100:200, 100:300], plain[100:200, 100:300])


def test_the_inset_shows_the_last_image_with_marker_and_target():
    run = sample_run()
    recorded = run.camera
    assert recorded is not None
    inset = camera_inset(recorded, 4 * recorded.model.width)
    step = int(np.flatnonzero(np.isfinite(recorded.feature - recorded.target).all(-1))[0])
    shown = inset(step, float(run.time[step]))
    for points, colour in (
        (recorded.feature, palette.VERMILION),
        (recorded.target, palette.GREEN),
    ):
        at = points[step] * shown.shape[1] / recorded.model.width
        rows, columns = np.nonzero((shown == palette.rgba(colour)[:3]).all(-1))
        assert len(rows)
        np.testing.assert_allclose([columns.mean(), rows.mean()], at, atol=6)


def test_bodies_and_boxes_are_drawn_where_the_camera_projects_them(camera):
    capsule = Capsule(
        start=(0.0, -0.5, 0.0), end=(0.0, 0.5, 0.0), radius=0.06, colour=(0.0, 0.0, 1.0, 1.0)
    )
    box = Box(centre=(0.0, 0.0, 0.3), half_size=(0.1, 0.1, 0.1), colour=(1.0, 0.0, 0.0, 1.0))
    picture = draw_run(run_of((still(capsules=(capsule,)),), (box,)), 0, camera)
    assert pixel(picture, camera, (0, 0.4, 0)) == [0, 0, 255]
    assert pixel(picture, camera, (0, -0.4, 0)) == [0, 0, 255]
    red = np.argwhere((picture == [255, 0, 0]).all(-1))
    for edge in ((0.1, 0.1, 0.3), (0.1, 0.0, 0.4), (0.1, 0.0, 0.2)):
        u, v = camera.project(np.array(edge))
        assert np.abs(red - [v, u]).max(axis=1).min() <= 1
    background = pixel(picture, camera, (0, 0.4, 0.3))
    assert pixel(picture, camera, (0.1, 0.0, 0.3)) == background


def test_a_turned_body_is_drawn_turned(camera):
    steps = len(sample_run().time)
    quarter = np.tile([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0], (steps, 1))  # about x: y to z
    capsule = Capsule(
        start=(0.0, 0.0, 0.0), end=(0.0, 0.3, 0.0), radius=0.03, colour=(0.0, 0.0, 1.0, 1.0)
    )
    body = Body(
        name="it", position=np.zeros((steps, 3)), orientation=quarter, capsules=(capsule,)
    )
    picture = draw_run(run_of((body,)), 0, camera)
    assert pixel(picture, camera, (0, 0, 0.2)) == [0, 0, 255]
    assert pixel(picture, camera, (0, 0.2, 0)) != [0, 0, 255]


def test_near_objects_hide_far_ones(camera):
    def rod(x, colour):
        start, end = (x, -0.3, 0.0), (x, 0.3, 0.0)
        return Capsule(start=start, end=end, radius=0.05, colour=colour)

    near, far = rod(0.5, (0.0, 1.0, 0.0, 1.0)), rod(0.3, (1.0, 0.0, 0.0, 1.0))
    for rods in ((near, far), (far, near)):
        picture = draw_run(run_of((still(capsules=rods),)), 0, camera)
        assert pixel(picture, camera, (0.5, 0, 0)) == [0, 255, 0]


def test_lines_are_drawn_and_those_behind_the_camera_are_not(camera):
    def line(x):
        start, end = np.array([x, -0.3, 0.0]), np.array([x, 0.3, 0.0])
        return Line(start=start, end=end, colour=(0.0, 0.0, 1.0, 1.0), width=0.05)

    blue = [0, 0, 255]
    assert pixel(draw_run(run_of(), 0, camera, [line(0.0)]), camera, (0, 0.1, 0)) == blue
    bare = draw_run(run_of(), 0, camera)
    np.testing.assert_array_equal(draw_run(run_of(), 0, camera, [line(4.0)]), bare)
