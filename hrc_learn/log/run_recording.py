"""Recording of one run of a task: plain arrays, no robot model, no drawing library.

A field that is None or empty drops its panel or figure. Times are seconds from the start of the
run.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, UInt8

from hrc_learn.geometry import Body, Box
from hrc_learn.log.step_log import Event
from hrc_learn.vision import CameraModel


@dataclass(frozen=True, kw_only=True, eq=False)
class JointRanges:
    """Ranges to draw beside joint positions."""

    lower: Float[np.ndarray, " joints"]
    """[rad]"""
    upper: Float[np.ndarray, " joints"]
    """[rad]"""
    velocity: Float[np.ndarray, " joints"] | None = None
    """Largest speeds [rad/s]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraRecording:
    """What a camera saw, and what was made of it."""

    model: CameraModel
    """The true camera: drawn as a frustum; simulation only knows it."""
    feature: Float[np.ndarray, "time 2"]
    """Measured feature [px]; NaN while it was not seen."""
    target: Float[np.ndarray, "time 2"]
    """Where the feature was wanted [px]; NaN while nothing was wanted."""
    image_time: Float[np.ndarray, " images"] = field(default_factory=lambda: np.empty(0))
    """[s]"""
    images: tuple[UInt8[np.ndarray, "h w 3"], ...] = ()
    """RGB, a few a second."""

    def __post_init__(self) -> None:
        if len(self.image_time) != len(self.images):
            raise ValueError(
                f"image_time has {len(self.image_time)} entries for {len(self.images)} images."
            )

    @property
    def error(self) -> Float[np.ndarray, " time"]:
        """Distance from feature to target [px]."""
        return np.linalg.norm(self.feature - self.target, axis=-1)


@dataclass(frozen=True, kw_only=True, eq=False)
class RunRecording:
    """One run of a task, sampled at every control step.

    Raises:
        ValueError: If a field has another number of samples than `time`.
    """

    title: str
    time: Float[np.ndarray, " time"]
    """[s], increasing."""

    joint_names: tuple[str, ...]
    joint_position: Float[np.ndarray, "time joints"]
    """[rad]"""
    joint_velocity: Float[np.ndarray, "time joints"] | None = None
    """[rad/s]"""
    joint_limits: JointRanges | None = None
    demo_joint_position: Float[np.ndarray, "time joints"] | None = None
    """Demonstration at the matching phase of the run, NaN elsewhere [rad]."""

    position: Float[np.ndarray, "time 3"]
    """Tool centre point in the base frame [m]."""
    demo_path: Float[np.ndarray, "samples 3"] | None = None
    """Tool centre point of the demonstration [m]."""
    plan_path: Float[np.ndarray, "plan_samples 3"] | None = None
    """Path that the learned motion asked for [m]."""

    bodies: tuple[Body, ...] = ()
    """The arm's links, the gripper, carried objects."""
    boxes: tuple[Box, ...] = ()
    """Everything that stands still, in the base frame."""
    region: Box | None = None
    """The Cartesian region in which the camera takes over."""
    active_region: Float[np.ndarray, "time 6"] | None = None
    """Centre and half edges of the region of the controller's position at each step [m]; NaN
    while no controller was in the loop."""
    drawn: Bool[np.ndarray, " time"] | None = None
    """Whether a person had drawn that."""

    camera: CameraRecording | None = None
    image_jacobian: Float[np.ndarray, "time 2 6"] | None = None
    """Estimate by the learned model [px/m, px/rad]; NaN where the run made none."""
    true_image_jacobian: Float[np.ndarray, "time 2 6"] | None = None
    """Of the true camera, simulation only [px/m, px/rad]."""
    weight_norm: Float[np.ndarray, " time"] | None = None
    """Frobenius norm of the image Jacobian's weights."""
    potentials: Mapping[str, Float[np.ndarray, " time"]] = field(default_factory=dict)
    """Potential of each region, or a Lyapunov function, by name."""

    potential_rate: Float[np.ndarray, " time"] | None = None
    """Rate of the sum of the potentials that the estimated image Jacobian predicts [1/s]."""

    nullspace_input: Float[np.ndarray, "time joints"] | None = None
    """Null-space input d of the person, on each joint [N m]."""
    push: Float[np.ndarray, "time 2 3"] | None = None
    """Point of the arm that the person pushes, and another in the direction in which they push
    it [m]; NaN while nobody pushes."""
    followed: Float[np.ndarray, " time"] | None = None
    """Share of the push that the arm follows, 0 to 1; NaN while nobody pushes."""
    hindered: Mapping[str, Bool[np.ndarray, " time"]] = field(default_factory=dict)
    """Whether each hindrance keeps it from following, by name."""
    elbow_motion: Float[np.ndarray, " time"] | None = None
    """How far the elbow is from where it would be undisturbed [m]."""
    position_deviation: Float[np.ndarray, " time"] | None = None
    """How far the end effector is from where it would be undisturbed [m]."""
    rotation_deviation: Float[np.ndarray, " time"] | None = None
    """The same for its orientation [rad]."""

    worker_distance: Mapping[str, Float[np.ndarray, " time"]] = field(default_factory=dict)
    """Smallest distance between a worker and the robot with its load, as it is and as it is
    seen, by name [m]; NaN while it is not known."""
    worker_nearest: Float[np.ndarray, "time 2 3"] | None = None
    """Points of the robot and of the worker that are the nearest to each other [m]."""

    safety: Mapping[str, Float[np.ndarray, " time"] | Bool[np.ndarray, " time"]] = field(
        default_factory=dict
    )
    """Whether, or how strongly, each guard of the safety filter acted, by name."""
    phases: tuple[Event, ...] = ()
    """When the task entered each of its phases."""
    remarks: tuple[Event, ...] = ()
    """What was said to the person beside the arm."""

    def __post_init__(self) -> None:
        series: dict[str, np.ndarray | None] = {name: getattr(self, name) for name in _SERIES}
        series |= {f"potentials[{name!r}]": value for name, value in self.potentials.items()}
        for field_name in ("safety", "worker_distance", "hindered"):
            named = getattr(self, field_name)
            series |= {f"{field_name}[{name!r}]": value for name, value in named.items()}
        for body in self.bodies:
            series[f"bodies: {body.name}.position"] = body.position
            series[f"bodies: {body.name}.orientation"] = body.orientation
        if self.camera is not None:
            series["camera.feature"] = self.camera.feature
            series["camera.target"] = self.camera.target
        check_samples(self.time, series)


_SERIES = (
    "joint_position",
    "joint_velocity",
    "demo_joint_position",
    "position",
    "image_jacobian",
    "true_image_jacobian",
    "weight_norm",
    "potential_rate",
    "nullspace_input",
    "push",
    "followed",
    "elbow_motion",
    "position_deviation",
    "rotation_deviation",
    "worker_nearest",
    "active_region",
    "drawn",
)


def check_samples(
    time: Float[np.ndarray, " time"], series: Mapping[str, np.ndarray | None]
) -> None:
    wrong = {n: len(v) for n, v in series.items() if v is not None and len(v) != len(time)}
    if wrong:
        raise ValueError(
            f"time has {len(time)} samples, but "
            + ", ".join(f"{name} has {n}" for name, n in wrong.items())
            + ". Log every field at every control step, with NaN where it has no value."
        )
