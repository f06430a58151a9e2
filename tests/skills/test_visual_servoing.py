"""Steps of visual servoing that a whole grasp would hide."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from seen_cameras import camera_network, camera_vector
from unchecked import shapes_unchecked

from hrc_learn.controller import AdaptiveController, Goals
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import CameraEstimator, FixedEstimator, RBFImageJacobian, paper_grid
from hrc_learn.kinematics import panda
from hrc_learn.protocols import HumanInput
from hrc_learn.sim.scene import overhead_camera
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills import MissedGraspError
from hrc_learn.skills.marker_sensor import MarkerConsistency, MarkerObservation, SeenFeature
from hrc_learn.skills.visual_servoing import (
    ServoStep,
    ServoTarget,
    VisualServo,
    VisualServoConfig,
)
from hrc_learn.skills.visual_target import VisualTarget
from hrc_learn.skills.work_cell import CellReading
from hrc_learn.vision.camera_model import IMAGE_SIZE

CONFIG = VisualServoConfig()
ABOVE = Workplace().hover()
MARKER = 3
MIDDLE = np.array([700.0, 500.0])
NO_OFFSET = VisualTarget(offset=np.zeros(3), error=np.nan)


CAMERA = camera_vector(overhead_camera())


class Estimator(CameraEstimator):
    """Notes the poses at which the image Jacobian is evaluated."""

    def __init__(self):
        super().__init__(camera_network(CAMERA))
        self.poses = []

    def jacobian(self, state, r):
        self.poses.append(r)
        return super().jacobian(state, r).detach()


@pytest.fixture
def law():
    goals = Goals.at(ABOVE.position, ABOVE.orientation)
    return ServoStep(AdaptiveController(panda, Estimator(), goals), MARKER)


def reading(pixel=None, *, time=1.0, image_joints=None, push=0.0):
    seen = {} if pixel is None else {MARKER: SeenFeature(np.array(pixel), 0.0)}
    joints = panda.ready + 0.2
    effort = np.zeros(7)
    effort[1] = push
    return CellReading(
        time=time,
        dt=0.01,
        joints=joints,
        pose=panda.forward(joints),
        markers=MarkerObservation(time=time - 0.1, joints=image_joints, features=seen),
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
    # So does the excess over the tolerated angle.
    turn = torch.zeros(3, dtype=torch.float64)
    turn[axis] = side
    for excess in (-1e-3, 1e-3):
        tilted = quaternion.multiply(
            quaternion.exp((CONFIG.angle + excess) * turn), above.orientation
        )
        _, gradient = goals.orientation.feedback(tilted)
        expected = CONFIG.rate * max(excess, 0.0) * turn
        torch.testing.assert_close(gradient, expected, rtol=5e-3, atol=1e-9)


def test_lengths_of_a_hand_scale_with_it_but_no_heights_above_the_table():
    half = CONFIG.scaled(0.5)
    (a, b, c), (d, e, f) = CONFIG.half_size, CONFIG.acquisition_half_size
    assert half.half_size == pytest.approx((a / 2, b / 2, c))
    assert half.acquisition_half_size == pytest.approx((d / 2, e / 2, f))
    assert (half.height_tolerance, half.probe) == pytest.approx(
        (CONFIG.height_tolerance / 2, CONFIG.probe / 2)
    )
    assert CONFIG.scaled(1.0) == CONFIG


@pytest.mark.parametrize("known", [True, False])
def test_the_image_jacobian_is_estimated_once_an_image_at_the_pose_of_that_image(law, known):
    now = reading(image_joints=panda.ready if known else None)
    state = law.observed(law.initial_state(now.joints), now)
    law.observed(state, now)
    (pose,) = law.controller.estimator.poses
    there = panda.forward(panda.ready if known else now.joints)
    torch.testing.assert_close(pose.position, there.position)


class Rising(VisualTarget):
    """Target whose pixel comes down in the image by 200 px while the tool rises by `top`."""

    top: float

    def __call__(self, camera, pixel, above, height=None):
        raised = 0.0 if height is None else float(height - above.position[2])
        edge = IMAGE_SIZE[1] - 1 - CONFIG.border
        lower = 200.0 * (raised / self.top * (1 - 1e-9) - 1)
        return torch.tensor([700.0, edge + lower], dtype=torch.float64)


@pytest.mark.parametrize(
    ("top", "fraction"), [(1.0, 1.0), (0.75, 0.75), (0.5, 0.5), (0.3, 0.5)]
)
def test_a_probe_starts_no_higher_than_the_marker_stays_in_the_image(law, top, fraction):
    """The marker leaves the image of this camera at a fraction of the probe's height."""
    visual = Rising(offset=np.zeros(3), error=np.nan)
    object.__setattr__(visual, "top", top * CONFIG.probe)
    height = law.probe_height(law.initial_state(panda.ready), target_above(visual=visual))
    assert height == pytest.approx(fraction * CONFIG.probe)


@pytest.mark.parametrize(("detected", "raised"), [(True, 0.05), (False, 0.0)])
def test_the_end_effector_is_raised_only_after_its_marker_was_detected(detected, raised):
    """A camera that was moved is sure to see the box, not the space above it."""
    goals = target_above(raised=0.05).goals(CAMERA, ABOVE, detected=detected)
    expected = ABOVE.position + torch.tensor([0.0, 0.0, raised], dtype=torch.float64)
    torch.testing.assert_close(goals.position.centre, expected)


def test_a_target_that_is_kept_does_not_follow_the_estimate():
    elsewhere = CAMERA + 0.01
    kept, free = target_above(kept_camera=CAMERA), target_above()
    np.testing.assert_array_equal(kept.pixel(elsewhere, ABOVE), free.pixel(CAMERA, ABOVE))
    assert np.linalg.norm(free.pixel(elsewhere, ABOVE) - free.pixel(CAMERA, ABOVE)) > 5


def test_a_controller_that_estimates_no_camera_is_refused():
    network = RBFImageJacobian.from_jacobian(torch.zeros(2, 6).double(), paper_grid(), 0.1)
    goals = Goals.at(ABOVE.position, ABOVE.orientation)
    controller = AdaptiveController(panda, FixedEstimator(network), goals)
    with pytest.raises(ValueError, match="give the controller a CameraEstimator"):
        ServoStep(controller, MARKER)


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
        ((700.0, 1000.0), CONFIG.lost_after, False),
        ((700.0, 1000.0), CONFIG.lost_after + 1e-3, True),
        # Marker's distance from the border: at most twice the least of a target.
        ((2 * CONFIG.border, 500.0), 1.5, True),
        ((2 * CONFIG.border + 1, 500.0), 1.5, False),
        ((700.0, IMAGE_SIZE[1] - 2 * CONFIG.border), 1.5, True),
        ((700.0, IMAGE_SIZE[1] - 2 * CONFIG.border - 1), 1.5, False),
        ((np.nan, np.nan), 1.5, True),
    ],
)
def test_only_a_marker_last_seen_near_the_border_has_left_the_image(law, pixel, missing, out):
    """A marker that vanishes in the middle is occluded: the end effector waits for it."""
    state = law.initial_state(panda.ready)
    state = replace(state, last_pixel=np.array(pixel), last_detection=10.0 - missing)
    assert law.out_of_view(state, 10.0) == out


def test_a_hold_that_an_error_ended_does_not_reach_into_the_next_target(law):
    """Its test of the marker would compare the next target's pixels with those held."""
    state = law.initial_state(panda.ready)
    held = replace(state, held=MarkerConsistency(tolerance=CONFIG.marker_tolerance))
    assert law.restarted(held, 2.0, state.controller.safety).held is None


@pytest.mark.long
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


class Cell:
    """A work cell whose arm is at once where the step wants it."""

    joints, pose, loop_state = panda.ready, ABOVE, SimpleNamespace(safety=None)

    def __init__(self, waits=1):
        self.time, self.task_time, self.waits = 0.0, 0.0, waits

    @property
    def reading(self):
        return replace(reading(MIDDLE, time=self.time), pose=self.pose)

    def execute(self, *_args, **_columns):
        self.time += 0.02
        # Every other step the arm waits for a person, with waits=2.
        if round(self.time / 0.02) % self.waits == 0:
            self.task_time += 0.02


class IdealStep:
    """A step without errors whose predicted error falls with every probe."""

    marker, config = MARKER, CONFIG

    def __init__(self, cell, errors):
        self.cell, self.errors, self.heights = cell, list(errors), []
        goals = Goals.at(ABOVE.position, ABOVE.orientation)
        self.law = ServoStep(AdaptiveController(panda, Estimator(), goals), MARKER)
        first = self.initial_state(panda.ready)
        with torch.inference_mode():
            self.result, _ = self.law.step(first, reading(MIDDLE), target_above())

    def initial_state(self, joints):
        return self.law.initial_state(joints)

    restarted = observed = staticmethod(lambda state, *_: state)
    probe_height = staticmethod(lambda state, target: CONFIG.probe)
    pixel_error = turn_error = staticmethod(lambda state, now, target: 0.0)
    out_of_view = staticmethod(lambda state, time: False)

    @property
    def probes(self):
        """Times that the end effector has been higher up."""
        raised = np.array([0.0, *self.heights]) > 0
        return int((np.diff(raised.astype(int)) == 1).sum())

    def uncertainty(self, state, target):
        return self.errors[self.probes]

    def step(self, state, now, target):
        self.heights.append(target.raised)
        self.cell.pose = raised_by(target.raised)
        return self.result, state


def raised_by(height):
    up = torch.tensor([0.0, 0.0, height], dtype=torch.float64)
    return Pose(ABOVE.position + up, ABOVE.orientation)


@pytest.mark.parametrize("errors", [[0.001], [0.01, 0.002], [0.02, 0.004, 0.0024]])
def test_the_arm_probes_until_the_target_is_certain(errors):
    cell = Cell()
    step = IdealStep(cell, errors)
    with shapes_unchecked():
        duration = VisualServo(cell, step).servo_to(target_above())
    assert step.probes == len(errors) - 1
    assert step.heights[-1] == 0
    # It has rested at the target after each of them.
    assert duration + CONFIG.dwell >= max(step.probes, 1) * CONFIG.dwell


def test_probes_after_the_first_pass_beside_the_target_towards_the_middle():
    step, items = IdealStep(Cell(), [0.02, 0.02, 0.02, 0.001]), []
    step.config = replace(CONFIG, probe_aside=100.0)
    move = step.step

    def noting(state, now, target):
        if target.raised > 0:
            items.append(target.item)
        return move(state, now, target)

    step.step = noting
    item = np.array([300.0, 700.0])
    with shapes_unchecked():
        VisualServo(step.cell, step).servo_to(target_above(item=item))
    away = np.unique(np.stack(items), axis=0) - item
    assert sorted(np.linalg.norm(away, axis=1)) == pytest.approx([0, 100, 100])
    middle = np.array(IMAGE_SIZE) / 2 - item
    aside = away[np.linalg.norm(away, axis=1) > 1]
    assert (aside @ middle > 0.7 * 100 * np.linalg.norm(middle)).all()
    across = aside @ np.array([-middle[1], middle[0]])
    assert across.prod() < 0  # one on either side


def test_an_arm_whose_target_stays_uncertain_does_not_descend():
    cell = Cell()
    step = IdealStep(cell, [0.01] * (CONFIG.max_probes + 1))
    with (
        shapes_unchecked(),
        pytest.raises(MissedGraspError, match=r"may still be 10\.0 mm off"),
    ):
        VisualServo(cell, step).servo_to(target_above())


@pytest.mark.parametrize(
    ("limits", "waits", "away", "passed", "text"),
    [
        ((1.0, 9.0), 1, 0.0, 1.0, "after 1 s the marker is still 50.0 px from its target"),
        ((1.0, 9.0), 2, 0.0, 2.0, "after 1 s the marker is still"),
        ((1.0, 9.0), 1, 0.4, 1.4, "after 1 s the marker is still"),
        ((9.0, 0.5), 1, 0.0, 0.5, f"marker {MARKER} was not detected"),
        ((9.0, 0.5), 1, 0.4, 0.9, "was not detected"),
    ],
)
def test_it_gives_up_after_its_own_time_and_counts_no_time_of_people(
    limits, waits, away, passed, text
):
    """People make the arm wait, or lead it away by a drawing."""
    cell = Cell(waits)
    cell.time = cell.task_time = begun = 100.0  # of an earlier task
    step = IdealStep(cell, [0.001])
    timeout, occlusion_timeout = limits
    step.config = replace(CONFIG, timeout=timeout, occlusion_timeout=occlusion_timeout)
    step.pixel_error = lambda state, now, target: 50.0
    move = step.step

    def led(state, now, target):
        result, state = move(state, now, target)
        led_away = cell.time - begun < away
        return result, replace(state, drawn=replace(state.drawn, away=led_away))

    step.step = led
    with shapes_unchecked(), pytest.raises(MissedGraspError, match=text) as raised:
        VisualServo(cell, step).servo_to(target_above())
    hidden = "was not detected" in text
    assert raised.value.mishap == ("marker occluded" if hidden else "missed grasp")
    assert cell.time - begun == pytest.approx(passed, abs=0.05)


def test_a_hold_keeps_the_camera_estimate_and_the_orientation_for_its_duration():
    """New images improve the estimate, but do not move the target meanwhile."""
    cell = Cell()
    step, seen = IdealStep(cell, [0.001]), []
    move = step.step

    def noting(state, now, target):
        seen.append((target.kept_camera, state.held, state.wanted_orientation))
        return move(state, now, target)

    step.step = noting
    with shapes_unchecked():
        servo = VisualServo(cell, step)
        wanted = servo.state.goal_orientation
        servo.hold(target_above(), 0.1)
    assert cell.time == pytest.approx(0.1)
    assert len(seen) == 5
    for kept, held, orientation in seen:
        torch.testing.assert_close(kept, CAMERA)
        assert held.tolerance == CONFIG.marker_tolerance
        torch.testing.assert_close(orientation, wanted)
    assert servo.state.held is None


@pytest.mark.parametrize("aligned", [False, True])
def test_the_orientation_is_the_aligned_one_turned_by_the_person(aligned):
    cell = Cell()
    with shapes_unchecked():
        servo = VisualServo(cell, IdealStep(cell, [0.001]))
    half = torch.tensor([np.cos(0.15), 0, 0, np.sin(0.15)])  # 0.3 rad about the vertical
    drawn = replace(servo.state.drawn, turn=half)
    wanted = about_vertical(0.5) if aligned else None
    servo.state = replace(servo.state, drawn=drawn, wanted_orientation=wanted)
    found = servo.orientation(about_vertical(-0.2))
    expected = about_vertical((0.5 if aligned else -0.2) + 0.3)
    assert abs(float(found @ expected)) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("out", [False, True])
def test_a_marker_out_of_the_image_is_to_be_detected_again(out):
    """The next step then raises the end effector no more, as before its first image."""
    cell = Cell()
    step, detected = IdealStep(cell, [0.001]), []
    step.out_of_view = lambda state, time: out
    move = step.step

    def noting(state, now, target):
        detected.append(state.detected)
        return move(state, now, target)

    step.step = noting
    with shapes_unchecked():
        servo = VisualServo(cell, step)
        servo.state = replace(servo.state, detected=True, last_detection=0.0)
        servo._step_within(target_above(), 0.0)
    assert detected == [not out]


def wanting(law, monkeypatch, *, uncertainty=0.0, angle=0.1, detected=True, known=True):
    """State after an image in which the object has a direction, and the arguments used."""
    asked = []

    def turn(*given):
        asked.append(given)
        return 0.3

    monkeypatch.setattr(law, "_angle", SimpleNamespace(turn=turn) if known else None)
    monkeypatch.setattr(law, "uncertainty", lambda state, target: uncertainty)
    state = replace(law.initial_state(panda.ready), detected=detected)
    target = SimpleNamespace(
        angle=angle, above=ABOVE, turn_range=(-1.0, 1.0), heading=lambda camera: 0.7
    )
    now = replace(reading(MIDDLE), pose=Pose(ABOVE.position, about_vertical(0.2)))
    with shapes_unchecked():
        return law._with_wanted_orientation(state, now, target), asked


def test_the_end_effector_turns_as_demonstrated_towards_the_object(law, monkeypatch):
    state, (asked,) = wanting(law, monkeypatch)
    heading, reference, now, turns, _ = asked
    assert (heading, turns) == (0.7, (-1.0, 1.0))
    assert torch.equal(reference, ABOVE.orientation)
    assert float(now) == pytest.approx(0.2, abs=1e-9)
    assert state.chosen_turn == 0.3
    same = abs(float(state.wanted_orientation @ about_vertical(0.3)))
    assert same == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize(
    ("given", "turns"),
    [
        ({"uncertainty": 0.03}, True),  # within 3 cm the direction of the object is known
        ({"uncertainty": 0.0301}, False),
        ({"angle": None}, False),
        ({"detected": False}, False),
        ({"known": False}, False),
    ],
)
def test_it_turns_only_if_camera_marker_and_demonstrations_show_where(
    law, monkeypatch, given, turns
):
    state, asked = wanting(law, monkeypatch, **given)
    assert (state.wanted_orientation is not None) == turns
    assert len(asked) == turns


def test_the_heading_of_an_object_is_that_of_an_edge_of_its_marker():
    """Two points on the edge, projected by the simulator's own camera, give the direction."""
    tool_offset = np.array([0.0, 0.0, 0.08])
    visual = VisualTarget(offset=tool_offset, error=np.nan)
    down = quaternion.rotate(ABOVE.orientation, torch.from_numpy(tool_offset)).numpy()
    place = ABOVE.position.numpy() + down
    # A camera from the side, in whose image angles are not those on the table.
    eye, middle = np.array([0.6, 0.3, 0.5]), np.array([0.0, 0.1, 0.0])
    camera = overhead_camera().look_at(place + eye, place + middle)
    for heading in (-0.8, 0.3, 1.2):
        along = np.array([np.cos(heading), np.sin(heading), 0.0])
        first, second = (camera.project(place + s * 0.005 * along) for s in (-1, 1))
        edge = second - first
        target = target_above(
            visual=visual,
            item=(first + second) / 2,
            angle=float(np.arctan2(edge[1], edge[0])),
        )
        found = target.heading(camera_vector(camera))
        assert found == pytest.approx(heading, abs=1e-3)
    assert target_above().heading(camera_vector(camera)) is None
