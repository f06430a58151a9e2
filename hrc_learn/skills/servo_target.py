"""Target of visual servoing in the image, and the controller's goals to reach the target.

Demonstrations end with the end effector right above an object. The position of the object's
marker in the tool frame at that moment is learned from the pixels of both markers. In a new
scene, the estimated camera turns the object's pixel into a ray, which is intersected with the
plane at the demonstrated height of objects. The end effector has to go where this intersection
has the learned position in the tool frame. The target in the image is the pixel that the end
effector's marker will have there. Calibration errors that move both markers alike cancel.
"""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller import Goals
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.jacobian import CameraSpread
from hrc_learn.jacobian.perspective import MARKER, SIZE, marker_pixels, on_plane
from hrc_learn.regions import OrientationRegion
from hrc_learn.skills.drawn_goals import DrawnGoalsConfig
from hrc_learn.store import Metres, Pixels, read_json, write_json
from hrc_learn.vision.camera_model import IMAGE_SIZE

LONGEST_OFFSET = 0.4
"""Longest offset of the object's marker from the tool centre point [m]. Demonstrations at one
place contain little information on the object's height: without this bound, the offset could
become metres long."""

# Iterations of the fit of the offset; each iteration solves a linearised projection.
_STEPS = 8
# Offset from which the fit starts: below the end effector [m].
_BELOW = (0.0, 0.0, 0.1)
# A marker's direction in the image is converted to a heading by projecting the ends of a
# segment onto the marker's plane; this is the half length of the segment [px].
_ALONG = 20.0


@dataclass(frozen=True, kw_only=True)
class _TargetFile:
    version: Literal[3] = 3
    offset_m: tuple[Metres, Metres, Metres]
    error_px: Pixels | None


@dataclass(frozen=True, kw_only=True)
class VisualTarget:
    """Position of the object's marker relative to a tool right above the object."""

    offset: Float[np.ndarray, "3"]
    """Position of the object's marker in the tool frame [m]."""
    error: float
    """Root mean square leave-one-out error [px]; NaN with fewer than five demonstrations."""

    @classmethod
    def fit(
        cls, camera: Float[Tensor, "13"], objects: Float[np.ndarray, "demos 2"], poses: Pose
    ) -> "VisualTarget":
        """Fit the offset to the ends of demonstrations.

        Args:
            camera: Camera of the demonstrations (see `jacobian.perspective`).
            objects: Pixels of the object's marker [px].
            poses: Poses of the end effector right above the object, (demos,).

        Raises:
            ValueError: There are fewer than three demonstrations.
        """
        if len(objects) < 3:
            raise ValueError(
                f"the visual target needs three or more demonstrations, got {len(objects)}."
            )
        offset, error = np.array(_BELOW), math.nan
        for _ in range(_STEPS):
            # The object is treated as a marker on the tool.
            carrying = torch.cat([camera[: MARKER.start], torch.from_numpy(offset)])
            seen, slope = marker_pixels(carrying, poses)
            design = slope[..., MARKER].numpy()
            towards = objects - seen.numpy() + design @ offset
            offset, error = _solved(design.reshape(-1, 3), towards)
        return cls(offset=offset, error=error)

    def tool_position(
        self, camera: Float[Tensor, "*batch 13"], pixel: Float[Tensor, "2"], above: Pose
    ) -> Float[Tensor, "*batch 3"]:
        """Position of a tool right above an object, in the base frame [m].

        Args:
            camera: Cameras.
            pixel: Pixel of the object's marker [px].
            above: Orientation of the tool, and height of the tool at the end of demonstrations.
        """
        offset = quaternion.rotate(above.orientation, torch.from_numpy(self.offset))
        height = above.position[2] + offset[2]
        return on_plane(camera, pixel.expand(*camera.shape[:-1], 2), height) - offset

    def __call__(
        self,
        camera: Float[Tensor, "*batch 13"],
        pixel: Float[Tensor, "2"],
        above: Pose,
        height: float | Float[Tensor, ""] | None = None,
    ) -> Float[Tensor, "*batch 2"]:
        """Target pixel of the end effector's marker for an object's marker at `pixel` [px].

        Args:
            camera: Cameras.
            pixel: Pixel of the object's marker [px].
            above: Orientation of the tool, and height of the tool at the end of demonstrations.
            height: Height of the tool now [m]; None: the height of `above`.
        """
        place = self.tool_position(camera, pixel, above)
        if height is not None:
            level = torch.as_tensor(height).to(place).expand(place.shape[:-1])
            place = torch.cat([place[..., :2], level[..., None]], dim=-1)
        orientation = above.orientation.expand(*place.shape[:-1], 4)
        one = Pose(place.unsqueeze(-2), orientation.unsqueeze(-2))
        return marker_pixels(camera, one)[0].squeeze(-2)

    def uncertainty(
        self,
        cameras: CameraSpread,
        image_jacobian: Float[np.ndarray, "2 6"],
        pixel: Float[Tensor, "2"],
        above: Pose,
    ) -> float:
        """Standard deviation of the tool's position above the object, both axes combined [m].

        The loop is closed through the image, so only the error of the target pixel counts.

        Args:
            cameras: Estimate of the camera.
            image_jacobian: Image Jacobian of the end effector's marker [px/m, px/rad].
            pixel: Pixel of the object's marker [px].
            above: Orientation of the tool, and height of the tool at the end of demonstrations.
        """
        best, *others = self(cameras.samples, pixel, above)
        apart = (torch.stack(others) - best).numpy()
        metres = np.linalg.lstsq(image_jacobian[:, :2], apart.T, rcond=None)[0]
        return float(np.sqrt(cameras.weights.numpy() @ (metres**2).sum(0)))

    def save(self, path: Path) -> None:
        """Write a JSON file, atomically."""
        x, y, z = self.offset.tolist()
        write_json(path, _TargetFile(offset_m=(x, y, z), error_px=self.error))

    @classmethod
    def load(cls, path: Path) -> "VisualTarget":
        """Read a saved target.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is damaged or has an unknown version.
        """
        content = read_json(path, _TargetFile, "fit the visual target again")
        error = math.nan if content.error_px is None else content.error_px
        return cls(offset=np.array(content.offset_m), error=error)


def _solved(
    design: Float[np.ndarray, "equations unknowns"], pixels: Float[np.ndarray, "demos 2"]
) -> tuple[Float[np.ndarray, " unknowns"], float]:
    """Least-squares solution, with two equations per demonstration, and leave-one-out error.

    The error is the root mean square over the demonstrations [px].
    A solution longer than `LONGEST_OFFSET` is shortened by the smallest sufficient ridge
    penalty.
    """
    u, s, vt = np.linalg.svd(design, full_matrices=False)
    # The factor keeps the divisions below finite for rank-deficient designs.
    s = np.maximum(s, 1e-12 * s[0])
    along = u.T @ pixels.ravel()

    def too_long(penalty: float) -> bool:
        return float(np.linalg.norm(s * along / (s**2 + penalty))) > LONGEST_OFFSET

    low, high = 0.0, 0.0
    if too_long(0.0):
        high = float(s[0] * np.linalg.norm(along)) / LONGEST_OFFSET
        # Bisection: the length decreases as the penalty grows.
        while high - low > 1e-6 * high:
            middle = (low + high) / 2
            low, high = (middle, high) if too_long(middle) else (low, middle)
    inverse = (vt.T * (s / (s**2 + high))) @ u.T
    solution = inverse @ pixels.ravel()
    if len(pixels) < 5:
        return solution, float("nan")
    residuals = pixels - (design @ solution).reshape(-1, 2)
    # Errors of left-out demonstrations, from blocks of the hat matrix (PRESS, Allen 1974).
    hat = (design @ inverse).reshape(len(pixels), 2, len(pixels), 2)
    own = hat[np.arange(len(pixels)), :, np.arange(len(pixels))]
    press = np.linalg.solve(np.eye(2) - own, residuals[..., None])
    return solution, float(np.sqrt((press**2).sum(axis=(1, 2)).mean()))


def object_heading(
    camera: Float[Tensor, "13"], pixel: Float[Tensor, "2"], angle: float, height: float
) -> float:
    """Heading in the base frame of a marker that lies flat [rad].

    Args:
        camera: Camera.
        pixel: Pixel of the marker [px].
        angle: Direction of the marker in the image [rad].
        height: Height of the marker [m].
    """
    along = _ALONG * pixel.new_tensor([math.cos(angle), math.sin(angle)])
    ends = torch.stack([pixel - along, pixel + along])
    start, end = on_plane(camera.expand(2, SIZE), ends, height)
    x, y, _ = (end - start).tolist()
    return math.atan2(y, x)


@dataclass(frozen=True, kw_only=True)
class VisualServoConfig:
    """Tolerances, time limits and regions of visual servoing.

    The end effector moves in a flat box above the table. A probe is a motion from above the box
    down into the box; it is made while the camera is uncertain.
    """

    tolerance: float = 1.5
    """Distance of the feature from the target that counts as reached [px]."""
    dwell: float = 0.3
    """Time at the target until it counts as reached [s]."""
    height_tolerance: float = 0.01
    """Height error of the end effector that counts as reached [m]."""
    turn_tolerance: float = 0.03
    """Orientation error of the end effector that counts as reached [rad]."""
    timeout: float = 40.0
    """Give up after this long [s]."""
    occlusion_timeout: float = 10.0
    """Give up after the end effector's marker is undetected for this long [s]."""
    object_error: float = 0.0025
    """Predicted error above the object below which the gripper may descend to grasp [m], one
    standard deviation in the plane. With a larger error, the end effector probes."""
    probe: float = 0.06
    """Height above the box from which a probe descends [m]. The descent shows how the marker's
    pixel depends on height."""
    probe_tolerance: float = 30.0
    """Distance of the feature from the target at which a probe begins its descent [px]."""
    probe_aside: float = 0.0
    """Distance in the image by which all probes but the first are shifted, roughly towards its
    middle [px]. Motions across the image and in depth together show the camera's tilt."""
    max_probes: int = 6
    """Largest number of probes."""
    border: float = 80.0
    """Smallest distance of the target from the border of the image [px]; a marker closer than
    50 px is cut off."""
    turn_border: float = 60.0
    """Distance of the marker from the border below which the gripper does not turn if the turn
    would reduce the distance [px]."""
    turn_rate: float = 0.8
    """Highest angular speed at which the gripper turns for the object [rad/s]. A turn moves the
    marker by 0.15 m per radian. At this speed, the marker stays within 10 px of its target even
    with delayed images."""
    marker_tolerance: float = 1.5
    """Deviation of the marker from its predicted pixel, while the end effector is held, above
    which it counts as half hidden [px]: three times the noise of pixel and prediction."""
    lost_after: float = 1.0
    """Time without detection after which a marker last seen near the border counts as out of
    view, not as occluded [s]. The end effector then returns to the middle of the box."""
    half_size: tuple[float, float, float] = (0.12, 0.12, 0.003)
    """Half edges of the box in which vision feedback acts [m]. The box is flat: the image shows
    little about height, and an object has to be grasped at the demonstrated height."""
    acquisition_half_size: tuple[float, float, float] = (0.03, 0.03, 0.003)
    """Half edges of the box until the marker is first detected [m]. A camera that was moved may
    not see the whole box, but will see the middle of the box."""
    angle: float = 0.01
    """Half angle of the tolerated cone of orientations [rad]. The paper's cone of 7.6 degrees
    would shift the marker by 1 cm."""
    rate: float = 4.0
    """Rate at which the end effector returns into the box and into the cone [1/s]."""
    rest_rate: float = 1.0
    """Rate at which the null space returns to the posture above the table [1/s]."""
    drawn: DrawnGoalsConfig = field(default_factory=DrawnGoalsConfig)
    """Effect of a person's drawing on the goals."""

    def __post_init__(self) -> None:
        tolerances = "tolerance", "height_tolerance", "turn_tolerance"
        check_settings(self, positive=(*tolerances, "max_probes", "turn_rate", "angle", "rate"))

    def scaled(self, size: float) -> "VisualServoConfig":
        """The same settings, with the lengths above the table scaled to a hand.

        Args:
            size: Size of the hand relative to the Franka hand.
        """
        (a, b, c), (d, e, f) = self.half_size, self.acquisition_half_size
        return replace(
            self,
            height_tolerance=size * self.height_tolerance,
            probe=size * self.probe,
            half_size=(size * a, size * b, c),
            acquisition_half_size=(size * d, size * e, f),
        )

    def within(self, pixel: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """The nearest pixel at least `border` pixels away from the border of the image [px]."""
        return np.clip(pixel, self.border, np.array(IMAGE_SIZE) - 1 - self.border)

    def goals(
        self, above: Pose, target: Float[np.ndarray, "2"], *, detected: bool = True
    ) -> Goals:
        """Goals of the controller.

        Args:
            above: Middle of the box above the table, and orientation of the end effector.
            target: Target of the end effector's marker [px]. A target outside the image may be
                due to a wrong image Jacobian. It is moved to the border, and the motion towards
                it corrects the image Jacobian.
            detected: False until the end effector's marker is first detected.
        """
        half_size = self.half_size if detected else self.acquisition_half_size
        goals = Goals.at(
            above.position,
            above.orientation,
            torch.from_numpy(self.within(target)),
            half_size=half_size,
        )
        # Just outside a region, the distance from its wall decays at the rate 4 k_c / h^2 for
        # positions (stiffness k_c, half edge h) and k_o (alpha_o / 2)^2 for orientations
        # (stiffness k_o, sharpness alpha_o). With the paper's k_c = 4e-4, an arm whose marker
        # has left the image would move on until it is fully stretched.
        walls = tuple(self.rate / 4 * h**2 for h in half_size)
        sharpness = 2 / self.angle
        return replace(
            goals,
            # This region attracts from anywhere in the image, unlike the paper's region.
            vision=replace(goals.vision, formulation="saturated"),
            position=replace(goals.position, stiffness=walls),
            orientation=OrientationRegion(
                goal=above.orientation,
                sharpness=sharpness,
                stiffness=4 * self.rate / sharpness**2,
            ),
        )


@dataclass(frozen=True, kw_only=True)
class ServoTarget:
    """Pose that the end effector servos to, with all that determines its target pixel."""

    config: VisualServoConfig
    above: Pose
    """Middle of the box above the table, and orientation of the end effector."""
    posture: Float[Tensor, " joints"] | None
    """Joint positions at `above`, approached in joint space [rad]; None: the Cartesian regions
    guide the approach."""
    visual: VisualTarget
    """Position of the object's marker in the tool frame."""
    item: Float[np.ndarray, "2"]
    """Pixel of the object's marker [px]."""
    angle: float | None = None
    """Direction of the object's marker in the image [rad]; None: the gripper does not turn."""
    turn_range: tuple[float, float] = (0.0, 0.0)
    """Smallest and largest turn of the gripper about the vertical [rad]."""
    orientation: Float[Tensor, "4"] | None = None
    """Orientation of the end effector, turned for the object; None: orientation of `above`."""
    rest: Float[Tensor, " joints"] | None = None
    """Posture to which the null space returns [rad]; None: the null space does not return."""
    raised: float = 0.0
    """Height of the goal above the box [m], for probes."""
    kept_camera: Float[Tensor, "13"] | None = None
    """Camera that determines the target pixel. It keeps the target in place while the estimate
    of the camera changes. None: the present estimate determines the target pixel."""

    def goals(self, camera: Float[Tensor, "13"], pose: Pose, *, detected: bool) -> Goals:
        """Goals from an estimate of the camera, for the present pose of the end effector."""
        # A camera that was moved may not see above the box: do not raise the goal until the
        # marker is detected.
        offset = torch.tensor([0.0, 0.0, self.raised if detected else 0.0], dtype=torch.float64)
        above = Pose(self.above.position + offset, self.tool_orientation)
        goals = self.config.goals(above, self.pixel(camera, pose), detected=detected)
        return goals.approached_by(self.posture)

    def pixel(self, camera: Float[Tensor, "13"], pose: Pose) -> Float[np.ndarray, "2"]:
        """Target of the marker with the end effector at its present height [px].

        At any height, the target is the pixel of a marker right above the object. Therefore a
        height error of some millimetres does not move the gripper sideways.
        """
        camera = camera if self.kept_camera is None else self.kept_camera
        lower_wall = float(self.above.position[2]) - self.config.half_size[2]
        height = pose.position[2].clamp(min=lower_wall)
        return self.visual(
            camera, torch.from_numpy(self.item), self.demonstrated, height
        ).numpy()

    def uncertainty(
        self, cameras: CameraSpread, image_jacobian: Float[np.ndarray, "2 6"]
    ) -> float:
        """Predicted error above the object: standard deviation in the horizontal plane [m]."""
        item = torch.from_numpy(self.item)
        return self.visual.uncertainty(cameras, image_jacobian, item, self.demonstrated)

    def heading(self, camera: Float[Tensor, "13"]) -> float | None:
        """Heading of the object's marker in the base frame [rad]; None without a direction."""
        if self.angle is None:
            return None
        offset = quaternion.rotate(self.tool_orientation, torch.from_numpy(self.visual.offset))
        height = float(self.above.position[2] + offset[2])
        return object_heading(camera, torch.from_numpy(self.item), self.angle, height)

    @property
    def demonstrated(self) -> Pose:
        """Height at which demonstrations end, and present orientation of the end effector."""
        return Pose(self.above.position, self.tool_orientation)

    @property
    def tool_orientation(self) -> Float[Tensor, "4"]:
        """Orientation of the end effector: turned for the object, or else that of `above`."""
        return self.above.orientation if self.orientation is None else self.orientation
