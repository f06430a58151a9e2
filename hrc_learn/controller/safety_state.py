"""Settings, state and report of the safety filter."""

from __future__ import annotations

from dataclasses import dataclass, field

from jaxtyping import Bool, Float, Int
from torch import Tensor

from hrc_learn.controller.constraint_layer import ConstraintConfig, SeparationConfig
from hrc_learn.pytree import pytree

INTERVENTIONS = (
    "velocity",
    "position",
    "acceleration",
    "jerk",
    "tcp_speed",
    "separation",
    "invalid",
    "stopped",
    "start",
)
"""Kinds of interventions, in the order of the last axis of their flags and counts."""


@dataclass(frozen=True, kw_only=True)
class SafetyConfig:
    """Margins and caps in addition to the joint limits."""

    margin: float = 0.02
    """Distance kept from every joint position limit [rad]."""
    velocity_margin: float = 0.02
    """Unused fraction of every joint velocity limit. The arm's own servo overshoots its command
    by up to 1.2 % of the limit (in MuJoCo)."""
    rate: float = 5.0
    """Fastest decay of the remaining distance to a limit [1/s]; at most 1/dt."""
    braking: float = 1.0
    """Fraction of the acceleration and jerk limits that the arm's driver uses, in (0, 1].
    franky plans with its `dynamics` factor, 0.3 by default in our adapter."""
    delay: float = 0.0
    """Longest time from a joint position reading to the motion that results from it [s]."""
    jitter: float = 0.0
    """Largest relative deviation of a step from its `dt`, in [0, 1). Zero where dt is the
    measured time since the last step: then all limits hold exactly."""
    tcp_speed: float = 1.0
    """Highest speed of the tool centre point, and of any other point whose Jacobian is given
    [m/s]."""
    separation: SeparationConfig = field(default_factory=SeparationConfig)
    """Protective distance from people. It lowers the tool-speed cap where `human_distance` is
    given, and limits all links where `distances` to a person are given."""
    constraints: ConstraintConfig | None = None
    """Keeps limits and distances by one quadratic program, in which the null space yields to
    the task; None: each joint brakes by itself before its limits, and no distance is kept."""

    def __post_init__(self):
        for name in ("rate", "tcp_speed"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, but is {getattr(self, name)}")
        for name in ("margin", "delay"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, but is {getattr(self, name)}")
        if not 0 < self.braking <= 1:
            raise ValueError(f"braking must be in (0, 1], but is {self.braking}")
        for name in ("velocity_margin", "jitter"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} must be in [0, 1), but is {getattr(self, name)}")

    @property
    def longest_step(self) -> float:
        """Longest step for which the limits are guaranteed [s]."""
        return 1 / (self.rate * (1 + self.jitter))


@pytree
@dataclass(frozen=True, kw_only=True)
class SafetyState:
    """State of the filter between two steps."""

    velocity: Float[Tensor, "*batch n"]
    """Velocity of the last step [rad/s]."""
    acceleration: Float[Tensor, "*batch n"]
    """Acceleration of the last step [rad/s^2]."""
    position: Float[Tensor, "*batch n"]
    """Predicted joint positions [rad], used while the measurement is invalid."""
    dt: Float[Tensor, "*batch"]
    """Last valid step [s], used while the given one is invalid."""
    fresh: Bool[Tensor, "*batch"]
    """True before the first step after a start."""
    too_fast: Float[Tensor, "*batch"]
    """Time for which a point has been faster than its cap, without interruption [s]."""
    counts: Int[Tensor, "*batch kinds"]
    """Number of steps with each of `INTERVENTIONS`."""

    def count(self, kind: str) -> Int[Tensor, "*batch"]:
        """Number of steps with one kind of intervention."""
        return self.counts[..., _index(kind)]


@pytree
@dataclass(frozen=True, kw_only=True)
class ConstraintReport:
    """Effect of the quadratic program in one step (`ConstrainedVelocity`)."""

    slowed: Float[Tensor, "*batch"]
    """Fraction of the task velocity given up, 0 to 1."""
    violation: Float[Tensor, "*batch"]
    """Excess of the fastest closing speed over the allowed one [m/s]."""
    solved: Bool[Tensor, "*batch"]
    """False: the arm brakes, because the solver needed more steps."""


@pytree
@dataclass(frozen=True, kw_only=True)
class SafetyReport:
    """Interventions of the filter in one step."""

    flags: Bool[Tensor, "*batch kinds"]
    """True for each of `INTERVENTIONS` that changed the command by more than rounding."""
    speed_excess: Float[Tensor, "*batch"]
    """Speed above the cap of the fastest point [m/s]. Above zero where no admissible motion
    keeps the cap: it fell faster than the arm can brake, or a start was too fast."""
    speed_excess_time: Float[Tensor, "*batch"]
    """Time for which the cap has been exceeded, up to the end of this step [s]."""
    constraints: ConstraintReport | None = None
    """Effect of the constraints, where the filter has them."""

    def acted(self, kind: str) -> Bool[Tensor, "*batch"]:
        """True where one kind of intervention changed the command."""
        return self.flags[..., _index(kind)]


def _index(kind: str) -> int:
    if kind not in INTERVENTIONS:
        raise ValueError(f"no intervention {kind!r}; there are {', '.join(INTERVENTIONS)}")
    return INTERVENTIONS.index(kind)
