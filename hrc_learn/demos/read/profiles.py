"""What one episode says of its columns: robust sizes, rests, how the action leads the state.

No figure here hangs on a single value: sizes are quantiles, delays and slopes are found from
all frames. A `Contract` and the check compare these profiles over episodes.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32, Float64, Int64, Shaped

from hrc_learn.demos.read.roles import INDEX_KEYS

Columns = Mapping[str, Shaped[np.ndarray, "_frames _components"]]

# Half a percent at either end is left to glitches.
_LEVELS = (0.005, 0.05, 0.5, 0.95, 0.995)
_MOST_FRAMES = 4000
"""Frames a delay is looked for in; the middle of longer episodes is enough."""
_LONGEST_DELAY = 1.5
"""No controller answers later than this [s]."""


@dataclass(frozen=True, slots=True)
class ColumnProfile:
    """One feature during one episode, a number for each component.

    All are kept in one array: of 10,000 episodes small ones take more than their numbers.
    """

    figures: Float64[np.ndarray, "13 components"]

    @property
    def levels(self) -> Float64[np.ndarray, "5 components"]:
        """Quantiles 0.5, 5, 50, 95 and 99.5 %."""
        return self.figures[:5]

    @property
    def start(self) -> Float64[np.ndarray, " components"]:
        """Median of the first frames."""
        return self.figures[5]

    @property
    def goal(self) -> Float64[np.ndarray, " components"]:
        """Median of the last frames."""
        return self.figures[6]

    @property
    def step(self) -> Float64[np.ndarray, " components"]:
        """Change from frame to frame that one in a hundred is above."""
        return self.figures[7]

    @property
    def noise(self) -> Float64[np.ndarray, " components"]:
        """Median size of the second difference."""
        return self.figures[8]

    @property
    def held(self) -> Float64[np.ndarray, " components"]:
        """Most frames in a row without any change."""
        return self.figures[9]

    @property
    def distinct(self) -> Float64[np.ndarray, " components"]:
        """Values that differ."""
        return self.figures[10]

    @property
    def largest(self) -> Float64[np.ndarray, " components"]:
        """Largest absolute value."""
        return self.figures[11]

    @property
    def flat(self) -> Float64[np.ndarray, " components"]:
        """Share of steps without any change."""
        return self.figures[12]

    @property
    def peak(self) -> Float64[np.ndarray, " components"]:
        """Largest absolute value but for half a percent at either end."""
        return np.abs(self.levels[[0, -1]]).max(0)

    @property
    def span(self) -> Float64[np.ndarray, " components"]:
        """Range but for half a percent at either end."""
        return self.levels[-1] - self.levels[0]


@dataclass(frozen=True, kw_only=True, slots=True)
class Tracking:
    """How a command and the component that follows it go together during one episode."""

    delay: int
    """Frames by which the state comes later, the same for all components."""
    residual: Float32[np.ndarray, " delays"]
    """What is left of the variance of the components that follow their command, at each delay,
    from the longest lead on."""
    slope: Float64[np.ndarray, " components"]
    """Change of the state for a change of the command, at that delay."""
    fit: Float64[np.ndarray, " components"]
    """Share of the state's variance that the command explains (R squared)."""
    partner: Int64[np.ndarray, " components"]
    """State that each command is most like."""
    likeness: Float64[np.ndarray, " components"]
    """Size of their correlation; 0 where one of them rests."""


@dataclass(frozen=True, kw_only=True, slots=True)
class EpisodeProfile:
    """One episode, feature by feature."""

    index: int
    length: int
    columns: dict[str, ColumnProfile]
    """By feature."""
    tracking: dict[str, Tracking] = field(default_factory=dict)
    """By the role of the command: `command_position` against the joints, `command_velocity` and
    `joint_velocity` against their rates, `rates` for commands of position against rates."""


def profile_columns(frames: Columns) -> dict[str, ColumnProfile]:
    """Profiles of all columns that hold finite numbers, LeRobot's own left out."""
    profiles = {}
    for key, values in frames.items():
        if key in INDEX_KEYS or not len(values) or values.dtype.kind not in "fiub":
            continue
        values = values.astype(float)
        if np.isfinite(values).all():
            profiles[key] = _profile(values)
    return profiles


def _profile(values: Float64[np.ndarray, "frames components"]) -> ColumnProfile:
    few = max(1, min(5, len(values) // 4))
    # Sorting once gives the quantiles and what differs.
    ordered = np.sort(values, axis=0)
    places = np.rint(np.array(_LEVELS) * (len(values) - 1)).astype(int)
    steps = np.abs(np.diff(values, axis=0)) if len(values) > 1 else np.zeros_like(values)
    bends = np.abs(np.diff(values, 2, axis=0)) if len(values) > 2 else np.zeros_like(values)
    at = min(len(steps) - 1, int(0.99 * len(steps)))
    figures = (
        *ordered[places],
        np.median(values[:few], axis=0),
        np.median(values[-few:], axis=0),
        np.partition(steps, at, axis=0)[at],
        np.median(bends, axis=0),
        longest_hold(values),
        1 + (np.diff(ordered, axis=0) > 0).sum(0),
        np.maximum(np.abs(ordered[0]), np.abs(ordered[-1])),
        (steps == 0).mean(0),
    )
    return ColumnProfile(np.stack(figures).astype(float))


def longest_hold(
    values: Float64[np.ndarray, "frames components"],
) -> Int64[np.ndarray, " components"]:
    """Most frames in a row that hold the same value, by component."""
    count = np.arange(len(values))[:, None]
    changed = np.ones(values.shape, dtype=bool)
    changed[1:] = values[1:] != values[:-1]
    since = np.maximum.accumulate(np.where(changed, count, 0), axis=0)
    return 1 + (count - since).max(0)


def is_discrete(profile: ColumnProfile, length: int) -> np.ndarray:
    """Components that switch between levels instead of moving: commands, flags, grippers.

    Either few levels in all, or nearly always at rest at what they jump between.
    """
    few = profile.distinct <= max(4, min(12, length // 20))
    # What rests nearly all the time, and then goes a good part of its range in one step.
    span = np.maximum(profile.levels[-1] - profile.levels[0], 1e-12)
    switching = (profile.flat > 0.9) & (profile.step > 0.2 * span) & (profile.distinct < 50)
    return few | switching


def gain_over(tracking: Tracking, delay: int) -> float:
    """How much better the delay of an episode fits than another one: 0 to 1.

    0 too where that other one leaves little: delays of slow motions are hard to tell.
    """
    residual = tracking.residual
    other = residual[int(np.clip(len(residual) // 2 + delay, 0, len(residual) - 1))]
    return float(1 - residual.min() / other) if other > _LITTLE else 0.0


# Of the variance: a tenth of the motion.
_LITTLE = 0.01
_FOLLOWED = 0.2
"""What is left of the variance of a component that follows its command."""


def _standardized(values: np.ndarray) -> np.ndarray:
    """Components of mean 0 and variance 1; 0 where nothing moves."""
    centered = values - values.mean(0)
    return centered / np.maximum(centered.std(0), 1e-12)


# Of the variance: a window in which a component rests, but for what rounding leaves.
_RESTS = 1e-10


def _correlations(
    command: Float64[np.ndarray, "frames components"],
    state: Float64[np.ndarray, "frames components"],
    reach: int,
) -> Float64[np.ndarray, "delays components"]:
    """Correlation of state(t) with command(t - delay), delays from -reach to reach.

    The same frames of the state are compared at each; 0 where the command rests in its own.
    """
    inner = len(state) - 2 * reach
    late, early = _standardized(state[reach : reach + inner]), _standardized(command)
    windows = np.lib.stride_tricks.sliding_window_view(early, inner, axis=0)
    together = np.einsum("dcn,nc->dc", windows, late) / inner
    # Mean and variance of all windows from running sums.
    sums, squares = (np.cumsum(np.pad(x, ((1, 0), (0, 0))), axis=0) for x in (early, early**2))
    mean = (sums[inner:] - sums[:-inner]) / inner
    variance = (squares[inner:] - squares[:-inner]) / inner - mean**2
    found = together / np.sqrt(np.maximum(variance, _RESTS))
    return np.where(variance > _RESTS, found, 0.0)[::-1]  # the last window is the earliest


def track(
    command: Float64[np.ndarray, "frames components"],
    state: Float64[np.ndarray, "frames components"],
    fps: float,
) -> Tracking | None:
    """How the state follows the command; None where nothing moves, or in too few frames."""
    frames = len(state)
    if frames > _MOST_FRAMES:
        first = (frames - _MOST_FRAMES) // 2
        command, state = (v[first : first + _MOST_FRAMES] for v in (command, state))
        frames = _MOST_FRAMES
    reach = min(round(_LONGEST_DELAY * fps), frames // 4)
    if frames < 20 or reach < 1:
        return None
    size = np.minimum(state.std(0), command.std(0))
    moving = size > 1e-9 * (1 + np.abs(state).max(0))
    if not moving.any():
        return None
    delays = np.arange(-reach, reach + 1)
    left = 1 - np.maximum(_correlations(command[:, moving], state[:, moving], reach), 0) ** 2
    # Hands and grippers that stand still at an object tell nothing of the delay.
    followed = left.min(0) < _FOLLOWED
    residual = left[:, followed if followed.any() else slice(None)].mean(1)
    best = int(residual.argmin())
    delay = int(delays[best])
    there = slice(max(delay, 0), frames + min(delay, 0))
    before = slice(max(-delay, 0), frames + min(-delay, 0))
    a, s = command[before], state[there]
    a0, s0 = a - a.mean(0), s - s.mean(0)
    power, answer = (a0**2).sum(0), (s0**2).sum(0)
    together = (a0 * s0).sum(0)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = together / power
        fit = together**2 / (power * answer)
        likeness = np.nan_to_num(np.abs(a0.T @ s0) / np.sqrt(np.outer(power, answer)))
    for value in (slope, fit):
        value[~moving] = np.nan
    likeness[~moving] = 0.0
    likeness[:, ~moving] = 0.0
    partner = likeness.argmax(1)
    return Tracking(
        delay=delay,
        residual=residual.astype(np.float32),
        slope=slope,
        fit=fit,
        partner=partner,
        likeness=likeness.max(1),
    )


def track_quantities(
    quantities: Mapping[str, Float64[np.ndarray, "_frames _components"]], fps: float
) -> dict[str, Tracking]:
    """How commands, joints and their rates go together, by what is compared.

    Args:
        quantities: By role, during one episode.
        fps: Frame rate [1/s].
    """
    joints, found = quantities.get("joint_position"), {}
    if joints is None or len(joints) < 3:
        return {}
    rates = np.gradient(joints, 1 / fps, axis=0)
    pairs = {
        "command_position": (quantities.get("command_position"), joints),
        "rates": (quantities.get("command_position"), rates),
        "command_velocity": (quantities.get("command_velocity"), rates),
        "joint_velocity": (quantities.get("joint_velocity"), rates),
    }
    for name, (given, followed) in pairs.items():
        if given is not None and given.shape == followed.shape:
            tracking = track(given, followed, fps)
            if tracking is not None:
                found[name] = tracking
    return found
