"""Pulls as null-space input, and the hand-guided arm."""

import numpy as np
import pytest
import torch

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import coarse_orientation, panda
from hrc_learn.protocols import ArmState, DrawnRegion, Human, HumanInput
from hrc_learn.sim.workplace import Workplace
from hrc_learn.teleoperation import InteractionForceConfig, force_to_nullspace_input
from hrc_learn.teleoperation.hand_guiding import (
    ATTRACTION,
    RETURN_SPEED,
    HandGuidedArm,
    HandGuidingConfig,
    bounded,
    capped,
    gizmo_nullspace_input,
    guiding_twist,
)

pytestmark = pytest.mark.simulation


class IdealArm:
    def __init__(self):
        self.time, self.q = 0.0, Workplace().home_joints().numpy()
        self.velocity = np.zeros(7)

    def read(self):
        return ArmState(
            time=self.time,
            joint_position=self.q.copy(),
            joint_velocity=self.velocity.copy(),
            gripper_width=0.08,
        )

    def command(self, joint_velocity):
        self.velocity = joint_velocity.copy()

    def hand(self):
        return panda.forward(torch.from_numpy(self.q))


class Wish(Human):
    """A person who always asks for the same."""

    def __init__(self, **asked):
        self.asked, self.told = HumanInput(**asked), []

    def tell(self, feedback):
        self.told.append(feedback)

    def read(self, state):
        return self.asked


def lead(seconds, dt=0.04, **asked):
    arm = IdealArm()
    led = HandGuidedArm(panda, arm, Wish(**asked), HandGuidingConfig(dt=dt))
    start = arm.hand()
    for _ in range(round(seconds / dt)):
        led.step()
        arm.q += dt * arm.velocity
        arm.time += dt
    return arm, start


def test_the_hand_goes_where_it_is_led():
    way = np.array([0.0, 0.1, -0.05])
    arm, start = lead(1.0, twist=np.concatenate([way, np.zeros(3)]))
    moved = (arm.hand().position - start.position).numpy()
    # It takes a moment to come up to speed, and steps of 40 ms cut curves.
    np.testing.assert_allclose(moved, way, atol=0.05 * 0.1)
    assert np.linalg.norm(start.twist_to(arm.hand())[3:]) < 5e-3


def test_a_pull_at_the_body_leaves_the_hand_where_it_is():
    q = Workplace().home_joints()
    effort = 3.0 * panda.joint_jacobian(q, 4)[:3].mT.numpy() @ np.array([0.0, 4.0, 0.0])
    arm, start = lead(0.6, dt=0.01, nullspace_input=effort)
    assert np.abs(arm.q - q.numpy()).max() > 0.05
    # What is left is the drift of a step of 10 ms.
    assert float(start.twist_to(arm.hand()).norm()) < 3e-3


def test_a_region_draws_the_hand_in_no_faster_than_it_may():
    region = DrawnRegion(centre=(0.45, 0.25, 0.35), half_size=(0.08, 0.08, 0.08))
    arm, start = lead(1.0, region=region)
    distance = float((arm.hand().position - start.position).norm())
    assert distance <= ATTRACTION * 1.0 + 1e-6
    arm, _ = lead(8.0, region=region)
    offset = np.abs(arm.hand().position.numpy() - region.centre)
    # The last of the way in decays: within a few millimetres of the wall.
    assert (offset < 0.085).all()


def test_a_target_is_reached():
    target = (0.5, 0.1, 0.4)
    arm, _ = lead(6.0, target=target)
    np.testing.assert_allclose(arm.hand().position.numpy(), target, atol=3e-3)


def test_the_hand_that_leads_knows_better_than_the_region():
    region = DrawnRegion(centre=(0.45, 0.25, 0.35), half_size=(0.08, 0.08, 0.08))
    away = np.array([0.0, -0.1, 0.0, 0.0, 0.0, 0.0])
    led, _ = lead(1.0, region=region, twist=away)
    alone, _ = lead(1.0, twist=away)
    np.testing.assert_allclose(led.q, alone.q, atol=1e-12)


class Hesitant(Wish):
    """Asks for nothing until a time, then for what they wish."""

    def __init__(self, since, **asked):
        super().__init__(**asked)
        self.since = since

    def read(self, state):
        return self.asked if state.time >= self.since else HumanInput()


def returned(person, seconds, offset):
    """Arm and its path [rad] on the way to a posture so far from where it starts [rad]."""
    arm, path = IdealArm(), []
    led = HandGuidedArm(panda, arm, person, HandGuidingConfig(dt=0.01))
    led.move_to(torch.from_numpy(arm.q + offset))
    for _ in range(round(100 * seconds)):
        led.step()
        path.append(arm.q.copy())
        arm.q += 0.01 * arm.velocity
        arm.time += 0.01
    return arm, np.array(path)


@pytest.mark.long
def test_an_arm_that_is_sent_to_a_posture_goes_straight_there_and_rests():
    offset = np.array([0.25, -0.1, 0.0, 0.15, 0.0, 0.05, -0.2])
    arm, path = returned(Wish(), 6.0, offset)
    np.testing.assert_allclose(path[-1] - path[0], offset, atol=2e-3)
    np.testing.assert_allclose(arm.velocity, 0.0, atol=1e-6)
    share = (path - path[0]) @ offset / (offset @ offset)
    np.testing.assert_allclose(path - path[0], share[:, None] * offset, atol=1e-3)
    assert (np.diff(share) >= -1e-9).all()
    fastest = np.abs(np.diff(path, axis=0)).max() / 0.01
    assert fastest == pytest.approx(RETURN_SPEED, rel=0.02)


@pytest.mark.long
@pytest.mark.parametrize(
    "asked",
    [
        {"twist": np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0])},
        {"nullspace_input": np.array([0.3, 0.0, 0.2, 0.0, 0.0, 0.0, 0.0])},
    ],
)
def test_who_moves_the_arm_on_its_way_has_it(asked):
    offset = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    arm, path = returned(Hesitant(0.5, **asked), 2.5, offset)
    gone = path[50, 0] - path[0, 0]
    # A moment to come to rest, and what is asked for since, but not the way.
    assert path[-1, 0] - path[0, 0] < gone + 0.15
    assert np.abs(arm.velocity).max() > 1e-3


def test_an_arm_that_is_stopped_rests_at_once():
    arm = IdealArm()
    led = HandGuidedArm(panda, arm, Wish(), HandGuidingConfig(dt=0.01))
    led.move_to(torch.from_numpy(arm.q + 0.2))
    for _ in range(30):
        led.step()
    assert arm.velocity.any()
    led.stop()
    assert not arm.velocity.any()


def test_limits_hold_whatever_is_asked():
    arm, _ = lead(
        3.0, twist=np.array([0.0, 0.0, 5.0, 0.0, 0.0, 0.0]), nullspace_input=np.full(7, 1e3)
    )
    assert (arm.q >= panda.limits.lower.numpy()).all()
    assert (arm.q <= panda.limits.upper.numpy()).all()


@pytest.mark.parametrize("speed", [0.1, 4.0])
def test_who_leads_the_hand_too_fast_is_told_so(speed):
    arm, twist = IdealArm(), np.array([0.0, 0.0, speed, 0.0, 0.0, 0.0])
    person = Wish(twist=twist)
    led = HandGuidedArm(panda, arm, person, HandGuidingConfig(dt=0.01))
    for _ in range(40):
        step = led.step()
        arm.q += 0.01 * arm.velocity
        arm.time += 0.01
    # The joint velocity sent, over the one that the hand would need.
    J = panda.jacobian(torch.from_numpy(step.state.joint_position)).numpy()
    needed = np.linalg.pinv(J) @ twist
    told = person.told[-1]
    assert told.pushed
    assert told.followed == pytest.approx(step.command @ needed / (needed @ needed), abs=1e-3)
    assert [reason.hindrance for reason in told.reasons] == ["speed"] * (speed > 1)
    assert (told.followed < 0.5) == (speed > 1)


def test_who_pulls_where_only_the_hand_could_follow_is_told_so():
    arm = IdealArm()
    J = panda.jacobian(torch.from_numpy(arm.q)).numpy()
    n = np.linalg.svd(J)[2][6]
    for push, reasons in ((J.T @ np.array([9.0, 0, 0, 0, 0, 0]), ["task"]), (n, [])):
        person = Wish(nullspace_input=push)
        HandGuidedArm(panda, arm, person).step()
        (told,) = person.told
        assert told.pushed
        assert [reason.hindrance for reason in told.reasons] == reasons
        assert told.followed == pytest.approx(abs(n @ push) / np.linalg.norm(push), abs=1e-6)


def test_who_asks_for_nothing_is_told_nothing():
    person = Wish(region=DrawnRegion(centre=(0.45, 0.25, 0.35), half_size=(0.1, 0.1, 0.1)))
    HandGuidedArm(panda, IdealArm(), person).step()
    (told,) = person.told
    assert (told.pushed, told.followed, told.reasons) == (False, 1.0, ())


@pytest.mark.parametrize("name", ["dt", "damping"])
def test_settings_that_make_no_sense_are_refused(name):
    with pytest.raises(ValueError, match=f"{name} must be positive"):
        HandGuidingConfig(**{name: 0.0})


UNBOUNDED = InteractionForceConfig(
    mapping="pinv", speed=1e9, max_force=1e9, max_nullspace_input=1e9
)


def configurations(n, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(panda.limits.lower.numpy(), panda.limits.upper.numpy(), size=(n, 7))


def point_on_link(q, joint, offset):
    """Where a point fixed to the link that a joint moves is, by forward kinematics alone."""
    return panda.link_poses(torch.from_numpy(q))[joint - 1].apply(offset).numpy()


def numeric_jacobian(q, joint, offset, h=1e-6):
    columns = [
        (point_on_link(q + h * e, joint, offset) - point_on_link(q - h * e, joint, offset))
        / (2 * h)
        for e in np.eye(7)
    ]
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("joint", range(1, 8))
def test_a_handle_moves_its_point_as_fast_as_the_displacement_says(joint):
    rng = np.random.default_rng(joint)
    for q in configurations(10, seed=joint):
        offset = torch.from_numpy(rng.uniform(-0.2, 0.2, size=3))
        point = point_on_link(q, joint, offset)
        displacement = rng.normal(size=3)
        d = gizmo_nullspace_input(panda, q, joint, point, displacement, UNBOUNDED)
        J = numeric_jacobian(q, joint, offset)
        # Least squares: the first joints cannot move their link in every direction.
        expected, *_ = np.linalg.lstsq(J, UNBOUNDED.rate * displacement, rcond=1e-6)
        # Near singularities finite differences are all that limits the comparison.
        error = 1e-7 * (1 + np.linalg.norm(expected))
        np.testing.assert_allclose(d / UNBOUNDED.damping, expected, atol=error)
        assert not d[joint:].any()


def test_a_spring_does_the_work_of_its_force():
    config = InteractionForceConfig(mapping="transpose", max_force=1e9, max_nullspace_input=1e9)
    rng = np.random.default_rng(0)
    for q in configurations(20):
        offset = torch.from_numpy(rng.uniform(-0.2, 0.2, size=3))
        displacement = rng.normal(size=3)
        d = gizmo_nullspace_input(
            panda, q, 5, point_on_link(q, 5, offset), displacement, config
        )
        q_dot = rng.normal(size=7)
        velocity = numeric_jacobian(q, 5, offset) @ q_dot
        power = config.stiffness * displacement @ velocity
        assert d @ q_dot == pytest.approx(power, abs=1e-5)


def test_a_pull_at_the_joint_itself_needs_no_point():
    q = configurations(1)[0]
    origin = point_on_link(q, 4, torch.zeros(3, dtype=torch.float64))
    pull = np.array([1.0, -2.0, 0.5])
    for mapping in ("pinv", "transpose"):
        config = InteractionForceConfig(mapping=mapping)
        at_point = force_to_nullspace_input(panda, q, 4, pull, config, origin)
        np.testing.assert_allclose(
            at_point, force_to_nullspace_input(panda, q, 4, pull, config), atol=1e-12
        )


@pytest.mark.parametrize("mapping", ["pinv", "transpose"])
def test_far_handles_pull_as_hard_as_they_may_and_in_their_direction(mapping):
    config = InteractionForceConfig(mapping=mapping)
    far = InteractionForceConfig(mapping=mapping, max_nullspace_input=0.5)
    for q in configurations(20):
        point, way = point_on_link(q, 4, torch.zeros(3).double()), np.array([0.3, -0.2, 0.9])
        d = [gizmo_nullspace_input(panda, q, 4, point, k * way, config) for k in (10.0, 100.0)]
        np.testing.assert_allclose(d[0], d[1], atol=1e-12)
        small = gizmo_nullspace_input(panda, q, 4, point, 10.0 * way, far)
        assert np.abs(small).max() <= 0.5 + 1e-12
        np.testing.assert_allclose(small * np.abs(d[0]).max(), d[0] * np.abs(small).max())


def test_a_handle_that_is_not_displaced_asks_for_nothing():
    q = configurations(1)[0]
    point = point_on_link(q, 6, torch.zeros(3).double())
    assert not gizmo_nullspace_input(
        panda, q, 6, point, np.zeros(3), InteractionForceConfig()
    ).any()


def test_a_joint_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match="joint must be 1 to 7"):
        gizmo_nullspace_input(
            panda, configurations(1)[0], 8, np.zeros(3), np.ones(3), InteractionForceConfig()
        )


def test_caps_shorten_and_never_lengthen():
    assert capped(np.array([3.0, 4.0]), 2.5).tolist() == [1.5, 2.0]
    assert capped(np.array([3.0, 4.0]), 9.0).tolist() == [3.0, 4.0]
    assert bounded(np.array([-4.0, 2.0]), 1.0).tolist() == [-1.0, 0.5]
    assert bounded(np.zeros(2), 1.0).tolist() == [0.0, 0.0]


def guided(position, error, velocity, config):
    """Twist of an end effector that has to turn by `error` (a rotation vector) to its rule."""
    position = torch.tensor(position, dtype=torch.float64)
    turn = quaternion.exp(torch.tensor([0.4, -0.1, 0.3], dtype=torch.float64))
    goal = quaternion.multiply(turn, coarse_orientation(position))
    error = quaternion.exp(torch.tensor(error, dtype=torch.float64))
    start = quaternion.multiply(quaternion.conjugate(error), goal)
    return [
        guiding_twist(Pose(position, sign * start), np.array(velocity), config, turn)
        for sign in (1.0, -1.0)
    ]


def test_a_hand_follows_and_turns_the_shorter_way():
    config = InteractionForceConfig(turn_rate=1.0, turn_speed=10.0)
    for twist in guided([0.4, 0.2, 0.3], [0.3, -0.5, 0.2], [0.1, 0.0, 0.0], config):
        np.testing.assert_allclose(twist, [0.1, 0.0, 0.0, 0.3, -0.5, 0.2], atol=1e-12)


def test_a_hand_is_led_no_faster_than_allowed():
    config = InteractionForceConfig(speed=0.2, turn_speed=0.3)
    for twist in guided([0.4, 0.2, 0.3], [0.0, 2.0, 0.0], [0.0, 3.0, 4.0], config):
        np.testing.assert_allclose(twist, [0.0, 0.12, 0.16, 0.0, 0.3, 0.0], atol=1e-12)


@pytest.mark.parametrize("name", ["rate", "speed", "stiffness", "damping", "turn_speed"])
def test_strengths_that_make_no_sense_are_refused(name):
    with pytest.raises(ValueError, match=f"{name} must be positive"):
        InteractionForceConfig(**{name: 0.0})
