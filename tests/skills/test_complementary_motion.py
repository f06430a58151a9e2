"""A policy's posture and a person's push, on an arm that goes where it is sent."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from unchecked import shapes_unchecked

from hrc_learn.controller.joint_path import FAR_ASIDE
from hrc_learn.controller.null_space_motion import YieldingConfig
from hrc_learn.kinematics import panda
from hrc_learn.protocols import ArmState, Human, HumanInput
from hrc_learn.skills import ComplementaryMotion, complementary_motion, joint_line

pytestmark = pytest.mark.simulation

DT = 0.05
SIDEWAYS = np.array([4.0, 0.0, -4.0, 0.0, 3.0, 0.0, 0.0])


@pytest.fixture
def usual_steps():
    """Marks tests whose loop makes five steps for one of the policy, as a user's does."""


@pytest.fixture(autouse=True)
def coarse_steps(monkeypatch, request):
    """Two steps of the loop for one of the policy: they show the same in half the time."""
    if "usual_steps" not in request.fixturenames:
        monkeypatch.setattr(complementary_motion, "_STEP", DT / 2)


class Pusher(Human):
    """Pushes with given efforts from one time to another."""

    def __init__(self, push, start, end):
        self.push, self.start, self.end = np.asarray(push, dtype=float), start, end
        self.told = []

    def read(self, state):
        on = self.start <= state.time < self.end
        return HumanInput(nullspace_input=self.push if on else np.zeros(7))

    def tell(self, feedback):
        self.told.append(feedback)

    def reasons(self):
        """Hindrances told of at each step."""
        return [{reason.hindrance for reason in told.reasons} for told in self.told]


def line(seconds=4.0, still=6.0):
    """A policy's postures: a transfer, and then rest."""
    far = torch.tensor([-0.9, 0.3, 0.1, 0.3, -0.1, 0.3, -0.3], dtype=torch.float64)
    speed = 1.875 * 0.9 / seconds
    path = joint_line(panda.ready, panda.ready + far, speed=speed, dt=DT).numpy()
    return np.concatenate([path, np.repeat(path[-1:], round(still / DT), axis=0)])


def followed(
    wishes, human, widths=None, before=lambda k, motion: None, limits=panda.limits, **options
):
    """Postures and joints of every step, and the gripper's openings."""
    motion = ComplementaryMotion(panda, human, DT, limits, **options)
    postures, joints, openings = [], [], []
    with shapes_unchecked():
        for k, wish in enumerate(wishes):
            before(k, motion)
            state = ArmState(
                time=k * DT,
                joint_position=wish,
                joint_velocity=np.zeros(7),
                gripper_width=0.0,
            )
            q, width = motion.next(state, wish, math.nan if widths is None else widths[k])
            assert motion.posture is not None
            postures.append(motion.posture.clone())
            joints.append(torch.from_numpy(q.copy()))
            openings.append(width)
    return torch.stack(postures), torch.stack(joints), openings


def elbow(joints):
    return panda.joint_origins(joints)[:, 3]


def hand_off(postures, joints):
    """Distance of the end effector from where the policy has it [m], and its turn [rad]."""
    twist = panda.forward(joints).twist_to(panda.forward(postures))
    return float(twist[:, :3].norm(dim=-1).max()), float(twist[:, 3:].norm(dim=-1).max())


def test_what_nobody_pushes_is_handed_on_as_it_is():
    wishes, widths = line(still=0.2), np.linspace(0.08, 0.0, len(line(still=0.2)))
    human = Pusher(SIDEWAYS, 1e9, 1e9)
    _, joints, openings = followed(wishes, human, widths)
    assert not any(told.pushed or told.reasons for told in human.told)
    np.testing.assert_array_equal(joints.numpy(), wishes)
    assert openings == widths.tolist()


@pytest.mark.long
@pytest.mark.usefixtures("usual_steps")
def test_elbow_goes_aside_and_back_while_the_hand_goes_on():
    wishes = line(seconds=3.0, still=5.5)
    postures, joints, _ = followed(wishes, Pusher(-2.0 * SIDEWAYS, 0.5, 1.3))
    np.testing.assert_array_equal(postures.numpy(), wishes)  # without a pause
    aside = (elbow(joints) - elbow(postures)).norm(dim=-1)
    assert aside.max() > 0.1
    off, turn = hand_off(postures, joints)
    assert off < 1e-6
    assert turn < 1e-6
    # Joints that are back are the policy's own to the last digit.
    assert torch.equal(joints[-1], postures[-1])
    step = joints.diff(dim=0).abs().amax(dim=0) / DT
    assert (step <= panda.limits.velocity).all()
    # Smoothly: each joint's speed changes by no more than its limit.
    assert (joints.diff(n=2, dim=0).abs() / DT**2 <= panda.limits.acceleration).all()


@pytest.mark.parametrize("strength", [0.3, 3.0])
def test_the_share_followed_is_the_null_velocity_reached_over_the_one_asked(strength):
    wishes = np.repeat(panda.ready.numpy()[None], 12, axis=0)
    human = Pusher(strength * SIDEWAYS, 0.0, 9.0)
    _, joints, _ = followed(wishes, human)
    half_way = (joints[-1] + joints[-2]) / 2
    n = torch.linalg.svd(panda.jacobian(half_way))[2][6].numpy()
    reached = n @ (joints[-1] - joints[-2]).numpy() / DT
    asked = n @ human.push / YieldingConfig().damping
    assert human.told[-1].followed == pytest.approx(reached / asked, rel=0.06)
    assert human.reasons()[-1] == ({"speed"} if strength > 1 else set())


@pytest.mark.long
def test_a_push_ends_where_limits_and_singularities_begin():
    """However long and hard: the hand stays, no joint passes its limit, and they come back."""
    wishes = np.repeat(panda.ready.numpy()[None], round(10.0 / DT), axis=0)
    postures, joints, _ = followed(wishes, Pusher(-4 * SIDEWAYS, 0.2, 2.2))
    assert ((joints > panda.limits.lower) & (joints < panda.limits.upper)).all()
    assert torch.linalg.svdvals(panda.jacobian(joints))[:, -1].min() > 0.05
    assert (joints - postures).abs().max() > 1.0
    assert hand_off(postures, joints)[0] < 1e-6
    np.testing.assert_allclose(joints[-1], postures[-1], atol=1e-3)


def test_the_null_space_stops_before_a_limit_that_would_move_the_hand(monkeypatch):
    monkeypatch.setattr(complementary_motion, "_STEP", DT)  # a policy as fast as the loop
    limits = replace(panda.limits, lower=panda.ready - 0.4, upper=panda.ready + 0.4)
    wishes = np.repeat(panda.ready.numpy()[None], round(2.5 / DT), axis=0)
    human = Pusher(3 * SIDEWAYS, 0.1, 2.5)
    postures, joints, _ = followed(wishes, human, limits=limits)
    moved = (joints - panda.ready).abs()
    assert 0.3 < moved.max() < 0.4
    # The person is told of the joint that really is there.
    told, joint = human.told[-1], int(moved[-1].argmax()) + 1
    assert told.followed < 0.05
    assert told.reasons[0].text == f"joint {joint} is at its limit"
    assert hand_off(postures, joints)[0] < 1e-6


@pytest.mark.long
def test_nobody_pushes_the_arm_into_what_is_around_it():
    """A wall across the way of the elbow: it slides along, and the hand goes on."""
    wishes = line(seconds=3.5, still=0.0)
    human = Pusher(1.2 * SIDEWAYS, 0.5, 2.6)
    postures, free, _ = followed(wishes, human)
    way = elbow(free) - elbow(postures)
    farthest = int(way.norm(dim=-1).argmax())
    out, start = way[farthest] / way[farthest].norm(), elbow(postures)[farthest]

    def clearance(q):
        return 0.12 - ((panda.joint_origins(q)[..., 3, :] - start) * out).sum(-1)

    assert clearance(free).min() < 0.0 < clearance(postures).min()
    postures, kept, _ = followed(wishes, human, clearance=clearance)
    assert clearance(kept).min() > 0.01  # of 0.03; this wall bounds one point alone
    assert (elbow(kept) - elbow(postures)).norm(dim=-1).max() > 0.05
    # Both runs told of, one after the other; the second person of the wall.
    reasons, near = human.reasons(), clearance(kept) < 0.035
    assert not any("obstacle" in told for told in reasons[: len(wishes)])
    pushed = torch.tensor([told.pushed for told in human.told[len(wishes) :]])
    hindered = torch.tensor(["obstacle" in told for told in reasons[len(wishes) :]])
    assert hindered[near & pushed].float().mean() > 0.8
    assert clearance(kept)[hindered].max() < 0.15
    assert hand_off(postures, kept)[0] < 1e-6


@pytest.mark.usefixtures("usual_steps")
def test_what_is_near_and_does_not_come_nearer_hinders_nobody():
    human, wishes = Pusher(SIDEWAYS, 0.0, 1.0), panda.ready.numpy()[None].repeat(3, axis=0)
    _, joints, _ = followed(wishes, human, clearance=lambda q: q.new_full(q.shape[:-1], 0.01))
    assert elbow(joints)[:, 1].diff().abs().min() > 1e-5
    assert human.reasons() == [set()] * 3


@pytest.mark.long
@pytest.mark.usefixtures("usual_steps")
def test_where_an_arm_aside_cannot_go_on_it_waits_and_then_does_everything_that_was_asked():
    wishes, blocked = line(seconds=3.0, still=4.5), {}
    widths = np.arange(len(wishes), dtype=float)

    def before(k, motion):
        if k == 40:
            blocked["at"] = motion.joints.clone()
        if k == 90:
            blocked.clear()

    def clearance(q):
        free = torch.full(q.shape[:-1], 0.5, dtype=torch.float64)
        if not blocked:
            return free
        away = (q - blocked["at"]).norm(dim=-1)
        return torch.where(away < 0.3, 0.02 - 0.1 * away, free)

    human = Pusher(SIDEWAYS, 0.2, 2.2)
    postures, joints, openings = followed(wishes, human, widths, before, clearance=clearance)
    assert (joints[88] - joints[60]).abs().max() < 1e-2  # it waits
    assert hand_off(postures, joints)[0] < 1e-6
    assert (np.diff(openings) >= 0).all()  # the gripper waits too, and skips nothing until
    jumps = np.flatnonzero(np.diff(openings) > 1)  # the policy and the arm are at rest together
    assert all(np.abs(wishes[-1] - postures[k].numpy()).max() < 0.02 for k in jumps)
    np.testing.assert_allclose(postures[-1], wishes[-1], atol=1e-9)
    # On its way through the policy's postures, none cut short.
    nearest = np.linalg.norm(postures.numpy()[:, None] - wishes[None], axis=-1).min(axis=1)
    assert nearest.max() < 0.03


def test_beginning_anew_forgets_the_push():
    motion = ComplementaryMotion(panda, Pusher(SIDEWAYS, 0.0, 1.0), DT, panda.limits)
    q = panda.ready.numpy()
    state = ArmState(time=0.5, joint_position=q, joint_velocity=np.zeros(7), gripper_width=0.0)
    for _ in range(10):
        motion.next(state, q)
    assert np.abs(motion.offset).max() > 0.01
    assert motion.nullspace_input.any()
    motion.restart()
    assert not motion.offset.any()
    assert not motion.nullspace_input.any()
    assert not motion.waits


@pytest.mark.long
def test_paths_beside_the_policys_own_keep_the_limits():
    """A random one, on which the task alone, or a stop, would lead joints aside beyond them."""
    rng = np.random.default_rng(10)
    goal = panda.ready + torch.from_numpy(rng.uniform(-0.9, 0.9, 7))
    goal = goal.clamp(panda.limits.lower + 0.25, panda.limits.upper - 0.25)
    path = joint_line(panda.ready, goal, speed=0.6, dt=DT).numpy()
    wishes = np.concatenate([path, np.repeat(path[-1:], 30, axis=0)])
    push = rng.choice([-1, 1]) * rng.uniform(1, 2) * SIDEWAYS
    postures, joints, _ = followed(wishes, Pusher(push, 0.3, rng.uniform(1.5, 3.5)))
    assert (elbow(joints) - elbow(postures)).norm(dim=-1).max() > 0.05
    assert (joints <= panda.limits.upper).all()
    assert (joints >= panda.limits.lower).all()
    assert (joints.diff(n=2, dim=0).abs() / DT**2 <= panda.limits.acceleration).all()
    assert hand_off(postures, joints)[0] < 1e-6


@pytest.mark.long
def test_joints_far_aside_hold_the_policy_until_they_are_nearer():
    """Where the end effector rests the null space leads back as it led aside."""
    wishes = line(seconds=3.0, still=5.5)
    postures, joints, _ = followed(wishes, Pusher(SIDEWAYS, 0.4, 2.6))
    far = (joints - postures).norm(dim=-1) > FAR_ASIDE
    assert far.sum() > 15
    # It needs 0.2 s to stop.
    moves = postures.diff(dim=0).abs().amax(dim=-1) > 0
    assert not moves[4:][far.unfold(0, 6, 1).all(dim=-1)].any()
    np.testing.assert_allclose(joints[-1], wishes[-1], atol=1e-3)


@pytest.mark.long
def test_a_push_far_aside_is_balanced_by_the_return_and_its_fraction_reported():
    posture = np.array([0.59, -0.25, -0.05, -2.05, 0.0, 1.61, 1.13])
    human = Pusher(2 * SIDEWAYS, 0.2, 1e9)
    postures, joints, _ = followed(np.repeat(posture[None], 100, axis=0), human)
    far = (postures[-1] - joints[-1]).norm()
    assert FAR_ASIDE < far < FAR_ASIDE + 0.4
    assert (joints[-1] - joints[-10]).abs().max() < 0.02
    kept = {reason.hindrance: reason.kept for reason in human.told[-1].reasons}
    assert kept["too_far"] < 0.1
    assert "task_waits" in kept


@pytest.mark.long
def test_joints_that_stay_aside_are_not_led_back_however_far_they_are():
    config = YieldingConfig(after_push="stay")
    wishes = line(seconds=3.0, still=0.5)
    postures, joints, _ = followed(wishes, Pusher(SIDEWAYS, 0.3, 2.7), config=config)
    np.testing.assert_array_equal(postures.numpy(), wishes)  # without a pause
    off = (joints - postures).norm(dim=-1)
    assert off.max() > FAR_ASIDE
    assert off[-1] > off.max() - 0.1
    assert (elbow(joints) - elbow(postures)).norm(dim=-1)[-1] > 0.1
    assert hand_off(postures, joints)[0] < 1e-6


def test_step_that_ends_too_near_an_obstacle_is_not_taken():
    """An obstacle that the loop did not foresee, as where the correction of the hand leads."""
    asked = []

    def clearance(q):
        distance = torch.full(q.shape[:-1], 0.5, dtype=torch.float64)
        if q.shape == (2, 7) and torch.equal(q[0], panda.ready):
            asked.append(q)
            distance[1] = 0.0
        return distance

    human = Pusher(SIDEWAYS, 0.0, 9.0)
    wishes = np.repeat(panda.ready.numpy()[None], 4, axis=0)
    _, joints, _ = followed(wishes, human, clearance=clearance)
    assert asked
    assert torch.equal(joints[-1], panda.ready)
    assert "obstacle" in human.reasons()[-1]
    kept = {reason.hindrance: reason.kept for reason in human.told[-1].reasons}
    assert kept["obstacle"] == 0.0
