from dataclasses import replace

import pytest
import sampling
import torch

from hrc_learn.controller import SafetyFilter, VelocityStep, WantedVelocity
from hrc_learn.kinematics import panda

LIMITS, DT = panda.limits, 1e-3
STEP = VelocityStep(panda)
# Rounding of differences of velocities near 2 rad/s over 1 ms, and over its square.
ROUNDING = 1e-9


def wanted(q: torch.Tensor, velocity: torch.Tensor, stop: bool = False) -> WantedVelocity:
    return WantedVelocity(
        joint_position=q,
        joint_velocity=velocity,
        stop=torch.full(q.shape[:-1], stop),
        dt=DT,
    )


@pytest.mark.parametrize("batch", [(), (3, 2)])
def test_it_is_the_safety_filter_with_the_jacobian_of_the_arm(batch):
    rng = sampling.generator(0)
    q = sampling.within(LIMITS.lower, LIMITS.upper, *batch, rng=rng)
    velocity = 2 * torch.randn(*batch, 7, generator=rng, dtype=torch.float64)
    safety, state = SafetyFilter(panda), STEP.initial_state(q)
    expected, after, report = safety.step(
        safety.initial_state(q), q, velocity, DT, jacobian=panda.jacobian(q)
    )
    command, new = STEP.step(state, wanted(q, velocity))
    torch.testing.assert_close(command.joint_velocity, expected, rtol=0, atol=1e-15)
    torch.testing.assert_close(new.safety.velocity, after.velocity, rtol=0, atol=1e-15)
    assert torch.equal(command.safety.flags, report.flags)


def test_whatever_is_wanted_the_limits_hold_at_every_millisecond():
    rng = sampling.generator(1)
    q = sampling.within(LIMITS.lower, LIMITS.upper, 16, rng=rng).clamp(
        LIMITS.lower + 0.03, LIMITS.upper - 0.03
    )
    state = STEP.initial_state(q)
    v, a = torch.zeros_like(q), torch.zeros_like(q)
    fastest = torch.zeros(())
    for k in range(400):
        if k % 100 == 0:
            push = 50 * torch.sign(torch.randn(q.shape, generator=rng, dtype=torch.float64))
        command, state = STEP.step(state, wanted(q, push))
        new = command.joint_velocity
        acceleration = (new - v) / DT
        assert (new.abs() <= LIMITS.velocity).all()
        assert (acceleration.abs() <= LIMITS.acceleration + ROUNDING / DT).all()
        assert ((acceleration - a).abs() <= LIMITS.jerk * DT + ROUNDING / DT).all()
        tool = torch.linalg.vecdot(panda.jacobian(q)[..., :3, :], new.unsqueeze(-2)).norm(
            dim=-1
        )
        fastest = torch.maximum(fastest, tool.max())
        v, a, q = new, acceleration, q + DT * new
        assert ((q >= LIMITS.lower) & (q <= LIMITS.upper)).all()
    assert 0.9 < fastest <= STEP.safety.config.tcp_speed


def test_a_stop_and_no_number_brake_to_rest():
    q = panda.ready
    for poison in (False, True):
        state = STEP.initial_state(q)
        for _ in range(120):
            _, state = STEP.step(state, wanted(q, torch.full((7,), 0.3, dtype=torch.float64)))
        assert state.safety.velocity.abs().max() > 0.2
        velocity = torch.full((7,), torch.nan if poison else 0.3, dtype=torch.float64)
        for _ in range(120):
            command, state = STEP.step(state, wanted(q, velocity, stop=not poison))
        assert command.joint_velocity.abs().max() < 1e-9


def test_a_step_beyond_what_the_filter_guarantees_is_refused():
    still = torch.zeros_like(panda.ready)
    too_long = replace(wanted(panda.ready, still), dt=0.3)
    with pytest.raises(ValueError, match=r"a step dt in \(0, 0.2\] s .* but got 0.3 s"):
        STEP.step(STEP.initial_state(panda.ready), too_long)
