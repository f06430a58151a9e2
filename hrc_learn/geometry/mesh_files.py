"""Meshes from files: COLLADA, STL and Wavefront OBJ, as triangles with normals and colours.

Only what describes the shape of a robot's link is read: triangles and polygons, where they
stand in the scene, and one plain colour for each material. Pictures on surfaces are left out.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float, Int

from hrc_learn.geometry.shapes import PLAIN, Colour, MeshFile

_CREASE = np.cos(np.deg2rad(40.0))
"""Cosine of the angle between two faces from which on the edge between them is drawn sharp."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MeshPart:
    """Triangles of one colour."""

    vertices: Float[np.ndarray, "vertices 3"]
    """[m]"""
    normals: Float[np.ndarray, "vertices 3"]
    """Unit normals; where an edge is sharp, each side has vertices of its own."""
    faces: Int[np.ndarray, "faces 3"]
    """Corners of each triangle, counter-clockwise as seen from outside."""
    colour: Colour | None = None
    """None: the file gives none."""

    def placed(self, mesh: MeshFile) -> "MeshPart":
        """The same where a body carries it, in the body's frame and never without a colour."""
        w, *axis = mesh.orientation
        scale, v = np.array(mesh.scale), np.array(axis)

        def turned(vectors: np.ndarray) -> np.ndarray:
            return vectors + 2.0 * np.cross(v, np.cross(v, vectors) + w * vectors)

        normals = turned(self.normals / scale)
        return MeshPart(
            vertices=turned(self.vertices * scale) + mesh.position,
            normals=normals / np.linalg.norm(normals, axis=-1, keepdims=True),
            # A mirrored part would be seen from inside.
            faces=self.faces[:, ::-1] if scale.prod() < 0 else self.faces,
            colour=self.colour or mesh.colour or PLAIN,
        )


@cache
def read_mesh(path: Path) -> tuple[MeshPart, ...]:
    """Read the shape in a file; it is kept, so the file is read once.

    Args:
        path: A .dae (COLLADA), .stl (binary or text) or .obj (Wavefront) file.

    Returns:
        Its parts, one for each material, in the frame and unit that the file is meant in:
        metres. COLLADA says its unit; the others have none and are taken as they are.
        COLLADA's `up_axis` is ignored, as all readers of URDF do.

    Raises:
        ValueError: The file is of another kind, or holds no triangle.
    """
    return tuple(_part(triangles, colour) for triangles, colour in _read(path))


def mesh_points(path: Path) -> Float[np.ndarray, "points 3"]:
    """Corners of the triangles in a file that `read_mesh` reads, each once [m].

    Raises:
        ValueError: The file is of another kind, or holds no triangle.
    """
    corners = [triangles.reshape(-1, 3) for triangles, _ in _read(path)]
    return np.unique(np.concatenate(corners).astype(np.float64), axis=0)


def _read(path: Path) -> "list[tuple[_Triangles, Colour | None]]":
    """Triangles of each colour in a file; at least one."""
    readers = {".dae": _read_collada, ".stl": _read_stl, ".obj": _read_obj}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ValueError(
            f"{path}: cannot read {path.suffix} meshes, only {', '.join(readers)}."
        )
    parts = [part for part in reader(path) if len(part[0])]
    if not parts:
        raise ValueError(f"{path} holds no triangle: is it complete?")
    return parts


type _Triangles = Float[np.ndarray, "faces 3 3"]
"""Corners of each triangle."""


def _part(triangles: _Triangles, colour: Colour | None) -> MeshPart:
    triangles = triangles.astype(np.float64)
    across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    triangles, across = (rows[np.any(across != 0, axis=-1)] for rows in (triangles, across))
    corners = triangles.reshape(-1, 3)
    # Corners at one place have one normal where no sharp edge lies between their faces. A
    # micrometre apart is one place: files in text are rounded there.
    _, place = np.unique(np.round(corners, 6), axis=0, return_inverse=True)
    face = across / np.linalg.norm(across, axis=-1, keepdims=True)
    normals = _smooth(np.repeat(face, 3, axis=0), np.repeat(across, 3, axis=0), place.ravel())
    both = np.concatenate([np.round(corners, 6), np.round(normals, 3)], axis=-1)
    _, first, index = np.unique(both, axis=0, return_index=True, return_inverse=True)
    return MeshPart(
        vertices=corners[first],
        normals=normals[first],
        faces=index.reshape(-1, 3),
        colour=colour,
    )


def _smooth(
    own: Float[np.ndarray, "corners 3"],
    weighted: Float[np.ndarray, "corners 3"],
    place: Int[np.ndarray, " corners"],
) -> Float[np.ndarray, "corners 3"]:
    """Normal of each corner: the mean over the faces around it, by area, up to sharp edges.

    Args:
        own: Unit normal of the corner's own face.
        weighted: The same times the face's area.
        place: Number of the place where the corner is.
    """
    order = np.argsort(place, kind="stable")
    counts = np.bincount(place)
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    # All pairs of corners at one place.
    repeats = counts[place[order]]
    first = np.repeat(order, repeats)
    within = np.arange(len(first)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
    second = order[np.repeat(starts[place[order]], repeats) + within]
    alike = (own[first] * own[second]).sum(-1) > _CREASE
    total = np.zeros_like(own)
    np.add.at(total, first[alike], weighted[second[alike]])
    length = np.linalg.norm(total, axis=-1, keepdims=True)
    return np.where(length > 0, total / np.maximum(length, np.finfo(float).tiny), own)


def _read_stl(path: Path) -> Iterator[tuple[_Triangles, Colour | None]]:
    data = path.read_bytes()
    count = int.from_bytes(data[80:84], "little") if len(data) >= 84 else 0
    if len(data) == 84 + 50 * count:
        record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
        yield np.frombuffer(data, record, count, 84)["corners"], None
    else:
        lines = (line.split() for line in data.decode("utf-8", "replace").splitlines())
        values = [line[1:4] for line in lines if line and line[0] == "vertex"]
        if len(values) % 3:
            raise ValueError(f"{path} ends within a triangle: it is not a complete STL file.")
        yield np.array(values, dtype=np.float64).reshape(-1, 3, 3), None


def _read_obj(path: Path) -> Iterator[tuple[_Triangles, Colour | None]]:
    points: list[list[float]] = []
    faces: dict[str, list[list[int]]] = {}
    colours: dict[str, Colour] = {}
    material = ""
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        word, *rest = line.split() or [""]
        if word == "v":
            points.append([float(value) for value in rest[:3]])
        elif word == "mtllib" and (path.parent / " ".join(rest)).is_file():
            colours |= _obj_colours(path.parent / " ".join(rest))
        elif word == "usemtl":
            material = " ".join(rest)
        elif word == "f":
            # Counted from 1, or backwards from the last point so far.
            corners = [int(corner.split("/")[0]) for corner in rest]
            corners = [k - 1 if k > 0 else len(points) + k for k in corners]
            faces.setdefault(material, []).extend(_fan(corners))
    at = np.array(points, dtype=np.float64).reshape(-1, 3)
    for name, corners in faces.items():
        yield at[np.array(corners)], colours.get(name)


def _fan(corners: list[int]) -> list[list[int]]:
    """Triangles of a convex polygon."""
    return [[corners[0], corners[k], corners[k + 1]] for k in range(1, len(corners) - 1)]


def _obj_colours(path: Path) -> dict[str, Colour]:
    colours: dict[str, Colour] = {}
    name = ""
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        word, *rest = line.split() or [""]
        if word == "newmtl":
            name = " ".join(rest)
        elif word == "Kd":
            red, green, blue = (float(value) for value in rest[:3])
            colours[name] = (red, green, blue, 1.0)
    return colours


def _read_collada(path: Path) -> Iterator[tuple[_Triangles, Colour | None]]:
    root = ElementTree.parse(path).getroot()
    for element in root.iter():  # names without COLLADA's namespace, which has versions
        element.tag = element.tag.rpartition("}")[2]
    unit = root.find("asset/unit")
    scale = 1.0 if unit is None else float(unit.get("meter", 1.0))
    names = {element.get("id", ""): element for element in root.iter() if element.get("id")}
    colours = _collada_colours(root, names)
    scene = root.find("library_visual_scenes/visual_scene")
    frame = np.diag([scale, scale, scale, 1.0])
    for node in scene if scene is not None else ():
        if node.tag == "node":
            yield from _collada_node(node, frame, names, colours)


def _collada_node(
    node: ElementTree.Element,
    parent: Float[np.ndarray, "4 4"],
    names: Mapping[str, ElementTree.Element],
    colours: Mapping[str, Colour],
) -> Iterator[tuple[_Triangles, Colour | None]]:
    frame = parent
    for child in node:
        if child.tag in _TRANSFORMS:
            frame = frame @ _TRANSFORMS[child.tag](_numbers(child))
        elif child.tag == "node":
            yield from _collada_node(child, frame, names, colours)
        elif child.tag == "instance_geometry":
            bound = {
                material.get("symbol", ""): material.get("target", "")[1:]
                for material in child.iter("instance_material")
            }
            for triangles, symbol in _collada_geometry(names[child.get("url", "")[1:]], names):
                placed = triangles @ frame[:3, :3].T + frame[:3, 3]
                # A mirrored part would be seen from inside.
                placed = placed[:, ::-1] if np.linalg.det(frame[:3, :3]) < 0 else placed
                yield placed, colours.get(bound.get(symbol, symbol))


def _numbers(element: ElementTree.Element) -> Float[np.ndarray, " n"]:
    return np.array((element.text or "").split(), dtype=np.float64)


def _translation(values: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    frame = np.eye(4)
    frame[:3, 3] = values
    return frame


def _rotation(values: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4 4"]:
    """Rotation matrix of an axis and an angle in degrees, by Rodrigues' formula."""
    x, y, z = values[:3] / np.linalg.norm(values[:3])
    cross, angle, frame = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), values[3], np.eye(4)
    angle = np.deg2rad(angle)
    frame[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return frame


_TRANSFORMS = {
    "matrix": lambda values: values.reshape(4, 4),
    "translate": _translation,
    "rotate": _rotation,
    "scale": lambda values: np.diag([*values, 1.0]),
}


def _collada_geometry(
    geometry: ElementTree.Element, names: Mapping[str, ElementTree.Element]
) -> Iterator[tuple[_Triangles, str]]:
    """Triangles of each material, with the symbol that stands for it."""
    for kind in ("triangles", "polylist"):
        for group in geometry.iterfind(f"mesh/{kind}"):
            inputs = group.findall("input")
            stride = 1 + max(int(one.get("offset", 0)) for one in inputs)
            vertex = next(one for one in inputs if one.get("semantic") == "VERTEX")
            source = names[vertex.get("source", "")[1:]].find("input[@semantic='POSITION']")
            array = None if source is None else names[source.get("source", "")[1:]]
            numbers = None if array is None else array.find("float_array")
            index = group.find("p")
            if numbers is None or index is None:
                continue
            corners = np.array((index.text or "").split(), dtype=np.int64)
            corners = corners.reshape(-1, stride)[:, int(vertex.get("offset", 0))]
            sizes = group.find("vcount")
            if sizes is not None:
                counts = np.array((sizes.text or "").split(), dtype=np.int64)
                polygons = np.split(corners, np.cumsum(counts)[:-1])
                fans = [_fan(polygon.tolist()) for polygon in polygons]
                corners = np.array([triangle for fan in fans for triangle in fan], dtype=int)
            points = _numbers(numbers).reshape(-1, 3)
            yield points[corners.reshape(-1, 3)], group.get("material", "")


def _collada_colours(
    root: ElementTree.Element, names: Mapping[str, ElementTree.Element]
) -> dict[str, Colour]:
    """Plain colour of each material that has one."""
    colours: dict[str, Colour] = {}
    for material in root.iterfind("library_materials/material"):
        effect = material.find("instance_effect")
        found = None if effect is None else names.get(effect.get("url", "")[1:])
        diffuse = None if found is None else found.find(".//diffuse/color")
        if diffuse is not None:
            red, green, blue = _numbers(diffuse)[:3].tolist()
            colours[material.get("id", "")] = (red, green, blue, 1.0)
    return colours
