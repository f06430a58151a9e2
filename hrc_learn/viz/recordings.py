"""What runs, fits, sweeps and demonstrations hand over to be shown: plain arrays, no robot
model, no library.

Whatever is None or empty drops its panel or figure. Times are seconds from the run's start.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from hrc_learn.geometry import Body, Box
from hrc_learn.log import JointRanges
from hrc_learn.log.run_recording import check_samples

Seen = Mapping[str, tuple[Float[np.ndarray, "_"], tuple[bytes, ...]]]
"""What cameras saw, by their names: times [s], and a JPEG file for each."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FitRecording:
    """Demonstrations beside what the fitted primitives make of them, on the same grids.

    Raises:
        ValueError: If the numbers of demonstrations or of their samples disagree.
    """

    title: str
    joint_names: tuple[str, ...]
    time: tuple[Float[np.ndarray, "_"], ...]
    """Time grid of each demonstration [s]."""
    demos: tuple[Float[np.ndarray, "_ joints"], ...]
    """Demonstrated joint positions [rad]."""
    reproductions: tuple[Float[np.ndarray, "_ joints"], ...]
    """Reproduced joint positions [rad]."""
    demo_paths: tuple[Float[np.ndarray, "_ 3"], ...] = ()
    """Tool centre point of each demonstration [m]."""
    reproduction_paths: tuple[Float[np.ndarray, "_ 3"], ...] = ()
    """Tool centre point of each reproduction [m]."""
    joint_limits: JointRanges | None = None
    boxes: tuple[Box, ...] = ()
    residual: Mapping[int, float] = field(default_factory=dict)
    """Normalised RMS error of the fit for each number of basis functions tried."""
    n_basis: int | None = None
    """The number of basis functions used."""
    unit: str = "rad"
    """Of the joints, or "m" where they are positions."""
    episodes: tuple[int, ...] = ()
    """Of which dataset's episodes the demonstrations are, where that is known."""
    images: Mapping[int, Seen] = field(default_factory=dict)
    """What cameras saw, by episode."""

    def __post_init__(self) -> None:
        if self.episodes and len(self.episodes) != len(self.demos):
            raise ValueError(
                f"{len(self.demos)} demonstrations cannot be of {len(self.episodes)} episodes."
            )
        if not len(self.time) == len(self.demos) == len(self.reproductions) > 0:
            raise ValueError(
                "time, demos and reproductions must hold one array a demonstration, but hold "
                f"{len(self.time)}, {len(self.demos)} and {len(self.reproductions)}."
            )
        for i, (t, demo, reproduction) in enumerate(
            zip(self.time, self.demos, self.reproductions, strict=True)
        ):
            if not len(t) == len(demo) == len(reproduction):
                raise ValueError(
                    f"demonstration {i} has {len(t)} times, {len(demo)} demonstrated and "
                    f"{len(reproduction)} reproduced samples; they must agree."
                )


@dataclass(frozen=True, kw_only=True, eq=False)
class DemonstrationTrace:
    """One demonstration; whatever was not recorded is None.

    Raises:
        ValueError: If a field has another number of samples than `time`.
    """

    episode: int
    task: str
    time: Float[np.ndarray, " time"]
    """[s]"""
    joint_position: Float[np.ndarray, "time joints"] | None = None
    """[rad], or [m] of sliding joints."""
    position: Float[np.ndarray, "time 3"] | None = None
    """Tool centre point [m]."""
    feature: Float[np.ndarray, "time 2"] | None = None
    """In the image [px]; NaN while it was not seen."""
    human_effort: Float[np.ndarray, "time joints"] | None = None
    gripper: Float[np.ndarray, " time"] | None = None
    """Opening [m]."""
    bodies: tuple[Body, ...] = ()
    """The arm along the demonstration."""
    images: Seen = field(default_factory=dict)
    """What cameras saw."""

    def __post_init__(self) -> None:
        names = ("joint_position", "position", "feature", "human_effort", "gripper")
        series = {f"episode {self.episode}: {name}": getattr(self, name) for name in names}
        check_samples(self.time, series)

    @property
    def duration(self) -> float:
        """[s]"""
        return float(self.time[-1] - self.time[0])

    @property
    def length(self) -> float | None:
        """Of the path of the tool centre point [m]."""
        if self.position is None:
            return None
        return float(np.linalg.norm(np.diff(self.position, axis=0), axis=1).sum())


@dataclass(frozen=True, kw_only=True, eq=False)
class DemonstrationsRecording:
    """Demonstrations of one task by one robot.

    Raises:
        ValueError: If there is none.
    """

    title: str
    joint_names: tuple[str, ...]
    demonstrations: tuple[DemonstrationTrace, ...]
    joint_limits: JointRanges | None = None
    notes: tuple[str, ...] = ()
    """What was guessed or odd when they were read."""

    def __post_init__(self) -> None:
        if not self.demonstrations:
            raise ValueError("there is no demonstration to show.")


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorMap:
    """Shares over cells of the horizontal plane."""

    x: Float[np.ndarray, " nx_and_1"]
    """Edges of the cells [m]."""
    y: Float[np.ndarray, " ny_and_1"]
    """Edges of the cells [m]."""
    z: float
    """Height at which they are drawn [m]."""
    share: Float[np.ndarray, "nx ny"]
    """Error over size of what was predicted; NaN in an empty cell."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LearningRecording:
    """Rounds of learning, the first before anything was learned.

    Raises:
        ValueError: If curves or centres do not have a value for each round, or the best round
            is none of them.
    """

    title: str
    measured: Mapping[str, float] = field(default_factory=dict)
    """Values of the result, by name."""
    curves: Mapping[str, Float[np.ndarray, "_"]] = field(default_factory=dict)
    """Of the rounds, by name with unit; none where nothing was learned in rounds."""
    best: int = 0
    """The round that was kept."""
    centers: Float[np.ndarray, "rounds neurons 3"] = field(
        default_factory=lambda: np.zeros((1, 0, 3))
    )
    """Where the neurons stood in each [m]."""
    paths: tuple[Float[np.ndarray, "_ 3"], ...] = ()
    """Of the end effector in demonstrations [m]."""
    errors: ErrorMap | None = None
    """On demonstrations held out."""
    images: Mapping[str, bytes] = field(default_factory=dict)
    """JPEG files by what they show."""

    def __post_init__(self) -> None:
        rounds = len(self.centers)
        for name, values in self.curves.items():
            if len(values) != rounds:
                raise ValueError(
                    f"{name!r} has {len(values)} values, but there are centers of {rounds} "
                    "rounds; they must agree."
                )
        if not 0 <= self.best < rounds:
            raise ValueError(f"best must be one of the {rounds} rounds, but is {self.best}.")
