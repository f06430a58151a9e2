import numpy as np
import pytest
import torch

from hrc_learn.geometry import Pose
from hrc_learn.kinematics import panda
from hrc_learn.sim import (
    HAND_MARKER,
    EGLCamera,
    RenderingUnavailableError,
    World,
    open_camera,
    rendering,
)
from hrc_learn.sim.workplace import Workplace
from hrc_learn.vision import MarkerDetector, SyntheticCamera, centre

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

    monkeypatch.setattr(rendering, "_open_context", unavailable)
    rng = np.random.default_rng(0)
    assert isinstance(open_camera(world, "auto", rng=rng), SyntheticCamera)
    with pytest.raises(RenderingUnavailableError, match="Install"):
        open_camera(world, "egl", rng=rng)
