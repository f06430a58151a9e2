"""ArUco markers of the 4x4_50 dictionary: flat plates with a quiet zone, and their detection.

Marker frame: origin in the middle, x right, y up, z out of the plate towards the viewer.
"""

import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8

if TYPE_CHECKING:
    import cv2

MODULES = 6
"""Squares along a marker's edge: four code squares between two squares of the black border."""
QUIET_MODULES = 1
"""Squares of white on each side, which detection needs."""
PLATE_MODULES = MODULES + 2 * QUIET_MODULES

_UNIT_SQUARE = np.array([[-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, -0.5, 0]])


@dataclass(frozen=True)
class Marker:
    """One printed marker."""

    id: int
    """Number in the 4x4_50 dictionary, 0 to 49."""
    size: float
    """Edge of the black square [m]; the plate with its quiet zone is 8/6 as wide."""

    def __post_init__(self) -> None:
        if not 0 <= self.id < 50:
            raise ValueError(f"id must be 0 to 49 in dictionary 4x4_50, but is {self.id}.")
        if not self.size > 0:
            raise ValueError(f"size must be positive [m], but is {self.size}.")

    @property
    def plate_size(self) -> float:
        """Edge of the plate, quiet zone included [m]."""
        return self.size * PLATE_MODULES / MODULES

    @property
    def corners(self) -> Float[np.ndarray, "4 3"]:
        """Corners of the black square in the marker frame [m].

        They are in the order in which detectors report them: top left, top right, bottom right,
        bottom left of the upright marker.
        """
        return self.size * _UNIT_SQUARE

    @property
    def plate_corners(self) -> Float[np.ndarray, "4 3"]:
        """Corners of the plate in the marker frame [m], in the order of `corners`."""
        return self.plate_size * _UNIT_SQUARE


@cache
def dictionary() -> "cv2.aruco.Dictionary":
    """The 4x4_50 dictionary."""
    import cv2

    return cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)


def marker_texture(id: int, pixels: int) -> UInt8[np.ndarray, "pixels pixels"]:
    """Grey picture of a plate: the marker inside its quiet zone, row 0 at the top (+y).

    Args:
        id: Number in the 4x4_50 dictionary.
        pixels: Edge of the picture [px]: a multiple of 8, so that modules are whole pixels.

    Raises:
        ValueError: If `pixels` is not a positive multiple of 8.
    """
    import cv2

    module, rest = divmod(pixels, PLATE_MODULES)
    if module < 1 or rest:
        text = f"pixels must be a positive multiple of {PLATE_MODULES}, the modules along the"
        raise ValueError(f"{text} edge of a plate, but is {pixels}.")
    inner = cv2.aruco.generateImageMarker(dictionary(), id, module * MODULES, borderBits=1)
    return np.pad(inner, module * QUIET_MODULES, constant_values=255)


_CLOSE_LOOK_EVERY = 5
"""Number of images between full-resolution searches for markers that stay unseen."""

Corners = Float[np.ndarray, "4 2"]
"""Pixels of top left, top right, bottom right, bottom left corner of the upright marker."""


class MarkerDetector:
    """Finds given markers in a stream of images.

    A marker is searched for near its last position, then in the whole image at half resolution,
    and only then at full resolution; corners are always refined at full resolution. This takes
    a fraction of the time of a plain search and is no less accurate. While a marker stays
    unseen, full resolution is tried only once in a few images. If two markers in an image have
    the same id, a warning is given and neither is reported, unless exactly one of them is near
    the last position.
    """

    def __init__(self, ids: Iterable[int]):
        """Set up the search.

        Args:
            ids: Markers to report, of the 4x4_50 dictionary; others are ignored.
        """
        import cv2

        self.ids = frozenset(ids)
        parameters = cv2.aruco.DetectorParameters()
        # A single threshold window of 13 px finds as many markers as the three default windows.
        parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = 13
        # Lines fitted to the contour keep the rough corners within reach of the refinement.
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_CONTOUR
        # The outline of the white plate is a square too. At the default minimum distance, this
        # square hides the marker inside when both lie near the edge of the image.
        parameters.minMarkerDistanceRate = 0.05
        self._aruco = cv2.aruco.ArucoDetector(dictionary(), parameters)
        self._last: dict[int, Corners] = {}
        self._in_vain: dict[int, int] = {}

    def detect(
        self,
        image: UInt8[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w"],
        ids: Iterable[int] | None = None,
    ) -> dict[int, Corners]:
        """Corners of the markers seen in an image, by id.

        Args:
            image: RGB or grey.
            ids: The detector's markers to search for in this image; None: all of them. A
                marker that is out of sight costs a search of the whole image.
        """
        wanted = self.ids if ids is None else self.ids.intersection(ids)
        found: dict[int, Corners] = {}
        for id in wanted.intersection(self._last):
            found |= self._search_near(image, id, self._last.pop(id))
        if missing := wanted.difference(found):
            found |= self._search_everywhere(image, missing)
        self._last |= found
        return {id: corners.copy() for id, corners in found.items()}

    def _search_near(self, image: np.ndarray, id: int, last: Corners) -> dict[int, Corners]:
        # From frame to frame, a marker may move by half its size.
        reach = 0.5 * np.ptp(last, axis=0).max() + 8
        # Images may have become smaller; OpenCV refuses an empty part.
        end = np.array(image.shape[1::-1]) - 1
        low = np.floor(last.min(axis=0) - reach).astype(int).clip(0, end)
        high = np.ceil(last.max(axis=0) + reach).astype(int)
        grey = as_grey(image[low[1] : high[1], low[0] : high[0]])
        rough = self._search(grey, frozenset([id]))
        return {id: _refine(grey, corners) + low for id, corners in rough.items()}

    def _search_everywhere(self, image: np.ndarray, ids: frozenset[int]) -> dict[int, Corners]:
        import cv2

        grey = as_grey(image)
        half = np.asarray(cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
        found: dict[int, Corners] = {}
        for id, corners in self._search(half, ids).items():
            # Pixel k of the image at half resolution covers pixels 2k and 2k + 1 of the image.
            # These corners only show where to search: they may be pixels off.
            found |= self._search_near(grey, id, 2.0 * corners + 0.5)
        missing = ids.difference(found)
        self._in_vain = {id: self._in_vain.get(id, -1) + 1 for id in missing}
        if any(count % _CLOSE_LOOK_EVERY == 0 for count in self._in_vain.values()):
            rough = self._search(grey, missing)
            found |= {id: _refine(grey, corners) for id, corners in rough.items()}
        return found

    def _search(self, grey: np.ndarray, ids: frozenset[int]) -> dict[int, Corners]:
        corners, found, _ = self._aruco.detectMarkers(np.ascontiguousarray(grey))
        seen = [] if found is None else [int(id) for id in found.ravel()]
        for id in ids.intersection(id for id in seen if seen.count(id) > 1):
            warnings.warn(f"marker {id} is in the image twice: neither is used", stacklevel=2)
        return {
            id: square[0].astype(np.float64)
            for id, square in zip(seen, corners, strict=True)
            if id in ids and seen.count(id) == 1
        }


def centre(corners: Float[np.ndarray, "4 2"]) -> Float[np.ndarray, "2"]:
    """Pixel of a marker's middle: the intersection of the marker's diagonals.

    The mean of the corners would be wrong, because perspective shrinks the farther half.
    """
    a, b, c, d = corners
    across, between, ca = d - b, b - a, c - a
    s = (between[0] * across[1] - between[1] * across[0]) / (
        ca[0] * across[1] - ca[1] * across[0]
    )
    return a + s * ca


def angle(corners: Float[np.ndarray, "4 2"]) -> float:
    """Direction of a marker's x axis in the image, from u towards v [rad]."""
    # Sum of the directions of the marker's upper and lower edge.
    u, v = corners[1] - corners[0] + corners[2] - corners[3]
    return float(np.arctan2(v, u))


def _refine(grey: np.ndarray, corners: Corners) -> Corners:
    """Corners moved to the saddle points of the grey levels.

    The search window covers the error of the rough corners. It excludes the next corner, a
    module away, and objects that hide the rim of the plate.
    """
    import cv2

    module = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).min() / MODULES
    half_window = int(np.clip(0.4 * module, 2, 6))
    refined = cv2.cornerSubPix(
        np.ascontiguousarray(grey),
        np.ascontiguousarray(corners, dtype=np.float32).reshape(4, 1, 2),
        (half_window, half_window),
        (-1, -1),
        (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01),
    )
    return refined[:, 0].astype(np.float64)


def as_grey(
    image: UInt8[np.ndarray, "height width 3"] | UInt8[np.ndarray, "height width"],
) -> UInt8[np.ndarray, "height width"]:
    """Grey image of an RGB image."""
    import cv2

    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)) if image.ndim == 3 else image
