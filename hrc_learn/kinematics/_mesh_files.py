"""Points of mesh files: STL, OBJ and COLLADA. Colours, normals and textures are not read."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float


def mesh_points(path: Path) -> Float[np.ndarray, "points 3"]:
    """Vertices of a mesh in the coordinates of its file, float64, each once.

    Raises:
        ValueError: The file is of another format, or has no vertices.
    """
    read = {".stl": _stl, ".obj": _obj, ".dae": _collada}.get(path.suffix.lower())
    if read is None:
        raise ValueError(f"{path} is no STL, OBJ or COLLADA file, which are the meshes read")
    points = read(path)
    if len(points) == 0:
        raise ValueError(f"the mesh {path} has no vertices")
    return np.unique(points, axis=0)


def _stl(path: Path) -> np.ndarray:
    data = path.read_bytes()
    count = int.from_bytes(data[80:84], "little")
    # A file may begin with the word of the text format and be binary: its length tells.
    if len(data) >= 84 + 50 * count and not (data[:5] == b"solid" and b"facet" in data[:500]):
        kind = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("spare", "<u2")])
        faces = np.frombuffer(data, kind, count, 84)
        return faces["corners"].reshape(-1, 3).astype(np.float64)
    words = [line.split() for line in data.decode("utf-8", "replace").splitlines()]
    return _rows(w[1:4] for w in words if w and w[0] == "vertex")


def _obj(path: Path) -> np.ndarray:
    with path.open(encoding="utf-8", errors="replace") as lines:
        return _rows(line.split()[1:4] for line in lines if line.startswith("v "))


def _rows(words) -> np.ndarray:
    return np.array([[float(word) for word in row] for row in words]).reshape(-1, 3)


def _collada(path: Path) -> np.ndarray:
    """Positions of all geometries that the scene shows [m]; like RViz, whichever axis is up."""
    root = ElementTree.parse(path).getroot()
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]  # without the namespace
    unit = root.find("asset/unit")
    scale = 1.0 if unit is None else float(unit.get("meter", 1))
    geometries = {g.get("id"): _positions(g) for g in root.iter("geometry")}
    found = []

    def visit(node: ElementTree.Element, pose: np.ndarray) -> None:
        for part in node:
            if part.tag == "matrix":
                pose = pose @ _floats(part).reshape(4, 4)
            elif part.tag == "translate":
                move = np.eye(4)
                move[:3, 3] = _floats(part)
                pose = pose @ move
            elif part.tag == "scale":
                pose = pose @ np.diag([*_floats(part), 1.0])
            elif part.tag == "rotate":
                pose = pose @ _about(_floats(part))
            elif part.tag == "instance_geometry":
                points = geometries.get(part.get("url", "").removeprefix("#"))
                if points is not None:
                    found.append(points @ pose[:3, :3].T + pose[:3, 3])
            elif part.tag == "node":
                visit(part, pose)

    for scene in root.iter("visual_scene"):
        visit(scene, np.eye(4))
    return scale * np.concatenate([np.zeros((0, 3)), *found])


def _positions(geometry: ElementTree.Element) -> np.ndarray | None:
    vertices = geometry.find("mesh/vertices/input[@semantic='POSITION']")
    if vertices is None:
        return None
    source = vertices.get("source", "").removeprefix("#")
    numbers = geometry.find(f"mesh/source[@id='{source}']/float_array")
    return None if numbers is None else _floats(numbers).reshape(-1, 3)


def _floats(element: ElementTree.Element) -> np.ndarray:
    return np.array([float(word) for word in (element.text or "").split()])


def _about(axis_and_degrees: np.ndarray) -> np.ndarray:
    x, y, z = axis_and_degrees[:3] / np.linalg.norm(axis_and_degrees[:3])
    angle = np.deg2rad(axis_and_degrees[3])
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    T = np.eye(4)
    T[:3, :3] += np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
    return T
