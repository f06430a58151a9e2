"""Steps of visual servoing that a whole grasp would hide."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from unchecked import shapes_unchecked

from hrc_learn.controller import AdaptiveController, Goals
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import FixedEstimator, Measurement, RBFImageJacobian, paper_grid
from hrc_learn.kinematics import panda
from hrc_learn.protocols import HumanInput
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills import MarkerObservation, ServoTarget, VisualServo, VisualServoConfig
from hrc_learn.skills.visual_servoing import ServoReading, ServoStep
from hrc_learn.skills.visual_skill import VisualTarget
from hrc_learn.vision.camera_model import IMAGE_SIZE

CONFIG = VisualServoConfig()
ABOVE = Workplace().hover()
MARKER = 3
MIDDLE = np.array([700.0, 500.0])
NO_OFFSET = VisualTarget(offset=np.zeros(3), error=np.nan)


class Estimator(FixedEstimator):
    """Notes the poses at which the image Jacobian is evaluated, and compared frames."""

    def __init__(self, jacobian):
        centers = paper_grid().double()
        network = RBFImageJacobian.from_jacobian(torch.as_tensor(jacobian), centers, 0.1)
        super().__init__(network)
        self.poses, self.pairs = [], []

    def jacobian(self, state, r):
        self.poses.append(r)
        return super().jacobian(state, r).detach()

    def compared(self, state, before, now):
        self.pairs.append((before, now))
        return state


@pytest.fixture
def law():
    estimator = Estimator(np.zeros((2, 6)))
    goals = Goals.at(ABOVE.position, ABOVE.orientation)
    return ServoStep(AdaptiveController(panda, estimator, goals), MARKER)


def reading(pixel=None, *, time=1.0, image_joints=None, push=0.0):
    pixels = {} if pixel is None else {MARKER: np.array(pixel)}
    joints = panda.ready + 0.2
    effort = np.zeros(7)
    effort[1] = push
    return ServoReading(
        time=time,
        dt=0.01,
        joints=joints,
        pose=panda.forward(joints),
        markers=MarkerObservation(time=time - 0.1, joints=image_joints, pixels=pixels),
        human=HumanInput(nullspace_input=effort),
        return_speed=0.4,
    )


def target_above(**changes):
    target = ServoTarget(
        config=CONFIG,
        above=ABOVE,
        posture=None,
        visual=NO_OFFSET,
        item=np.zeros(2),
    )
    return replace(target, **changes)


def offset_along(orientation, line):
    """Visual target whose offset is a direction in the base frame, at an orientation."""
    back = quaternion.conjugate(orientation)
    offset = quaternion.rotate(back, torch.tensor(line, dtype=torch.float64))
    return VisualTarget(offset=offset.numpy(), error=np.nan)


def about_vertical(angle):
    turn = quaternion.exp(torch.tensor([0.0, 0.0, angle], dtype=torch.float64))
    return quaternion.multiply(turn, ABOVE.orientation)


@pytest.mark.parametrize("detected", [True, False])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_outside_the_box_the_excess_decays_at_the_rate_on_any_side(detected, axis, side):
    above = panda.forward(panda.ready)
    goals = CONFIG.goals(above, MIDDLE, detected=detected)
    beyond = torch.zeros(3, dtype=torch.float64)
    beyond[axis] = side * 1e-3 * float(goals.position.half_size[axis])
    wall = above.position + 1e3 * beyond
    _, gradient = goals.position.feedback(wall + beyond)
    torch.testing.assert_close(-gradient, -CONFIG.rate * beyond, rtol=5e-3, atol=1e-9)
    assert not goals.position.feedback(wall - beyond)[1].any()


@pytest.mark.parametrize("known", [True, False])
def test_the_image_jacobian_is_estimated_once_an_image_at_the_pose_of_that_image(law, known):
    now = reading(image_joints=panda.ready if known else None)
    state = law.observed(law.initial_state(now.joints), now)
    law.observed(state, now)
    (pose,) = law.controller.estimator.poses
    there = panda.forward(panda.ready if known else now.joints)
    torch.testing.assert_close(pose.position, there.position)


@pytest.mark.parametrize(
    ("top", "fraction"), [(1.0, 1.0), (0.75, 0.75), (0.5, 0.5), (0.3, 0.5)]
)
def test_a_probe_starts_no_higher_than_the_marker_stays_in_the_image(law, top, fraction):
    """The marker leaves the image of this camera at a fraction of the probe's height."""
    edge = IMAGE_SIZE[1] - 1 - CONFIG.border
    rise = 200.0 / (top * CONFIG.probe)  # pixels a metre
    jacobian = np.zeros((2, 6))
    jacobian[1, 2] = rise * (1 - 1e-9)
    target = target_above(item=np.array([700.0, edge - 200.0]))
    state = replace(law.initial_state(panda.ready), image_jacobian=jacobian)
    height = law.probe_height(state, target)
    assert height == pytest.approx(fraction * CONFIG.probe)


@pytest.mark.parametrize(("detected", "raised"), [(True, 0.05), (False, 0.0)])
def test_the_end_effector_is_raised_only_after_its_marker_was_detected(detected, raised):
    """A camera that was moved is sure to see the box, not the space above it."""
    target = target_above(raised=0.05)
    goals = target.goals(np.zeros((2, 6)), ABOVE, detected=detected)
    expected = ABOVE.position + torch.tensor([0.0, 0.0, raised], dtype=torch.float64)
    torch.testing.assert_close(goals.position.centre, expected)


def pinhole(height):
    """Image Jacobian and pixel of a point below a camera of 1000 px that looks down."""
    xi = np.array([0.2, 0.1]) / height
    jacobian = np.zeros((2, 6))
    jacobian[:, :3] = 1000 / height * np.column_stack([np.diag([1.0, -1.0]), xi])
    return jacobian, 1000 * xi + np.array(IMAGE_SIZE) / 2


def test_a_descent_teaches_the_image_jacobian_at_its_lower_end(law):
    """A camera right above sees both ends; its depth changes by 1 / z a metre."""
    low, high = 1.2, 1.12
    jacobian, pixel = pinhole(low)

    def at(depth):
        none = torch.zeros(6, dtype=torch.float64)
        return Measurement(
            pose=Pose(torch.tensor([0.2, -0.1, -depth]).double(), ABOVE.orientation),
            feature=torch.from_numpy(pinhole(depth)[1]),
            valid=torch.tensor(True),
            dt=0.0,
            xi_x=none[:2],
            xi_r=none,
        )

    target = target_above(visual=replace(NO_OFFSET, focal=1000.0))
    state = replace(law.initial_state(panda.ready), image_jacobian=jacobian)
    law.learned(state, target, at(high), at(low))
    ((above, below),) = law.controller.estimator.pairs
    descent = above.pose.position - below.pose.position
    expected = torch.from_numpy(jacobian[:, :3]) @ descent
    torch.testing.assert_close(above.feature - below.feature, expected, rtol=1e-5, atol=0)
    torch.testing.assert_close(below.feature, torch.from_numpy(pixel))


@pytest.mark.parametrize("height", [-0.004, 0.0, 0.002, 0.013])
def test_within_the_box_the_target_is_straight_below(height):
    """Above the box it is on the line, which leans."""
    jacobian = np.zeros((2, 6))
    jacobian[:, :2] = 1000.0 * np.eye(2)
    leaning = offset_along(ABOVE.orientation, [0.6, 0.0, 0.8])
    target = target_above(visual=leaning, item=np.array([-600.0, 0.0]))
    up = torch.tensor([0.0, 0.0, height], dtype=torch.float64)
    pixel = target.pixel(jacobian, Pose(ABOVE.position + up, ABOVE.orientation))
    aside = 0.75 * max(height - CONFIG.half_size[2], 0.0)
    np.testing.assert_allclose(pixel, [1000.0 * aside, 0.0], atol=1e-9)


def test_the_goal_turns_no_faster_than_the_camera_can_guide_the_marker(law):
    wanted, goals = about_vertical(0.1), [ABOVE.orientation]
    state = replace(law.initial_state(panda.ready), wanted_orientation=wanted)
    taken = int(np.ceil(0.1 / CONFIG.turn_rate / 0.01))
    with torch.inference_mode(), shapes_unchecked():
        for k in range(taken + 2):
            _, state = law.step(state, reading(MIDDLE, time=1.0 + 0.01 * k), target_above())
            goals.append(state.goal_orientation)
    goals = torch.stack(goals)
    steps = quaternion.angle(goals[1:], goals[:-1])
    assert steps.max() <= CONFIG.turn_rate * 0.01 + 1e-12
    assert quaternion.angle(goals[taken], wanted) < 1e-7
    assert quaternion.angle(goals[taken - 2], wanted) > 1e-3


@pytest.mark.parametrize(
    ("pixel", "waits"),
    [
        (None, True),
        ((30.0, 500.0), False),
        ((1400.0, 500.0), True),
        ((700.0, 1060.0), False),
        ((700.0, 20.0), True),
        ((700.0, 500.0), False),
    ],
)
def test_a_turn_waits_where_it_would_move_the_marker_out_of_the_image(law, pixel, waits):
    """It swings the marker to the right and up here."""
    now, jacobian = reading(pixel), np.zeros((2, 6))
    jacobian[:, 5] = 200.0, -100.0
    state = replace(
        law.initial_state(panda.ready),
        wanted_orientation=about_vertical(0.5),
        goal_orientation=about_vertical(0.1),
        image_jacobian=jacobian,
        image_jacobian_time=now.markers.time,
    )
    with torch.inference_mode(), shapes_unchecked():
        _, state = law.step(state, now, target_above())
    turned = float(quaternion.angle(state.goal_orientation, about_vertical(0.1)))
    assert turned == pytest.approx(0.0 if waits else CONFIG.turn_rate * 0.01, abs=1e-7)


@pytest.mark.parametrize(
    ("pixel", "missing", "out"),
    [
        ((700.0, 500.0), 5.0, False),
        ((700.0, 1000.0), 0.5, False),
        ((700.0, 1000.0), 1.5, True),
        ((100.0, 500.0), 1.5, True),
        ((np.nan, np.nan), 1.5, True),
    ],
)
def test_only_a_marker_last_seen_near_the_border_has_left_the_image(law, pixel, missing, out):
    """A marker that vanishes in the middle is occluded: the end effector waits for it."""
    state = law.initial_state(panda.ready)
    state = replace(state, last_pixel=np.array(pixel), last_detection=10.0 - missing)
    assert law.out_of_view(state, 10.0) == out


def test_the_null_space_returns_except_while_a_person_pushes_it(law):
    state, speeds = law.initial_state(panda.ready), []
    far = panda.ready + 10.0
    target = target_above(rest=panda.ready)
    with torch.inference_mode(), shapes_unchecked():
        for k, push in enumerate([0.0] * 5 + [2.0] * 60 + [0.0] * 60):
            result, state = law.step(state, reading(time=1.0 + 0.01 * k, push=push), target)
            rest = result.goals.rest
            speeds.append(0.0 if rest is None else float(rest.gradient(far).norm()))
        result, _ = law.step(state, reading(time=3.0), replace(target, rest=None))
    speeds = np.array(speeds)
    np.testing.assert_allclose(speeds[[0, 4, -1]], 0.4, rtol=1e-3)
    assert not speeds[40:65].any()  # pushed for half a second and more
    assert np.abs(np.diff(speeds)).max() < 0.1 * 0.4  # without jumps
    assert result.goals.rest is None


@dataclass(frozen=True)
class Drawn:
    away, active, turn = False, False, torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)


@dataclass(frozen=True)
class State:
    last_detection: float = 0.0
    detected: bool = True
    drawn: Drawn = Drawn()


class Cell:
    """A work cell whose arm is at once where the step wants it."""

    chain, joints, distances = panda, panda.ready, None
    config, human_input = SimpleNamespace(dt=0.02, return_speed=0.4), HumanInput()
    pose, loop_state = ABOVE, SimpleNamespace(safety=None)

    def __init__(self, waits=1):
        self.time, self.task_time, self.waits = 0.0, 0.0, waits

    @property
    def observation(self):
        return MarkerObservation(time=self.time, joints=panda.ready, pixels={MARKER: MIDDLE})

    def execute(self, *_args, **_columns):
        self.time += 0.02
        # Every other step the arm waits for a person, with waits=2.
        if round(self.time / 0.02) % self.waits == 0:
            self.task_time += 0.02


class IdealStep:
    """A step without errors; `arrive` sets the pose of the arm for a target."""

    marker, config = MARKER, CONFIG

    def __init__(self, cell, arrive, tool_target=lambda target: target):
        self.cell, self.arrive, self.turned = cell, arrive, tool_target
        self.heights, self.descents = [], 0

    def initial_state(self, joints):
        return State()

    restarted = observed = staticmethod(lambda state, *_: state)
    probe_height = staticmethod(lambda state, target: CONFIG.probe)
    pixel_error = turn_error = staticmethod(lambda state, now, target: 0.0)
    out_of_view = staticmethod(lambda state, time: False)
    feature = staticmethod(lambda now: MIDDLE)

    def tool_target(self, state, target):
        return self.turned(target)

    def learned(self, state, target, high, low):
        self.descents += 1
        return state

    def step(self, state, now, target):
        self.heights.append(target.raised)
        self.cell.pose = self.arrive(target, self.descents)
        goals = SimpleNamespace(position=None)
        result = SimpleNamespace(
            command=None, goals=goals, approach=0.0, remark="", columns=lambda drawn: {}
        )
        return result, state


def raised_by(height):
    up = torch.tensor([0.0, 0.0, height], dtype=torch.float64)
    return Pose(ABOVE.position + up, ABOVE.orientation)


def test_a_probe_descends_at_its_speed_and_waits_with_the_task():
    cell = Cell(waits=2)
    step = IdealStep(cell, lambda target, _: raised_by(target.raised))
    with shapes_unchecked():
        VisualServo(cell, step).servo_to(target_above())
    heights = np.array(step.heights)
    descent = heights[(heights > 0) & (heights < CONFIG.probe)]
    lowered = np.diff(descent)
    np.testing.assert_allclose(lowered[::2], lowered[0], atol=1e-12)
    assert sorted({round(float(x), 9) for x in lowered}) == [-CONFIG.probe_speed * 0.02, 0.0]
    assert descent[-1] <= CONFIG.probe_speed * 0.02 * (1 + 1e-9)


@pytest.mark.parametrize(
    ("astray", "moves", "probes"),
    [
        (0.0, [0.0], 1),
        (0.03, [0.0, 0.0], 2),  # the first descent deviated: another one from there
        (0.0, [0.01, 0.01, 0.001], 3),  # until learning changes nothing
        (0.0, [0.01] * 9, CONFIG.max_probes),
    ],
)
def test_a_descent_is_repeated_until_it_teaches_nothing_new(astray, moves, probes):
    """The line of a turned tool leads elsewhere; only deviations from that line count."""
    wanted = about_vertical(1.2)

    # Leans by 45 degrees to the side on which the tool carries its marker.
    side = quaternion.to_matrix(wanted)[:, 1].numpy()
    visual = offset_along(wanted, side + np.array([0.0, 0.0, 1.0]))
    along = torch.from_numpy(visual.line(wanted) / visual.line(wanted)[2])

    def arrive(target, learned):
        """On the line above; below it astray, and moved by what has been learned so far."""
        if target.raised:
            return Pose(ABOVE.position + target.raised * along, wanted)
        moved = float(np.sum(moves[:learned]))
        low = torch.tensor([astray, moved, 0.0], dtype=torch.float64)
        return Pose(ABOVE.position + low, wanted)

    cell = Cell()
    turn = lambda target: replace(target, orientation=wanted)  # noqa: E731
    step = IdealStep(cell, arrive, turn)
    with shapes_unchecked():
        VisualServo(cell, step).servo_to(target_above(visual=visual))
    assert step.descents == probes
