"""A scene without markers: nothing of them is left but the frames to measure against."""

from dataclasses import replace

import numpy as np
import pytest

from hrc_learn.sim import HAND_MARKER, RenderingUnavailableError, World, open_camera
from hrc_learn.sim.scene import UnmarkedLook, unmarked
from hrc_learn.sim.workplace import Workplace
from hrc_learn.vision import MarkerDetector

MARKED = Workplace()
PLACE = np.array([0.01, -0.02, -0.1])


@pytest.fixture(scope="module")
def world():
    look = UnmarkedLook(seed=3, clutter=4, distractors=2)
    world = World(unmarked(MARKED.scene, look, PLACE))
    world.reset(MARKED.hover_joints().numpy(), {})
    return world


def test_no_plate_is_left_and_clutter_touches_nothing(world):
    model = world.model
    names = [model.geom(i).name for i in range(model.ngeom)]
    assert not [name for name in names if "marker" in name]
    clutter = [n for n in names if n.startswith(("clutter", "distractor"))]
    assert len(clutter) == 6
    assert not any(model.geom(n).contype or model.geom(n).conaffinity for n in clutter)
    # The measured place is where it is said to be, in the tool's frame.
    np.testing.assert_allclose(world.hand_marker_offset(), PLACE, atol=1e-9)


def test_clutter_lies_clear_of_the_objects(world):
    middle, half = (x.numpy() for x in MARKED.object_region())
    model = world.model
    for k in range(4):
        geom = model.geom(f"clutter{k}")
        reach = np.linalg.norm(geom.size[:2])
        apart = np.abs(geom.pos[:2] - middle[:2]) - reach
        assert (apart > half[:2] - 0.06).any()


def test_the_same_object_has_the_same_print_in_every_scene(world):
    def print_of(seed):
        spec = World(unmarked(MARKED.scene, UnmarkedLook(seed=seed))).describe()
        return spec.texture("box_print").data

    assert print_of(1) == print_of(2)


@pytest.mark.long
@pytest.mark.egl
def test_a_camera_sees_no_marker(world):
    try:
        camera = open_camera(world, "egl", rng=np.random.default_rng(0))
    except RenderingUnavailableError as error:
        pytest.skip(str(error))
    ids = [HAND_MARKER, *(item.marker.id for item in world.config.objects)]
    image = camera.read()
    assert MarkerDetector(ids).detect(image) == {}
    assert image.std() > 20
    marked = World(replace(MARKED.scene, camera=world.config.camera))
    marked.reset(MARKED.hover_joints().numpy(), {})
    shown = open_camera(marked, "egl", rng=np.random.default_rng(0)).read()
    assert HAND_MARKER in MarkerDetector(ids).detect(shown)
