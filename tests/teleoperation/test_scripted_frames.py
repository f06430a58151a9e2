"""Frames of scripted demonstrations: their times, rates, columns and repetitions."""

import math
from copy import copy
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from unchecked import shapes_unchecked

from hrc_learn.geometry import minimum_jerk
from hrc_learn.kinematics import gripper_down
from hrc_learn.protocols import ArmState, Human, HumanInput
from hrc_learn.sim import HAND_MARKER, World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.marker_sensor import MarkerSensor
from hrc_learn.skills.visual_skill import ANGLE_FEATURE, OBJECT_FEATURE
from hrc_learn.skills.work_cell import TaskFailedError
from hrc_learn.teleoperation import scripted_demonstrations
from hrc_learn.teleoperation.scripted_demonstrations import (
    DemonstrationConfig,
    PlacingDemonstrationConfig,
    ServoDemonstrationConfig,
    _turn_for,
    demonstrate_placing,
    demonstrate_servoing,
    film_servoing,
    guided_frames,
    placing_expert,
    servo_expert,
)

pytestmark = pytest.mark.simulation

WORKPLACE = Workplace()


@pytest.fixture(scope="module")
def world():
    return World(WORKPLACE.scene)


class Still(Human):
    """Asks for nothing."""

    def read(self, state):
        return HumanInput()


@pytest.mark.parametrize(
    ("every", "duration", "settle", "steps"),
    [(1, 0.02, 0.03, 5), (2, 0.05, 0.0, 5), (4, 0.1, 0.05, 15)],
)
def test_every_nth_control_step_is_a_frame(world, every, duration, settle, steps):
    config = DemonstrationConfig(duration=duration, settle=settle, record_every=every)
    assert config.fps == pytest.approx(100 / every)
    world.reset(WORKPLACE.home_joints().numpy())
    observed = []

    def observe():
        observed.append(world.time)
        return {"extra": len(observed)}

    frames = list(guided_frames(world, Still(), config, observe))
    assert len(frames) == math.ceil(steps / every)
    times = [frame["time"] for frame in frames]
    np.testing.assert_allclose(times, 0.01 * every * np.arange(len(frames)), atol=1e-9)
    np.testing.assert_allclose(observed, times, atol=1e-9)
    assert [frame["extra"] for frame in frames] == [*range(1, len(frames) + 1)]
    assert world.time == pytest.approx(0.01 * steps)


def test_a_frame_every_zero_steps_is_refused():
    with pytest.raises(ValueError, match="record_every must be positive, but is 0"):
        DemonstrationConfig(duration=1.0, record_every=0)
    assert DemonstrationConfig(duration=1.0, record_every=1).fps == pytest.approx(100.0)


@pytest.mark.parametrize("turned", [0.0, 0.8, -1.2])
def test_an_expert_of_servoing_wobbles_turns_for_the_object_and_ends_above_it(turned):
    config = ServoDemonstrationConfig(duration=10.0, points=3)
    above = np.array([0.4, 0.3, 0.1])
    expert = servo_expert(WORKPLACE, above, config, np.random.default_rng(0), turned)
    np.testing.assert_allclose(expert.path.position(10.0), above, atol=1e-9)
    # It descends from 6 cm above, last.
    late = np.array([expert.path.position(t) for t in np.linspace(8.5, 10.0, 30)])
    low = late[late[:, 2] < above[2] + 0.05]
    np.testing.assert_allclose(low[:, :2], np.broadcast_to(above[:2], (len(low), 2)), atol=2e-3)
    # Points lie within the reach of the middle, and above the height of hovering.
    middle = WORKPLACE.hover().position.numpy()
    rng = np.random.default_rng(0)
    spread = rng.uniform(-1, 1, (3, 3)) * (0.10, 0.08, 0.06)
    spread[:, 2] = np.abs(spread[:, 2])
    np.testing.assert_allclose(expert.path.position(0.0), middle + spread[0])
    passed = np.array([expert.path.position(t) for t in np.linspace(0, 10, 4001)])
    higher = above + np.array([0.0, 0.0, 0.06])
    points = np.vstack([middle + spread, higher])
    for point in points:
        assert np.linalg.norm(passed - point, axis=1).min() < 1e-3
    assert passed[:, 2].max() < points[:, 2].max() + 1e-9
    rates, phases = rng.uniform(0.8, 1.6, 3), rng.uniform(0, 2 * np.pi, 3)
    down = Rotation.from_quat(gripper_down().numpy(), scalar_first=True)
    for time in (0.0, 1.0, 3.0, 5.0, 6.5, 6.9, 7.2, 7.6, 10.0):
        # The wobble fades from 6.5 s to 7.5 s; the turn takes place from 2 s to 7 s.
        fading = min(max(7.5 - time, 0.0), 1.0)
        vector = 0.12 * fading * np.sin(rates * time + phases)
        vector[2] += turned * float(minimum_jerk(torch.tensor((time - 2.0) / 5.0))[0])
        expected = Rotation.from_rotvec(vector) * down
        found = expert.orientation(torch.zeros(3).double(), time).numpy()
        off = Rotation.from_quat(found, scalar_first=True) * expected.inv()
        assert off.magnitude() < 1e-6, time


def test_a_smaller_hand_is_guided_along_the_same_motion_in_proportion():
    """All lengths scale: way points, the final descent and the tremor."""
    robot = copy(WORKPLACE.robot)
    robot.hand_size = 0.6
    arm = replace(WORKPLACE.scene.arm, robot=robot)
    small = replace(WORKPLACE, scene=replace(WORKPLACE.scene, arm=arm))
    middle = WORKPLACE.hover().position.numpy()
    below = np.array([0.05, -0.02, -0.1])

    def motion(workplace, size, time):
        """Way covered from the middle, and what the tremor adds to the velocity."""
        shaking, steady = (
            servo_expert(
                workplace,
                middle + size * below,
                ServoDemonstrationConfig(tremor=tremor),
                np.random.default_rng(0),
            )
            for tremor in (0.02, 0.0)
        )
        q = np.zeros(len(workplace.robot.chain.joint_names))
        state = ArmState(time=time, joint_position=q, joint_velocity=q, gripper_width=0.0)
        added = shaking.read(state).twist - steady.read(state).twist
        return shaking.path.position(time) - middle, added[:3]

    for time in (0.0, 3.0, 6.0, 8.0, 8.9):
        way, shaken = motion(WORKPLACE, 1.0, time)
        way_of_small, shaken_of_small = motion(small, 0.6, time)
        np.testing.assert_allclose(way_of_small, 0.6 * way, atol=1e-9)
        np.testing.assert_allclose(shaken_of_small, 0.6 * shaken, atol=1e-9)
        assert np.linalg.norm(shaken) > 1e-3


CORNERS = np.array([[300.0, 200.0], [310.0, 200.0], [310.0, 210.0], [300.0, 210.0]])
OBJECT = CORNERS[:, ::-1] + 100


class Blinking(MarkerSensor):
    """Sees the object once, and the gripper's marker as it is told."""

    def __init__(self, *seen):
        self.seen = [None, *seen]

    def corners(self, ids=None):
        now = self.seen.pop(0) if self.seen else CORNERS
        found = {WORKPLACE.scene.objects[0].marker.id: OBJECT}
        return found if now is None else found | {HAND_MARKER: now}


BRIEF = ServoDemonstrationConfig(
    duration=0.1, settle=0.06, points=1, descent=0.01, record_every=2
)


def test_a_hidden_marker_is_where_it_was_seen_last(world):
    moved = CORNERS + 7.0
    sensor = Blinking(None, CORNERS, None, moved, None)
    frames = demonstrate_servoing(world, WORKPLACE, sensor, BRIEF, np.random.default_rng(0))
    assert len(frames) == 8
    centres = [frame["feature"].tolist() for frame in frames[:6]]
    assert centres == [[0, 0], [305, 205], [305, 205], [312, 212], [312, 212], [305, 205]]
    visible = [bool(frame["feature_visible"]) for frame in frames[:6]]
    assert visible == [False, True, False, True, False, True]
    for frame in frames:
        np.testing.assert_allclose(frame[OBJECT_FEATURE], [*OBJECT.mean(axis=0), 1.0])
    assert frames[1][ANGLE_FEATURE][0] == frames[2][ANGLE_FEATURE][0]


class Camera:
    """Counts the images that were taken."""

    def __init__(self):
        self.taken = 0

    def read(self):
        self.taken += 1
        return self.taken


def test_a_film_begins_at_home_and_goes_on_without_a_gap(world):
    camera: Any = Camera()
    config = replace(BRIEF, record_every=4)
    with shapes_unchecked():
        frames = list(
            film_servoing(
                world, WORKPLACE, Blinking(), camera, config, np.random.default_rng(0)
            )
        )
    times = np.array([frame["time"] for frame in frames])
    np.testing.assert_allclose(times, 0.04 * np.arange(len(frames)), atol=1e-9)
    assert [frame["images"]["front"] for frame in frames] == [*range(1, len(frames) + 1)]
    q = np.stack([frame["joint_position"] for frame in frames])
    np.testing.assert_allclose(q[0], WORKPLACE.home_joints(), atol=1e-3)
    # All but the 4 frames of the demonstration itself lead there, at 1.2 rad/s at most.
    lead = q[: len(frames) - 4]
    steps = np.abs(np.diff(lead, axis=0)).max(axis=1)
    assert steps.max() <= 1.2 * 0.04 + 1e-9
    assert steps.mean() > 0.5 * 0.04
    np.testing.assert_allclose(q[len(lead)], lead[-1], atol=1e-3)
    velocity = np.stack([frame["joint_velocity"] for frame in frames[: len(lead)]])
    np.testing.assert_allclose(velocity[1:-1], (lead[2:] - lead[:-2]) / 0.08, atol=1e-2)
    for frame in frames[:: len(frames) // 3]:
        tool = WORKPLACE.robot.chain.forward(torch.from_numpy(frame["joint_position"]))
        np.testing.assert_allclose(frame["position"], tool.position, atol=1e-6)


@pytest.mark.parametrize("turns", [(-0.4, np.pi - 0.4), (-np.pi / 2, np.pi / 2), (-0.3, 0.5)])
@pytest.mark.parametrize("yaw", [-3.0, -1.0, -0.2, 0.0, 0.3, 1.5, 3.1])
def test_the_gripper_turns_within_its_range_to_the_side_of_an_object(turns, yaw):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
    place: Any = SimpleNamespace(hover_turns=turns)
    with shapes_unchecked():
        turn = _turn_for(pose, place)
    assert turns[0] <= turn <= turns[1]
    # No other turn within reach is closer to the object's, up to half turns.
    best = np.abs(np.sin(np.linspace(*turns, 10_001) - yaw)).min()
    assert np.abs(np.sin(turn - yaw)) == pytest.approx(best, abs=2e-4)


@pytest.fixture
def outcomes(monkeypatch):
    """Demonstrations of placing whose ends [m off] and touches are chosen."""
    tried = []

    def prepare(*plan):
        plan = list(plan)
        goal = WORKPLACE.shelf("middle").position.numpy()
        world: Any = SimpleNamespace(
            cabinet_contacts=SimpleNamespace(touches=()),
            object_contacts=SimpleNamespace(touches=()),
        )

        def frames(world, expert, config):
            off, cabinet, held = plan[len(tried)]
            tried.append(expert)
            world.cabinet_contacts.touches, world.object_contacts.touches = cabinet, held
            yield {"position": goal + 5.0}
            yield {"position": goal + np.array([0.0, off, 0.0])}

        monkeypatch.setattr(scripted_demonstrations, "guided_frames", frames)
        monkeypatch.setattr(scripted_demonstrations, "placing_expert", lambda *given: given[2])
        with shapes_unchecked():
            return demonstrate_placing(
                world,
                WORKPLACE,
                "middle",
                PlacingDemonstrationConfig(),
                np.random.default_rng(0),
            )

    return prepare


@pytest.mark.parametrize(
    ("plan", "discarded"),
    [
        ([(0.019, (), ())], 0),
        ([(0.021, (), ()), (0.0, (), ())], 1),
        ([(0.0, ("a",), ()), (0.0, (), ("b",)), (0.019, (), ())], 2),
    ],
)
def test_a_demonstration_that_touches_or_misses_is_repeated(outcomes, plan, discarded):
    frames, found = outcomes(*plan)
    assert found == discarded
    assert len(frames) == 2


@pytest.mark.parametrize(
    ("last", "reason"),
    [((0.31, (), ()), "the arm ended 31 cm from its place"), ((0.0, ("x", "y"), ()), "x")],
)
def test_three_bad_demonstrations_are_given_up_with_the_last_reason(outcomes, last, reason):
    with pytest.raises(TaskFailedError, match=f"3 demonstrations in a row failed: {reason}$"):
        outcomes((0.5, (), ()), (0.5, (), ()), last)


@pytest.mark.parametrize("pulls", [True, False])
def test_an_expert_of_placing_starts_near_home_and_crosses_the_edge_higher(world, pulls):
    config = PlacingDemonstrationConfig(pull_elbow=pulls, lift=0.05, spread=0.03)
    rng = np.random.default_rng(7)
    expert: Any = placing_expert(world, WORKPLACE, "middle", config, rng)
    offset = 0.03 * np.random.default_rng(7).standard_normal(3)
    home = WORKPLACE.home().position.numpy()
    tool = WORKPLACE.robot.chain.forward(torch.from_numpy(world.arm.read().joint_position))
    np.testing.assert_allclose(tool.position, home + offset, atol=1e-3)
    assert world.holds(WORKPLACE.scene.objects[0].name)
    guide = expert._sources[0] if pulls else expert
    np.testing.assert_allclose(guide.path.position(0.0), home + offset, atol=1e-6)
    goal = WORKPLACE.shelf("middle").position.numpy()
    np.testing.assert_allclose(guide.path.position(14.0), goal, atol=1e-6)
    path = np.array([guide.path.position(t) for t in np.linspace(0, 14, 400)])
    front = WORKPLACE.scene.cabinet.front
    crossing = path[np.abs(path[:, 1] - front).argmin()]
    assert 0.02 < crossing[2] - goal[2] < 0.06
    if pulls:
        forces = expert._sources[1].forces
        assert [(f.start, f.end) for f in forces] == [(0.5, 5.5), (4.5, 15.5)]
