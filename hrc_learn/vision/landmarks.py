"""Tool and objects found in images without markers, by features of reference views (Lowe 2004).

A tool is a cloud of points fixed to a link of the arm. Its pixel is that of one place on the
link, by perspective-n-point from all points that match. An object is a set of views; a match
with one of them, as a similarity, gives its pixel and its direction. Every finding has a
covariance, and None means that the image does not tell.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from hrc_learn.store import new_file, read_json, write_json

RATIO = 0.8
"""Largest ratio of the distances to the best and to the second best descriptor."""
# Points of a tool closer than this are views of one point [m].
_SAME_POINT = 0.006
# Largest error of a match [px] in an image of 1440x1080, in proportion for others.
_REACH, _WIDTH = 5.0, 1440
# Fewest points that agree on a tool, and on an object.
FEWEST_POINTS, _FEWEST_MATCHES = 8, 6
# Least standard deviation of a feature's place [px].
_LEAST_NOISE = 0.15
# Range of an object's size relative to its view.
_SCALES = (0.5, 2.0)
# Margin about the last finding within which the next is looked for first [px of `_WIDTH`].
_MARGIN = 70

Grey = UInt8[np.ndarray, "height width"]


@dataclass(frozen=True, kw_only=True)
class Features:
    """Corners and blobs of an image with their descriptors."""

    pixels: Float[np.ndarray, "n 2"]
    """(u, v) [px]."""
    descriptors: UInt8[np.ndarray, "n 128"]

    def chosen(self, which: Bool[np.ndarray, " n"] | Int[np.ndarray, " m"]) -> Features:
        """Some of them."""
        return Features(pixels=self.pixels[which], descriptors=self.descriptors[which])

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
        left, top, right, bottom = box or (0, 0, image.shape[1], image.shape[0])
        part = np.ascontiguousarray(image[top:bottom, left:right])
        grey = np.asarray(cv2.cvtColor(part, cv2.COLOR_RGB2GRAY)) if part.ndim == 3 else part
        # White arms have little contrast: half of what SIFT asks for by default.
        found, descriptors = cv2.SIFT_create(0, 3, 0.02).detectAndCompute(grey, None)  # pyright: ignore[reportAttributeAccessIssue, reportCallIssue, reportArgumentType]
        if descriptors is None:
            return cls(pixels=np.zeros((0, 2)), descriptors=np.zeros((0, 128), np.uint8))
        pixels = np.array([key.pt for key in found]) + (left, top)
        return cls(pixels=pixels, descriptors=descriptors.astype(np.uint8))


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Place of something in an image."""

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
    """Points on a link, and the place whose pixel stands for the tool."""

    points: Float[np.ndarray, "n 3"]
    """Points in the frame of the link [m]."""
    descriptors: UInt8[np.ndarray, "n 128"]
    place: Float[np.ndarray, "3"]
    """Reported place in the frame of the link [m]."""
    optics: tuple[float, float, float, float]
    """Focal length [px], principal point (u, v) [px] and radial coefficient of the camera."""

    def find(self, seen: Features, width: int) -> Finding | None:
        """Pixel of the place among an image's features; None: not found.

        Args:
            seen: Features of the image.
            width: Width of the image [px].
        """
        image, own = self._matches(seen)
        if len(image) < FEWEST_POINTS:
            return None
        f, u, v, k = self.optics
        matrix = np.array([[f, 0, u], [0, f, v], [0, 0, 1]])
        lens = np.array([k, 0.0, 0.0, 0.0])
        points, pixels, reach = self.points[own], seen.pixels[image], _REACH * width / _WIDTH
        good, turn, shift, inliers = cv2.solvePnPRansac(
            points,
            pixels,
            matrix,
            lens,
            iterationsCount=300,
            reprojectionError=reach,
            flags=cv2.SOLVEPNP_AP3P,
        )
        if not good or inliers is None or len(inliers) < FEWEST_POINTS:
            return None
        kept = inliers.ravel()
        for _ in range(3):
            turn, shift = cv2.solvePnPRefineLM(
                points[kept], pixels[kept], matrix, lens, turn, shift
            )
            there, _ = cv2.projectPoints(points, turn, shift, matrix, lens)
            kept = np.flatnonzero(np.linalg.norm(there[:, 0] - pixels, axis=1) < reach)
            if len(kept) < FEWEST_POINTS:
                return None
        there, slope = cv2.projectPoints(points[kept], turn, shift, matrix, lens)
        pixel, by_pose = cv2.projectPoints(self.place[None], turn, shift, matrix, lens)
        error = there[:, 0] - pixels[kept]
        covariance = _propagated(slope[:, :6], by_pose[:, :6], error)
        if not np.isfinite(covariance).all() or shift[2, 0] <= 0:
            return None
        return Finding(pixel=pixel[0, 0], covariance=covariance, points=pixels[kept])

    def _matches(self, seen: Features) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
        """Indices of features, and of the points that they match better than any other."""
        if len(seen.pixels) < FEWEST_POINTS:
            return np.zeros(0, int), np.zeros(0, int)
        # Other views of the same point are no rivals of the best.
        index, distance = nearest(seen.descriptors, self.descriptors, 6)
        apart = np.linalg.norm(self.points[index] - self.points[index[:, :1]], axis=-1)
        rival = np.where(apart > _SAME_POINT, distance, distance[:, -1:]).min(axis=1)
        clear = distance[:, 0] < RATIO * rival
        return np.flatnonzero(clear), index[clear, 0]


@dataclass(frozen=True, kw_only=True)
class Object:
    """Views of an object, each with its features about the object's middle."""

    views: tuple[Features, ...]
    """Features relative to the middle, in its direction, at the size of the first view [px]."""

    def find(self, seen: Features, width: int) -> Finding | None:
        """Pixel and direction among an image's features; None: not found."""
        found = [match_view(view, seen, width) for view in self.views]
        best = max((f for f in found if f), key=lambda f: len(f.points), default=None)
        return best


def match_view(view: Features, seen: Features, width: int) -> Finding | None:
    """Place of a view's origin in an image, and direction of its first axis; None: not found.

    Args:
        view: Features of the view.
        seen: Features of the image.
        width: Width of the image [px].
    """
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
    # One feature found several times is one match.
    if len({*image[kept].tolist()}) < _FEWEST_MATCHES or not _SCALES[0] < scale < _SCALES[1]:
        return None
    a, b = a[kept], b[kept]
    n, zero, one = len(a), np.zeros(len(a)), np.ones(len(a))
    design = np.stack(
        [
            np.column_stack([a[:, 0], -a[:, 1], one, zero]),
            np.column_stack([a[:, 1], a[:, 0], zero, one]),
        ],
        axis=1,
    ).reshape(2 * n, 4)
    c, s, u, v = np.linalg.lstsq(design, b.ravel(), rcond=None)[0]
    error = (design @ (c, s, u, v)).reshape(n, 2) - b
    by_map = np.array([[0.0, 0, 1, 0], [0, 0, 0, 1]])
    return Finding(
        pixel=np.array([u, v]),
        covariance=_propagated(design, by_map, error),
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
        count: Number of the nearest; with fewer others, the last one is repeated.
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
    """Covariance of a pixel that depends on unknowns found by least squares."""
    freedom = max(error.size - slope.shape[1], 1)
    variance = max((error**2).sum() / freedom, _LEAST_NOISE**2)
    # Columns of one size make the inverse exact enough.
    size = np.linalg.norm(slope, axis=0) + 1e-12
    inverse = np.linalg.pinv((slope / size).T @ (slope / size))
    scaled = by_unknowns / size
    return variance * scaled @ inverse @ scaled.T


@dataclass(frozen=True)
class _LandmarksFile:
    version: Literal[1]
    image_size: tuple[int, int]
    place: tuple[float, float, float]
    optics: tuple[float, float, float, float]
    objects: dict[str, int]


@dataclass(frozen=True, kw_only=True)
class Landmarks:
    """Everything that is found without markers in the images of one camera."""

    tool: Tool
    objects: Mapping[str, Object] = field(default_factory=dict)
    """Objects by name."""
    image_size: tuple[int, int]
    """Width and height of the images [px]."""

    def save(self, folder: Path) -> None:
        """Write `landmarks.json` and `landmarks.safetensors`."""
        from safetensors.numpy import save_file

        folder.mkdir(parents=True, exist_ok=True)
        arrays = {"tool.points": self.tool.points, "tool.descriptors": self.tool.descriptors}
        for name, item in self.objects.items():
            for k, view in enumerate(item.views):
                arrays[f"{name}.{k}.pixels"] = view.pixels
                arrays[f"{name}.{k}.descriptors"] = view.descriptors
        with new_file(folder / "landmarks.safetensors") as part:
            save_file({key: np.ascontiguousarray(a) for key, a in arrays.items()}, part)
        x, y, z = self.tool.place.tolist()
        content = _LandmarksFile(
            version=1,
            image_size=self.image_size,
            place=(x, y, z),
            optics=self.tool.optics,
            objects={name: len(item.views) for name, item in self.objects.items()},
        )
        write_json(folder / "landmarks.json", content)

    @classmethod
    def load(cls, folder: Path) -> Landmarks:
        """Read saved landmarks.

        Raises:
            FileNotFoundError: There are none: the model was fitted to markers.
            ValueError: A file is damaged or has an unknown version.
        """
        from safetensors.numpy import load_file

        content = read_json(folder / "landmarks.json", _LandmarksFile, "fit it again")
        arrays = load_file(folder / "landmarks.safetensors")

        def view(key: str) -> Features:
            pixels, descriptors = arrays[f"{key}.pixels"], arrays[f"{key}.descriptors"]
            return Features(pixels=pixels, descriptors=descriptors)

        tool = Tool(
            points=arrays["tool.points"],
            descriptors=arrays["tool.descriptors"],
            place=np.array(content.place),
            optics=content.optics,
        )
        objects = {
            name: Object(views=tuple(view(f"{name}.{k}") for k in range(count)))
            for name, count in content.objects.items()
        }
        return cls(tool=tool, objects=objects, image_size=content.image_size)


class LandmarkDetector:
    """Finds landmarks in a stream of images, first about the place of the last finding."""

    def __init__(self, landmarks: Landmarks):
        self.landmarks = landmarks
        self._last: dict[str, Finding] = {}

    def find(
        self, image: UInt8[np.ndarray, "height width 3"], names: Sequence[str]
    ) -> dict[str, Finding]:
        """Findings by name, `tool` or that of an object; what is not found is left out.

        Raises:
            ValueError: The image has another size than those that were learned from.
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
            item = self._item(name)
            last, finding = self._last.pop(name, None), None
            if last is not None:
                finding = item.find(Features.of(image, _about(last.points, size)), size[0])
            if finding is None:
                whole = whole or Features.of(image)
                finding = item.find(whole, size[0])
            if finding is not None:
                found[name] = self._last[name] = finding
        return found

    def _item(self, name: str) -> Tool | Object:
        if name == "tool":
            return self.landmarks.tool
        if name not in self.landmarks.objects:
            known = ", ".join(self.landmarks.objects) or "none"
            raise ValueError(f"no object {name!r} was learned; there are {known}.")
        return self.landmarks.objects[name]


def _about(
    points: Float[np.ndarray, "n 2"], size: tuple[int, int]
) -> tuple[int, int, int, int]:
    """Part of an image about points (left, top, right, bottom) [px]."""
    margin = _MARGIN * size[0] / _WIDTH
    left, top = np.maximum(points.min(axis=0) - margin, 0).astype(int).tolist()
    right, bottom = np.minimum(points.max(axis=0) + margin, size).astype(int).tolist()
    return left, top, right, bottom
