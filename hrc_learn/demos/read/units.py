"""Units of a dataset's values: given by the caller, declared, or guessed from evidence.

LeRobot declares no units, and radians, degrees, encoder ticks and -100..100 all occur. If the
name of a column states a unit, this unit is used. Otherwise, the values and the type of the
robot are the evidence. The quantities are named by their roles (see `quantities.ROLES`).
"""

import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.read import unit_evidence
from hrc_learn.demos.read.columns import ColumnSelection
from hrc_learn.demos.read.dataset_folder import EpisodeEntry
from hrc_learn.demos.read.metadata import SIDECAR_PATH
from hrc_learn.demos.read.naming import is_hand, role_of_key
from hrc_learn.demos.read.quantities import DIMENSIONS, ORIENTATION_ROLES, ROLES
from hrc_learn.demos.read.unit_evidence import CONFIDENT, Guess, Sizes

_SCALED = re.compile(r"(?:(-?\d+\.?\d*(?:e[-+]?\d+)?) )?(.+?)(/step)?")
"""Unit with an optional factor: 1.1 deg for -100..100 of a calibrated motor, 0.05 rad/step for
scaled commands that are added to the joint positions."""

_JOINTS = ("joint_position", "command_position")
_RATES = ("joint_velocity", "command_velocity")
_FOLLOWERS = ("command_position", *_RATES)
"""Quantities that take over the unit of the joint positions if nothing is declared."""
_GUESSABLE = (*_JOINTS, *unit_evidence.GUESSED_BY_SIZE)


@dataclass(frozen=True, kw_only=True)
class UnitDecision:
    """Unit of one quantity on disk, and the evidence for it."""

    role: str
    unit: str
    """Unit of all components, or of most of them."""
    units: tuple[str, ...] = ()
    """Unit of each component if they differ: an arm in degrees, its fingers from 0 to 1."""
    guessed: bool = False
    """True if neither the caller, the dataset nor a name states the unit."""
    confidence: float = 1.0
    """Confidence, 0 to 1."""
    evidence: str = ""
    """Evidence for a guess, in words."""
    other: str = ""
    """Second candidate for the unit; "" if there is none."""
    leader: str = ""
    """Other quantity from which this quantity takes over its unit; "" if there is none."""

    @property
    def factor(self) -> float | Float64[np.ndarray, " components"]:
        """Factor from values on disk to SI values: one number, or one per component."""
        if not self.units:
            return unit_factor(self.role, self.unit)
        return np.array([unit_factor(self.role, unit) for unit in self.units])

    @property
    def steps(self) -> Bool[np.ndarray, " components"]:
        """True for components that hold changes per step; one value if all have one unit."""
        return np.array([unit.endswith("/step") for unit in self.units or (self.unit,)])

    @property
    def converts(self) -> bool:
        """True if a guess changes the values."""
        return self.guessed and bool(np.any(self.factor != 1) or self.steps.any())

    @property
    def note(self) -> str | None:
        """The guess and how to overrule it; None if no guess is worth mentioning."""
        # A gripper in metres or as a fraction of its opening is the usual case.
        if not self.guessed or (self.role == "gripper" and not self.converts):
            return None
        sure = "" if self.confidence > unit_evidence.ASSUMED else " (assumed, not known)"
        if self.confidence < CONFIDENT:
            sure = f" ({100 * self.confidence:.0f} % sure)"
        others = sorted({*self.units} - {self.unit})
        fingers = f", others for {', '.join(others)}" if others else ""
        return (
            f"{self.role}: no unit declared, {self.evidence}: taken for {self.unit}"
            f"{fingers}{sure}; overrule with units={{{self.role!r}: ...}}"
        )

    @property
    def doubt(self) -> str | None:
        """Question to the user if the guess is not sure enough to be used; else None."""
        if self.confidence >= CONFIDENT or self.leader:
            return None
        candidates = [self.unit, *filter(None, [self.other])]
        ways = " or ".join(f"--units {self.role} {unit}" for unit in candidates)
        return (
            f"{self.role} is in {' or '.join(candidates)}? {self.evidence} (taken for "
            f"{self.unit}, {100 * self.confidence:.0f} % sure): give {ways}, or leave columns "
            f"out with --mapping {self.role} COLUMNS|none"
        )

    @property
    def si_unit(self) -> str:
        """Unit after the conversion.

        This is the SI unit of the quantity, except for fractions of a range ("1", and "1/s" for
        their rates) and for a gripper that is measured as an angle ("rad").
        """
        own, unit = ROLES[self.role].unit, self.unit.removesuffix("/s")
        if unit in DIMENSIONS["ratio"]:
            own = "1" + self.unit[len(unit) :]
        elif self.role == "gripper" and unit in DIMENSIONS["angle"]:
            own = "rad"
        return own + "/step" * bool(self.steps.any())

    @property
    def plain(self) -> "UnitDecision":
        """The decision without the factors in its units: deg instead of 1.1 deg."""
        units = [re.sub(_SCALED, r"\2\3", unit, count=1) for unit in self.units or (self.unit,)]
        return replace(self, unit=units[0], units=tuple(units) if len({*units}) > 1 else ())

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
    scaled = _SCALED.fullmatch(unit)
    known = ("command_position",) if scaled and scaled[3] else (*_JOINTS, *_RATES)
    size = float(scaled[1] or 1) if scaled else 0.0
    if role in known and scaled and scaled[2] != unit and 0 < abs(size) < math.inf:
        return size * unit_factor(role, scaled[2])
    options = units_of(role)
    if unit not in options:
        raise DatasetError(
            f"{role} does not come in {unit!r}; known units are {', '.join(options)}"
        )
    return options[unit]


def units_of(role: str) -> dict[str, float]:
    """Units of a quantity and their factors, without the units per step of commands."""
    if role in _RATES:
        return {f"{unit}/s": factor for unit, factor in units_of("joint_position").items()}
    own = ROLES[role].unit
    options = next(units for units in DIMENSIONS.values() if own in units)
    if role in ("gripper", *_JOINTS):
        # Grippers and hands report an angle or a fraction of their opening, hobby arms a
        # fraction of their range. Sliding fingers report metres.
        options = options | DIMENSIONS["ratio"] | DIMENSIONS["angle"] | {"m": 1.0}
    return options


def guessed_from_values(roles: Iterable[str], stated: Collection[str]) -> list[str]:
    """Quantities whose unit can only be guessed from the size of their values."""
    return [role for role in roles if role in _GUESSABLE and role not in stated]


def decide_units(
    selections: Mapping[str, ColumnSelection],
    sizes: Mapping[str, Sizes],
    stated: Mapping[str, str | Sequence[str]],
    frame_step: float = 1.0,
    robot_type: str = "",
) -> dict[str, UnitDecision]:
    """Decide on a unit for every quantity.

    Args:
        selections: Columns of the quantities, whose names are evidence.
        sizes: Sizes of the values on disk, for quantities whose unit must be guessed.
        stated: Units by role, or of each component, from the caller or the dataset.
        frame_step: Step of the true stamps in their unit on disk, divided by the nominal period
            in seconds.
        robot_type: Robot type of the dataset, "" if unknown.
    """
    decisions: dict[str, UnitDecision] = {}
    for role in sorted(selections, key=lambda role: role in _FOLLOWERS):
        selection = selections[role]
        named = _named_units(selection)
        if role in stated:
            decisions[role] = _stated(role, stated[role])
        elif all(named):
            decisions[role] = replace(
                _stated(role, named),
                confidence=unit_evidence.STATED,
                evidence="the names state it",
            )
        elif role in _FOLLOWERS and (leader := decisions.get("joint_position")):
            decisions[role] = _following(role, leader)
        elif role == "time":
            decisions[role] = _guess_time(frame_step)
        elif role in sizes:
            decisions[role] = _guess(selection, sizes, robot_type, named)
        else:
            why, sure = selection.assumed or "by its name", 0.8 if selection.assumed else 0.95
            unit = ROLES[role].unit
            decisions[role] = UnitDecision(role=role, unit=unit, confidence=sure, evidence=why)
    return decisions


def _named_units(selection: ColumnSelection) -> tuple[str, ...]:
    """Unit that the name of each component states, if the quantity can have it; else ""."""
    rate = "/s" if selection.role in _RATES else ""
    known = units_of(selection.role)
    return tuple(
        next((u for u in (unit, unit.removesuffix("/s") + rate) if unit and u in known), "")
        for unit in selection.units or ("",) * len(selection.columns)
    )


def _stated(role: str, unit: str | Sequence[str]) -> UnitDecision:
    if isinstance(unit, str):
        return UnitDecision(role=role, unit=unit)
    most = max(dict.fromkeys(unit), key=list(unit).count)
    return UnitDecision(role=role, unit=most, units=tuple(unit) if len({*unit}) > 1 else ())


def _following(role: str, leader: UnitDecision) -> UnitDecision:
    """Decision to take over the unit of the leading quantity, per second for velocities."""
    rate = "/s" if role in _RATES else ""
    return UnitDecision(
        role=role,
        unit=leader.unit + rate,
        units=tuple(unit + rate for unit in leader.units),
        confidence=leader.confidence,
        leader=leader.role,
        evidence=f"that of {leader.role}",
    )


def _guess(
    selection: ColumnSelection,
    sizes: Mapping[str, Sizes],
    robot_type: str,
    named: Sequence[str],
) -> UnitDecision:
    """Guess from the values of each component, and the names that state a unit."""
    role, own = selection.role, sizes[selection.role]
    units: tuple[str, ...] = ()
    if role in _JOINTS:
        if role == "joint_position" and "command_position" in sizes:
            own = _with_command(own, sizes["command_position"])
        guess, units = _guess_joint_units(own, selection, robot_type, named)
    else:
        guess = unit_evidence.guess_by_size(role, own)
    guess = unit_evidence.confirm(guess, ROLES[role].unit, robot_type)
    return UnitDecision(
        role=role,
        units=units if {*units} - {guess.unit} else (),
        guessed=guess.confidence < unit_evidence.STATED,
        **guess._asdict(),
    )


def _with_command(joints: Sizes, command: Sizes) -> Sizes:
    """Sizes of joints and commands together.

    Commands reach the limit of 100 and are clipped there even where joints stop earlier. Those
    of at most 1 may be changes of the joints, clipped at 1.
    """
    if len(command.peak) != len(joints.peak):
        return joints
    near = (joints.peak > 90) & (command.peak > 90)
    return joints._replace(
        clipped=np.maximum(joints.clipped, command.clipped * (command.peak > 1)),
        peak=np.where(near, np.maximum(joints.peak, command.peak), joints.peak),
    )


def _guess_joint_units(
    sizes: Sizes, selection: ColumnSelection, robot_type: str, named: Sequence[str]
) -> tuple[Guess, tuple[str, ...]]:
    """Unit of the arm, and of each joint and finger."""
    labels = selection.labels
    hand = np.array([is_hand(label) for label in labels])
    hand &= not hand.all()
    # If no name marks the gripper, it is the last column.
    hand[-1] |= sizes.opening[-1] and not sizes.opening.all()
    stated = np.array([bool(unit) for unit in named])
    guess = unit_evidence.guess_joints(sizes, ~hand & ~stated, labels, robot_type)
    # The key of a whole feature, such as `qpos`, may show its content.
    unnamed = selection.numbered and role_of_key(selection.columns[0][0]) is None
    guess = unit_evidence.doubt_meaning(guess, sizes, labels, unnamed)
    fingers = unit_evidence.guess_fingers(
        sizes, hand, labels, guess.unit, unit_evidence.is_hobby_arm(robot_type, labels)
    )
    units = tuple(
        named[i] if stated[i] else fingers[i] if hand[i] else guess.unit
        for i in range(len(hand))
    )
    return guess, units


def _guess_time(frame_step: float) -> UnitDecision:
    """Unit of the stamps: the one that brings their step closest to the nominal period."""
    sizes = DIMENSIONS["time"]
    # The bound avoids the logarithm of a step of zero.
    off = {unit: abs(math.log10(max(frame_step, 1e-3) * size)) for unit, size in sizes.items()}
    unit = min(off, key=off.__getitem__)
    if unit == "s":
        return UnitDecision(role="time", unit=unit)
    evidence = f"steps are {frame_step:.3g} times 1/fps"
    return UnitDecision(role="time", unit=unit, guessed=True, evidence=evidence)


Quantities = dict[str, Float64[np.ndarray, "_frames _components"]]
"""Role -> values during one episode, in the units on disk."""
_SAMPLED_FRAMES = 1000
"""Frames that suffice to estimate the size of an episode's values."""


def units_from_episodes(
    selections: Mapping[str, ColumnSelection],
    episodes: Iterable[tuple[EpisodeEntry, Quantities]],
    fps: float,
    declared: Mapping[str, str | Sequence[str]],
    given: Mapping[str, str],
    sample: Collection[int] | None = None,
    robot_type: str = "",
) -> tuple[dict[str, UnitDecision], list[DatasetError]]:
    """Unit of each quantity, guessed from the size of its values where nothing states the unit.

    The size of a component is the median of its peaks in all episodes, so that no single frame
    or episode decides.

    Args:
        selections: Columns of the quantities.
        episodes: Episodes in the units on disk.
        fps: Frame rate [1/s].
        declared: Units from the sidecar, in the form of `stated` in `decide_units`.
        given: Units from the caller, which take precedence; for joints, also calibration files.
        sample: Indices of the episodes that decide; None for all.
        robot_type: Robot type of the dataset, "" if unknown.

    Returns:
        The decisions, and an error for each episode that contradicts them.

    Raises:
        DatasetError: A unit is unknown, or does not fit its quantity or its values.
    """
    require_known(given)
    _require_declared(declared)
    files = calibrations(given)
    guessed = guessed_from_values(selections, {*declared, *given} - files.keys())
    steps: list[float] = []
    measured: list[tuple[EpisodeEntry, dict[str, Sizes]]] = []
    for entry, quantities in episodes:
        known = {r: quantities[r] for r in guessed if r in quantities}
        some = {r: values[:: 1 + len(values) // _SAMPLED_FRAMES] for r, values in known.items()}
        measured.append(
            (entry, {r: unit_evidence.measure(v) for r, v in some.items() if len(v)})
        )
        time = quantities.get("time", np.empty((0, 1)))
        if len(time) > 1:
            # Step in the unit on disk, divided by the nominal period in seconds.
            steps.append(float(np.nanmedian(np.diff(time[:, 0]))) * fps)
    deciding = [m for entry, m in measured if sample is None or entry.index in sample]
    deciding = deciding or [m for _, m in measured]
    found = {role: [own[role] for own in deciding if role in own] for role in guessed}
    sizes = {role: unit_evidence.typical(known) for role, known in found.items() if known}
    step = float(np.median(steps)) if steps else 1.0
    read = {
        role: unit_evidence.calibrated_units(file, selections[role].labels, own, robot_type)
        for role, file in files.items()
        if (own := sizes.get(role)) is not None
    }
    decisions = decide_units(selections, sizes, {**declared, **given, **read}, step, robot_type)
    faults = [
        fault
        for role, own in sizes.items()
        for fault in _contradictions(selections[role], own.peak, decisions[role], measured)
    ]
    return decisions, faults


def calibrations(given: Mapping[str, str]) -> dict[str, Path]:
    """Files of LeRobot's calibrations that the caller gives as units of joints, by role."""
    return {r: Path(u) for r, u in given.items() if r in _JOINTS and u.endswith(".json")}


def require_known(given: Mapping[str, str]) -> None:
    """Check the units that a caller gives; calibration files are read later.

    Raises:
        DatasetError: A unit is unknown, or does not fit its quantity.
    """
    for role in given.keys() - calibrations(given).keys():
        unit_factor(role, given[role])


def _require_declared(declared: Mapping[str, str | Sequence[str]]) -> None:
    for role, unit in declared.items():
        for one in (unit,) if isinstance(unit, str) else unit:
            try:
                unit_factor(role, one)
            except DatasetError as error:
                key = f"units.{role}"
                raise DatasetError(str(error), file=SIDECAR_PATH, key=key) from error


_DEGREES = math.log(180 / math.pi)
_NEAR = math.log(2.5)
"""Largest distance of log(ratio of sizes) from log(57.3) that indicates degrees among radians,
or radians among degrees."""


def _contradictions(
    selection: ColumnSelection,
    size: Float64[np.ndarray, " components"],
    decision: UnitDecision,
    measured: Sequence[tuple[EpisodeEntry, Mapping[str, Sizes]]],
) -> Iterator[DatasetError]:
    """Errors of episodes with values about 57.3 times as large or as small as in the others.

    Such episodes hold degrees among radians, or radians among degrees.
    """
    role = selection.role
    if role not in ("joint_position", "command_position", *ORIENTATION_ROLES):
        return
    # Components that hardly move have no size to compare, and fractions are no angles.
    units = [decision.unit_of(i) for i in range(len(size))]
    moving = (size > 1e-2) & [unit not in DIMENSIONS["ratio"] for unit in units]
    known = [(entry, own[role].peak) for entry, own in measured if role in own]
    if not moving.any() or not known:
        return
    reached = np.stack([own[moving] for _, own in known])
    ratios = np.median(np.log(np.maximum(reached, 1e-9) / size[moving]), axis=1)
    for (entry, _), ratio in zip(known, ratios.tolist(), strict=True):
        if abs(abs(ratio) - _DEGREES) < _NEAR:
            seems = "deg" if ratio > 0 else "rad"
            twice = seems == decision.unit
            mixed = "converted twice" if twice else f"{seems} among {decision.unit}"
            yield entry.error(
                f"{role} is about {math.exp(abs(ratio)):.0f} times as "
                f"{'large' if seems == 'deg' else 'small'} as in the other episodes: {mixed}? "
                f"Leave the episode out, or record it again",
                key=selection.column_name(int(np.flatnonzero(moving)[0])),
            )
