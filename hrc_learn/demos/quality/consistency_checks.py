"""Checks of one episode against the others: sizes, rests, noise, switches and columns."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from hrc_learn.demos.format.dataset_folder import DatasetFolder, EpisodeEntry
from hrc_learn.demos.issues import Issue
from hrc_learn.demos.read.profiles import ColumnProfile, EpisodeProfile, is_discrete
from hrc_learn.demos.read.quantities import meaning_of_component

FEWEST = 3
"""Fewest episodes among which one can be compared with the others."""
_IMPOSSIBLE = 1e12
"""Size that no sensor reports: flipped bits, or memory that was never written."""
_IMPLAUSIBLE = 1e3
"""Multiple of the usual size that no sensor reports."""
_FAR_OFF = 3.0
"""Distance from the other episodes, in spreads, above which an episode is examined."""
_HALF_TURN = 0.9 * np.pi
"""Length of a rotation vector [rad] above which noise of the hand can flip its sign."""
_MOST_NAMED = 6
"""Components named in a message."""


@dataclass(frozen=True, kw_only=True)
class FeatureProfiles:
    """Profiles of one feature in all episodes that hold it."""

    key: str
    fps: float
    """Frame rate [1/s]."""
    entries: list[EpisodeEntry]
    profiles: list[ColumnProfile]
    names: list[str]
    smooth: np.ndarray
    """Mask of components that move without switching, in most episodes."""

    def stack(self, name: str) -> Float64[np.ndarray, "episodes ..."]:
        """One statistic of every profile."""
        return np.stack([getattr(profile, name) for profile in self.profiles]).astype(float)

    @property
    def lengths(self) -> Int64[np.ndarray, " episodes"]:
        """Number of frames of each episode."""
        return np.array([entry.length for entry in self.entries])

    @property
    def span(self) -> Float64[np.ndarray, " components"]:
        """Usual range of each component."""
        return np.median(self.stack("span"), axis=0)

    @property
    def is_comparable(self) -> bool:
        """True if there are enough episodes to compare."""
        return len(self.entries) >= FEWEST


def feature_profiles(
    folder: DatasetFolder,
    entries: Mapping[int, EpisodeEntry],
    profiles: Mapping[int, EpisodeProfile],
) -> Iterator[FeatureProfiles]:
    """Profiles of all episodes, feature by feature."""
    for key, declared in folder.features.items():
        known = [p for p in profiles.values() if key in p.columns]
        widths = {p.columns[key].start.shape for p in known}
        if widths != {(declared.width,)}:
            continue  # reported with the columns
        discrete = np.mean([is_discrete(p.columns[key], p.length) for p in known], axis=0)
        yield FeatureProfiles(
            key=key,
            fps=folder.fps,
            entries=[entries[p.index] for p in known],
            profiles=[p.columns[key] for p in known],
            names=[declared.component(i) for i in range(declared.width)],
            smooth=discrete < 0.5,
        )


def lengths(entries: Sequence[EpisodeEntry]) -> Iterator[Issue]:
    """Episodes that were interrupted, or joined."""
    if len(entries) <= FEWEST:
        return
    usual = float(np.median([entry.length for entry in entries]))
    for entry in entries:
        # Operators differ by a factor of two or three, not by five.
        if not usual / 5 < entry.length < 5 * usual:
            yield entry.warning(
                f"has {entry.length} frames where {usual:.0f} are usual: broken off, "
                f"or several in one?"
            )


def sizes(feature: FeatureProfiles) -> Iterator[Issue]:
    """Values that no robot reports."""
    usual = np.median(feature.stack("peak"), axis=0)
    largest = feature.stack("largest")
    scale = np.maximum(usual, np.where(feature.smooth, 1e-3, np.inf))
    absurd = (largest > _IMPOSSIBLE) | (largest > _IMPLAUSIBLE * scale)
    absurd &= np.array([not _is_clock_name(name, feature.key) for name in feature.names])
    for number, component in np.argwhere(absurd):
        name, size = feature.names[component], largest[number, component]
        yield feature.entries[number].fault(
            f"{name} reaches {size:.3g}, usually {usual[component]:.3g}: the file was "
            f"damaged, or memory was never written; leave the episode out",
            key=feature.key,
            components=(name,),
            severity=float(np.log(size)),
        )


def _is_clock_name(name: str, key: str) -> bool:
    """True for clocks, which are large by nature."""
    return any("time" in text.lower() or "stamp" in text.lower() for text in (name, key))


def holds(feature: FeatureProfiles) -> Iterator[Issue]:
    """Components that froze in one episode, and hardly ever rest in the others."""
    if not feature.is_comparable:
        return
    held, frames = feature.stack("held"), feature.lengths
    fraction = held / frames[:, None]
    usual = np.median(fraction, axis=0)
    # Long in itself, long for this component, and longer than any pause of the operator.
    frozen = (
        (fraction > 0.1) & (fraction > 5 * usual + 0.02) & (held > max(10, 0.3 * feature.fps))
    )
    frozen &= feature.smooth & (feature.span > 0)
    for number, component in np.argwhere(frozen):
        name = feature.names[component]
        yield feature.entries[number].warning(
            f"{name} stays the same for {held[number, component]:.0f} of "
            f"{frames[number]} frames, usually for {100 * usual[component]:.0f} %: the "
            f"encoder froze?",
            key=feature.key,
            components=(name,),
            severity=float(fraction[number, component]),
        )


def noise(feature: FeatureProfiles) -> Iterator[Issue]:
    """Components far noisier, or far coarser, in one episode than in the others."""
    if not feature.is_comparable:
        return
    noise, span = feature.stack("noise"), feature.span
    moving = feature.smooth & (span > 0)
    # Second differences vary by a factor of three between operators, not by ten.
    noisy = (noise > 10 * np.median(noise, axis=0)) & (noise > 0.005 * span) & moving
    frames = feature.lengths[:, None]
    levels = feature.stack("distinct") / frames
    # A fifth of the usual levels: values were rounded or the encoder lost bits.
    coarse = (levels < 0.2 * np.median(levels, axis=0)) & moving
    coarse &= feature.stack("held") / frames < 0.1  # otherwise it rests
    for odd, what in ((noisy, "far noisier"), (coarse, "of far fewer levels")):
        for number in np.flatnonzero(odd.any(1)):
            names = [feature.names[i] for i in np.flatnonzero(odd[number])]
            yield feature.entries[number].warning(
                (f"is {what} than in the other episodes: {', '.join(names[:_MOST_NAMED])}"),
                key=feature.key,
                components=tuple(names),
                severity=float(odd[number].sum()),
            )


def switches(feature: FeatureProfiles) -> Iterator[Issue]:
    """Grippers and flags that stay, or switch the other way, in one episode alone."""
    if not feature.is_comparable:
        return
    span, usual_span = feature.stack("span"), feature.span
    ends = np.stack([feature.stack("start"), feature.stack("goal")], axis=1)
    usual = np.median(ends, axis=0)
    # Ends within a tenth of the range count as the same level.
    near = np.abs(ends - usual) <= 0.1 * usual_span
    opposite = np.abs(ends - usual[::-1]) <= 0.1 * usual_span
    # Only components that usually change their level from start to goal.
    switching = ~feature.smooth & (np.ptp(usual, axis=0) > 0.5 * usual_span) & (usual_span > 0)
    for component in np.flatnonzero(switching):
        alike = near[:, :, component].all(1)
        if alike.sum() < max(FEWEST, len(alike) - 1):
            continue  # the other episodes differ too
        for number in np.flatnonzero(~alike):
            name = feature.names[component]
            if span[number, component] == 0:
                text = f"{name} stays, it switches in the other episodes"
            elif opposite[number, :, component].all():
                text = f"{name} switches the other way than in the other episodes"
            else:
                continue
            yield feature.entries[number].warning(text, key=feature.key, components=(name,))


def exchanged_columns(feature: FeatureProfiles) -> Iterator[Issue]:
    """Columns exchanged, negated, offset or run backwards in one episode.

    An episode is described by five figures per component (5, 50 and 95 % quantiles, start and
    goal) and compared with the median over all episodes, in units of their spread.
    """
    if not feature.is_comparable or not feature.key.startswith(
        ("observation.", "state", "action")
    ):
        return
    moving = np.flatnonzero(feature.smooth & (feature.span > 0) & ~_without_sign(feature))
    if not len(moving):
        return
    levels = feature.stack("levels")[:, 1:4, moving]
    ends = np.stack([feature.stack("start"), feature.stack("goal")], axis=1)[..., moving]
    figures = np.concatenate([levels, ends], axis=1)
    usual = np.median(figures, axis=0)
    # 1.4826 scales a median deviation to the standard deviation of a normal distribution.
    spread = 1.4826 * np.median(np.abs(figures - usual), axis=0).mean(0)
    # Nearly identical episodes have no spread; 5 % of the range replaces it.
    scale = np.maximum(spread, 0.05 * feature.span[moving]) + 1e-9
    names = [feature.names[i] for i in moving]
    for number, own in enumerate(figures):
        off = np.abs(own - usual).mean(0) / scale
        if not (off > _FAR_OFF).any():
            continue
        found = (
            _permuted(own, usual, scale, off, names)
            or _negated(own, usual, scale, off, names)
            or _reversed(own, usual, scale, off)
            or _offset(own, usual, off, names)
        )
        if found is not None:
            level, text = found
            yield Issue(
                message=text,
                level=level,
                **feature.entries[number].location,
                key=feature.key,
                components=tuple(names[i] for i in np.flatnonzero(off > _FAR_OFF)),
                severity=float(off.max()),
            )


_Figures = Float64[np.ndarray, "5 components"]
_PerComponent = Float64[np.ndarray, " components"]


def _permuted(
    own: _Figures, usual: _Figures, scale: _PerComponent, off: _PerComponent, names: list[str]
) -> tuple | None:
    """Components that took each other's place."""
    from scipy.optimize import linear_sum_assignment

    cost = np.abs(own[:, :, None] - usual[:, None, :]).mean(0) / scale
    # The bound keeps one outlier from deciding the whole assignment.
    _, best = linear_sum_assignment(np.minimum(cost, 50))
    exchanged = _displaced_cycles(best, off > _FAR_OFF)
    after = cost[exchanged, best[exchanged]]
    # In their new places all components must look usual: within two spreads.
    if len(exchanged) < 2 or after.max() >= 2:
        return None
    if after.mean() >= 0.3 * off[exchanged].mean():
        return None
    pairs = ", ".join(f"{names[i]} like {names[best[i]]}" for i in exchanged[:4])
    return "error", f"columns look exchanged, in this episode alone: {pairs}"


def _displaced_cycles(
    best: Int64[np.ndarray, " components"], off: Bool[np.ndarray, " components"]
) -> Int64[np.ndarray, " _"]:
    """Components of permutation cycles in which every component is far from its usual place.

    If only some are far off, they resemble the others by chance.
    """
    found = []
    for first in range(len(best)):
        ring = [first]
        while best[ring[-1]] != first:
            ring.append(int(best[ring[-1]]))
        if len(ring) > 1 and off[ring].all():
            found.append(first)
    return np.array(found, dtype=int)


def _negated(
    own: _Figures, usual: _Figures, scale: _PerComponent, off: _PerComponent, names: list[str]
) -> tuple | None:
    """Components with the opposite sign; negation exchanges the quantiles 5 and 95 %."""
    turned = np.abs(-own[[2, 1, 0, 3, 4]] - usual).mean(0) / scale
    # The negated figures must be usual, and far closer than the original ones.
    negated = np.flatnonzero((off > _FAR_OFF) & (turned < 1.5) & (turned < 0.25 * off))
    if not len(negated):
        return None
    listed = ", ".join(names[i] for i in negated[:_MOST_NAMED])
    return "error", f"has the other sign than in the other episodes: {listed}"


def _reversed(
    own: _Figures, usual: _Figures, scale: _PerComponent, off: _PerComponent
) -> tuple | None:
    """A motion from the usual goal to the usual start."""
    back = np.abs(own[[0, 1, 2, 4, 3]] - usual).mean(0) / scale
    # All components together: single ones look alike in both directions.
    if off.mean() > 2 and back.mean() < 0.4 * off.mean():
        return "warning", "runs the other way than the other episodes"
    return None


def _offset(
    own: _Figures, usual: _Figures, off: _PerComponent, names: list[str]
) -> tuple | None:
    """Components shifted as a whole, or far from the other episodes in another way."""
    moved = np.flatnonzero(off > 3 * _FAR_OFF)
    shift = own - usual
    # A moved zero shifts all five figures by the same amount.
    alike = np.ptp(shift, axis=0) < 0.2 * np.abs(shift.mean(0))
    offset = [i for i in moved if alike[i]]
    if offset:
        listed = ", ".join(f"{names[i]} by {shift[1, i]:.3g}" for i in offset[:_MOST_NAMED])
        return "warning", (
            f"is offset from the other episodes all along: {listed}: its zero was moved?"
        )
    if not len(moved):
        return None
    listed = ", ".join(names[i] for i in moved[:_MOST_NAMED])
    return "warning", f"is far from the other episodes: {listed}"


def _without_sign(feature: FeatureProfiles) -> Bool[np.ndarray, " components"]:
    """Mask of components of orientations whose sign has no meaning.

    These are quaternions, and rotation vectors near half a turn in any episode.
    """
    meanings = map(meaning_of_component, feature.names)
    roles = np.array([meaning.role if meaning else "" for meaning in meanings])
    vectors = roles == "rotation_vector"
    middles = np.linalg.norm(feature.stack("levels")[:, 2] * vectors, axis=1)
    near_half_turn = bool((middles > _HALF_TURN).any())
    return np.char.startswith(roles, "quaternion") | (vectors & near_half_turn)
