"""Speed and separation monitoring after ISO 10218-2:2025, Annex L."""

import math

import pytest
import sampling
import torch
from projections import null_space_projector
from unchecked import shapes_unchecked

from hrc_learn.controller import SafetyConfig, SafetyFilter, SeparationConfig
from hrc_learn.kinematics import panda

pytestmark = pytest.mark.simulation

READY = panda.ready
ACROSS = torch.tensor([1.4, 0.9, 0.3, 0.8, 0.3, -0.4, 0.8], dtype=torch.float64)
"""Joint velocity that moves the tool at more than half a metre a second."""


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def test_the_speed_solves_the_equation_of_the_standard():
    config = SeparationConfig(human_speed=1.2, reaction_time=0.15, deceleration=3.0)
    distance = torch.linspace(0.5, 4.0, 50, dtype=torch.float64)
    v = config.highest_speed(distance)
    human = 1.2 * (0.15 + v / 3.0)
    arm = v * 0.15 + v**2 / (2 * 3.0)
    torch.testing.assert_close(human + arm + config.clearance, distance)


@pytest.mark.parametrize(("v", "v_h"), [(0.0, 1.6), (0.4, 0.0), (0.7, 0.9), (0.3, -0.5)])
def test_the_protective_distance_is_what_both_go_until_the_arm_stands(v, v_h):
    """By steps of a millisecond: the arm goes on while it reacts, and brakes."""
    config = SeparationConfig(reaction_time=0.12, deceleration=2.5, clearance=0.07)
    dt, gone, speed, time = 1e-4, 0.0, v, 0.0
    while speed > 0 or time < config.reaction_time:
        if time >= config.reaction_time:
            speed = max(speed - config.deceleration * dt, 0.0)
        gone += dt * (speed + max(v_h, 0.0))
        time += dt
    needed = config.protective_distance(tensor(v), tensor(v_h))
    assert float(needed) == pytest.approx(gone + config.clearance, abs=5e-4)
    # What goes away counts as at rest.
    away = config.protective_distance(tensor(-v), tensor(v_h))
    torch.testing.assert_close(away, config.protective_distance(tensor(0.0), tensor(v_h)))
    # And the speed that keeps it is the one it was computed for.
    torch.testing.assert_close(config.highest_speed(needed, tensor(v_h)), tensor(v))


def test_a_measured_speed_takes_the_place_of_the_assumed_one():
    config, distance = SeparationConfig(human_speed=1.1), tensor(0.5, 1.0)
    assumed = config.highest_speed(distance)
    torch.testing.assert_close(config.highest_speed(distance, tensor(1.1, 1.1)), assumed)
    assert (config.highest_speed(distance, tensor(0.2, 0.2)) > assumed).all()
    v = tensor(0.3)
    torch.testing.assert_close(
        config.protective_distance(v), config.protective_distance(v, tensor(1.1))
    )


def test_a_person_too_close_or_lost_stops_and_nobody_hinders_nobody():
    config = SeparationConfig()
    speeds = config.highest_speed(tensor(0.0, 0.36, math.nan, -1.0, math.inf))
    assert speeds[:4].tolist() == [0, 0, 0, 0]
    assert speeds[4] == math.inf


def test_the_tool_is_as_fast_as_the_distance_allows():
    safety = SafetyFilter(panda.limits)
    J = panda.jacobian(READY).expand(3, 6, 7)
    q, u = READY.expand(3, 7), ACROSS.expand(3, 7)
    distance = tensor(math.inf, 0.6, 0.1)
    state = safety.initial_state(q)
    for _ in range(200):
        v, state, report = safety.step(state, q, u, 0.004, jacobian=J, human_distance=distance)
    speed = (J @ v[..., None])[:, :3, 0].norm(dim=-1)
    allowed = SeparationConfig().highest_speed(distance)
    assert speed[0] > 0.5
    # The rest is kept for ramps of the acceleration.
    assert 0.85 * allowed[1] < speed[1] <= allowed[1]
    assert 0 < speed[1] < 0.3
    assert v[2].norm() == 0
    assert report.acted("separation").tolist() == [False, True, True]
    assert state.count("separation").tolist() == [0, 200, 200]


@pytest.mark.parametrize(("distance", "acts"), [(0.1, True), (math.nan, True), (9.0, False)])
def test_a_person_too_close_ends_motion_in_the_null_space_too(distance, acts):
    """The tool is at rest anyway; that all joints must be is an intervention all the same."""
    safety, J = SafetyFilter(panda.limits), panda.jacobian(READY)
    u = null_space_projector(J) @ torch.ones(7, dtype=torch.float64)
    assert u.norm() > 0.1
    assert (J @ u).norm() < 1e-12
    state = safety.initial_state(READY, u)
    for _ in range(100):
        v, state, report = safety.step(
            state, READY, u, 0.004, jacobian=J, human_distance=tensor(distance)[0]
        )
    assert report.acted("separation").item() is acts
    assert not report.acted("tcp_speed")
    torch.testing.assert_close(v, 0 * u if acts else u)


def test_who_wants_to_rest_before_a_person_rests():
    """Neither the tool's speed nor the one allowed is other than zero: no 0 / 0."""
    safety, J, zero = SafetyFilter(panda.limits), panda.jacobian(READY), torch.zeros_like(READY)
    v, _, report = safety.step(
        safety.initial_state(READY),
        READY,
        zero,
        0.01,
        jacobian=J,
        human_distance=tensor(0.0)[0],
    )
    assert (v == 0).all()
    assert report.acted("separation")


def test_at_the_speed_that_the_distance_allows_nothing_is_reported():
    safety, J = SafetyFilter(panda.limits), panda.jacobian(READY)
    allowed = SeparationConfig().highest_speed(tensor(0.6))[0]
    u = ACROSS * allowed / (J @ ACROSS)[:3].norm()
    for factor, acts in ((1 - 1e-3, False), (1 + 1e-3, True)):
        _, _, report = safety.step(
            safety.initial_state(READY, u),
            READY,
            factor * u,
            0.004,
            jacobian=J,
            human_distance=tensor(0.6)[0],
        )
        assert report.acted("separation").item() is acts


@pytest.mark.long
def test_the_arm_rests_before_a_person_who_comes_running():
    """At v_h straight towards it, with 80 ms of the reaction time spent until the arm is told:
    who has come as near as the clearance meets a tool at rest. Then the person leaves."""
    dt, config = 0.002, SeparationConfig(human_speed=1.6, reaction_time=0.1)
    safety = SafetyFilter(panda.limits, SafetyConfig(separation=config))
    q, state, v = READY, safety.initial_state(READY), torch.zeros(7).double()
    closest, met, late = 3.0, math.inf, round(0.08 / dt)
    distances = [3.0] * late
    speeds = []
    with shapes_unchecked():
        for k in range(2600):
            approach = 1.6 if k < 1200 else -1.6
            J = panda.jacobian(q)
            before = state
            u = ACROSS * math.cos(2 * math.pi * k * dt / 1.5)
            v, state, _ = safety.step(
                state, q, u, dt, jacobian=J, human_distance=tensor(distances[k])[0]
            )
            q = q + v * dt
            speed = (J @ v)[:3].norm().item()
            closest = max(closest - approach * dt, 0.0) - speed * dt
            distances.append(closest)
            speeds.append(speed)
            if closest <= config.clearance:
                met = min(met, k)
                assert speed < 1e-9
            jerk = (state.acceleration - before.acceleration).abs()
            assert (jerk <= panda.limits.jerk * dt * (1 + 1e-9)).all()
    assert met < 1200
    assert max(speeds[:400]) > 0.3
    assert max(speeds[-200:]) > 0.3  # it has resumed


def test_above_its_cap_the_tool_brakes_as_for_a_stop():
    """Joints that brake before their limits, each by itself, would leave it faster."""
    rng, safety, dt = sampling.generator(4), SafetyFilter(panda.limits), 0.01
    lower, upper = panda.limits.lower, panda.limits.upper
    q = sampling.within(lower, upper, 200, rng=rng, margin=0.1)
    state, beyond, u = safety.initial_state(q), 0, q
    distance = torch.full((200,), 0.8, dtype=torch.float64)
    cap = SeparationConfig().highest_speed(distance)
    with shapes_unchecked():
        for k in range(120):
            if k % 30 == 0:
                u = 3 * torch.randn(200, 7, generator=rng, dtype=torch.float64)
            J = panda.jacobian(q)
            v, after, _ = safety.step(state, q, u, dt, jacobian=J, human_distance=distance)
            stopping, _, _ = safety.step(
                state, q, u, dt, jacobian=J, stop=torch.ones(200, dtype=torch.bool)
            )
            speed, least = ((J @ x[..., None])[:, :3, 0].norm(dim=-1) for x in (v, stopping))
            assert (speed <= torch.maximum(cap, least) * (1 + 1e-9)).all()
            beyond += int((speed > cap).sum())
            state, q = after, q + v * dt
    assert beyond == 0


def test_a_distance_without_a_jacobian_is_refused():
    safety = SafetyFilter(panda.limits)
    with pytest.raises(ValueError, match="set jacobian"):
        safety.step(
            safety.initial_state(READY), READY, ACROSS, 0.01, human_distance=tensor(1.0)[0]
        )


def test_bad_settings_are_refused():
    with pytest.raises(ValueError, match="deceleration must be positive"):
        SeparationConfig(deceleration=0.0)
    with pytest.raises(ValueError, match="human_speed must not be negative"):
        SeparationConfig(human_speed=-1.0)
    with pytest.raises(ValueError, match="margin must not be negative"):
        SafetyConfig(margin=-0.1)
    with pytest.raises(ValueError, match=r"velocity_margin must be in \[0, 1\)"):
        SafetyConfig(velocity_margin=1.0)
    with pytest.raises(ValueError, match="tcp_speed must be positive"):
        SafetyConfig(tcp_speed=0.0)


def test_a_batch_is_a_loop():
    rng = sampling.generator()
    safety = SafetyFilter(panda.limits)
    q = READY + 0.2 * torch.randn(4, 7, generator=rng, dtype=torch.float64)
    distance = tensor(0.2, 0.5, 1.0, math.nan)
    J = panda.jacobian(q)
    u = ACROSS.expand(4, 7)
    whole, _, _ = safety.step(
        safety.initial_state(q, u), q, u, 0.004, jacobian=J, human_distance=distance
    )
    for k in range(4):
        one, _, _ = safety.step(
            safety.initial_state(q[k], u[k]),
            q[k],
            u[k],
            0.004,
            jacobian=J[k],
            human_distance=distance[k],
        )
        torch.testing.assert_close(one, whole[k], rtol=0, atol=1e-15)
