"""What a person draws as goals of the controller, on an arm that does as it is told."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from sampling import generator
from servoing import CENTRE, DOUBLE, DOWN, LIMITS, POSTURE, grasping, observe, overhead_camera
from unchecked import shapes_unchecked

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import panda
from hrc_learn.protocols import DrawnRegion, HumanInput
from hrc_learn.regions import PositionRegion
from hrc_learn.skills.drawn_goals import (
    Drawing,
    DrawnGoals,
    DrawnGoalsConfig,
    drawn_position,
    vision_scale,
)
from hrc_learn.skills.visual_servoing import VisualServoConfig

pytestmark = pytest.mark.simulation

CONFIG = DrawnGoalsConfig()
DT = 0.02
ELSEWHERE = DrawnRegion(centre=(0.40, 0.20, 0.40), half_size=(0.06, 0.08, 0.05))
TARGET = (0.42, 0.16, 0.42)
PLANNED = PositionRegion(
    centre=CENTRE, half_size=torch.tensor([0.12, 0.12, 0.003], dtype=DOUBLE)
)


def test_the_box_drawn_is_the_region_but_for_a_margin_and_its_flatness():
    box = DrawnRegion(centre=(0.3, 0.5, 0.2), half_size=(0.10, 0.03, 0.15))
    region = drawn_position(Drawing(box, None), PLANNED, CONFIG)
    np.testing.assert_allclose(region.centre, [0.3, 0.5, 0.3])
    np.testing.assert_allclose(region.half_size, [0.08, 0.015, 0.003])
    # Half a narrow box is left; the planned height is taken where the box reaches it.
    low = replace(PLANNED, centre=CENTRE - torch.tensor([0.0, 0.0, 0.5], dtype=DOUBLE))
    assert float(drawn_position(Drawing(box, None), low, CONFIG).centre[2]) == pytest.approx(
        0.2 - 0.15 + 0.003
    )


@pytest.mark.parametrize("beyond", [-1.0, 0.0, 0.5])
def test_the_camera_has_no_share_from_the_walls_on_outwards(beyond):
    box = ELSEWHERE
    at = torch.tensor(box.centre, dtype=DOUBLE)
    at[0] += box.half_size[0] + beyond * CONFIG.wall
    assert vision_scale(box, at, CONFIG) == pytest.approx(min(max(-beyond, 0.0), 1.0))


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_near_a_wall_the_end_effector_returns_at_the_rate_asked_for(sign):
    region = drawn_position(Drawing(ELSEWHERE, None), PLANNED, CONFIG)
    for axis in range(3):
        outside = region.centre.clone()
        outside[axis] += sign * (region.half_size[axis] + 1e-6)
        speed = -region.gradient(outside)[axis]
        torch.testing.assert_close(
            speed, torch.tensor(-sign * CONFIG.rate * 1e-6, dtype=DOUBLE), rtol=1e-2, atol=0
        )


def test_a_target_is_kept_within_the_region():
    outside = (0.9, 0.2, 0.4)
    region = drawn_position(Drawing(ELSEWHERE, outside), PLANNED, CONFIG)
    far = region.centre + region.half_size
    np.testing.assert_allclose(far[0], 0.46)
    np.testing.assert_allclose(region.centre[1:], [0.2, 0.4])


class Loop:
    """An ideal arm that servoes to a planned region while a person draws."""

    def __init__(self, camera=None, config=CONFIG, refusal=lambda pose: ""):
        controller, self.camera = grasping(rng=generator())
        self.controller, self.q, self.time = controller, POSTURE.clone(), 0.0
        self.state, self.said = controller.initial_state(self.q), []
        self.law = DrawnGoals(config, refusal)
        self.drawn = self.law.initial_state()
        self.velocity, self.potential = [torch.zeros(7, dtype=DOUBLE)], []
        self.visible = camera is not None
        target = controller.goals.vision.target
        planned = VisualServoConfig().goals(Pose(CENTRE, DOWN), target.numpy())
        self.planned = planned.with_vision(self.visible)
        self.orientation = []

    @torch.inference_mode()
    @shapes_unchecked()
    def run(self, seconds, **asked):
        wish = HumanInput(**asked)
        for _ in range(round(seconds / DT)):
            self.drawn = self.law.turned(self.drawn, wish.turn, 0.8 * DT)
            turned = quaternion.multiply(self.drawn.turn, DOWN)
            region = replace(self.planned.orientation, goal=turned)
            planned = replace(self.planned, orientation=region)
            self.drawn, remark = self.law.read(self.drawn, wish, planned, self.time)
            self.said += [remark] if remark else []
            goals, self.drawn = self.law.applied(self.drawn, planned, self.pose.position)
            feature, _ = self.camera.project(self.pose)
            observation = observe(
                self.q,
                feature=feature,
                feature_visible=torch.tensor(self.visible),
                dt=DT,
                goals=goals,
            )
            command, self.state = self.controller.step(self.state, observation)
            self.velocity.append(command.joint_velocity)
            self.potential.append(float(command.potential))
            self.q, self.time = self.q + DT * command.joint_velocity, self.time + DT
        return self.pose.position.numpy()

    @property
    def pose(self) -> Pose:
        return panda.forward(self.q)


def inside(position, region, tolerance=1e-3):
    return (np.abs(position - region.centre) <= np.array(region.half_size) + tolerance).all()


@pytest.mark.long
def test_a_drawing_leads_the_end_effector_and_what_was_planned_does_so_again_afterwards():
    loop = Loop()
    at_plan = loop.run(1.5)
    assert np.abs(at_plan - CENTRE.numpy())[2] < 5e-3
    assert not inside(at_plan, ELSEWHERE)
    led = loop.run(3.0, region=ELSEWHERE, target=TARGET)
    assert inside(led, ELSEWHERE)
    # The box of a target is approached from outside: within its walls, and a little beyond.
    np.testing.assert_allclose(led, TARGET, atol=CONFIG.target_half_size + 5e-4)
    assert loop.drawn.away
    back = loop.run(3.0)
    assert np.abs(back - CENTRE.numpy())[2] < 5e-3
    # Without the camera the last centimetres to the wide planned box take long.
    assert (np.abs(back - CENTRE.numpy())[:2] < 0.16).all()
    assert np.abs(led - CENTRE.numpy()).max() > 0.2
    assert loop.said == [
        "The target in the drawn region guides the end effector; the task waits.",
        "The plan guides the end effector again.",
    ]
    assert not loop.drawn.away


def test_between_changes_the_potential_only_falls():
    loop = Loop()
    for asked in ({}, {"region": ELSEWHERE, "target": TARGET}, {"region": ELSEWHERE}, {}):
        loop.potential.clear()
        loop.run(1.4, **asked)
        # An arm that changes its direction first has to brake, by 7.5 rad/s^2 at least.
        braked = loop.potential[12:]
        assert np.diff(braked).max() <= 1e-9 + 1e-6 * braked[0]
        assert loop.potential[-1] < 0.05 * max(loop.potential) + 1e-6


def test_no_drawing_makes_the_command_jump():
    loop = Loop()
    for k in range(6):
        loop.run(0.4, region=ELSEWHERE if k % 2 else None, target=TARGET if k == 3 else None)
    change = torch.stack(loop.velocity).diff(dim=0).abs().amax(dim=0) / DT
    assert (change <= LIMITS.acceleration * (1 + 1e-9)).all()
    assert float(torch.stack(loop.velocity).abs().max()) > 0.1  # it has moved


@pytest.mark.long
def test_what_the_camera_sees_beyond_the_walls_does_not_draw_it_out():
    """The planned target is at the middle of the planned box; the box drawn is beside it."""
    x, y, z = CENTRE.tolist()
    box = DrawnRegion(centre=(x + 0.16, y, z), half_size=(0.08, 0.08, 0.06))
    loop = Loop(camera=overhead_camera())
    assert not inside(loop.run(1.5), box)
    assert inside(loop.run(3.5, region=box), box)
    # The camera leads up to where its share ends: beyond the middle, towards its target.
    beside = (loop.pose.position.numpy() - box.centre)[0]
    assert beside < -0.5 * box.half_size[0]
    loop.run(3.0)
    pixel, _ = loop.camera.project(loop.pose)
    assert float((pixel - loop.planned.vision.target).norm()) < 2


def test_in_a_region_over_the_planned_place_the_task_goes_on():
    x, y, z = CENTRE.tolist()
    box = DrawnRegion(centre=(x + 0.02, y, z), half_size=(0.14, 0.14, 0.1))
    loop = Loop(camera=overhead_camera())
    loop.run(3.5, region=box)
    pixel, _ = loop.camera.project(loop.pose)
    assert float((pixel - loop.planned.vision.target).norm()) < 2
    assert inside(loop.pose.position.numpy(), box)
    assert not loop.drawn.away
    assert loop.said == ["The drawn region guides the end effector."]


@pytest.mark.long
@pytest.mark.parametrize("turn", [(0.0, -0.2, 0.2), (0.0, 1.5, 0.0)])
def test_the_turn_comes_on_top_of_the_planned_orientation(turn):
    loop = Loop()
    loop.run(2.2, turn=turn)
    angle = min(np.linalg.norm(turn), CONFIG.largest_turn)
    # By Rodrigues' formula, not by quaternions.
    n = np.array(turn) / np.linalg.norm(turn)
    cross = np.array([[0, -n[2], n[1]], [n[2], 0, -n[0]], [-n[1], n[0], 0]])
    R = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    wanted = R @ quaternion.to_matrix(DOWN).numpy()
    now = quaternion.to_matrix(loop.pose.orientation).numpy()
    missing = np.arccos(np.clip((np.trace(wanted.T @ now) - 1) / 2, -1, 1))
    tolerance = loop.planned.orientation.tolerance
    assert missing < tolerance + 0.01
    loop.run(2.2)
    assert float(quaternion.angle(loop.pose.orientation, DOWN)) < tolerance + 0.01


def test_the_turn_goes_no_faster_than_told():
    law = DrawnGoals(CONFIG)
    drawn = law.initial_state()
    turns = [drawn.turn]
    for _ in range(60):
        drawn = law.turned(drawn, (0.0, 0.0, 0.3), 0.008)
        turns.append(drawn.turn)
    steps = quaternion.angle(torch.stack(turns[1:]), torch.stack(turns[:-1]))
    assert float(steps.max()) <= 0.008 + 1e-12
    np.testing.assert_allclose(quaternion.log(drawn.turn), [0, 0, 0.3], atol=1e-12)


def test_a_drawing_that_is_refused_leaves_the_plan_in_the_lead():
    asked = []

    def refusal(pose):
        asked.append(pose)
        return "a wall" if pose.position[1] < 0.3 else ""

    loop = Loop(refusal=refusal)
    alone = Loop()
    np.testing.assert_allclose(loop.run(0.8, target=TARGET), alone.run(0.8), atol=1e-12)
    assert loop.said == ["Refused the target: a wall."]
    (pose,) = asked  # once a change
    np.testing.assert_allclose(pose.position, TARGET)
    loop.run(0.4, target=(0.3, 0.4, 0.4))
    assert loop.said[-1] == "The target guides the end effector; the task waits."


def test_what_is_dragged_leads_at_once_and_again_when_it_is_still():
    """A pointer brings another target with each step: not each of them is looked into."""
    asked = []
    loop = Loop(refusal=lambda pose: asked.append(pose.position[0].item()) or "")
    for k in range(50):
        loop.run(DT, target=(0.3 + 0.002 * k, 0.3, 0.4))
    assert asked == [0.3]
    loop.run(CONFIG.settling + DT, target=(0.398, 0.3, 0.4))
    assert asked == [0.3, 0.398]


@pytest.mark.parametrize("name", ["rate", "target_half_size", "wall", "settling"])
def test_settings_that_make_no_sense_are_refused(name):
    with pytest.raises(ValueError, match=f"{name} must be positive"):
        DrawnGoalsConfig(**{name: 0.0})
