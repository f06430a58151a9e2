"""Robust statistics of one episode's columns, and of how the state follows the command.

Apart from the lowest and highest value, no statistic depends on a single value: sizes are
quantiles, delays and slopes use all frames. The contract (`contract`) and the consistency
checks (`quality.consistency_checks`) compare these profiles over episodes.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, Shaped

from hrc_learn.demos.issues import Issue
from hrc_learn.demos.read.dataset_folder import DatasetFolder, EpisodeEntry
from hrc_learn.demos.read.quantities import INDEX_KEYS
from hrc_learn.demos.read.units import Quantities

# Half a percent at either end is ignored: these values may be glitches.
_LEVELS = (0.005, 0.05, 0.5, 0.95, 0.995)
_MOST_FRAMES = 4000
"""Frames used to find a delay; the middle of a longer episode is enough."""
_LONGEST_DELAY = 1.5
"""Largest delay considered [s]; no controller answers later."""
# Negligible fraction of the variance: an error of a tenth of the motion leaves 0.01
# unexplained.
_NEGLIGIBLE = 0.01
# Largest residual variance of a component that follows its command.
_FOLLOWED = 0.2
_REST, _FEWEST_STILL = 5, 5
"""`_REST`: number of frames over which a component at rest hardly moves. `_FEWEST_STILL`:
smallest number of frames at rest that give an offset."""
_REST_MOTION = 0.005
"""Largest motion at rest, relative to the range."""
FOLLOWS = 0.8
"""R squared above which a state follows its command."""
LOST = 0.4
"""R squared below which a state does not follow its command."""
_SAME_SLOPE = 0.3
"""Largest relative difference from the typical slope, for components in the same unit."""
_SAME_UNIT, _LATE = np.log(2.0), 0.75
"""`_SAME_UNIT`: largest absolute logarithm of the slope, here a factor of 2, of a state that
follows commanded positions. `_LATE`: largest delay of such a state [s]."""
PROMPT = 0.2
"""Delay within which an arm follows its command [s]. Longer delays are doubtful: a slow motion
that is delayed by more than this resembles its own rate of change."""
RATE_WINDOW = 0.2
"""Averaging time for joint rates and for the commands that are compared with them [s]. A change
from frame to frame is mostly noise."""
MOST_NAMED = 6
"""Largest number of components named in a message."""
# Largest relative variance of a window in which a component rests; rounding causes this much.
_RESTING = 1e-10


@dataclass(frozen=True, kw_only=True, slots=True)
class ColumnProfile:
    """Statistics of one feature during one episode, one number per component."""

    levels: Float64[np.ndarray, "5 _components"]
    """Quantiles 0.5, 5, 50, 95 and 99.5 %."""
    start: Float64[np.ndarray, " _components"]
    """Median of the first frames."""
    goal: Float64[np.ndarray, " _components"]
    """Median of the last frames."""
    step: Float64[np.ndarray, " _components"]
    """99 % quantile of the change from frame to frame."""
    noise: Float64[np.ndarray, " _components"]
    """Median size of the second difference."""
    held: Int64[np.ndarray, " _components"]
    """Largest number of consecutive frames without any change."""
    distinct: Int64[np.ndarray, " _components"]
    """Number of distinct values."""
    low: Float64[np.ndarray, " _components"]
    high: Float64[np.ndarray, " _components"]
    at_ends: Int64[np.ndarray, "2 _components"]
    """Number of frames at the lowest and at the highest value."""
    flat: Float64[np.ndarray, " _components"]
    """Fraction of steps without any change."""

    @property
    def peak(self) -> Float64[np.ndarray, " components"]:
        """Largest absolute value, without half a percent at either end."""
        return np.abs(self.levels[[0, -1]]).max(0)

    @property
    def span(self) -> Float64[np.ndarray, " components"]:
        """Range, without half a percent at either end."""
        return self.levels[-1] - self.levels[0]


@dataclass(frozen=True, kw_only=True, slots=True)
class Tracking:
    """Relation between a command and the state that follows it during one episode."""

    delay: int
    """Delay of the state, the same for all components [frames]."""
    residual: Float32[np.ndarray, " delays"]
    """Fraction of the variance left unexplained at each delay, from the longest lead to the
    longest delay, averaged over the components that follow their command."""
    slope: Float64[np.ndarray, " components"]
    """Change of the state per change of the command, at that delay."""
    fit: Float64[np.ndarray, " components"]
    """Fraction of the state's variance that the command explains (R squared)."""
    offset: Float64[np.ndarray, " components"]
    """Command minus state while both rest; NaN where they rest too seldom."""


@dataclass(frozen=True, kw_only=True, slots=True)
class EpisodeProfile:
    """Statistics of one episode."""

    entry: EpisodeEntry
    columns: dict[str, ColumnProfile]
    """Profile of each feature."""
    tracking: dict[str, Tracking] = field(default_factory=dict)
    """Relations by name. `command_position`: joint positions that follow position commands.
    `command_velocity`: joint rates that follow velocity commands. `rates`: joint rates that
    follow position commands, only known if the joint positions do not promptly follow these
    commands. Rates are means over `RATE_WINDOW`."""


def profile_columns(
    frames: Mapping[str, Shaped[np.ndarray, "_frames _components"]],
) -> dict[str, ColumnProfile]:
    """Profiles of all columns of finite numbers, without LeRobot's own index columns."""
    profiles = {}
    for key, values in frames.items():
        if key in INDEX_KEYS or not len(values) or values.dtype.kind not in "fiub":
            continue
        values = values.astype(float)
        if np.isfinite(values).all():
            profiles[key] = _profile(values)
    return profiles


def _profile(values: Float64[np.ndarray, "frames components"]) -> ColumnProfile:
    # In its first and last five frames, an arm usually rests. Their median suppresses glitches.
    few = max(1, min(5, len(values) // 4))
    # One sort gives the quantiles and the number of distinct values.
    ordered = np.sort(values, axis=0)
    places = np.rint(np.array(_LEVELS) * (len(values) - 1)).astype(int)
    steps = np.abs(np.diff(values, axis=0)) if len(values) > 1 else np.zeros_like(values)
    bends = np.abs(np.diff(values, 2, axis=0)) if len(values) > 2 else np.zeros_like(values)
    at = min(len(steps) - 1, int(0.99 * len(steps)))
    return ColumnProfile(
        levels=ordered[places],
        start=_middle(values[:few]),
        goal=_middle(values[-few:]),
        step=np.partition(steps, at, axis=0)[at].copy(),
        noise=_middle(bends),
        held=_longest_hold(values),
        distinct=1 + (np.diff(ordered, axis=0) > 0).sum(0),
        low=ordered[0].copy(),  # a view would keep all frames in memory
        high=ordered[-1].copy(),
        at_ends=np.stack([(values == end).sum(0) for end in (ordered[0], ordered[-1])]),
        flat=(steps == 0).mean(0),
    )


def _middle(
    values: Float64[np.ndarray, "frames components"],
) -> Float64[np.ndarray, " components"]:
    """Median of each component, ten times faster than `np.median` for a short episode."""
    places = (len(values) - 1) // 2, len(values) // 2
    ordered = np.partition(values, places, axis=0)
    return (ordered[places[0]] + ordered[places[1]]) / 2


def _longest_hold(
    values: Float64[np.ndarray, "frames components"],
) -> Int64[np.ndarray, " components"]:
    """Largest number of consecutive frames with the same value."""
    count = np.arange(len(values))[:, None]
    changed = np.ones(values.shape, dtype=bool)
    changed[1:] = values[1:] != values[:-1]
    since = np.maximum.accumulate(np.where(changed, count, 0), axis=0)
    return 1 + (count - since).max(0)


def is_discrete(profile: ColumnProfile, length: int) -> np.ndarray:
    """Mask of components that switch between levels: commands, flags, grippers.

    They have few levels in all, or rest most of the time and jump between few levels.
    """
    # Up to 12 levels in long episodes: grippers with several openings.
    few = profile.distinct <= max(4, min(12, length // 20))
    span = np.maximum(profile.levels[-1] - profile.levels[0], 1e-12)
    # A switch rests in most frames, jumps by at least a fifth of the range, and has few values.
    switching = (profile.flat > 0.9) & (profile.step > 0.2 * span) & (profile.distinct < 50)
    return few | switching


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

    def median(self, name: str) -> Float64[np.ndarray, " components"]:
        """Median of one statistic over the episodes, for each component."""
        return np.median(self.stack(name), axis=0)

    @cached_property
    def constant(self) -> Bool[np.ndarray, " components"]:
        """Mask of components that have one value in all episodes."""
        return self.stack("low").min(0) == self.stack("high").max(0)

    @property
    def varied(self) -> Bool[np.ndarray, " components"]:
        """Mask of components that are smooth, or whose extremes take more than four values.

        Values such as pixels may hardly change within short episodes, but their extremes differ
        between episodes.
        """
        ends = np.sort(np.concatenate([self.stack("low"), self.stack("high")]), axis=0)
        return self.smooth | ((np.diff(ends, axis=0) > 0).sum(0) > 3)

    def named(self, chosen: Bool[np.ndarray, " components"]) -> str:
        """Names of the chosen components."""
        if chosen.all() and len(chosen) > 1:
            return "all components"
        return listed(self.names, np.flatnonzero(chosen))

    def issue(
        self,
        number: int,
        text: str,
        components: Sequence[int],
        severity: float = 0.0,
        level: Literal["error", "warning"] = "warning",
    ) -> Issue:
        """Issue of components in one of the episodes."""
        return self.entries[number].fault(
            text,
            key=self.key,
            components=tuple(self.names[i] for i in components),
            severity=severity,
            level=level,
        )

    @property
    def lengths(self) -> Int64[np.ndarray, " episodes"]:
        """Number of frames of each episode."""
        return np.array([entry.length for entry in self.entries])


def listed(names: Sequence[str], places: Sequence[int] | np.ndarray) -> str:
    """Names of the components with these indices, at most `MOST_NAMED`."""
    return ", ".join(names[int(place)] for place in places[:MOST_NAMED])


def feature_profiles(
    folder: DatasetFolder, profiles: Sequence[EpisodeProfile]
) -> Iterator[FeatureProfiles]:
    """Profiles of all episodes, feature by feature."""
    for key, declared in folder.features.items():
        known = [p for p in profiles if key in p.columns and key not in INDEX_KEYS]
        widths = {p.columns[key].start.shape for p in known}
        if widths != {(declared.width,)}:
            continue  # the check of the columns reports this
        discrete = np.mean([is_discrete(p.columns[key], p.entry.length) for p in known], axis=0)
        yield FeatureProfiles(
            key=key,
            fps=folder.fps,
            entries=[p.entry for p in known],
            profiles=[p.columns[key] for p in known],
            names=[declared.component(i) for i in range(declared.width)],
            smooth=discrete < 0.5,
        )


def gain_over(tracking: Tracking, delay: int) -> float:
    """Relative improvement of the fit at the episode's own delay over another delay, 0 to 1.

    The improvement is 0 if the other delay fits well too: delays of slow motions are hard to
    determine.
    """
    residual = tracking.residual
    other = residual[int(np.clip(len(residual) // 2 + delay, 0, len(residual) - 1))]
    return float(1 - residual.min() / other) if other > _NEGLIGIBLE else 0.0


def _correlations(
    command: Float64[np.ndarray, "frames components"],
    state: Float64[np.ndarray, "frames components"],
    reach: int,
) -> Float64[np.ndarray, "delays components"]:
    """Correlation of state(t) with command(t - delay), for delays from -reach to reach.

    For each delay, the same frames of the state are compared with a window of the command. The
    correlation is 0 if the command rests in this window.
    """
    inner = len(state) - 2 * reach
    # Scaled to mean 0 and variance 1; 0 where nothing moves.
    late, early = (
        (values - values.mean(0)) / np.maximum(values.std(0), 1e-12)
        for values in (state[reach : reach + inner], command)
    )
    windows = np.lib.stride_tricks.sliding_window_view(early, inner, axis=0)
    product = np.einsum("dcn,nc->dc", windows, late) / inner
    # Mean and variance of all windows from running sums.
    first = np.zeros((1, early.shape[1]))
    sums, squares = (np.concatenate([first, np.cumsum(x, axis=0)]) for x in (early, early**2))
    mean = (sums[inner:] - sums[:-inner]) / inner
    variance = (squares[inner:] - squares[:-inner]) / inner - mean**2
    found = product / np.sqrt(np.maximum(variance, _RESTING))
    return np.where(variance > _RESTING, found, 0.0)[::-1]  # the last window has delay -reach


def track(
    command: Float64[np.ndarray, "frames components"],
    state: Float64[np.ndarray, "frames components"],
    fps: float,
) -> Tracking | None:
    """Relation between command and state; None if nothing moves or frames are too few."""
    frames = len(state)
    if frames > _MOST_FRAMES:
        first = (frames - _MOST_FRAMES) // 2
        command, state = (v[first : first + _MOST_FRAMES] for v in (command, state))
        frames = _MOST_FRAMES
    # At least half of the frames must remain to compare at every delay.
    reach = min(round(_LONGEST_DELAY * fps), frames // 4)
    if frames < 20 or reach < 1:
        return None
    size = np.minimum(state.std(0), command.std(0))
    # The motion must exceed the rounding errors of the values.
    moving = size > 1e-9 * (1 + np.abs(state).max(0))
    if not moving.any():
        return None
    offset = _resting_offset(command, state)
    left = 1 - np.maximum(_correlations(command[:, moving], state[:, moving], reach), 0) ** 2
    # Hands and grippers that stop at an object do not show the delay.
    followed = left.min(0) < _FOLLOWED
    residual = left[:, followed if followed.any() else slice(None)].mean(1)
    delay = int(residual.argmin()) - reach
    a = command[max(-delay, 0) : frames + min(-delay, 0)]
    s = state[max(delay, 0) : frames + min(delay, 0)]
    a0, s0 = a - a.mean(0), s - s.mean(0)
    power, answer, product = (a0**2).sum(0), (s0**2).sum(0), (a0 * s0).sum(0)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = product / power
        fit = product**2 / (power * answer)
    slope[~moving] = fit[~moving] = np.nan
    # Where nothing rests, a state that copies its command, with a slope of 1 up to noise, shows
    # the offset, too.
    copied = np.isnan(offset) & (fit > 1 - _NEGLIGIBLE) & (np.abs(slope - 1) < 2 * _NEGLIGIBLE)
    offset = np.where(copied, a.mean(0) - s.mean(0), offset)
    return Tracking(
        delay=delay, residual=residual.astype(np.float32), slope=slope, fit=fit, offset=offset
    )


def _resting_offset(
    command: Float64[np.ndarray, "frames components"],
    state: Float64[np.ndarray, "frames components"],
) -> Float64[np.ndarray, " components"]:
    """Median of command minus state over the frames in which both hardly move."""
    span = np.maximum(np.ptp(state, axis=0), np.ptp(command, axis=0))
    # Values are compared over five frames, so that a slow motion does not count as rest.
    still = np.maximum(
        *(np.abs(values[_REST:] - values[:-_REST]) for values in (command, state))
    ) <= _REST_MOTION * np.maximum(span, 1e-12)
    # Frames in motion are sorted last; the middle of the others is their median.
    gap = np.sort(np.where(still, (command - state)[_REST:], np.inf), axis=0)
    count = still.sum(0)
    places = np.stack([np.maximum(count - 1, 0) // 2, np.minimum(count // 2, len(gap) - 1)])
    middle = np.take_along_axis(gap, places, axis=0).mean(0)
    return np.where(count >= _FEWEST_STILL, middle, np.nan)


def track_quantities(quantities: Quantities, fps: float) -> dict[str, Tracking]:
    """Tracking of commands in one episode, as in `EpisodeProfile`.

    Args:
        quantities: Values by role.
        fps: Frame rate [1/s].
    """
    joints, found = quantities.get("joint_position"), {}
    if joints is None or len(joints) < 3:
        return {}
    position, velocity = (
        quantities.get(f"command_{kind}") for kind in ("position", "velocity")
    )
    window = min(max(2, round(RATE_WINDOW * fps)), len(joints) - 1)
    rates = (joints[window:] - joints[:-window]) * fps / window
    if position is not None and position.shape == joints.shape:
        found["command_position"] = tracking = track(position, joints, fps)
        late = tracking is not None and abs(tracking.delay) / fps > PROMPT
        # The fit is NaN where nothing moves.
        if tracking is None or late or (tracking.fit <= FOLLOWS).any():
            found["rates"] = track(_means(position, window), rates, fps)
    if velocity is not None and velocity.shape == joints.shape:
        found["command_velocity"] = track(_means(velocity, window), rates, fps)
    return {name: tracking for name, tracking in found.items() if tracking is not None}


def _means(
    values: Float64[np.ndarray, "frames components"], window: int
) -> Float64[np.ndarray, "_windows components"]:
    """Moving mean: entry k is the mean of the frames k to k + `window` (exclusive)."""
    sums = np.cumsum(values, axis=0)
    return (sums[window:] - sums[:-window] - values[window:] + values[:-window]) / window


def commanded_rates(
    trackings: Sequence[Mapping[str, Tracking]], fps: float
) -> tuple[Float64[np.ndarray, " components"], float] | None:
    """Evidence that commands named as positions are changes or velocities.

    Args:
        trackings: Tracking in each episode, as `track_quantities` gives it.
        fps: Frame rate [1/s].

    Returns:
        Joint rate per unit of the command [1/s], NaN for components that do not follow. Typical
        R squared: the fraction of the variance of the rates that the commands explain. None
        instead of both if most joints do not follow.
    """
    positions, rates = (
        [known[name] for known in trackings if name in known]
        for name in ("command_position", "rates")
    )
    if not rates or 2 * len(rates) < len(trackings):
        return None
    rate_delay, position_delay = (
        abs(float(np.median([t.delay for t in group]))) / fps for group in (rates, positions)
    )
    fit, slope = (over_episodes([getattr(t, name) for t in rates]) for name in ("fit", "slope"))
    position_fit = over_episodes([t.fit for t in positions])
    # If both interpretations fit a smooth motion, the one without a long delay is right.
    prompt = rate_delay <= PROMPT < position_delay
    followed = (position_fit < LOST) | (prompt & (position_fit < fit))
    followed &= (fit > FOLLOWS) & (slope > 0)
    # Joints that move together seem to follow any command, but by different factors.
    typical = np.median(slope[followed]) if followed.any() else 0.0
    followed &= np.abs(slope - typical) < _SAME_SLOPE * typical
    if 2 * followed.sum() <= len(slope):
        return None
    return np.where(followed, slope, np.nan), float(np.median(fit[followed]))


def are_positions(trackings: Sequence[Mapping[str, Tracking]], fps: float) -> bool:
    """True if the joints follow commands as positions in the same unit, or if none moves."""
    votes = []
    for tracking in (known["command_position"] for known in trackings if len(known)):
        near = (tracking.fit > LOST) & (np.abs(np.log(np.abs(tracking.slope))) < _SAME_UNIT)
        near &= (tracking.slope > 0) & (-PROMPT <= tracking.delay / fps <= _LATE)
        votes.append(near[np.isfinite(tracking.fit)].mean() >= 0.5)
    return not votes or bool(np.mean(votes) >= 0.5)


def over_episodes(rows: Sequence[np.ndarray]) -> Float64[np.ndarray, " components"]:
    """Median over episodes; components that rest count as 0."""
    with np.errstate(all="ignore"):
        return np.nan_to_num(np.median(np.nan_to_num(np.stack(rows)), axis=0))
