"""The control loop of a work cell, on an arm that does as it is told."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from obedient_arm import ObedientArm
from unchecked import shapes_unchecked

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.geometry.numerics import null_projection
from hrc_learn.kinematics import panda
from hrc_learn.protocols import HINDRANCES, Human, HumanInput
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills import (
    BlockedPathError,
    TaskFailedError,
    WorkCell,
    WorkCellConfig,
    joint_line,
)
from hrc_learn.skills.null_space_yielding import FAR_ASIDE, STUCK
from hrc_learn.skills.path_following import PathFollower, _Patience, follow_path
from hrc_learn.teleoperation import ScriptedPerturbation


@pytest.fixture
def cell():
    arm, person = ObedientArm(panda.ready.numpy()), ScriptedPerturbation(panda, ())
    return WorkCell(chain=panda, arm=arm, gripper=arm, human=person, advance=arm.advance)


def test_the_joints_move_along_a_path_as_fast_as_it_runs(cell):
    far = torch.tensor([0.3, -0.2, 0.1, 0.2, -0.1, 0.3, -0.3], dtype=torch.float64)
    path = joint_line(panda.ready, panda.ready + far, speed=0.3, dt=0.01).numpy()
    assert follow_path(cell, path) == len(path)
    commanded = cell.log["command_velocity"]
    # The slope of a minimum jerk motion, by its polynomial (Flash and Hogan 1985).
    duration = 1.875 * 0.3 / 0.3  # its peak is 15/8 of its mean speed
    s = np.minimum(0.01 * np.arange(len(path)) / duration, 1.0)[:, None]
    slope = 30 * s**2 * (1 - s) ** 2 / duration * far.numpy()
    # Steps of 10 ms leave errors of their square, which the feedback decays.
    np.testing.assert_allclose(commanded, slope, atol=4e-3)
    np.testing.assert_allclose(cell.joints, path[-1], atol=1e-3)


def test_a_path_of_one_sample_or_none_leaves_the_arm_where_it_is(cell):
    here = cell.joints.numpy()
    for samples in (1, 0):
        assert follow_path(cell, np.repeat(here[None], samples, axis=0)) == samples
    np.testing.assert_array_equal(cell.joints, here)


def test_a_path_is_left_when_its_end_is_told(cell):
    far = torch.full((7,), 0.1, dtype=torch.float64)
    path = joint_line(panda.ready, panda.ready + far, speed=0.3, dt=0.01).numpy()
    assert follow_path(cell, path, until=lambda: len(cell.log) == 12) == 12


class CountingSensor:
    age = 0.0

    def __init__(self):
        self.asked = []

    def corners(self, ids):
        self.asked.append(ids)
        return {}


@pytest.mark.parametrize("tracked", [(), (7,)])
def test_markers_are_detected_now_and_then_while_they_are_tracked(cell, tracked):
    sensor = CountingSensor()
    cell._markers._sensor, cell.tracked_markers = sensor, tracked
    cell.hold_pose(0.02)
    assert sensor.asked == []
    cell.hold_pose(0.10)  # twelve steps by now, with a detection at each fourth
    assert sensor.asked == 3 * [tracked] * bool(tracked)


class SlowCamera:
    """Takes an image each 70 ms, which arrives 50 ms later, and tells how old it is.

    Its only marker is seen at the column that the time says at which the image was taken.
    """

    def __init__(self, arm):
        self._arm, self.age, self._images = arm, 0.0, []

    def corners(self, ids):
        now = self._arm.time
        taken = 0.07 * np.floor((now - 0.05) / 0.07)
        self.age = now - taken + 1e-4 * np.sin(1e3 * now)  # the clocks differ a little
        square = 1e-3 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        return {7: np.array([taken, 0.0]) + square}

    def read(self):
        return np.zeros((2, 2, 3), np.uint8)


def test_an_image_counts_for_when_it_was_taken_and_once(cell):
    arm = cell._arm
    cell._markers._sensor, cell.tracked_markers = SlowCamera(arm), (7,)
    turning, seen = torch.zeros(7).double(), []
    turning[0] = 0.2
    for _ in range(100):
        cell.step(turning)
        observation = cell.observation
        if observation.joints is not None and observation.time > 0.4:
            seen.append(observation.time)
            assert arm.time - 0.05 - 0.07 - 0.04 - 1e-3 <= observation.time <= arm.time - 0.049
            assert observation.pixels[7][0] == pytest.approx(observation.time, abs=2e-4)
            # Where the joint was then: it turns at 0.2 rad/s.
            since = arm.q[0] - float(observation.joints[0])
            assert since == pytest.approx(0.2 * (arm.time - observation.time), abs=1e-6)
    times = np.unique(seen)
    np.testing.assert_allclose(np.diff(times), 0.07, atol=3e-4)  # each but once


class Wall(ObedientArm):
    """Feels a stiff surface below a height."""

    def __init__(self, height, noise=0.0):
        super().__init__(HOVER.numpy())
        self._height, self._noise = height, noise
        self._rng = np.random.default_rng(0)

    def read(self):
        pose, J = panda.forward_and_jacobian(torch.from_numpy(self.q))
        depth = max(self._height - float(pose.position[2]), 0.0)
        push = torch.tensor([0, 0, 2e4 * depth, 0, 0, 0], dtype=torch.float64)
        torque = (J.mT @ push).numpy() + self._noise * self._rng.standard_normal(7)
        return replace(super().read(), external_torque=torque)


HOVER = Workplace().hover_joints()


def lowered(by):
    start = panda.forward(HOVER)
    return Pose(start.position - torch.tensor([0, 0, by]).double(), start.orientation)


def cell_with(arm, **options):
    """With nobody beside it."""
    return WorkCell(
        chain=panda,
        arm=arm,
        gripper=arm,
        human=ScriptedPerturbation(panda, ()),
        advance=arm.advance,
        **options,
    )


@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_a_surface_is_found_where_it_is(noise):
    top = float(panda.forward(HOVER).position[2]) - 0.03
    cell = cell_with(Wall(top, noise=noise))
    met = cell.move_until_contact(lowered(0.06))
    assert met is not None
    assert float(met.position[2]) == pytest.approx(top, abs=1.5e-3)
    assert float(cell.pose.position[2]) > top - 3e-3  # it did not go on


def test_where_nothing_is_met_it_ends_at_the_goal():
    cell = cell_with(Wall(-1.0, noise=0.2))
    assert cell.move_until_contact(lowered(0.04)) is None
    torch.testing.assert_close(cell.pose.position, lowered(0.04).position, rtol=0, atol=1e-3)


class RoughWall(Wall):
    """An estimate of external torques has its joints' dry friction in it, and an error of its
    model of gravity that changes with the posture: as if something pushed the hand up or down.
    """

    def read(self):
        state = super().read()
        friction = 1.5 * np.tanh(self.velocity / 0.01)
        aside = float(self_motion(HOVER) @ (self.q - HOVER.numpy()))
        gravity = 80.0 * aside * panda.jacobian(torch.from_numpy(self.q))[2].numpy()
        torque = state.external_torque - friction + gravity
        return replace(state, external_torque=torque)


def test_who_pushes_the_null_space_is_not_taken_for_a_surface():
    """Two pushes, one on the way and one as the surface is near, to both sides."""
    top = float(panda.forward(HOVER).position[2]) - 0.03
    cell = cell_with(RoughWall(top, noise=0.2))
    pull = 8.0 * self_motion(HOVER)

    class Pushes(Human):
        def read(self, state):
            first, second = 0.6 < state.time < 1.1, 1.7 < state.time < 2.2
            return HumanInput(nullspace_input=pull * (int(first) - int(second)))

    cell.human = Pushes()
    met = cell.move_until_contact(lowered(0.06))
    pushed = (cell.log["nullspace_input"] != 0).any(axis=1)
    assert pushed.sum() > 90
    # It waited meanwhile.
    descent = np.diff(cell.log["goal_position"][:, 2])
    np.testing.assert_allclose(descent[pushed[:-1] & pushed[1:]], 0.0, atol=1e-9)
    assert hindered(cell, "task_waits").sum() > 90  # and said so
    assert met is not None
    assert float(met.position[2]) == pytest.approx(top, abs=2e-3)


def test_who_pushes_for_ever_is_not_waited_for_so_long():
    class Push(Human):
        def read(self, state):
            return HumanInput(nullspace_input=2.0 * self_motion(HOVER))

    arm = Wall(-1.0)
    cell = cell_with(arm, config=WorkCellConfig(longest_wait=0.3))
    cell.human = Push()
    with pytest.raises(TaskFailedError, match="null space was pushed"):
        cell.move_until_contact(lowered(0.04))
    assert cell.time < 0.5


def test_a_jump_of_the_null_space_input_comes_smoothly(cell):
    pull = np.array([0.6, 0.0, -0.6, 0.0, 0.5, 0.0, 0.0])

    class Jump(Human):
        def read(self, state):
            return HumanInput(nullspace_input=pull * (state.time < 0.5))

    cell.human = Jump()
    cell.hold_pose(1.5)
    d = cell.log["nullspace_input"]
    acceleration = np.diff(d, axis=0) / cell.config.damping / cell.config.dt
    most = panda.limits.acceleration.numpy() + 1e-9
    assert (np.abs(acceleration[:49]) <= 0.3 * most).all()
    assert (np.abs(acceleration) <= 0.601 * most).all()
    assert np.abs(acceleration[0]).max() > 0.2
    # It ends as fast as it may.
    assert (np.abs(acceleration[49]) / most).max() > 0.59
    # All of it that is in the null space, in the end.
    unit = self_motion(panda.ready)
    np.testing.assert_allclose(d[48], unit * (unit @ pull), atol=0.08)
    assert (d[-1] == 0.0).all()


class LateArm(ObedientArm):
    """Does what it is told some steps later."""

    def __init__(self, q, late):
        super().__init__(q)
        self._told = [0 * q] * late

    def command(self, joint_velocity):
        self._told.append(joint_velocity.copy())
        self.velocity = self._told.pop(0)


@pytest.mark.parametrize("straight", [True, False])
def test_an_arm_whose_delay_is_known_keeps_to_its_path(straight):
    def lag(told):
        arm = LateArm(panda.ready.numpy(), late=3)
        cell = WorkCell(
            chain=panda,
            arm=arm,
            gripper=arm,
            human=ScriptedPerturbation(panda, ()),
            advance=arm.advance,
            config=WorkCellConfig(command_delay=told),
        )
        with shapes_unchecked():
            if straight:
                here = cell.pose
                up = torch.tensor([0.05, 0.1, 0.1], dtype=torch.float64)
                cell.move_straight(Pose(here.position + up, here.orientation))
            else:
                follow_path(cell, transfer())
        hand = panda.forward(torch.from_numpy(cell.log["joint_position"])).position
        away = hand - torch.from_numpy(cell.log["goal_position"])
        return float(away.norm(dim=-1).max())

    # Three steps of delay, and the one that a velocity takes to become a position.
    assert lag(0.03) < 1e-3
    assert lag(0.0) > 4 * lag(0.03)


@pytest.mark.parametrize(
    ("start", "side", "ends_at"),
    [
        ([-0.55, 0.77, -1.28, -2.3, -0.03, 1.12, -0.38], -1, "limit"),
        ([-0.13, 0.8, 1.3, -2.25, -1.07, 1.07, -1.29], 1, "limit"),
        ([0.82, -0.67, -1.4, -1.91, -0.1, 2.0, -0.19], -1, "singularity"),
        ([-0.12, 0.01, -0.48, -1.53, 0.95, 2.26, -1.12], -1, "singularity"),
    ],
)
def test_however_hard_and_long_a_person_pushes_the_task_keeps_its_place_and_room(
    start, side, ends_at
):
    """Pushes on and on along the self-motion, which would end there."""
    arm = LateArm(np.array(start), late=2)
    way = side * self_motion(start)

    class Person(Human):
        def read(self, state):
            unit = self_motion(state.joint_position)
            way[:] = unit * np.sign(unit @ way)
            return HumanInput(nullspace_input=12.0 * way)

        def tell(self, feedback):
            self.told = feedback

    person = Person()
    cell = WorkCell(
        chain=panda,
        arm=arm,
        gripper=arm,
        human=person,
        advance=arm.advance,
        config=WorkCellConfig(command_delay=0.02),
    )
    with shapes_unchecked():
        cell.hold_pose(6.0)
    joints = torch.from_numpy(cell.log["joint_position"])
    hand = panda.forward(joints).position
    assert (joints - joints[0]).abs().max() > 0.2
    assert (hand - hand[0]).norm(dim=-1).max() < 1.5e-3
    limits = panda.limits
    room_of_each = torch.minimum(joints - limits.lower, limits.upper - joints)
    room = room_of_each.min(-1).values
    singular = torch.linalg.svdvals(panda.jacobian(joints))[:, -1]
    assert room.min() > 0.1
    assert singular.min() > 0.049
    (reason, *_), joint = person.told.reasons, int(room_of_each[-1].argmin())
    assert person.told.followed < 0.1
    if ends_at == "limit":
        assert room[-1] < 0.14
        # The one that really is the nearest to its limit.
        assert (reason.hindrance, reason.text) == (
            "joint_limit",
            f"joint {joint + 1} is at its limit",
        )
        assert panda.joint_names[joint] in person.told.near_limits
    else:
        assert singular[-1] < 0.07
        assert reason.hindrance == "singularity"


def self_motion(q):
    q = torch.as_tensor(q, dtype=torch.float64)
    return np.linalg.svd(panda.jacobian(q).numpy())[2][6]


def test_the_null_space_gives_way_to_a_task_that_needs_the_room():
    """A joint at the edge of the room left to the task, which a push had moved it to."""
    q = panda.ready.clone()
    arm = ObedientArm(q.numpy())
    cell = cell_with(arm)
    lower, upper = cell._room.velocity_bounds(q)
    direction = self_motion(q)
    k = int(np.abs(direction).argmax())
    task = torch.zeros(7, dtype=torch.float64)
    task[k] = 0.2
    cell._room.velocity_bounds = lambda joints: (
        lower,
        upper.clone().index_fill(0, torch.tensor(k), 0.0),
    )
    J, still = panda.jacobian(q), torch.zeros(7, dtype=torch.float64)
    null = cell._within_limits(J, task, still)
    assert float((J @ null).norm()) < 1e-9
    assert float((task + null)[k]) == pytest.approx(0.0, abs=1e-9)


def pushed_along(path, push, seconds, **options):
    """A cell that follows a path while a person pushes from its first to its last second."""
    arm = ObedientArm(path[0])

    class Person(Human):
        def read(self, state):
            d = push if seconds[0] <= state.time < seconds[1] else np.zeros(7)
            return HumanInput(nullspace_input=d)

    cell = WorkCell(
        chain=panda, arm=arm, gripper=arm, human=Person(), advance=arm.advance, **options
    )
    with shapes_unchecked():  # hundreds of steps: three times as long checked
        follow_path(cell, path)
    return cell


PUSH = np.array([4.0, 0.0, -4.0, 0.0, 3.0, 0.0, 0.0])


def transfer():
    far = torch.tensor([-0.9, 0.3, 0.1, 0.3, -0.1, 0.3, -0.3], dtype=torch.float64)
    return joint_line(panda.ready, panda.ready + far, speed=0.4, dt=0.01).numpy()


def hand_off(cell):
    """Largest distance of the end effector from its pose on the path, which may wait."""
    joints, path = (
        torch.from_numpy(cell.log[name]) for name in ("joint_position", "path_joints")
    )
    hand, planned = panda.forward(joints), panda.forward(path)
    turn = quaternion.angle(hand.orientation, planned.orientation)
    return float((hand.position - planned.position).norm(dim=-1).max()), float(turn.max())


def test_a_person_pushes_the_elbow_aside_during_a_planned_motion_and_the_hand_goes_on():
    path = transfer()
    free, pushed = (pushed_along(path, push, (0.5, 2.5)) for push in (0 * PUSH, PUSH))
    elbows = [
        panda.link_poses(torch.from_numpy(cell.log["joint_position"][: len(path)])).position
        for cell in (free, pushed)
    ]
    aside = (elbows[1] - elbows[0])[:, 3].norm(dim=-1)
    assert aside.max() > 0.15
    lag, off = hand_off(free)[0], hand_off(pushed)
    assert off[0] < lag + 1e-3
    assert off[1] < 5e-3
    # So far aside that the null space might lead elsewhere by then, the path waits.
    planned = pushed.log["path_joints"]
    apart = np.linalg.norm(planned - pushed.log["joint_position"], axis=1)[1:]
    moves = np.abs(np.diff(planned, axis=0)).max(axis=1) > 1e-3
    assert apart.max() > FAR_ASIDE > apart[moves].max() - 0.1
    # Two seconds after they let go the joints are on their way back, at the end they are there.
    np.testing.assert_allclose(pushed.joints, path[-1], atol=0.04)
    speed = np.abs(pushed.log["joint_velocity"][260:]).max()
    assert speed < np.abs(free.log["joint_velocity"]).max() + 0.4


@pytest.mark.parametrize(
    ("straight", "after_push", "share"),
    [(0.6, "return", 0.0), (0.725, "return", 0.5), (0.9, "return", 1.0), (0.6, "stay", 1.0)],
)
@pytest.mark.parametrize("farther", [True, False])
def test_nobody_pushes_joints_so_far_that_they_do_not_find_back(
    straight, after_push, share, farther
):
    """But whoever leads them back does."""
    first, *_, null = np.linalg.svd(panda.jacobian(panda.ready).numpy())[2]

    class Person(Human):
        def read(self, state):
            return HumanInput(nullspace_input=(0.6 - 1.2 * farther) * null)

    # So slow on its way back that all the motion is of the push.
    config = WorkCellConfig(after_push=after_push, pose_gain=1e-3)
    cell = cell_with(ObedientArm(panda.ready.numpy()), config=config)
    cell.human = Person()
    cell.hold_pose(0.5)
    push = cell.yielding.null_velocity
    assert push.norm() > 0.05
    error = straight * null + np.sqrt(1 - straight**2) * first
    path = cell.joints.numpy()[None] + error
    jacobian = cell.jacobian
    follow_path(cell, path, until=lambda: len(cell.log) > 50)
    led = null_projection(jacobian, torch.from_numpy(cell.log["command_velocity"][50]))
    share = share if farther else 1.0
    assert float(led @ push / (push @ push)) == pytest.approx(share, abs=0.1)
    lost = farther and after_push == "return" and straight < 0.65
    assert hindered(cell, "too_far")[50] == lost
    assert cell.log["followed"][50] == pytest.approx(share, abs=0.1)


def test_who_pushes_is_told_that_a_path_which_waits_leads_the_joints_back():
    null = np.linalg.svd(panda.jacobian(panda.ready).numpy())[2][-1]

    class Person(Human):
        def read(self, state):
            return HumanInput(nullspace_input=-0.5 * null)

    cell = cell_with(ObedientArm(panda.ready.numpy()))
    cell.human = Person()
    cell.hold_pose(0.5)
    path = np.repeat(cell.joints.numpy()[None] + (FAR_ASIDE + 0.1) * null, 100, axis=0)
    follow_path(cell, path, until=lambda: len(cell.log) > 120)
    followed, velocity = cell.log["followed"], cell.log["joint_velocity"] @ null
    assert followed[49] == pytest.approx(1.0, abs=0.01)
    assert velocity[49] < -0.1
    # From 0.5 s on, as the path has stopped and the joints turn round.
    assert followed[-1] == 0.0
    assert velocity[-1] > 0.1
    assert hindered(cell, "too_far")[-1]


def test_a_path_gone_back_to_where_the_joints_are_on_it_goes_on():
    cell = cell_with(ObedientArm(panda.ready.numpy()))
    patience, off = _Patience(cell.config), torch.full((7,), 0.5, dtype=torch.float64)
    cell.yielding.begin(off)
    for _ in range(205):
        patience.step(cell.yielding, off, 0.0, True)
    assert patience.is_stuck
    for _ in range(100):
        patience.step(cell.yielding, off * 0.5, -1.0, True)
    assert patience.is_stuck
    cell.yielding.begin(torch.zeros_like(off))
    patience.step(cell.yielding, off * 0, -1.0, True)
    assert not patience.is_stuck


def test_a_path_that_waits_is_not_gone_back_while_the_joints_come_nearer():
    """However slowly: here for longer than it takes to give up."""
    path = transfer()
    cell = pushed_along(path, PUSH, (0.3, 4.0), config=WorkCellConfig(return_speed=0.15))
    planned, joints = cell.log["path_joints"], cell.log["joint_position"]
    off = np.linalg.norm(planned - joints, axis=1)
    assert off.max() > FAR_ASIDE
    along = (planned - path[0]) @ (path[-1] - path[0])
    assert np.diff(along).min() > -1e-6
    rests = np.abs(np.diff(planned, axis=0)).max(axis=1) < 1e-6
    released = cell.log["time"][1:] > 4.0
    assert 0.01 * (rests & released).sum() > 2.0 + STUCK
    # Until the joints are well on their way back.
    assert off[1:][released & ~rests][0] < 1.45


def test_who_holds_the_arm_aside_for_ever_is_not_waited_for_so_long():
    config = WorkCellConfig(longest_wait=1.0)
    with pytest.raises(TaskFailedError, match="held aside"):
        pushed_along(transfer(), PUSH, (0.3, 60.0), config=config)


def test_an_arm_that_meets_something_is_not_one_that_was_pushed():
    class Stuck(ObedientArm):
        def advance(self, duration):
            first = self.q[0]
            super().advance(duration)
            self.q[0] = first

    cell, path = cell_with(Stuck(panda.ready.numpy())), transfer()
    with shapes_unchecked():
        assert follow_path(cell, path, until=lambda: len(cell.log) > 2 * len(path)) == len(path)
    assert abs(float(cell.joints[0]) - path[-1, 0]) > 0.5
    assert len(cell.log) == len(path)


def test_joints_stay_beside_the_path_if_wanted():
    path, config = transfer(), WorkCellConfig(after_push="stay")
    cell = pushed_along(path, PUSH, (0.5, 2.5), config=config)
    assert np.abs(cell.joints.numpy() - path[-1]).max() > 0.2
    assert hand_off(cell)[0] < 4e-3
    assert len(cell.log) == len(path)


def test_nobody_pushes_the_arm_into_what_is_around_it():
    """A wall where the elbow would be pushed to; the hand goes on all the same."""
    path = transfer()
    free = pushed_along(path, PUSH, (0.5, 2.5))
    reached = panda.link_poses(torch.from_numpy(free.log["joint_position"])).position[:, 3]
    middle, start = reached[reached[:, 1].argmax()], reached[0]

    def clearance(q):
        elbow = panda.link_poses(q).position[..., 3, :]
        return ((start + middle) / 2 - elbow)[..., 1] + 0.03

    kept = pushed_along(path, PUSH, (0.5, 2.5), clearance=clearance)
    distance = clearance(torch.from_numpy(kept.log["joint_position"]))
    assert clearance(torch.from_numpy(free.log["joint_position"])).min() < 0
    assert distance.min() > 0.02
    assert hand_off(kept)[0] < 4e-3


def hindered(cell, hindrance):
    """In which steps the person was told of a hindrance."""
    return cell.log["hindered"][:, HINDRANCES.index(hindrance)].astype(bool)


def along_a_singularity():
    """A path on which the shoulder is stretched half-way."""
    start = torch.tensor([-0.3, 0.7, 1.5, -1.9, -0.1, 2.0, -0.3], dtype=torch.float64)
    end = torch.tensor([-0.4, -0.7, 1.6, -1.9, 0.1, 2.0, -0.1], dtype=torch.float64)
    path = joint_line(start, end, speed=0.4, dt=0.01)
    smallest = torch.linalg.svdvals(panda.jacobian(path))[:, -1]
    assert smallest[[0, -1]].min() > 0.1 > 0.02 > smallest.min()
    return path.numpy(), int(smallest.argmin())


def test_a_path_waits_before_its_singularity_while_a_person_holds_the_elbow_aside():
    path, narrow = along_a_singularity()
    cell = pushed_along(path, 0.5 * PUSH, (0.2, 4.0))
    followed = cell.log["path_joints"]
    time, released = cell.log["time"], cell.log["time"] < 4.0
    reached = np.linalg.norm(followed[:, None] - path[None], axis=-1).argmin(axis=1)
    assert reached[released].max() < narrow
    assert (np.linalg.norm(cell.log["joint_position"] - followed, axis=1)[released]).max() > 0.1
    # The hand stays where the path waits; on through the singularity the joints are on it.
    q = torch.from_numpy(cell.log["joint_position"])
    off = panda.forward(q).position - torch.from_numpy(cell.log["goal_position"])
    assert off.norm(dim=-1).max() < 6e-3
    assert hindered(cell, "task_waits").sum() > 100
    assert not hindered(cell, "task_waits")[~released].any()
    at = reached == narrow
    assert np.abs(cell.log["joint_position"] - followed)[at].max() < 0.03
    np.testing.assert_allclose(cell.joints, path[-1], atol=0.03)
    assert time[-1] > 4.0 + len(path) * 0.01 / 4


def test_joints_that_stay_beside_a_path_come_back_to_it_before_its_singularity():
    path, _ = along_a_singularity()
    config = WorkCellConfig(after_push="stay")
    cell = pushed_along(path, 0.5 * PUSH, (0.2, 1.0), config=config)
    np.testing.assert_allclose(cell.joints, path[-1], atol=0.03)


@pytest.mark.parametrize("distance", [0.5, -0.5])
def test_an_arm_that_finds_no_way_back_goes_straight_or_says_so(distance):
    goal = panda.ready
    away = goal + torch.tensor([0.0, 0.3, 0.0, 0.3, 0.0, 0.0, 0.0], dtype=torch.float64)
    arm = ObedientArm(away.numpy())

    def clearance(q):
        # Clear at both ends; in between as given.
        ends = torch.stack([goal, away])
        near = (q[..., None, :] - ends).norm(dim=-1).amin(-1)
        return torch.where(near < 0.05, 0.5, distance)

    cell = cell_with(arm, clearance=clearance)
    path = goal[None].numpy()
    with shapes_unchecked():
        if distance < 0:
            with pytest.raises(BlockedPathError, match="pushed aside"):
                PathFollower(cell, path).go_straight_back(0.0)
        else:
            assert PathFollower(cell, path).go_straight_back(0.0) == 0.0
            np.testing.assert_allclose(cell.joints, goal, atol=0.03)
            speed = np.linalg.norm(cell.log["joint_velocity"], axis=1).max()
            assert speed < 2 * cell.config.return_speed


def test_where_the_way_back_is_blocked_another_sample_of_the_path_is_as_good():
    """A wall between the arm and where the path waits, but not where it began."""
    start = panda.ready
    waits = start + torch.tensor([0.0, 0.3, 0.0, 0.3, 0.0, 0.0, 0.0], dtype=torch.float64)
    arm = ObedientArm((start + torch.tensor([0.2] + 6 * [0.0]).double()).numpy())

    def clearance(q):
        # A post halfway to the sample at which it waits.
        middle = (torch.from_numpy(arm_began) + waits) / 2
        return (q - middle).norm(dim=-1) - 0.15

    arm_began = arm.q.copy()
    cell = cell_with(arm, clearance=clearance)
    path = joint_line(start, waits, speed=0.5, dt=0.01).numpy()
    with shapes_unchecked():
        sample = PathFollower(cell, path).go_straight_back(float(len(path) - 1))
    assert sample < len(path) / 2
    np.testing.assert_allclose(cell.joints, path[int(sample)], atol=0.05)
    assert clearance(torch.from_numpy(cell.log["joint_position"])).min() > 0


def test_at_a_singularity_of_the_path_nobody_pushes_the_arm_off_it():
    path, narrow = along_a_singularity()
    begin = 0.01 * narrow
    cell = pushed_along(path, PUSH, (begin - 0.05, begin + 0.05))
    off = np.abs(cell.log["joint_position"] - cell.log["path_joints"])
    assert off.max() < 0.05
    assert len(cell.log) <= len(path) + 30
    pushed = np.isfinite(cell.log["followed"])
    assert pushed.sum() == 10
    assert hindered(cell, "narrow_path")[pushed].all()
    assert (cell.log["followed"][pushed] == 0).all()


def test_the_path_waits_where_the_arm_aside_would_meet_something():
    """A wall across the way of the elbow that is pushed aside, but not of the planned one."""
    path = transfer()
    free, pushed = (pushed_along(path, push, (0.2, 2.5)) for push in (0 * PUSH, PUSH))

    def elbow(cell):
        return panda.link_poses(torch.from_numpy(cell.log["joint_position"])).position[:, 3]

    aside = elbow(pushed)[len(path) // 2]
    assert (elbow(free) - aside).norm(dim=-1).min() > 0.1

    def clearance(q):
        return (panda.link_poses(q).position[..., 3, :] - aside).norm(dim=-1) - 0.05

    kept = pushed_along(path, PUSH, (0.2, 2.5), clearance=clearance)
    assert clearance(torch.from_numpy(pushed.log["joint_position"])).min() < 0
    assert clearance(torch.from_numpy(kept.log["joint_position"])).min() > 0.015
    q = torch.from_numpy(kept.log["joint_position"])
    off = panda.forward(q).position - torch.from_numpy(kept.log["goal_position"])
    assert off.norm(dim=-1).max() < 6e-3
    np.testing.assert_allclose(kept.joints, path[-1], atol=0.04)
