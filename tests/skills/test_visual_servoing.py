"""Steps of visual servoing that a whole grasp would hide."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import Measurement
from hrc_learn.kinematics import panda
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills import MarkerObservation, ServoTarget, VisualServo, VisualServoConfig
from hrc_learn.skills.drawn_goals import DrawnGoals
from hrc_learn.vision.camera_model import IMAGE_SIZE

CONFIG = VisualServoConfig()


class StillCell:
    """A work cell at rest, whose newest image was taken elsewhere."""

    chain, config = panda, SimpleNamespace(dt=0.01, return_speed=0.4)
    joints, time = panda.ready + 0.2, 1.0

    def __init__(self, image_joints):
        self.task_time = 1.0
        self.observation = MarkerObservation(time=0.9, joints=image_joints)


class Estimator:
    """Notes at which poses it was asked for an image Jacobian."""

    def __init__(self):
        self.asked = []

    def jacobian(self, _state, pose):
        self.asked.append(pose)
        return torch.zeros(2, 6)


def servo_in(cell):
    servo, estimator = VisualServo.__new__(VisualServo), Estimator()
    servo._cell, servo._config = cell, CONFIG
    servo._controller = SimpleNamespace(estimator=estimator)
    servo._cached = (np.nan, np.zeros((2, 6)))
    servo._drawn, servo._led = DrawnGoals(CONFIG.drawn), 0.0
    servo.state = SimpleNamespace(estimator=None)
    return servo, estimator


@pytest.mark.parametrize("detected", [True, False])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_tool_that_has_left_its_box_returns_at_the_rate_to_any_side(detected, axis, side):
    above = panda.forward(panda.ready)
    goals = CONFIG.goals(above, np.array([700.0, 500.0]), detected=detected)
    beyond = torch.zeros(3, dtype=torch.float64)
    beyond[axis] = side * 1e-3 * float(goals.position.half_size[axis])
    wall = above.position + 1e3 * beyond
    _, gradient = goals.position.feedback(wall + beyond)
    torch.testing.assert_close(-gradient, -CONFIG.rate * beyond, rtol=5e-3, atol=1e-9)
    assert not goals.position.feedback(wall - beyond)[1].any()


@pytest.mark.parametrize("known", [True, False])
def test_the_image_jacobian_is_estimated_once_an_image_where_that_was_taken(known):
    cell = StillCell(panda.ready if known else None)
    servo, estimator = servo_in(cell)
    servo._image_jacobian()
    servo._image_jacobian()
    (pose,) = estimator.asked
    there = panda.forward(panda.ready if known else cell.joints)
    torch.testing.assert_close(pose.position, there.position)


@pytest.mark.parametrize(("top", "share"), [(1.0, 1.0), (0.75, 0.75), (0.5, 0.5), (0.3, 0.5)])
def test_a_probe_begins_no_higher_than_where_the_marker_stays_in_the_image(top, share):
    """A camera above whose image the marker leaves at a part of the probe's height."""
    servo, _ = servo_in(StillCell(None))
    servo._turned = None
    edge = IMAGE_SIZE[1] - 1 - CONFIG.border
    rise = 200.0 / (top * CONFIG.probe)  # pixels a metre
    target = replace(
        unturned_target(),
        target=lambda J, orientation, further: np.array(
            [700.0, edge - 200.0 + rise * further[2] * (1 - 1e-9)]
        ),
    )
    assert servo._probe_height(target) == pytest.approx(share * CONFIG.probe)


def test_the_hand_is_raised_only_once_its_marker_was_seen():
    """Where a moved camera sees it for sure is in the box, not above."""
    target, jacobian = replace(unturned_target(), raised=0.05), np.zeros((2, 6))
    pose = target.above
    for detected, raised in ((True, 0.05), (False, 0.0)):
        position = target.goals(jacobian, pose, detected=detected).position.centre
        expected = pose.position + torch.tensor([0.0, 0.0, raised], dtype=torch.float64)
        torch.testing.assert_close(position, expected)


@dataclass(frozen=True)
class Estimated:
    estimator: object


def pinhole(height):
    """Image Jacobian and pixel of a point so far under a camera of 1000 px that looks down."""
    xi = np.array([0.2, -0.1]) / height
    jacobian = np.zeros((2, 6))
    jacobian[:, :3] = 1000 / height * np.column_stack([np.eye(2), xi])
    return jacobian, 1000 * xi


def test_what_is_learned_from_a_descent_holds_at_its_lower_end():
    """Both ends seen by a camera straight above, whose depth changes by 1 / z a metre."""
    servo, learned = servo_in(StillCell(None))[0], []
    servo._controller.estimator.compared = lambda state, *pair: learned.append(pair)
    low, high = 1.2, 1.12
    jacobian, pixel = pinhole(low)
    servo._cached = (0.9, jacobian)
    servo._cell.observation = MarkerObservation(time=0.9, joints=panda.ready)
    servo.state = Estimated(estimator=None)

    def at(depth):
        upright = panda.forward(panda.ready).orientation
        none = torch.zeros(6, dtype=torch.float64)
        return Measurement(
            pose=Pose(torch.tensor([0.2, -0.1, -depth]).double(), upright),
            feature=torch.from_numpy(pinhole(depth)[1]),
            valid=torch.tensor(True),
            dt=0.0,
            xi_x=none[:2],
            xi_r=none,
        )

    target = replace(
        unturned_target(), depth_gradient=lambda J, x: np.array([0.0, 0.0, -1 / low])
    )
    servo._learn(target, at(high), at(low))
    ((above, below),) = learned
    way = above.pose.position - below.pose.position
    expected = torch.from_numpy(jacobian[:, :3]) @ way
    torch.testing.assert_close(above.feature - below.feature, expected, rtol=1e-5, atol=0)
    torch.testing.assert_close(below.feature, torch.from_numpy(pixel))


def test_a_probe_comes_down_at_its_speed_from_where_it_begins():
    servo, _ = servo_in(StillCell(None))
    heights = []

    def step(target):
        heights.append(target.raised)
        # Every other step the arm waits for somebody.
        servo._cell.task_time += 0.01 * (len(heights) % 2)

    servo.step = step
    above = Workplace().hover()
    up = np.array([0.0, 0.0, 1.0])
    servo._descend(
        ServoTarget(
            config=CONFIG,
            above=above,
            posture=None,
            target=lambda J, orientation, further: J,
            lines=lambda orientation: up,
            raised=0.045,
        )
    )
    assert heights[0] == 0.045
    lowered = np.diff(heights)
    np.testing.assert_allclose(lowered[::2], -CONFIG.probe_speed * 0.01)
    np.testing.assert_allclose(lowered[1::2], 0.0)
    assert 0 < heights[-1] <= CONFIG.probe_speed * 0.01 * (1 + 1e-9)


@pytest.mark.parametrize("height", [-0.004, 0.0, 0.002, 0.013])
def test_within_the_box_the_gripper_is_led_straight_down(height):
    """Above it along the line, which leans."""
    above, line = Workplace().hover(), np.array([0.6, 0.0, 0.8])
    target = ServoTarget(
        config=CONFIG,
        above=above,
        posture=None,
        target=lambda J, orientation, further: J[:, :3] @ further,
        lines=lambda orientation: line,
    )
    jacobian = np.zeros((2, 6))
    jacobian[:, :2] = 1000.0 * np.eye(2)
    up = torch.tensor([0.0, 0.0, height], dtype=torch.float64)
    pixel = target.pixel(jacobian, Pose(above.position + up, above.orientation))
    aside = 0.75 * max(height - CONFIG.half_size[2], 0.0)
    np.testing.assert_allclose(pixel, [1000.0 * aside, 0.0], atol=1e-9)


@pytest.mark.parametrize(
    ("astray", "moves", "probes"),
    [
        (0.0, [0.0], 1),
        (0.03, [0.0, 0.0], 2),  # the first descent led aside: once more, from there
        (0.0, [0.01, 0.01, 0.001], 3),  # until what is learned changes nothing
        (0.0, [0.01] * 9, CONFIG.max_probes),
    ],
)
def test_a_descent_is_repeated_until_it_teaches_nothing_new(astray, moves, probes):
    """The line leads elsewhere for a turned tool; only what leaves that one counts."""
    above = Workplace().hover()
    about = quaternion.exp(torch.tensor([0.0, 0.0, 1.2], dtype=torch.float64))
    turned = quaternion.multiply(about, above.orientation)

    def line(orientation):
        """Leans by 45 degrees to the side on which the tool carries its marker."""
        side = quaternion.to_matrix(orientation)[:, 1].numpy()
        return np.add(side, [0.0, 0.0, 1.0]) / np.sqrt(2)

    cell = SimpleNamespace(time=0.0, task_time=0.0, pose=above)
    servo, descents = servo_in(cell)[0], []
    along = torch.from_numpy(line(turned) / line(turned)[2])
    start = Pose(above.position + CONFIG.probe * along, turned)
    low = []

    def descend(_target):
        descents.append(cell.pose)
        low[:] = [torch.tensor([astray, 0.0, 0.0], dtype=torch.float64)]

    def converge(target, *_):
        if target.raised:
            cell.pose = start
        else:
            cell.pose = Pose(above.position + low[0], turned)
            low[:] = [low[0] + torch.tensor([0.0, moves[len(descents) - 1], 0.0]).double()]
        return 0.0

    vars(servo).update(_config=CONFIG, _turned=turned, _cell=cell, _resume=lambda: None)
    vars(servo).update(_descend=descend, _converge=converge, _at_rest=None)
    servo._probe_height = lambda target: CONFIG.probe
    servo.servo_to(
        ServoTarget(
            config=CONFIG,
            above=above,
            posture=None,
            target=lambda J, orientation, further: J,
            lines=line,
        )
    )
    assert len(descents) == probes


def unturned_target():
    return ServoTarget(
        config=CONFIG,
        above=Workplace().hover(),
        posture=None,
        target=lambda J, orientation, further: np.zeros(2),
        lines=lambda orientation: np.array([0.0, 0.0, 1.0]),
    )


def turning_servo(wanted, now=None):
    servo, _ = servo_in(StillCell(None))
    vars(servo).update(_turned=wanted, _turning=now)
    return servo


def about_vertical(angle):
    turn = quaternion.exp(torch.tensor([0.0, 0.0, angle], dtype=torch.float64))
    return quaternion.multiply(turn, Workplace().hover().orientation)


def test_the_goal_turns_no_faster_than_the_camera_can_lead_the_marker():
    servo, middle = turning_servo(about_vertical(0.5)), np.array([700.0, 500.0])
    goals = [Workplace().hover().orientation]
    taken = int(np.ceil(0.5 / CONFIG.turn_rate / 0.01))
    for _ in range(taken + 10):
        servo._turn_on(unturned_target(), middle)
        goals.append(servo._turning)
    goals = torch.stack(goals)
    steps = quaternion.angle(goals[1:], goals[:-1])
    assert steps.max() <= CONFIG.turn_rate * 0.01 + 1e-12
    assert quaternion.angle(goals[taken], about_vertical(0.5)) < 1e-7
    assert quaternion.angle(goals[taken - 2], about_vertical(0.5)) > 1e-3


@pytest.mark.parametrize(
    ("pixel", "waits"),
    [
        ((np.nan, np.nan), True),
        ((30.0, 500.0), False),
        ((1400.0, 500.0), True),
        ((700.0, 1060.0), False),
        ((700.0, 20.0), True),
        ((700.0, 500.0), False),
    ],
)
def test_a_turn_waits_where_it_would_take_the_marker_out_of_the_image(pixel, waits):
    """It swings the marker to the right and up here."""
    servo = turning_servo(about_vertical(0.5), about_vertical(0.1))
    jacobian = np.zeros((2, 6))
    jacobian[:, 5] = 200.0, -100.0
    servo._image_jacobian = lambda: jacobian
    servo._turn_on(unturned_target(), np.array(pixel))
    turned = float(quaternion.angle(servo._turning, about_vertical(0.1)))
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
def test_only_a_marker_last_seen_near_the_edge_has_left_the_image(pixel, missing, out):
    """What vanishes in the middle is occluded: the end effector waits for it where it is."""
    servo, _ = servo_in(StillCell(None))
    vars(servo).update(_last_pixel=np.array(pixel), _last_detection=servo._cell.time - missing)
    assert servo._out_of_view() == out


def test_the_null_space_goes_back_but_while_a_person_pushes_it():
    servo, _ = servo_in(StillCell(None))
    servo._rests, rest = 1.0, panda.ready
    planned = CONFIG.goals(panda.forward(panda.ready), np.array([700.0, 500.0]))
    speeds = []
    for push in [0.0] * 5 + [2.0] * 60 + [0.0] * 60:
        servo._cell.human_input = SimpleNamespace(effort=lambda joints: np.array([0.0, push]))
        goals = servo._resting(planned, rest)
        far = torch.full((7,), 10.0, dtype=torch.float64)
        back = (
            0.0 if goals.rest is None else float(goals.rest.gradient(panda.ready + far).norm())
        )
        speeds.append(back)
    speeds = np.array(speeds)
    np.testing.assert_allclose(speeds[[0, 4, -1]], 0.4, rtol=1e-3)
    assert not speeds[40:65].any()  # pushed for half a second and more
    # Gone and back without jumps.
    assert np.abs(np.diff(speeds)).max() < 0.1 * 0.4
    assert servo._resting(planned, None).rest is None
