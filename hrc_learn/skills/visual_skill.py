"""Learned model of visual servoing: image Jacobian, approach direction, and visual target.

Demonstrations end with the end effector right above an object. The target is the place of the
object's marker in the tool frame there, learned from the pixels of both markers. In a new scene
the camera, as estimated then, turns the object's pixel into a ray; the ray meets the height
at which the demonstrations found objects; and the end effector belongs where the object has the
learned place. The target in the image is the pixel of the end effector's marker there, so
errors of calibration that move both markers alike cancel.
"""

import copy
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
from hrc_learn.jacobian import (
    CameraConfig,
    CameraEstimator,
    CameraSpread,
    CellErrors,
    EvidenceResult,
    RBFImageJacobian,
)
from hrc_learn.jacobian.perspective import (
    FOCAL,
    MARKER,
    SHIFT,
    SIZE,
    marker_pixels,
    on_plane,
)
from hrc_learn.kinematics.tool_orientation import Approach
from hrc_learn.model_files import SavedModel, write_model
from hrc_learn.store import Metres, Pixels, Radians, read_json, write_json
from hrc_learn.vision.landmarks import Features, Landmarks, Object, Tool

OBJECT_FEATURE = "observation.object_feature"
"""Dataset column with the object's marker in the image."""
OBJECT_FEATURE_NAMES = ("u", "v", "visible")
ANGLE_FEATURE = "observation.marker_angle"
"""Dataset column with the directions of both markers in the image [rad]."""
ANGLE_FEATURE_NAMES = ("tool", "object")
LONGEST_OFFSET = 0.4
"""Longest offset of the object's marker from the tool centre point [m]. Demonstrations at one
place hardly show the height of the object: without this bound it could be metres."""
HALF_TURN = math.pi
"""Period of the turn of a parallel grasp [rad]."""

# Steps of the fit of the offset, each from a closed form: perspective changes it slightly.
_STEPS = 8
# Offset from which the fit starts: below the end effector [m].
_BELOW = (0.0, 0.0, 0.1)
# Distance in the image along a marker's direction whose ends are followed to the table [px].
_ALONG = 20.0
# Distance from the range within which a chosen turn is kept [rad]: the error of its estimate
# while the camera is uncertain.
_KEPT = 0.15


@dataclass(frozen=True, kw_only=True)
class _TargetFile:
    version: Literal[3] = 3
    offset_m: tuple[Metres, Metres, Metres]
    error_px: Pixels | None


@dataclass(frozen=True, kw_only=True)
class VisualTarget:
    """Place of the object's marker in the frame of a tool right above it."""

    offset: Float[np.ndarray, "3"]
    """Place in the tool frame [m]."""
    error: float
    """Leave-one-out error, root mean square [px]; NaN with fewer than five demonstrations."""

    @classmethod
    def fit(
        cls,
        camera: Float[Tensor, "13"],
        objects: Float[np.ndarray, "demos 2"],
        poses: Pose,
    ) -> "VisualTarget":
        """Fit to the ends of demonstrations.

        Args:
            camera: Camera of the demonstrations (see `jacobian.perspective`).
            objects: Pixels of the object's marker [px].
            poses: Poses of the end effector right above it, (demos,).

        Raises:
            ValueError: There are fewer than three demonstrations.
        """
        if len(objects) < 3:
            raise ValueError(
                f"the visual target needs three or more demonstrations, got {len(objects)}."
            )
        offset, error = np.array(_BELOW), math.nan
        for _ in range(_STEPS):
            # The camera sees the object as a marker on the tool.
            carrying = torch.cat([camera[: MARKER.start], torch.from_numpy(offset)])
            seen, slope = marker_pixels(carrying, poses)
            design = slope[..., MARKER].numpy()
            towards = objects - seen.numpy() + design @ offset
            offset, error = _solved(design.reshape(-1, 3), towards)
        return cls(offset=offset, error=error)

    def tool_position(
        self,
        camera: Float[Tensor, "*batch 13"],
        pixel: Float[Tensor, "2"],
        above: Pose,
    ) -> Float[Tensor, "*batch 3"]:
        """Place of a tool right above an object [m].

        Args:
            camera: Cameras.
            pixel: Pixel of the object's marker [px].
            above: Orientation of the tool, and its height where demonstrations end.
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
            above: Orientation of the tool, and its height where demonstrations end.
            height: Height of the tool now [m]; None: that of `above`.
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
        """Standard deviation of the tool's place above the object, root of both axes [m].

        The image closes the loop, so what counts is the error of the target pixel.

        Args:
            cameras: Estimate of the camera.
            image_jacobian: Image Jacobian of the end effector's marker [px/m, px/rad].
            pixel: Pixel of the object's marker [px].
            above: Orientation of the tool, and its height where demonstrations end.
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
class _AngleFile:
    version: Literal[2] = 2
    offset_rad: Radians
    spread_rad: Radians


@dataclass(frozen=True, kw_only=True)
class MarkerAngle:
    """Demonstrated turn of the end effector relative to the object's marker."""

    offset: float
    """Heading of the tool's x axis less that of the marker's, modulo half turns [rad]."""
    spread: float
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
            angles: Directions of that marker in the image [rad].
            poses: Poses of the end effector right above it, (demos,).
            target: Place of the object in the tool frame.

        Raises:
            ValueError: There is no demonstration.
        """
        if not len(angles):
            raise ValueError("the direction of a marker needs one demonstration or more.")
        differences = []
        for pixel, direction, k in zip(objects, angles, range(len(angles)), strict=True):
            place = poses[k].apply(torch.from_numpy(target.offset))
            seen = object_heading(camera, torch.from_numpy(pixel), direction, float(place[2]))
            differences.append(_heading(poses[k].orientation) - seen)
        # The mean of angles modulo half turns is half the mean of their doubles.
        offset = float(np.angle(np.exp(2j * np.array(differences)).mean())) / 2
        off = np.array([_wrapped(d - offset) for d in differences])
        return cls(offset=offset, spread=float(np.sqrt((off**2).mean())))

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
            turn_range: Smallest and largest turn [rad]. Of turns that differ by half turns, the
                nearest one in the range is chosen, and kept while it is not far out of the
                range: near an end of the range, noise would otherwise turn the tool back and
                forth.
            chosen: Turn chosen before; None: none.
        """
        return _within(heading + self.offset - _heading(reference), now, turn_range, chosen)

    def save(self, path: Path) -> None:
        """Write a JSON file, atomically."""
        write_json(path, _AngleFile(offset_rad=self.offset, spread_rad=self.spread))

    @classmethod
    def load(cls, path: Path) -> "MarkerAngle":
        """Read a saved direction.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is damaged, or has an unknown version.
        """
        content = read_json(path, _AngleFile, "fit it again")
        return cls(offset=content.offset_rad, spread=content.spread_rad)


def object_heading(
    camera: Float[Tensor, "13"], pixel: Float[Tensor, "2"], angle: float, height: float
) -> float:
    """Heading in the base frame of a marker that lies flat [rad].

    Args:
        camera: Camera.
        pixel: Pixel of the marker [px].
        angle: Its direction in the image [rad].
        height: Its height [m].
    """
    along = _ALONG * pixel.new_tensor([math.cos(angle), math.sin(angle)])
    ends = torch.stack([pixel - along, pixel + along])
    start, end = on_plane(camera.expand(2, SIZE), ends, height)
    x, y, _ = (end - start).tolist()
    return math.atan2(y, x)


def _heading(orientation: Float[Tensor, "4"]) -> float:
    """Heading of a tool's x axis in the horizontal plane [rad]."""
    x, y, _ = quaternion.to_matrix(orientation)[:, 0].tolist()
    return math.atan2(y, x)


def _within(
    turn: float, now: float, turn_range: tuple[float, float], chosen: float | None
) -> float:
    """Turn in the range that equals `turn` modulo half turns.

    The one nearest to the present turn; the one chosen before, if it is nearly in the range.
    """
    low, high = turn_range
    candidates = [turn + k * HALF_TURN for k in range(-3, 4)]
    if chosen is not None:
        same = min(candidates, key=lambda c: abs(c - chosen))
        if low - _KEPT <= same <= high + _KEPT:
            return same
    inside = [c for c in candidates if low <= c <= high]
    return min(inside or [min(max(turn, low), high)], key=lambda c: abs(c - now))


def _wrapped(angle: float) -> float:
    """An angle modulo half turns, within a quarter turn of zero [rad]."""
    return float((angle + HALF_TURN / 2) % HALF_TURN - HALF_TURN / 2)


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
    landmarks: Landmarks | None = None
    """What is found without markers; None: tool and objects carry them."""
    cells: CellErrors | None = None
    """Held-out errors by cell of a grid; None for a loaded skill."""

    def save(self, folder: Path) -> None:
        """Write the image Jacobian, and whatever else was learned with it."""
        self.jacobian.save(folder / "jacobian")
        if self.target is not None:
            self.target.save(folder / "visual_target.json")
        if self.approach is not None:
            self.approach.save(folder / "approach.json")
        if self.angle is not None:
            self.angle.save(folder / "angle.json")
        if self.landmarks is not None:
            _write_landmarks(self.landmarks, folder / "landmarks")

    @classmethod
    def load(cls, folder: Path) -> "VisualServoSkill":
        """Read a saved skill.

        Raises:
            FileNotFoundError: There is no such folder or file.
            ValueError: A file has an unknown version or kind.
        """
        target, approach = folder / "visual_target.json", folder / "approach.json"
        angle, landmarks = folder / "angle.json", folder / "landmarks"
        return cls(
            jacobian=RBFImageJacobian.load(folder / "jacobian"),
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


def _write_landmarks(landmarks: Landmarks, folder: Path) -> None:
    tool = landmarks.tool
    arrays = {"points": tool.points, "descriptors": tool.descriptors, "place": tool.place}
    arrays["optics"] = np.array(tool.optics)
    for name, item in landmarks.objects.items():
        for k, view in enumerate(item.views):
            arrays[f"{name}.{k}.pixels"] = view.pixels
            arrays[f"{name}.{k}.descriptors"] = view.descriptors
    views = {name: len(item.views) for name, item in landmarks.objects.items()}
    config = {"image_size": list(landmarks.image_size), "views": views}
    tensors = {name: torch.from_numpy(np.ascontiguousarray(a)) for name, a in arrays.items()}
    write_model(folder, "Landmarks", config, tensors)


def _read_landmarks(folder: Path) -> Landmarks:
    saved = SavedModel(folder, "Landmarks")

    def array(name: str) -> np.ndarray:
        return saved.tensor(name).numpy()

    def view(key: str) -> Features:
        return Features(pixels=array(f"{key}.pixels"), descriptors=array(f"{key}.descriptors"))

    f, u, v, k = array("optics").tolist()
    width, height = saved.get("image_size", list)
    tool = Tool(
        points=array("points"),
        descriptors=array("descriptors"),
        place=array("place"),
        optics=(f, u, v, k),
    )
    views = saved.get("views", dict).items()
    objects = {
        name: Object(views=tuple(view(f"{name}.{n}") for n in range(count)))
        for name, count in views
    }
    return Landmarks(tool=tool, objects=objects, image_size=(width, height))


def camera_estimator(
    learned: RBFImageJacobian, config: CameraConfig | None = None
) -> CameraEstimator:
    """Online estimate of a camera that may have been moved since the demonstrations.

    Args:
        learned: Image Jacobian of the demonstrations with its camera.
        config: Window, noise and prior.

    Raises:
        ValueError: The model has no camera.
    """
    return CameraEstimator(copy.deepcopy(learned).double(), config)
