"""Meshes of the Panda, where the package that ships them is installed (extra `meshes`)."""

import math
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

from .shapes import MeshFile

_FOLDER = "cmeel.prefix/share/example-robot-data/robots/panda_description/meshes/visual"
_TCP = 0.1034  # from the hand's frame along z [m]
_PARTS = {
    **{f"link{i}": {"file": f"link{i}"} for i in range(8)},
    "hand": {"file": "hand"},
    "tool": {"file": "hand", "offset": (0.0, 0.0, -_TCP)},
    "finger_left": {"file": "finger"},
    "finger_right": {"file": "finger", "turn": math.pi},
}


def panda_mesh(body: str) -> MeshFile | None:
    """Mesh of a link, the hand or a finger of the Panda.

    Args:
        body: link0 to link7, hand, finger_left or finger_right; tool is the hand in the frame
            of the tool centre point.

    Returns:
        None for any other body, and where there are no meshes.
    """
    folder = _folder()
    if folder is None or body not in _PARTS:
        return None
    place: dict[str, Any] = dict(_PARTS[body])
    return MeshFile(path=folder / f"{place.pop('file')}.dae", **place)


@cache
def _folder() -> Path | None:
    try:
        folder = Path(str(distribution("example-robot-data").locate_file(_FOLDER)))
    except PackageNotFoundError:
        return None
    return folder if folder.is_dir() else None
