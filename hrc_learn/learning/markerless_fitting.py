"""Find the tool and an object in demonstration videos, without markers or calibration.

The pixels of the moving arm differ from the background image. The image features among these
pixels are matched across frames of all demonstrations. The pixels of one feature over time are
a track. A point fixed to a link of the arm moves with the known kinematics of that link, and
one unknown camera sees all points. Therefore a camera fitted to one track (`fit_camera`)
predicts the tracks of all other points of the same link. The camera that explains most tracks
is chosen, and the explained tracks give the points of the tool. The object lies ahead of the
tool when a demonstration ends, at a different position in each demonstration.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from matplotlib.image import imsave
from torch import Tensor

from hrc_learn.demos import Demonstration, DemonstrationSet, DemonstrationSource
from hrc_learn.demos.dataset_views import arm_of_dataset
from hrc_learn.demos.image_features import camera_key
from hrc_learn.demos.images import ImageReader
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import CameraFit, ImageDemonstration, fit_camera
from hrc_learn.jacobian.perspective import (
    FOCAL,
    MARKER,
    SIZE,
    adjust_bundle,
    eye_of,
    marker_pixels,
    rays,
)
from hrc_learn.skills.visual_skill import ANGLE_FEATURE, OBJECT_FEATURE
from hrc_learn.store import new_file
from hrc_learn.vision.landmarks import (
    ASIDE,
    FEWEST_POINTS,
    RATIO,
    Features,
    Finding,
    LandmarkDetector,
    Landmarks,
    Object,
    Tool,
    changed_features,
    draw_finding,
    match_view,
    nearest,
)
from hrc_learn.vision.markers import as_grey

# Approximate numbers of frames, over all demonstrations.
# `_FRAMES`: least number that is searched for tracks, if demonstrations are long enough.
# `_STARTS`: frames whose features start a track. `_USUAL`: fewest frames whose median is the
# background image.
_FRAMES, _STARTS, _USUAL = 72, 10, 31
# `_SHORTEST`: fewest frames in which a track is seen.
# `_STILL`: least median distance of a track's pixels from their median; also the least median
# distance between two tracks to which cameras are fitted [px at an image width of 1440].
# `_TRIED`: largest number of tracks to which cameras are fitted.
# `_ENOUGH`: number of explained tracks at which the search for a camera stops.
# `_AGREES`: error below which a pixel agrees with the camera [px at an image width of 1440].
_SHORTEST, _STILL, _TRIED, _ENOUGH, _AGREES = 10, 20.0, 12, 150, 4.0
# Errors beyond which a pixel counts less, one for each of three successive bundle adjustments
# [px at an image width of 1440].
_CLOSER = (8.0, 4.0, 2.0)
# Largest distance of a tool point from the origin of its link [m].
_NEAR = 0.35
# Least number of frames, over all demonstrations, in which the fitted tool is searched for
# (all frames if there are fewer).
_FOLLOWED = 320
# Largest width of one image in the picture of the findings [px].
_TILE = 720
# `_DEEPEST`: length of the line ahead of the tool on which the object lies when a demonstration
# ends [m]. `_CLEAR`: number of images of each demonstration from which the object is learned;
# in these images, the tool is farthest from the object.
_DEEPEST, _CLEAR = 0.25, 7


@dataclass(frozen=True, kw_only=True)
class MarkerlessFit:
    """Tool and object found in the videos of demonstrations."""

    demos: DemonstrationSet
    """The demonstrations. The pixels found for tool and object replace recorded features."""
    landmarks: Landmarks
    """Tool and object, for detection at run time."""
    camera: Float[Tensor, "13"]
    """Camera that explains the motion of the tool (see `jacobian.perspective`)."""
    seen: float
    """Fraction of the frames searched by `_Search.follow` in which the tool was found."""
    deviation: float
    """Standard deviation of the tool's pixel, median over the frames with the tool [px]."""
    picture: UInt8[np.ndarray, "height width 3"]
    """First and last image that show the tool, for up to three demonstrations; tool and object
    are drawn into them."""

    def figures(self) -> dict[str, float]:
        """Measured values of the fit, by name."""
        return {
            "tool_points": len(self.landmarks.tool.points),
            "tool_seen": self.seen,
            "tool_pixel_std_px": self.deviation,
            "objects_found": sum(OBJECT_FEATURE in demo.extra for demo in self.demos),
        }

    def save_picture(self, path: Path) -> None:
        """Write the picture, as PNG."""
        with new_file(path) as part:
            imsave(part, self.picture, format="png")


class _Link(NamedTuple):
    """A link of the arm to which the tracked points may be fixed."""

    pose: Pose
    """Poses of the link in the base frame, one for each searched frame."""
    axis: tuple[np.ndarray, np.ndarray] | None = None
    """Axis of the last joint, on which `Tool.place` must lie: a point on the axis [m] and the
    direction of the axis, both in the link's frame. None: `Tool.place` may lie anywhere."""


def find_landmarks(source: DemonstrationSource, camera: str | None = None) -> MarkerlessFit:
    """Find the tool and the object in the videos of demonstrations.

    Args:
        source: Demonstrations that end above an object, with video.
        camera: Name of the camera; None: the only one.

    Raises:
        ValueError: The dataset has no video or no poses, nothing in the video moves like the
            arm, or the fitted tool is found in no frame.
    """
    reader = ImageReader(source.folder)
    key = camera_key(reader.cameras, camera)
    demos = _with_poses(source, source.load())
    height, width = reader.size(key)
    search = _Search(reader, key, demos, (width, height))
    poses = _poses(demos, search.picked)
    links = [_Link(poses), *_wrist(source, demos, search.picked)]
    features = search.features()
    tracks = _tracks(features, width)
    best: tuple[int, _Link, CameraFit] | None = None
    for fit in _cameras(tracks, links, (width, height)):
        for link in links:
            count = int(_points(tracks, link.pose, fit.camera, width)[1].sum())
            if best is None or count > best[0]:
                best = (count, link, fit)
        if best is not None and best[0] >= _ENOUGH:
            break
    if best is None or best[0] < FEWEST_POINTS:
        raise ValueError(
            f"{source.source}, {key}: nothing in the video moves as the arm's kinematics say "
            f"({0 if best is None else best[0]} points found, {FEWEST_POINTS} needed). Check "
            "that this camera stands still and sees the gripper, and that joints and images "
            "are synchronised."
        )
    _, link, fit = best
    tool, adjusted = _tool(tracks, link, fit.camera, (width, height))
    landmarks = Landmarks(tool=tool, image_size=(width, height))
    # Convert `tool.place` from the frame of the link to the tool frame. For the wrist link, the
    # place lies on the axis of the last joint, so it is fixed in the tool frame, too.
    place = poses[0].inverse().apply(link.pose[0].apply(torch.from_numpy(tool.place)))
    seen_by = torch.cat([adjusted[: MARKER.start], place])
    found = search.follow(landmarks, seen_by)
    item = search.object(seen_by)
    if item is not None:
        landmarks = replace(landmarks, objects={"object": item[0]})
    objects = [None] * len(demos) if item is None else item[1]
    sure = [f.deviation for row in found for f in row if f is not None]
    return MarkerlessFit(
        demos=_described(demos, found, objects),
        landmarks=landmarks,
        camera=seen_by,
        seen=len(sure) / search.followed,
        deviation=float(np.median(sure)),
        picture=search.picture(found, objects),
    )


class _Search:
    """Search for tool and object in frames of all demonstrations."""

    def __init__(
        self, reader: ImageReader, key: str, demos: DemonstrationSet, size: tuple[int, int]
    ):
        self._reader, self._key, self._demos, self._size = reader, key, demos, size
        each = max(2, -(-_FRAMES // len(demos)))
        self.followed = 0
        self.picked = [
            np.unique(np.linspace(0, len(d) - 1, each).astype(int)).tolist() for d in demos
        ]

    def features(self) -> list[Features]:
        """For each picked frame, the features of the pixels that differ from the background."""
        images = [image for rows in self._pictures(self.picked) for image in rows]
        stride = max(1, len(images) // _USUAL)
        usual = np.median(np.stack(images[::stride]), axis=0).astype(np.uint8)
        return [changed_features(image, usual) for image in images]

    def _pictures(self, rows: Sequence[Sequence[int]]) -> Iterator[list[np.ndarray]]:
        """Yield the grey images of the frames `rows[k]` of each demonstration k."""
        for demo, frames in zip(self._demos, rows, strict=True):
            shown = self._reader.stream(demo.episode, self._key, frames)
            yield [as_grey(image) for _, image in shown]

    def follow(
        self, landmarks: Landmarks, camera: Float[Tensor, "13"]
    ) -> list[list[Finding | None]]:
        """Find the fitted tool in frames of all demonstrations.

        Returns:
            For each demonstration, the tool in each frame. None: the tool was not found, or
            the frame was not searched.
        """
        found: list[list[Finding | None]] = []
        stride = max(1, sum(map(len, self._demos)) // _FOLLOWED)
        for demo in self._demos:
            detector = LandmarkDetector(landmarks)
            row: list[Finding | None] = [None] * len(demo)
            # Count back from the last frame: the visual target is learned there.
            wanted = list(range(len(demo) - 1, -1, -stride))[::-1]
            expected = marker_pixels(camera, _pose_of(demo))[0].numpy()
            most = 4 * _AGREES * self._size[0] / 1440
            for k, image in self._reader.stream(demo.episode, self._key, wanted):
                seen = detector.find(image, ["tool"]).get("tool")
                # A few wrong matches may agree by chance, but then rarely lie where the camera
                # and the kinematics predict the tool.
                if seen is not None and np.linalg.norm(seen.pixel - expected[k]) < most:
                    row[k] = seen
            found.append(row)
            self.followed += len(wanted)
        if not any(map(any, found)):
            raise ValueError(
                f"{self._demos.source}, {self._key}: the tool is found in none of "
                f"{self.followed} frames. Film it from nearer, in focus and with more light."
            )
        return found

    def picture(
        self, found: Sequence[Sequence[Finding | None]], objects: Sequence[Finding | None]
    ) -> UInt8[np.ndarray, "height width 3"]:
        """First and last image that show the tool, for up to three demonstrations (RGB).

        Tool and object are drawn into the images.
        """
        rows, smaller = [], -(-self._size[0] // _TILE)
        for demo, tools, item in list(zip(self._demos, found, objects, strict=True))[:3]:
            seen = [k for k, finding in enumerate(tools) if finding is not None] or [0]
            tiles = []
            for k, shown in self._reader.stream(demo.episode, self._key, [seen[0], seen[-1]]):
                image = np.ascontiguousarray(shown)
                for finding in filter(None, (tools[k], item)):
                    draw_finding(image, finding)
                tiles.append(image[::smaller, ::smaller])
            # If only one image shows the tool, this image is both the first and the last.
            rows.append(np.hstack((tiles * 2)[:2]))
        return np.vstack(rows)

    def object(self, camera: Float[Tensor, "13"]) -> tuple[Object, list[Finding | None]] | None:
        """Find the object near the line ahead of the tool.

        Returns:
            Views of the object, and its finding in each demonstration (None: not found there).
            None: fewer than two demonstrations show the same object.
        """
        below = [_below(demo, camera) for demo in self._demos]
        rows = []
        for demo, line in zip(self._demos, below, strict=True):
            # While the tool is far from the object or outside the image, the arm does not hide
            # the object.
            tool = marker_pixels(camera, _pose_of(demo))[0].numpy()
            away = np.linalg.norm(tool[:, None] - line, axis=-1).min(axis=1)
            rows.append(sorted(np.argsort(away)[-_CLEAR:].tolist()))
        views = [np.median(np.stack(p), axis=0).astype(np.uint8) for p in self._pictures(rows)]
        usual = np.median(np.stack(views), axis=0).astype(np.uint8)
        seen = [changed_features(v, usual, line) for v, line in zip(views, below, strict=True)]
        return _common_object(seen, below, self._size[0])


class _Tracks(NamedTuple):
    """Features, each with its pixels in all searched frames."""

    pixels: Float[np.ndarray, "tracks frames 2"]
    """Pixels (u, v) of each feature [px]; NaN in frames in which the feature is not seen."""
    descriptors: UInt8[np.ndarray, "tracks 128"]


def _tracks(features: Sequence[Features], width: int) -> _Tracks:
    """Match the features of `_STARTS` frames in all frames; keep tracks that move.

    Args:
        features: Features of each searched frame.
        width: Width of the images [px].
    """
    tracks, descriptors = [], []
    starts = np.unique(np.linspace(0, len(features) - 1, _STARTS).astype(int))
    for start in starts:
        own = features[start]
        pixels = np.full((len(own.pixels), len(features), 2), np.nan)
        for k, other in enumerate(features):
            if min(len(own.pixels), len(other.pixels)) < 2:
                continue
            index, distance = nearest(own.descriptors, other.descriptors, 2)
            clear = distance[:, 0] < RATIO * distance[:, 1]
            pixels[clear, k] = other.pixels[index[clear, 0]]
        kept = np.isfinite(pixels[..., 0]).sum(1) >= _SHORTEST
        pixels = pixels[kept]
        apart = np.linalg.norm(pixels - np.nanmedian(pixels, axis=1, keepdims=True), axis=-1)
        moved = np.nanmedian(apart, axis=1) > _STILL * width / 1440
        tracks.append(pixels[moved])
        descriptors.append(own.descriptors[kept][moved])
    return _Tracks(np.concatenate(tracks), np.concatenate(descriptors))


def _cameras(
    tracks: _Tracks, links: Sequence[_Link], image_size: tuple[int, int]
) -> Iterator[CameraFit]:
    """Fit one camera for each pair of a track and a link, as if the link carried the track.

    Tracks seen in most frames come first. At most `_TRIED` tracks are used.
    """
    pixels = tracks.pixels
    chosen: list[np.ndarray] = []
    for k in np.argsort(-np.isfinite(pixels[..., 0]).sum(1)):
        apart = [np.nanmedian(np.linalg.norm(pixels[k] - other, axis=-1)) for other in chosen]
        # Tracks that start in different frames may show the same point.
        if len(chosen) < _TRIED and all(not a < _STILL * image_size[0] / 1440 for a in apart):
            chosen.append(pixels[k])
            for link in links:
                track = torch.from_numpy(pixels[k])
                seen = track.isfinite().all(-1)
                demo = ImageDemonstration(pose=link.pose, feature=track, visible=seen)
                yield fit_camera([demo], image_size)


def _points(
    tracks: _Tracks, pose: Pose, camera: Float[Tensor, "13"], width: int
) -> tuple[Float[np.ndarray, "tracks 3"], Bool[np.ndarray, " tracks"]]:
    """Point of each track in the frame of a link [m]; True if the track moves with the link.

    With p and T the position and rotation matrix of the link, a point m of the link lies at
    p + T m. A camera at e sees the point in direction d, so d x (p + T m - e) = 0. These
    equations of all frames are solved for m by robust least squares.
    """
    position, turn = pose.position.numpy(), quaternion.to_matrix(pose.orientation).numpy()
    pixels = torch.from_numpy(tracks.pixels)
    sight = rays(camera.expand(*pixels.shape[:2], SIZE), pixels).numpy()
    seen = np.isfinite(sight[..., 0])
    sight = np.nan_to_num(sight / np.linalg.norm(sight, axis=-1, keepdims=True))
    lever = eye_of(camera).numpy() - position
    # Matrices of the cross product with each line of sight.
    across = np.cross(sight[..., None, :], np.eye(3)).swapaxes(-1, -2)
    design, right = across @ turn, (across @ lever[..., None])[..., 0]
    scale = float(camera[FOCAL].exp()) / np.maximum(np.linalg.norm(lever, axis=-1), 0.05)
    most = _AGREES * width / 1440
    weight, point = seen.astype(float), np.zeros((len(seen), 3))
    agrees = seen
    for reach in (16, 8, 4, 2, 1, 1, 1, 1):
        weighted = (weight * scale**2)[..., None, None] * design
        gram = np.einsum("tfij,tfik->tjk", weighted, design) + 1e-6 * np.eye(3)
        towards = np.einsum("tfij,tfi->tj", weighted, right)
        point = np.linalg.solve(gram, towards[..., None])[..., 0]
        error = np.einsum("tfij,tj->tfi", design, point) - right
        size = scale * np.linalg.norm(error, axis=-1)
        weight = seen / (1 + (size / (reach * most)) ** 2) ** 2
        agrees = seen & (size < most)
    count = agrees.sum(1)
    good = (count >= _SHORTEST) & (count > 0.5 * seen.sum(1))
    return point, good & (np.linalg.norm(point, axis=1) < _NEAR)


def _tool(
    tracks: _Tracks, link: _Link, camera: Float[Tensor, "13"], image_size: tuple[int, int]
) -> tuple[Tool, Float[Tensor, "13"]]:
    """Tool made of the points that move with a link, and the camera refined with these points.

    Args:
        tracks: Tracks of the video.
        link: Link that carries the tool.
        camera: Camera fitted to one of the tracks.
        image_size: Width and height of the image [px].
    """
    width = image_size[0]
    for reach in _CLOSER:
        points, agrees = _points(tracks, link.pose, camera, width)
        places = torch.from_numpy(points[agrees])
        pixels = torch.from_numpy(tracks.pixels[agrees])
        cameras = torch.cat([camera[: MARKER.start].expand(len(places), -1), places], dim=-1)
        reach_px = reach * width / 1440
        camera = adjust_bundle(cameras, link.pose, pixels, image_size, reach_px)[0]
    points, agrees = _points(tracks, link.pose, camera, width)
    points = points[agrees]
    place = np.median(points, axis=0)
    if link.axis is not None:
        # Use the nearest point on the axis of the last joint, because a motion of this joint
        # does not move the point.
        origin, direction = link.axis
        place = origin + ((place - origin) @ direction) * direction
    f, (u, v, k) = float(camera[FOCAL].exp()), camera[1:4].tolist()
    tool = Tool(
        points=points, descriptors=tracks.descriptors[agrees], place=place, optics=(f, u, v, k)
    )
    return tool, camera


def _with_poses(source: DemonstrationSource, demos: DemonstrationSet) -> DemonstrationSet:
    """Demonstrations with tool poses, recorded in all of them or computed from the joints."""
    if all(d.position is not None and d.orientation is not None for d in demos):
        return demos
    arm = arm_of_dataset(source)

    def posed(demo: Demonstration) -> Demonstration:
        assert demo.joint_position is not None
        tool = arm.arm.forward(arm.positions(demo.joint_position))
        position, orientation = tool.position.numpy(), tool.orientation.numpy()
        return replace(demo, position=position, orientation=orientation)

    return demos.map(posed)


def _poses(demos: DemonstrationSet, picked: Sequence[Sequence[int]]) -> Pose:
    """Poses of the tool in the picked frames of all demonstrations, as one batch (frames,)."""
    parts = [_pose_of(d)[torch.tensor(k)] for d, k in zip(demos, picked, strict=True)]
    return Pose(
        torch.cat([part.position for part in parts]),
        torch.cat([part.orientation for part in parts]),
    )


def _wrist(
    source: DemonstrationSource, demos: DemonstrationSet, picked: Sequence[Sequence[int]]
) -> Iterator[_Link]:
    """Yield the link before the last joint; nothing if arm or joint positions are unknown."""
    joints = [d.joint_position for d in demos]
    rows = [q[k] for q, k in zip(joints, picked, strict=True) if q is not None]
    try:
        arm = arm_of_dataset(source)
    except ValueError:
        return
    if len(rows) < len(joints):
        return
    links = arm.arm.link_poses(arm.positions(np.concatenate(rows)))
    wrist, last = links[:, arm.arm.joints - 2], links[0, arm.arm.joints - 1]
    turn = quaternion.to_matrix(wrist.orientation[0]).mT
    origin = (turn @ (last.position - wrist.position[0])).numpy()
    direction = (turn @ quaternion.to_matrix(last.orientation)[:, 2]).numpy()
    yield _Link(wrist, (origin, direction))


def _pose_of(demo: Demonstration) -> Pose:
    """Poses of the tool in all frames of a demonstration, (frames,)."""
    assert demo.position is not None
    assert demo.orientation is not None
    return Pose(torch.from_numpy(demo.position), torch.from_numpy(demo.orientation))


def _below(demo: Demonstration, camera: Float[Tensor, "13"]) -> Float[np.ndarray, "points 2"]:
    """Pixels of 16 points on the line ahead of the tool when a demonstration ends [px]."""
    end = _pose_of(demo)[-1]
    depth = torch.linspace(0, _DEEPEST, 16, dtype=torch.float64)[:, None]
    points = end.position + depth * quaternion.to_matrix(end.orientation)[:, 2]
    # `marker_pixels` projects a marker that is fixed to the tool. Here, the marker lies at the
    # origin of the tool frame, and the tool is placed at each of the points.
    bare = torch.cat([camera[:10], camera.new_zeros(3)])
    return marker_pixels(bare, Pose(points, end.orientation.expand(len(depth), 4)))[0].numpy()


def _common_object(
    seen: Sequence[Features], lines: Sequence[Float[np.ndarray, "points 2"]], width: int
) -> tuple[Object, list[Finding | None]] | None:
    """Object that most demonstrations show near the line ahead of the tool at their end.

    Args:
        seen: Features of each demonstration that may belong to the object.
        lines: Pixels of the line ahead of the tool at the end of each demonstration [px].
        width: Width of the images [px].

    Returns:
        The object, and its finding in each demonstration (None: not found there). None: fewer
        than two demonstrations show the same object.
    """
    rows: list[list[Finding | None]] = []
    for features, line in zip(seen, lines, strict=True):
        first = replace(features, pixels=features.pixels - line[len(line) // 2])
        found = [match_view(first, other, width) for other in seen]
        # Drop findings far from the line ahead of the tool.
        near = [
            f if f and np.linalg.norm(end - f.pixel, axis=1).min() < ASIDE * width else None
            for f, end in zip(found, lines, strict=True)
        ]
        rows.append(near)
    best = min(rows, key=lambda row: row.count(None))
    if len(best) - best.count(None) < 2:
        return None
    views = []
    for other, finding in zip(seen, best, strict=True):
        if finding is not None:
            c, s = finding.scale * np.cos(finding.angle), finding.scale * np.sin(finding.angle)
            back = np.linalg.inv([[c, -s], [s, c]])
            views.append(replace(other, pixels=(other.pixels - finding.pixel) @ back.T))
    return Object(views=tuple(views)), best


def _described(
    demos: DemonstrationSet,
    tools: Sequence[Sequence[Finding | None]],
    objects: Sequence[Finding | None],
) -> DemonstrationSet:
    """Demonstrations with the findings in the columns that detected markers would fill."""
    result, replaced = [], (OBJECT_FEATURE, ANGLE_FEATURE)
    for demo, found, item in zip(demos, tools, objects, strict=True):
        visible = np.array([f is not None for f in found])
        pixels = np.array([np.zeros(2) if f is None else f.pixel for f in found])
        extra = {key: x for key, x in demo.extra.items() if key not in replaced}
        if item is not None:
            extra[OBJECT_FEATURE] = np.tile((*item.pixel, 1.0), (len(demo), 1))
            extra[ANGLE_FEATURE] = np.tile((np.nan, item.angle), (len(demo), 1))
        result.append(replace(demo, feature=pixels, feature_visible=visible, extra=extra))
    return DemonstrationSet(
        result, notes=demos.notes, source=demos.source, joint_unit=demos.joint_unit
    )
