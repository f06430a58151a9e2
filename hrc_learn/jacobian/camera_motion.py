"""Notices that a camera was moved: the robot's own marker is not seen where it must be.

Demonstrations tell where a camera sees the marker of a tool at any pose of it (`MarkerCamera`).
A camera that turned by w and moved by v sees it elsewhere, to first order by e = L (w, v) with
the derivatives L of the pixel by the camera's twist (its interaction matrix). Over the last
seconds, e is fitted by one such motion; how much of it that explains, as the root mean square
over the frames, is compared with what the demonstrations themselves show at most when each of
them is left out of the fit. Errors of calibration, lens and stamps are within that, and so do
not raise an alarm. Where no demonstration went, nothing is known of these errors, and nothing
is compared.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian.fitting import RBFCenters
from hrc_learn.jacobian.network import RBFImageJacobian
from hrc_learn.jacobian.perspective import MarkerCamera
from hrc_learn.jacobian.samples import FOLDS, ImageDemonstration

_PLAUSIBLE = np.array([0.1] * 3 + [0.1] * 3)
"""Prior standard deviation of a motion [rad, m]: settles which of a turn and a shift that look
alike is meant, by taking both as likely for a tripod that was knocked."""
_FARTHEST = 5.0
"""Of these a camera has not moved by more: it would not see the table any longer."""
FEWEST_FRAMES = 10
"""Frames with the marker in view below which nothing is said."""
_OUTLIER = 3.0
"""Errors count no more than so many medians of all in view: a marker half covered is off by
pixels in a frame or two, a moved camera in all of them."""
_REFINEMENTS = 5
"""Steps of Gauss and Newton: three are enough for ten degrees."""


@dataclass(frozen=True, kw_only=True)
class CameraMotion:
    """How a camera moved from where it stood during the demonstrations."""

    rotation: tuple[float, float, float]
    """Rotation vector about the camera's axes (x right, y down, z along the view) [rad]."""
    translation: tuple[float, float, float]
    """Along the same axes [m]."""
    displacement: float
    """Root mean square over the frames of what it explains in the image [px]."""

    @property
    def angle(self) -> float:
        """[rad]"""
        return float(np.linalg.norm(self.rotation))

    @property
    def distance(self) -> float:
        """[m]"""
        return float(np.linalg.norm(self.translation))

    @property
    def twist(self) -> Float[np.ndarray, "6"]:
        """As `MarkerCamera.moved` takes it [rad, m]."""
        return np.array([*self.rotation, *self.translation])

    def __str__(self) -> str:
        return (
            f"camera moved by {np.rad2deg(self.angle):.1f} degrees and "
            f"{1e3 * self.distance:.0f} mm ({self.displacement:.1f} px in the image)"
        )


@dataclass(frozen=True, kw_only=True)
class CameraReference:
    """A camera as the demonstrations saw it, and how exactly they tell."""

    camera: MarkerCamera
    """Fitted to all of them."""
    threshold: float
    """Displacement beyond which the camera was moved [px]."""
    window: float
    """Over which the threshold was measured [s]."""
    lower: tuple[float, float, float]
    """Corner of the box in which demonstrations showed the marker, in the camera frame [m]."""
    upper: tuple[float, float, float]
    """The opposite one."""

    def covers(self, point: Float[np.ndarray, "3"]) -> bool:
        """Whether demonstrations showed the marker at or around a point of the camera frame."""
        return bool(((point >= self.lower) & (point <= self.upper)).all())

    @staticmethod
    def fit(
        demonstrations: Sequence[ImageDemonstration],
        fps: float,
        image_size: tuple[int, int],
        *,
        window: float = 1.0,
        margin: float = 2.5,
    ) -> CameraReference:
        """Learn where the marker must be seen, and how far off it is without any motion.

        Args:
            demonstrations: Of one camera that stood still, two or more; read several times.
            fps: Of their frames [1/s].
            image_size: Width and height [px].
            window: Time over which a motion is looked for [s]; half of it passes, on the
                average, before a small one counts in full.
            margin: Threshold over the largest displacement in demonstrations held out.

        Raises:
            ValueError: Fewer than two demonstrations, or the marker is hardly seen in them.
        """
        if len(demonstrations) < 2:
            raise ValueError(
                f"a camera's reference needs two demonstrations or more, to hold one out; got "
                f"{len(demonstrations)}."
            )
        if not (window > 0 and fps > 0 and margin >= 1):
            raise ValueError(
                f"window and fps must be positive and margin at least 1, got {window}, {fps} "
                f"and {margin}."
            )
        largest = 0.0
        folds = min(FOLDS, len(demonstrations))
        for fold in range(folds):
            others = [d for i, d in enumerate(demonstrations) if i % folds != fold]
            camera = _camera_of(others, image_size)
            watch = CameraWatch(_reference(camera, others, np.inf, window))
            for demo in demonstrations[fold::folds]:
                largest = max(largest, _largest_displacement(watch, demo, fps))
        if not largest:
            raise ValueError(
                f"the marker is never seen in {FEWEST_FRAMES} frames within {window} s of a "
                "demonstration: there is nothing to compare with."
            )
        camera = _camera_of(demonstrations, image_size)
        return _reference(camera, demonstrations, margin * largest, window)

    def content(self) -> dict[str, Any]:
        """As JSON takes it."""
        return asdict(self)

    @staticmethod
    def from_content(content: dict[str, Any]) -> CameraReference:
        """Of what `content` returned, as JSON gave it back.

        Raises:
            ValueError: A field is missing or of another kind.
        """
        try:
            camera = MarkerCamera(**_numbers(content["camera"]))
            return CameraReference(**{**_numbers({**content, "camera": 0.0}), "camera": camera})
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                "a camera's reference has camera, threshold, window, lower and upper, this one "
                f"not: {error}."
            ) from error


def _numbers(content: dict[str, Any]) -> dict[str, Any]:
    """With tuples where JSON has lists."""
    return {
        name: tuple(map(float, value)) if isinstance(value, list | tuple) else float(value)
        for name, value in content.items()
    }


def _reference(
    camera: MarkerCamera,
    demonstrations: Sequence[ImageDemonstration],
    threshold: float,
    window: float,
) -> CameraReference:
    points = np.concatenate([camera.points(_seen(demo)[0]) for demo in demonstrations])
    lower, upper = (tuple(corner.tolist()) for corner in (points.min(0), points.max(0)))
    return CameraReference(
        camera=camera, threshold=threshold, window=window, lower=lower, upper=upper
    )


class _Frame(NamedTuple):
    time: float
    point: Float[np.ndarray, "3"]
    pixel: Float[np.ndarray, "2"]
    error: Float[np.ndarray, "2"]
    jacobian: Float[np.ndarray, "2 6"]


class CameraWatch:
    """Compares frame by frame where a marker is seen with where it must be.

    Attributes:
        reference: What is compared with.
        displacement: Of the last seconds [px]; 0 while too little is seen.
    """

    def __init__(self, reference: CameraReference, fewest: int = FEWEST_FRAMES):
        """Compare with a camera that stands still.

        Args:
            reference: Of the demonstrations.
            fewest: Frames from which on a motion is told; of less than 10, the fewer the larger
                it must be.
        """
        self.reference = reference
        self.displacement = 0.0
        self._fewest = fewest
        self._frames: deque[_Frame] = deque()

    def clear(self) -> None:
        """Forget what was seen: before another episode, or after a pause."""
        self.displacement = 0.0
        self._frames.clear()

    def update(
        self, time: float, pose: Pose, pixel: Float[np.ndarray, "2"]
    ) -> CameraMotion | None:
        """Take one frame in which the marker was found.

        It does not count where the tool is outside the region of the demonstrations.

        Args:
            time: Of the image [s], later than the frame's before.
            pose: Of the tool at that time, unbatched.
            pixel: Where the marker was seen [px].

        Returns:
            The motion since the demonstrations where it is larger than the threshold.

        Raises:
            ValueError: Time or pixel are not finite, or time does not go on.
        """
        if not (np.isfinite(time) and np.isfinite(pixel).all()):
            raise ValueError(
                f"time and pixel must be finite, got {time} and {pixel}: leave frames out in "
                "which the marker was not found."
            )
        frames = self._frames
        if frames and not time > frames[-1].time:
            raise ValueError(
                f"time must go on, but {time} follows {frames[-1].time}: call clear() between "
                "episodes."
            )
        camera = self.reference.camera
        point = camera.points(_double(pose))
        if self.reference.covers(point):
            frames.append(
                _Frame(
                    time,
                    point,
                    pixel,
                    pixel - camera.project(point),
                    camera.motion_jacobian(point),
                )
            )
        while frames and frames[0].time < time - self.reference.window:
            frames.popleft()
        if len(frames) < self._fewest:
            self.displacement = 0.0
            return None
        errors = np.array([frame.error for frame in frames])
        jacobians = np.array([frame.jacobian for frame in frames])
        twist, self.displacement = _explained(errors, jacobians)
        if self.displacement <= self.reference.threshold * max(1, FEWEST_FRAMES / len(frames)):
            return None
        points, pixels = (np.array([f[i] for f in frames]) for i in (1, 2))
        return motion_of(refined_twist(camera, points, pixels, twist), points, camera)


@dataclass(frozen=True, kw_only=True)
class CameraPlacement:
    """Episodes during which a camera stood still at one place."""

    episodes: tuple[int, ...]
    """Indices into the demonstrations."""
    motion: CameraMotion
    """From the first placement."""


def camera_placements(
    demonstrations: Sequence[ImageDemonstration],
    image_size: tuple[int, int],
    *,
    margin: float = 6.0,
) -> list[CameraPlacement]:
    """Where the camera stood in which episodes, in the order of their recording.

    Camera and marker are found from all episodes together, the camera's motion for each. An
    episode belongs to the first placement that it differs from by less than `margin` times what
    neighbouring episodes differ by in the median. A camera that was moved before every second
    episode or more often is not noticed.

    Args:
        demonstrations: In the order of recording; in memory, they are read several times.
        image_size: Width and height [px].
        margin: See above.

    Returns:
        One placement where the camera stood still. Episodes in which the marker is hardly seen
        are in none.
    """
    seen = {
        index: frames
        for index, demo in enumerate(demonstrations)
        if len(frames := _seen(demo)[1]) >= FEWEST_FRAMES
    }
    if len(seen) < 2:
        return []
    chosen = [demonstrations[index] for index in seen]
    unmoved, twists = chosen, np.zeros((len(chosen), 6))
    camera = _camera_of(chosen, image_size)
    for _ in range(_REFINEMENTS):
        views = [(camera.points(pose), pixel) for pose, pixel in map(_seen, chosen)]
        twists = np.array([refined_twist(camera, *view, np.zeros(6)) for view in views])
        # The camera of all stays where the typical episode sees it from.
        twists -= np.median(twists, axis=0)
        unmoved = [
            _as_unmoved(demo, camera, twist) for demo, twist in zip(chosen, twists, strict=True)
        ]
        camera = _camera_of(unmoved, image_size)
    jacobians = [camera.motion_jacobian(camera.points(_seen(demo)[0])) for demo in chosen]

    def apart(first: int, second: int) -> float:
        return max(
            _root_mean_square(jacobians[i] @ (twists[first] - twists[second]))
            for i in (first, second)
        )

    typical = np.median([apart(i, i + 1) for i in range(len(chosen) - 1)])
    groups: list[list[int]] = []
    for i in range(len(chosen)):
        home = next((g for g in groups if apart(g[0], i) <= margin * typical), None)
        if home is None:
            groups.append([i])
        else:
            home.append(i)
    index = list(seen)
    first = np.median(twists[groups[0]], axis=0)
    return [
        CameraPlacement(
            episodes=tuple(index[i] for i in group),
            motion=motion_of(
                np.median(twists[group], axis=0) - first,
                np.concatenate([camera.points(_seen(chosen[i])[0]) for i in group]),
                camera,
            ),
        )
        for group in groups
    ]


def _camera_of(
    demonstrations: Sequence[ImageDemonstration], image_size: tuple[int, int]
) -> MarkerCamera:
    neurons = RBFCenters.around(demonstrations)
    network = RBFImageJacobian.fit_demonstrations(demonstrations, neurons)
    return MarkerCamera.fit(demonstrations, network.double(), image_size)


def _largest_displacement(watch: CameraWatch, demo: ImageDemonstration, fps: float) -> float:
    watch.clear()
    largest = 0.0
    for frame in demo.visible.nonzero()[:, 0].tolist():
        watch.update(frame / fps, demo.pose[frame], demo.feature[frame].double().numpy())
        largest = max(largest, watch.displacement)
    return largest


def _seen(demo: ImageDemonstration) -> tuple[Pose, Float[np.ndarray, "_frames 2"]]:
    """Poses and pixels of the frames in which the marker was found."""
    pose = Pose(demo.pose.position[demo.visible], demo.pose.orientation[demo.visible])
    return _double(pose), demo.feature[demo.visible].double().numpy()


def _double(pose: Pose) -> Pose:
    return Pose(pose.position.double(), pose.orientation.double())


def _explained(
    errors: Float[np.ndarray, "frames 2"],
    jacobians: Float[np.ndarray, "frames 2 6"],
    already: Float[np.ndarray, "6"] | None = None,
) -> tuple[Float[np.ndarray, "6"], float]:
    """The motion that explains the errors best, and how much of them, rms [px].

    Of a camera that has moved by `already`, all of which is to be plausible.
    """
    size = np.linalg.norm(errors, axis=-1)
    # At least a tenth of a pixel, so that exact images are not all outliers.
    most = max(_OUTLIER * float(np.median(size)), 0.1)
    errors = errors * np.minimum(1.0, most / np.maximum(size, most))[:, None]
    scaled = jacobians * _PLAUSIBLE
    gram = np.einsum("fij,fik->jk", scaled, scaled) + np.eye(6)
    towards = np.einsum("fij,fi->j", scaled, errors)
    if already is not None:
        towards -= already / _PLAUSIBLE
    unit = np.linalg.solve(gram, towards)
    return _PLAUSIBLE * unit, _root_mean_square(scaled @ unit)


def refined_twist(
    camera: MarkerCamera,
    points: Float[np.ndarray, "frames 3"],
    pixels: Float[np.ndarray, "frames 2"],
    twist: Float[np.ndarray, "6"],
    steps: int = _REFINEMENTS,
) -> Float[np.ndarray, "6"]:
    """The motion [rad, m] by Gauss-Newton, also where it is large."""
    for _ in range(steps):
        seen = from_moved(points, twist)
        errors = pixels - camera.project(seen)
        step, _ = _explained(errors, camera.motion_jacobian(seen), twist)
        # In the frame of the camera as moved so far.
        turn = quaternion.exp(torch.from_numpy(np.stack([twist[:3], step[:3]])))
        both = quaternion.log(quaternion.multiply(turn[0], turn[1])).numpy()
        shift = quaternion.rotate(turn[0], torch.from_numpy(step[3:])).numpy()
        twist = np.concatenate([both, twist[3:] + shift])
        # Two frames that contradict each other would lead to where both are behind the camera.
        twist = twist * min(1.0, _FARTHEST / float(np.linalg.norm(twist / _PLAUSIBLE)))
    return twist


def from_moved(
    points: Float[np.ndarray, "*batch 3"], twist: Float[np.ndarray, "6"]
) -> Float[np.ndarray, "*batch 3"]:
    """Points [m] in the frame of a camera that turned and moved (see `MarkerCamera.moved`)."""
    turn = quaternion.exp(torch.from_numpy(twist[:3]))
    return (points - twist[3:]) @ quaternion.to_matrix(turn).numpy()


def _as_unmoved(
    demo: ImageDemonstration, camera: MarkerCamera, twist: Float[np.ndarray, "6"]
) -> ImageDemonstration:
    """What the camera would have seen had it not moved."""
    points = camera.points(_double(demo.pose))
    change = camera.project(from_moved(points, twist)) - camera.project(points)
    return replace(demo, feature=demo.feature.double() - torch.from_numpy(change))


def motion_of(
    twist: Float[np.ndarray, "6"], points: Float[np.ndarray, "frames 3"], camera: MarkerCamera
) -> CameraMotion:
    turn, shift = twist[:3].tolist(), twist[3:].tolist()
    return CameraMotion(
        rotation=(turn[0], turn[1], turn[2]),
        translation=(shift[0], shift[1], shift[2]),
        displacement=_root_mean_square(camera.motion_jacobian(points) @ twist),
    )


def _root_mean_square(pixels: Float[np.ndarray, "frames 2"]) -> float:
    return float(np.sqrt((pixels**2).sum(-1).mean()))
