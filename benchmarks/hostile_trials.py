"""Hostile trials: poisoned inputs, and plants that do less than the limits promise, later.

After each hostile phase the inputs are healthy again, and each arm has to move towards the
ready posture: what was told wrongly must not be remembered.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from disturbance_trials import (
    all_finite,
    random_controller,
    ticks_beyond,
    uniform,
)
from jaxtyping import Bool, Float, Int
from limit_monitor import LimitMonitor
from torch import Tensor
from torch.utils import _pytree

from hrc_learn.controller import (
    Goals,
    Observation,
    SafetyConfig,
    SafetyFilter,
)
from hrc_learn.jacobian import (
    CompositeEstimator,
    FixedEstimator,
    KalmanEstimator,
    PaperEstimator,
)
from hrc_learn.kinematics import panda

# Beyond 1e12 nothing is a number to the controller.
_POISONS = torch.tensor([torch.nan, torch.inf, -torch.inf, 1e300, -1e30], dtype=torch.float64)
_ESTIMATORS = {
    "kalman": KalmanEstimator,
    "composite": CompositeEstimator,
    "paper": PaperEstimator,
    "fixed": FixedEstimator,
}
# What the filter commanded last: whoever is told otherwise can keep no limit of acceleration.
_SPARED = ("safety.velocity", "safety.acceleration")
# Healthy time after the hostile one [s]: at the 0.5 m/s of an approach the longest way takes
# 3.5 s for its first half.
_RECOVERY = 4.0
_NEAR = 0.1  # from the ready posture, of any joint: there a run need not move [rad]
_HOLD = 0.3  # for which a hostile command or person stays as it is [s]


@dataclass(frozen=True, kw_only=True)
class HostileResult:
    """Results, one entry for each trial."""

    ticks: Int[Tensor, "trials"]
    """Hostile ticks."""
    poisoned: Int[Tensor, "trials"]
    """Those with a number that was none, in a quantity of this arm or in the step."""
    beyond: Int[Tensor, "trials kinds"]
    """Ticks beyond the limits of position, velocity, acceleration and, where steps are regular,
    jerk."""
    furthest: Float[Tensor, "trials"]
    """Of any joint past a limit of position; negative: short of all [rad]."""
    unknown: Int[Tensor, "trials"]
    """Ticks with a NaN or an infinity in joint velocity or state."""
    stuck: Bool[Tensor, "trials"]
    """Whether the arm was not half way to the ready posture 4 s later."""

    def summary(self) -> dict[str, float]:
        """Totals by name, and the furthest position in mrad."""
        return {
            **ticks_beyond(self.beyond),
            "ticks": float(self.ticks.sum()),
            "poisoned": float(self.poisoned.sum()),
            "furthest_mrad": 1e3 * self.furthest.max().item(),
            "nan": float(self.unknown.sum()),
            "stuck": float(self.stuck.sum()),
        }


def _past_limits(q: Float[Tensor, "trials n"]) -> Float[Tensor, "trials"]:
    limits = panda.limits
    return torch.maximum(q - limits.upper, limits.lower - q).amax(-1)


def _away(q: Float[Tensor, "trials n"]) -> Float[Tensor, "trials"]:
    """Largest distance of a joint from the ready posture [rad]."""
    return (q - panda.ready).abs().amax(-1)


def _stuck(before: Tensor, after: Tensor) -> Bool[Tensor, "trials"]:
    return ~(_away(after) < (0.5 * _away(before)).clamp(min=_NEAR))


@dataclass(frozen=True, kw_only=True)
class PoisonConfig:
    """How trials of the controller are drawn."""

    count: int = 250
    seed: int = 0
    duration: float = 4.0
    """Of the hostile phase [s]."""
    dt: float = 0.01
    """Control step [s]."""
    share: float = 1 / 3
    """Of the ticks of each arm in which one number of its state or observation is none."""
    step_share: float = 0.1
    """Of the ticks whose step is none, for all arms at once."""
    estimators: tuple[str, ...] = tuple(_ESTIMATORS)
    """Of which image Jacobians are estimated, by as many arms each."""


def run_poison_trials(config: PoisonConfig) -> HostileResult:
    """Poison arms, as many with each estimator, that people pull at, come near and leave."""
    rng = torch.Generator().manual_seed(config.seed)
    names = config.estimators
    shares = [len(part) for part in torch.arange(config.count).tensor_split(len(names))]
    parts = [
        _poison(config, _ESTIMATORS[name], count, rng)
        for name, count in zip(names, shares, strict=True)
        if count
    ]
    columns = {key: torch.cat([vars(part)[key] for part in parts]) for key in vars(parts[0])}
    return HostileResult(**columns)


@torch.inference_mode()
def _poison(
    config: PoisonConfig, estimator: type, count: int, rng: torch.Generator
) -> HostileResult:
    limits, dt = panda.limits, config.dt
    q = torch.lerp(limits.lower, limits.upper, uniform(rng, count, 7))
    controller, camera = random_controller(count, rng, estimator)
    tool = panda.forward(panda.ready)
    ready = Goals.at(tool.position, tool.orientation, controller.goals.vision.target)
    ready = ready.with_vision(False).approached_by(panda.ready)
    hostile_goals, ready = (_of_each_arm(goals, count) for goals in (controller.goals, ready))
    state = controller.initial_state(q)
    watch = LimitMonitor(limits, state.safety.velocity, dt)
    beyond = torch.zeros(count, 5, dtype=torch.int64)
    furthest = torch.full((count,), -math.inf, dtype=torch.float64)
    unknown, poisoned = torch.zeros(2, count, dtype=torch.int64)
    hostile, hold = round(config.duration / dt), round(_HOLD / dt)
    before = q
    for k in range(hostile + round(_RECOVERY / dt)):
        healthy = k >= hostile
        if k == hostile:
            before = q
        if k % hold == 0 or k == hostile:
            # Far beyond what a person applies (6 N in the force trials).
            pull = torch.zeros_like(q) if healthy else 20 * _normal(rng, count, 7)
            near = uniform(rng, count) < (0.0 if healthy else 0.1)
            goals = ready if healthy else hostile_goals.moved_to(_normal(rng, count, 3))
        feature, visible = camera.project(panda.forward(q))
        observation = Observation(
            joint_position=q,
            feature=feature,
            feature_visible=visible,
            feature_new=torch.ones_like(visible),
            feature_age=torch.zeros(count, dtype=q.dtype),
            image_joint_position=q,
            nullspace_input=pull,
            human_distance=torch.where(near, 0.3, 3.0).to(q),
            goals=goals,
            dt=torch.tensor(dt, dtype=q.dtype),
        )
        if not healthy:
            spared = () if k == 0 else _SPARED
            (state, observation), hit = _poisoned(
                (state, observation), config.share, rng, spared
            )
            if float(uniform(rng)) < config.step_share:
                bad = torch.cat([_POISONS, _POISONS.new_tensor([0.0, -dt, 5.0])])
                step = bad[torch.randint(len(bad), (), generator=rng)]
                observation, hit = replace(observation, dt=step), torch.ones_like(hit)
            poisoned += hit
        command, state = controller.step(state, observation)
        q = q + dt * command.joint_velocity
        beyond += watch.violations(q, command.joint_velocity)
        furthest = torch.maximum(furthest, _past_limits(q))
        unknown += ~all_finite((command.joint_velocity, state))
    return HostileResult(
        ticks=torch.full((count,), hostile),
        poisoned=poisoned,
        beyond=beyond,
        furthest=furthest,
        unknown=unknown,
        stuck=_stuck(before, q),
    )


def _of_each_arm(goals: Goals, count: int) -> Goals:
    """Goals with all their numbers apart for each arm."""

    def apart(x: Tensor) -> Tensor:
        return x if x.dim() and len(x) == count else x.expand(count, *x.shape).clone()

    return _pytree.tree_map(apart, goals)


def _normal(rng: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=rng, dtype=torch.float64)


def _poisoned(
    tree: Any, share: float, rng: torch.Generator, spared: tuple[str, ...]
) -> tuple[Any, Bool[Tensor, "trials"]]:
    """A copy in which a share of the arms has one number that is none, anywhere.

    Returns:
        The copy, and which arms.
    """
    leaves, structure = _pytree.tree_flatten_with_path(tree)
    values = [x for _, x in leaves]
    places = [
        k
        for k, (path, x) in enumerate(leaves)
        if x.is_floating_point() and x.dim() > 0 and not _pytree.keystr(path).endswith(spared)
    ]
    count = len(values[places[0]])
    hit = uniform(rng, count) < share
    where = torch.randint(len(places), (count,), generator=rng)
    for k, place in enumerate(places):
        arms = (hit & (where == k)).nonzero().flatten()
        if len(arms):
            broken = values[place].clone().reshape(count, -1)
            column = torch.randint(broken.shape[1], (len(arms),), generator=rng)
            value = torch.randint(len(_POISONS), (len(arms),), generator=rng)
            broken[arms, column] = _POISONS[value]
            values[place] = broken.reshape(values[place].shape)
    return _pytree.tree_unflatten(values, structure), hit


@dataclass(frozen=True, kw_only=True)
class PlantConfig:
    """How trials of the safety filter with an imperfect plant are drawn."""

    count: int = 250
    seed: int = 0
    duration: float = 4.0
    """Of the hostile phase [s]."""
    dt: float = 0.01
    """Control step [s]."""
    braking: float = 0.3
    """Least fraction of the limits of acceleration that a plant has; each has its own, up to
    1. That of the adapter of a real arm."""
    delay: float = 0.02
    """Largest delay of a command [s]."""
    lag: float = 0.01
    """Largest time constant of the servos after that [s]."""
    jitter: float = 0.3
    """Largest fraction by which a step is longer or shorter than it says."""
    encoder_offset: float = 2e-3
    """Largest error of a joint's zero [rad]."""
    encoder_noise: float = 1e-4
    """Standard deviation of a reading [rad]."""
    poison: float = 0.02
    """Share of the ticks in which a reading, a command or a Jacobian is NaN."""
    worse: float = 1.0
    """How many times slower, later and more irregular plants are than was declared."""

    def safety(self) -> SafetyConfig:
        """What the filter is told."""
        return SafetyConfig(
            braking=self.braking, delay=self.delay + self.lag, jitter=self.jitter
        )


_FINE = 1e-3  # step of the simulated joints [s]
_COMMANDS = 4  # kinds of hostile commands


@torch.inference_mode()
def run_plant_trials(config: PlantConfig) -> HostileResult:
    """Command arms, by the filter, that follow as slowly, late and irregularly as declared.

    A quarter of the arms each is told random velocities, signs at ten times any limit that
    change within steps, swings of 0.5 to 20 Hz, and to go on outwards wherever it is. Their
    drivers draw up to the declared worst, and a third each has the worst.
    """
    rng, count = torch.Generator().manual_seed(config.seed), config.count
    limits, dt = panda.limits, config.dt
    safety = SafetyFilter(limits, config.safety())
    plant = _Plant(config, rng)
    q = torch.lerp(limits.lower, limits.upper, uniform(rng, count, 7))
    inside = config.encoder_offset + safety.config.margin
    q = q.clamp(limits.lower + inside, limits.upper - inside)
    plant.start(q)
    hostile_command = _hostile_commands(config, rng)
    state = safety.initial_state(plant.read())
    ticks, poisoned, unknown = torch.zeros(3, count, dtype=torch.int64)
    beyond = torch.zeros(count, 3, dtype=torch.int64)
    furthest = torch.full((count,), -math.inf, dtype=torch.float64)
    due, stepped, before = 0.0, -dt, None
    command = torch.zeros_like(q)
    for k in range(round((config.duration + _RECOVERY) / _FINE)):
        now = k * _FINE
        healthy = now >= config.duration
        if healthy and before is None:
            before = plant.q
        if now >= due - 1e-9:
            due = now + dt * (1 + plant.jitter * float(2 * uniform(rng) - 1))
            reading = plant.read()
            u = panda.ready - reading if healthy else hostile_command(now, reading)
            J = panda.jacobian(reading)
            given = {"q": reading, "u": 2 * u, "J": J}
            if not healthy:
                given, hit = _poisoned(given, config.poison, rng, ())
                ticks += 1
                poisoned += hit
            near = uniform(rng, count) < (0.0 if healthy else 0.02)
            last = command
            command, state, _ = safety.step(
                state,
                given["q"],
                given["u"],
                dt,
                jacobian=given["J"],
                human_distance=torch.where(near, 0.3, 3.0).to(q),
            )
            change = (command - last).abs() / (now - stepped)
            stepped = now
            beyond[:, 1] += (command.abs() > limits.velocity).any(-1)
            beyond[:, 2] += (change > (1 + 1e-9) * config.braking * limits.acceleration).any(-1)
            unknown += ~all_finite((command, state))
        plant.advance(command)
        out = _past_limits(plant.q)
        beyond[:, 0] += out > 0
        furthest = torch.maximum(furthest, out)
    assert before is not None
    return HostileResult(
        ticks=ticks,
        poisoned=poisoned,
        beyond=beyond,
        furthest=furthest,
        unknown=unknown,
        stuck=_stuck(before, plant.q),
    )


def _hostile_commands(
    config: PlantConfig, rng: torch.Generator
) -> Callable[[float, Tensor], Tensor]:
    """Joint velocities by time and reading, a kind for each arm [rad/s]."""
    count, limits = config.count, panda.limits
    kind = (torch.arange(count) % _COMMANDS).unsqueeze(-1)
    frequency = 0.5 * 40 ** uniform(rng, count, 1)
    phase = 2 * math.pi * uniform(rng, count, 7)
    held: dict[str, Any] = {"until": 0.0}

    def command(now: float, q: Tensor) -> Tensor:
        if now >= held["until"]:
            held["until"] = now + _HOLD
            held["random"] = 3 * _normal(rng, count, 7)
            held["side"] = torch.where(uniform(rng, count, 7) < 0.2, -1.0, 1.0)
        signs = 20 * torch.sign(_normal(rng, count, 7))
        swing = 3 * torch.sin(2 * math.pi * frequency * now + phase)
        outwards = 20 * held["side"] * torch.sign(q - (limits.lower + limits.upper) / 2)
        return torch.stack([held["random"], signs, swing, outwards]).gather(
            0, kind.expand(count, 7)[None]
        )[0]

    return command


class _Plant:
    """Joints that follow each command late, with a lag and a fraction of their acceleration."""

    def __init__(self, config: PlantConfig, rng: torch.Generator):
        self.rng, self.noise = rng, config.encoder_noise
        self.jitter = min(config.worse * config.jitter, 0.9)

        def drawn() -> Tensor:
            """0 to 1; the worst for a third of the arms."""
            return (1.5 * uniform(rng, config.count, 1)).clamp(max=1)

        least = config.braking / config.worse
        fraction = 1 + (least - 1) * drawn()
        self.reach = fraction * panda.limits.acceleration * _FINE
        self.late = (config.worse * config.delay * drawn() / _FINE).round().long()
        lag = (config.worse * config.lag * drawn()).clamp(min=1e-9)
        self.follow = -torch.expm1(-_FINE / lag)
        self.offset = config.encoder_offset * (2 * uniform(rng, config.count, 7) - 1)
        self.told: deque[Tensor] = deque(maxlen=int(self.late.max()) + 1)

    def start(self, q: Tensor) -> None:
        self.q, self.v = q, torch.zeros_like(q)
        self.told.extend([self.v] * (self.told.maxlen or 1))

    def read(self) -> Tensor:
        return self.q + self.offset + self.noise * _normal(self.rng, *self.q.shape)

    def advance(self, command: Tensor) -> None:
        """One fine step."""
        self.told.append(command)
        place = (len(self.told) - 1 - self.late).expand(-1, self.q.shape[-1])
        wanted = torch.stack(tuple(self.told)).gather(0, place[None])[0]
        change = self.follow * (wanted - self.v)
        self.v = self.v + change.clamp(-self.reach, self.reach)
        self.q = self.q + _FINE * self.v
