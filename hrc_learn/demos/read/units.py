"""Units of a dataset's values: given by the caller, declared, or guessed from their size.

LeRobot declares no units, and radians, degrees, encoder ticks and -100..100 all occur.
"""

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.read.columns import ColumnSelection
from hrc_learn.demos.read.dataset_folder import EpisodeEntry
from hrc_learn.demos.read.metadata import SIDECAR_PATH
from hrc_learn.demos.read.quantities import ORIENTATION_ROLES, ROLES, is_hand

_DIMENSIONS: dict[str, dict[str, float]] = {
    "angle": {"rad": 1.0, "deg": math.pi / 180, "tick": 2 * math.pi / 4096},
    "angular velocity": {"rad/s": 1.0, "deg/s": math.pi / 180, "tick/s": 2 * math.pi / 4096},
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "torque": {"N m": 1.0, "N mm": 1e-3},
    "pixels": {"px": 1.0},
    "ratio": {"1": 1.0, "%": 1e-2},
}
"""Dimension -> unit -> factor to the SI unit. A tick is 1/4096 of a turn, as the encoders of
hobby servos count; the position of their zero is unknown."""

# Two turns: wrists turn further than one, and no demonstration stays within 13 degrees.
_JOINT_LIMITS = {"rad": 4 * math.pi, "deg": 400.0}
# Beyond the reach of any arm on a fixed base.
_REACH = {"m": 5.0, "cm": 500.0}
# One turn and some noise; two turns for an unwrapped vector.
_ROTATION_LIMIT = {
    "euler_xyz": 2 * math.pi + 0.1,
    "euler_intrinsic_xyz": 2 * math.pi + 0.1,
    "rotation_vector": 4 * math.pi,
}
# Largest fraction of a range, allowing for noise, and widest opening of a gripper [m].
_FINGER_RATIO, _GRIPPER_RATIO, _PERCENT, _WIDEST_GRIPPER = 1.05, 2.0, 105.0, 0.2
_FOLLOWERS = {
    "joint_velocity": "joint_position",
    "command_position": "joint_position",
    "command_velocity": "joint_position",
}
"""Quantity -> quantity whose unit it takes over if nothing is declared."""
_GUESSABLE = ("joint_position", "command_position", "position", "gripper", *_ROTATION_LIMIT)


@dataclass(frozen=True, kw_only=True)
class UnitDecision:
    """Unit of one quantity on disk, and the evidence for it."""

    role: str
    unit: str
    """Unit of all components, or of most of them."""
    units: tuple[str, ...] = ()
    """Unit of each component if they differ: an arm in degrees, its fingers from 0 to 1."""
    note: str | None = None
    """The guess and how to overrule it; None if nothing was guessed."""
    converts: bool = False
    """True if a guess changes the values."""
    confidence: float = 1.0
    """Confidence, 0 to 1."""
    evidence: str = ""
    """Evidence for a guess, in words."""

    @property
    def factor(self) -> float | Float64[np.ndarray, " components"]:
        """Factor from values on disk to SI values: one number, or one per component."""
        if not self.units:
            return unit_factor(self.role, self.unit)
        return np.array([unit_factor(self.role, unit) for unit in self.units])

    def unit_of(self, component: int) -> str:
        """Unit of one component."""
        return self.units[component] if self.units else self.unit


def unit_factor(role: str, unit: str) -> float:
    """Factor from a unit to the SI unit of a quantity.

    Raises:
        DatasetError: The quantity is unknown, or does not come in this unit.
    """
    if role not in ROLES:
        raise DatasetError(
            f"units are given for the unknown quantity {role!r}; known are {', '.join(ROLES)}"
        )
    options = units_of(role)
    if unit not in options:
        raise DatasetError(
            f"{role} does not come in {unit!r}; known units are {', '.join(options)}"
        )
    return options[unit]


def units_of(role: str) -> dict[str, float]:
    """Units of a quantity with their factors."""
    own = ROLES[role].unit
    options = next(units for units in _DIMENSIONS.values() if own in units)
    if role in ("gripper", "joint_position", "command_position"):
        # Grippers and hands give a fraction of their opening, hobby arms of their range.
        options = options | _DIMENSIONS["ratio"]
    return options


def guessed_from_values(roles: Iterable[str], stated: Collection[str]) -> list[str]:
    """Quantities whose unit can only be guessed from the size of their values."""
    return [role for role in roles if role in _GUESSABLE and role not in stated]


def decide_units(
    largest: Mapping[str, float | Sequence[float]],
    declared: Mapping[str, str | Sequence[str]],
    given: Mapping[str, str],
    frame_step: float = 1.0,
    hands: Mapping[str, Sequence[bool]] | None = None,
) -> dict[str, UnitDecision]:
    """Decide on a unit for every quantity.

    Args:
        largest: Usual largest absolute value on disk by role: of all components, or of each.
        declared: Units by role, or of each component, from the sidecar.
        given: Units by role from the caller, which take precedence.
        frame_step: Step of the true stamps on disk, as a multiple of the nominal period [s].
        hands: Role -> True for each finger or gripper; no hands if not given.

    Raises:
        DatasetError: A unit is unknown, or does not fit its quantity.
    """
    for role, unit in given.items():
        unit_factor(role, unit)
    for role, unit in declared.items():
        for one in (unit,) if isinstance(unit, str) else unit:
            try:
                unit_factor(role, one)
            except DatasetError as error:
                raise DatasetError(
                    str(error), file=SIDECAR_PATH, key=f"units.{role}"
                ) from error
    stated = {**declared, **given}
    decisions: dict[str, UnitDecision] = {}
    for role in sorted(largest, key=lambda role: role in _FOLLOWERS):
        if role in stated:
            decisions[role] = _stated(role, stated[role])
        elif (leader := decisions.get(_FOLLOWERS.get(role, ""))) is not None:
            decisions[role] = _following(role, leader)
        elif role == "time":
            decisions[role] = _guess_time(frame_step)
        elif role == "gripper":
            decisions[role] = _guess_gripper(float(np.max(largest[role])))
        elif role in _GUESSABLE:
            peaks = np.atleast_1d(np.asarray(largest[role], float))
            decisions[role] = _guess(role, peaks, (hands or {}).get(role, ()))
        else:
            decisions[role] = UnitDecision(role=role, unit=ROLES[role].unit)
    return decisions


def _stated(role: str, unit: str | Sequence[str]) -> UnitDecision:
    if isinstance(unit, str):
        return UnitDecision(role=role, unit=unit)
    most = max(dict.fromkeys(unit), key=list(unit).count)
    return UnitDecision(role=role, unit=most, units=tuple(unit) if len({*unit}) > 1 else ())


def _following(role: str, leader: UnitDecision) -> UnitDecision:
    """Decision for the unit of the leading quantity, if this quantity comes in it."""
    velocity = role.endswith("velocity")
    unit = leader.unit + "/s" if velocity else leader.unit
    # A position given as a fraction of its range does not tell the unit of the velocity.
    followed = leader.unit != "1" and unit in units_of(role)
    return UnitDecision(
        role=role,
        unit=unit if followed else ROLES[role].unit,
        units=() if velocity else leader.units,
        confidence=leader.confidence,
        evidence=f"that of {leader.role}" if followed or not velocity else "",
    )


def _guess(role: str, peaks: np.ndarray, hands: Sequence[bool]) -> UnitDecision:
    """Guess from the largest value of each component."""
    is_arm = np.ones(len(peaks), bool)
    if len(hands) == len(peaks):
        is_arm = ~np.asarray(hands, bool)
    largest = float(peaks[is_arm].max() if is_arm.any() else peaks.max())
    unit, confidence = guess_unit(role, largest), 0.95
    units: tuple[str, ...] = ()
    if role in ("joint_position", "command_position"):
        units = tuple(
            unit if arm else _finger_unit(float(peak), unit)
            for peak, arm in zip(peaks, is_arm, strict=True)
        )
        # Radians beyond a turn are rare; small values in degrees are not.
        confidence = 0.95 if largest <= 2 * math.pi else 0.8
    caution = {
        "deg": " (LeRobot's -100..100 look alike)" if role not in _ROTATION_LIMIT else "",
        "tick": " (1/4096 of a turn, zero unknown)",
    }.get(unit, "")
    if caution:
        # A range of exactly 100 is typical of normalised values.
        confidence = 0.5 if 95 <= largest <= 101 else 0.8
    others = sorted({*units} - {unit})
    fingers = f", fingers for {', '.join(others)}" if others else ""
    return UnitDecision(
        role=role,
        unit=unit,
        units=units if others else (),
        note=_note(role, f"values usually reach {largest:.4g}", f"{unit}{caution}{fingers}"),
        converts=unit != ROLES[role].unit,
        confidence=confidence,
        evidence=f"values usually reach {largest:.3g}",
    )


def _note(role: str, evidence: str, unit: str) -> str:
    return (
        f"{role}: no unit declared, {evidence}: taken for {unit}; "
        f"overrule with units={{{role!r}: ...}}"
    )


def guess_unit(role: str, largest: float) -> str:
    """Unit that usually gives values of this size."""
    if role == "position":
        return next((unit for unit, limit in _REACH.items() if largest <= limit), "mm")
    if role in _ROTATION_LIMIT:
        return "rad" if largest <= _ROTATION_LIMIT[role] else "deg"
    return next((unit for unit, limit in _JOINT_LIMITS.items() if largest <= limit), "tick")


def _finger_unit(peak: float, arm: str) -> str:
    """Unit of a finger by its largest value and the unit of the arm."""
    if peak <= _FINGER_RATIO:
        return "1"
    if peak <= _JOINT_LIMITS["rad"]:
        return "rad"
    return "%" if peak <= _PERCENT and arm != "deg" else arm


def _guess_gripper(largest: float) -> UnitDecision:
    limits = {"m": _WIDEST_GRIPPER, "1": _GRIPPER_RATIO, "%": _PERCENT, "mm": math.inf}
    unit = next(unit for unit, limit in limits.items() if largest <= limit)
    converts = unit_factor("gripper", unit) != 1
    note = _note("gripper", f"values usually reach {largest:.4g}", unit)
    return UnitDecision(
        role="gripper",
        unit=unit,
        note=note if converts else None,
        converts=converts,
        confidence=0.8,
        evidence=f"values usually reach {largest:.3g}",
    )


def _guess_time(frame_step: float) -> UnitDecision:
    """Unit of the stamps: the one that brings their step closest to the frame rate."""
    sizes = _DIMENSIONS["time"]
    # The bound avoids the logarithm of a step of zero.
    off = {unit: abs(math.log10(max(frame_step, 1e-3) * size)) for unit, size in sizes.items()}
    unit = min(off, key=off.__getitem__)
    if unit == "s":
        return UnitDecision(role="time", unit=unit)
    note = _note("time", f"steps are {frame_step:.3g} times 1/fps", unit)
    return UnitDecision(role="time", unit=unit, note=note, converts=True)


Quantities = dict[str, Float64[np.ndarray, "_frames _components"]]
"""Role -> values during one episode, in the units on disk."""
Peaks = dict[str, Float64[np.ndarray, " _components"]]
"""Role -> 99.5 % quantile of the absolute values of each component in one episode."""
# Frames that suffice to estimate the size of an episode's values.
_SAMPLED_FRAMES = 1000


def usual_peaks(quantities: Quantities, roles: Sequence[str]) -> Peaks:
    """Size of the values of each component in one episode, robust against single outliers."""
    peaks: Peaks = {}
    for role in roles:
        values = quantities[role]
        sizes = np.abs(values[:: 1 + len(values) // _SAMPLED_FRAMES])
        sizes[~np.isfinite(sizes)] = 0.0
        if len(sizes):
            place = int(0.995 * (len(sizes) - 1))
            peaks[role] = np.partition(sizes, place, axis=0)[place]
    return peaks


def units_from_episodes(
    selections: Mapping[str, ColumnSelection],
    episodes: Iterable[tuple[EpisodeEntry, Quantities]],
    fps: float,
    declared: Mapping[str, str | Sequence[str]],
    given: Mapping[str, str],
    sample: Collection[int] | None = None,
) -> tuple[dict[str, UnitDecision], list[DatasetError]]:
    """Unit of each quantity, from the size of its values where it must be guessed.

    The size of a component is the median over episodes of its peak in each, so that no single
    frame or episode decides.

    Args:
        selections: Columns of the quantities.
        episodes: Episodes in the units on disk.
        fps: Frame rate [1/s].
        declared: Units from the sidecar, as in `decide_units`.
        given: Units from the caller, which take precedence.
        sample: Indices of the episodes that decide; None for all.

    Returns:
        The decisions, and the episodes and columns that contradict them.

    Raises:
        DatasetError: A unit is unknown, or does not fit its quantity.
    """
    guessed = guessed_from_values(selections, {*declared, *given})
    steps: list[float] = []
    peaks: list[tuple[EpisodeEntry, Peaks]] = []
    for entry, quantities in episodes:
        peaks.append((entry, usual_peaks(quantities, [r for r in guessed if r in quantities])))
        time = quantities.get("time", np.empty((0, 1)))
        if len(time) > 1:
            # As a multiple of the nominal period.
            steps.append(float(np.nanmedian(np.diff(time[:, 0]))) * fps)
    usual: dict[str, float | Sequence[float]] = dict.fromkeys(selections, 0.0)
    deciding = [p for entry, p in peaks if sample is None or entry.index in sample]
    deciding = deciding or [p for _, p in peaks]
    for role in guessed:
        known = [p[role] for p in deciding if role in p]
        if known:
            usual[role] = np.median(known, axis=0).tolist()
    hands = {
        role: [is_hand(label) for label in selection.labels]
        for role, selection in selections.items()
    }
    step = float(np.median(steps)) if steps else 1.0
    decisions = decide_units(usual, declared, given, step, hands)
    faults = [
        fault
        for role in guessed
        if isinstance(usual[role], list)
        for fault in _contradictions(selections[role], usual[role], decisions[role], peaks)
    ]
    return decisions, faults


_DEGREES = math.log(180 / math.pi)
_NEAR = math.log(2.5)
"""Logarithmic distance from the factor 57.3 within which sizes indicate degrees."""


def _contradictions(
    selection: ColumnSelection,
    usual: float | Sequence[float],
    decision: UnitDecision,
    peaks: Sequence[tuple[EpisodeEntry, Peaks]],
) -> Iterator[DatasetError]:
    """Episodes about 57.3 times as large or small as the others: degrees among radians."""
    role, size = selection.role, np.asarray(usual)
    if role not in ("joint_position", "command_position", *ORIENTATION_ROLES):
        return
    # Components that hardly move have no size to compare, and fractions are no angles.
    angles = np.array([decision.unit_of(i) for i in range(len(size))]) != "1"
    moving = (size > 1e-2) & angles
    known = [(entry, p[role]) for entry, p in peaks if role in p and len(p[role]) == len(size)]
    if not moving.any() or not known:
        return
    reached = np.stack([own[moving] for _, own in known])
    ratios = np.median(np.log(np.maximum(reached, 1e-9) / size[moving]), axis=1)
    for (entry, _), ratio in zip(known, ratios.tolist(), strict=True):
        if abs(abs(ratio) - _DEGREES) < _NEAR:
            seems = "deg" if ratio > 0 else "rad"
            yield entry.error(
                f"{role} is about {math.exp(abs(ratio)):.0f} times as "
                f"{'large' if seems == 'deg' else 'small'} as in the other episodes: {seems} "
                f"among {decision.unit}? Leave the episode out, or record it again",
                key=selection.column_name(int(np.flatnonzero(moving)[0])),
            )
