"""What visual servoing has learned: image Jacobian, approach direction, and visual target.

The target is where in the image the end effector's marker should be, for it to be right above
an object.

The markers of end effector and object are at different heights and places, so the target is not
the object's pixel. With an uncalibrated camera the offset has to be learned: each demonstration
ends with the end effector right above an object, and gives one pair of pixels.

For a camera at its place in the demonstrations, a map from pixel to pixel is enough. One that
has been moved since sees the same offset in space from another side: the image Jacobian, which
adapts, projects it into the image.
"""

import copy
import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.controller import INITIAL_IMAGE_JACOBIAN
from hrc_learn.jacobian import (
    CellErrors,
    EvidenceResult,
    KalmanEstimator,
    RBFImageJacobian,
    paper_grid,
)
from hrc_learn.kinematics.tool_orientation import Approach
from hrc_learn.store import new_file

OBJECT_FEATURE = "observation.object_feature"
"""Column of a dataset with the object's marker in the image."""
OBJECT_FEATURE_NAMES = ("u", "v", "visible")
UP = np.array([0.0, 0.0, 1.0])
LONGEST_OFFSET = 0.3
"""Of the end effector's marker from the object's [m]. From few demonstrations along a flat box
the image Jacobian knows little about height: without this bound the least-squares offset can be
metres long."""


@dataclass(frozen=True, kw_only=True)
class VisualTarget:
    """Affine map from the pixel of an object's marker to that of the end effector's above it.

    Affine is exact for a camera that looks straight down through a perfect lens, and good to a
    few pixels for one that does not; `error` tells.
    """

    matrix: Float[np.ndarray, "2 3"]
    """Maps (u, v, 1) of the object's marker to (u, v) of the end effector's [px]."""
    error: float
    """Leave-one-out error, root mean square [px]; NaN from fewer than five demonstrations."""
    offset: Float[np.ndarray, "3"] | None = None
    """From the object's marker to the end effector's, base frame [m], by the image Jacobian at
    the latter: shorter than the true one, as perspective shrinks what is further away. None
    where no image Jacobian was given."""
    offset_error: float = float("nan")
    """As `error`, of targets by the offset [px]."""

    @classmethod
    def fit(
        cls,
        objects: Float[np.ndarray, "demos 2"],
        tools: Float[np.ndarray, "demos 2"],
        jacobians: Float[np.ndarray, "demos 2 6"] | None = None,
    ) -> "VisualTarget":
        """Fit to the ends of demonstrations.

        Args:
            objects: Pixels of the object's marker [px].
            tools: Pixels of the end effector's marker right above it [px].
            jacobians: Image Jacobians of that marker there [px/m, px/rad].

        Raises:
            ValueError: If there are fewer than three demonstrations, or they lie on a line.
        """
        design = np.column_stack([objects, np.ones(len(objects))])
        if np.linalg.matrix_rank(design - design.mean(axis=0)) < 2:
            raise ValueError(
                f"{len(objects)} demonstrations do not determine the visual target: at least "
                "three are needed, with objects that do not lie on one line in the image."
            )
        matrix, error = _solved(np.kron(design, np.eye(2)), tools)
        offset, offset_error = None, float("nan")
        if jacobians is not None:
            directions = jacobians[..., :3].reshape(-1, 3)
            offset, offset_error = _solved(directions, tools - objects, LONGEST_OFFSET)
        return cls(
            matrix=matrix.reshape(3, 2).T, error=error, offset=offset, offset_error=offset_error
        )

    def __call__(self, pixel: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """Where the end effector's marker should be for an object's marker at `pixel` [px]."""
        return self.matrix @ np.append(pixel, 1.0)

    def from_view(
        self, pixel: Float[np.ndarray, "2"], jacobian: Float[np.ndarray, "2 6"]
    ) -> Float[np.ndarray, "2"]:
        """The same for a camera that may have been moved since the demonstrations.

        Args:
            pixel: Of the object's marker [px].
            jacobian: Estimate of the image Jacobian of the end effector's marker
                [px/m, px/rad].
        """
        return self(pixel) if self.offset is None else pixel + jacobian[:, :3] @ self.offset

    def line(self) -> Float[np.ndarray, "3"]:
        """Direction from the object's marker to the end effector's above it, base frame.

        Straight up without a learned offset, or with one that is flatter than 30 degrees,
        which few demonstrations cannot tell from noise.
        """
        if self.offset is None or self.offset[2] < 0.5 * np.linalg.norm(self.offset):
            return UP
        return self.offset / np.linalg.norm(self.offset)

    def save(self, path: Path) -> None:
        """Write to a JSON file, whole or not at all."""
        content = {
            "version": 1,
            "matrix": self.matrix.tolist(),
            "error_px": _or_none(self.error),
            "offset_m": None if self.offset is None else self.offset.tolist(),
            "offset_error_px": _or_none(self.offset_error),
        }
        with new_file(path) as part:
            part.write_text(json.dumps(content, indent=2), encoding="utf-8")

    @classmethod
    def load(cls, path: Path) -> "VisualTarget":
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If it is not one of ours.
        """
        content = json.loads(path.read_text(encoding="utf-8"))
        if content.get("version") != 1 or "matrix" not in content:
            raise ValueError(f"{path} is not a visual target of a known version: fit it again.")
        offset = content.get("offset_m")
        return cls(
            matrix=np.array(content["matrix"]),
            error=_or_nan(content["error_px"]),
            offset=None if offset is None else np.array(offset),
            offset_error=_or_nan(content.get("offset_error_px")),
        )


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


def _or_none(error: float) -> float | None:
    return None if np.isnan(error) else error


def _or_nan(error: float | None) -> float:
    return float("nan") if error is None else float(error)


@dataclass(frozen=True, kw_only=True)
class VisualServoSkill:
    """What was learned from demonstrations of visual servoing."""

    jacobian: RBFImageJacobian
    target: VisualTarget | None
    """None where no object was observed."""
    approach: Approach | None = None
    """None where no object was observed."""
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
        )

    def target_of(
        self, pixel: Float[np.ndarray, "2"], jacobian: Float[np.ndarray, "2 6"]
    ) -> Float[np.ndarray, "2"]:
        """Where the marker should be for the end effector to be above an object at a pixel.

        Args:
            pixel: Of the object's marker [px].
            jacobian: Estimate of the image Jacobian of the end effector's marker
                [px/m, px/rad].

        Raises:
            ValueError: If no object was observed in the demonstrations.
        """
        if self.target is None:
            raise ValueError(
                f"the skill knows no visual target: its demonstrations lack {OBJECT_FEATURE}."
            )
        return self.target.from_view(pixel, jacobian)

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
            values["target_error_by_offset_px"] = self.target.offset_error
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
    return KalmanEstimator(network)


def guessed_network() -> RBFImageJacobian:
    """The paper's initial image Jacobian, the same everywhere."""
    guess = torch.tensor(INITIAL_IMAGE_JACOBIAN, dtype=torch.float64)
    return RBFImageJacobian.from_jacobian(guess, paper_grid(), 0.1)
