"""What visual servoing has learned: image Jacobian, approach direction, and visual target.

The target is where in the image the end effector's marker should be, for it to be right above
an object.

The markers of end effector and object are at different heights and places, so the target is not
the object's pixel. With an uncalibrated camera the offset has to be learned: each demonstration
ends with the end effector right above an object, and gives one pair of pixels.

The offset is one in space, fixed to the tool that turns with the object. The image Jacobian,
which adapts to a camera that has been moved, projects it into the image: with the perspective
of a camera whose focal length was learned, without which the offset looks a few percent longer
or shorter once the camera has been turned by 10 degrees.
"""

import copy
import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller import INITIAL_IMAGE_JACOBIAN
from hrc_learn.geometry import quaternion
from hrc_learn.jacobian import (
    CellErrors,
    EvidenceResult,
    KalmanConfig,
    KalmanEstimator,
    RBFImageJacobian,
    depth_gradient,
    paper_grid,
)
from hrc_learn.kinematics.tool_orientation import Approach
from hrc_learn.skills.marker_angle import MarkerAngle
from hrc_learn.store import write_text
from hrc_learn.vision.camera_model import IMAGE_SIZE

OBJECT_FEATURE = "observation.object_feature"
"""Column of a dataset with the object's marker in the image."""
OBJECT_FEATURE_NAMES = ("u", "v", "visible")
ANGLE_FEATURE = "observation.marker_angle"
"""Column with the directions of the end effector's and of the object's marker [rad]."""
ANGLE_FEATURE_NAMES = ("tool", "object")
UP = np.array([0.0, 0.0, 1.0])
LONGEST_OFFSET = 0.3
"""Of the end effector's marker from the object's [m]. From few demonstrations along a flat box
the image Jacobian knows little about height: without this bound the least-squares offset can be
metres long."""

_MOST_NEARER = 1.5
"""How much nearer to the camera than the object the end effector's marker may be believed, as a
ratio: a bound for as long as the image Jacobian is not known yet."""

POSE_NOISE = 1.5e-4
"""Standard deviation of a pose by encoders with noise of 1e-4 rad, on levers of up to 0.8 m, as
the estimator of the image Jacobian has to expect it [m]."""
PIXEL_NOISE = 0.15
"""The same of a marker's centre [px]: 0.08 px of the detector (docs/training.md), more in
images that are noisy and blurred."""


@dataclass(frozen=True, kw_only=True)
class VisualTarget:
    """Offset from the object's marker to the end effector's right above it."""

    offset: Float[np.ndarray, "3"]
    """In the tool's frame [m]; without a focal length the one that an image without perspective
    would show, shorter for an object further away."""
    error: float
    """Leave-one-out error, root mean square [px]; NaN from fewer than five demonstrations."""
    focal: float | None = None
    """Focal length of the camera [px]; None: perspective is left out."""

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
            orientations: Of the end effector there.
            focal: Focal length of the camera [px]; None leaves perspective out.

        Raises:
            ValueError: If there are fewer than three demonstrations.
        """
        if len(objects) < 3:
            raise ValueError(
                f"{len(objects)} demonstrations do not determine the visual target: at least "
                "three are needed."
            )
        apart, rows = tools - objects, jacobians[..., :3]
        if focal is not None:
            # apart = J o / (1 - g o) is linear in the offset o as well.
            rows = rows + apart[..., :, None] * _gradient(rows, tools, focal)[..., None, :]
        design = rows @ quaternion.to_matrix(orientations).numpy()
        offset, error = _solved(design.reshape(-1, 3), apart, LONGEST_OFFSET)
        return cls(offset=offset, error=error, focal=focal)

    def __call__(
        self,
        pixel: Float[np.ndarray, "2"],
        jacobian: Float[np.ndarray, "2 6"],
        orientation: Float[Tensor, "4"],
        further: Float[np.ndarray, "3"] | None = None,
    ) -> Float[np.ndarray, "2"]:
        """Where the end effector's marker should be for an object's marker at `pixel` [px].

        Args:
            pixel: Of the object's marker [px].
            jacobian: Estimate of the image Jacobian of the end effector's marker
                [px/m, px/rad].
            orientation: Of the end effector when it is there.
            further: Way from there, base frame [m]; none when None.
        """
        offset = self._in_base(orientation)
        if further is not None:
            offset = offset + further
        apart = jacobian[:, :3] @ offset
        seen = pixel + apart
        # Depth changes with where it is seen, a little: twice is within a tenth of a pixel.
        for _ in range(2):
            nearer = 1 - float(self.depth_gradient(jacobian, seen) @ offset)
            seen = pixel + apart / min(max(nearer, 1 / _MOST_NEARER), _MOST_NEARER)
        return seen

    def depth_gradient(
        self, jacobian: Float[np.ndarray, "2 6"], pixel: Float[np.ndarray, "2"]
    ) -> Float[np.ndarray, "3"]:
        """Relative change of the marker's depth with its place [1/m]; 0 without a focal length.

        Args:
            jacobian: Image Jacobian of the end effector's marker [px/m, px/rad].
            pixel: Where it is seen [px].
        """
        if self.focal is None:
            return np.zeros(3)
        return _gradient(jacobian[:, :3], pixel, self.focal)

    def line(self, orientation: Float[Tensor, "4"]) -> Float[np.ndarray, "3"]:
        """Direction from the object's marker to the end effector's above it, base frame.

        Straight up for an offset that is flatter than 30 degrees, which few demonstrations
        cannot tell from noise.
        """
        offset = self._in_base(orientation)
        length = np.linalg.norm(offset)
        return UP if offset[2] < 0.5 * length else offset / length

    def _in_base(self, orientation: Float[Tensor, "4"]) -> Float[np.ndarray, "3"]:
        return quaternion.rotate(orientation, torch.from_numpy(self.offset)).numpy()

    def save(self, path: Path) -> None:
        """Write to a JSON file, whole or not at all."""
        error = None if np.isnan(self.error) else self.error
        content = {
            "version": 2,
            "offset_m": self.offset.tolist(),
            "error_px": error,
            "focal_px": self.focal,
        }
        write_text(path, json.dumps(content, indent=2))

    @classmethod
    def load(cls, path: Path) -> "VisualTarget":
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If it is not one of ours.
        """
        content = json.loads(path.read_text(encoding="utf-8"))
        if content.get("version") != 2 or "offset_m" not in content:
            raise ValueError(f"{path} is not a visual target of a known version: fit it again.")
        error = content["error_px"]
        return cls(
            offset=np.array(content["offset_m"]),
            error=float("nan") if error is None else float(error),
            focal=content.get("focal_px"),
        )


def _gradient(
    jacobian: Float[np.ndarray, "*batch 2 3"],
    pixel: Float[np.ndarray, "*batch 2"],
    focal: float,
) -> Float[np.ndarray, "*batch 3"]:
    """Relative change of depth with place [1/m] of a camera that looks through its middle."""
    return depth_gradient(jacobian, pixel, focal, np.array(IMAGE_SIZE) / 2)


def _solved(
    design: Float[np.ndarray, "equations unknowns"],
    pixels: Float[np.ndarray, "demos 2"],
    longest: float = np.inf,
) -> tuple[Float[np.ndarray, " unknowns"], float]:
    """Least squares on pixels, two equations a demonstration, and their leave-one-out error.

    A solution longer than `longest` is shortened by the ridge penalty that takes.
    """
    inverse = _ridge_inverse(design, pixels.ravel(), longest)
    solution = inverse @ pixels.ravel()
    if len(pixels) < 5:
        return solution, float("nan")
    residuals = pixels - (design @ solution).reshape(-1, 2)
    # By blocks of the hat matrix, one for each demonstration (Allen 1974, PRESS).
    hat = (design @ inverse).reshape(len(pixels), 2, len(pixels), 2)
    own = hat[np.arange(len(pixels)), :, np.arange(len(pixels))]
    press = np.linalg.solve(np.eye(2) - own, residuals[..., None])
    return solution, float(np.sqrt((press**2).sum(axis=(1, 2)).mean()))


def _ridge_inverse(
    design: Float[np.ndarray, "equations unknowns"],
    values: Float[np.ndarray, " equations"],
    longest: float,
) -> Float[np.ndarray, "unknowns equations"]:
    """Pseudo-inverse, damped just enough to keep the solution as short as asked for."""
    u, s, vt = np.linalg.svd(design, full_matrices=False)
    # Rank deficient designs: the factor keeps the divisions below finite.
    s = np.maximum(s, 1e-12 * s[0])
    along = u.T @ values

    def length(penalty: float) -> float:
        return float(np.linalg.norm(s * along / (s**2 + penalty)))

    low, high = 0.0, 0.0
    if length(0.0) > longest:
        high = float(s[0] * np.linalg.norm(along)) / longest
        # Bisection: the length falls with the penalty.
        while high - low > 1e-6 * high:
            middle = (low + high) / 2
            low, high = (middle, high) if length(middle) > longest else (low, middle)
    return (vt.T * (s / (s**2 + high))) @ u.T


@dataclass(frozen=True, kw_only=True)
class VisualServoSkill:
    """What was learned from demonstrations of visual servoing."""

    jacobian: RBFImageJacobian
    target: VisualTarget | None
    """None where no object was observed."""
    approach: Approach | None = None
    """None where no object was observed."""
    angle: MarkerAngle | None = None
    """None where no directions of markers were recorded: the gripper is not turned."""
    learned: EvidenceResult | None = None
    """How RBF centres, noise and prior were learned; None where they were given."""
    cells: CellErrors | None = None
    """Held-out errors by cell of a grid; None of a skill that was loaded."""

    def save(self, folder: Path) -> None:
        """Write `folder/jacobian`, `folder/visual_target.json`, `folder/approach.json`."""
        self.jacobian.save(folder / "jacobian")
        if self.target is not None:
            self.target.save(folder / "visual_target.json")
        if self.approach is not None:
            self.approach.save(folder / "approach.json")
        if self.angle is not None:
            self.angle.save(folder)

    @classmethod
    def load(cls, folder: Path) -> "VisualServoSkill":
        """Read what `training/fit_image_jacobian.py` wrote.

        Raises:
            FileNotFoundError: If there is no such folder or file.
            ValueError: If a file is not one of ours.
        """
        target, approach = folder / "visual_target.json", folder / "approach.json"
        return cls(
            jacobian=RBFImageJacobian.load(folder / "jacobian"),
            target=VisualTarget.load(target) if target.exists() else None,
            approach=Approach.load(approach) if approach.exists() else None,
            angle=MarkerAngle.load(folder) if (folder / "angle").exists() else None,
        )

    def target_of(
        self,
        pixel: Float[np.ndarray, "2"],
        jacobian: Float[np.ndarray, "2 6"],
        orientation: Float[Tensor, "4"],
        further: Float[np.ndarray, "3"] | None = None,
    ) -> Float[np.ndarray, "2"]:
        """Where the marker should be for the end effector to be above an object at a pixel.

        Args:
            pixel: Of the object's marker [px].
            jacobian: Estimate of the image Jacobian of the end effector's marker
                [px/m, px/rad].
            orientation: Of the end effector there.
            further: Way from there, base frame [m]; none when None.

        Raises:
            ValueError: If no object was observed in the demonstrations.
        """
        if self.target is None:
            raise ValueError(
                f"the skill knows no visual target: its demonstrations lack {OBJECT_FEATURE}."
            )
        return self.target(pixel, jacobian, orientation, further)

    def metrics(self) -> dict[str, float]:
        """How well image motion and visual targets are predicted.

        Raises:
            ValueError: If the skill was loaded; its metrics are in metrics.json.
        """
        report = self.jacobian.report
        if report is None or self.cells is None:
            raise ValueError("only a skill just fitted has metrics; see its metrics.json.")
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
    """A Kalman filter that starts from the learned Jacobian, but does not rely on it.

    The camera may have been moved since it was learned, about which the covariance of the fit
    knows nothing; the wide prior of a guess takes its place.
    """
    network = copy.deepcopy(learned).double()
    network.covariance = None
    config = KalmanConfig(
        pose_noise=POSE_NOISE, pixel_noise=PIXEL_NOISE, watched_drift=10.0, max_step=0.1
    )
    return KalmanEstimator(network, config)


def guessed_network() -> RBFImageJacobian:
    """The paper's initial image Jacobian, the same everywhere."""
    guess = torch.tensor(INITIAL_IMAGE_JACOBIAN, dtype=torch.float64)
    return RBFImageJacobian.from_jacobian(guess, paper_grid(), 0.1)
