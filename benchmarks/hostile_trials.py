"""Hostile trials: poisoned inputs, and plants slower and later than the limits declare.

After each hostile phase the inputs are valid again, and each arm has to move towards the ready
posture: wrong inputs must not have a lasting effect.
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

# The controller treats numbers beyond 1e12 as invalid.
_POISONS = torch.tensor([torch.nan, torch.inf, -torch.inf, 1e300, -1e30], dtype=torch.float64)
_ESTIMATORS = {
    "kalman": KalmanEstimator,
    "composite": CompositeEstimator,
    "paper": PaperEstimator,
    "fixed": FixedEstimator,
}
# Last command of the filter, which is never poisoned: acceleration limits refer to it.
_SPARED = ("safety.velocity", "safety.acceleration")
# Duration of the valid phase after the hostile one [s]: at 0.5 m/s of an approach, the first
# half of the longest way takes 3.5 s.
_RECOVERY = 4.0
# Distance of all joints from the ready posture below which an arm need not move [rad].
_NEAR = 0.1
_HOLD = 0.3  # time for which a hostile command or person stays constant [s]


@dataclass(frozen=True, kw_only=True)
class HostileResult:
    """Results, one entry for each trial."""

    ticks: Int[Tensor, "trials"]
    """Number of ticks of the hostile phase."""
    poisoned: Int[Tensor, "trials"]
    """Number of ticks with NaN, infinity or 1e300 in an input of this arm or in the step."""
    beyond: Int[Tensor, "trials kinds"]
    """Number of ticks beyond the limits of position, velocity, acceleration and, if steps are
    regular, jerk."""
    furthest: Float[Tensor, "trials"]
    """Largest excess of any joint over a position limit; negative: distance to the nearest
    limit [rad]."""
    unknown: Int[Tensor, "trials"]
    """Ticks with a NaN or an infinity in joint velocity or state."""
    stuck: Bool[Tensor, "trials"]
    """True if the arm had not covered half of its way to the ready posture after 4 s."""

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
    """Distribution of the trials of the controller."""

    count: int = 250
    seed: int = 0
    duration: float = 4.0
    """Duration of the hostile phase [s]."""
    dt: float = 0.01
    """Control step [s]."""
    share: float = 1 / 3
    """Fraction of the ticks in which one number of an arm's state or observation is invalid."""
    step_share: float = 0.1
    """Fraction of the ticks with an invalid step, for all arms at once."""
    estimators: tuple[str, ...] = tuple(_ESTIMATORS)
    """Estimators of the image Jacobian; each has the same number of arms."""


def run_poison_trials(config: PoisonConfig) -> HostileResult:
    """Poison arms with each estimator, while people pull at them, approach and leave."""
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
    """Goals with separate numbers for each arm."""

    def apart(x: Tensor) -> Tensor:
        return x if x.dim() and len(x) == count else x.expand(count, *x.shape).clone()

    return _pytree.tree_map(apart, goals)


def _normal(rng: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=rng, dtype=torch.float64)


def _poisoned(
    tree: Any, share: float, rng: torch.Generator, spared: tuple[str, ...]
) -> tuple[Any, Bool[Tensor, "trials"]]:
    """A copy in which a fraction of the arms has one invalid number at a random place.

    Returns:
        The copy, and flags of these arms.
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
    """Distribution of the trials of the safety filter with an imperfect plant."""

    count: int = 250
    seed: int = 0
    duration: float = 4.0
    """Duration of the hostile phase [s]."""
    dt: float = 0.01
    """Control step [s]."""
    braking: float = 0.3
    """Smallest fraction of the acceleration limits that a plant has; fractions are drawn up to
    1. The default is that of a real arm's adapter."""
    delay: float = 0.02
    """Largest delay of a command [s]."""
    lag: float = 0.01
    """Largest time constant of the servos after the delay [s]."""
    jitter: float = 0.3
    """Largest fraction by which a step is longer or shorter than declared."""
    encoder_offset: float = 2e-3
    """Largest error of a joint's zero [rad]."""
    encoder_noise: float = 1e-4
    """Standard deviation of a reading [rad]."""
    poison: float = 0.02
    """Fraction of the ticks in which a reading, a command or a Jacobian is NaN."""
    worse: float = 1.0
    """Factor by which plants are slower, later and more irregular than declared."""

    def safety(self) -> SafetyConfig:
        """Configuration of the filter, with the declared properties of the plant."""
        return SafetyConfig(
            braking=self.braking, delay=self.delay + self.lag, jitter=self.jitter
        )


_FINE = 1e-3  # step of the simulated joints [s]
_COMMANDS = 4  # kinds of hostile commands


@torch.inference_mode()
def run_plant_trials(config: PlantConfig) -> HostileResult:
    """Command arms through the filter; they follow as slowly, late and irregularly as declared.

    Each quarter of the arms receives one kind of commands: random velocities, signs at ten
    times any limit that change within steps, oscillations of 0.5 to 20 Hz, or velocities
    towards the nearer limit. The properties of the plants are drawn up to the declared worst; a
    third of the plants has the worst.
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
    """Joint velocities as a function of time and reading, one kind per arm [rad/s]."""
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
    """Joints that follow each command with delay, lag and a fraction of their acceleration."""

    def __init__(self, config: PlantConfig, rng: torch.Generator):
        self.rng, self.noise = rng, config.encoder_noise
        self.jitter = min(config.worse * config.jitter, 0.9)

        def drawn() -> Tensor:
            """Random numbers from 0 to 1; 1 (the worst) for a third of the arms."""
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
        """Advance by one step of the simulated joints."""
        self.told.append(command)
        place = (len(self.told) - 1 - self.late).expand(-1, self.q.shape[-1])
        wanted = torch.stack(tuple(self.told)).gather(0, place[None])[0]
        change = self.follow * (wanted - self.v)
        self.v = self.v + change.clamp(-self.reach, self.reach)
        self.q = self.q + _FINE * self.v
