"""ArUco markers of the 4x4_50 dictionary, as flat plates with a white quiet zone.

Marker frame: origin in the middle, x right, y up, z out of the plate towards whoever reads it.
"""

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8

if TYPE_CHECKING:
    import cv2

MODULES = 6
"""Squares along a marker's edge: 4 of code between two of black border."""
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

        In the order in which detectors report them: top left, top right, bottom right,
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
        pixels: Edge of the picture. A multiple of 8, so that every module is whole pixels.

    Raises:
        ValueError: If `pixels` is not a positive multiple of 8.
    """
    import cv2

    module, rest = divmod(pixels, PLATE_MODULES)
    if module < 1 or rest:
        raise ValueError(
            f"pixels must be a positive multiple of {PLATE_MODULES}, the modules along the "
            f"edge of a plate, but is {pixels}."
        )
    inner = cv2.aruco.generateImageMarker(dictionary(), id, module * MODULES, borderBits=1)
    return np.pad(inner, module * QUIET_MODULES, constant_values=255)
