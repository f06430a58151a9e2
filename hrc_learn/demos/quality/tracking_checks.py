"""Checks of commands against the state that follows them, in one episode and over all."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float64, Int64

from hrc_learn.demos.format.dataset_folder import DatasetFolder, EpisodeEntry
from hrc_learn.demos.issues import Issue, warning
from hrc_learn.demos.quality.consistency_checks import FEWEST
from hrc_learn.demos.read.columns import ColumnMapping
from hrc_learn.demos.read.profiles import EpisodeProfile, Tracking, gain_over

# R squared above which a state follows its command, and below which it does not.
_FOLLOWS, _LOST = 0.8, 0.4
_PROMPT = 0.2
"""Delay within which an arm follows [s]; a slow motion resembles its own rate later."""


def command_tracking(
    folder: DatasetFolder,
    mapping: ColumnMapping,
    entries: Mapping[int, EpisodeEntry],
    profiles: Mapping[int, EpisodeProfile],
) -> Iterator[Issue]:
    """Delays, signs and pairs of commands and states that agree between episodes."""
    known = [p for p in profiles.values() if "command_position" in p.tracking]
    if "command_position" not in mapping.selections or not known:
        return
    command = mapping.selections["command_position"]
    key, names = command.columns[0][0], command.labels
    trackings = [p.tracking["command_position"] for p in known]
    usual_fit = _median([t.fit for t in trackings])
    yield from _velocity_commands(folder.fps, key, names, profiles, usual_fit)
    follow = usual_fit > _FOLLOWS
    if not follow.any():
        return
    usual_slope = _median([t.slope for t in trackings])
    delays = np.array([t.delay for t in trackings])
    delay = float(np.median(delays))
    if delay < -1:
        yield warning(
            message=f"the state moves {-delay:.0f} frames before its command in most episodes: "
            f"actions and states are shifted against each other",
            key=key,
        )
    agreement = (np.abs(delays - delay) <= 2).mean()
    for profile, tracking in zip(known, trackings, strict=True):
        place = {**entries[profile.index].location, "key": key, "components": (*names,)}
        shift = tracking.delay - delay
        # The own delay must explain far more of the motion than the usual one.
        better = gain_over(tracking, round(delay)) > 0.8
        # Three frames are the scatter of estimated delays.
        if abs(shift) > max(3, 0.1 * abs(delay)) and better and agreement > 0.5:
            yield Issue(
                message=f"the state comes {tracking.delay} frames after its command, in the "
                f"other episodes {delay:.0f}: actions were shifted against states",
                **place,
                severity=abs(shift),
            )
        elif len(known) >= FEWEST:
            yield from _component_tracking(tracking, usual_slope, follow, names, place)


def _median(rows: Sequence[np.ndarray]) -> Float64[np.ndarray, " components"]:
    """Median over episodes; components that rest count as 0."""
    with np.errstate(all="ignore"):
        return np.nan_to_num(np.median(np.nan_to_num(np.stack(rows)), axis=0))


def _component_tracking(
    tracking: Tracking,
    usual_slope: Float64[np.ndarray, " components"],
    follow: Bool[np.ndarray, " components"],
    names: tuple[str, ...],
    place: Mapping,
) -> Iterator[Issue]:
    """Components that follow their command in the other episodes, but not in this one."""

    def listed(components: Int64[np.ndarray, " _"]) -> str:
        return ", ".join(names[i] for i in components[:6])

    fit, slope, partner = tracking.fit, tracking.slope, tracking.partner
    follows = follow & (fit > _FOLLOWS)
    lost = np.flatnonzero(follow & ~(fit > _LOST) & ~np.isnan(fit))
    # The slope equals minus the usual one, within half of it.
    opposite = np.abs(slope + usual_slope) < 0.5 * np.abs(usual_slope)
    against = np.flatnonzero(follows & opposite)
    swapped = [i for i in lost if tracking.similarity[i] > 0.9 and partner[i] != i]
    if len(against):
        yield Issue(
            message=f"the state goes the other way than its command, in this episode alone: "
            f"{listed(against)}",
            **place,
        )
    elif len(swapped) > 1:
        pairs = ", ".join(f"{names[i]} as {names[partner[i]]}" for i in swapped[:4])
        yield Issue(message=f"columns look exchanged against the state: {pairs}", **place)
    elif len(lost):
        yield warning(
            message=f"the state does not follow its command, as it does in the other episodes: "
            f"{listed(lost)}",
            **place,
            severity=float(len(lost)),
        )
    with np.errstate(all="ignore"):
        ratio = np.abs(slope / np.where(usual_slope, usual_slope, 1))
    # A factor of exp(0.5) = 1.6: payload and contact explain less.
    size = np.flatnonzero(follows & (np.abs(np.log(ratio + 1e-9)) > 0.5))
    if len(size):
        yield warning(
            message=f"the state goes {slope[size[0]]:.2g} times as far as its command, in the "
            f"other episodes {usual_slope[size[0]]:.2g}: {listed(size)}",
            **place,
        )


def _velocity_commands(
    fps: float,
    key: str,
    names: tuple[str, ...],
    profiles: Mapping[int, EpisodeProfile],
    position_fit: Float64[np.ndarray, " components"],
) -> Iterator[Issue]:
    """Commands that are named like positions but are velocities."""
    known = [p.tracking for p in profiles.values()]
    rates = [t["rates"] for t in known if "rates" in t]
    positions = [t["command_position"] for t in known if "command_position" in t]
    if not rates:
        return
    rate_delay, position_delay = (
        abs(float(np.median([t.delay for t in group]))) / fps for group in (rates, positions)
    )
    # If both readings fit a smooth motion, the one without a long delay is meant.
    prompt = rate_delay <= _PROMPT < position_delay
    fit, slope = _median([t.fit for t in rates]), _median([t.slope for t in rates])
    # Slopes between 0.3 and 3: the same unit per second, with lag or gain.
    speeds = (fit > _FOLLOWS) & (np.abs(slope) > 0.3) & (np.abs(slope) < 3)
    speeds &= (position_fit < _LOST) | (prompt & (position_fit < fit))
    if speeds.sum() > len(speeds) / 2:
        yield Issue(
            message=f"is taken for positions, but follows the velocity of the state with slope "
            f"{float(np.median(slope[speeds])):.2f}: {', '.join(names[:6])}; declare it "
            f"(mapping={{'command_velocity': {key!r}, 'command_position': None}})",
            key=key,
        )
