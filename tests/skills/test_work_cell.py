"""The control loop of a work cell, on an arm that does as it is told."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from obedient_arm import ObedientArm, cell_with, hindered
from unchecked import shapes_unchecked

from hrc_learn.controller.arm_loop_state import MoveJoints
from hrc_learn.geometry import Pose
from hrc_learn.kinematics import ArmChoice, panda
from hrc_learn.protocols import Human, HumanInput
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills import (
    StoppedByPersonError,
    TaskFailedError,
    WorkCell,
    WorkCellConfig,
    joint_line,
)
from hrc_learn.skills.marker_sensor import SeenFeature

pytestmark = pytest.mark.simulation


@pytest.fixture
def cell():
    return cell_with(ObedientArm(panda.ready.numpy()))


@pytest.mark.parametrize("name", ["ur5e", "so101"])
def test_without_input_an_arm_of_any_number_of_joints_holds_its_pose(name):
    class NoInput(Human):
        def read(self, state):
            return HumanInput()

        def tell(self, feedback):
            pass

    chain = ArmChoice(name).work_arm().chain
    q = chain.ready.numpy()
    arm = ObedientArm(q)
    cell = WorkCell(chain=chain, arm=arm, gripper=arm, human=NoInput(), advance=arm.advance)
    cell.hold_pose(0.1)
    assert cell.log["nullspace_input"].shape[1:] == q.shape
    assert not cell.log["nullspace_input"].any()
    np.testing.assert_allclose(arm.q, q, atol=1e-6)


class CountingSensor:
    age = 0.0

    def __init__(self):
        self.asked = []

    def features(self, ids):
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

    def features(self, ids):
        now = self._arm.time
        taken = 0.07 * np.floor((now - 0.05) / 0.07)
        self.age = now - taken + 1e-4 * np.sin(1e3 * now)  # the clocks differ a little
        pixel = np.array([taken, 0.0])
        return {7: SeenFeature(pixel, 0.0)}

    def read(self):
        return np.zeros((2, 2, 3), np.uint8)


def test_an_image_is_kept_now_and_then():
    arm = ObedientArm(panda.ready.numpy())
    cell = cell_with(arm, config=WorkCellConfig(keep_image_every=3))
    cell._markers._sensor = SlowCamera(arm)
    cell.hold_pose(10 * cell.config.dt)
    steps = [round(kept.time / cell.config.dt) for kept in cell.images]
    assert steps == [3, 6, 9]


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
            assert observation.features[7].pixel[0] == pytest.approx(observation.time, abs=2e-4)
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


def test_a_surface_is_found_where_it_is():
    top = float(panda.forward(HOVER).position[2]) - 0.03
    cell = cell_with(Wall(top, noise=0.2))
    met = cell.move_until_contact(lowered(0.06))
    assert met is not None
    assert float(met.position[2]) == pytest.approx(top, abs=2e-4)  # a step of the arm
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


@pytest.mark.long
def test_who_pushes_the_null_space_is_not_taken_for_a_surface():
    """Two pushes, one on the way and one as the surface is near, to both sides."""
    top = float(panda.forward(HOVER).position[2]) - 0.03
    pull = 8.0 * self_motion(HOVER)

    class Pushes(Human):
        def read(self, state):
            first, second = 0.6 < state.time < 1.1, 1.7 < state.time < 2.2
            return HumanInput(nullspace_input=pull * (int(first) - int(second)))

    cell = cell_with(RoughWall(top, noise=0.2), Pushes())
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
    cell = cell_with(arm, Push(), config=WorkCellConfig(longest_wait=0.3))
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


@pytest.mark.long
@pytest.mark.parametrize("straight", [True, False])
def test_an_arm_whose_delay_is_known_keeps_to_its_path(straight):
    def lag(told):
        arm = LateArm(panda.ready.numpy(), late=3)
        cell = cell_with(arm, config=WorkCellConfig(command_delay=told))
        with shapes_unchecked():
            if straight:
                here = cell.pose
                up = torch.tensor([0.05, 0.1, 0.1], dtype=torch.float64)
                cell.move_straight(Pose(here.position + up, here.orientation))
            else:
                far = torch.tensor([-0.9, 0.3, 0.1, 0.3, -0.1, 0.3, -0.3]).double()
                path = joint_line(panda.ready, panda.ready + far, speed=0.6, dt=0.01)
                cell.follow_path(path.numpy())
        hand = panda.forward(torch.from_numpy(cell.log["joint_position"])).position
        away = hand - torch.from_numpy(cell.log["goal_position"])
        return float(away.norm(dim=-1).max())

    # Three steps of delay, and the one that a velocity takes to become a position.
    known = lag(0.03)
    assert known < 1e-3
    assert lag(0.0) > 4 * known


@pytest.mark.long
@pytest.mark.parametrize(
    ("start", "side", "ends_at"),
    [
        ([-0.55, 0.77, -1.28, -2.3, -0.03, 1.12, -0.38], -1, "limit"),
        ([0.82, -0.67, -1.4, -1.91, -0.1, 2.0, -0.19], -1, "singularity"),
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
        cell.hold_pose(4.0)
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


class SlowArm(ObedientArm):
    """Follows a third of a command for a while, as at a limit."""

    def advance(self, duration):
        now = self.velocity
        if 0.4 < self.time < 1.4:
            self.velocity = now / 3
        super().advance(duration)
        self.velocity = now


def test_a_straight_line_is_kept_to_when_the_cell_is_slow():
    cell = cell_with(ObedientArm(HOVER.numpy()), config=WorkCellConfig(speed=0.5))
    with shapes_unchecked():
        cell.move_straight(lowered(0.002), speed=0.04)
    hand = panda.forward(torch.from_numpy(cell.log["joint_position"])).position
    away = hand - torch.from_numpy(cell.log["goal_position"])
    assert float(away.norm(dim=-1).max()) < 1e-4


@pytest.mark.long
def test_a_straight_line_slows_down_for_an_arm_that_falls_behind():
    cell = cell_with(SlowArm(HOVER.numpy()))
    start = cell.pose.position
    with shapes_unchecked():
        cell.move_straight(lowered(0.15), speed=0.15)
    hand = panda.forward(torch.from_numpy(cell.log["joint_position"])).position
    goal = torch.from_numpy(cell.log["goal_position"])
    planned = -(goal - start)[:, 2] / 0.15
    # Without the rule the pose would be 46 mm ahead of the arm.
    assert (hand - goal).norm(dim=-1).max() < 0.035
    assert cell.time > 1.4 + 0.5
    assert planned.diff().min() > -1e-9
    torch.testing.assert_close(hand[-1], lowered(0.15).position, rtol=0, atol=2e-3)


class Stops(Human):
    """Asks to stop from one time on; between 0.1 s and 0.1 s before that, also pushes."""

    def __init__(self, at, push=0.0):
        self.at, self._push = at, push

    def read(self, state):
        pushes = 0.1 <= state.time < self.at - 0.1
        return HumanInput(
            nullspace_input=self._push * self_motion(panda.ready) * pushes,
            stop="enough" if state.time >= self.at - 1e-9 else "",
        )


def test_an_arm_that_a_person_stops_brakes_to_rest_within_its_acceleration():
    cell = cell_with(ObedientArm(panda.ready.numpy()), Stops(0.3))
    speed = torch.zeros(7).double()
    speed[0] = 0.5
    with pytest.raises(StoppedByPersonError, match=r"^stopped: enough$"):
        turn(cell, speed)
    arm, dt = cell._arm, cell.config.dt
    assert not arm.velocity.any()
    commanded = cell.log["command_velocity"][:, 0]
    stop = round(0.3 / dt)
    moving = int((np.abs(commanded) > 1e-6).sum())
    slower = -np.diff(commanded[stop - 1 : moving])
    assert (slower > 0).all()
    assert slower.max() <= float(panda.limits.acceleration[0]) * dt * (1 + 1e-9)
    assert len(commanded) - stop < 0.5 / dt
    # The task did not end by itself: the request alone raised.
    assert commanded[:stop].max() == pytest.approx(0.5, rel=1e-6)


def turn(cell, speed):
    while cell.time < 9.0:
        cell.step(speed)


def test_an_arm_that_does_not_come_to_rest_is_given_up_after_a_second(monkeypatch):
    """Its filter would brake for longer."""
    config = WorkCellConfig(dt=0.02)
    cell = cell_with(ObedientArm(panda.ready.numpy()), Stops(0.06), config=config)
    monkeypatch.setattr(
        type(cell), "step", lambda self, velocity: self._act(MoveJoints(joint_velocity=TURNING))
    )
    with pytest.raises(StoppedByPersonError):
        cell.hold_pose(0.1)
    assert cell.time == pytest.approx(0.06 + 1.0, abs=2.5 * cell.config.dt)


TURNING = torch.full((7,), 0.01, dtype=torch.float64)


def test_detection_is_awaited_on_an_arm_that_holds_its_pose(cell):
    """Images of the past do not count, however many arrive."""
    arm = cell._arm
    cell._markers._sensor = SlowCamera(arm)
    turning = torch.zeros(7).double()
    turning[0] = 0.2
    for _ in range(30):
        cell.step(turning)
    begun, steps = cell.time, len(cell.log)
    observed = cell.wait_for_detection()
    assert begun <= observed.time <= cell.time
    assert observed is cell.observation
    # At most 70 ms until an image is taken, 50 ms until it arrives, two steps between looks.
    assert 0.05 <= cell.time - begun <= 0.07 + 0.05 + 0.05
    waited = len(cell.log) - steps
    assert waited % cell.config.detect_every == 0
    assert np.abs(cell.log["command_velocity"][-1]).max() < 0.05


def test_joints_pushed_aside_return_after_the_end_of_a_path_unless_they_are_to_stay():
    """The path lasts 0.5 s; a person pushes during its first half."""
    goal = panda.ready.clone()
    goal[0] += 0.2
    path = joint_line(panda.ready, goal, speed=1.875 * 0.2 / 0.5, dt=0.02).numpy()
    off, steps = {}, {}
    for after in ("return", "stay"):
        config = WorkCellConfig(dt=0.02, after_push=after)
        person = Stops(0.35, push=6.0)
        person.read = pushing_only(person.read)
        cell = cell_with(ObedientArm(path[0]), person, config=config)
        assert cell.follow_path(path) == len(path)
        assert cell.plan is None
        off[after] = float(np.abs(cell.joints.numpy() - path[-1]).max())
        steps[after] = len(cell.log)
    assert 3 * off["return"] < off["stay"]
    assert len(path) <= steps["stay"] < steps["return"] < len(path) + 5.0 / 0.02


def pushing_only(read):
    """The same person, who does not stop the arm."""
    return lambda state: replace(read(state), stop="")


def test_a_return_that_does_not_succeed_ends_after_five_seconds(monkeypatch):
    path = np.repeat(panda.ready.numpy()[None], 2, axis=0)
    cell = cell_with(ObedientArm(path[0]), config=WorkCellConfig(dt=0.1))
    observe = cell._loop.observe

    def never_back(state, reading):
        state, limitations = observe(state, reading)
        return replace(state, aside=torch.tensor(True)), limitations

    monkeypatch.setattr(cell._loop, "observe", never_back)
    assert cell.follow_path(path) == 2
    assert 5.0 <= cell.time <= 5.0 + 4 * cell.config.dt


def test_distances_are_those_of_the_people_who_are_tracked(cell):
    assert cell.distances is None
    people: Any = SimpleNamespace(distances="distances")
    with shapes_unchecked():
        cell._reading = replace(cell._reading, people=people)
    assert cell.distances == "distances"


def test_an_image_that_is_taken_at_once_needs_no_waiting(cell):
    cell._markers._sensor = CountingSensor()
    assert cell.wait_for_detection().time == cell.time
    assert len(cell.log) == 0
