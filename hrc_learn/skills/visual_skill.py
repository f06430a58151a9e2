"""Learned model of visual servoing: image Jacobian, approach direction, and visual target.

The visual target is the pixel of the end effector's marker when the end effector is right above
an object. The markers of end effector and object are at different heights and positions, so the
target is not the object's pixel. With an uncalibrated camera the offset has to be learned: each
demonstration ends with the end effector right above an object, and gives one pair of pixels.

The offset is a vector in space, fixed to the tool, which turns with the object. The image
Jacobian, which adapts to a camera that has been moved, projects it into the image, with the
perspective of a camera whose focal length was learned. Without perspective the offset appears a
few percent too long or too short once the camera has been turned by 10 degrees.
"""

import copy
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import quaternion
from hrc_learn.jacobian import (
    CellErrors,
    EvidenceResult,
    KalmanConfig,
    KalmanEstimator,
    RBFImageJacobian,
    depth_gradient,
)
from hrc_learn.jacobian.perspective import FOCAL, SHIFT
from hrc_learn.kinematics.tool_orientation import Approach
from hrc_learn.skills.marker_sensor import MarkerAngle
from hrc_learn.store import Metres, Pixels, read_json, write_json
from hrc_learn.vision.camera_model import IMAGE_SIZE

OBJECT_FEATURE = "observation.object_feature"
"""Dataset column with the object's marker in the image."""
OBJECT_FEATURE_NAMES = ("u", "v", "visible")
ANGLE_FEATURE = "observation.marker_angle"
"""Dataset column with the directions of both markers in the image [rad]."""
ANGLE_FEATURE_NAMES = ("tool", "object")
UP = np.array([0.0, 0.0, 1.0])
LONGEST_OFFSET = 0.3
"""Longest offset of the end effector's marker from the object's [m]. A few demonstrations in a
flat box teach the image Jacobian little about height: without this bound the least-squares
offset can be metres long."""

# Largest ratio of the depths of both markers: a bound while the image Jacobian is uncertain.
_MAX_DEPTH_RATIO = 1.5

POSE_NOISE = 1.5e-4
"""Standard deviation of a pose from encoders with noise of 1e-4 rad on levers of up to 0.8 m,
for the estimator of the image Jacobian [m]."""
PIXEL_NOISE = 0.15
"""Standard deviation of a marker's centre [px]: 0.08 px for the detector, more in noisy and
blurred images."""


@dataclass(frozen=True, kw_only=True)
class _TargetFile:
    version: Literal[2] = 2
    offset_m: tuple[Metres, Metres, Metres]
    error_px: Pixels | None
    focal_px: Pixels | None = None

    def __post_init__(self) -> None:
        if self.focal_px is not None and self.focal_px <= 0:
            raise ValueError(f"focal_px must be positive, got {self.focal_px}")


@dataclass(frozen=True, kw_only=True)
class VisualTarget:
    """Offset from the object's marker to the end effector's marker right above it."""

    offset: Float[np.ndarray, "3"]
    """Offset in the tool frame [m]. Without a focal length, it is that of an image without
    perspective."""
    error: float
    """Leave-one-out error, root mean square [px]; NaN with fewer than five demonstrations."""
    focal: float | None = None
    """Focal length of the camera [px]; None: no perspective."""

    @classmethod
    def fit(
        cls,
        objects: Float[np.ndarray, "demos 2"],
        tools: Float[np.ndarray, "demos 2"],
        jacobians: Float[np.ndarray, "demos 2 6"],
        orientations: Float[Tensor, "demos 4"],
        focal: float | None = None,
    ) -> "VisualTarget":
        """Fit to the ends of demonstrations.

        Args:
            objects: Pixels of the object's marker [px].
            tools: Pixels of the end effector's marker right above it [px].
            jacobians: Image Jacobians of that marker there [px/m, px/rad].
            orientations: Orientations of the end effector there.
            focal: Focal length of the camera [px]; None: no perspective.

        Raises:
            ValueError: There are fewer than three demonstrations.
        """
        if len(objects) < 3:
            raise ValueError(
                f"the visual target needs three or more demonstrations, got {len(objects)}."
            )
        apart, rows = tools - objects, jacobians[..., :3]
        if focal is not None:
            # apart = J o / (1 - g o) is also linear in the offset o.
            rows = rows + apart[..., :, None] * _gradient(rows, tools, focal)[..., None, :]
        design = rows @ quaternion.to_matrix(orientations).numpy()
        offset, error = _solved(design.reshape(-1, 3), apart)
        return cls(offset=offset, error=error, focal=focal)

    def __call__(
        self,
        pixel: Float[np.ndarray, "2"],
        jacobian: Float[np.ndarray, "2 6"],
        orientation: Float[Tensor, "4"],
        further: Float[np.ndarray, "3"] | None = None,
    ) -> Float[np.ndarray, "2"]:
        """Target pixel of the end effector's marker for an object's marker at `pixel` [px].

        Args:
            pixel: Pixel of the object's marker [px].
            jacobian: Estimated image Jacobian of the end effector's marker [px/m, px/rad].
            orientation: Orientation of the end effector at the target.
            further: Offset of the target from right above the object, base frame [m]; None:
                none.
        """
        offset = self._in_base(orientation)
        if further is not None:
            offset = offset + further
        apart = jacobian[:, :3] @ offset
        seen = pixel + apart
        # Depth depends slightly on the pixel: two iterations are within a tenth of a pixel.
        for _ in range(2):
            nearer = 1 - float(self.depth_gradient(jacobian, seen) @ offset)
            seen = pixel + apart / min(max(nearer, 1 / _MAX_DEPTH_RATIO), _MAX_DEPTH_RATIO)
        return seen

    def depth_gradient(
        self, jacobian: Float[np.ndarray, "2 6"], pixel: Float[np.ndarray, "2"]
    ) -> Float[np.ndarray, "3"]:
        """Relative change of the marker's depth with its position [1/m]; 0 without perspective.

        Args:
            jacobian: Image Jacobian of the end effector's marker [px/m, px/rad].
            pixel: Pixel of that marker [px].
        """
        if self.focal is None:
            return np.zeros(3)
        return _gradient(jacobian[:, :3], pixel, self.focal)

    def line(self, orientation: Float[Tensor, "4"]) -> Float[np.ndarray, "3"]:
        """Direction from the object's marker to the end effector's above it, base frame.

        Straight up for no offset, and for one flatter than 30 degrees, which a few
        demonstrations do not distinguish from noise.
        """
        offset = self._in_base(orientation)
        length = np.linalg.norm(offset)
        return UP if offset[2] <= 0.5 * length else offset / length

    def _in_base(self, orientation: Float[Tensor, "4"]) -> Float[np.ndarray, "3"]:
        return quaternion.rotate(orientation, torch.from_numpy(self.offset)).numpy()

    def save(self, path: Path) -> None:
        """Write a JSON file, atomically."""
        x, y, z = self.offset.tolist()
        content = _TargetFile(offset_m=(x, y, z), error_px=self.error, focal_px=self.focal)
        write_json(path, content)

    @classmethod
    def load(cls, path: Path) -> "VisualTarget":
        """Read a saved target.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is damaged or has an unknown version.
        """
        content = read_json(path, _TargetFile, "fit the visual target again")
        error = math.nan if content.error_px is None else content.error_px
        return cls(offset=np.array(content.offset_m), error=error, focal=content.focal_px)


def _gradient(
    jacobian: Float[np.ndarray, "*batch 2 3"],
    pixel: Float[np.ndarray, "*batch 2"],
    focal: float,
) -> Float[np.ndarray, "*batch 3"]:
    """Relative change of depth with position [1/m], principal point in the image's middle."""
    return depth_gradient(jacobian, pixel, focal, np.array(IMAGE_SIZE) / 2)


def _solved(
    design: Float[np.ndarray, "equations unknowns"], pixels: Float[np.ndarray, "demos 2"]
) -> tuple[Float[np.ndarray, " unknowns"], float]:
    """Least-squares solution for pixels, two equations a demonstration, and leave-one-out
    error.

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
        # Bisection: the length falls with the penalty.
        while high - low > 1e-6 * high:
            middle = (low + high) / 2
            low, high = (middle, high) if too_long(middle) else (low, middle)
    inverse = (vt.T * (s / (s**2 + high))) @ u.T
    solution = inverse @ pixels.ravel()
    if len(pixels) < 5:
        return solution, float("nan")
    residuals = pixels - (design @ solution).reshape(-1, 2)
    # From blocks of the hat matrix, one for each demonstration (Allen 1974, PRESS).
    hat = (design @ inverse).reshape(len(pixels), 2, len(pixels), 2)
    own = hat[np.arange(len(pixels)), :, np.arange(len(pixels))]
    press = np.linalg.solve(np.eye(2) - own, residuals[..., None])
    return solution, float(np.sqrt((press**2).sum(axis=(1, 2)).mean()))


@dataclass(frozen=True, kw_only=True)
class VisualServoSkill:
    """Skill learned from demonstrations of visual servoing."""

    jacobian: RBFImageJacobian
    """Image Jacobian of the end effector's marker."""
    target: VisualTarget | None
    """Visual target; None if the demonstrations show no object."""
    approach: Approach | None = None
    """Approach direction; None if the demonstrations show no object."""
    angle: MarkerAngle | None = None
    """Marker direction; None if it was not recorded: the gripper does not turn."""
    learned: EvidenceResult | None = None
    """Learning of RBF centres, noise and prior; None if they were given."""
    cells: CellErrors | None = None
    """Held-out errors by cell of a grid; None for a loaded skill."""

    def save(self, folder: Path) -> None:
        """Write `jacobian`, `visual_target.json`, `approach.json` and `angle` in a folder."""
        self.jacobian.save(folder / "jacobian")
        if self.target is not None:
            self.target.save(folder / "visual_target.json")
        if self.approach is not None:
            self.approach.save(folder / "approach.json")
        if self.angle is not None:
            self.angle.save(folder)

    @classmethod
    def load(cls, folder: Path) -> "VisualServoSkill":
        """Read a saved skill.

        Raises:
            FileNotFoundError: There is no such folder or file.
            ValueError: A file has an unknown version or kind.
        """
        target, approach = folder / "visual_target.json", folder / "approach.json"
        return cls(
            jacobian=RBFImageJacobian.load(folder / "jacobian"),
            target=VisualTarget.load(target) if target.exists() else None,
            approach=Approach.load(approach) if approach.exists() else None,
            angle=MarkerAngle.load(folder) if (folder / "angle").exists() else None,
        )

    def metrics(self) -> dict[str, float]:
        """Prediction errors of image motion and visual targets, by name.

        Raises:
            ValueError: The skill was loaded; its metrics are in metrics.json.
        """
        report = self.jacobian.report
        if report is None or self.cells is None:
            raise ValueError("a loaded skill has no metrics; see its metrics.json.")
        known = self.cells.relative[self.cells.pairs > 0]
        values = {
            "pairs": float(report.pairs),
            "neurons": float(len(self.jacobian.centers)),
            "motion_px": report.motion,
            "fit_error_px": report.error,
            "held_out_error_px": report.held_out_error,
            "held_out_relative": report.held_out_error / report.motion,
            "held_out_relative_worst_cell": float(known.max()),
        }
        camera = self.jacobian.camera_fit
        if camera is not None:
            values |= {
                "focal_px": float(camera.camera[FOCAL].exp()),
                "focal_relative_std": camera.deviation(FOCAL),
                "camera_place_std_mm": 1e3 * camera.deviation(SHIFT),
            }
        if self.learned is not None:
            first, best = self.learned.rounds[0], self.learned.rounds[self.learned.best]
            values |= {
                "pixel_noise_px": self.learned.config.pixel_noise,
                "width": float(self.learned.neurons.width),
                "learning_rounds": float(self.learned.best),
                "before_learning_error_px": first.held_out_error,
                "after_learning_error_px": best.held_out_error,
            }
        if self.target is not None:
            values["target_error_px"] = self.target.error
        if self.angle is not None:
            values["angle_spread_deg"] = math.degrees(self.angle.spread)
        if self.approach is not None:
            values["approach_spread_deg"] = math.degrees(self.approach.spread)
            values["approach_turned_deg"] = math.degrees(self.approach.turned)
        return values


def from_learned(learned: RBFImageJacobian) -> KalmanEstimator:
    """Kalman filter that starts from the learned Jacobian with the wide prior of a guess.

    The camera may have been moved since the fit, which the covariance of the fit does not
    cover.
    """
    network = copy.deepcopy(learned).double()
    network.covariance = None
    config = KalmanConfig(
        pose_noise=POSE_NOISE, pixel_noise=PIXEL_NOISE, watched_drift=10.0, max_step=0.1
    )
    return KalmanEstimator(network, config)
