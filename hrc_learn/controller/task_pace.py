"""Response of an arm to nearby people: pace of the task, and null-space motion to make way."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.controller.constraint_layer import Distances
from hrc_learn.controller.interface import SafetyConfig
from hrc_learn.controller.joint_path import CHANGE_OF_RATE, changed_rate
from hrc_learn.geometry.numerics import check_settings, safe_norm
from hrc_learn.kinematics import SerialChain
from hrc_learn.pytree import pytree, static

# Step of a difference quotient along a motion [s].
_STEP = 1e-4
# `_BINDING`: a distance counts as binding if at most this much of the allowed closing speed is
# unused [m/s]; at a binding distance, the solver leaves only rounding unused.
# `_BLOCKED`: speed scale below which the arm counts as blocked.
_BINDING, _BLOCKED = 1e-3, 0.01


@pytree
class TaskPace:
    """Speed of the task relative to its planned speed, and a clock that runs at this speed."""

    time: Float[Tensor, "*batch"]
    """Task time [s]: the time of the clock, less the time lost to people near the arm and to
    pauses."""
    people_scale: Float[Tensor, "*batch"]
    """Speed scale imposed by people near the arm, 0 to 1."""
    speed_override: Float[Tensor, "*batch"]
    """Speed scale set by the operator: `full_speed`, or less during a pause."""
    blocked_for: Float[Tensor, "*batch"]
    """Time for which people have blocked the arm without interruption [s]."""
    full_speed: float = static(1.0)
    """Speed scale of a task that is not paused."""

    @classmethod
    def begin(cls, time: Float[Tensor, "*batch"], full_speed: float) -> TaskPace:
        """Pace of a task at full speed.

        Args:
            time: Reading of the clock [s].
            full_speed: Speed scale of a task that is not paused.
        """
        return cls(
            time=time,
            people_scale=torch.ones_like(time),
            speed_override=torch.full_like(time, full_speed),
            blocked_for=torch.zeros_like(time),
            full_speed=full_speed,
        )

    @property
    def scale(self) -> Float[Tensor, "*batch"]:
        """Speed scale of the task now, 0 to 1."""
        return self.people_scale * self.speed_override

    @property
    def at_full_speed(self) -> Bool[Tensor, "*batch"]:
        """True where neither people nor a pause slow the task down."""
        return (self.people_scale == 1) & (self.speed_override == self.full_speed)

    def limited(self, people_scale: Float[Tensor, "*batch"], dt: float) -> TaskPace:
        """Pace one step later, limited by people near the arm.

        Args:
            people_scale: Fraction of the requested motion that people permit. The speed scale
                follows a drop immediately, but rises only as fast as a path speeds up.
            dt: Control step [s].
        """
        scale = torch.minimum(people_scale, self.people_scale + dt / CHANGE_OF_RATE)
        time = self.time + scale * self.speed_override * dt
        blocked_for = torch.where(scale < _BLOCKED, self.blocked_for + dt, 0.0)
        return replace(self, people_scale=scale, time=time, blocked_for=blocked_for)

    def overridden(self, pause: Bool[Tensor, "*batch"], dt: float) -> TaskPace:
        """Pace one step later, slowed down smoothly during a pause.

        Args:
            pause: True while a person pauses the task.
            dt: Control step [s].
        """
        rate = changed_rate(self.speed_override, (~pause).to(self.speed_override), dt)
        return replace(self, speed_override=rate.clamp(max=self.full_speed))


def capped_scale(
    chain: SerialChain,
    q: Float[Tensor, "*batch n"],
    jacobian: Float[Tensor, "*batch 6 n"],
    velocity: Float[Tensor, "*batch n"],
    cap: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch"]:
    """Speed scale with which the tool and all joints keep a cap on their speed, 0 to 1.

    Args:
        chain: Kinematics of the arm.
        q: Joint positions [rad].
        jacobian: Jacobian of the tool.
        velocity: Joint velocity to scale [rad/s].
        cap: Cap on the speed [m/s]; infinite: no cap.
    """
    moved = chain.joint_origins(q + _STEP * velocity) - chain.joint_origins(q)
    joints = torch.linalg.vector_norm(moved, dim=-1).amax(-1) / _STEP
    tool = torch.linalg.vector_norm(
        torch.linalg.vecdot(jacobian[..., :3, :], velocity.unsqueeze(-2)), dim=-1
    )
    speed = torch.maximum(joints, tool)
    return (cap / speed.clamp(min=torch.finfo(q.dtype).tiny)).clamp(0, 1)


def closes_in(
    distances: Distances, sent: Float[Tensor, "*batch n"], safety: SafetyConfig
) -> Bool[Tensor, "*batch"]:
    """True where the arm approaches people as fast as the protective distance allows.

    Args:
        distances: Distances from people.
        sent: Joint velocity sent to the arm [rad/s].
        safety: Settings of the safety filter, with constraints.
    """
    assert safety.constraints is not None  # without them no distance is kept
    allowed = distances.closing_speed(safety.constraints, safety.separation)
    opening = torch.linalg.vecdot(distances.gradient, sent.unsqueeze(-2))
    return (allowed + opening <= _BINDING).any(-1)


WayMaking = Literal["none", "expert", "automatic", "both"]


@dataclass(frozen=True, kw_only=True)
class WayMakingConfig:
    """Settings of way-making: source of null-space motion, and repulsion from nearby bodies."""

    mode: WayMaking = "both"
    """Source of null-space motion: none, the null-space input of a person, the repulsion from
    nearby bodies, or the sum of both."""
    far: float = 0.3
    """Distance at which the repulsion begins [m]: well before the 0.13 m at which
    `ConstraintConfig` begins to slow down an approach at 0.5 m/s."""
    near: float = 0.08
    """Distance at which the repulsion is largest [m], before the constraints bind."""
    speed: float = 0.5
    """Joint velocity at the largest repulsion [rad/s]; only its null-space part acts."""
    smoothing: float = 0.02
    """Difference of distances below which pairs count about equally [m]. Without smoothing, the
    direction of the repulsion would jump where another pair becomes the nearest."""

    def __post_init__(self):
        if not self.near < self.far:
            raise ValueError(f"near must be below far, but they are {self.near} and {self.far}")
        check_settings(self, positive=("speed", "smoothing"))

    @property
    def automatic(self) -> bool:
        """True if the repulsion moves the null space."""
        return self.mode in ("automatic", "both")

    @property
    def expert(self) -> bool:
        """True if the null-space input of a person moves the null space."""
        return self.mode in ("expert", "both")


def way_making_velocity(
    distances: Distances, config: WayMakingConfig | None = None
) -> Float[Tensor, "*batch n"]:
    """Joint velocity away from nearby bodies [rad/s]; only its null-space part acts.

    The velocity follows the gradient of the smoothed least distance
    d = -k log sum exp(-d_i/k), with k = `smoothing`, like a repulsive potential (Khatib 1986).
    It rises smoothly from zero at `far` to `speed` at `near`. It is zero where a distance is
    not a number: the arm brakes there.

    Args:
        distances: Distances from the bodies to keep away from.
        config: Default: the recommended settings.
    """
    config = config or WayMakingConfig()
    distances = distances.where(distances.known())
    ratio = -distances.distance / config.smoothing
    least = -config.smoothing * torch.logsumexp(ratio, -1)
    gradient = (torch.softmax(ratio, -1).unsqueeze(-1) * distances.gradient).sum(-2)
    level = ((config.far - least) / (config.far - config.near)).clamp(0, 1)
    speed = config.speed * level * level * (3 - 2 * level)
    length = safe_norm(gradient)
    direction = gradient / torch.where(length > 0, length, 1.0).unsqueeze(-1)
    return speed.unsqueeze(-1) * direction


def null_space_input(
    push: Float[Tensor, "*batch n"] | None,
    distances: Distances | None,
    config: WayMakingConfig | None,
    damping: float,
) -> Float[Tensor, "*batch n"] | None:
    """Null-space input of a person, plus the input equivalent to way-making [N m].

    Args:
        push: Input of a person [N m]; None: no person pushes.
        distances: Distances from the bodies to keep away from; None: no body is near.
        config: Source of null-space motion; None: a person.
        damping: c_d, null-space input per unit of joint velocity [N m s/rad].

    Returns:
        The input; None: there is no input.
    """
    if config is None:
        return push
    if not config.expert:
        push = None
    if not config.automatic or distances is None:
        return push
    own = damping * way_making_velocity(distances, config)
    return own if push is None else push + own
