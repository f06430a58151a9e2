import numpy as np
import pytest

from hrc_learn.experiments import surroundings
from hrc_learn.experiments.surroundings import (
    OBJECTS_REACH,
    THREE_OBJECTS,
    draw_object_poses,
    with_objects,
)
from hrc_learn.sim import World
from hrc_learn.sim.arm_model import FINGER_STROKE
from hrc_learn.sim.workplace import Workplace

WORKPLACE = with_objects(Workplace(), THREE_OBJECTS)
WORLD = World(WORKPLACE.scene)


# Points of the open fingers beside an object, in its frame: along its x axis 4 to 6 cm to
# either side, 1 cm deep; homogeneous.
OPEN_FINGERS = np.array(
    [
        [side * x, y, 0.0, 1.0]
        for side in (-1, 1)
        for x in np.linspace(0.04, 0.06, 9)
        for y in np.linspace(-0.01, 0.01, 9)
    ]
).T


def scattered(seed):
    return draw_object_poses(WORKPLACE, WORLD, np.pi, np.random.default_rng(seed))


def test_objects_lie_on_the_table_in_reach_and_in_view_with_room_for_the_fingers():
    places = []
    for seed in range(30):
        poses = scattered(seed)
        centres = np.array([poses[item.name][:3, 3] for item in THREE_OBJECTS])
        for item, pose in zip(THREE_OBJECTS, poses.values(), strict=True):
            assert pose[2, 3] == item.half_size[2]
            marker = pose[:3, :3] @ item.marker.corners.T + pose[:3, 3:]
            assert WORKPLACE.scene.camera.in_view(marker.T).all()
        off = np.abs(centres[:, :2] - WORKPLACE.table_centre)
        assert (off <= OBJECTS_REACH).all()
        for one in THREE_OBJECTS:
            for other in THREE_OBJECTS:
                if one is not other:
                    inside = np.linalg.inv(poses[other.name]) @ poses[one.name] @ OPEN_FINGERS
                    beside = np.abs(inside[:2].T) > other.half_size[:2]
                    assert beside.any(axis=1).all()
        places.append(centres[:, :2])
    assert np.std(places, axis=0).min() > 0.03  # at random, all of them


def test_the_gripper_takes_every_object_and_its_palm_clears_them_all():
    tallest = max(2 * item.half_size[2] for item in THREE_OBJECTS)
    for item in THREE_OBJECTS:
        assert 2 * item.half_size[0] < 2 * FINGER_STROKE - 0.02
        assert item.marker.plate_size <= 2 * min(item.half_size[:2])
        assert item.half_size[2] + 0.037 > tallest  # the palm, above the tool centre point


def test_scattered_objects_rest_where_they_were_put():
    world, poses = WORLD, scattered(3)
    world.reset(WORKPLACE.home_joints().numpy(), poses)
    world.advance(0.5)
    for item in THREE_OBJECTS:
        np.testing.assert_allclose(world.object_pose(item.name), poses[item.name], atol=1e-3)
        assert world.rests_on(item.name, "table")


def test_more_objects_than_fit_are_refused(monkeypatch):
    monkeypatch.setattr(surroundings, "OBJECTS_REACH", (0.01, 0.01))
    monkeypatch.setattr(surroundings, "_ARRANGEMENTS", 20)
    with pytest.raises(ValueError, match="do not fit"):
        scattered(0)
