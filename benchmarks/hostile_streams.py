"""Send streams of hostile commands through the safety filter.

The commands that a 1 kHz driver would send are kept for independent checks against the limits
of arms.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from disturbance_trials import uniform
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hrc_learn.controller import SafetyConfig, SafetyFilter
from hrc_learn.kinematics import JointLimits, arm

STREAMS = ("random", "bang-bang", "resonant", "outward", "chasing", "poisoned")
"""Kinds of commands.

"random": new random velocities in each tick, or held for some time. "bang-bang": signs at ten
times any limit that change after 1 to 300 ms. "resonant": oscillations of 0.5 to 200 Hz.
"outward": towards the nearer limit. "chasing": reversed as soon as the arm obeys. "poisoned":
all of these, with NaN or infinity in a third of the ticks.
"""

_POISONS = torch.tensor([torch.nan, torch.inf, -torch.inf, 1e300, -1e30], dtype=torch.float64)
# These inputs are common to all arms; the time step is the control step.
_STEPS = torch.cat([_POISONS, _POISONS.new_tensor([0.0, -1e-3, 5.0])])


@dataclass(frozen=True, kw_only=True)
class StreamConfig:
    """Distribution of the streams."""

    arm: str = "fr3"
    """Name of the arm, as for `arm`."""
    count: int = 120
    """Number of streams; each kind has the same number."""
    ticks: int = 1000
    """Number of ticks of each stream."""
    seed: int = 0
    dt: float = 1e-3
    """Control step [s]."""
    noise: float = 1e-4
    """Standard deviation of a reading of half of the arms; the others read without error [rad].
    """
    poison: float = 1 / 3
    """Fraction of the ticks in which a poisoned stream contains NaN or infinity."""
    event: float = 2e-3
    """Fraction of the ticks with a stop; the same for a stale reading, a person near the tool,
    and an invalid step."""
    safety: SafetyConfig = field(default_factory=SafetyConfig)


@dataclass(frozen=True, kw_only=True)
class HostileStreams:
    """Commands sent, and positions of the arms, from rest on."""

    position: Float[Tensor, "ticks streams n"]
    """Position after each tick [rad]."""
    velocity: Float[Tensor, "ticks streams n"]
    """Velocity sent in each tick [rad/s]; zero in the first."""
    kind: Int[Tensor, "streams"]
    """Index into `STREAMS`."""
    poisoned: int
    """Number of ticks with NaN or infinity."""


@torch.inference_mode()
def hostile_streams(config: StreamConfig, safety: SafetyFilter | None = None) -> HostileStreams:
    """Send hostile commands through the filter to arms that follow them exactly.

    The arms start at rest, anywhere within their limits: a quarter of the joints start within
    30 mrad of a limit.

    Args:
        config: Distribution of the streams.
        safety: The filter; None: a filter with the arm's limits and `config.safety`.
    """
    rng = torch.Generator().manual_seed(config.seed)
    robot, count, dt = arm(config.arm), config.count, config.dt
    safety = safety or SafetyFilter(robot.limits, config.safety)
    kind = torch.arange(count) % len(STREAMS)
    poisoned = (kind == STREAMS.index("poisoned")).unsqueeze(-1)
    noise = config.noise * (torch.arange(count) % 4 < 2).unsqueeze(-1)
    # The tool's speed is capped on a third of the arms; the others have joint limits only.
    uncapped = (torch.arange(count) % 3 > 0).view(-1, 1, 1)
    command = _commands(config, robot.limits, kind, rng)
    q = _start(robot.limits, count, rng)
    v = torch.zeros_like(q)
    state = safety.initial_state(q)
    positions, velocities, poisonings = [q], [v], 0
    for k in range(config.ticks - 1):
        reading = q + noise * torch.randn(q.shape, generator=rng, dtype=q.dtype)
        u = command(k * dt, reading, v)
        J = robot.jacobian(reading).masked_fill(uncapped, 0)
        step = torch.tensor(dt, dtype=q.dtype)
        if float(uniform(rng)) < config.event:
            step = _STEPS[torch.randint(len(_STEPS), (), generator=rng)]
        hit = poisoned & (uniform(rng, count, 1) < config.poison)
        if bool(hit.any()):
            given = torch.cat([reading, u, J.flatten(-2)], dim=-1)
            given = _poisoned(given, hit, rng)
            reading, u = given[:, :7], given[:, 7:14]
            J = given[:, 14:].view_as(J)
            poisonings += int(hit.sum())
        stale = uniform(rng, count, 1) < config.event
        v, state, _ = safety.step(
            state,
            reading.masked_fill(stale, torch.nan),
            u,
            step,
            jacobian=J,
            human_distance=_where(rng, count, config.event, 0.3, 3.0),
            stop=uniform(rng, count) < config.event,
        )
        q = q + dt * v
        positions.append(q)
        velocities.append(v)
    return HostileStreams(
        position=torch.stack(positions),
        velocity=torch.stack(velocities),
        kind=kind,
        poisoned=poisonings,
    )


def _start(limits: JointLimits, count: int, rng: torch.Generator) -> Tensor:
    near = 0.03 * uniform(rng, count, 7)
    anywhere = torch.lerp(limits.lower, limits.upper, uniform(rng, count, 7))
    ends = torch.where(uniform(rng, count, 7) < 0.5, limits.lower + near, limits.upper - near)
    return torch.where(uniform(rng, count, 7) < 0.25, ends, anywhere)


def _where(rng: torch.Generator, count: int, share: float, yes: float, no: float) -> Tensor:
    hit: Bool[Tensor, "streams"] = uniform(rng, count) < share
    return torch.where(hit, yes, no).double()


def _poisoned(given: Tensor, hit: Tensor, rng: torch.Generator) -> Tensor:
    """A copy with NaN or infinity in one number of each selected stream."""
    rows = hit.squeeze(-1).nonzero().flatten()
    columns = torch.randint(given.shape[-1], (len(rows),), generator=rng)
    given = given.clone()
    given[rows, columns] = _POISONS[torch.randint(len(_POISONS), (len(rows),), generator=rng)]
    return given


def _commands(
    config: StreamConfig, limits: JointLimits, kind: Tensor, rng: torch.Generator
) -> Callable[[float, Tensor, Tensor], Tensor]:
    """Joint velocities as a function of time, reading and last sent velocity; one kind per
    stream.
    """
    count, dt = config.count, config.dt
    shape = (count, 7)
    frequency = 0.5 * 400 ** uniform(rng, *shape)
    phase = 2 * math.pi * uniform(rng, *shape)
    hold = 1e-3 * 300 ** uniform(rng, count, 1)  # mean time between two changes [s]
    middle = limits.middle
    signs = [torch.sign(torch.randn(shape, generator=rng).double()) for _ in range(3)]
    held = torch.zeros(shape, dtype=torch.float64)
    last = torch.zeros(shape, dtype=torch.float64)

    def command(now: float, q: Tensor, v: Tensor) -> Tensor:
        nonlocal held, last
        changes = uniform(rng, *shape) < dt / hold
        signs[0] = torch.where(changes, -signs[0], signs[0])
        signs[1] = torch.where(uniform(rng, *shape) < 0.2 * dt, -signs[1], signs[1])
        # Reversed when the arm has reached the commanded velocity, or rests.
        arrived = ((v - last).abs() < 1e-3 * dt * limits.acceleration) & (
            uniform(rng, *shape) < 0.3
        )
        signs[2] = torch.where(arrived, -signs[2], signs[2])
        last = v
        normal = 3 * torch.randn(shape, generator=rng, dtype=torch.float64)
        held = torch.where(changes, normal, held)
        every = hold < 3e-3  # streams with the shortest times change in every tick
        random = torch.where(every, normal, held)
        outwards = 20 * torch.sign(q - middle) * torch.where(signs[1] < 0, -0.2, 1.0)
        all_kinds = torch.stack(
            [
                random,
                20 * signs[0],
                6 * torch.sin(2 * math.pi * frequency * now + phase),
                outwards,
                20 * signs[2],
            ]
        )
        # Poisoned streams cycle through all kinds, one second each.
        turn = (kind + int(now)) % len(all_kinds)
        which = torch.where(kind < len(all_kinds), kind, turn)
        return all_kinds.gather(0, which.view(1, count, 1).expand(1, *shape))[0]

    return command
