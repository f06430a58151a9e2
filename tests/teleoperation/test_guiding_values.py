"""Values of hand guiding, scripted people and held gizmos, by closed forms."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import coarse_orientation, panda
from hrc_learn.protocols import ArmState, DrawnRegion, Feedback, Human, HumanInput
from hrc_learn.teleoperation.gate.messages import TrackedHand
from hrc_learn.teleoperation.hand_guiding import (
    CombinedInput,
    GuidedStep,
    HandGuidedArm,
    InputFilter,
    InteractionForceConfig,
    LinkGuide,
    bounded,
    capped,
    check_positive,
    force_to_nullspace_input,
    gizmo_nullspace_input,
    guiding_twist,
)
from hrc_learn.teleoperation.page_operator import (
    HeldGizmo,
    HeldGizmos,
    PageHuman,
    gizmo_command,
)
from hrc_learn.teleoperation.page_session import recorded_frame
from hrc_learn.teleoperation.scripted_expert import (
    GuidedPath,
    ScriptedForce,
    ScriptedPerturbation,
    Tremor,
    random_pulls,
)

pytestmark = pytest.mark.simulation

READY = panda.ready.numpy()
SPRING, PAPER = InteractionForceConfig(), InteractionForceConfig(mapping="pinv")


def reading(time=0.0, q=READY, velocity=None):
    velocity = np.zeros(7) if velocity is None else velocity
    return ArmState(time=time, joint_position=q, joint_velocity=velocity, gripper_width=0.04)


class Asks(Human):
    """Always the same input."""

    def __init__(self, **asked):
        self.asked, self.told = HumanInput(**asked), []

    def read(self, state):
        return self.asked

    def tell(self, feedback):
        self.told.append(feedback)


@pytest.mark.parametrize(("size", "scale"), [(0.0, 1), (4.9, 1), (5.0, 1), (10.0, 0.5)])
def test_vectors_are_shortened_with_their_direction(size, scale):
    vector = size * np.array([0.6, 0.0, -0.8])
    np.testing.assert_allclose(capped(vector, 5.0), scale * vector)
    expected = vector * min(1.0, 4.0 / max(0.8 * size, 1e-12))
    np.testing.assert_allclose(bounded(vector, 4.0), expected)


@pytest.mark.parametrize("value", [0, -1.0, float("nan")])
def test_settings_are_positive(value):
    with pytest.raises(ValueError, match="speed must be positive, but is"):
        InteractionForceConfig(speed=value)
    check_positive(InteractionForceConfig())


@pytest.mark.parametrize("joint", [2, 4, 6])
def test_a_force_at_a_point_of_a_link_becomes_the_torques_of_its_lever(joint):
    """By finite differences of the point's position."""
    force, point = np.array([3.0, -2.0, 5.0]), np.array([0.3, 0.1, 0.5])
    link = panda.link_poses(panda.ready)[joint - 1]
    local = link.inverse().apply(torch.from_numpy(point))
    expected = np.zeros(7)
    for k in range(7):
        ends = []
        for step in (-1e-6, 1e-6):
            q = panda.ready.clone()
            q[k] += step
            ends.append(panda.link_poses(q)[joint - 1].apply(local).numpy())
        expected[k] = force @ (ends[1] - ends[0]) / 2e-6
    found = force_to_nullspace_input(panda, READY, joint, force, SPRING, point)
    np.testing.assert_allclose(found, expected, atol=1e-7)
    origin = panda.joint_jacobian(panda.ready, joint).numpy()[:3]
    np.testing.assert_allclose(
        force_to_nullspace_input(panda, READY, joint, force), origin.T @ force, atol=1e-12
    )


@pytest.mark.parametrize("size", [5.0, 60.0])
def test_the_papers_mapping_is_the_pseudo_inverse_of_a_capped_velocity(size):
    force = size * np.array([0.0, 0.6, 0.8])
    J = panda.joint_jacobian(panda.ready, 4).numpy()[:3]
    velocity = 2.0 / 150 * force
    velocity *= min(1, 0.25 / np.linalg.norm(velocity))
    expected = 3.0 * np.linalg.pinv(J, rcond=1e-6) @ velocity
    found = force_to_nullspace_input(panda, READY, 4, force, PAPER)
    np.testing.assert_allclose(found, expected, atol=1e-10)


@pytest.mark.parametrize("size", [0.05, 0.29, 0.31, 2.0])
def test_a_gizmo_is_a_spring_of_bounded_force_and_torques(size):
    J = panda.joint_jacobian(panda.ready, 6).numpy()[:3]
    way = np.array([0.8, 0.6, 0.0])
    force = min(150 * size, 45.0) * way
    torque = J.T @ force
    expected = torque * min(1, 20 / np.abs(torque).max())
    found = gizmo_nullspace_input(panda, READY, 6, None, size * way, SPRING)
    np.testing.assert_allclose(found, expected, atol=1e-10)


def test_the_guided_end_effector_turns_by_the_coarse_rule():
    pose = panda.forward(panda.ready)
    own = quaternion.exp(torch.tensor([0.0, 0.05, 0.02]).double())
    near = quaternion.multiply(own, coarse_orientation(pose.position))
    twist = guiding_twist(Pose(pose.position, near), np.array([0.1, 0.0, 0.0]), SPRING)
    np.testing.assert_allclose(twist[:3], [0.1, 0, 0])
    np.testing.assert_allclose(twist[3:], [0, -0.2, -0.08], atol=1e-9)
    fast = guiding_twist(Pose(pose.position, near), np.array([0.0, 0.6, 0.8]), SPRING)
    np.testing.assert_allclose(fast[:3], [0, 0.15, 0.2])
    turned = guiding_twist(Pose(pose.position, near), np.zeros(3), SPRING, own)
    np.testing.assert_allclose(turned[3:], 0, atol=1e-9)
    far = quaternion.exp(torch.tensor([0.0, 0.0, 1.0]).double())
    turned = guiding_twist(Pose(pose.position, near), np.zeros(3), SPRING, far)
    assert np.linalg.norm(turned[3:]) == pytest.approx(0.8)
    steered = gizmo_command(panda, READY, (), SPRING, direction=np.array([0.0, -0.5, 0.0]))
    np.testing.assert_allclose(steered.twist[:3], [0, -0.125, 0])


def test_the_guided_end_effector_is_level_where_its_work_cell_wants_it():
    """At the shelf of an SO-101, 0.3 m from its base, as the motion that is learned there."""
    position = torch.tensor([0.0, -0.3, 0.1]).double()
    level = Pose(position, coarse_orientation(position, 0.3))
    still = np.zeros(3)
    own = guiding_twist(level, still, InteractionForceConfig(level_at=0.3))
    np.testing.assert_allclose(own[3:], 0, atol=1e-9)
    other = guiding_twist(level, still, InteractionForceConfig())
    assert np.linalg.norm(other[3:]) == pytest.approx(0.8)  # it would turn up by 45 degrees


def test_a_link_is_pulled_by_a_device_with_a_fraction_of_the_largest_force():
    J = panda.joint_jacobian(panda.ready, 4).numpy()[:3]
    device = Asks(twist=np.array([0.0, 0.1, 0.0, 9, 9, 9]), nullspace_input=np.full(7, 0.5))
    asked = LinkGuide(device, panda).read(reading())
    assert not asked.twist.any()
    torque = J.T @ np.array([0.0, 45 * 0.4, 0.0]) + 0.5
    np.testing.assert_allclose(asked.nullspace_input, torque * min(1, 20 / abs(torque).max()))
    guide = LinkGuide(device, panda)
    guide.tell(Feedback(pace=0.5))
    assert device.told[0].pace == 0.5


def test_acceleration_is_bounded():
    device = Asks(twist=np.array([0.3, 0.4, 0, 0, 0, 2.0]))
    human = InputFilter(device)
    assert human.read(reading(5.0)).twist.tolist() == [0] * 6
    first = human.read(reading(5.1)).twist
    np.testing.assert_allclose(first, [0.09, 0.12, 0, 0, 0, 0.5])
    np.testing.assert_allclose(human.read(reading(5.2)).twist, 2 * first)
    assert human.read(reading(5.1)).twist == pytest.approx(2 * first)
    np.testing.assert_allclose(human.read(reading(9.0)).twist, device.asked.twist)


def test_inputs_add_up_and_the_first_that_sets_a_thing_is_used():
    region = DrawnRegion(centre=(0, 0, 0), half_size=(1, 1, 1))
    one = Asks(twist=np.ones(6), gripper=0.01, requests=("start",))
    two = Asks(twist=np.full(6, 2.0), gripper=0.02, region=region, requests=("stop",),
               nullspace_input=np.full(7, 3.0), target=(1.0, 2.0, 3.0))  # fmt: skip
    asked = CombinedInput(one, two).read(reading())
    assert asked.twist.tolist() == [3] * 6
    assert asked.nullspace_input.tolist() == [3] * 7
    assert (asked.gripper, asked.region, asked.target) == (0.01, region, (1, 2, 3))
    assert asked.requests == ("start", "stop")
    CombinedInput(one, two).tell(Feedback(pace=0.3))
    assert (one.told[0].pace, two.told[0].pace) == (0.3, 0.3)


class Still:
    """An arm that stays where it is put, and keeps its last command."""

    def __init__(self, q=READY):
        self.q, self.sent = q, None

    def read(self):
        return reading(q=self.q)

    def command(self, velocity):
        self.sent = velocity


def guided(q=READY, **asked):
    arm = Still(q)
    return HandGuidedArm(panda, arm, Asks(**asked)), arm


TOOL = panda.forward(panda.ready).position.numpy()


def linear(arm, q=READY):
    """Velocity of the end effector after the filter has had time to follow."""
    for _ in range(60):
        arm.step()
    return (panda.jacobian(torch.from_numpy(q)).numpy() @ arm.step().command)[:3]


@pytest.mark.parametrize(("distance", "speed"), [(0.04, 0.06), (0.08, 0.12), (0.3, 0.12)])
def test_a_target_attracts_by_its_distance_up_to_a_speed(distance, speed):
    way = np.array([0.0, 0.6, 0.8])
    arm, _ = guided(target=tuple(TOOL + distance * way))
    np.testing.assert_allclose(linear(arm), speed * way, atol=2e-3)


def test_a_region_attracts_until_the_hand_is_inside():
    half = (0.05, 0.05, 0.05)
    for shift, moves in ((0.04, False), (0.3, True)):
        centre = tuple(TOOL + np.array([0, shift, 0]))
        arm, _ = guided(region=DrawnRegion(centre=centre, half_size=half))
        velocity = linear(arm)
        assert (velocity[1] > 0.05) == moves
        assert np.linalg.norm(velocity) < 0.125
    # A person who moves it is stronger.
    arm, _ = guided(
        region=DrawnRegion(centre=centre, half_size=half),
        twist=np.array([0, -0.05, 0, 0, 0, 0.0]),
    )
    np.testing.assert_allclose(linear(arm), [0, -0.05, 0], atol=2e-3)


def test_a_pull_moves_the_null_space_by_the_damping():
    d = np.linspace(-2, 2, 7)
    arm, _ = guided(nullspace_input=d)
    for _ in range(80):
        step = arm.step()
    J = panda.jacobian(panda.ready).numpy()
    expected = (np.eye(7) - np.linalg.pinv(J) @ J) @ d / 3.0
    np.testing.assert_allclose(step.command, expected, atol=5e-3)


@pytest.mark.parametrize(("ahead", "speed"), [(0.1, 0.15), (0.2, 0.3), (0.6, 0.3)])
def test_a_posture_is_approached_in_a_straight_line(ahead, speed):
    arm, driver = guided()
    way = np.array([1.0, 0, -0.5, 0, 0, 0, 0.25])
    arm.move_to(torch.from_numpy(READY + ahead * way))
    for _ in range(80):
        step = arm.step()
    np.testing.assert_allclose(step.command, speed * way, atol=1e-3)
    driver.q = READY + ahead * way + 0.9e-3
    arm.step()
    driver.q = READY
    for _ in range(80):
        step = arm.step()
    np.testing.assert_allclose(step.command, 0, atol=1e-6)
    arm.stop()
    assert not driver.sent.any()


@pytest.mark.parametrize(
    "asked", [{"twist": np.full(6, 1e-3)}, {"nullspace_input": np.ones(7)}]
)
def test_a_person_that_moves_the_arm_ends_the_way_to_a_posture(asked):
    arm, _ = guided(**asked)
    arm.move_to(torch.from_numpy(READY + 0.5))
    for _ in range(80):
        step = arm.step()
    assert np.abs(step.command).max() < 0.25


@pytest.mark.parametrize(
    ("time", "strength"),
    [(0.9, 0), (1.0, 0), (1.1, 0.15625), (1.2, 0.5), (1.4, 1), (2.0, 1), (2.6, 1), (2.8, 0.5),
     (3.0, 0), (3.2, 0)],
)  # fmt: skip
def test_a_pull_comes_and_goes_softly(time, strength):
    pull = ScriptedForce(start=1.0, duration=2.0, towards=(1.0, 0.0, 0.0))
    assert pull.end == 3
    assert pull.strength(time) == pytest.approx(strength, abs=1e-9)
    force = pull.force(time, np.array([0.9, 0.0, 0.0]))
    np.testing.assert_allclose(force, [10 * strength, 0, 0], atol=1e-9)
    force = pull.force(time, np.array([0.0, 0.0, 0.0]))
    np.testing.assert_allclose(force, [25 * strength, 0, 0], atol=1e-9)


def test_pulls_at_given_times_add_up():
    towards = (0.3, 0.9, 0.6)
    forces = [ScriptedForce(start=1.0, duration=2.0, towards=towards, joint=j) for j in (4, 6)]
    human = ScriptedPerturbation(panda, forces, begin=10.0)
    expected = np.zeros(7)
    for force in forces:
        origin = panda.joint_origins(panda.ready)[force.joint - 1].numpy()
        J = panda.joint_jacobian(panda.ready, force.joint).numpy()[:3]
        expected += J.T @ force.force(2.0, origin)
    np.testing.assert_allclose(human.read(reading(12.0)).nullspace_input, expected)
    assert not human.read(reading(10.9)).nullspace_input.any()
    assert not human.read(reading(13.1)).nullspace_input.any()
    waiting = ScriptedPerturbation(panda, forces, begin=None)
    assert not waiting.read(reading(2.0)).nullspace_input.any()
    waiting.begin(4.0)
    assert waiting.read(reading(6.0)).nullspace_input.any()


def test_random_pulls_are_as_long_and_as_level_as_people_pull():
    pulls = random_pulls(np.random.default_rng(0), 3000.0)
    assert 0 <= pulls[0].start <= 6
    pauses = np.array([b.start - a.end for a, b in pairwise(pulls)])
    lengths = np.array([p.duration for p in pulls])
    assert ((pauses >= 1) & (pauses <= 6)).all()
    assert ((lengths >= 2) & (lengths <= 4.5)).all()
    assert pulls[-1].start < 3000 < pulls[-1].end + 6
    towards = np.array([p.towards for p in pulls])
    np.testing.assert_allclose(np.linalg.norm(towards, axis=1), 10)
    slopes = np.rad2deg(np.arcsin(towards[:, 2] / 10))
    assert 25 < slopes.max() <= 30
    assert -30 <= slopes.min() < -25
    headings = np.arctan2(towards[:, 1], towards[:, 0])
    assert headings.min() < -2.9
    assert headings.max() > 2.9
    assert pulls[0].max_force == 60


def test_a_guided_path_goes_from_rest_to_rest_through_its_points():
    points = np.array([[0.0, 0, 0], [0.3, 0, 0], [0.3, 0.4, 0]])
    path = GuidedPath(points, 2.0, 5.0)
    assert path.end == 7
    np.testing.assert_allclose(path.position(4.0), points[0])
    np.testing.assert_allclose(path.position(8.0), points[2])
    np.testing.assert_allclose(path.velocity(5.0), 0, atol=1e-12)
    np.testing.assert_allclose(path.velocity(7.0), 0, atol=1e-12)
    s = np.linspace(0, 1, 401)
    u = 10 * s**3 - 15 * s**4 + 6 * s**5
    passed = 5 + 2 * s[np.abs(u - 3 / 7).argmin()]
    np.testing.assert_allclose(path.position(passed), points[1], atol=2e-3)
    for time in (5.3, 6.0, 6.6):
        slope = (path.position(time + 1e-6) - path.position(time - 1e-6)) / 2e-6
        np.testing.assert_allclose(path.velocity(time), slope, atol=1e-6)


def test_a_tremor_shakes_at_eight_hertz_with_its_amplitude():
    tremor = Tremor(2e-4, np.random.default_rng(0))
    time = np.arange(0, 100, 0.005)
    velocity = np.array([tremor.velocity(t) for t in time])
    spectrum = np.abs(np.fft.rfft(velocity, axis=0)) / len(time) * 2
    rates = np.fft.rfftfreq(len(time), 0.005)
    for rate, size in ((8.0, 1.0), (7.2, 0.7), (0.35, 3.0), (0.22, 3.0)):
        found = spectrum[np.abs(rates - rate).argmin()] / (2 * np.pi * rate)
        np.testing.assert_allclose(found, 2e-4 * size, rtol=1e-3)
    others = np.abs(rates[:, None] - [8.0, 7.2, 0.35, 0.22]).min(1) > 0.006
    assert spectrum[others].max() < 1e-6


def test_held_gizmos_are_taken_moved_and_released():
    changes = []
    links = panda.link_poses(panda.ready)
    held = HeldGizmos(lambda: changes.append(1), lambda: links)
    point = np.array([0.4, 0.1, 0.5])
    held.grab(("a", "x"), 4, point, point + 0.1)
    held.grab(("a", "y"), None, point, point)
    held.grab(("b", "x"), 6, point, point)
    assert len(changes) == 3
    own = held.held()[("a", "x")]
    np.testing.assert_allclose(links[3].apply(torch.from_numpy(own.held_at)).numpy(), point)
    hand = held.held()[("a", "y")]
    np.testing.assert_allclose(links[-1].position.numpy() + hand.held_at, point)
    held.move(("a", "x"), point + 0.2)
    np.testing.assert_allclose(held.held()[("a", "x")].pointer, point + 0.2)
    held.move(("z", "x"), point)
    assert len(held.held()) == 3
    held.release("a", "y")
    assert {*held.held()} == {("a", "x"), ("b", "x")}
    held.release(name="x")
    assert held.held() == {}
    held.grab(("a", "x"), 4, point, point)
    count = len(changes)
    held.release("z")
    assert len(changes) == count
    held.release()
    assert held.held() == {}
    HeldGizmos().grab(("a", "x"), 4, point, point)


def test_rings_turn_and_the_next_drag_adds_to_the_turn():
    held = HeldGizmos()
    one, two = (Rotation.from_rotvec(v) for v in ([0.2, 0, 0], [0.0, 0.3, 0.1]))
    wxyz = lambda r: r.as_quat(scalar_first=True)  # noqa: E731
    assert held.turn_vector is None
    held.take(("a", "x"), None, np.array([1.0, 0, 0, 0]))
    assert held.turning
    held.move(("a", "x"), np.zeros(3), wxyz(one))
    np.testing.assert_allclose(held.turn_vector, [0.2, 0, 0], atol=1e-12)
    held.release("a", "x")
    assert not held.turning
    held.move(("a", "x"), np.zeros(3), wxyz(two))
    np.testing.assert_allclose(held.turn_vector, [0.2, 0, 0], atol=1e-12)
    held.take(("b", "x"), None, wxyz(one))
    held.move(("b", "x"), np.zeros(3), wxyz(two * one))
    np.testing.assert_allclose(held.turn_vector, (two * one).as_rotvec(), atol=1e-12)
    held.clear_turn()
    assert held.turn_vector is None
    held.release("z")
    assert held.turning


def test_commands_of_gizmos_and_keys_add_up():
    link = panda.link_poses(panda.ready)
    at = np.array([0.05, 0.0, 0.1])
    point = link[3].apply(torch.from_numpy(at)).numpy()
    pull = HeldGizmo(joint=4, held_at=at, pointer=point + np.array([0.05, 0, 0]))
    tool = HeldGizmo(
        joint=None, held_at=np.array([0.0, 0, 0.02]), pointer=TOOL + np.array([0, 0.05, 0.02])
    )
    found = gizmo_command(panda, READY, [pull, tool], SPRING, direction=np.array([0.2, 0, 0]))
    expected = gizmo_nullspace_input(panda, READY, 4, point, np.array([0.05, 0, 0]), SPRING)
    np.testing.assert_allclose(found.nullspace_input, expected)
    np.testing.assert_allclose(found.twist[:3], [0.05, 0.1, 0], atol=1e-9)
    np.testing.assert_allclose(
        found.arrows[0], [point, point + np.array([0.05, 0, 0])], atol=1e-9
    )
    np.testing.assert_allclose(found.arrows[1][0], TOOL + np.array([0, 0, 0.02]), atol=1e-9)
    assert found.held == (4, None)
    assert not gizmo_command(panda, READY, [pull], SPRING).twist.any()
    far = replace(pull, pointer=point + np.array([5.0, 0, 0]))
    both = gizmo_command(panda, READY, [far, far], SPRING)
    assert np.abs(both.nullspace_input).max() == pytest.approx(20)


def test_what_is_posted_holds_for_a_moment():
    now, here = [1.0], [True]
    human = PageHuman(clock=lambda: now[0], present=lambda: here[0])
    region = DrawnRegion(centre=(0, 0, 0), half_size=(1, 1, 1))
    human.post(HumanInput(twist=np.ones(6), region=region, gripper=0.03))
    human.request("start")
    human.request("stop")
    asked = human.read(reading())
    assert asked.twist.tolist() == [1] * 6
    assert asked.requests == ("start", "stop")
    assert human.read(reading()).requests == ()
    for width in (0.08, 0.02):
        human.grip(width)
    assert [human.read(reading()).gripper for _ in range(2)] == [0.02, 0.03]
    now[0] = 1.25
    assert human.read(reading()).twist.any()
    now[0] = 1.26
    silent = human.read(reading(7.0))
    assert not silent.twist.any()
    assert (silent.region, silent.gripper) == (region, None)
    assert human.state.time == 7
    now[0], here[0] = 1.1, False
    assert not human.read(reading()).twist.any()


def test_frames_hold_what_the_person_asked_for():
    pose = panda.forward(panda.ready)
    region = DrawnRegion(centre=(1, 2, 3), half_size=(4, 5, 6))
    asked = HumanInput(twist=np.arange(6.0), region=region)
    step = GuidedStep(state=reading(3.0), human_input=asked, pose=pose, command=np.ones(7))
    seen = TrackedHand(hand="left", position=(1, 2, 3), orientation=(1, 0, 0, 0))
    frame = recorded_frame(step, {"left": seen})
    assert frame["observation.human_twist"].tolist() == [0, 1, 2, 3, 4, 5]
    assert frame["observation.region"].tolist() == [1, 2, 3, 4, 5, 6]
    assert frame["observation.left_hand"].tolist() == [1, 2, 3, 1, 0, 0, 0]
    assert frame["observation.right_hand"].tolist() == [0] * 7
    assert (frame["time"], frame["gripper"]) == (3, 0.04)
    none = replace(step, human_input=HumanInput())
    assert not recorded_frame(none, {})["observation.region"].any()
    assert not frame["human_effort"].any()
    assert math.isclose(float(np.linalg.norm(frame["orientation"])), 1)
