"""Compare each episode with the others: sizes, rests, noise, columns and commands."""

from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float64

from hrc_learn.demos.demonstration import Demonstration
from hrc_learn.demos.issues import Issue, warning
from hrc_learn.demos.read.columns import ColumnSelection
from hrc_learn.demos.read.dataset_folder import EpisodeEntry
from hrc_learn.demos.read.kinematic_evidence import zero_offsets
from hrc_learn.demos.read.naming import is_hand, meaning_of_component
from hrc_learn.demos.read.profiles import (
    FOLLOWS,
    LOST,
    MOST_NAMED,
    EpisodeProfile,
    FeatureProfiles,
    Tracking,
    gain_over,
    listed,
    over_episodes,
)
from hrc_learn.demos.read.units import UnitDecision
from hrc_learn.kinematics import Arm

FEWEST = 3
"""Smallest number of episodes for comparing one episode with the others."""
_IMPOSSIBLE = 1e12
"""Size that no sensor reports: flipped bits, or memory that was never written."""
_IMPLAUSIBLE = 1e3
"""Multiple of the usual size that no sensor reports."""
_FAR_OFF = 3.0
"""Distance from the other episodes, as a multiple of the spread over episodes, above which an
episode is examined."""
_HALF_TURN = 0.9 * np.pi
"""Length of a rotation vector [rad] above which small motions can flip its sign."""
_SATURATED = 0.25
"""Fraction of frames at an end of the range above which a component is reported."""
_OFFSET = 0.1
"""Smallest distance between command and state at rest that is reported, relative to the joint's
range. Hobby servos under load stop a few degrees from their command."""


def lengths(entries: Sequence[EpisodeEntry]) -> Iterator[Issue]:
    """Report unusually short or long episodes: interrupted, or several episodes in one."""
    if len(entries) <= FEWEST:
        return
    usual = float(np.median([entry.length for entry in entries]))
    for entry in entries:
        # Operators differ by a factor of two or three, not by five.
        if not usual / 5 < entry.length < 5 * usual:
            text = f"has {entry.length} frames where {usual:.0f} are usual"
            yield entry.warning(f"{text}: broken off, or several in one?")


def column_ranges(features: Sequence[FeatureProfiles]) -> Iterator[Issue]:
    """Report components that never change, or stay at an end of their range."""
    still = [feature.key for feature in features if feature.constant.all()]
    if len(still) > MOST_NAMED:
        text = f"{len(still)} features never change: {listed(still, range(len(still)))}, ..."
        yield warning(message=text)
    said = {*still} if len(still) > MOST_NAMED else set()
    for feature in features:
        low, high, constant = feature.stack("low"), feature.stack("high"), feature.constant
        if constant.any() and feature.key not in said:
            text = f"never changes: {feature.named(constant)}"
            yield warning(message=text, key=feature.key)
        ends = feature.stack("at_ends")
        at_low = (ends[:, 0] * (low == low.min(0))).sum(0) / feature.lengths.sum()
        at_high = (ends[:, 1] * (high == high.max(0))).sum(0) / feature.lengths.sum()
        at_end = np.maximum(at_low, at_high)
        # Grippers that are open or closed are at one end or the other.
        saturated = (at_end > _SATURATED) & ~constant & (at_low + at_high < 1)
        if saturated.any() and feature.key.startswith(("observation.state", "action", "state")):
            share = f"{100 * at_end[saturated].max():.0f} % of the frames"
            text = f"sits at an end of its range for up to {share}: {feature.named(saturated)}"
            yield warning(message=text, key=feature.key)


def sizes(feature: FeatureProfiles) -> Iterator[Issue]:
    """Report values that no robot produces."""
    usual = feature.median("peak")
    largest = np.maximum(np.abs(feature.stack("low")), np.abs(feature.stack("high")))
    scale = np.maximum(usual, np.where(feature.smooth, 1e-3, np.inf))
    absurd = (largest > _IMPOSSIBLE) | (largest > _IMPLAUSIBLE * scale)
    # Clocks are large by nature.
    texts = [f"{name} {feature.key}".lower() for name in feature.names]
    absurd &= np.array(["time" not in text and "stamp" not in text for text in texts])
    for number, component in np.argwhere(absurd).tolist():
        size = largest[number, component]
        text = (
            f"{feature.names[component]} reaches {size:.3g}, usually {usual[component]:.3g}: "
            f"the file was damaged, or memory was never written; leave the episode out"
        )
        yield feature.issue(number, text, [component], float(np.log(size)), "error")


def holds(feature: FeatureProfiles) -> Iterator[Issue]:
    """Report components that froze in one episode, but hardly ever rest in the others."""
    if feature.key == "observation.environment_state":
        return  # objects rest until something touches them
    held, frames = feature.stack("held"), feature.lengths
    fraction = held / frames[:, None]
    usual = np.median(fraction, axis=0)
    # A component froze if it rests for a large part of the episode, for much longer than usual,
    # and for longer than a short pause.
    frozen = (fraction > 0.1) & (fraction > 5 * usual + 0.02)
    frozen &= (held > max(10, 0.3 * feature.fps)) & feature.smooth
    frozen &= feature.median("span") > 0
    for number, component in np.argwhere(frozen).tolist():
        text = (
            f"{feature.names[component]} stays the same for {held[number, component]:.0f} of "
            f"{frames[number]} frames, usually for {100 * usual[component]:.0f} %: the encoder "
            f"froze?"
        )
        yield feature.issue(number, text, [component], float(fraction[number, component]))


def noise(feature: FeatureProfiles) -> Iterator[Issue]:
    """Report components that are far noisier or coarser in one episode than in the others."""
    noise, span = feature.stack("noise"), feature.median("span")
    moving = feature.smooth & (span > 0)
    # Second differences vary by a factor of three between operators, not by ten.
    noisy = (noise > 10 * feature.median("noise")) & (noise > 0.005 * span) & moving
    frames = feature.lengths[:, None]
    levels = feature.stack("distinct") / frames
    # With less than a fifth of the usual number of distinct values, values were rounded, or the
    # encoder lost bits.
    coarse = (levels < 0.2 * np.median(levels, axis=0)) & moving
    coarse &= feature.stack("held") / frames < 0.1  # a component at rest is not coarse
    for odd, what in ((noisy, "is far noisier"), (coarse, "has far fewer levels")):
        for number in np.flatnonzero(odd.any(1)).tolist():
            places = np.flatnonzero(odd[number]).tolist()
            text = f"{what} than in the other episodes: {listed(feature.names, places)}"
            yield feature.issue(number, text, places, float(len(places)))


def switches(feature: FeatureProfiles) -> Iterator[Issue]:
    """Report grippers and flags that do not switch, or switch the other way, in one episode."""
    span, usual_span = feature.stack("span"), feature.median("span")
    ends = np.stack([feature.stack("start"), feature.stack("goal")], axis=1)
    usual = np.median(ends, axis=0)
    # Values at start and goal within a tenth of the range count as the same level.
    near = np.abs(ends - usual) <= 0.1 * usual_span
    opposite = np.abs(ends - usual[::-1]) <= 0.1 * usual_span
    # Only components that usually change their level from start to goal.
    switching = ~feature.smooth & (np.ptp(usual, axis=0) > 0.5 * usual_span) & (usual_span > 0)
    for component in np.flatnonzero(switching).tolist():
        alike = near[:, :, component].all(1)
        if alike.sum() < max(FEWEST, len(alike) - 1):
            continue  # the other episodes differ too
        for number in np.flatnonzero(~alike).tolist():
            name = feature.names[component]
            if span[number, component] == 0:
                text = f"{name} does not switch, unlike in the other episodes"
            elif opposite[number, :, component].all():
                text = f"{name} switches the other way than in the other episodes"
            else:
                continue
            yield feature.issue(number, text, [component])


def exchanged_columns(feature: FeatureProfiles) -> Iterator[Issue]:
    """Report columns that are exchanged, negated, offset or reversed in time in one episode.

    An episode is described by five figures per component: 5, 50 and 95 % quantiles, start and
    goal. The figures are compared with their medians over all episodes. The unit of these
    differences is the spread over the episodes.
    """
    if not feature.key.startswith(("observation.", "state", "action")):
        return
    span = feature.median("span")
    moving = np.flatnonzero(feature.smooth & (span > 0) & ~_without_sign(feature))
    if not len(moving):
        return
    levels = feature.stack("levels")[:, 1:4, moving]
    ends = np.stack([feature.stack("start"), feature.stack("goal")], axis=1)[..., moving]
    figures = np.concatenate([levels, ends], axis=1)
    usual = np.median(figures, axis=0)
    # 1.4826 scales a median deviation to the standard deviation of a normal distribution.
    spread = 1.4826 * np.median(np.abs(figures - usual), axis=0).mean(0)
    # Nearly identical episodes have no spread; 5 % of the range replaces it.
    scale = np.maximum(spread, 0.05 * span[moving]) + 1e-9
    names = [feature.names[i] for i in moving]
    for number, own in enumerate(figures):
        off = np.abs(own - usual).mean(0) / scale
        if not (off > _FAR_OFF).any():
            continue
        given = (own, usual, scale, off, names)
        found = _permuted(*given) or _moved(*given)
        if found is not None:
            level, text = found
            far = moving[off > _FAR_OFF].tolist()
            yield feature.issue(number, text, far, float(off.max()), level)


_Figures = Float64[np.ndarray, "5 components"]
_PerComponent = Float64[np.ndarray, " components"]
_Finding = tuple[Literal["error", "warning"], str]


def _permuted(
    own: _Figures, usual: _Figures, scale: _PerComponent, off: _PerComponent, names: list[str]
) -> _Finding | None:
    """Components that exchanged their places."""
    from scipy.optimize import linear_sum_assignment

    cost = np.abs(own[:, :, None] - usual[:, None, :]).mean(0) / scale
    # The bound keeps one outlier from deciding the whole assignment.
    _, best = linear_sum_assignment(np.minimum(cost, 50))
    # Keep cycles of the permutation in which every component is far from its usual values. If
    # only some components of a cycle are far, the cycle arose by chance.
    cyclic, after = best != np.arange(len(best)), best
    for _ in best:
        cyclic &= off[after] > _FAR_OFF
        after = best[after]
    exchanged = np.flatnonzero(cyclic)
    if not len(exchanged):
        return None
    left = cost[exchanged, best[exchanged]]
    # In their new places all components must look usual: within two spreads.
    if left.max() >= 2 or left.mean() >= 0.3 * off[exchanged].mean():
        return None
    pairs = ", ".join(f"{names[i]} like {names[best[i]]}" for i in exchanged[:4])
    return "error", f"columns look exchanged, in this episode alone: {pairs}"


def _moved(
    own: _Figures, usual: _Figures, scale: _PerComponent, off: _PerComponent, names: list[str]
) -> _Finding | None:
    """Components with the opposite sign or a moved zero, or a motion reversed in time."""
    # Negation exchanges the quantiles 5 and 95 %. The negated figures must be usual, and far
    # closer than the original ones.
    turned = np.abs(-own[[2, 1, 0, 3, 4]] - usual).mean(0) / scale
    negated = np.flatnonzero((off > _FAR_OFF) & (turned < 1.5) & (turned < 0.25 * off))
    if len(negated):
        text = "has the opposite sign of the other episodes"
        return "error", f"{text}: {listed(names, negated)}"
    # Compare all components together: a single component may look alike in both directions.
    back = np.abs(own[[0, 1, 2, 4, 3]] - usual).mean(0) / scale
    if off.mean() > 2 and back.mean() < 0.4 * off.mean():
        return "warning", "runs in the reverse direction of the other episodes"
    moved, shift = np.flatnonzero(off > 3 * _FAR_OFF), own - usual
    # A moved zero shifts all five figures by the same amount.
    alike = np.ptp(shift, axis=0) < 0.2 * np.abs(shift.mean(0))
    offset = ", ".join(
        [f"{names[i]} by {shift[1, i]:.3g}" for i in moved if alike[i]][:MOST_NAMED]
    )
    if offset:
        text = f"is offset from the other episodes all along: {offset}: its zero was moved?"
        return "warning", text
    if len(moved):
        return "warning", f"is far from the other episodes: {listed(names, moved)}"
    return None


def _without_sign(feature: FeatureProfiles) -> Bool[np.ndarray, " components"]:
    """Mask of components whose sign can change while the orientation stays the same.

    Such components belong to quaternions, or to rotation vectors that are near half a turn in
    any episode.
    """
    # The last part of a name decides: `object.qy` has the meaning of `qy`.
    meanings = [meaning_of_component(name.rpartition(".")[2]) for name in feature.names]
    roles = np.array([meaning.role if meaning else "" for meaning in meanings])
    vectors = roles == "rotation_vector"
    middles = np.linalg.norm(feature.stack("levels")[:, 2] * vectors, axis=1)
    near_half_turn = bool((middles > _HALF_TURN).any())
    return np.char.startswith(roles, "quaternion") | (vectors & near_half_turn)


def command_tracking(
    command: ColumnSelection, profiles: Sequence[EpisodeProfile]
) -> Iterator[Issue]:
    """Report episodes whose states follow their commands differently than in other episodes.

    Args:
        command: Columns of the commands.
        profiles: Profiles of the episodes that have commands.
    """
    trackings = [profile.tracking["command_position"] for profile in profiles]
    place = {"key": command.columns[0][0], "components": command.labels}
    follow = over_episodes([tracking.fit for tracking in trackings]) > FOLLOWS
    if not follow.any():
        return
    usual_slope = over_episodes([t.slope for t in trackings])
    delays = np.array([t.delay for t in trackings])
    delay = float(np.median(delays))
    if delay < -1:
        text = (
            f"the state moves {-delay:.0f} frames before its command in most episodes: actions "
            f"and states are shifted against each other"
        )
        yield warning(message=text, key=place["key"])
    agreement = (np.abs(delays - delay) <= 2).mean()
    for profile, tracking in zip(profiles, trackings, strict=True):
        shift = tracking.delay - delay
        # The episode's own delay must explain far more of the motion than the usual delay.
        better = gain_over(tracking, round(delay)) > 0.8
        # Estimated delays scatter by three frames.
        if abs(shift) > max(3, 0.1 * abs(delay)) and better and agreement > 0.5:
            text = (
                f"the state comes {tracking.delay} frames after its command, in the other "
                f"episodes {delay:.0f}: actions were shifted against states"
            )
            yield profile.entry.fault(text, severity=abs(shift), **place)
        elif len(trackings) >= FEWEST:
            found = _component_tracking(tracking, usual_slope, follow, command.labels)
            for text, level in found:
                yield profile.entry.fault(text, level=level, **place)


def command_offsets(
    command: ColumnSelection,
    state: ColumnSelection,
    profiles: Sequence[EpisodeProfile],
    features: Sequence[FeatureProfiles],
    unit: UnitDecision,
) -> Iterator[Issue]:
    """Report offsets between commands and resting states, and episodes with unusual offsets.

    Different calibrations of a leader and its follower cause such offsets.

    Args:
        command: Columns of the commands.
        state: Columns of the states that follow the commands.
        profiles: Profiles of the episodes that have commands.
        features: Profiles of all features.
        unit: Unit of the states.
    """
    factors = np.broadcast_to(unit.factor, len(state.columns)) * (unit.si_unit == "rad")
    place: dict[str, Any] = {"key": command.columns[0][0]}
    spans = {feature.key: feature.median("span") for feature in features}
    offsets = np.stack([profile.tracking["command_position"].offset for profile in profiles])
    parts = zip(offsets.T, command.labels, state.columns, np.rad2deg(factors), strict=True)
    for own, name, (key, index), degrees in parts:
        found = np.flatnonzero(np.isfinite(own))
        # A hand that holds an object does not reach its command, and flags have no offset.
        if not len(found) or key not in spans or is_hand(name):
            continue
        usual, least = float(np.median(own[found])), _OFFSET * float(spans[key][index])
        off = np.abs(own[found] - usual)
        if least > 0 and abs(usual) > least and np.median(off) < least / 2:
            text = (
                f"{name} rests {usual:.4g} from its command (action minus state) in "
                f"{len(found)} episodes: leader and follower were calibrated differently"
                + (f", by {usual * degrees:+.1f} deg?" if degrees else "?")
            )
            yield warning(message=text, **place)
        for number in found[off > least] if least > 0 and len(found) >= FEWEST else ():
            text = (
                f"{name} rests {own[number]:.4g} from its command, in the other episodes "
                f"{usual:.4g}: its calibration changed?"
            )
            yield profiles[number].entry.warning(text, **place)


def joint_zeros(
    arm: Arm, columns: Sequence[int], demos: Sequence[Demonstration]
) -> Iterator[Issue]:
    """Report wrong zeros of joints, found from tool positions and the kinematics of the arm.

    Args:
        arm: The arm.
        columns: Columns of its joints.
        demos: Demonstrations with joints [rad] and positions.
    """
    joints = [q[:, columns] for demo in demos if (q := demo.joint_position) is not None]
    positions = [p for demo in demos if (p := demo.position) is not None]
    offsets = zero_offsets(arm, np.concatenate(joints), np.concatenate(positions))
    found = [
        f"{demos[0].joint_names[k]} {np.rad2deg(offset):+.1f} deg"
        for k, offset in zip(columns, offsets, strict=True)
        if offset
    ]
    if found:
        text = "zeros of joints are off: forward kinematics give the recorded positions with"
        yield warning(message=f"{text} {', '.join(found)} added", key="joint_position")


def _component_tracking(
    tracking: Tracking,
    usual_slope: Float64[np.ndarray, " components"],
    follow: Bool[np.ndarray, " components"],
    names: tuple[str, ...],
) -> Iterator[tuple[str, Literal["error", "warning"]]]:
    """Components that follow their command in the other episodes, but not in this one."""
    fit, slope = tracking.fit, tracking.slope
    follows = follow & (fit > FOLLOWS)
    lost = np.flatnonzero(follow & ~(fit > LOST) & ~np.isnan(fit))
    # The slope is the negative of the usual slope, within half of its size.
    opposite = np.abs(slope + usual_slope) < 0.5 * np.abs(usual_slope)
    against = np.flatnonzero(follows & opposite)
    if len(against):
        text = "the state goes the other way than its command, in this episode alone"
        yield f"{text}: {listed(names, against)}", "error"
    elif len(lost):
        text = "the state does not follow its command, as it does in the other episodes"
        yield f"{text}: {listed(names, lost)}", "warning"
    with np.errstate(all="ignore"):
        ratio = np.abs(slope / np.where(usual_slope, usual_slope, 1))
    # Above a factor of exp(0.5) = 1.6: payload and contact cause smaller changes.
    size = np.flatnonzero(follows & (np.abs(np.log(ratio + 1e-9)) > 0.5))
    if len(size):
        text = (
            f"the state goes {slope[size[0]]:.2g} times as far as its command, in the other "
            f"episodes {usual_slope[size[0]]:.2g}: {listed(names, size)}"
        )
        yield text, "warning"
