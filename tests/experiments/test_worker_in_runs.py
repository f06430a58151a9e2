"""How near a worker is believed to be, and which of his touches count."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from hrc_learn.experiments.collaboration.worker import (
    SensedDistance,
    move_worker,
    somebody_comes,
    worker_contacts,
)
from hrc_learn.kinematics import GraspedBox, separation
from hrc_learn.protocols import PersonObservation
from hrc_learn.sim import MotionLog, WorkerDistance, World, whole_arm
from hrc_learn.sim.worker import PARTS
from hrc_learn.sim.workplace import Workplace
from hrc_learn.viz import StepLog

WORKPLACE = Workplace()
VISIT = somebody_comes(WORKPLACE, np.random.default_rng(5))
SCENE = replace(WORKPLACE.scene, worker=VISIT.worker.config)
HAND = PARTS.index("hand_right")


def observed(time: float = 1.0, hand_at: np.ndarray | None = None) -> PersonObservation:
    """As he puts down what he brought; or his right hand alone, the rest of him far away."""
    capsules = VISIT.capsules_at(VISIT.released)
    ends = capsules.ends
    if hand_at is not None:
        hand = ends[HAND] - ends[HAND].mean(axis=0) + hand_at
        ends = ends + 5.0
        ends[HAND] = hand
    return PersonObservation(
        time=time, ends=ends, radius=capsules.radius, velocity=capsules.velocity
    )


def test_the_robot_knows_no_more_than_its_tracker_and_its_joints():
    arm, q = whole_arm(SCENE.arm), WORKPLACE.hover_joints()
    tracker = SimpleNamespace(read=lambda: None)
    sensed = SensedDistance(tracker, arm, SCENE.objects)
    sensed.note(0.0, q.numpy(), ())
    tracker.read = observed
    sensed.note(1.1, q.numpy(), ())
    sensed.note(1.2, q.numpy(), ("box",))
    seen = observed()
    ends, radius = torch.from_numpy(seen.ends), torch.from_numpy(seen.radius)
    # Gripped along its x, which is the line of closing, the tool's y.
    a, b, c = SCENE.objects[0].half_size
    with_box = separation(arm, q, ends, radius, GraspedBox(half_size=(b, a, c))).distance
    np.testing.assert_allclose(
        sensed.log["distance"],
        [np.nan, with_box[:-1].min().item(), with_box.min().item()],
    )
    np.testing.assert_allclose(sensed.log["age"], [np.nan, 0.1, 0.2])


def test_a_held_box_is_where_it_is_believed_to_be():
    """To the millimetres by which it is gripped: the simulator's own distance of the box."""
    world = World(SCENE)
    world.hold("box", WORKPLACE.home_joints().numpy())
    below = world.object_pose("box")[:3, 3] - [0.01, 0.02, 0.2]
    world.move_worker(observed(hand_at=below).ends)
    true = WorkerDistance(world).now(world.held())
    assert true.arm_geom == "box"
    tracker = SimpleNamespace(read=lambda: observed(hand_at=below))
    sensed = SensedDistance(tracker, whole_arm(SCENE.arm), SCENE.objects)
    sensed.note(1.0, world.arm.read().joint_position, world.held())
    assert sensed.log["distance"][0] == pytest.approx(true.distance, abs=2e-3)


@pytest.mark.parametrize("held", [True, False])
def test_what_the_robot_holds_can_meet_the_worker_what_lies_about_cannot(held):
    world = World(SCENE)
    if held:
        world.hold("box", WORKPLACE.home_joints().numpy())
    else:
        world.reset(WORKPLACE.home_joints().numpy())
        world.advance(0.2)
    for monitor in world._monitors:
        monitor.clear()
    motion, log = MotionLog(world), StepLog()
    below = world.object_pose("box")[:3, 3] - [0.0, 0.0, 0.04]
    for place in (below, below, below + 5.0):
        world.move_worker(observed(hand_at=place).ends)
        log.append(time=world.time)
        motion.advance(0.01)
    boxes = [touch for touch in world.worker_contacts.touches if touch.first == "box"]
    assert boxes
    counted = [t for t in worker_contacts(world, log, motion) if t.first == "box"]
    assert counted == (boxes if held else [])
    assert motion.held("box").all() == held
    assert (motion.nearest()[0].arm_geom == "box") == held
    assert [pair.distance > 1 for pair in motion.nearest()] == [False, False, True]
    assert len(motion.nearest(2)) == 2


def test_he_is_where_his_visit_says():
    world = World(SCENE)
    world.reset(WORKPLACE.home_joints().numpy())
    world.data.time = VISIT.released
    move_worker(world, VISIT)
    capsule = world.data.geom("worker_head").xpos
    ends = VISIT.capsules_at(VISIT.released).ends
    np.testing.assert_allclose(capsule, ends[PARTS.index("head")].mean(axis=0), atol=1e-9)
    item = world.data.body("worker_item").xpos
    np.testing.assert_allclose(item, VISIT.item_at(VISIT.released))


def test_a_world_without_a_worker_keeps_no_distances():
    world = World(WORKPLACE.scene)
    world.reset(WORKPLACE.home_joints().numpy())
    motion = MotionLog(world)
    motion.advance(0.01)
    assert motion.nearest() == ()
