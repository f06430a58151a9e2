"""Scenarios: shown by their expert they succeed, by contacts; left alone they do not."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from unchecked import shapes_unchecked

from hrc_learn.geometry import Pose
from hrc_learn.kinematics import panda
from hrc_learn.protocols import ArmState, Human, HumanInput
from hrc_learn.sim import World
from hrc_learn.skills.arm_motion import PositionServo, PositionServoConfig
from hrc_learn.skills.grasping import CLOSED, OPEN
from hrc_learn.teleoperation.hand_guiding import HandGuidedArm, HandGuidingConfig
from hrc_learn.teleoperation.scenarios import (
    Grasping,
    Placing,
    ScenarioRun,
    SequencedInput,
    overview,
)

DT = 0.05


class Joints:
    """An arm that moves exactly as it is told."""

    def __init__(self, q):
        self.q, self.velocities = q, []

    def read(self):
        return ArmState(
            time=DT * len(self.velocities),
            joint_position=self.q.copy(),
            joint_velocity=np.zeros(7),
            gripper_width=0.0,
        )

    def command(self, joint_velocity):
        self.velocities.append(joint_velocity)
        self.q = self.q + DT * joint_velocity


READY = panda.ready.numpy()


def test_a_motion_within_limits_is_reached_when_the_next_target_is_due():
    arm = Joints(READY)
    servo = PositionServo(panda, arm, DT)
    for k in range(1, 40):
        target = READY + 0.2 * (1 - np.cos(1.5 * DT * k))
        _, sent = servo.follow(target)
        np.testing.assert_allclose(sent, target, atol=1e-9)
        # The safety filter fades accelerations in and out, by less than a microradian.
        np.testing.assert_allclose(arm.q, target, atol=1e-5)
    assert not servo.safety.counts.any()


def test_a_target_that_jumps_makes_no_jump_of_the_arm():
    arm = Joints(READY)
    servo = PositionServo(panda, arm, DT, PositionServoConfig(gain=5.0))
    for _ in range(60):
        servo.follow(READY + 0.5)
    velocity = np.stack([np.zeros(7), *arm.velocities])
    limits = panda.limits
    assert (np.abs(velocity) <= limits.velocity.numpy() * (1 + 1e-9)).all()
    steepest = limits.acceleration.numpy() * DT * (1 + 1e-9)
    assert (np.abs(np.diff(velocity, axis=0)) <= steepest).all()
    # Of joint 6, 0.5 rad more would be all but beyond its limit.
    np.testing.assert_allclose(arm.q, READY + 0.5, atol=1e-3)


def test_a_pushed_arm_is_brought_back_and_a_blocked_one_not_wound_up():
    arm = Joints(READY)
    servo = PositionServo(panda, arm, DT)
    servo.follow(READY)
    arm.q = arm.q + 0.05
    for _ in range(25):
        servo.follow(READY)
    np.testing.assert_allclose(arm.q, READY, atol=1e-4)
    for _ in range(40):  # held where it is while it is sent elsewhere
        servo.follow(READY + 0.4)
        arm.q = READY.copy()
    servo.follow(READY + 0.4)
    assert np.abs(arm.velocities[-1]).max() < 1.5


def test_a_pose_is_reached_from_nearby():
    arm = Joints(READY)
    servo = PositionServo(panda, arm, DT)
    goal = panda.forward(torch.from_numpy(READY + 0.05))
    reached = panda.forward(torch.from_numpy(servo.joints_at(goal)))
    assert float(reached.twist_to(goal).abs().max()) < 1e-8


def test_targets_too_far_apart_are_refused():
    with pytest.raises(ValueError, match="raise the frame rate"):
        PositionServo(panda, Joints(READY), 0.5)


@pytest.fixture(scope="module")
def grasping():
    return ScenarioRun(Grasping(), 20.0)


def show(run):
    """Let the expert show the scenario with commands of positions."""
    arm = run.world.arm
    velocity = np.zeros(7)

    class Reading:
        def read(self):
            return arm.read()

        def command(self, joint_velocity):
            velocity[:] = joint_velocity

    led = HandGuidedArm(panda, Reading(), run.expert, HandGuidingConfig(dt=run.dt))
    target = arm.read().joint_position
    with shapes_unchecked(), torch.inference_mode():
        for _ in range(round(run.scenario.duration / run.dt)):
            asked = led.step().human_input
            target = target + run.dt * velocity
            run.command(target, asked.gripper)


@pytest.mark.long
def test_the_expert_grasps_and_doing_nothing_does_not(grasping):
    grasping.begin(3)
    show(grasping)
    assert grasping.succeeded()
    grasping.begin(3)
    assert not grasping.succeeded()


def test_the_same_seed_and_commands_lead_to_the_same_end(grasping):
    ends = []
    for seed in (5, 6, 5):
        grasping.begin(seed)
        first = grasping.world.arm.read().joint_position
        for k in range(10):
            grasping.command(first + 0.01 * k, 0.08)
        ends.append((grasping.object_pixel(), grasping.world.data.qpos.copy()))
    for same, other in zip(ends[0], ends[2], strict=True):
        np.testing.assert_array_equal(same, other)
    assert np.abs(ends[0][0] - ends[1][0]).max() > 5  # px: it lies elsewhere


def test_the_pixel_is_where_the_camera_has_the_object(grasping):
    grasping.begin(7)
    world = grasping.world
    marker = world.config.objects[0].marker.id
    top = world.marker_poses()[marker][:3, 3]
    np.testing.assert_allclose(
        grasping.object_pixel(), world.config.camera.project(top), atol=1.0
    )


@pytest.mark.slow
def test_the_expert_places():
    run = ScenarioRun(Placing(), 20.0)
    assert not run.succeeded()
    show(run)
    assert run.succeeded()
    assert run.world.cabinet_contacts.touches == []


def test_a_box_in_the_hand_is_not_placed():
    world = World()
    scenario = Placing()
    scenario.begin(world, np.random.default_rng(0))
    assert world.holds("box")
    assert not scenario.succeeded(world)


def test_turns_follow_each_other():
    class Still(Human):
        def read(self, state):
            return HumanInput()

    arm = Joints(READY)
    turns = SequencedInput([(0.0, Still(), 0.08), (1.0, Still(), 0.0)])
    widths = []
    for _ in range(30):
        widths.append(turns.read(arm.read()).gripper)
        arm.command(np.zeros(7))
    assert widths == [0.08] * 20 + [0.0] * 10


def test_the_picture_holds_table_and_cabinet():
    camera, config = overview(240, 180), World().config
    corners = np.array([[0.0, 0.3, 0.0], [0.5, 0.8, 0.0], [0.6, 0.0, 0.35]])
    shelves = np.array([[0.4, config.cabinet.front, h] for h in (0.12, 0.36, 0.60)])
    assert camera.in_view(np.vstack([corners, shelves])).all()


def test_a_grasp_succeeds_if_the_object_is_held_and_lifted_by_half_of_15_centimetres():
    grasping = Grasping()
    workplace = grasping.workplace
    world, item = World(workplace.scene), workplace.scene.objects[0]
    hover = workplace.hover()
    low = torch.tensor([0.0, 0.0, max(item.half_size)], dtype=torch.float64)
    for height, held, succeeds in (
        (0.073, True, False),
        (0.077, True, True),
        (0.077, False, False),
    ):
        tool = Pose(hover.position.clone(), hover.orientation)
        tool.position[2] = height + low[2]
        q = panda.inverse(tool, near=workplace.hover_joints()).numpy()
        world.hold(item.name, q)
        if not held:
            pose = world.object_pose(item.name)
            world.reset(workplace.home_joints().numpy(), {item.name: pose})
        bottom = world.object_pose(item.name)[2, 3] - max(item.half_size)
        assert bottom == pytest.approx(height, abs=1e-3)
        assert world.holds(item.name) == held
        assert grasping.succeeded(world) == succeeds


def test_the_gripper_closes_after_the_approach_and_the_object_lies_on_the_table():
    grasping = Grasping()
    scene = grasping.workplace.scene
    item = replace(scene.objects[0], half_size=(0.02, 0.03, 0.05))  # another than expected
    world = World(replace(scene, objects=(item, *scene.objects[1:])))
    shown = grasping.begin(world, np.random.default_rng(0))
    place = world.object_pose(item.name)[:3, 3]
    assert place[2] - item.half_size[2] == pytest.approx(world.table_top)
    for time, width in ((0.0, OPEN), (3.99, OPEN), (4.0, CLOSED), (4.7, CLOSED), (7.2, CLOSED)):
        state = ArmState(
            time=time,
            joint_position=READY,
            joint_velocity=np.zeros(7),
            gripper_width=0.0,
        )
        assert shown.read(state).gripper == width
    assert grasping.duration == pytest.approx(7.2)
