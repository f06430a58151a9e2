"""How far a worker was from an arm that moved, and which of his touches count."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from hrc_learn.controller import SeparationConfig
from hrc_learn.controller.contact_limits import ContactLimits, region_numbers
from hrc_learn.experiments import surroundings
from hrc_learn.experiments.surroundings import (
    draw_visit,
    near_worker,
    worker_contacts,
)
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import panda, separation
from hrc_learn.kinematics.registry import arm
from hrc_learn.log import StepLog
from hrc_learn.sim import MotionLog, Worker, WorkerConfig, World, random_visit, whole_arm
from hrc_learn.sim.arm_model import ArmModelConfig
from hrc_learn.sim.recorded_world import WorkerDistance
from hrc_learn.sim.worker import PARTS, REGIONS
from hrc_learn.sim.workplace import Workplace, gripper_down
from hrc_learn.skills.grasping import as_load

WORKPLACE = Workplace()
VISIT = random_visit(
    Worker(WorkerConfig()),
    np.random.default_rng(5),
    bench=WORKPLACE.scene.table,
    under=WORKPLACE.table_centre,
)
SCENE = replace(WORKPLACE.scene, worker=VISIT.worker.config)
HAND = PARTS.index("hand_right")


def ends_with_hand_at(place):
    """His right hand alone, the rest of him far away."""
    ends = VISIT.capsules_at(VISIT.released).ends
    hand = ends[HAND] - ends[HAND].mean(axis=0) + place
    ends = ends + 5.0
    ends[HAND] = hand
    return ends


def distances_at(arm, q, time, load):
    there = VISIT.capsules_at(time)
    ends, radius = torch.from_numpy(there.ends), torch.from_numpy(there.radius)
    return separation(arm, torch.from_numpy(q), ends, radius, load).distance.numpy()


def test_the_margin_is_what_both_would_still_go_while_the_arm_stops():
    """By differences of distances alone, with the arm's joints where they really are."""
    arm, config, rng = whole_arm(SCENE.arm), SeparationConfig(), np.random.default_rng(0)
    steps, h = 12, 1e-6
    time = VISIT.begin + np.linspace(1.0, 8.0, steps)
    q = WORKPLACE.hover_joints().numpy() + 0.3 * rng.standard_normal((steps, 7))
    v = 0.4 * rng.standard_normal((steps, 7))
    v[3] = 0.0
    offset, box = rng.normal(0, 0.01, 7), as_load(SCENE.objects[0])
    held = np.arange(steps) >= 7
    log = StepLog()
    for k in range(steps):
        log.append(time=time[k], joint_position=q[k] + offset, joint_velocity=v[k])
    found = near_worker(
        log, VISIT, arm, config, encoder_offset=offset, loads={"box": (box, held)}
    ).margin
    expected = []
    for k in range(steps):
        load = box if held[k] else None
        now = distances_at(arm, q[k], time[k], load)
        later = distances_at(arm, q[k] + h * v[k], time[k], load)
        closing = np.maximum((now - later) / h, 0.0)
        gone = distances_at(arm, q[k], time[k] - 1e-4, load)
        come = distances_at(arm, q[k], time[k] + 1e-4, load)
        coming = np.maximum((gone - come) / 2e-4, 0.0)
        stopping = closing / config.deceleration
        needed = coming * stopping + closing * stopping / 2
        expected.append(np.where(closing > 0.01, now - needed, np.inf).min())
    np.testing.assert_allclose(found, expected, atol=1e-3)
    assert np.isinf(found[3])  # who rests closes in on nobody
    assert np.isfinite(found).sum() > 8


def test_contacts_within_the_limits_need_no_margin_those_of_the_head_do():
    """An arm that moves anyhow while a worker reaches under it."""
    arm, rng, log, steps = whole_arm(SCENE.arm), np.random.default_rng(0), StepLog(), 40
    time = VISIT.begin + np.linspace(1.0, 8.0, steps)
    q = WORKPLACE.hover_joints().numpy() + 0.3 * rng.standard_normal((steps, 7))
    v = 0.15 * rng.standard_normal((steps, 7))
    for k in range(steps):
        log.append(time=time[k], joint_position=q[k], joint_velocity=v[k])

    def margins(mode, regions=REGIONS):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("hrc_learn.experiments.surroundings.REGIONS", regions)
            config = SeparationConfig(mode=mode)
            zero = np.zeros(7)
            return near_worker(log, VISIT, arm, config, encoder_offset=zero, loads={}).margin

    apart, both = margins("ssm"), margins("ssm+pfl")
    assert (both >= apart).all()
    assert (both > apart + 0.05).sum() > 5
    np.testing.assert_array_equal(margins("ssm+pfl", ("head",) * len(REGIONS)), apart)


@pytest.mark.simulation
def test_force_of_contacts_grows_with_the_speed_of_both_and_is_zero_without_contact():
    """By differences of distances, relative to the speed of a contact at its limit."""
    arm, rng, log = whole_arm(SCENE.arm), np.random.default_rng(2), StepLog()
    steps, h = 24, 1e-6
    time = VISIT.begin + np.linspace(3.0, 3.2, steps)
    hand = torch.from_numpy(VISIT.capsules_at(time[:1]).ends[0, HAND].mean(axis=0))
    there = WORKPLACE.robot.inverse(Pose(hand, gripper_down()), near=WORKPLACE.hover_joints())
    wide = np.where(np.arange(steps) < 12, 0.04, 0.5)[:, None]  # near his hand, anywhere
    q = there.numpy() + wide * rng.standard_normal((steps, 7))
    v = 0.4 * rng.standard_normal((steps, 7))
    for k in range(steps):
        log.append(time=time[k], joint_position=q[k], joint_velocity=v[k])
    config = SeparationConfig(mode="ssm+pfl")
    found = near_worker(log, VISIT, arm, config, encoder_offset=np.zeros(7), loads={}).force
    whole = replace(config, contact=replace(config.contact, used=1.0))
    person = VISIT.capsules_at(time)
    pairs = separation(
        arm, torch.from_numpy(q), *map(torch.from_numpy, (person.ends, person.radius))
    )
    regions, limits = region_numbers(REGIONS), ContactLimits(arm, whole, ())
    limit = limits.speeds(pairs, torch.from_numpy(q), regions, False).first.numpy()
    now = distances_at(arm, q, time, None)
    closing = (now - distances_at(arm, q + h * v, time, None)) / h
    gone, come = (distances_at(arm, q, time + t, None) for t in (-1e-4, 1e-4))
    relative = np.maximum(closing + (gone - come) / 2e-4, 0.0)
    touched, pushed = now <= 0, closing > 0.01
    with np.errstate(divide="ignore", invalid="ignore"):
        expected = np.where(touched & pushed, relative / limit, 0.0).max((1, 2))
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)
    assert (np.isfinite(found) & (found > 0)).sum() > 2
    assert (touched & ~pushed).any()
    assert pushed[found == 0].any()
    # Where no contact is allowed, any force exceeds the limit without bound.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hrc_learn.experiments.surroundings.REGIONS", ("head",) * len(REGIONS))
        forbidden = near_worker(log, VISIT, arm, config, encoder_offset=np.zeros(7), loads={})
    np.testing.assert_array_equal(forbidden.force, np.where(found > 0, np.inf, 0.0))


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
        world.move_worker(ends_with_hand_at(place))
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


def test_a_world_without_a_worker_keeps_no_distances():
    world = World(WORKPLACE.scene)
    world.reset(WORKPLACE.home_joints().numpy())
    motion = MotionLog(world)
    motion.advance(0.01)
    assert motion.nearest() == ()


def test_beside_the_elbow_nobody_leans_into_the_arm_that_waits():
    visit = draw_visit(WORKPLACE, np.random.default_rng(0))
    other = draw_visit(WORKPLACE, np.random.default_rng(1))
    assert other.worker.config != visit.worker.config
    waiting, world = WORKPLACE.hover_joints().numpy(), World(SCENE)
    world.reset(waiting)
    distance = WorkerDistance(world)
    apart = []
    for time in np.arange(visit.begin, visit.end, 0.1):
        world.move_worker(visit.capsules_at(time).ends)
        apart.append(distance.now().distance)
    # The capsules that he is drawn by contain the arm, so it is further away than they say.
    assert min(apart) > 0.03
    # He stands at the side of the elbow, before the robot's, and reaches under the forearm.
    x = visit.posture(np.array(visit.released)).place[0]
    table = WORKPLACE.scene.table
    assert x < table.centre[0] - table.half_size[0]
    elbow, wrist = panda.joint_origins(torch.from_numpy(waiting))[3:5, :2].numpy()
    beside = np.abs(visit.markers[:, :2] - (elbow + wrist) / 2)
    assert beside.max() < 0.25
    assert 2.0 < visit.reaches[0, 0] - visit.begin < 9.0


def test_a_worker_reaches_under_the_forearm_of_any_arm(monkeypatch):
    robot, seen = arm("ur5e"), []

    def random_visit(worker, rng, *, under, **_):
        seen.append(under)
        raise ValueError("not needed here")

    monkeypatch.setattr(surroundings, "random_visit", random_visit)
    monkeypatch.setattr(Workplace, "hover_joints", lambda place: robot.ready)
    scene = replace(WORKPLACE.scene, arm=ArmModelConfig(robot=robot))
    with pytest.raises(ValueError, match=r"none of 30 workers .* its forearm 0\.\d+ m above"):
        draw_visit(replace(WORKPLACE, scene=scene), np.random.default_rng(0))
    world = World(scene)
    world.reset(robot.ready.numpy())
    # The forearm of a UR5e goes from its third to its fourth joint.
    x, y, _ = (world.data.body("link3").xpos + world.data.body("link4").xpos) / 2
    assert seen[0] == pytest.approx((y, -x), abs=1e-9)
