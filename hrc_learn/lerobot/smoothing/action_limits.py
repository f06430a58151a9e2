"""Limits of a robot's actions, from demonstrations, a URDF or a calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Float
from lerobot.utils.constants import ACTION, OBS_STATE

from hrc_learn.controller.motion_filter import MotionFilter
from hrc_learn.demos.read.dataset_folder import open_folder, select_episodes
from hrc_learn.demos.read.frames import read_frames
from hrc_learn.demos.read.unit_evidence import STEP_IN_DEGREES, read_calibration
from hrc_learn.kinematics.description import MOVING
from hrc_learn.kinematics.urdf import read_urdf
from hrc_learn.lerobot.policy.action_encoding import matched_columns
from hrc_learn.store import JsonFile, Positive

_UNUSUAL = 0.999
"""Quantile of the differences used as a limit; single glitches do not count."""
_STILL = 1e-3
"""Least limit of a value, relative to the largest limit of all values: limits must be positive,
even for a value that never moved."""

type Range = tuple[float | None, float | None]
"""Lowest and highest position; None: no limit."""


@dataclass(frozen=True, kw_only=True)
class ActionLimits(JsonFile):
    """Limits of every value of an action, and the state column that measures the value.

    Limits are in the unit of the value.

    Raises:
        ValueError: The lists differ in length, or a range is empty. `load` checks the rest.
    """

    ADVICE: ClassVar[str] = "write the limits of actions again by hrc smooth --limits"

    names: list[str]
    fps: Positive
    """Actions a second."""
    velocity: list[Positive]
    """Largest velocity [1/s]."""
    acceleration: list[Positive]
    """Largest acceleration [1/s^2]."""
    jerk: list[Positive]
    """Largest jerk [1/s^3]."""
    lower: list[float | None]
    """Lowest position; None: no limit."""
    upper: list[float | None]
    """Highest position; None: no limit."""
    state_columns: list[int]
    """Columns of `observation.state` that measure each value; -1: not measured."""

    def __post_init__(self) -> None:
        for key, values in vars(self).items():
            if key != "fps" and (not values or len(values) != len(self.names)):
                raise ValueError(
                    f"{key} must have one entry for each of {', '.join(self.names)}, but is "
                    f"{values!r}"
                )
        if min(self.state_columns) < -1:
            raise ValueError(f"state_columns must be columns or -1, not {self.state_columns}")
        for name, low, high in zip(self.names, *self.positions(), strict=True):
            if not low < high:
                raise ValueError(
                    f"lower of {name} must be below upper, but they are {low:g} and {high:g}"
                )

    def positions(self) -> tuple[Float[np.ndarray, " D"], Float[np.ndarray, " D"]]:
        """Lowest and highest positions; infinite where there is no limit."""
        low, high = (np.array(ends, dtype=np.float64) for ends in (self.lower, self.upper))
        return np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)

    def motion_filter(self, dt: float) -> MotionFilter:
        """Filter that keeps positions, dt [s] apart, within these limits."""
        lower, upper = self.positions()
        rates = ("velocity", "acceleration", "jerk")
        limits = {name: np.array(getattr(self, name), dtype=np.float64) for name in rates}
        return MotionFilter(dt, lower=lower, upper=upper, **limits)

    def within(
        self, ranges: Mapping[str, Range], velocities: Mapping[str, float] | None = None
    ) -> ActionLimits:
        """The same limits, with the limits of some values replaced.

        Args:
            ranges: Lowest and highest positions, by name of the value.
            velocities: Highest velocities by name [1/s]; each applies only if it is lower than
                the present limit.
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


def gathered_limits(
    dataset: str | Path,
    *,
    scale: float = 1.0,
    urdf: str | Path | None = None,
    calibration: str | Path | None = None,
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
    if not 0 < scale < math.inf:
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


def _require_names(limits: ActionLimits, found: set[str], file: str | Path) -> None:
    if found.isdisjoint(limits.names):
        raise ValueError(
            f"{file} names {', '.join(sorted(found))}, but the actions of the dataset are "
            f"{', '.join(limits.names)}"
        )


def demonstrated_limits(dataset: str | Path, scale: float = 1.0) -> ActionLimits:
    """Limits within which a policy moves at most as abruptly as its demonstrators did.

    Limits are the 99.9th percentiles of differences of the actions within episodes. Positions
    are not limited. If the demonstrated velocity is constant, the limit of acceleration lets
    the velocity change from zero to its limit within one action period. If the demonstrated
    acceleration is constant, the limit of jerk lets the acceleration change from zero to its
    limit within one action period.

    Args:
        dataset: LeRobot dataset that the policy was trained on.
        scale: Factor of the demonstrated limits.

    Raises:
        FileNotFoundError: There is no dataset.
        ValueError: The dataset cannot be read, or its actions are constant.
    """
    folder = open_folder(dataset)
    features, fps = folder.features, folder.fps
    if ACTION not in features:
        raise ValueError(f"{dataset} has no actions.")
    entries = select_episodes(folder)
    episodes = [np.asarray(x[ACTION], float) for _, x in read_frames(folder, entries, [ACTION])]
    velocity, acceleration, jerk = (scale * _largest(episodes, k, fps) for k in (1, 2, 3))
    if not velocity.any():
        raise ValueError(f"the actions of {dataset} are constant: name a dataset with motions.")
    # Largest second differences that rounding causes in values of constant velocity.
    rounding = 2 * np.finfo(np.float32).eps * np.abs(np.concatenate(episodes)).max(axis=0)
    steady = acceleration <= scale * fps**2 * rounding
    acceleration = np.where(steady, fps * velocity, acceleration)
    jerk = np.where(steady | (jerk == 0), fps * acceleration, jerk)
    velocity, acceleration, jerk = (
        np.maximum(x, _STILL * x.max()).tolist() for x in (velocity, acceleration, jerk)
    )
    names, width, state = features[ACTION].names, len(velocity), features.get(OBS_STATE)
    states, state_width = (None, 0) if state is None else (state.names, math.prod(state.shape))
    return ActionLimits(
        names=[*names] if names else [f"{ACTION}.{i}" for i in range(width)],
        fps=fps,
        velocity=velocity,
        acceleration=acceleration,
        jerk=jerk,
        lower=[None] * width,
        upper=[None] * width,
        state_columns=matched_columns(names, states, (width, state_width)),
    )


def urdf_limits(
    urdf: str | Path, *, degrees: bool = False
) -> tuple[dict[str, Range], dict[str, float]]:
    """Ranges and velocities of the joints of a URDF, named as LeRobot names their actions.

    A URDF has no limits of acceleration or jerk. Continuous joints have no range. Zeros, which
    many exporters write, do not count as limits.

    Args:
        urdf: File.
        degrees: True if the robot's actions are in degrees; a URDF has radians.

    Returns:
        Lowest and highest positions by `NAME.pos`, and highest velocities by `NAME.pos` [1/s].

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is no URDF, or no joint has limits.
    """
    ranges: dict[str, Range] = {}
    velocities: dict[str, float] = {}
    for joint in read_urdf(Path(urdf)).joints:
        if joint.kind not in MOVING:
            continue
        unit = math.degrees(1) if degrees and joint.kind != "prismatic" else 1.0
        low, high = (unit * (end or 0.0) for end in (joint.lower, joint.upper))
        if low < high:
            ranges[f"{joint.name}.pos"] = (low, high)
        if joint.velocity is not None and joint.velocity > 0:
            velocities[f"{joint.name}.pos"] = unit * joint.velocity
    if not ranges and not velocities:
        raise ValueError(f"{urdf} has no joints with limits")
    return ranges, velocities


def calibrated_ranges(calibration: str | Path, *, degrees: bool = False) -> dict[str, Range]:
    """Ranges through which a robot's motors were moved when LeRobot calibrated the robot.

    Commands of the motor `gripper` are always 0 to 100, even with `degrees`.

    Args:
        calibration: File that LeRobot keeps in `calibration/robots/TYPE/ID.json`.
        degrees: True if the robot is commanded in degrees, LeRobot's `use_degrees`; else in
            percent, -100 to 100.

    Returns:
        Lowest and highest positions by `NAME.pos`.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is no calibration.
    """
    ranges: dict[str, Range] = {}
    for name, (span, _) in read_calibration(Path(calibration)).items():
        end = span / 2 * STEP_IN_DEGREES if degrees else 100.0
        ranges[f"{name}.pos"] = (0.0, 100.0) if name == "gripper" else (-end, end)
    return ranges


def _largest(episodes: Sequence[np.ndarray], order: int, fps: float) -> np.ndarray:
    differences = [np.abs(np.diff(e, n=order, axis=0)) for e in episodes if len(e) > order]
    if not differences:
        raise ValueError("episodes are too short to tell how the actions move.")
    return np.quantile(np.concatenate(differences), _UNUSUAL, axis=0) * fps**order
