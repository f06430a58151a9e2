"""Cameras on the workplace: rendered images, occluded markers, cameras that are moved."""

import mujoco
import numpy as np
import pytest
import torch
from sample_runs import sample_run

from hrc_learn.geometry import Body, Box, Capsule, Pose
from hrc_learn.geometry.shapes import Line
from hrc_learn.kinematics import panda
from hrc_learn.sim import (
    HAND_MARKER,
    CameraChange,
    ChangingCamera,
    OcclusionInterval,
    RecordedWorld,
    RenderingUnavailableError,
    SceneConfig,
    ScriptedOcclusion,
    World,
    cameras,
    open_camera,
)
from hrc_learn.sim.cameras import EGLCamera
from hrc_learn.sim.scene import NOWHERE
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.marker_sensor import MarkerSensor
from hrc_learn.vision import CameraModel, MarkerDetector, SyntheticCamera, centre

WORKPLACE = Workplace()


def beside_the_box():
    hover = WORKPLACE.hover()
    beside = Pose(hover.position + torch.tensor([0.18, 0.02, 0.0]), hover.orientation)
    return panda.inverse(beside, 0.2, near=panda.ready).numpy()


@pytest.fixture
def world():
    world = World(WORKPLACE.scene)
    world.reset(beside_the_box())
    return world


def egl_or_skip(world):
    try:
        return EGLCamera(world, rng=np.random.default_rng(0))
    except RenderingUnavailableError as reason:
        pytest.skip(str(reason))


def detected(world, image):
    ids = [HAND_MARKER, *(item.marker.id for item in world.config.objects)]
    return {id: centre(corners) for id, corners in MarkerDetector(ids).detect(image).items()}


def projected(world):
    camera = world.config.camera
    return {id: camera.project(pose[:3, 3]) for id, pose in world.marker_poses().items()}


@pytest.mark.long
@pytest.mark.egl
def test_a_camera_sees_on_when_the_one_before_it_is_gone(world):
    camera = egl_or_skip(world)
    seen = set(detected(world, camera.read()))
    camera = EGLCamera(world, rng=np.random.default_rng(0))  # the first one is dropped here
    assert set(detected(world, camera.read())) == seen
    other = EGLCamera(world, rng=np.random.default_rng(0))
    other.close()
    other.close()
    assert set(detected(world, camera.read())) == seen
    camera.close()


@pytest.mark.egl
def test_rendered_markers_stand_where_the_camera_model_says(world):
    camera = egl_or_skip(world)
    found = detected(world, camera.read())
    camera.close()
    assert set(found) == set(projected(world))
    for id, pixel in projected(world).items():
        assert np.linalg.norm(found[id] - pixel) < 0.5


def test_the_camera_without_opengl_sees_the_same(world):
    camera = open_camera(world, "synthetic", rng=np.random.default_rng(0))
    found = detected(world, camera.read())
    assert set(found) == set(projected(world))
    for id, pixel in projected(world).items():
        assert np.linalg.norm(found[id] - pixel) < 0.5


def test_the_arm_hides_what_is_behind_it(world):
    under_the_hand = np.eye(4)
    under_the_hand[:3, 3] = world.arm.tcp_pose()[:3, 3]
    under_the_hand[2, 3] = 0.03
    world.reset(beside_the_box(), {"box": under_the_hand})
    camera = open_camera(world, "synthetic", rng=np.random.default_rng(0))
    assert set(detected(world, camera.read())) == {HAND_MARKER}


def test_without_opengl_auto_falls_back_and_egl_says_what_to_install(world, monkeypatch):
    def unavailable(width, height):
        raise RenderingUnavailableError("no EGL here. Install EGL")

    monkeypatch.setattr(cameras, "_open_context", unavailable)
    rng = np.random.default_rng(0)
    assert isinstance(open_camera(world, "auto", rng=rng), SyntheticCamera)
    with pytest.raises(RenderingUnavailableError, match="Install"):
        open_camera(world, "egl", rng=rng)


@pytest.fixture(scope="module")
def board_world():
    return World(WORKPLACE.scene)


def sensor_for(world, kind):
    return MarkerSensor(
        open_camera(world, kind, rng=np.random.default_rng(0)), WORKPLACE.scene.marker_ids
    )


@pytest.mark.parametrize("kind", ["synthetic", pytest.param("egl", marks=pytest.mark.egl)])
@pytest.mark.long
def test_a_marker_is_hidden_for_a_spell_and_seen_again(board_world, kind):
    board_world.reset(WORKPLACE.hover_joints().numpy())
    sensor = sensor_for(board_world, kind)
    occluder = ScriptedOcclusion(board_world, [OcclusionInterval(start=0.1, duration=0.2)])
    seen = []
    for _ in range(4):
        occluder.update()
        image = sensor.read()
        seen.append(
            (
                round(board_world.time, 3),
                HAND_MARKER in sensor.detect(),
                image.mean(axis=-1).std(),
            )
        )
        board_world.advance(0.1)
    assert [found for _, found, _ in seen] == [True, False, False, True]


def test_nothing_touches_the_board(board_world):
    board_world.reset(WORKPLACE.hover_joints().numpy())
    board_world.move_obstacle("occluder", board_world.arm.tcp_pose()[:3, 3])
    assert board_world.collisions_along(WORKPLACE.hover_joints().numpy()[None]) == []
    board_world.move_obstacle("occluder", NOWHERE)


def test_spells_of_no_length_in_time_are_refused():
    with pytest.raises(ValueError, match="must not be negative"):
        OcclusionInterval(start=-1.0, duration=2.0)


MODEL = SceneConfig().camera
WATCHED = np.array([[0.14, 0.46, 0.06], [0.34, 0.62, 0.06], [0.24, 0.54, 0.25]])


def turn_between(a, b):
    cosine = (np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2
    return float(np.arccos(np.clip(cosine, -1, 1)))


def test_a_changed_camera_is_moved_and_turned_as_far_as_asked_and_sees_what_it_should():
    change, rng = CameraChange(), np.random.default_rng(0)
    directions = []
    for _ in range(20):
        changed = change.applied(MODEL, WATCHED, rng)
        moved = changed.pose[:3, 3] - MODEL.pose[:3, 3]
        assert np.linalg.norm(moved) == pytest.approx(0.10)
        assert turn_between(changed.pose, MODEL.pose) == pytest.approx(np.deg2rad(10))
        assert changed.in_view(WATCHED).all()
        assert changed.distortion == MODEL.distortion
        directions.append(moved)
    assert np.linalg.norm(np.mean(directions, axis=0)) < 0.05


def test_refocusing_scales_the_image_about_the_principal_point():
    change = CameraChange(distance=0.0, angle=0.0, focus=1.1)
    changed = change.applied(MODEL, WATCHED, np.random.default_rng(0))
    offset = MODEL.project(WATCHED) - MODEL.principal
    np.testing.assert_allclose(changed.project(WATCHED) - MODEL.principal, 1.1 * offset)


def test_a_camera_that_would_look_elsewhere_is_refused():
    with pytest.raises(ValueError, match="change it less"):
        CameraChange(focus=9.0).applied(MODEL, WATCHED, np.random.default_rng(0), 50)
    with pytest.raises(ValueError, match="distance must not be negative"):
        CameraChange(distance=-0.1)


def test_images_come_from_the_camera_of_the_day():
    class Named:
        def __init__(self, model):
            self.model = model

        def read(self):
            return np.full((1, 1, 3), int(self.model.focal[0]) % 256, dtype=np.uint8)

    camera = ChangingCamera(MODEL, Named)
    other = CameraChange(focus=1.1).applied(MODEL, WATCHED, np.random.default_rng(1))
    before = camera.read()
    camera.change(3.5, other)
    assert (camera.read() != before).all()
    assert [time for time, _ in camera.history] == [-np.inf, 3.5]
    assert camera.model is other


def test_a_recorded_run_has_its_bodies_where_they_were():
    run = sample_run()
    steps = np.arange(len(run.time))
    turn = np.stack([np.cos(0.01 * steps), 0 * steps, 0 * steps, np.sin(0.01 * steps)], axis=-1)
    place = np.stack([0.01 * steps, 0 * steps, 0.3 + 0 * steps], axis=-1)
    shapes = {
        "boxes": (Box(centre=(0.1, 0.0, 0.0), half_size=(0.01, 0.02, 0.03)),),
        "capsules": (
            Capsule(start=(0.0, 0.0, 0.0), end=(0.2, 0.0, 0.0), radius=0.02),
            Capsule(start=(0.0, 0.3, 0.0), end=(0.0, 0.3, 0.0), radius=0.02),
        ),
    }
    body = Body(name="it", position=place, orientation=turn, **shapes)
    world = RecordedWorld(sample_run(bodies=(body,), boxes=()))
    drawn = np.flatnonzero(world.model.geom_bodyid == world.model.body("body0").id)
    middles = np.array([[0.1, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.3, 0.0]])
    for step in (0, 50, 100):
        world.show(step)
        angle = 0.02 * step
        R = np.array(
            [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
        )
        np.testing.assert_allclose(
            world.data.geom_xpos[drawn], middles @ R.T + place[step], atol=1e-9
        )


def test_opengls_frustum_shows_every_point_at_its_pixel():
    """By the definition of glFrustum, with the image's edges half a pixel outside."""
    model = CameraModel(
        width=320, height=200, focal=(260.0, 240.0), principal=(150.0, 110.0)
    ).look_at(np.array([0.9, 0.4, 1.2]), np.array([0.5, 0.0, 0.1]), roll=0.3)
    view = mujoco.MjvGLCamera()
    view.frustum_near = 0.05
    cameras._set_view(view, model)
    right = np.cross(view.forward, view.up)
    points = np.random.default_rng(0).uniform([0.2, -0.4, 0], [0.9, 0.4, 0.4], (20, 3))
    away = points - view.pos
    depth = away @ view.forward
    x, y = (view.frustum_near * (away @ axis) / depth for axis in (right, view.up))
    u = (x - view.frustum_center + view.frustum_width) / (2 * view.frustum_width) * 320
    height = view.frustum_top - view.frustum_bottom
    v = (view.frustum_top - y) / height * 200
    pixels = np.stack([u, v], axis=-1) - 0.5
    np.testing.assert_allclose(pixels, model.project(points), atol=1e-3)  # single precision
    assert view.orthographic == 0


def test_a_marker_is_hidden_if_a_corner_or_its_middle_is(world):
    model = world.config.camera
    markers = [item.marker for item in world.config.objects]
    markers.append(world.config.arm.marker.marker)
    assert cameras.hidden_markers(world, model, markers) == set()
    marker = markers[0]
    pose, eye = world.marker_poses()[marker.id], model.pose[:3, 3]
    half = np.array([0.07, 0.09, 0.004])
    corners = marker.corners @ pose[:3, :3].T + pose[:3, 3]
    for point in (pose[:3, 3], *corners):
        # The board's corner comes just up to the ray to that point, or falls short of it.
        at = point + 0.3 * (eye - point) / np.linalg.norm(eye - point)
        out = np.sign((point - pose[:3, 3])[:2])
        out[out == 0] = 1
        for gap, hidden in ((-2e-3, True), (2e-3, False)):
            if not hidden and np.allclose(point, pose[:3, 3]):
                continue
            centre = at + np.append(out * (half[:2] + gap), 0.0)
            world.move_obstacle("occluder", centre)
            assert (marker.id in cameras.hidden_markers(world, model, markers)) == hidden
    world.move_obstacle("occluder", NOWHERE)


@pytest.mark.parametrize("change", [CameraChange(), CameraChange(distance=0.02, angle=0.05)])
def test_a_changed_camera_is_as_far_and_as_much_turned_as_asked(change):
    model, rng = WORKPLACE.scene.camera, np.random.default_rng(0)
    middle = np.array([[*WORKPLACE.table_centre, 0.0]])
    for _ in range(5):
        changed = change.applied(model, middle, rng)
        shift = changed.pose[:3, 3] - model.pose[:3, 3]
        assert np.linalg.norm(shift) == pytest.approx(change.distance)
        turn = changed.pose[:3, :3] @ model.pose[:3, :3].T
        assert np.arccos((np.trace(turn) - 1) / 2) == pytest.approx(change.angle)
        assert changed.in_view(middle).all()
        assert changed.focal == model.focal
    closer = CameraChange(distance=0.0, angle=0.0, focus=1.2).applied(model, middle, rng)
    np.testing.assert_allclose(closer.focal, np.multiply(1.2, model.focal))
    np.testing.assert_allclose(closer.pose, model.pose, atol=1e-12)
    with pytest.raises(
        ValueError, match=r"moved by 3 m, turned by 90 degrees and refocused by 2"
    ):
        CameraChange(distance=3.0, angle=np.pi / 2, focus=2.0).applied(
            model, np.array([[9.0, 9.0, 0.0]]), rng, attempts=2
        )


def test_a_board_is_held_ten_centimetres_before_a_marker_for_its_interval(world):
    interval = OcclusionInterval(start=0.5, duration=0.25)
    occlusion, eye = ScriptedOcclusion(world, [interval]), world.config.camera.pose[:3, 3]
    for time, there in ((0.0, False), (0.5, True), (0.7, True), (0.75, False), (0.4, False)):
        world.data.time = time
        occlusion.update()
        board = world.data.body("occluder").xpos
        if there:
            marker = world.marker_poses()[HAND_MARKER][:3, 3]
            assert np.linalg.norm(board - marker) == pytest.approx(0.1)
            towards = (eye - marker) / np.linalg.norm(eye - marker)
            np.testing.assert_allclose(board, marker + 0.1 * towards)
        else:
            np.testing.assert_allclose(board, NOWHERE)


def test_lines_of_a_recording_are_arrows_or_rods_until_the_scene_is_full():
    scene = mujoco.MjvScene(mujoco.MjModel.from_xml_string("<mujoco/>"), maxgeom=2)
    start, end, colour = (
        np.array([0.1, 0.2, 0.3]),
        np.array([0.1, 0.2, 0.9]),
        (0.25, 0.5, 0.75, 1.0),
    )
    for head in (True, False, False):
        cameras._add_line(
            scene, Line(start=start, end=end, width=0.01, colour=colour, head=head)
        )
    assert scene.ngeom == 2
    arrow, rod = scene.geoms[:2]
    assert arrow.type == mujoco.mjtGeom.mjGEOM_ARROW
    assert rod.type == mujoco.mjtGeom.mjGEOM_CAPSULE
    for geom in (arrow, rod):
        np.testing.assert_allclose(geom.rgba, colour)
        np.testing.assert_allclose(geom.mat[:, 2], [0.0, 0.0, 1.0], atol=1e-6)
        assert geom.size[0] == pytest.approx(0.01)
    # An arrow begins at its place, a rod has its middle there.
    np.testing.assert_allclose(arrow.pos, start, atol=1e-6)
    np.testing.assert_allclose(rod.pos, (0.1, 0.2, 0.6), atol=1e-6)
