"""Recordings of demonstrations, fits and learning: plain arrays, no robot model, no library.

A field that is None or empty drops its panel or figure.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from hrc_learn.geometry import Body, Box
from hrc_learn.log import JointRanges
from hrc_learn.log.run_recording import check_samples

Seen = Mapping[str, tuple[Float[np.ndarray, "_"], tuple[bytes, ...]]]
"""Camera images by the name of the camera: times [s], and a JPEG file for each."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FitRecording:
    """Demonstrations and their reproductions by the fitted primitives, on the same grids.

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
    """Number of basis functions used."""
    unit: str = "rad"
    """Unit of the joints: "rad", or "m" for positions."""
    episodes: tuple[int, ...] = ()
    """Episode of each demonstration in its dataset, if known."""
    images: Mapping[int, Seen] = field(default_factory=dict)
    """Camera images by episode."""

    def __post_init__(self) -> None:
        if self.episodes and len(self.episodes) != len(self.demos):
            raise ValueError(
                f"episodes names {len(self.episodes)} episodes for {len(self.demos)} "
                "demonstrations; give one for each."
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
    """One demonstration; quantities that were not recorded are None.

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
    """Camera images."""

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
        """Length of the path of the tool centre point [m]."""
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
    """Notes of the reader: guesses and anomalies."""

    def __post_init__(self) -> None:
        if not self.demonstrations:
            raise ValueError("demonstrations must not be empty.")


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorMap:
    """Relative error over cells of the horizontal plane."""

    x: Float[np.ndarray, " nx_and_1"]
    """Edges of the cells [m]."""
    y: Float[np.ndarray, " ny_and_1"]
    """Edges of the cells [m]."""
    z: float
    """Height at which the cells are drawn [m]."""
    relative_error: Float[np.ndarray, "nx ny"]
    """Error relative to the size of the predicted quantity; NaN in an empty cell."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LearningRecording:
    """Rounds of learning; the first one is the state before learning.

    Raises:
        ValueError: If curves or centres do not have a value for each round, or the best round
            is none of them.
    """

    title: str
    measured: Mapping[str, float] = field(default_factory=dict)
    """Values of the result, by name."""
    curves: Mapping[str, Float[np.ndarray, "_"]] = field(default_factory=dict)
    """Values over the rounds, by name with unit; none without rounds."""
    best: int = 0
    """Round whose result was kept."""
    centers: Float[np.ndarray, "rounds neurons 3"] = field(
        default_factory=lambda: np.zeros((1, 0, 3))
    )
    """Centres of the neurons in each round [m]."""
    paths: tuple[Float[np.ndarray, "_ 3"], ...] = ()
    """Paths of the end effector in demonstrations [m]."""
    errors: ErrorMap | None = None
    """Errors on held-out demonstrations."""
    images: Mapping[str, bytes] = field(default_factory=dict)
    """JPEG files by their titles."""

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
