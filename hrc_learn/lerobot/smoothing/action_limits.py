"""Limits of a robot's actions, from demonstrations, a URDF or a calibration."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

try:
    from hrc_learn.controller.motion_filter import MotionFilter, MotionState
except ImportError:  # the distribution of this folder has a copy of that file
    from .motion_filter import (  # pyright: ignore[reportMissingImports]
        MotionFilter,
        MotionState,
    )

__all__ = ["ActionLimits", "MotionFilter", "MotionState"]

ACTION, STATE = "action", "observation.state"
_UNUSUAL = 0.999
"""Quantile of the differences used as a limit; single glitches do not count."""
_STILL = 1e-3
"""Limit of a value that never moved, relative to the largest limit; limits must be positive."""
_ENCODER_STEPS = 4095
"""Encoder steps of a turn, for servos that LeRobot calibrates in degrees (Feetech STS,
Dynamixel X).
"""

type Range = tuple[float | None, float | None]
"""Lowest and highest position; None: no limit."""


@dataclass(frozen=True, kw_only=True)
class ActionLimits:
    """Limits of every value of an action, in its unit, and where it is measured.

    Raises:
        ValueError: An entry is missing, of the wrong type, not finite or out of its range.
    """

    names: list[str]
    fps: float
    """Actions a second."""
    velocity: list[float]
    """[1/s]"""
    acceleration: list[float]
    """[1/s^2]"""
    jerk: list[float]
    """[1/s^3]"""
    lower: list[float | None]
    """Lowest position; None: no limit."""
    upper: list[float | None]
    """Highest position; None: no limit."""
    state_columns: list[int]
    """Columns of `observation.state` that measure each value; -1: not measured."""

    def __post_init__(self) -> None:
        named = isinstance(self.names, list) and self.names
        if not (named and all(isinstance(name, str) for name in self.names)):
            raise ValueError(f"names must be a list of texts, but is {self.names!r}")
        if not _is_positive(self.fps):
            raise ValueError(f"fps must be positive and finite, but is {self.fps!r}")
        for key, (fits, needed) in _ENTRIES.items():
            values = getattr(self, key)
            if not isinstance(values, list) or len(values) != len(self.names):
                raise ValueError(
                    f"{key} must have one entry for each of {', '.join(self.names)}, but is "
                    f"{values!r}"
                )
            for name, value in zip(self.names, values, strict=True):
                if not fits(value):
                    raise ValueError(f"{key} of {name} must be {needed}, but is {value!r}")
        for name, low, high in zip(self.names, *self.positions(), strict=True):
            if not low < high:
                raise ValueError(
                    f"lower of {name} must be below upper, but they are {low:g} and {high:g}"
                )

    def positions(self) -> tuple[Float[np.ndarray, " D"], Float[np.ndarray, " D"]]:
        """Lowest and highest positions; infinite where there is no limit."""
        low = [-math.inf if x is None else x for x in self.lower]
        high = [math.inf if x is None else x for x in self.upper]
        return np.array(low, dtype=np.float64), np.array(high, dtype=np.float64)

    def motion_filter(self, dt: float) -> MotionFilter:
        """Filter that keeps positions, dt [s] apart, within these limits."""
        lower, upper = self.positions()
        return MotionFilter(
            dt,
            velocity=np.array(self.velocity, dtype=np.float64),
            acceleration=np.array(self.acceleration, dtype=np.float64),
            jerk=np.array(self.jerk, dtype=np.float64),
            lower=lower,
            upper=upper,
        )

    def within(
        self, ranges: Mapping[str, Range], velocities: Mapping[str, float] | None = None
    ) -> ActionLimits:
        """The same with other limits for the values that are named.

        Args:
            ranges: Lowest and highest positions.
            velocities: Highest velocities, where lower than those of today [1/s].
        """
        pairs = [
            ranges.get(name, (low, high))
            for name, low, high in zip(self.names, self.lower, self.upper, strict=True)
        ]
        velocity = [
            min(v, (velocities or {}).get(name, math.inf))
            for name, v in zip(self.names, self.velocity, strict=True)
        ]
        return replace(
            self, lower=[p[0] for p in pairs], upper=[p[1] for p in pairs], velocity=velocity
        )

    def save(self, path: Path) -> None:
        """Write them as JSON; the file is whole or as it was."""
        write_json(path, asdict(self))

    @classmethod
    def load(cls, path: Path) -> ActionLimits:
        """Read a file that `save` wrote.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: It holds no limits.
        """
        content, keys = read_json(path), [f.name for f in fields(cls)]
        if not isinstance(content, dict) or content.keys() != {*keys}:
            raise ValueError(
                f"{path} holds no limits of actions: its keys must be {', '.join(keys)}"
            )
        try:
            return cls(**content)
        except ValueError as error:
            raise ValueError(f"{path} holds no limits of actions: {error}") from None


def _is_number(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    # Whole numbers of JSON have no bound; no robot has a limit beyond this one.
    return abs(value) < 1e300


def _is_positive(value: Any) -> bool:
    return _is_number(value) and value > 0


def _is_number_or_none(value: object) -> bool:
    return value is None or _is_number(value)


_ENTRIES: dict[str, tuple[Callable[[Any], bool], str]] = {
    "velocity": (_is_positive, "positive and finite"),
    "acceleration": (_is_positive, "positive and finite"),
    "jerk": (_is_positive, "positive and finite"),
    "lower": (_is_number_or_none, "finite or null"),
    "upper": (_is_number_or_none, "finite or null"),
    "state_columns": (lambda x: type(x) is int and x >= -1, "a column, or -1"),
}
"""Entries for each value of an action: what they must be, as a check and in words."""


def gathered_limits(
    dataset: Path,
    *,
    scale: float = 1.0,
    urdf: Path | None = None,
    calibration: Path | None = None,
    degrees: bool = False,
) -> ActionLimits:
    """Limits of the demonstrations, with limits of position and velocity from other sources.

    Args:
        dataset: LeRobot dataset, as in `demonstrated_limits`.
        scale: Factor of the demonstrated limits.
        urdf: URDF file, as in `urdf_limits`; None: there is none.
        calibration: Calibration file, as in `calibrated_ranges`; its ranges take precedence
            over the URDF's.
        degrees: True if the robot's actions are in degrees.

    Raises:
        FileNotFoundError: A file is missing.
        ValueError: A file cannot be read, or has no name in common with the dataset.
    """
    if not scale > 0:
        raise ValueError(f"scale must be positive, but is {scale}")
    limits = demonstrated_limits(dataset, scale)
    if urdf is not None:
        ranges, velocities = urdf_limits(urdf, degrees=degrees)
        _require_names(limits, {*ranges, *velocities}, urdf)
        limits = limits.within(ranges, velocities)
    if calibration is not None:
        ranges = calibrated_ranges(calibration, degrees=degrees)
        _require_names(limits, set(ranges), calibration)
        missing = [n for n in limits.names if n.endswith(".pos") and n not in ranges]
        others = [n for n in ranges if n not in limits.names]
        if missing and others:
            raise ValueError(
                f"{calibration} has {', '.join(others)} in place of {', '.join(missing)}: "
                "it is the calibration of another robot"
            )
        limits = limits.within(ranges)
    return limits


def _require_names(limits: ActionLimits, found: set[str], file: Path) -> None:
    if found.isdisjoint(limits.names):
        raise ValueError(
            f"{file} names {', '.join(sorted(found))}, but the actions of the dataset are "
            f"{', '.join(limits.names)}"
        )


def demonstrated_limits(dataset: Path, scale: float = 1.0) -> ActionLimits:
    """Limits within which the policy moves at most as abruptly as its demonstrators did.

    Limits are the 99.9th percentiles of differences of the actions within episodes, without
    limits of position.

    Args:
        dataset: LeRobot dataset that the policy was trained on.
        scale: Factor of the demonstrated limits.

    Raises:
        FileNotFoundError: There is no dataset.
        ValueError: It cannot be read, or its actions are constant.
    """
    info = read_json(dataset / "meta" / "info.json")
    features, fps = info["features"], float(info["fps"])
    if ACTION not in features:
        raise ValueError(f"{dataset} has no actions.")
    episodes = _read_actions(dataset)
    names, width = _names(features, ACTION), episodes[0].shape[-1]
    names = names or [f"{ACTION}.{i}" for i in range(width)]
    limits = [scale * _largest(episodes, order, fps) for order in (1, 2, 3)]
    if not all((limit > 0).any() for limit in limits):
        raise ValueError(f"the actions of {dataset} hold still: there is no motion to go by.")
    velocity, acceleration, jerk = (
        np.maximum(limit, _STILL * limit.max()).tolist() for limit in limits
    )
    return ActionLimits(
        names=names,
        fps=fps,
        velocity=velocity,
        acceleration=acceleration,
        jerk=jerk,
        lower=[None] * width,
        upper=[None] * width,
        state_columns=_state_columns(features, names, width),
    )


def urdf_limits(
    urdf: Path, *, degrees: bool = False
) -> tuple[dict[str, Range], dict[str, float]]:
    """Ranges and velocities of the joints of a URDF, named as LeRobot names their actions.

    A URDF has no limits of acceleration or jerk: those are the demonstrators'. Joints that turn
    for ever have no range; values of zero, which many exporters write, are no limits.

    Args:
        urdf: File.
        degrees: True if the robot's actions are in degrees; a URDF has radians.

    Returns:
        Lowest and highest position of `NAME.pos`, and its velocity.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no URDF.
    """
    try:
        root = ElementTree.fromstring(urdf.read_text(encoding="utf-8"))
    except ElementTree.ParseError as error:
        raise ValueError(f"{urdf} is not a URDF: {error}") from None
    if root.tag != "robot":
        raise ValueError(f"{urdf} is not a URDF: it describes a {root.tag}, not a robot")
    ranges: dict[str, Range] = {}
    velocities: dict[str, float] = {}
    for joint in root.iter("joint"):
        kind, limit = joint.get("type"), joint.find("limit")
        if limit is None or kind not in ("revolute", "continuous", "prismatic"):
            continue
        unit = math.degrees(1) if degrees and kind != "prismatic" else 1.0
        name = f"{joint.get('name')}.pos"
        low, high = (unit * float(limit.get(side, 0)) for side in ("lower", "upper"))
        if kind != "continuous" and low < high:
            ranges[name] = (low, high)
        if (velocity := unit * float(limit.get("velocity", 0))) > 0:
            velocities[name] = velocity
    if not ranges and not velocities:
        raise ValueError(f"{urdf} has no joints with limits")
    return ranges, velocities


def calibrated_ranges(calibration: Path, *, degrees: bool = False) -> dict[str, Range]:
    """Ranges that a robot's motors were moved through when LeRobot calibrated it.

    Commands of the motor `gripper` are 0 to 100 in either case.

    Args:
        calibration: File that LeRobot keeps in `calibration/robots/TYPE/ID.json`.
        degrees: True if the robot is commanded in degrees, LeRobot's `use_degrees`; else in
            percent, -100 to 100.

    Returns:
        Lowest and highest position of `NAME.pos`.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no calibration.
    """
    content = read_json(calibration)
    ranges: dict[str, Range] = {}
    for name, motor in content.items() if isinstance(content, dict) else ():
        try:
            half = (float(motor["range_max"]) - float(motor["range_min"])) / 2
        except (TypeError, KeyError, ValueError):
            half = 0.0
        if half <= 0:
            raise ValueError(
                f"{calibration} is no calibration of LeRobot: {name} has no range_min below a "
                "range_max"
            )
        if name == "gripper":
            ranges[f"{name}.pos"] = (0.0, 100.0)
        else:
            end = half * 360 / _ENCODER_STEPS if degrees else 100.0
            ranges[f"{name}.pos"] = (-end, end)
    if not ranges:
        raise ValueError(f"{calibration} is no calibration of LeRobot: it has no motors")
    return ranges


def read_json(path: Path) -> Any:
    """Content of a file.

    Raises:
        FileNotFoundError: There is none.
        ValueError: It is damaged.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no {path}")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is damaged: {error}") from None


def write_json(path: Path, content: Any) -> None:
    """Write a file that is complete or as it was."""
    new = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with new.open("w", encoding="utf-8") as file:
            json.dump(content, file, indent=2)
            file.flush()
            os.fsync(file.fileno())
        new.replace(path)
    finally:
        new.unlink(missing_ok=True)


def _read_actions(folder: Path) -> list[Float[np.ndarray, "frames D"]]:
    """Actions of each episode, of all versions of the format that keep them in Parquet."""
    from pyarrow import ArrowInvalid
    from pyarrow.dataset import dataset

    files = [str(file) for file in sorted((folder / "data").glob("chunk-*/*.parquet"))]
    if not files:
        raise ValueError(f"{folder} has no episodes.")
    try:
        table = dataset(files, format="parquet").to_table(columns=["episode_index", ACTION])
    except (ArrowInvalid, OSError) as error:
        raise ValueError(f"{folder}: the actions cannot be read: {error}") from None
    index = table["episode_index"].to_numpy()
    actions = np.array(table[ACTION].to_pylist(), dtype=np.float64).reshape(len(index), -1)
    return [actions[index == k] for k in np.unique(index)]


def _largest(episodes: Sequence[np.ndarray], order: int, fps: float) -> np.ndarray:
    differences = [np.abs(np.diff(e, n=order, axis=0)) for e in episodes if len(e) > order]
    if not differences:
        raise ValueError("episodes are too short to tell how the actions move.")
    return np.quantile(np.concatenate(differences), _UNUSUAL, axis=0) * fps**order


def _names(features: Mapping[str, Any], key: str) -> list[str]:
    """Names in a feature's metadata: flat, nested or in a dict; none if their number does not
    match.
    """
    names = _flat(features[key].get("names") or [])
    return names if len(names) == math.prod(features[key]["shape"]) else []


def _flat(names: Any) -> list[str]:
    if isinstance(names, dict):
        names = list(names.values())
    if not isinstance(names, list | tuple):
        return [str(names)]
    return [name for part in names for name in _flat(part)]


def _state_columns(features: Mapping[str, Any], names: list[str], width: int) -> list[int]:
    """State column of each action value, matched by name; by index if neither has names."""
    if STATE not in features:
        return [-1] * width
    states = _names(features, STATE)
    if not states and not _names(features, ACTION):
        return list(range(width)) if features[STATE]["shape"][0] == width else [-1] * width
    index = {name: i for i, name in enumerate(states)}
    return [index.get(name, -1) for name in names]
