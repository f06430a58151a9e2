from dataclasses import replace

import numpy as np
import pytest

from hrc_learn.sim import (
    HAND_MARKER,
    NOWHERE,
    OcclusionInterval,
    ScriptedOcclusion,
    World,
    open_camera,
)
from hrc_learn.sim.camera_disturbances import occluding_boards
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.marker_sensor import MarkerSensor

WORKPLACE = Workplace()


@pytest.fixture(scope="module")
def world():
    return World(WORKPLACE.scene)


def sensor_for(world, kind):
    return MarkerSensor(
        open_camera(world, kind, rng=np.random.default_rng(0)), WORKPLACE.scene.marker_ids
    )


@pytest.mark.parametrize("kind", ["synthetic", pytest.param("egl", marks=pytest.mark.egl)])
def test_a_marker_is_hidden_for_a_spell_and_seen_again(world, kind):
    world.reset(WORKPLACE.hover_joints().numpy())
    sensor = sensor_for(world, kind)
    occluder = ScriptedOcclusion(world, [OcclusionInterval(start=0.1, duration=0.2)])
    seen = []
    for _ in range(4):
        occluder.update()
        image = sensor.read()
        seen.append(
            (round(world.time, 3), HAND_MARKER in sensor.detect(), image.mean(axis=-1).std())
        )
        world.advance(0.1)
    assert [found for _, found, _ in seen] == [True, False, False, True]


def test_the_board_is_drawn_between_camera_and_marker(world):
    world.reset(WORKPLACE.hover_joints().numpy())
    camera = open_camera(world, "synthetic", rng=np.random.default_rng(0))
    before = camera.read()
    u, v = WORKPLACE.scene.camera.project(world.marker_poses()[HAND_MARKER][:3, 3])
    ScriptedOcclusion(world, [OcclusionInterval(start=0.0, duration=1.0)]).update()
    pixel = camera.read()[round(v), round(u)].astype(float)
    np.testing.assert_allclose(pixel / 255, (0.55, 0.36, 0.30), atol=0.06)
    world.move_obstacle("occluder", NOWHERE)
    assert (camera.read()[:40] == before[:40]).all()


def test_a_board_that_is_taken_away_is_seen_by_no_camera(world):
    """Not even by one that would see it through the floor."""
    camera = WORKPLACE.scene.camera
    pose = camera.pose.copy()
    pose[:2, 3] = NOWHERE[:2]
    above = replace(camera, pose=pose)
    assert above.in_view(np.array([NOWHERE])).all()
    world.move_obstacle("occluder", NOWHERE)
    assert occluding_boards(world, above) == []
    world.move_obstacle("occluder", (*NOWHERE[:2], 0.5))
    assert len(occluding_boards(world, above)) == 1
    world.move_obstacle("occluder", NOWHERE)


def test_nothing_touches_the_board(world):
    world.reset(WORKPLACE.hover_joints().numpy())
    world.move_obstacle("occluder", world.arm.tcp_pose()[:3, 3])
    assert world.collisions_along(WORKPLACE.hover_joints().numpy()[None]) == []
    world.move_obstacle("occluder", NOWHERE)


def test_spells_of_no_length_in_time_are_refused():
    with pytest.raises(ValueError, match="must not be negative"):
        OcclusionInterval(start=-1.0, duration=2.0)
