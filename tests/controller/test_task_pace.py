"""Pace of a task beside people: how its scale falls and rises, and what slows it down."""

import math
from dataclasses import replace

import pytest
import torch
from projections import null_space_projector

from hrc_learn.controller import Command, ConstraintConfig, Distances, SafetyConfig
from hrc_learn.controller.arm_loop import ArmLoop
from hrc_learn.controller.arm_loop_state import ArmLoopConfig, ArmReading, WatchedPeople
from hrc_learn.controller.task_pace import (
    TaskPace,
    WayMakingConfig,
    closes_in,
    null_space_input,
)
from hrc_learn.kinematics import panda

DOUBLE, DT = torch.float64, 0.01
Q = torch.tensor([0.4, 0.2, -0.3, -2.2, 0.1, 2.4, 0.6], dtype=DOUBLE)
V = torch.tensor([0.1, -0.05, 0.08, 0.02, -0.1, 0.06, 0.1], dtype=DOUBLE)


def number(value):
    return torch.tensor(value, dtype=DOUBLE)


def pace(people=1.0, override=1.0, full_speed=1.0, blocked_for=0.0):
    begun = TaskPace.begin(number(5.0), full_speed)
    return replace(
        begun,
        people_scale=number(people),
        speed_override=number(override),
        blocked_for=number(blocked_for),
    )


@pytest.mark.parametrize(
    ("before", "people", "scale", "blocked_for"),
    [
        (1.0, 0.3, 0.3, 0.0),  # it drops at once
        (0.3, 1.0, 0.35, 0.0),  # and rises in 0.2 s
        (0.98, 1.0, 1.0, 0.0),
        (0.5, 0.0, 0.0, 2.01),
        (0.0, 0.009, 0.009, 2.01),  # below a hundredth it counts as blocked
        (0.0, 0.011, 0.011, 0.0),
    ],
)
def test_people_slow_a_task_at_once_and_it_recovers_smoothly(
    before, people, scale, blocked_for
):
    later = pace(before, override=0.8, blocked_for=2.0).limited(number(people), DT)
    assert float(later.people_scale) == pytest.approx(scale)
    assert float(later.scale) == pytest.approx(0.8 * scale)
    # The clock of the task runs with it.
    assert float(later.time) == pytest.approx(5.0 + 0.8 * scale * DT)
    assert float(later.blocked_for) == pytest.approx(blocked_for)


@pytest.mark.parametrize(
    ("before", "pause", "after"),
    [(0.8, False, 0.8), (0.8, True, 0.75), (0.02, True, 0.0), (0.4, False, 0.45)],
)
def test_a_pause_takes_a_fifth_of_a_second(before, pause, after):
    later = pace(override=before, full_speed=0.8).overridden(torch.tensor(pause), DT)
    assert float(later.speed_override) == pytest.approx(after)
    assert bool(later.at_full_speed) == (after == 0.8)
    assert not pace(people=0.9).at_full_speed


@pytest.mark.parametrize(
    ("approach", "closes"), [(-1.0, False), (0.0, False), (0.99, False), (1.0, True)]
)
def test_an_arm_closes_in_where_it_approaches_as_fast_as_it_may(approach, closes):
    safety = SafetyConfig(constraints=ConstraintConfig())
    assert safety.constraints is not None
    gradient = torch.tensor([[-1.0, 0, 0, 0, 0, 0, 0], [0, 1.0, 0, 0, 0, 0, 0]], dtype=DOUBLE)
    distances = Distances(
        distance=number([1.2, 0.9]),
        gradient=gradient,
        approach_speed=torch.zeros(2, dtype=DOUBLE),
        person=torch.ones(2, dtype=torch.bool),
    )
    allowed = float(distances.closing_speed(safety.constraints, safety.separation)[0])
    assert allowed > 0.1
    sent = torch.zeros(7, dtype=DOUBLE)
    sent[0] = approach * allowed
    assert bool(closes_in(distances, sent, safety)) == closes


@pytest.mark.parametrize("mode", ["none", "expert", "automatic", "both", None])
@pytest.mark.parametrize("near", [True, False])
@pytest.mark.parametrize("push", [1.5, None])
def test_the_null_space_is_moved_by_those_that_the_mode_names(mode, near, push):
    gradient = torch.eye(7, dtype=DOUBLE)[None, 3]
    distances = Distances(
        distance=number([0.05]), gradient=gradient, approach_speed=number([0.0])
    )
    push = None if push is None else push * torch.ones(7, dtype=DOUBLE)
    config = None if mode is None else WayMakingConfig(mode=mode, speed=0.5)
    found = null_space_input(push, distances if near else None, config, damping=3.0)
    expected = torch.zeros(7, dtype=DOUBLE)
    if push is not None and mode in ("expert", "both", None):
        expected = expected + push
    if near and mode in ("automatic", "both"):
        expected = expected + 3.0 * 0.5 * gradient[0]  # damping times speed
    torch.testing.assert_close(torch.zeros(7).double() if found is None else found, expected)


def loop():
    return ArmLoop(panda, ArmLoopConfig(safety=SafetyConfig(constraints=ConstraintConfig())))


def reading(**values):
    pose, jacobian = panda.forward_and_jacobian(Q)
    still = torch.zeros(7, dtype=DOUBLE)
    given = ArmReading(
        joint_position=Q,
        pose=pose,
        jacobian=jacobian,
        nullspace_input=still,
        pause=torch.tensor(False),
        explain=True,
    )
    return replace(given, **values)


def people(scale=1.0, distance=3.0):
    return WatchedPeople(
        distances=Distances(
            distance=number([distance]),
            gradient=torch.eye(7, dtype=DOUBLE)[None, 0],
            approach_speed=number([0.0]),
            person=torch.tensor([True]),
        ),
        nearest=number(distance),
        age=number(0.0),
        speed_scale=number(scale),
        speed_cap=number(math.inf),
    )


def command_of(law, velocity, twist, **values):
    """A command of the adaptive controller, with the report of a filter that did nothing."""
    _, _, report = law.safety.step(
        law.safety.initial_state(Q, V), Q, V, DT, jacobian=panda.jacobian(Q)
    )
    still, six = torch.zeros(7, dtype=DOUBLE), torch.zeros(6, dtype=DOUBLE)
    return Command(
        **{
            "joint_velocity": velocity,
            "twist": twist,
            "null_velocity": still,
            "xi_x": six[:2],
            "xi_r": six,
            "xi_q": still,
            "s": six,
            "image_jacobian": torch.zeros(2, 6, dtype=DOUBLE),
            "weight_norm": number(0.0),
            "vision_level": number(0.0),
            "potential": number(0.0),
            "potential_rate": number(0.0),
            "safety": report,
        }
        | values
    )


SLOWED = {
    "nobody": ({}, False),
    "stop": ({"stop": torch.tensor(True)}, True),
    "people far away": ({"people": people()}, False),
    "people who slow it down": ({"people": people(0.99)}, True),
    "people who are not seen": ({"people": people(distance=math.nan)}, True),
}


@pytest.mark.parametrize("case", SLOWED)
def test_a_command_of_the_controller_is_sent_at_the_pace_of_the_task(case):
    values, slowed = SLOWED[case]
    law, J = loop(), panda.jacobian(Q)
    state = law.initial_state(Q, joint_velocity=0.3 * V)
    state = replace(state, pace=pace(override=0.4))
    # The filter of the controller has left half of the wanted twist.
    sent, later, report = law.act(state, reading(**values), command_of(law, V, 2 * (J @ V)))
    torch.testing.assert_close(sent, 0.4 * V)
    torch.testing.assert_close(later.safety.velocity, 0.4 * V)
    torch.testing.assert_close(later.safety.acceleration, 0.1 * V / DT)
    assert float(later.pace.people_scale) == pytest.approx(0.5 if slowed else 1.0)
    assert not later.path.followed
    assert bool(report.slowed_by_people) == (case == "people who slow it down")


def test_a_limited_push_on_the_controller_is_explained_by_its_joint():
    """Without what the controller's own joint region asks for."""
    law, N = loop(), null_space_projector(panda.jacobian(Q))
    push, xi = 0.2 * torch.ones(7, dtype=DOUBLE), 0.3 * torch.eye(7, dtype=DOUBLE)[1]
    state = replace(law.initial_state(Q), null_velocity=push)
    wanted = N @ (push - xi / law.config.damping)
    command = command_of(law, V, panda.jacobian(Q) @ V, null_velocity=0.25 * wanted, xi_q=xi)
    _, _, report = law.act(state, reading(), command)
    (limit,) = report.limitations
    assert limit.cause == "joint_limit"
    assert float(limit.kept) == pytest.approx(0.25)
    lower, upper = law.safety.velocity_bounds(Q)
    room = torch.where(wanted > 0, upper, lower) / wanted
    assert int(limit.joint) == int(room.argmin())
    assert report.null_motion is not None
    torch.testing.assert_close(report.null_motion[0], 0.25 * wanted)
    torch.testing.assert_close(report.null_motion[1], N @ V)
