"""What an arm tells the person who leads it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from obedient_arm import ObedientArm
from servoing import POSTURE, grasping, observe
from unchecked import shapes_unchecked

from hrc_learn.controller import ControllerConfig, SafetyFilter
from hrc_learn.kinematics import GraspedBox, panda
from hrc_learn.protocols import HINDRANCES, ArmState, Human, HumanInput, PersonObservation
from hrc_learn.sim import ArmModelConfig, whole_arm
from hrc_learn.skills import WorkCell, WorkCellConfig
from hrc_learn.skills.person_watch import PersonWatch
from hrc_learn.skills.step_report import PersonFeedback

pytestmark = pytest.mark.simulation

Q = panda.ready


class Pusher(Human):
    """Pushes with a constant null-space input until a time, and keeps what it is told."""

    def __init__(self, push, until=np.inf):
        self.push, self.until, self.told = push, until, []

    def read(self, state):
        return HumanInput(nullspace_input=self.push * (state.time < self.until))

    def tell(self, feedback):
        self.told.append(feedback)


def self_motion(q):
    return np.linalg.svd(panda.jacobian(torch.as_tensor(q)).numpy())[2][6]


def cell_of(person, arm=None, **options):
    arm = arm or ObedientArm(Q.numpy())
    return WorkCell(
        chain=panda, arm=arm, gripper=arm, human=person, advance=arm.advance, **options
    )


def held(push, seconds=1.0, until=np.inf, **options):
    """A cell that keeps its hand where it is while a person pushes."""
    person = Pusher(push, until)
    cell = cell_of(person, **options)
    with shapes_unchecked():
        cell.hold_pose(seconds)
    return cell, person


def reached_of_asked(cell, push, row):
    """Share by the null vector of a step's Jacobian, from what was sent."""
    n = self_motion(cell.log["joint_position"][row])
    asked = n @ push / cell.config.damping
    return float(n @ cell.log["command_velocity"][row] / asked)


@pytest.mark.parametrize("torque", [1.0, 4.0, 12.0])
def test_the_share_followed_is_the_velocity_reached_over_the_one_asked(torque):
    push = torque * self_motion(Q)
    cell, person = held(push, seconds=0.8)
    told = person.told[-1]
    assert told.pushed
    assert told.followed == pytest.approx(reached_of_asked(cell, push, -1), abs=0.02)
    assert told.followed == cell.log["followed"][-1]
    if torque == 1.0:
        assert told.followed > 0.98
        assert told.reasons == ()
    if torque == 12.0:
        assert told.followed < 0.5
        assert [reason.hindrance for reason in told.reasons] == ["speed"]
        assert told.reasons[0].kept == pytest.approx(told.followed, abs=1e-9)


def test_getting_under_way_is_no_refusal():
    cell, person = held(1.0 * self_motion(Q), seconds=0.1)
    assert reached_of_asked(cell, 1.0 * self_motion(Q), 2) < 0.3
    assert all(told.followed > 0.98 for told in person.told)


def test_nothing_is_told_of_a_push_that_is_none():
    cell, person = held(np.zeros(7), seconds=0.2)
    assert len(person.told) == len(cell.log) == 20
    assert not any(told.pushed or told.reasons or told.followed != 1 for told in person.told)
    assert np.isnan(cell.log["followed"]).all()
    assert not cell.log["hindered"].any()


def test_it_is_over_when_they_let_go():
    cell, person = held(12.0 * self_motion(Q), seconds=0.6, until=0.3)
    pushed = [told.pushed for told in person.told]
    # The input that is read after a step is asked of the next.
    assert pushed == [0.005 < 0.01 * k < 0.295 for k in range(60)]
    assert np.abs(cell.log["nullspace_input"][32]).max() > 0.5  # the arm has yet to stop
    assert not cell.log["hindered"][30:].any()


def test_a_push_that_only_the_hand_could_follow_is_told_to_be_one():
    push = panda.jacobian(Q).mT.numpy() @ np.array([10.0, 0, 0, 0, 0, 0])
    assert abs(self_motion(Q) @ push) < 1e-9
    _, person = held(push, seconds=0.05)
    assert person.told[-1].followed < 0.01
    assert [reason.hindrance for reason in person.told[-1].reasons] == ["task"]


def test_how_far_what_is_in_the_way_is():
    """A wall 2 cm off the elbow, which keeps 3 cm."""
    push, elbow = 2.0 * self_motion(Q), panda.link_poses(Q).position[3]
    way = panda.joint_jacobian(Q, 4)[:3] @ torch.from_numpy(push)
    way = way / way.norm()

    def clearance(q):
        return 0.02 - (panda.link_poses(q).position[..., 3, :] - elbow) @ way

    _, person = held(push, seconds=0.3, clearance=clearance)
    told = person.told[-1]
    assert told.followed < 0.05
    assert [reason.text for reason in told.reasons] == ["an obstacle is 2 cm away"]
    _, person = held(-push, seconds=0.3, clearance=clearance)
    assert person.told[-1].reasons == ()


class Bystander:
    """A tracker that sees somebody at rest, a ball of 5 cm."""

    def __init__(self, arm, at):
        self._arm, self._at = arm, np.array([at, at])[None]

    def read(self):
        return PersonObservation(
            time=self._arm.time,
            ends=self._at,
            radius=np.array([0.05]),
            velocity=np.zeros((1, 2, 3)),
        )


@pytest.mark.parametrize("towards", [True, False])
def test_who_pushes_the_arm_at_somebody_is_told_so(towards):
    arm, push = ObedientArm(Q.numpy()), 4.0 * self_motion(Q)
    elbow = panda.link_poses(Q).position[3].numpy()
    way = panda.joint_jacobian(Q, 4)[:3].numpy() @ push
    at = elbow + 0.35 * way / np.linalg.norm(way)
    watch = PersonWatch(Bystander(arm, at), whole_arm(ArmModelConfig(robot=panda)))
    person = Pusher(push if towards else -push)
    cell = cell_of(person, arm, watch=watch)
    with shapes_unchecked():
        cell.hold_pose(0.4)
    told = person.told[-1]
    assert told.person_distance == cell.log["person_distance"][-1]
    assert 0.0 < told.person_distance < 0.35
    if towards:
        assert told.followed == pytest.approx(reached_of_asked(cell, push, -1), abs=0.05)
        assert told.followed < 0.5
        words = {reason.hindrance: reason.text for reason in told.reasons}
        assert words["person"].startswith(f"a person is {told.person_distance:.1f} m away")
    else:
        assert "person" not in {reason.hindrance for reason in told.reasons}


@pytest.mark.parametrize(("speed", "pause"), [(0.5, False), (1.0, True)])
def test_people_far_away_are_no_reason_of_a_slow_or_paused_task(speed, pause):
    class Operator(Pusher):
        def read(self, state):
            return replace(super().read(state), pause=pause)

    arm, person = ObedientArm(Q.numpy()), Operator(1.0 * self_motion(Q))
    watch = PersonWatch(Bystander(arm, [9.0, 0, 0]), whole_arm(ArmModelConfig(robot=panda)))
    config = WorkCellConfig(speed=speed)
    with shapes_unchecked():
        cell = cell_of(person, arm, watch=watch, config=config)
        cell.hold_pose(0.5)
    assert cell.pace.scale == speed * (not pause)
    assert person.told[-1].pace == 1.0
    assert person.told[-1].reasons == ()


READY = Q.numpy()


def state(q=READY, width=0.08, torque=None):
    return ArmState(
        time=0.0,
        joint_position=q,
        joint_velocity=0 * q,
        gripper_width=width,
        external_torque=torque,
    )


def test_a_force_at_the_end_effector_is_felt_as_it_is():
    force = np.array([5.0, -20.0, 12.0])
    torque = panda.jacobian(Q).mT.numpy() @ np.concatenate([force, [0.4, -0.2, 0.1]])
    felt = PersonFeedback(panda).end_step(state(torque=torque), pushed=False).contact_force
    np.testing.assert_allclose(felt, force, atol=1e-9)
    assert PersonFeedback(panda).end_step(state(), pushed=False).contact_force is None


def test_contacts_are_looked_at_ten_times_a_second_and_anew_when_the_clock_is_set_back():
    feedback, J = PersonFeedback(panda), panda.jacobian(Q)
    seen = []
    for time in (*np.arange(0.0, 0.5, 0.01), 0.2):
        torque = J.mT.numpy() @ np.array([time, 0, 0, 0, 0, 0])
        told = feedback.end_step(
            replace(state(torque=torque), time=float(time)), J, pushed=False
        )
        seen.append(float(told.contact_force[0]))
    assert len(set(np.round(seen[:-1], 6))) in (5, 6)  # times are no exact decimals
    assert np.max(np.abs(np.array(seen[:-1]) - np.arange(0.0, 0.5, 0.01))) < 0.1 + 1e-9
    assert seen[-1] == pytest.approx(0.2)


def test_joints_near_their_limits_are_named():
    q = Q.numpy().copy()
    q[1], q[5] = panda.limits.lower[1] + 0.1, panda.limits.upper[5] - 0.14
    told = PersonFeedback(panda).end_step(state(q), pushed=False)
    assert told.near_limits == (panda.joint_names[1], panda.joint_names[5])
    assert PersonFeedback(panda).end_step(state(), pushed=False).near_limits == ()


def test_an_object_slips_by_as_much_as_the_gripper_closes_while_it_holds_it():
    feedback = PersonFeedback(panda)
    load = GraspedBox(half_size=(0.02, 0.02, 0.05))

    def slip(width, load=None):
        return feedback.end_step(state(width=width), pushed=False, load=load).slip

    assert slip(0.08) == slip(0.05) == 0.0  # it closes on nothing yet
    assert slip(0.040, load) == 0.0
    assert slip(0.034, load) == pytest.approx(0.006)
    assert slip(0.08) == 0.0  # let go
    assert slip(0.030, GraspedBox(half_size=(0.015, 0.02, 0.05))) == 0.0


def test_shares_multiply_and_the_worst_comes_first():
    feedback = PersonFeedback(panda)
    feedback.note("speed", 0.5)
    feedback.note("obstacle", 0.2, distance=3.2)
    feedback.note("singularity", 0.99)  # nothing worth a word
    feedback.note("task_waits", mention=True)
    told = feedback.end_step(state(), pushed=True)
    assert told.followed == pytest.approx(0.5 * 0.2 * 0.99)
    reasons = [(reason.hindrance, reason.kept) for reason in told.reasons]
    assert reasons == [("obstacle", 0.2), ("speed", 0.5), ("task_waits", 1.0)]
    assert told.reasons[0].text == "an obstacle is 3 cm away"
    told = feedback.end_step(state(), pushed=True)
    assert told.followed == 1.0
    assert told.reasons == ()


def test_every_hindrance_has_words():
    for hindrance in HINDRANCES:
        feedback = PersonFeedback(panda)
        feedback.note(hindrance, 0.0, distance=2.0)
        (reason,) = feedback.end_step(state(), pushed=True).reasons
        assert len(reason.text) > 10
        assert "{" not in reason.text


@pytest.mark.parametrize("room", [1.0, 0.05])
def test_during_visual_servoing_it_is_told_as_well(room):
    """Beside a joint limit the adaptive controller leaves less of a push than is felt."""
    push = 0.6 * self_motion(POSTURE)
    arm, person = ObedientArm(POSTURE.numpy()), Pusher(push)
    cell = cell_of(person, arm)
    k = int(np.abs(push).argmax())
    limits = panda.limits
    upper, lower = limits.upper.clone(), limits.lower.clone()
    upper[k], lower[k] = arm.q[k] + room, arm.q[k] - room
    # The cell itself believes in more room.
    config = ControllerConfig(null_damping=cell.config.damping)
    controller, _ = grasping(rng=torch.Generator().manual_seed(0), config=config)
    controller.safety = SafetyFilter(replace(limits, lower=lower, upper=upper))
    law = controller.initial_state(cell.joints)
    with shapes_unchecked():
        for _ in range(60):
            command, law = controller.step(
                law,
                observe(
                    cell.joints,
                    feature_visible=torch.tensor(False),
                    nullspace_input=torch.from_numpy(cell.human_input.nullspace_input),
                    dt=cell.config.dt,
                ),
            )
            cell.execute(command, controller.goals.position)
    # What the joints' own gradient adds counts neither for nor against the push.
    n, told = self_motion(cell.log["joint_position"][-1]), person.told[-1]
    own = -n @ command.xi_q.numpy() / cell.config.damping
    reached = (n @ command.joint_velocity.numpy() - own) / (n @ push / cell.config.damping)
    assert told.followed == pytest.approx(reached, abs=0.03)
    if room == 1.0:
        assert told.followed > 0.9
    else:
        assert told.followed < 0.6
        assert told.reasons[0].text == f"joint {k + 1} is at its limit"
