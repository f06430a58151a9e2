"""What a run and a fit hand over to be shown: plain arrays, no robot model, no library.

Whatever is None or empty drops its panel or figure. Times are seconds from the run's start.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from ..vision import CameraModel
from .logged_steps import Event

Colour = tuple[float, float, float, float]
"""Red, green, blue, opacity, each 0 to 1."""

_WHITE: Colour = (0.86, 0.87, 0.89, 1.0)


@dataclass(frozen=True, kw_only=True)
class Capsule:
    """A cylinder with round ends, in the frame of the body that carries it."""

    start: tuple[float, float, float]
    """[m]"""
    end: tuple[float, float, float]
    """[m]"""
    radius: float
    """[m]"""
    colour: Colour = _WHITE


@dataclass(frozen=True, kw_only=True)
class Box:
    """A box, axes along those of the body that carries it, or of the base frame."""

    centre: tuple[float, float, float]
    """[m]"""
    half_size: tuple[float, float, float]
    """[m]"""
    colour: Colour = (0.75, 0.62, 0.45, 1.0)
    name: str = ""


@dataclass(frozen=True, kw_only=True)
class MeshFile:
    """A drawn shape in a file, in the frame of the body that carries it."""

    path: Path
    turn: float = 0.0
    """About z [rad]."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """[m]"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Body:
    """Something rigid that moves: a link of the arm, a finger, the object it carries."""

    name: str
    position: Float[np.ndarray, "time 3"]
    """Origin in the base frame [m]."""
    orientation: Float[np.ndarray, "time 4"]
    """Unit quaternion (w, x, y, z)."""
    capsules: tuple[Capsule, ...] = ()
    boxes: tuple[Box, ...] = ()
    mesh: MeshFile | None = None
    """Drawn in place of capsules and nameless boxes, where the file is there and the viewer
    can."""


@dataclass(frozen=True, kw_only=True, eq=False)
class JointLimits:
    """Ranges to draw beside joint positions."""

    lower: Float[np.ndarray, " joints"]
    """[rad]"""
    upper: Float[np.ndarray, " joints"]
    """[rad]"""


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
    joint_limits: JointLimits | None = None
    demo_joint_position: Float[np.ndarray, "time joints"] | None = None
    """Demonstration at the matching phase of the run, NaN elsewhere [rad]."""

    position: Float[np.ndarray, "time 3"]
    """Tool centre point in the base frame [m]."""
    demo_path: Float[np.ndarray, "samples 3"] | None = None
    """Tool centre point of the demonstration [m]."""
    plan_path: Float[np.ndarray, "samples 3"] | None = None
    """Path that the learned motion asked for [m]."""

    bodies: tuple[Body, ...] = ()
    """The arm's links, the gripper, carried objects."""
    boxes: tuple[Box, ...] = ()
    """Everything that stands still, in the base frame."""
    region: Box | None = None
    """The Cartesian region in which the camera takes over."""

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

    human_effort: Float[np.ndarray, "time joints"] | None = None
    """Null-space effort d of the person, on each joint."""
    elbow_motion: Float[np.ndarray, " time"] | None = None
    """How far the elbow is from where it would be undisturbed [m]."""
    position_deviation: Float[np.ndarray, " time"] | None = None
    """How far the end effector is from where it would be undisturbed [m]."""
    rotation_deviation: Float[np.ndarray, " time"] | None = None
    """The same for its orientation [rad]."""

    safety: Mapping[str, Float[np.ndarray, " time"] | Bool[np.ndarray, " time"]] = field(
        default_factory=dict
    )
    """Whether, or how strongly, each guard of the safety filter acted, by name."""
    phases: tuple[Event, ...] = ()
    """When the task entered each of its phases."""

    def __post_init__(self) -> None:
        steps = len(self.time)
        series: dict[str, np.ndarray | None] = {name: getattr(self, name) for name in _SERIES}
        series |= {f"potentials[{name!r}]": value for name, value in self.potentials.items()}
        series |= {f"safety[{name!r}]": value for name, value in self.safety.items()}
        for body in self.bodies:
            series[f"bodies: {body.name}.position"] = body.position
            series[f"bodies: {body.name}.orientation"] = body.orientation
        if self.camera is not None:
            series |= {
                "camera.feature": self.camera.feature,
                "camera.target": self.camera.target,
            }
        wrong = {
            name: len(value)
            for name, value in series.items()
            if value is not None and len(value) != steps
        }
        if wrong:
            raise ValueError(
                f"time has {steps} samples, but "
                + ", ".join(f"{name} has {n}" for name, n in wrong.items())
                + ". Log every field at every control step, with NaN where it has no value."
            )


_SERIES = (
    "joint_position",
    "demo_joint_position",
    "position",
    "image_jacobian",
    "true_image_jacobian",
    "weight_norm",
    "potential_rate",
    "human_effort",
    "elbow_motion",
    "position_deviation",
    "rotation_deviation",
)


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
    joint_limits: JointLimits | None = None
    boxes: tuple[Box, ...] = ()
    residual: Mapping[int, float] = field(default_factory=dict)
    """Normalised RMS error of the fit for each number of basis functions tried."""
    n_basis: int | None = None
    """The number of basis functions used."""
    unit: str = "rad"
    """Of the joints, or "m" where they are positions."""

    def __post_init__(self) -> None:
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


def arm_bodies(
    position: Float[np.ndarray, "time links 3"],
    orientation: Float[np.ndarray, "time links 4"],
    *,
    radius: float = 0.045,
    colour: Colour = _WHITE,
) -> tuple[Body, ...]:
    """A stick arm for robots without a drawn model: a capsule from each frame to the next.

    The base stands at the origin.

    Args:
        position: Origins of the joint frames, from the base to the tool [m].
        orientation: Their unit quaternions (w, x, y, z).
        radius: Of the capsules [m].
        colour: Of the capsules.
    """
    origin = np.zeros_like(position[:, :1])
    upright = np.zeros_like(orientation[:, :1])
    upright[..., 0] = 1.0
    position = np.concatenate([origin, position], axis=1)
    orientation = np.concatenate([upright, orientation], axis=1)
    bodies = []
    for i in range(position.shape[1] - 1):
        # Joint i + 1 sits on link i, so its place in frame i is the same at every time.
        w, axis = orientation[0, i, 0], orientation[0, i, 1:]
        offset = position[0, i + 1] - position[0, i]
        turned = np.cross(axis, offset)
        end = offset + 2.0 * (np.cross(axis, turned) - w * turned)  # by the conjugate
        x, y, z = end.tolist()
        capsule = Capsule(start=(0.0, 0.0, 0.0), end=(x, y, z), radius=radius, colour=colour)
        bodies.append(
            Body(
                name=f"link{i}",
                position=position[:, i],
                orientation=orientation[:, i],
                capsules=(capsule,),
            )
        )
    return tuple(bodies)
