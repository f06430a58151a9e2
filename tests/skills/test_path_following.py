"""Planned paths of the joints, off which a person pushes an arm that does as it is told."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from obedient_arm import ObedientArm, cell_with, hindered
from unchecked import shapes_unchecked

from hrc_learn.controller.joint_path import FAR_ASIDE
from hrc_learn.geometry import quaternion
from hrc_learn.geometry.numerics import null_projection
from hrc_learn.kinematics import panda
from hrc_learn.protocols import Human, HumanInput
from hrc_learn.skills import TaskFailedError, WorkCellConfig, joint_line

pytestmark = pytest.mark.simulation

DT = 0.02
"""Step of the long simulations [s]: twice the usual one halves their cost."""
PUSH = np.array([4.0, 0.0, -4.0, 0.0, 3.0, 0.0, 0.0])


@pytest.fixture
def cell():
    return cell_with(ObedientArm(panda.ready.numpy()))


@pytest.mark.long
def test_the_joints_move_along_a_path_as_fast_as_it_runs(cell):
    far = torch.tensor([0.3, -0.2, 0.1, 0.2, -0.1, 0.3, -0.3], dtype=torch.float64)
    path = joint_line(panda.ready, panda.ready + far, speed=0.3, dt=0.01).numpy()
    assert cell.follow_path(path) == len(path)
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
        assert cell.follow_path(np.repeat(here[None], samples, axis=0)) == samples
    np.testing.assert_array_equal(cell.joints, here)


def test_a_path_is_left_when_its_end_is_told(cell):
    far = torch.full((7,), 0.1, dtype=torch.float64)
    path = joint_line(panda.ready, panda.ready + far, speed=0.3, dt=0.01).numpy()
    assert cell.follow_path(path, until=lambda: len(cell.log) == 12) == 12
    # Another motion may lead far from the path that was left.
    away = cell.pose.position - torch.tensor([0.0, 0.0, 0.2], dtype=torch.float64)
    cell.move_straight(replace(cell.pose, position=away))
    np.testing.assert_allclose(cell.pose.position, away, atol=1e-3)


class HeldArm(ObedientArm):
    """Arm whose first joint an object stops after 0.1 rad."""

    def advance(self, duration):
        super().advance(duration)
        self.q[0] = min(self.q[0], float(panda.ready[0]) + 0.1)


def test_an_arm_that_an_object_holds_does_not_go_on():
    cell = cell_with(HeldArm(panda.ready.numpy()))
    far = torch.tensor([1.2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    path = joint_line(panda.ready, panda.ready + far, speed=0.8, dt=0.01).numpy()
    with pytest.raises(
        TaskFailedError, match=r"arm is 0\.15 m off its path: an object holds it"
    ):
        cell.follow_path(path)
    near = joint_line(cell.joints, panda.ready, speed=0.8, dt=0.01).numpy()
    assert cell.follow_path(near) == len(near)


def pushed_along(path, push, seconds, clearance=None, **settings):
    """A cell that follows a path while a person pushes from its first to its last second."""
    arm = ObedientArm(path[0])

    class Person(Human):
        def read(self, state):
            d = push if seconds[0] <= state.time < seconds[1] else np.zeros(7)
            return HumanInput(nullspace_input=d)

    config = WorkCellConfig(dt=DT, command_delay=DT, **settings)
    cell = cell_with(arm, Person(), config=config, clearance=clearance)
    with shapes_unchecked():  # checked, the steps take twice as long
        cell.follow_path(path)
    return cell


@cache
def transfer():
    far = torch.tensor([-0.9, 0.3, 0.1, 0.3, -0.1, 0.3, -0.3], dtype=torch.float64)
    return joint_line(panda.ready, panda.ready + far, speed=0.5, dt=DT).numpy()


@cache
def along_transfer(strength):
    """A transfer with a push until 2.5 s, shared by tests that only read it."""
    return pushed_along(transfer(), strength * PUSH, (0.5, 2.5))


def hand_off(cell):
    """Largest distance of the end effector from its pose on the path, which may wait."""
    joints, path = (
        torch.from_numpy(cell.log[name]) for name in ("joint_position", "path_joints")
    )
    hand, planned = panda.forward(joints), panda.forward(path)
    turn = quaternion.angle(hand.orientation, planned.orientation)
    return float((hand.position - planned.position).norm(dim=-1).max()), float(turn.max())


@pytest.mark.long
def test_a_person_pushes_the_elbow_aside_during_a_planned_motion_and_the_hand_goes_on():
    path = transfer()
    free, pushed = along_transfer(0.0), along_transfer(1.0)
    elbows = [
        panda.link_poses(torch.from_numpy(cell.log["joint_position"][: len(path)])).position
        for cell in (free, pushed)
    ]
    aside = (elbows[1] - elbows[0])[:, 3].norm(dim=-1)
    assert aside.max() > 0.15
    lag, off = hand_off(free)[0], hand_off(pushed)
    assert off[0] < lag + 2e-3  # the errors of an explicit step of 20 ms
    assert off[1] < 5e-3
    # So far aside that the null space might lead elsewhere by then, the path waits.
    planned = pushed.log["path_joints"]
    apart = np.linalg.norm(planned - pushed.log["joint_position"], axis=1)[1:]
    moves = np.abs(np.diff(planned, axis=0)).max(axis=1) > 1e-3
    assert apart.max() > FAR_ASIDE > apart[moves].max() - 0.1
    # Two seconds after they let go the joints are on their way back, at the end they are there.
    np.testing.assert_allclose(pushed.joints, path[-1], atol=0.04)
    speed = np.abs(pushed.log["joint_velocity"][130:]).max()
    assert speed < np.abs(free.log["joint_velocity"]).max() + 0.4


@pytest.mark.long
@pytest.mark.parametrize(
    ("straight", "after_push", "share", "farther"),
    [
        (0.6, "return", 0.0, True),
        (0.725, "return", 0.5, True),
        (0.6, "return", 0.0, False),
        (0.6, "stay", 1.0, True),
    ],
)
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
    cell = cell_with(ObedientArm(panda.ready.numpy()), Person(), config=config)
    cell.hold_pose(0.5)
    push = cell.loop_state.null_velocity
    assert push.norm() > 0.05
    error = straight * null + np.sqrt(1 - straight**2) * first
    path = cell.joints.numpy()[None] + error
    jacobian = cell.jacobian
    cell.follow_path(path, until=lambda: len(cell.log) > 50)
    led = null_projection(jacobian, torch.from_numpy(cell.log["command_velocity"][50]))
    share = share if farther else 1.0
    assert float(led @ push / (push @ push)) == pytest.approx(share, abs=0.1)
    assert hindered(cell, "too_far")[50] == (share < 1)
    assert not hindered(cell, "task_waits")[50]
    assert cell.log["followed"][50] == pytest.approx(share, abs=0.1)


@pytest.mark.long
def test_who_pushes_is_told_that_a_path_which_waits_leads_the_joints_back():
    null = np.linalg.svd(panda.jacobian(panda.ready).numpy())[2][-1]

    class Person(Human):
        def read(self, state):
            return HumanInput(nullspace_input=-0.5 * null)

    cell = cell_with(ObedientArm(panda.ready.numpy()), Person())
    cell.hold_pose(0.5)
    path = np.repeat(cell.joints.numpy()[None] + (FAR_ASIDE + 0.1) * null, 100, axis=0)
    cell.follow_path(path, until=lambda: len(cell.log) > 120)
    followed, velocity = cell.log["followed"], cell.log["joint_velocity"] @ null
    assert followed[49] == pytest.approx(1.0, abs=0.01)
    assert velocity[49] < -0.1
    # From 0.5 s on, as the path has stopped and the joints turn round.
    assert followed[-1] == 0.0
    assert velocity[-1] > 0.1
    assert hindered(cell, "too_far")[-1]


@pytest.mark.long
def test_a_path_that_waits_is_not_gone_back_while_the_joints_come_nearer():
    """However slowly: here for longer than it takes to give up."""
    path = transfer()
    cell = pushed_along(path, PUSH, (0.3, 3.0), return_speed=0.15)
    planned, joints = cell.log["path_joints"], cell.log["joint_position"]
    off = np.linalg.norm(planned - joints, axis=1)
    assert off.max() > FAR_ASIDE
    along = (planned - path[0]) @ (path[-1] - path[0])
    assert np.diff(along).min() > -1e-6
    rests = np.abs(np.diff(planned, axis=0)).max(axis=1) < 1e-6
    released = cell.log["time"][1:] > 3.0
    assert DT * (rests & released).sum() > 2.0 + cell.config.back_after
    # Until the joints are well on their way back.
    assert off[1:][released & ~rests][0] < 1.45


@pytest.mark.long
def test_who_holds_the_arm_aside_for_ever_is_not_waited_for_so_long():
    with pytest.raises(TaskFailedError, match="held aside"):
        pushed_along(transfer(), PUSH, (0.3, 60.0), longest_wait=1.0)


@pytest.mark.long
def test_an_arm_that_meets_something_is_not_one_that_was_pushed():
    class Stuck(ObedientArm):
        def advance(self, duration):
            first = self.q[0]
            super().advance(duration)
            self.q[0] = first

    config = WorkCellConfig(dt=DT, command_delay=DT)
    cell, path = cell_with(Stuck(panda.ready.numpy()), config=config), transfer()
    with pytest.raises(TaskFailedError, match="off its path: an object holds it"):
        cell.follow_path(path)
    assert not cell.loop_state.aside
    assert len(cell.log) < len(path)


@pytest.mark.long
def test_joints_stay_beside_the_path_if_wanted():
    path = transfer()
    cell = pushed_along(path, PUSH, (0.5, 2.5), after_push="stay")
    assert np.abs(cell.joints.numpy() - path[-1]).max() > 0.2
    assert hand_off(cell)[0] < 4e-3
    assert len(cell.log) == len(path)


@pytest.mark.long
def test_nobody_pushes_the_arm_into_what_is_around_it():
    """A wall where the elbow would be pushed to; the hand goes on all the same."""
    path = transfer()
    free = along_transfer(1.0)
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


def along_a_singularity():
    """A path on which the shoulder is stretched half-way."""
    start = torch.tensor([-0.3, 0.7, 1.5, -1.9, -0.1, 2.0, -0.3], dtype=torch.float64)
    end = torch.tensor([-0.4, -0.7, 1.6, -1.9, 0.1, 2.0, -0.1], dtype=torch.float64)
    path = joint_line(start, end, speed=0.5, dt=DT)
    smallest = torch.linalg.svdvals(panda.jacobian(path))[:, -1]
    assert smallest[[0, -1]].min() > 0.1 > 0.02 > smallest.min()
    return path.numpy(), int(smallest.argmin())


@pytest.mark.long
def test_a_path_waits_before_its_singularity_while_a_person_holds_the_elbow_aside():
    path, narrow = along_a_singularity()
    cell = pushed_along(path, 0.5 * PUSH, (0.2, 3.0))
    followed = cell.log["path_joints"]
    time, released = cell.log["time"], cell.log["time"] < 3.0
    reached = np.linalg.norm(followed[:, None] - path[None], axis=-1).argmin(axis=1)
    assert reached[released].max() < narrow
    assert (np.linalg.norm(cell.log["joint_position"] - followed, axis=1)[released]).max() > 0.1
    # The hand stays where the path waits; on through the singularity the joints are on it.
    q = torch.from_numpy(cell.log["joint_position"])
    off = panda.forward(q).position - torch.from_numpy(cell.log["goal_position"])
    assert off.norm(dim=-1).max() < 6e-3
    assert hindered(cell, "task_waits").sum() > 30
    assert not hindered(cell, "task_waits")[~released].any()
    at = reached == narrow
    assert np.abs(cell.log["joint_position"] - followed)[at].max() < 0.03
    np.testing.assert_allclose(cell.joints, path[-1], atol=0.03)
    assert time[-1] > 3.0 + len(path) * DT / 4


@pytest.mark.long
def test_joints_that_stay_beside_a_path_come_back_to_it_before_its_singularity():
    path, _ = along_a_singularity()
    cell = pushed_along(path, 0.5 * PUSH, (0.2, 1.0), after_push="stay")
    np.testing.assert_allclose(cell.joints, path[-1], atol=0.03)


@pytest.mark.long
def test_at_a_singularity_of_the_path_nobody_pushes_the_arm_off_it():
    path, narrow = along_a_singularity()
    begin = DT * narrow
    cell = pushed_along(path, PUSH, (begin - 0.05, begin + 0.05))
    off = np.abs(cell.log["joint_position"] - cell.log["path_joints"])
    assert off.max() < 0.05
    assert len(cell.log) <= len(path) + 30
    pushed = np.isfinite(cell.log["followed"])
    assert pushed.sum() == 5
    assert hindered(cell, "narrow_path")[pushed].all()
    assert (cell.log["followed"][pushed] == 0).all()


@pytest.mark.long
def test_the_path_waits_where_the_arm_aside_would_meet_something():
    """A wall across the way of the elbow that is pushed aside, but not of the planned one."""
    path = transfer()
    free, pushed = along_transfer(0.0), along_transfer(1.0)

    def elbow(cell):
        return panda.link_poses(torch.from_numpy(cell.log["joint_position"])).position[:, 3]

    aside = elbow(pushed)[len(path) // 2]
    assert (elbow(free) - aside).norm(dim=-1).min() > 0.1

    def clearance(q):
        return (panda.link_poses(q).position[..., 3, :] - aside).norm(dim=-1) - 0.05

    kept = pushed_along(path, PUSH, (0.5, 2.5), clearance=clearance)
    assert clearance(torch.from_numpy(pushed.log["joint_position"])).min() < 0
    assert clearance(torch.from_numpy(kept.log["joint_position"])).min() > 0.015
    q = torch.from_numpy(kept.log["joint_position"])
    off = panda.forward(q).position - torch.from_numpy(kept.log["goal_position"])
    assert off.norm(dim=-1).max() < 6e-3
    np.testing.assert_allclose(kept.joints, path[-1], atol=0.04)
