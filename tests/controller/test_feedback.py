import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from hrc_learn.controller import BlendingConfig, Goals
from hrc_learn.controller.resolved_rate import (
    BlendingState,
    VisionBlending,
    approach_velocity,
    fade,
    next_task_level,
    regional_feedback,
)
from hrc_learn.kinematics import panda
from hrc_learn.regions import PostureRegion

CENTRE = (719.5, 539.5)


def pixel(u: float, v: float) -> Tensor:
    return torch.tensor([u, v], dtype=torch.float64)


def follow(blending: VisionBlending, features, *, dt=0.01, state=None, age=None, visible=True):
    """State after each of some measurements."""
    state = state or blending.initial_state(torch.zeros(7, dtype=torch.float64))
    states = []
    for feature in features:
        usable = torch.tensor(visible)
        state, _, _ = blending.step(state, pixel(*feature), usable, dt, age=age)
        states.append(state)
    return states


def test_a_feature_must_come_well_inside_to_be_used_and_may_go_to_the_edge():
    states = follow(
        VisionBlending(), [(30, 500), (41, 500), (30, 500), (1, 500), (-1, 500), (30, 500)]
    )
    assert [s.active.item() for s in states] == [False, True, True, True, False, False]


def test_vision_fades_in_and_out_over_the_blend_time():
    states = follow(VisionBlending(), [CENTRE] * 40, dt=0.01)
    levels = torch.stack([s.level for s in states])
    torch.testing.assert_close(levels[:30], torch.linspace(1, 30, 30, dtype=torch.float64) / 30)
    assert (levels[30:] == 1).all()
    gone = follow(VisionBlending(), [CENTRE] * 15, state=states[-1], visible=False)
    assert gone[-1].level.item() == pytest.approx(0.5)


def test_without_blend_time_it_switches():
    blending = VisionBlending(BlendingConfig(blend_time=0.0))
    assert follow(blending, [CENTRE])[0].level == 1


@pytest.mark.parametrize("name", ["hysteresis", "blend_time", "max_feature_age"])
def test_settings_of_the_blending_are_not_negative(name):
    for wrong in (-0.1, math.nan):
        with pytest.raises(ValueError, match=f"{name} must not be negative"):
            BlendingConfig(**{name: wrong})


@pytest.mark.parametrize("lost", [(math.nan, 5.0), (2000.0, 500.0), (math.inf, 500.0)])
def test_what_cannot_be_used_leaves_the_last_good_feature(lost):
    *_, last = follow(VisionBlending(), [(600, 500)] * 40 + [lost] * 3)
    assert last.feature.tolist() == [600, 500]
    assert not last.active
    assert last.level.item() == pytest.approx(0.9)


def test_a_silent_camera_stops_the_arm_that_follows_it_and_no_other():
    blending = VisionBlending()
    old = torch.tensor(0.3, dtype=torch.float64)
    approaching = blending.initial_state(torch.zeros(7, dtype=torch.float64))
    following = follow(blending, [CENTRE] * 40)[-1]
    for state, stops in ((approaching, False), (following, True)):
        after, seen, stop = blending.step(
            state, pixel(*CENTRE), torch.tensor(True), 0.01, age=old
        )
        assert not seen
        assert stop.item() is stops
        assert after.level == state.level
    # It carries on where it was when the camera comes back.
    after, seen, stop = blending.step(
        after, pixel(*CENTRE), torch.tensor(True), 0.01, age=torch.zeros_like(old)
    )
    assert seen
    assert not stop
    assert after.level == 1


def test_the_members_of_a_batch_are_handled_apart():
    blending = VisionBlending()
    state = blending.initial_state(torch.zeros(3, 7, dtype=torch.float64))
    feature = torch.tensor([[700.0, 500], [10, 500], [math.nan, 0]], dtype=torch.float64)
    state, seen, _ = blending.step(state, feature, torch.tensor([True, True, True]), 0.03)
    assert seen.tolist() == [True, True, False]
    assert state.active.tolist() == [True, False, False]
    assert state.level.tolist() == pytest.approx([0.1, 0, 0])
    assert isinstance(state, BlendingState)


GOAL = torch.zeros(7, dtype=torch.float64)
POSTURE = PostureRegion(goal=GOAL, tolerance=0.5)


def away(distance: float) -> Tensor:
    """A joint position so far from the posture [rad]."""
    return GOAL + distance * torch.nn.functional.normalize(torch.ones_like(GOAL), dim=0)


def level_after(
    before: float, distance: float, *, vision_active: bool = False, dt: float = 0.03
) -> float:
    level = next_task_level(
        torch.tensor(before, dtype=torch.float64),
        POSTURE,
        away(distance),
        torch.tensor(vision_active),
        dt,
        0.3,
    )
    return level.item()


@pytest.mark.parametrize(
    ("before", "distance", "vision_active", "after"),
    [
        (0.0, 0.51, False, 0.0),  # still on its way
        (0.0, 0.49, False, 0.1),  # inside the region: task-space feedback takes over
        (0.0, 1.0, True, 0.0),  # the camera alone takes nothing over
        (0.5, 1.49, False, 0.6),  # and keeps the lead outside the region,
        (0.5, 1.51, False, 0.4),  # unless the posture lies far away,
        (0.5, 1.51, True, 0.6),  # but never while the camera leads
    ],
)
def test_task_space_feedback_takes_over_inside_the_posture_region(
    before, distance, vision_active, after
):
    assert level_after(before, distance, vision_active=vision_active) == pytest.approx(after)


def test_without_a_posture_there_is_no_approach_to_take_over_from():
    before = torch.ones(3, dtype=torch.float64)
    after = next_task_level(
        before, None, away(0.0).expand(3, 7), torch.ones(3, dtype=torch.bool), 0.1, 0.3
    )
    assert after.tolist() == [0, 0, 0]


def test_a_level_stays_between_zero_and_one():
    level, rising = torch.tensor([0.95, 0.05, 0.5]), torch.tensor([True, False, True])
    torch.testing.assert_close(fade(level, rising, 0.1, 1.0), torch.tensor([1.0, 0.0, 0.6]))


def test_an_approach_is_as_slow_as_the_caps_of_the_tool_ask():
    q = panda.ready
    posture = PostureRegion(goal=q + 0.5)
    J = panda.jacobian(q)
    for caps in ([0.05, 10.0], [10.0, 0.1], [0.05, 0.1]):
        v = approach_velocity(posture, q, J, torch.tensor(caps, dtype=torch.float64))
        twist = J @ v
        used = torch.stack([twist[:3].norm() / caps[0], twist[3:].norm() / caps[1]])
        assert used.max().item() == pytest.approx(1.0)
        # Straight towards the posture.
        assert torch.nn.functional.cosine_similarity(v, posture.goal - q, dim=0) > 1 - 1e-12
    free = approach_velocity(posture, q, J, torch.full((2,), 100.0, dtype=torch.float64))
    torch.testing.assert_close(free, -posture.gradient(q))


def test_the_requested_decay_of_the_pixel_error_is_capped_and_otherwise_unchanged():
    pose, blending = panda.forward(panda.ready), VisionBlending()
    goals = Goals.at(pose.position, pose.orientation, pixel(700.0, 500.0))
    seen = replace(
        blending.initial_state(panda.ready),
        feature=pixel(720.0, 540.0),
        level=pixel(1.0, 0.0)[0],
    )
    J_s = torch.eye(2, 6, dtype=torch.float64) * 1000.0  # px/m
    distance = math.hypot(20.0, 40.0)

    def requested(rate):
        xi_x = regional_feedback(goals, pose, seen, J_s, rate).xi_x
        return (J_s @ J_s.mT @ xi_x).norm().item()  # px/s

    free = requested(math.inf)
    assert free > 0.0
    assert requested(2 * free / distance) == pytest.approx(free, rel=1e-12)
    assert requested(0.1 * free / distance) == pytest.approx(0.1 * free + 1.0, rel=1e-9)
