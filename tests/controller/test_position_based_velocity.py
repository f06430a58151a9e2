"""Velocity limits that tighten towards those of position: the filter brakes in time."""

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from fr3_tables import FR3_TABLES
from hostile_streams import (
    STREAMS,
    StreamConfig,
    hostile_streams,
)
from limit_monitor import LimitMonitor
from sampling import generator
from step_equality import controller_and_observation
from unchecked import shapes_unchecked

from hrc_learn.controller import (
    AdaptiveController,
    ConstraintConfig,
    Observation,
    SafetyConfig,
    SafetyFilter,
)
from hrc_learn.deploy import EagerRunner, PackageRunner, StepRunner, open_step
from hrc_learn.kinematics import fr3, panda

pytestmark = pytest.mark.simulation

CONFIGS = {
    "default": SafetyConfig(),
    "no margins": SafetyConfig(margin=0.0, velocity_margin=0.0, rate=100.0),
    "driver of a real arm": SafetyConfig(braking=0.3, delay=0.03, jitter=0.3),
    "strong and slow": SafetyConfig(rate=1.0),
}
# Which libfranka takes off its limits.
TOLERANCE = 1e-3
DT = 1e-3


@pytest.fixture(autouse=True)
def _no_shape_checks() -> Iterator[None]:
    """They take most of the time of a step, and tracers cannot follow them."""
    with shapes_unchecked():
        yield


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
@pytest.mark.parametrize("vintage", FR3_TABLES)
def test_whatever_the_filter_allows_is_allowed(vintage, config):
    """At each position, the fastest a joint may be there as it brakes as hard as it can."""
    limits = FR3_TABLES[vintage]
    safety = SafetyFilter(fr3.limits, config)
    share = torch.linspace(-0.02, 1.02, 20_001, dtype=torch.float64)[:, None]
    q = torch.lerp(limits.lower, limits.upper, share)
    for ours, theirs, outwards in zip(
        safety.velocity_bounds(q), limits.velocity_bounds(q), (-1, 1), strict=True
    ):
        at_most = theirs.abs() * (1 - config.velocity_margin)
        # Steady motion; one that brakes with A may be faster by the reserve.
        braking = (outwards * ours + safety.barrier.reserve).clamp(max=safety.barrier.velocity)
        # In the margin joints come to rest, which takes them microseconds of radians.
        moving = outwards * ours > 0
        assert bool((braking <= at_most - (at_most < 2.5) * 1e-9)[moving].all())
        slow = moving & (at_most < 0.9 * limits.velocity)
        assert slow.any(0).all(), "each joint is slowed down before its limits"
        assert bool((braking <= at_most - TOLERANCE)[slow].all())
        # And it makes use of them: some joint nearly all, each half of what it may.
        free = outwards * ours >= (1 - 1e-12) * safety.barrier.velocity
        assert bool(free.any(0).all()) or config.braking < 1 or config.rate < 2


def test_limits_that_do_not_tighten_are_as_before():
    """For them the curve is the deceleration's that is the arm's own."""
    plain = SafetyFilter(panda.limits)
    A = plain.barrier.acceleration
    torch.testing.assert_close(plain.barrier.knee, A / 5.0)
    torch.testing.assert_close(plain.barrier.twice_acceleration, 2 * A)
    torch.testing.assert_close(plain.barrier.walls[1], panda.limits.upper - 0.02)
    far = replace(
        panda.limits,
        velocity_offset=torch.full((7,), 1e-3, dtype=torch.float64),
        deceleration=1e3 * panda.limits.acceleration,
    )
    for name, buffer in SafetyFilter(far).barrier.named_buffers():
        torch.testing.assert_close(buffer, plain.barrier.get_buffer(name), rtol=0, atol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("arm", [panda, fr3], ids=["panda", "fr3"])
@pytest.mark.parametrize("constraints", [None, ConstraintConfig()], ids=["", "constrained"])
def test_hostile_streams_keep_all_limits(arm, constraints):
    config = StreamConfig(
        arm=arm.name,
        count=24,
        ticks=500 if constraints is None else 60,
        safety=SafetyConfig(constraints=constraints),
    )
    sent = hostile_streams(config)
    assert bool(sent.velocity.isfinite().all())
    assert bool(sent.position.isfinite().all())
    assert sent.poisoned > 100 or constraints is not None
    watch = LimitMonitor(arm.limits, torch.zeros(24, 7, dtype=torch.float64), config.dt)
    for q, v in zip(sent.position, sent.velocity, strict=True):
        assert not watch.violations(q, v).any()
    # They are put to the test: each kind of stream by itself reaches a limit of its own.
    a = sent.velocity.diff(dim=0) / config.dt
    for kind in range(len(STREAMS)):
        fastest = (a[:, sent.kind == kind].abs() / arm.limits.acceleration).amax()
        assert float(fastest) > 0.9


@pytest.mark.long
def test_streams_that_know_of_no_tightening_break_it():
    """The check finds what it is there to find."""
    flat = replace(fr3.limits, velocity_offset=None, deceleration=None)
    config = StreamConfig(count=24, ticks=300)
    sent = hostile_streams(config, SafetyFilter(flat))
    watch = LimitMonitor(fr3.limits, torch.zeros(24, 7, dtype=torch.float64), config.dt)
    broken = torch.stack(
        [watch.violations(q, v) for q, v in zip(sent.position, sent.velocity, strict=True)]
    )
    assert broken[..., 1].any()
    assert not broken[..., 2:].any()


def push_outwards(runner: StepRunner, ticks: int) -> int:
    """Let a person ask for more than any limit; ticks at more than half of a lowered limit."""
    push = 30 * torch.randn(7, generator=generator(3), dtype=torch.float64)
    q, tight, limits = fr3.ready.clone(), 0, fr3.limits
    for _ in range(ticks):
        for name in ("joint_position", "image_joint_position"):
            runner.observation[name][:] = q.numpy()
        runner.observation["nullspace_input"][:] = push.numpy()
        v = torch.from_numpy(runner.step().copy())
        after = q + DT * v
        for at in (q, after):
            lower, upper = limits.velocity_bounds(at)
            assert bool(((v >= lower) & (v <= upper)).all())
        lowered = torch.where(v > 0, upper, -lower) < 0.9 * limits.velocity
        tight += int((lowered & (v.abs() > 0.3 * torch.where(v > 0, upper, -lower))).any())
        q = after
        assert bool(limits.contain(q))
    return tight


def fr3_step() -> tuple[AdaptiveController, Observation]:
    controller, observation = controller_and_observation(fr3.ready, fr3)
    return controller, replace(observation, dt=DT)


@pytest.mark.long
def test_the_controllers_step_brakes_before_an_fr3s_limits():
    assert push_outwards(EagerRunner(*fr3_step()), 350) > 20


@pytest.mark.slow
def test_the_exported_step_brakes_before_an_fr3s_limits(tmp_path):
    runner = open_step(*fr3_step(), tmp_path)
    assert isinstance(runner, PackageRunner)
    assert push_outwards(runner, 5000) > 20
