"""What one episode contradicts the others in: swaps, signs, delays, rests, glitches, sizes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from hrc_learn.demos.format.dataset_folder import DatasetFolder, EpisodeEntry
from hrc_learn.demos.issue import ValidationReport
from hrc_learn.demos.read.column_mapping import ColumnMapping
from hrc_learn.demos.read.profiles import ColumnProfile, EpisodeProfile, gain_over, is_discrete
from hrc_learn.demos.read.roles import meaning_of_component
from hrc_learn.demos.validation.data_checks import component_name

_FEW = 3
"""Episodes from which one can be told from the rest."""
# R squared at which a state follows its command, and at which it does not.
_FOLLOWS, _LOST = 0.8, 0.4


@dataclass(frozen=True, kw_only=True)
class _Feature:
    """One feature over all episodes that hold it, a row for each."""

    key: str
    entries: list[EpisodeEntry]
    profiles: list[ColumnProfile]
    names: list[str]
    smooth: np.ndarray
    """Components that move without switching, in most episodes."""

    def stack(self, name: str) -> Float64[np.ndarray, "episodes ..."]:
        """One figure of every profile."""
        return np.stack([getattr(profile, name) for profile in self.profiles]).astype(float)

    @property
    def span(self) -> Float64[np.ndarray, " components"]:
        """Usual range of each component."""
        return np.median(self.stack("span"), axis=0)


def check_consistency(
    folder: DatasetFolder,
    mapping: ColumnMapping,
    profiles: Mapping[int, EpisodeProfile],
    report: ValidationReport,
) -> None:
    """Compare every episode with the others, and commands with what follows them."""
    entries = {entry.index: entry for entry in folder.episodes}
    check_lengths([entries[i] for i in profiles], report)
    check_tracking(folder, mapping, entries, profiles, report)
    for feature in _features(folder, entries, profiles):
        check_sizes(feature, report)
        if len(feature.entries) < _FEW:
            continue
        check_holds(feature, folder.fps, report)
        check_noise(feature, report)
        check_switches(feature, report)
        if feature.key.startswith(("observation.", "state", "action")):
            check_exchanges(feature, report)


def _features(
    folder: DatasetFolder,
    entries: Mapping[int, EpisodeEntry],
    profiles: Mapping[int, EpisodeProfile],
) -> Iterator[_Feature]:
    for key, declared in folder.features.items():
        known = [p for p in profiles.values() if key in p.columns]
        widths = {p.columns[key].start.shape for p in known}
        if len(widths) != 1:
            continue
        discrete = np.mean([is_discrete(p.columns[key], p.length) for p in known], axis=0)
        width = widths.pop()[0]
        if width != declared.width:
            continue  # reported with the columns
        yield _Feature(
            key=key,
            entries=[entries[p.index] for p in known],
            profiles=[p.columns[key] for p in known],
            names=[component_name(declared, i) for i in range(width)],
            smooth=discrete < 0.5,
        )


def check_lengths(entries: Sequence[EpisodeEntry], report: ValidationReport) -> None:
    """Episodes that were broken off, or run together."""
    if len(entries) < _FEW + 1:
        return
    usual = float(np.median([entry.length for entry in entries]))
    for entry in entries:
        if not usual / 5 < entry.length < 5 * usual:
            report.warning(
                f"has {entry.length} frames where {usual:.0f} are usual: broken off, or "
                f"several in one?",
                **entry.location,
            )


_ABSURD, _FAR = 1e12, 1e3


def check_sizes(feature: _Feature, report: ValidationReport) -> None:
    """Values no robot reports: bits that flipped, or memory that was never written."""
    usual = np.median(feature.stack("peak"), axis=0)
    largest = feature.stack("largest")
    scale = np.maximum(usual, np.where(feature.smooth, 1e-3, np.inf))
    absurd = (largest > _ABSURD) | (largest > _FAR * scale)
    absurd &= np.array([not _counts(name, feature.key) for name in feature.names])
    for number, component in np.argwhere(absurd):
        report.error(
            f"{feature.names[component]} reaches {largest[number, component]:.3g}, usually "
            f"{usual[component]:.3g}: the file was damaged, or memory was never written; leave "
            f"the episode out",
            **feature.entries[number].location,
            key=feature.key,
            names=(feature.names[component],),
            severity=float(np.log(largest[number, component])),
        )


def _counts(name: str, key: str) -> bool:
    """Whether a column is one of clocks, which are large by nature."""
    return any("time" in text.lower() or "stamp" in text.lower() for text in (name, key))


def check_holds(feature: _Feature, fps: float, report: ValidationReport) -> None:
    """Components that froze in one episode, and hardly ever rest in the others."""
    held, lengths = feature.stack("held"), np.array([e.length for e in feature.entries])
    share = held / lengths[:, None]
    usual = np.median(share, axis=0)
    frozen = (share > 0.1) & (share > 5 * usual + 0.02) & (held > max(10, 0.3 * fps))
    frozen &= feature.smooth & (feature.span > 0)
    for number, component in np.argwhere(frozen):
        report.warning(
            f"{feature.names[component]} stays the same for {held[number, component]:.0f} of "
            f"{lengths[number]} frames, usually for {100 * usual[component]:.0f} %: the "
            f"encoder froze?",
            **feature.entries[number].location,
            key=feature.key,
            names=(feature.names[component],),
            severity=float(share[number, component]),
        )


def check_noise(feature: _Feature, report: ValidationReport) -> None:
    """Components far noisier, or far coarser, in one episode than in the others."""
    noise, span = feature.stack("noise"), feature.span
    usual = np.median(noise, axis=0)
    noisy = (noise > 10 * usual) & (noise > 0.005 * span) & feature.smooth & (span > 0)
    distinct, lengths = feature.stack("distinct"), np.array([e.length for e in feature.entries])
    levels = distinct / lengths[:, None]
    coarse = (levels < 0.2 * np.median(levels, axis=0)) & feature.smooth & (span > 0)
    coarse &= feature.stack("held") / lengths[:, None] < 0.1  # else it is at rest
    for odd, what in ((noisy, "far noisier"), (coarse, "of far fewer levels")):
        for number in np.flatnonzero(odd.any(1)):
            names = [feature.names[i] for i in np.flatnonzero(odd[number])]
            report.warning(
                f"is {what} than in the other episodes: {', '.join(names[:6])}",
                **feature.entries[number].location,
                key=feature.key,
                names=tuple(names),
                severity=float(odd[number].sum()),
            )


def check_switches(feature: _Feature, report: ValidationReport) -> None:
    """Grippers and flags that stay, or begin and end the other way, in one episode alone."""
    span = feature.stack("span")
    ends = np.stack([feature.stack("start"), feature.stack("goal")], axis=1)
    usual = np.median(ends, axis=0)
    near = np.abs(ends - usual) <= 0.1 * feature.span
    opposite = np.abs(ends - usual[::-1]) <= 0.1 * feature.span
    switches = ~feature.smooth & (np.ptp(usual, axis=0) > 0.5 * feature.span)
    for component in np.flatnonzero(switches & (feature.span > 0)):
        alike = near[:, :, component].all(1)
        if alike.sum() < max(_FEW, len(alike) - 1):
            continue  # no habit to go against
        for number in np.flatnonzero(~alike):
            name = feature.names[component]
            place = {**feature.entries[number].location, "key": feature.key, "names": (name,)}
            if span[number, component] == 0:
                report.warning(f"{name} stays, it switches in the other episodes", **place)
            elif opposite[number, :, component].all():
                report.warning(
                    f"{name} switches the other way than in the other episodes", **place
                )


# Exchanged columns, signs and directions, by where each component usually is.

_FAR_OFF = 3.0
"""Spreads from which an episode is not where the others are."""
_HALF_TURN = 0.9 * np.pi
"""Size of a rotation vector [rad] from which the noise of a hand turns it over."""


def check_exchanges(feature: _Feature, report: ValidationReport) -> None:
    """Columns exchanged, negated, moved or run backwards in one episode."""
    from scipy.optimize import linear_sum_assignment

    moving = np.flatnonzero(feature.smooth & (feature.span > 0) & ~_without_sign(feature))
    if not len(moving):
        return
    levels = feature.stack("levels")[:, 1:4, moving]
    ends = np.stack([feature.stack("start"), feature.stack("goal")], axis=1)[..., moving]
    shape = np.concatenate([levels, ends], axis=1)  # 5 %, 50 %, 95 %, start, goal
    usual = np.median(shape, axis=0)
    spread = 1.4826 * np.median(np.abs(shape - usual), axis=0).mean(0)
    scale = np.maximum(spread, 0.05 * feature.span[moving]) + 1e-9
    for number, own in enumerate(shape):
        off = np.abs(own - usual).mean(0) / scale
        if not (off > _FAR_OFF).any():
            continue
        cost = np.abs(own[:, :, None] - usual[:, None, :]).mean(0) / scale
        place = {
            **feature.entries[number].location,
            "key": feature.key,
            "severity": float(off.max()),
            "names": tuple(_name(feature, moving, i) for i in np.flatnonzero(off > _FAR_OFF)),
        }
        _, best = linear_sum_assignment(np.minimum(cost, 50))
        exchanged = _exchanged(best, off > _FAR_OFF)
        after = cost[exchanged, best[exchanged]]
        if (
            len(exchanged) > 1
            and after.max() < 2
            and after.mean() < 0.3 * off[exchanged].mean()
        ):
            pairs = [
                f"{_name(feature, moving, i)} like {_name(feature, moving, best[i])}"
                for i in exchanged[:4]
            ]
            report.error(
                f"columns look exchanged, in this episode alone: {', '.join(pairs)}", **place
            )
            continue
        turned = np.abs(-own[[2, 1, 0, 3, 4]] - usual).mean(0) / scale
        negated = np.flatnonzero((off > _FAR_OFF) & (turned < 1.5) & (turned < 0.25 * off))
        if len(negated):
            names = ", ".join(_name(feature, moving, i) for i in negated[:6])
            report.error(f"has the other sign than in the other episodes: {names}", **place)
            continue
        back = np.abs(own[[0, 1, 2, 4, 3]] - usual).mean(0) / scale
        if off.mean() > 2 and back.mean() < 0.4 * off.mean():
            report.warning("runs the other way than the other episodes", **place)
            continue
        moved = np.flatnonzero(off > 3 * _FAR_OFF)
        shift = own - usual
        alike = np.ptp(shift, axis=0) < 0.2 * np.abs(shift.mean(0))
        offset = [i for i in moved if alike[i]]
        if offset:
            names = ", ".join(
                f"{_name(feature, moving, i)} by {shift[1, i]:.3g}" for i in offset[:6]
            )
            report.warning(
                f"lies elsewhere than in the other episodes all along: {names}: its zero was "
                f"moved?",
                **place,
            )
        elif len(moved):
            names = ", ".join(_name(feature, moving, i) for i in moved[:6])
            report.warning(f"is far from the other episodes: {names}", **place)


def _exchanged(
    best: Int64[np.ndarray, " components"], off: Bool[np.ndarray, " components"]
) -> Int64[np.ndarray, " _"]:
    """Components that took each other's place, every one of them away from its own.

    Where only some are away, these look like others by chance.
    """
    found = []
    for first in range(len(best)):
        ring = [first]
        while best[ring[-1]] != first:
            ring.append(int(best[ring[-1]]))
        if len(ring) > 1 and off[ring].all():
            found.append(first)
    return np.array(found, dtype=int)


def _without_sign(feature: _Feature) -> Bool[np.ndarray, " components"]:
    """Components of orientations that mean the same turned over.

    Of quaternions, and of rotation vectors near half a turn in any episode.
    """
    meanings = map(meaning_of_component, feature.names)
    roles = np.array([meaning.role if meaning else "" for meaning in meanings])
    vectors = roles == "rotation_vector"
    middles = np.linalg.norm(feature.stack("levels")[:, 2] * vectors, axis=1)
    near_half_turn = bool((middles > _HALF_TURN).any())
    return np.char.startswith(roles, "quaternion") | (vectors & near_half_turn)


def _name(feature: _Feature, moving: np.ndarray, number: int | np.integer) -> str:
    return feature.names[int(moving[number])]


# Commands, and what follows them.


def check_tracking(
    folder: DatasetFolder,
    mapping: ColumnMapping,
    entries: Mapping[int, EpisodeEntry],
    profiles: Mapping[int, EpisodeProfile],
    report: ValidationReport,
) -> None:
    """Delays, signs and pairs of commands and states that differ between episodes."""
    command = mapping.selections.get("command_position")
    known = [p for p in profiles.values() if "command_position" in p.tracking]
    if command is None or not known:
        return
    key, names = command.columns[0][0], command.labels
    fits = np.stack([p.tracking["command_position"].fit for p in known])
    slopes = np.stack([p.tracking["command_position"].slope for p in known])
    delays = np.array([p.tracking["command_position"].delay for p in known])
    with np.errstate(all="ignore"):
        usual = np.nan_to_num(np.nanmedian(np.where(np.isnan(fits), 0, fits), axis=0))
        slope = np.nan_to_num(np.nanmedian(np.where(np.isnan(slopes), 0, slopes), axis=0))
    _check_rates(folder, mapping, profiles, usual, report)
    follow = usual > _FOLLOWS
    if not follow.any():
        return
    usual_delay = float(np.median(delays))
    if usual_delay < -1:
        report.warning(
            f"the state moves {-usual_delay:.0f} frames before its command in most episodes: "
            f"actions and states are shifted against each other",
            key=key,
        )
    for number, profile in enumerate(known):
        tracking = profile.tracking["command_position"]
        place = {**entries[profile.index].location, "key": key, "names": (*names,)}
        off = delays[number] - usual_delay
        agreeing = (np.abs(delays - usual_delay) <= 2).mean()
        better = gain_over(tracking, round(usual_delay)) > 0.8
        if abs(off) > max(3, 0.1 * abs(usual_delay)) and better and agreeing > 0.5:
            report.error(
                f"the state comes {delays[number]} frames after its command, in the other "
                f"episodes {usual_delay:.0f}: actions were shifted against states",
                **place,
                severity=float(abs(off)),
            )
            continue
        if len(known) < _FEW:
            continue
        lost = np.flatnonzero(follow & ~(fits[number] > _LOST) & ~np.isnan(fits[number]))
        against = np.flatnonzero(
            follow
            & (fits[number] > _FOLLOWS)
            & (np.abs(slopes[number] + slope) < 0.5 * np.abs(slope))
        )
        partner = tracking.partner
        swapped = [i for i in lost if tracking.likeness[i] > 0.9 and partner[i] != i]
        if len(against):
            report.error(
                f"the state goes the other way than its command, in this episode alone: "
                f"{', '.join(names[i] for i in against[:6])}",
                **place,
            )
        elif len(swapped) > 1:
            pairs = ", ".join(f"{names[i]} as {names[partner[i]]}" for i in swapped[:4])
            report.error(f"columns look exchanged against the state: {pairs}", **place)
        elif len(lost):
            report.warning(
                f"the state does not follow its command, as it does in the other episodes: "
                f"{', '.join(names[i] for i in lost[:6])}",
                **place,
                severity=float(len(lost)),
            )
        size = np.flatnonzero(
            follow
            & (fits[number] > _FOLLOWS)
            & (np.abs(np.log(np.abs(slopes[number] / np.where(slope, slope, 1)) + 1e-9)) > 0.5)
        )
        if len(size):
            report.warning(
                f"the state goes {slopes[number][size[0]]:.2g} times as far as its command, in "
                f"the other episodes {slope[size[0]]:.2g}: "
                f"{', '.join(names[i] for i in size[:6])}",
                **place,
            )


_PROMPT = 0.2
"""Delay [s] at which an arm follows its command; slow motion resembles its own rate later."""


def _check_rates(
    folder: DatasetFolder,
    mapping: ColumnMapping,
    profiles: Mapping[int, EpisodeProfile],
    position_fit: np.ndarray,
    report: ValidationReport,
) -> None:
    """Commands that are taken for positions by their names, and are velocities."""
    known = [p.tracking for p in profiles.values()]
    rates = [t["rates"] for t in known if "rates" in t]
    positions = [t["command_position"] for t in known if "command_position" in t]
    if not rates:
        return
    rate_delay, position_delay = (
        abs(float(np.median([t.delay for t in group]))) / folder.fps
        for group in (rates, positions)
    )
    # Of two ways to read a smooth motion the one without a long delay is meant.
    prompt = rate_delay <= _PROMPT < position_delay
    with np.errstate(all="ignore"):
        fit = np.nan_to_num(np.median([np.nan_to_num(t.fit) for t in rates], axis=0))
        slope = np.nan_to_num(np.median([np.nan_to_num(t.slope) for t in rates], axis=0))
    speeds = (fit > _FOLLOWS) & (np.abs(slope) > 0.3) & (np.abs(slope) < 3)
    speeds &= (position_fit < _LOST) | (prompt & (position_fit < fit))
    if speeds.sum() > len(speeds) / 2:
        command = mapping.selections["command_position"]
        key, names = command.columns[0][0], command.labels
        report.error(
            f"is taken for positions, but follows the velocity of the state with slope "
            f"{float(np.median(slope[speeds])):.2f}: {', '.join(names[:6])}; say so "
            f"(mapping={{'command_velocity': {key!r}, 'command_position': None}})",
            key=key,
        )
