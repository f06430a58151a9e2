"""Recordings of runs, demonstrations, fits and learning: plain arrays, no library.

A field that is None or empty drops its panel or figure. Times are seconds from the start.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from hrc_learn.geometry import Body, Box
from hrc_learn.log.step_log import Event
from hrc_learn.vision import CameraModel


@dataclass(frozen=True, kw_only=True, eq=False)
class JointRanges:
    """Joint ranges, drawn with joint positions."""

    lower: Float[np.ndarray, " joints"]
    """[rad]"""
    upper: Float[np.ndarray, " joints"]
    """[rad]"""
    velocity: Float[np.ndarray, " joints"] | None = None
    """Largest speeds [rad/s]."""

    @classmethod
    def of(cls, limits: Any) -> "JointRanges":
        """Ranges and speeds of an arm's limits (`kinematics.JointLimits`)."""
        names = ("lower", "upper", "velocity")
        return cls(**{name: getattr(limits, name).numpy() for name in names})


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraRecording:
    """Images of a camera, and the feature detected in them."""

    model: CameraModel
    """True camera, known in simulation only; drawn as a frustum."""
    feature: Float[np.ndarray, "time 2"]
    """Measured feature [px]; NaN while it was not visible."""
    target: Float[np.ndarray, "time 2"]
    """Target of the feature [px]; NaN without a target."""
    image_time: Float[np.ndarray, " images"] = field(default_factory=lambda: np.empty(0))
    """[s]"""
    images: tuple[UInt8[np.ndarray, "h w 3"], ...] = ()
    """RGB images, a few per second."""

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
    """Planned path of the learned motion [m]."""

    bodies: tuple[Body, ...] = ()
    """Links of the arm, gripper, carried objects."""
    boxes: tuple[Box, ...] = ()
    """Static objects, in the base frame."""
    region: Box | None = None
    """Cartesian region in which visual servoing takes over."""
    active_region: Float[np.ndarray, "time 6"] | None = None
    """Centre and half edges of the position region of the controller at each step [m]; NaN
    without a controller in the loop."""
    drawn: Bool[np.ndarray, " time"] | None = None
    """True while the region was drawn by a person."""

    camera: CameraRecording | None = None
    image_jacobian: Float[np.ndarray, "time 2 6"] | None = None
    """Image Jacobian estimated by the learned model [px/m, px/rad]; NaN without an estimate."""
    true_image_jacobian: Float[np.ndarray, "time 2 6"] | None = None
    """Image Jacobian of the true camera, in simulation only [px/m, px/rad]."""
    weight_norm: Float[np.ndarray, " time"] | None = None
    """Frobenius norm of the image Jacobian's weights."""
    potentials: Mapping[str, Float[np.ndarray, " time"]] = field(default_factory=dict)
    """Potential of each region, or a Lyapunov function, by name."""

    potential_rate: Float[np.ndarray, " time"] | None = None
    """Rate of the sum of the potentials, predicted by the estimated image Jacobian [1/s]."""

    nullspace_input: Float[np.ndarray, "time joints"] | None = None
    """Null-space input d of the person on each joint [N m]."""
    push: Float[np.ndarray, "time 2 3"] | None = None
    """Point of the arm that the person pushes, and a second point in the direction of the push
    [m]; NaN without a push."""
    followed: Float[np.ndarray, " time"] | None = None
    """Fraction of the push that the arm follows, 0 to 1; NaN without a push."""
    hindered: Mapping[str, Bool[np.ndarray, " time"]] = field(default_factory=dict)
    """True while a hindrance keeps the arm from following, by name."""
    elbow_motion: Float[np.ndarray, " time"] | None = None
    """Distance of the elbow from its undisturbed position [m]."""
    position_deviation: Float[np.ndarray, " time"] | None = None
    """Distance of the end effector from its undisturbed position [m]."""
    rotation_deviation: Float[np.ndarray, " time"] | None = None
    """Angle of the end effector from its undisturbed orientation [rad]."""

    worker_distance: Mapping[str, Float[np.ndarray, " time"]] = field(default_factory=dict)
    """Smallest distance between a worker and the robot with its load, true and seen by the
    robot, by name [m]; NaN while unknown."""
    worker_nearest: Float[np.ndarray, "time 2 3"] | None = None
    """Nearest points of robot and worker [m]."""

    safety: Mapping[str, Float[np.ndarray, " time"] | Bool[np.ndarray, " time"]] = field(
        default_factory=dict
    )
    """Intervention of each guard of the safety filter, by name: a flag or a strength."""
    phases: tuple[Event, ...] = ()
    """Start of each phase of the task."""
    remarks: tuple[Event, ...] = ()
    """Messages to the person near the arm."""

    def __post_init__(self) -> None:
        series: dict[str, np.ndarray] = {}
        for field_name, value in vars(self).items():
            if isinstance(value, Mapping):
                series |= {f"{field_name}[{name!r}]": one for name, one in value.items()}
            elif isinstance(value, np.ndarray) and field_name not in _PATHS:
                series[field_name] = value
        for body in self.bodies:
            series[f"bodies: {body.name}.position"] = body.position
            series[f"bodies: {body.name}.orientation"] = body.orientation
        if self.camera is not None:
            series["camera.feature"] = self.camera.feature
            series["camera.target"] = self.camera.target
        wrong = {n: len(v) for n, v in series.items() if len(v) != len(self.time)}
        if wrong:
            raise ValueError(
                f"time has {len(self.time)} samples, but "
                + ", ".join(f"{name} has {n}" for name, n in wrong.items())
                + ". Log every field at every control step, with NaN where it has no value."
            )


_PATHS = ("demo_path", "plan_path")
"""Arrays without a sample for each control step."""
