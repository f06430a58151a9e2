"""Limits with an arm that does less than it is told, later, and at other times."""

from typing import NamedTuple

import pytest
import sampling
import torch
from torch import Tensor
from unchecked import shapes_unchecked

from hrc_learn.controller import SafetyConfig, SafetyFilter
from hrc_learn.kinematics import panda

LIMITS = panda.limits
FINE = 1e-3
"""Step of the simulated joints [s]."""


class Plant(NamedTuple):
    braking: float = 1.0
    delay: float = 0.0
    jitter: float = 0.0

    def declared(self) -> SafetyConfig:
        return SafetyConfig(braking=self.braking, delay=self.delay, jitter=self.jitter)


def furthest_out(
    config: SafetyConfig, runs: int, plant: Plant, *, dt: float = 0.01, time: float = 3.0
) -> Tensor:
    """How far joints with such a driver come past their limits under hostile commands [rad].

    The driver follows each velocity, `delay` late, with its fraction of the acceleration.
    """
    rng = sampling.generator(11)
    safety = SafetyFilter(LIMITS, config)
    q = sampling.within(LIMITS.lower, LIMITS.upper, runs, rng=rng, margin=0.3)
    v, state, late = torch.zeros_like(q), safety.initial_state(q), round(plant.delay / FINE)
    told, way, command = [v] * (late + 1), v, v
    worst, next_step = torch.full((runs,), -torch.inf, dtype=torch.float64), 0.0
    for k in range(round(time / FINE)):
        if k * FINE >= next_step - 1e-9:
            unit = 2 * torch.rand((), generator=rng, dtype=torch.float64) - 1
            next_step = k * FINE + dt * (1 + plant.jitter * float(unit))
            if k % 500 < dt / FINE * 2:
                way = torch.sign(torch.randn(runs, 7, generator=rng, dtype=torch.float64))
            command, state, _ = safety.step(state, q, 10 * way, dt)
        told.append(command)
        reach = plant.braking * LIMITS.acceleration * FINE
        v = v + (told[-1 - late] - v).clamp(-reach, reach)
        q = q + v * FINE
        worst = torch.maximum(worst, torch.maximum(q - LIMITS.upper, LIMITS.lower - q).amax(-1))
    return worst


PLANTS = {
    "slow": Plant(braking=0.3),
    "late": Plant(delay=0.02),
    "irregular": Plant(jitter=0.5),
    "all of it": Plant(braking=0.3, delay=0.02, jitter=0.3),
}


@pytest.mark.long
@pytest.mark.parametrize(
    ("plant", "dt"), [*((name, 0.02) for name in PLANTS), ("all of it", 0.004)]
)
@shapes_unchecked()  # for speed
def test_no_command_breaks_a_position_limit_of_a_plant_that_is_declared(plant, dt):
    worst = furthest_out(PLANTS[plant].declared(), 256, PLANTS[plant], dt=dt)
    assert (worst < -SafetyConfig().margin).all()  # all of it is left for what servos err by
    assert (worst > -0.1).float().mean() > 0.6  # they did come there


@shapes_unchecked()  # for speed
def test_a_plant_that_is_not_declared_leaves_them():
    worst = furthest_out(SafetyConfig(), 64, Plant(braking=0.3, delay=0.02))
    assert (worst > 0.1).float().mean() > 0.3


def test_settings_that_no_driver_has_are_refused():
    with pytest.raises(ValueError, match=r"braking must be in \(0, 1\], but is 0.0"):
        SafetyConfig(braking=0.0)
    with pytest.raises(ValueError, match="delay must not be negative"):
        SafetyConfig(delay=-0.01)
    with pytest.raises(ValueError, match=r"jitter must be in \[0, 1\)"):
        SafetyConfig(jitter=1.0)


@shapes_unchecked()  # for speed
def test_steps_of_any_length_keep_all_limits_if_it_is_told():
    """As the time since the last step; nothing has to be declared then."""
    rng, runs = sampling.generator(5), 64
    safety = SafetyFilter(LIMITS)
    q = sampling.within(LIMITS.lower, LIMITS.upper, runs, rng=rng, margin=0.3)
    v, state = torch.zeros_like(q), safety.initial_state(q)
    a, way = v, v
    nearest = torch.full((runs,), torch.inf, dtype=torch.float64)
    for k in range(500):
        elapsed = 0.02 * 0.05 ** float(torch.rand((), generator=rng, dtype=torch.float64))
        q = q + v * elapsed
        if k % 120 < 4:
            way = torch.sign(torch.randn(runs, 7, generator=rng, dtype=torch.float64))
        before, a_before = v, a
        v, state, _ = safety.step(state, q, 10 * way, elapsed)
        a = (v - before) / elapsed
        assert (v.abs() <= LIMITS.velocity).all()
        assert (a.abs() <= LIMITS.acceleration * (1 + 1e-9)).all()
        assert ((a - a_before).abs() <= LIMITS.jerk * elapsed * (1 + 1e-6)).all()
        room = torch.minimum(q - LIMITS.lower, LIMITS.upper - q).amin(-1)
        nearest = torch.minimum(nearest, room)
    assert (nearest >= SafetyConfig().margin - 1e-9).all()
    assert (nearest < 0.05).float().mean() > 0.5  # they did come there
