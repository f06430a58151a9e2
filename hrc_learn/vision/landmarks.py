"""Detection of tool and objects without markers, by SIFT features (Lowe 2004).

A tool is a cloud of points fixed to a link of the arm. The detector reports the pixel of one
reference point on the link, computed by perspective-n-point from all matching points. An object
is a set of reference views; the similarity transform from one view to the image gives the
object's pixel and direction. Every finding has a covariance; None means that nothing was found.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, UInt8

from hrc_learn.vision.markers import as_grey

ASIDE = 0.06
"""Largest distance of an object from where it is expected, as a fraction of image width."""
RATIO = 0.8
"""Largest ratio of the distances to the best and to the second best descriptor."""
# Points of a tool closer together than this count as views of the same point [m].
_SAME_POINT = 0.006
# `_REACH`: largest error of a match [px at the image width `_WIDTH`].
# `_WIDTH`: image width for which such lengths are given [px].
_REACH, _WIDTH = 5.0, 1440
# Fewest points that must agree on a tool (`FEWEST_POINTS`) and on an object.
FEWEST_POINTS, _FEWEST_MATCHES = 8, 6
# Largest number of samples drawn from the clearest matches, and then from all matches. With
# these numbers, an image without the tool takes a fifth of a second.
_TRIALS = 300, 1000
# Once a pose is found, it is refined in rounds, one for each element of `_GUIDED`. A feature
# matches a point of the tool if it lies within this multiple of `_REACH` from the pixel that
# the pose predicts, and if their descriptors differ by less than `_SIMILAR`.
_GUIDED, _SIMILAR = (2.0, 1.0, 1.0), 270.0
# Least standard deviation of a feature's position in the image [px].
_LEAST_NOISE = 0.15
# Range of an object's size in the image, relative to its size in the view.
_SCALES = (0.5, 2.0)
# Margin around the last finding that is searched first [px at the image width `_WIDTH`].
_MARGIN = 70

# `_CHANGED`: a pixel counts as changed if its grey level changes by more than this.
# `_GROWN`: width of the square with which areas of changed pixels are dilated [px].
_CHANGED, _GROWN = 14, 9

Grey = UInt8[np.ndarray, "height width"]


@dataclass(frozen=True, kw_only=True)
class Features:
    """Corners and blobs of an image with their descriptors."""

    pixels: Float[np.ndarray, "n 2"]
    """(u, v) [px]."""
    descriptors: UInt8[np.ndarray, "n 128"]

    @classmethod
    def of(
        cls,
        image: UInt8[np.ndarray, "height width 3"] | Grey,
        box: tuple[int, int, int, int] | None = None,
    ) -> Features:
        """Features of an image, or of a part of it.

        Args:
            image: RGB or grey.
            box: Left, top, right, bottom of the part [px]; None: the whole image.
        """
        import cv2

        left, top, right, bottom = box or (0, 0, image.shape[1], image.shape[0])
        part = np.ascontiguousarray(image[top:bottom, left:right])
        # White arms have little contrast, so the threshold is half of SIFT's default.
        found, descriptors = cv2.SIFT_create(0, 3, 0.02).detectAndCompute(as_grey(part), None)  # pyright: ignore[reportAttributeAccessIssue, reportCallIssue, reportArgumentType]
        if descriptors is None:
            return cls(pixels=np.zeros((0, 2)), descriptors=np.zeros((0, 128), np.uint8))
        pixels = np.array([key.pt for key in found]) + np.array([left, top])
        return cls(pixels=pixels, descriptors=descriptors.astype(np.uint8))


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Position of a tool or an object in an image."""

    pixel: Float[np.ndarray, "2"]
    """(u, v) [px]."""
    covariance: Float[np.ndarray, "2 2"]
    """Covariance of the pixel [px^2]."""
    angle: float = np.nan
    """Direction in the image [rad]; NaN: none."""
    scale: float = 1.0
    """Size relative to the first view."""
    points: Float[np.ndarray, "n 2"]
    """Pixels of the features that agree [px]."""

    @property
    def deviation(self) -> float:
        """Largest standard deviation of the pixel [px]."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))


@dataclass(frozen=True, kw_only=True)
class Tool:
    """Points on a link, and the reference point that is reported as the tool's position."""

    points: Float[np.ndarray, "n 3"]
    """Points in the frame of the link [m]."""
    descriptors: UInt8[np.ndarray, "n 128"]
    place: Float[np.ndarray, "3"]
    """Reference point in the frame of the link [m]; its pixel is reported."""
    optics: tuple[float, float, float, float]
    """Focal length [px], principal point (u, v) [px] and radial coefficient of the camera."""

    def find(self, seen: Features, width: int) -> Finding | None:
        """Find the tool among an image's features; None: not found.

        Args:
            seen: Features of the image.
            width: Width of the image [px].
        """
        import cv2

        image, own = self._matches(seen)
        if len(image) < FEWEST_POINTS:
            return None
        f, u, v, k = self.optics
        matrix = np.array([[f, 0, u], [0, f, v], [0, 0, 1]])
        lens = np.array([k, 0.0, 0.0, 0.0])
        points: np.ndarray = self.points[own]
        pixels: np.ndarray = seen.pixels[image]
        reach = _REACH * width / _WIDTH
        search = cv2.UsacParams()
        search.threshold, search.loMethod = reach, cv2.LOCAL_OPTIM_NULL
        # Clear matches first (PROSAC, Chum and Matas 2005), then any matches.
        for search.sampler, search.maxIterations in zip(
            (cv2.SAMPLING_PROSAC, cv2.SAMPLING_UNIFORM), _TRIALS, strict=True
        ):
            good, _, turn, shift, inliers = cv2.solvePnPRansac(
                points, pixels, matrix, lens, params=search
            )
            if good and inliers is not None and len(inliers) >= FEWEST_POINTS:
                break
        else:
            return None
        kept: np.ndarray = np.asarray(inliers).ravel()
        points, pixels = points[kept], pixels[kept]
        for wide in _GUIDED:
            turn, shift = cv2.solvePnPRefineLM(points, pixels, matrix, lens, turn, shift)
            there, _ = cv2.projectPoints(self.points, turn, shift, matrix, lens)
            image, own = self._guided(seen, there[:, 0], wide * reach)
            if len(own) < FEWEST_POINTS:
                return None
            points, pixels = self.points[own], seen.pixels[image]
        turn, shift = cv2.solvePnPRefineLM(points, pixels, matrix, lens, turn, shift)
        there, slope = cv2.projectPoints(points, turn, shift, matrix, lens)
        pixel, by_pose = cv2.projectPoints(self.place[None], turn, shift, matrix, lens)
        covariance = _propagated(slope[:, :6], by_pose[:, :6], there[:, 0] - pixels)
        if not np.isfinite(covariance).all() or shift[2, 0] <= 0:
            return None
        return Finding(pixel=pixel[0, 0], covariance=covariance, points=pixels)

    def _guided(
        self, seen: Features, there: Float[np.ndarray, "n 2"], reach: float
    ) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
        """Indices of features, and of the most similar tool point expected near each of them.

        Args:
            seen: Features of the image.
            there: Expected pixels of the tool's points [px].
            reach: Largest distance from the expected pixel [px].
        """
        apart = np.linalg.norm(seen.pixels[:, None] - there, axis=-1)
        image, own = np.nonzero(apart < reach)
        a, b = seen.descriptors[image].astype(np.float32), self.descriptors[own]
        unlike = np.linalg.norm(a - b, axis=-1)
        order = unlike.argsort()[: (unlike < _SIMILAR).sum()]
        # Each feature and each point counts once, in its most similar pair.
        for side in (image, own):
            order = order[np.sort(np.unique(side[order], return_index=True)[1])]
        return image[order], own[order]

    def _matches(self, seen: Features) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
        """Indices of features and of the tool points that match them, clearest pair first."""
        if min(len(seen.pixels), len(self.points)) < FEWEST_POINTS:
            return np.zeros(0, int), np.zeros(0, int)
        # Other views of the same point do not compete with the best match.
        index, distance = nearest(seen.descriptors, self.descriptors, 6)
        apart = np.linalg.norm(self.points[index] - self.points[index[:, :1]], axis=-1)
        rival = np.where(apart > _SAME_POINT, distance, distance[:, -1:]).min(axis=1)
        back, _ = nearest(self.descriptors, seen.descriptors, 1)
        mutual = back[index[:, 0], 0] == np.arange(len(index))
        clear = np.flatnonzero(mutual & (distance[:, 0] < RATIO * rival))
        clear = clear[np.argsort(distance[clear, 0] / rival[clear])]
        return clear, index[clear, 0]


@dataclass(frozen=True, kw_only=True)
class Object:
    """Views of an object, each with its features around the object's middle."""

    views: tuple[Features, ...]
    """Features of each view [px]. Their frame has its origin at the object's middle and its
    first axis along the object's direction; its scale is the object's size in the first
    view."""

    def find(self, seen: Features, width: int) -> Finding | None:
        """Find the object among an image's features; None: not found."""
        found = [match_view(view, seen, width) for view in self.views]
        return max((f for f in found if f), key=lambda f: len(f.points), default=None)


def match_view(view: Features, seen: Features, width: int) -> Finding | None:
    """Find a view in an image: the pixel of its origin, and the direction of its first axis.

    Return None if it is not found.

    Args:
        view: Features of the view.
        seen: Features of the image.
        width: Width of the image [px].
    """
    import cv2

    if min(len(view.pixels), len(seen.pixels)) < _FEWEST_MATCHES:
        return None
    index, distance = nearest(view.descriptors, seen.descriptors, 2)
    own = np.flatnonzero(distance[:, 0] < RATIO * distance[:, 1])
    if len(own) < _FEWEST_MATCHES:
        return None
    image = index[own, 0]
    a, b = view.pixels[own], seen.pixels[image]
    map, inliers = cv2.estimateAffinePartial2D(
        a, b, method=cv2.RANSAC, ransacReprojThreshold=_REACH * width / _WIDTH
    )
    if map is None:
        return None
    kept = inliers.ravel().astype(bool)
    scale = float(np.linalg.norm(map[:, 0]))
    # A feature that was found several times counts once.
    if len({*image[kept].tolist()}) < _FEWEST_MATCHES or not _SCALES[0] < scale < _SCALES[1]:
        return None
    a, b = a[kept], b[kept]
    # Unknowns are scale and turn (c, s) and shift (u, v) of a similarity.
    turned = np.stack([a, a[:, ::-1] * (-1, 1)], axis=-1)
    design = np.concatenate([turned, np.broadcast_to(np.eye(2), turned.shape)], axis=-1)
    design = design.reshape(-1, 4)
    c, s, u, v = np.linalg.lstsq(design, b.ravel(), rcond=None)[0]
    error = (design @ (c, s, u, v)).reshape(-1, 2) - b
    return Finding(
        pixel=np.array([u, v]),
        covariance=_propagated(design, np.eye(4)[2:], error),
        angle=float(np.arctan2(s, c)),
        scale=scale,
        points=b,
    )


def nearest(
    own: UInt8[np.ndarray, "n 128"], others: UInt8[np.ndarray, "m 128"], count: int
) -> tuple[Int[np.ndarray, "n count"], Float[np.ndarray, "n count"]]:
    """Indices of the nearest other descriptors, and their distances, in ascending order.

    Args:
        own: Descriptors.
        others: Descriptors that are compared with them.
        count: Number of nearest descriptors; if there are fewer, the last one is repeated.
    """
    a, b = own.astype(np.float32), others.astype(np.float32)
    square = (a**2).sum(1)[:, None] + (b**2).sum(1) - 2 * a @ b.T
    few = min(count, len(others))
    index = np.argpartition(square, few - 1, axis=1)[:, :few]
    index = np.take_along_axis(index, np.take_along_axis(square, index, 1).argsort(1), 1)
    distance = np.sqrt(np.take_along_axis(square, index, 1).clip(0, None))
    more = ((0, 0), (0, count - few))
    return np.pad(index, more, mode="edge"), np.pad(distance, more, mode="edge")


def _propagated(
    slope: Float[np.ndarray, "m k"],
    by_unknowns: Float[np.ndarray, "2 k"],
    error: Float[np.ndarray, "n 2"],
) -> Float[np.ndarray, "2 2"]:
    """Covariance of a pixel that depends on unknowns found by least squares [px^2].

    Args:
        slope: Derivative of the fitted pixels with respect to the unknowns.
        by_unknowns: Derivative of the pixel with respect to the unknowns.
        error: Errors of the fitted pixels [px].
    """
    # Findings have at least `_FEWEST_MATCHES` points, so there are degrees of freedom left.
    freedom = error.size - slope.shape[1]
    variance = max((error**2).sum() / freedom, _LEAST_NOISE**2)
    # With columns of equal norm, the inverse is accurate enough.
    size = np.linalg.norm(slope, axis=0) + 1e-12
    inverse = np.linalg.pinv((slope / size).T @ (slope / size))
    scaled = by_unknowns / size
    return variance * scaled @ inverse @ scaled.T


@dataclass(frozen=True, kw_only=True)
class Landmarks:
    """Tool and objects to find without markers in the images of one camera."""

    tool: Tool
    objects: Mapping[str, Object] = field(default_factory=dict)
    """Objects by name."""
    image_size: tuple[int, int]
    """Width and height of the images [px]."""


class LandmarkDetector:
    """Finds landmarks in a stream of images, first near their last position.

    Items not found there are searched for in the whole image.
    """

    def __init__(self, landmarks: Landmarks):
        self.landmarks = landmarks
        self._last: dict[str, Finding] = {}

    def find(
        self, image: UInt8[np.ndarray, "height width 3"], names: Sequence[str]
    ) -> dict[str, Finding]:
        """Findings by name (`tool`, or an object's name), without items that are not found.

        Raises:
            ValueError: The image differs in size from the images of the demonstrations.
        """
        size = (image.shape[1], image.shape[0])
        if size != self.landmarks.image_size:
            raise ValueError(
                f"the camera's images are {size[0]}x{size[1]}, but landmarks were learned from "
                f"{self.landmarks.image_size[0]}x{self.landmarks.image_size[1]}: set the "
                "camera to that size."
            )
        whole: Features | None = None
        found: dict[str, Finding] = {}
        for name in names:
            item = self.landmarks.tool if name == "tool" else self.landmarks.objects[name]
            finding = _refined(item, image, self._last.pop(name, None))
            if finding is None:
                whole = whole or Features.of(image)
                finding = item.find(whole, size[0])
            if finding is not None:
                found[name] = self._last[name] = finding
        return found


def _refined(item: Tool | Object, image: np.ndarray, near: Finding | None) -> Finding | None:
    """Find an item near an earlier finding; None: not found."""
    if near is None:
        return None
    height, width = image.shape[:2]
    margin = _MARGIN * width / _WIDTH
    left, top = np.maximum(near.points.min(axis=0) - margin, 0).astype(int).tolist()
    right, bottom = (near.points.max(axis=0) + margin).astype(int).tolist()
    box = (left, top, min(right, width), min(bottom, height))
    return item.find(Features.of(image, box), width)


def draw_finding(image: UInt8[np.ndarray, "height width 3"], finding: Finding) -> None:
    """Draw features, their outline, the pixel with two standard deviations, and a direction.

    Args:
        image: RGB image, which is changed in place.
        finding: Finding in this image.
    """
    import cv2

    size, green, red = max(1, image.shape[1] // 480), (40, 220, 60), (255, 40, 40)
    points = np.rint(finding.points).astype(np.int32)
    cv2.polylines(image, [cv2.convexHull(points)], True, green, size)
    for u, v in points.tolist():
        cv2.circle(image, (u, v), size, (255, 220, 0), -1)
    u, v = np.rint(finding.pixel).astype(int).tolist()
    cv2.drawMarker(image, (u, v), red, cv2.MARKER_CROSS, 12 * size, size)
    variance, axes = np.linalg.eigh(finding.covariance)
    reach = np.maximum(np.rint(2 * np.sqrt(variance.clip(0))), 2 * size).astype(int).tolist()
    turn = float(np.degrees(np.arctan2(axes[1, 0], axes[0, 0])))
    cv2.ellipse(image, (u, v), (reach[0], reach[1]), turn, 0, 360, red, size)
    if np.isfinite(finding.angle):
        ahead = np.array([np.cos(finding.angle), np.sin(finding.angle)])
        a, b = np.rint(finding.pixel + 40 * size * ahead).astype(int).tolist()
        cv2.arrowedLine(image, (u, v), (a, b), (40, 120, 255), size)


def changed_features(
    image: Grey, usual: Grey, near: Float[np.ndarray, "points 2"] | None = None
) -> Features:
    """Features near pixels that differ from the usual image.

    Args:
        image: Grey image.
        usual: Usual image of the same scene.
        near: Points of a polyline; only features near it count [px]. None: all count.
    """
    import cv2

    different = (cv2.absdiff(image, usual) > _CHANGED).astype(np.uint8)
    # Single pixels are noise of sensor and video.
    opened = cv2.morphologyEx(different, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    mask: np.ndarray = np.asarray(cv2.dilate(opened, np.ones((_GROWN, _GROWN), np.uint8)))
    if near is not None:
        points, width = np.rint(near).astype(np.int32), round(2 * ASIDE * image.shape[1])
        mask &= np.asarray(cv2.polylines(np.zeros_like(mask), [points], False, 1, width))
    if not mask.any():
        return Features(pixels=np.zeros((0, 2)), descriptors=np.zeros((0, 128), np.uint8))
    left, top, width, height = cv2.boundingRect(mask)
    seen = Features.of(image, (left, top, left + width, top + height))
    u, v = np.rint(seen.pixels).astype(int).T
    inside = mask[v.clip(0, mask.shape[0] - 1), u.clip(0, mask.shape[1] - 1)] > 0
    return Features(pixels=seen.pixels[inside], descriptors=seen.descriptors[inside])
