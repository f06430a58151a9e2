"""Steps of visual servoing that a whole grasp would hide."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import panda
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills import MarkerObservation, ServoTarget, VisualServo, VisualServoConfig

CONFIG = VisualServoConfig()


class StillCell:
    """A work cell at rest, whose newest image was taken elsewhere."""

    chain, config = panda, SimpleNamespace(dt=0.01)
    joints, time = panda.ready + 0.2, 1.0

    def __init__(self, image_joints):
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
    servo.state = SimpleNamespace(estimator=None)
    return servo, estimator


@pytest.mark.parametrize("known", [True, False])
def test_the_image_jacobian_is_estimated_once_an_image_where_that_was_taken(known):
    cell = StillCell(panda.ready if known else None)
    servo, estimator = servo_in(cell)
    servo._image_jacobian()
    servo._image_jacobian()
    (pose,) = estimator.asked
    there = panda.forward(panda.ready if known else cell.joints)
    torch.testing.assert_close(pose.position, there.position)


def test_a_probe_comes_down_at_its_speed_from_where_it_begins():
    servo, _ = servo_in(StillCell(None))
    heights = []
    servo.step = lambda target: heights.append(target.raised)
    above = Workplace().hover()
    up = np.array([0.0, 0.0, 1.0])
    servo._descend(
        ServoTarget(
            config=CONFIG,
            above=above,
            posture=None,
            target=lambda J, orientation: J,
            lines=lambda orientation: up,
        )
    )
    assert heights[0] == CONFIG.probe
    np.testing.assert_allclose(np.diff(heights), -CONFIG.probe_speed * 0.01)
    assert 0 < heights[-1] <= CONFIG.probe_speed * 0.01 * (1 + 1e-9)


@pytest.mark.parametrize("height", [-0.004, 0.0, 0.002, 0.013])
def test_within_the_box_the_gripper_is_led_straight_down(height):
    """Above it along the line, which leans."""
    above, line = Workplace().hover(), np.array([0.6, 0.0, 0.8])
    target = ServoTarget(
        config=CONFIG,
        above=above,
        posture=None,
        target=lambda J, orientation: np.zeros(2),
        lines=lambda orientation: line,
    )
    jacobian = np.zeros((2, 6))
    jacobian[:, :2] = 1000.0 * np.eye(2)
    up = torch.tensor([0.0, 0.0, height], dtype=torch.float64)
    pixel = target.pixel(jacobian, Pose(above.position + up, above.orientation))
    aside = 0.75 * max(height - CONFIG.half_size[2], 0.0)
    np.testing.assert_allclose(pixel, [1000.0 * aside, 0.0], atol=1e-9)


@pytest.mark.parametrize(("astray", "probes"), [(0.0, 1), (0.03, CONFIG.max_probes)])
def test_a_turned_tool_that_stays_on_its_own_line_is_not_probed_again(astray, probes):
    """The line leads elsewhere for a turned tool; only what leaves that one counts."""
    above = Workplace().hover()
    about = quaternion.exp(torch.tensor([0.0, 0.0, 1.2], dtype=torch.float64))
    turned = quaternion.multiply(about, above.orientation)

    def line(orientation):
        """Leans by 45 degrees to the side on which the tool carries its marker."""
        side = quaternion.to_matrix(orientation)[:, 1].numpy()
        return np.add(side, [0.0, 0.0, 1.0]) / np.sqrt(2)

    servo, descents = VisualServo.__new__(VisualServo), []
    cell = SimpleNamespace(time=0.0, pose=above)
    along = torch.from_numpy(line(turned) / line(turned)[2])
    start = Pose(above.position + CONFIG.probe * along, turned)
    aside = torch.tensor([astray, 0.0, 0.0], dtype=torch.float64)

    def descend(_target):
        descents.append(cell.pose)
        cell.pose = Pose(above.position + aside, turned)

    def converge(target, *_):
        if target.raised:
            cell.pose = start
        return 0.0

    vars(servo).update(_config=CONFIG, _turned=turned, _cell=cell, _resume=lambda: None)
    vars(servo).update(_descend=descend, _converge=converge, _at_rest=None)
    servo.servo_to(
        ServoTarget(
            config=CONFIG,
            above=above,
            posture=None,
            target=lambda J, orientation: J,
            lines=line,
        )
    )
    assert len(descents) == probes


def unturned_target():
    return ServoTarget(
        config=CONFIG,
        above=Workplace().hover(),
        posture=None,
        target=lambda J, orientation: np.zeros(2),
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
    for _ in range(100):
        servo._turn_on(unturned_target(), middle)
        goals.append(servo._turning)
    goals = torch.stack(goals)
    steps = quaternion.angle(goals[1:], goals[:-1])
    assert steps.max() <= CONFIG.turn_rate * 0.01 + 1e-12
    taken = int(np.ceil(0.5 / CONFIG.turn_rate / 0.01))
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
