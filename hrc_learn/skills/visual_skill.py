"""Learned skill of visual servoing, and its files."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import CellErrors, EvidenceResult, RBFImageJacobian
from hrc_learn.jacobian.perspective import FOCAL
from hrc_learn.kinematics.tool_orientation import Approach
from hrc_learn.model_files import SavedModel, write_model
from hrc_learn.skills.visual_target import VisualTarget, object_heading
from hrc_learn.store import JsonFile, Radians
from hrc_learn.vision.landmarks import Features, Landmarks, Object, Tool

OBJECT_FEATURE = "observation.object_feature"
"""Dataset column with the pixel and the visibility of the object's marker."""
OBJECT_FEATURE_NAMES = ("u", "v", "visible")
ANGLE_FEATURE = "observation.marker_angle"
"""Dataset column with the directions of both markers in the image [rad]."""
ANGLE_FEATURE_NAMES = ("tool", "object")
HALF_TURN = math.pi
"""Turn after which a parallel gripper grasps an object in the same way [rad]."""

# A chosen turn is kept until it lies further than this outside the range of turns [rad]. This
# is the error of an estimated turn while the camera is uncertain.
_KEPT = 0.15
# Files of target, approach and angle.
_FILES = ("visual_target.json", "approach.json", "angle.json")


@dataclass(frozen=True, kw_only=True)
class MarkerAngle(JsonFile):
    """Demonstrated turn of the end effector relative to the object's marker.

    The JSON file that `save` writes has the same fields.
    """

    version: Literal[2] = 2
    offset_rad: Radians
    """Heading of the tool's x axis minus heading of the marker, modulo half turns [rad]."""
    spread_rad: Radians
    """Root mean square deviation of the offset among the demonstrations [rad]."""

    @classmethod
    def fit(
        cls,
        camera: Float[Tensor, "13"],
        objects: Float[np.ndarray, "demos 2"],
        angles: Sequence[float],
        poses: Pose,
        target: VisualTarget,
    ) -> "MarkerAngle":
        """Learn the offset from the ends of demonstrations.

        Args:
            camera: Camera of the demonstrations.
            objects: Pixels of the object's marker [px].
            angles: Directions of the object's marker in the image [rad].
            poses: Poses of the end effector right above the object, (demos,).
            target: Position of the object's marker in the tool frame.
        """
        differences = []
        for pixel, direction, k in zip(objects, angles, range(len(angles)), strict=True):
            place = poses[k].apply(torch.from_numpy(target.offset))
            seen = object_heading(camera, torch.from_numpy(pixel), direction, float(place[2]))
            differences.append(_heading(poses[k].orientation) - seen)
        # The mean of angles modulo half turns is half the mean of their doubles.
        offset = float(np.angle(np.exp(2j * np.array(differences)).mean())) / 2
        off = (np.array(differences) - offset + HALF_TURN / 2) % HALF_TURN - HALF_TURN / 2
        return cls(offset_rad=offset, spread_rad=float(np.sqrt((off**2).mean())))

    def turn(
        self,
        heading: float,
        reference: Float[Tensor, "4"],
        now: float,
        turn_range: tuple[float, float],
        chosen: float | None,
    ) -> float:
        """Turn about the vertical that aligns a tool with an object [rad].

        Args:
            heading: Heading of the object's marker (see `object_heading`) [rad].
            reference: Orientation of a tool that is not turned.
            now: Present turn of the tool [rad].
            turn_range: Smallest and largest turn [rad]. Turns that differ by half turns are
                equivalent. Among the equivalent turns in the range, the one nearest to `now` is
                chosen. If none is in the range, the end of the range nearest to an equivalent
                turn is chosen.
            chosen: Turn chosen before [rad]; None: no turn. The turn equivalent to it is kept
                until it is well outside the range: otherwise noise would turn the tool back and
                forth near an end of the range.
        """
        turn, (low, high) = heading + self.offset_rad - _heading(reference), turn_range
        candidates = [turn + k * HALF_TURN for k in range(-3, 4)]
        if chosen is not None:
            same = min(candidates, key=lambda c: abs(c - chosen))
            if low - _KEPT <= same <= high + _KEPT:
                return same
        nearest = min(candidates, key=lambda c: (max(low - c, c - high, 0.0), abs(c - now)))
        return min(max(nearest, low), high)


def _heading(orientation: Float[Tensor, "4"]) -> float:
    """Heading of a tool's x axis in the horizontal plane [rad]."""
    x, y, _ = quaternion.to_matrix(orientation)[:, 0].tolist()
    return math.atan2(y, x)


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
    """Demonstrated turn of the gripper; None if marker directions were not recorded: the
    gripper then does not align with the object."""
    learned: EvidenceResult | None = None
    """Learned RBF centres, noise and prior; None if they were given and not learned."""
    landmarks: Landmarks | None = None
    """Landmarks of tool and objects; None if tool and objects carry markers."""
    cells: CellErrors | None = None
    """Held-out errors in each cell of a horizontal grid; None for a loaded skill."""

    def save(self, folder: str | Path) -> None:
        """Write the image Jacobian and all other learned parts that are not None."""
        folder = Path(folder)
        self.jacobian.save(folder / "jacobian")
        parts = self.target, self.approach, self.angle
        for name, part in zip(_FILES, parts, strict=True):
            if part is not None:
                part.save(folder / name)
        if self.landmarks is not None:
            _write_landmarks(self.landmarks, folder / "landmarks")

    @classmethod
    def load(cls, folder: str | Path) -> "VisualServoSkill":
        """Read a saved skill.

        Raises:
            FileNotFoundError: There is no such folder or file.
            ValueError: A file has an unknown version or kind.
        """
        target, approach, angle = (Path(folder, name) for name in _FILES)
        landmarks = Path(folder, "landmarks")
        return cls(
            jacobian=RBFImageJacobian.load(Path(folder, "jacobian")),
            target=VisualTarget.load(target) if target.exists() else None,
            approach=Approach.load(approach) if approach.exists() else None,
            angle=MarkerAngle.load(angle) if angle.exists() else None,
            landmarks=_read_landmarks(landmarks) if landmarks.exists() else None,
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
                "camera_place_std_mm": 1e3 * camera.place_deviation,
            }
        if self.learned is not None:
            first, best = self.learned.rounds[0], self.learned.kept
            values |= {
                "pixel_noise_px": best.config.pixel_noise,
                "width": float(best.neurons.width),
                "learning_rounds": float(self.learned.best),
                "before_learning_error_px": first.held_out_error,
                "after_learning_error_px": best.held_out_error,
            }
        if self.target is not None:
            values["target_error_px"] = self.target.error
        if self.angle is not None:
            values["angle_spread_deg"] = math.degrees(self.angle.spread_rad)
        if self.approach is not None:
            values["approach_spread_deg"] = math.degrees(self.approach.spread_rad)
            values["approach_turned_deg"] = math.degrees(self.approach.turned_rad)
        return values


def _write_landmarks(landmarks: Landmarks, folder: Path) -> None:
    tool = landmarks.tool
    arrays = {"points": tool.points, "descriptors": tool.descriptors, "place": tool.place}
    arrays["optics"] = np.array(tool.optics)
    for name, item in landmarks.objects.items():
        for k, view in enumerate(item.views):
            arrays |= {f"{name}.{k}.{field}": array for field, array in vars(view).items()}
    views = {name: len(item.views) for name, item in landmarks.objects.items()}
    config = {"image_size": list(landmarks.image_size), "views": views}
    tensors = {name: torch.from_numpy(np.ascontiguousarray(a)) for name, a in arrays.items()}
    write_model(folder, "Landmarks", config, tensors)


def _read_landmarks(folder: Path) -> Landmarks:
    saved = SavedModel(folder, "Landmarks")

    def arrays(*names: str, of: str = "") -> dict[str, np.ndarray]:
        return {name: saved.tensor(f"{of}{name}").numpy() for name in names}

    f, u, v, k = saved.tensor("optics").tolist()
    width, height = saved.get("image_size", list)
    objects = {
        name: Object(
            views=tuple(
                Features(**arrays("pixels", "descriptors", of=f"{name}.{n}."))
                for n in range(count)
            )
        )
        for name, count in saved.get("views", dict).items()
    }
    tool = Tool(**arrays("points", "descriptors", "place"), optics=(f, u, v, k))
    return Landmarks(tool=tool, objects=objects, image_size=(width, height))
