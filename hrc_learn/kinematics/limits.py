"""Joint limits of an arm, and defaults for limits that its URDF or MJCF does not give."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hrc_learn.store import read_toml


@dataclass(frozen=True, kw_only=True)
class MotionLimits:
    """Limits of each joint's motion, float64.

    Limits of velocity, acceleration and jerk are the same in both directions. The class also
    describes axes other than joints; their unit of position then replaces the radian.

    Some arms reduce the velocity limit near a position limit, so that the joint can stop in
    time. For these arms, set both `velocity_offset` and `deceleration`; `velocity_bounds`
    then returns the reduced limits. Otherwise, set neither: `velocity` is the limit at every
    position.
    """

    lower: Float[Tensor, " joints"]
    """Smallest position [rad]."""
    upper: Float[Tensor, " joints"]
    """Largest position [rad]."""
    velocity: Float[Tensor, " joints"]
    """Largest velocity [rad/s]."""
    acceleration: Float[Tensor, " joints"]
    """Largest acceleration [rad/s^2]."""
    jerk: Float[Tensor, " joints"]
    """Largest jerk [rad/s^3]."""
    velocity_offset: Float[Tensor, " joints"] | None = None
    """Offset o in `velocity_bounds` [rad/s]; None if velocity limits do not depend on the
    position."""
    deceleration: Float[Tensor, " joints"] | None = None
    """Deceleration d in `velocity_bounds` [rad/s^2]."""

    def __post_init__(self):
        if (self.velocity_offset is None) != (self.deceleration is None):
            text = "velocity_offset and deceleration define position-dependent velocity limits:"
            raise ValueError(f"{text} give both, or neither")

    def slowed[Limits: MotionLimits](self: Limits, fraction: float) -> Limits:
        """Limits with the velocity limit multiplied by a fraction at every position."""
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

        Let x be the distance to the position limit in the direction of motion. The highest
        speed in this direction is

            min(velocity, max(0, sqrt(2 d max(0, x)) - o)).

        This is Franka's formula for the Research 3 ("Robot and interface specifications"). The
        root is the speed from which the deceleration d stops the joint at the limit; the offset
        o reduces it. The speed is zero within a distance of o^2/(2 d) from the limit. The
        bounds are differentiable: at a limit their slope is zero, not infinite.

        Args:
            q: Joint positions [rad].
        """
        velocity = self.velocity.to(q)
        if self.velocity_offset is None or self.deceleration is None:
            return (-velocity).expand(q.shape), velocity.expand(q.shape)
        o, d = self.velocity_offset.to(q), self.deceleration.to(q)
        ahead = torch.stack([q - self.lower.to(q), self.upper.to(q) - q])
        # At 2 d x <= o^2 the allowed speed is zero. The maximum also keeps the root away from
        # zero, where its slope would be infinite.
        speed = (2 * d * ahead).maximum(o * o).sqrt() - o
        lower, upper = speed.minimum(velocity)
        return -lower, upper


@dataclass(frozen=True, kw_only=True)
class JointLimits(MotionLimits):
    """Limits of each joint of an arm."""

    torque: Float[Tensor, " joints"]
    """Largest torque [N m]."""
    vintage: str
    """Publisher and date of these values, because manufacturers revise them."""

    @property
    def middle(self) -> Float[Tensor, " joints"]:
        """Centre of the range of each joint [rad]."""
        return (self.lower + self.upper) / 2

    def contain(self, q: Float[Tensor, "*batch joints"]) -> Bool[Tensor, "*batch"]:
        """True where all joints are within their limits or at them."""
        lower, upper = self.lower.to(q), self.upper.to(q)
        return torch.all((q >= lower) & (q <= upper), dim=-1)

    def excess(
        self,
        path: Float[Tensor, "*batch T joints"],
        dt: float,
        kinds: Sequence[str] = ("velocity", "acceleration", "jerk"),
    ) -> tuple[Float[Tensor, "*batch"], Int[Tensor, "*batch"]]:
        """Factor by which a path is too fast, and the limit that it exceeds most.

        Slowed down by this factor, the path keeps all limits. If the factor is below 1, the
        path keeps them already.

        Args:
            path: Joint positions [rad]. A derivative for which the path has too few samples
                counts as zero.
            dt: Time between samples [s].
            kinds: Limits to keep: velocity, acceleration, jerk, or the first of these.

        Returns:
            The factor, and the number of the limit. Limits of the first kind are numbered
            first, for all joints, then limits of the second kind, and so on.
        """
        factors = []
        for order, kind in enumerate(kinds, 1):
            rate = torch.diff(path, n=order, dim=-2).abs() / dt**order
            rate = torch.nn.functional.pad(rate, (0, 0, 1, 0))  # short paths have no rows
            factors.append((rate / getattr(self, kind)).amax(-2) ** (1 / order))
        worst, at = torch.cat(factors, -1).max(-1)
        return worst, at


# Defaults for limits that a description does not give. The default velocity of revolute joints
# does not exceed the limit of any joint of the registered arms, except Kinova's Jaco. The
# default velocity of prismatic joints is the reduced speed of ISO 10218-1:2025. We chose the
# times to full speed and to full acceleration; the Panda's times are 0.13 to 0.29 s and 2 ms.
DEFAULT_VELOCITY = 1.0  # [rad/s]
DEFAULT_SLIDING_VELOCITY = 0.25  # [m/s]
_SECONDS_TO_FULL_SPEED = 0.2
_SECONDS_TO_FULL_ACCELERATION = 0.02
# A joint without position limits turns at most once in each direction, to protect cables.
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
    """Joint limits from a description, completed with defaults.

    The default velocity limit is 1 rad/s, or 0.25 m/s for a prismatic joint. The default
    acceleration reaches the velocity limit in 0.2 s, and the default jerk reaches the
    acceleration limit in 20 ms. The default torque is unlimited. A continuous joint may turn
    once in each direction. A torque limit of zero counts as missing, because many descriptions
    write zero for an unknown limit.

    Args:
        names: Names of the joints.
        kinds: Kinds of the joints, see `JointKind`.
        known: For each joint, `lower`, `upper`, `velocity`, `acceleration`, `jerk` and `torque`
            [rad, m, s, N m, N]; None or no entry if unknown.
        source: Name or path of the description, for error messages and `JointLimits.vintage`.
        overrides: For each joint name, the limits that replace known limits. Limits under
            `default` apply to all joints.

    Raises:
        ValueError: A revolute or prismatic joint has no range, a range is empty, a limit of
            motion is not positive and finite, or an override names an unknown joint or limit.
    """
    overrides = overrides or {}
    for name, row in overrides.items():
        if name != "default" and name not in names:
            raise ValueError(f"limits are given for {name!r}, but the joints are {names}")
        if wrong := set(row) - set(_COLUMNS):
            raise ValueError(
                f"unknown limits of {name}: {', '.join(sorted(wrong))}; known are {_COLUMNS}"
            )
    advice = f"set it with limits=, or in {Path(source).stem}.limits.toml in the same folder"
    table: dict[str, list[float]] = {column: [] for column in _COLUMNS}
    for name, kind, row in zip(names, kinds, known, strict=True):
        given = {**row, **overrides.get("default", {}), **overrides.get(name, {})}
        given = {key: value for key, value in given.items() if value is not None}
        turn = _TURN if kind == "continuous" else math.nan
        full = {"lower": -turn, "upper": turn, **given}
        if not -math.inf < full["lower"] < full["upper"] < math.inf:
            text = f"{source}: joint {name} has the range {given.get('lower')} to"
            raise ValueError(f"{text} {given.get('upper')}; {advice}")
        slides = kind == "prismatic"
        full.setdefault("velocity", DEFAULT_SLIDING_VELOCITY if slides else DEFAULT_VELOCITY)
        full.setdefault("acceleration", full["velocity"] / _SECONDS_TO_FULL_SPEED)
        full.setdefault("jerk", full["acceleration"] / _SECONDS_TO_FULL_ACCELERATION)
        full["torque"] = given.get("torque") or math.inf
        for column in ("velocity", "acceleration", "jerk", "torque"):
            unlimited = column == "torque" and full[column] == math.inf
            if not (0 < full[column] < math.inf or unlimited):
                text = f"{source}: joint {name} has the {column} limit {full[column]:g}, which"
                raise ValueError(f"{text} is not positive and finite; {advice}")
        for column in _COLUMNS:
            table[column].append(float(full[column]))
    columns = {name: torch.tensor(row, dtype=torch.float64) for name, row in table.items()}
    return JointLimits(vintage=source, **columns)


def read_limits(path: Path) -> dict[str, dict[str, float]]:
    """Read limits from a TOML file with one table per joint; `default` applies to all joints.

        [default]
        acceleration = 5.0
        [elbow_joint]
        velocity = 2.0

    Raises:
        ValueError: The file is not valid TOML, or a table holds values other than numbers.
    """
    limits = {}
    for name, row in read_toml(path).items():
        if not isinstance(row, dict) or not all(type(x) in (int, float) for x in row.values()):
            raise ValueError(f"{path}: [{name}] must be a table of numbers")
        limits[name] = {key: float(value) for key, value in row.items()}
    return limits
