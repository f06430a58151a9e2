"""Limits of the joints of an arm, and the rule for those that its description lacks."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class MotionLimits:
    """Limits of each joint's motion, float64; velocities and up are symmetric.

    Of whatever else is moved as well, in its own unit in place of radians.

    Some arms lower their velocity limits towards the limits of position, to be able to stop:
    there `velocity_offset` and `deceleration` are given, both or neither, and
    `velocity_bounds` is what holds. Without them it is `velocity` everywhere.
    """

    lower: Float[Tensor, " joints"]
    """Smallest position [rad]."""
    upper: Float[Tensor, " joints"]
    """Largest position [rad]."""
    velocity: Float[Tensor, " joints"]
    """[rad/s]"""
    acceleration: Float[Tensor, " joints"]
    """[rad/s^2]"""
    jerk: Float[Tensor, " joints"]
    """[rad/s^3]"""
    velocity_offset: Float[Tensor, " joints"] | None = None
    """o of `velocity_bounds` [rad/s]; None: the limits of velocity are the same everywhere."""
    deceleration: Float[Tensor, " joints"] | None = None
    """d of `velocity_bounds` [rad/s^2]."""

    def __post_init__(self):
        if (self.velocity_offset is None) != (self.deceleration is None):
            raise ValueError(
                "velocity_offset and deceleration together tell how velocity limits depend on "
                "the position: give both, or neither"
            )

    def slowed[Limits: MotionLimits](self: Limits, fraction: float) -> Limits:
        """The same limits with velocities of at most a fraction of theirs, at each position."""
        o, d = self.velocity_offset, self.deceleration
        return replace(
            self,
            velocity=fraction * self.velocity,
            velocity_offset=None if o is None else fraction * o,
            deceleration=None if d is None else fraction**2 * d,
        )

    def velocity_bounds(
        self, q: Float[Tensor, "*batch joints"]
    ) -> tuple[Float[Tensor, "*batch joints"], Float[Tensor, "*batch joints"]]:
        """Lowest and highest velocity [rad/s] allowed at a position.

        With the distance x to the limit of position ahead it is

            min(velocity, max(0, sqrt(2 d max(0, x)) - o)),

        Franka's formula for the Research 3 ("Robot and interface specifications"): the speed
        from which a joint stops before the limit with the deceleration d, less an offset. Zero
        from o^2/(2 d) before the limit. Differentiable; at a limit the slope is zero, not
        infinite.

        Args:
            q: Joint positions [rad].
        """
        velocity = self.velocity.to(q)
        if self.velocity_offset is None or self.deceleration is None:
            return (-velocity).expand(q.shape), velocity.expand(q.shape)
        o, d = self.velocity_offset.to(q), self.deceleration.to(q)
        ahead = torch.stack([q - self.lower.to(q), self.upper.to(q) - q])
        # Nearer than that nothing is left, and the root has no slope at zero.
        speed = (2 * d * ahead).maximum(o * o).sqrt() - o
        lower, upper = speed.minimum(velocity)
        return -lower, upper


@dataclass(frozen=True, kw_only=True)
class JointLimits(MotionLimits):
    """Limits of each joint of an arm."""

    torque: Float[Tensor, " joints"]
    """[N m]"""
    vintage: str
    """Publisher and date of these numbers: manufacturers revise them."""

    @property
    def middle(self) -> Float[Tensor, " joints"]:
        """Centre of the range of each joint [rad]."""
        return (self.lower + self.upper) / 2

    def contain(self, q: Float[Tensor, "*batch joints"]) -> Bool[Tensor, "*batch"]:
        """True where all joints are within their range, limits included."""
        lower, upper = self.lower.to(q), self.upper.to(q)
        return torch.all((q >= lower) & (q <= upper), dim=-1)


# What a description does not tell, and why these: slower than the slowest joint of any arm
# registered here but Kinova's, and ISO 10218-1's reduced speed for what slides; full speed
# after 0.2 s and full acceleration after 20 ms, both a choice of ours (the Panda's: 0.13 to
# 0.29 s and 2 ms).
DEFAULT_VELOCITY = 1.0  # [rad/s]
DEFAULT_SLIDING_VELOCITY = 0.25  # [m/s]
_SECONDS_TO_FULL_SPEED = 0.2
_SECONDS_TO_FULL_ACCELERATION = 0.02
# A joint without limits turns at most once to either side of zero, as its cables would have it.
_TURN = 2 * math.pi
_COLUMNS = ("lower", "upper", "velocity", "acceleration", "jerk", "torque")


def complete_limits(
    names: Sequence[str],
    kinds: Sequence[str],
    known: Sequence[Mapping[str, float | None]],
    *,
    source: str,
    overrides: Mapping[str, Mapping[str, float]] | None = None,
) -> JointLimits:
    """Limits from what a description tells, the rest by rule.

    Where there is none: velocity 1 rad/s, or 0.25 m/s; acceleration the one that reaches the
    velocity in 0.2 s; jerk the one that reaches the acceleration in 20 ms; torque unlimited; a
    continuous joint one turn to either side. Zero, which some descriptions write for a limit
    of velocity or torque that they do not know, is none.

    Args:
        names: Names of the joints.
        kinds: Kinds of the joints, see `JointKind`.
        known: For each joint, `lower`, `upper`, `velocity`, `acceleration`, `jerk` and `torque`
            [rad, m, s, N m, N], as far as they are known.
        source: Name of the source of these limits.
        overrides: Replacements by joint name; for all joints under `default`.

    Raises:
        ValueError: A joint that slides has no range, a range is empty, or an override names no
            joint or no limit.
    """
    overrides = overrides or {}
    for name, row in overrides.items():
        if name != "default" and name not in names:
            raise ValueError(f"limits are given for {name!r}, but the joints are {names}")
        if wrong := set(row) - set(_COLUMNS):
            raise ValueError(f"{name} has no limit {', '.join(sorted(wrong))}: give {_COLUMNS}")
    table: dict[str, list[float]] = {column: [] for column in _COLUMNS}
    for name, kind, row in zip(names, kinds, known, strict=True):
        given = {**row, **overrides.get("default", {}), **overrides.get(name, {})}
        slides = kind == "prismatic"
        lower, upper = given.get("lower"), given.get("upper")
        if kind == "continuous":
            lower = -_TURN if lower is None else lower
            upper = _TURN if upper is None else upper
        if lower is None or upper is None or not lower < upper:
            raise ValueError(
                f"{source}: joint {name} has the range {lower} to {upper}; give it lower and "
                f"upper by limits=, or in the file {Path(source).stem}.limits.toml next to it"
            )
        velocity = given.get("velocity") or (
            DEFAULT_SLIDING_VELOCITY if slides else DEFAULT_VELOCITY
        )
        acceleration = given.get("acceleration") or velocity / _SECONDS_TO_FULL_SPEED
        jerk = given.get("jerk") or acceleration / _SECONDS_TO_FULL_ACCELERATION
        torque = given.get("torque") or math.inf
        for column, value in zip(
            _COLUMNS, (lower, upper, velocity, acceleration, jerk, torque), strict=True
        ):
            table[column].append(float(value))
    columns = {name: torch.tensor(row, dtype=torch.float64) for name, row in table.items()}
    return JointLimits(vintage=source, **columns)


def read_limits(path: Path) -> dict[str, dict[str, float]]:
    """Limits written in TOML: a table a joint, and `default` for all.

        [default]
        acceleration = 5.0
        [elbow_joint]
        velocity = 2.0

    Raises:
        ValueError: The file is no such TOML.
    """
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{path}: {error}") from None
    for name, row in tables.items():
        if not isinstance(row, dict) or not all(
            isinstance(value, int | float) for value in row.values()
        ):
            raise ValueError(f"{path}: [{name}] must be a table of numbers")
    return tables
