"""The worker in MuJoCo: seen, met without a force, and as near as the geoms say."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from hrc_learn.kinematics import panda, separation
from hrc_learn.sim import MovingBodies, Worker, WorkerConfig, World, random_visit, whole_arm
from hrc_learn.sim.recorded_world import WorkerDistance
from hrc_learn.sim.scene import WORKER_BODIES, WORKER_ITEM, build_scene
from hrc_learn.sim.worker import PARTS
from hrc_learn.sim.workplace import Workplace

WORKPLACE = Workplace()
CONFIG = WorkerConfig(stature=1.7)
SCENE = replace(WORKPLACE.scene, worker=CONFIG)
WORKER = Worker(CONFIG)
VISIT = random_visit(
    WORKER,
    np.random.default_rng(1),
    bench=SCENE.table,
    under=WORKPLACE.table_centre,
    begin=(0.0, 0.0),
)
REACHING = float(
    next(
        time
        for time, hands in zip(VISIT.time, VISIT.poses[:, 4:], strict=True)
        if time > VISIT.released + 0.5 and hands[[0, 3]].max() > 0.4
    )
)
"""When a hand is at the first marker [s]."""


def body(time=REACHING):
    return VISIT.capsules_at(time).ends


@pytest.fixture
def world():
    made = World(SCENE)
    made.reset(WORKPLACE.hover_joints().numpy())
    return made


def test_without_a_worker_the_scene_is_as_it_was():
    """What is left of a scene with one, without his bodies, is a scene without."""
    alone = build_scene(WORKPLACE.scene).compile()
    both = build_scene(SCENE).compile()
    theirs = {*WORKER_BODIES, WORKER_ITEM}
    bodies = [both.body(b).name for b in range(both.nbody)]
    assert bodies[: alone.nbody] == [alone.body(b).name for b in range(alone.nbody)]
    assert set(bodies[alone.nbody :]) == theirs
    assert (alone.geom_conaffinity <= 1).all()
    for name in dir(alone):
        mine = getattr(alone, name)
        if name.startswith("geom_") and isinstance(mine, np.ndarray) and name[5:] in _SAME:
            np.testing.assert_array_equal(mine, getattr(both, name)[: alone.ngeom])
    assert (alone.nq, alone.nv, alone.nu) == (both.nq, both.nv, both.nu)


_SAME = {"pos", "size", "quat", "contype", "margin", "gap", "friction", "solref", "rgba"}


def test_his_capsules_are_where_he_is(world):
    ends = body()
    world.move_worker(ends, np.array([0.1, 0.7, 0.025]))
    for k, name in enumerate(WORKER_BODIES):
        geom, pose = world.model.geom(name), world.data.geom(name)
        half = geom.size[1] * pose.xmat.reshape(3, 3)[:, 2]
        np.testing.assert_allclose(pose.xpos - half, ends[k, 0], atol=1e-9)
        np.testing.assert_allclose(pose.xpos + half, ends[k, 1], atol=1e-9)
        assert geom.size[0] == pytest.approx(WORKER.radius[k])
    np.testing.assert_allclose(world.data.body(WORKER_ITEM).xpos, [0.1, 0.7, 0.025])


def test_he_is_drawn_where_he_is(world):
    world.move_worker(body(), VISIT.item_at(REACHING))
    bodies = MovingBodies(world)
    position, orientation = bodies.poses()
    drawn = {b.name: b for b in bodies.drawn(position[None], orientation[None])}
    assert drawn.keys() >= {*WORKER_BODIES, WORKER_ITEM}
    for k, name in enumerate(WORKER_BODIES):
        (capsule,) = drawn[name].capsules
        np.testing.assert_allclose(drawn[name].position[0], body()[k].mean(axis=0), atol=1e-9)
        length = np.linalg.norm(np.subtract(capsule.end, capsule.start))
        assert length == pytest.approx(WORKER.lengths[k])
    assert len({drawn[name].capsules[0].colour for name in WORKER_BODIES}) >= 4


def swing(world, ends=None):
    """Where the joints go when the hand moves to where the worker stands or does not."""
    if ends is not None:
        world.move_worker(ends)
    world.arm.command(np.array([0.0, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    joints = []
    for _ in range(40):
        world.advance(0.01)
        joints.append(world.arm.read().joint_position)
    return np.array(joints), world.arm.read().external_torque


def test_the_arm_meets_him_without_a_force(world):
    alone, torque = swing(_fresh())
    chest = world.data.geom("hand").xpos - [0.0, 0.0, 0.12]
    ends = body() + chest - body()[PARTS.index("chest_left")].mean(axis=0)
    beside, felt = swing(world, ends)
    np.testing.assert_allclose(beside, alone, atol=1e-12)
    np.testing.assert_allclose(felt, torque, atol=1e-9)
    touches = world.worker_contacts.touches
    assert {touch.second for touch in touches} >= {"worker_chest_left"}
    assert any(touch.first == "hand" for touch in touches)
    assert max(touch.depth for touch in touches) > 0.01
    assert not world.table_contacts.touches


def _fresh():
    made = World(SCENE)
    made.reset(WORKPLACE.hover_joints().numpy())
    return made


def test_he_does_not_push_what_lies_on_the_table(world):
    world.advance(0.3)
    before = world.object_pose("box")
    hand = PARTS.index("hand_right")
    world.move_worker(body() + before[:3, 3] - body()[hand].mean(axis=0))
    world.advance(0.2)
    np.testing.assert_allclose(world.object_pose("box"), before, atol=1e-5)
    assert any(touch.first == "box" for touch in world.worker_contacts.touches)
    assert world.rests_on("box", "table")


def test_the_smallest_distance_is_the_smallest_of_all_pairs(world):
    """In which it is the simulator's own, between any geoms of both that collide."""
    model, found = world.model, []
    nearest = WorkerDistance(world)
    parts = [g for g in range(model.ngeom) if model.geom_contype[g]]
    theirs = [g for g in parts if model.geom(g).name in WORKER_BODIES]
    ours = [g for g in parts if model.geom(g).name.startswith(("link", "hand", "finger"))]
    for time in np.arange(VISIT.begin, VISIT.end, 1.3):
        world.move_worker(body(time))
        pair = nearest.now()
        every = {
            mujoco.mj_geomDistance(model, world.data, a, b, 50.0, None): (a, b)
            for a in ours
            for b in theirs
        }
        assert pair.distance == pytest.approx(min(every), abs=1e-9)
        names = tuple(model.geom(g).name for g in every[min(every)])
        assert (pair.arm_geom, pair.worker_geom) == names
        if pair.distance > 0:
            apart = np.linalg.norm(pair.points[1] - pair.points[0])
            assert apart == pytest.approx(pair.distance, abs=1e-6)
        found.append(pair.distance)
    assert min(found) < 0.1
    assert max(found) > 1.0


def test_what_the_robot_holds_counts_as_a_part_of_it(world):
    world.hold("box", WORKPLACE.home_joints().numpy())
    below = world.object_pose("box")[:3, 3] - [0.0, 0.0, 0.15]
    world.move_worker(body() + below - body()[PARTS.index("hand_right")].mean(axis=0))
    distance = WorkerDistance(world)
    with_load, without = distance.now(held=["box"]), distance.now()
    assert with_load.arm_geom == "box"
    assert with_load.distance < without.distance


def test_the_controllers_distance_is_never_greater(world):
    """Its capsules contain the geoms, so it errs to the safe side, by no more than they reach
    beyond them: 43 mm at the closed fingers.
    """
    arm, q = whole_arm(SCENE.arm), WORKPLACE.hover_joints()
    radius = torch.from_numpy(WORKER.radius)
    nearest, close = WorkerDistance(world), 0
    for time in np.arange(VISIT.begin, VISIT.end, 0.2):
        world.move_worker(body(time))
        true = nearest.now().distance
        believed = separation(arm, q, torch.from_numpy(body(time)), radius).distance.min()
        assert -0.045 < believed.item() - true < 1e-4 or true < 0
        close += 0 < true < 0.1
    assert close > 3
    assert panda.limits.contain(q)


def test_a_scene_without_a_worker_has_none_to_move():
    world = World(WORKPLACE.scene)
    with pytest.raises(ValueError, match="WorkerConfig"):
        world.move_worker(body())
    with pytest.raises(ValueError, match="WorkerConfig"):
        WorkerDistance(world)
