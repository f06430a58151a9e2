"""Shapes that are drawn or avoided, the rigid bodies that carry them, and mesh files.

A body is a trajectory of poses with boxes, capsules or mesh files attached to it. trimesh reads
the files. Only the triangles, their positions in the scene and one plain colour for each
material are used.
"""

from dataclasses import dataclass
from functools import cache
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

Colour = tuple[float, float, float, float]
"""Red, green, blue, opacity, each 0 to 1."""

PLAIN: Colour = (0.86, 0.87, 0.89, 1.0)
"""Colour of a robot link whose description specifies no colour."""

_CREASE = np.deg2rad(40.0)
"""Smallest angle between two faces whose common edge is drawn sharp [rad]."""


@dataclass(frozen=True, kw_only=True)
class Capsule:
    """A cylinder with round ends, in the frame of the body that carries it."""

    start: tuple[float, float, float]
    """Centre of the first round end [m]."""
    end: tuple[float, float, float]
    """Centre of the second round end [m]."""
    radius: float
    """Radius of cylinder and ends [m]."""
    colour: Colour = PLAIN


@dataclass(frozen=True, kw_only=True)
class Box:
    """A box aligned with the axes of the body that carries it, or of the base frame."""

    centre: tuple[float, float, float]
    """Centre [m]."""
    half_size: tuple[float, float, float]
    """Half of each edge length [m]."""
    colour: Colour = (0.75, 0.62, 0.45, 1.0)
    name: str = ""

    def edges(self) -> Float[np.ndarray, "12 2 3"]:
        """End points of the twelve edges [m]."""
        corners = np.array(list(product((-1, 1), repeat=3)))
        ends = [(a, b) for a, b in combinations(corners, 2) if (a != b).sum() == 1]
        return np.array(ends) * self.half_size + self.centre


@dataclass(frozen=True, kw_only=True, eq=False)
class Line:
    """A line or an arrow in the base frame, drawn into a picture."""

    start: Float[np.ndarray, "3"]
    """First end [m]."""
    end: Float[np.ndarray, "3"]
    """Second end, which is the tip of an arrow [m]."""
    colour: Colour
    width: float = 0.006
    """Width of the line [m]."""
    head: bool = False
    """True for an arrow."""


@dataclass(frozen=True, kw_only=True)
class MeshFile:
    """A drawn shape in a file (`read_mesh`), in the frame of the body that carries it."""

    path: Path
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Origin of the file's frame in the frame of the body [m]."""
    orientation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Orientation of the file's frame, a unit quaternion (w, x, y, z)."""
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors on the coordinates in the file, along the axes of the file."""
    colour: Colour | None = None
    """Colour of parts without a colour in the file; None: the default."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Body:
    """A moving rigid body: a link of the arm, a finger, or a carried object."""

    name: str
    position: Float[np.ndarray, "time 3"]
    """Origin in the base frame [m]."""
    orientation: Float[np.ndarray, "time 4"]
    """Unit quaternion (w, x, y, z)."""
    capsules: tuple[Capsule, ...] = ()
    boxes: tuple[Box, ...] = ()
    meshes: tuple[MeshFile, ...] = ()
    """Meshes that are drawn in place of capsules and nameless boxes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MeshPart:
    """Triangles of one colour."""

    vertices: Float[np.ndarray, "vertices 3"]
    """Positions of the vertices [m]."""
    normals: Float[np.ndarray, "vertices 3"]
    """Unit normals; at a sharp edge, each side has its own vertices."""
    faces: Int[np.ndarray, "faces 3"]
    """Corners of each triangle, counter-clockwise as seen from outside."""
    colour: Colour | None = None
    """Colour in the file, None if there is none."""

    def placed(self, mesh: MeshFile) -> "MeshPart":
        """The part in the frame of its body, with a colour."""
        w, *axis = mesh.orientation
        scale, v = np.array(mesh.scale), np.array(axis)

        def turned(vectors: np.ndarray) -> np.ndarray:
            return vectors + 2.0 * np.cross(v, np.cross(v, vectors) + w * vectors)

        normals = turned(self.normals / scale)
        return MeshPart(
            vertices=turned(self.vertices * scale) + mesh.position,
            # A degenerate triangle has no normal.
            normals=normals / np.linalg.norm(normals, axis=-1, keepdims=True).clip(1e-30),
            # A mirrored part would be seen from inside.
            faces=self.faces[:, ::-1] if scale.prod() < 0 else self.faces,
            colour=self.colour or mesh.colour or PLAIN,
        )


@cache
def read_mesh(path: str | Path) -> tuple[MeshPart, ...]:
    """Read the shape in a file; results are cached, so each file is read once.

    Args:
        path: A mesh file of a format that trimesh reads, such as COLLADA, STL, OBJ or PLY.

    Returns:
        Parts of the shape, one for each material, in the frame of the file [m]. COLLADA files
        state their unit; the numbers of other formats are taken as metres. COLLADA's `up_axis`
        is ignored, as in all readers of URDF.

    Raises:
        ValueError: The file is of another format, broken, or holds no triangle.
        ModuleNotFoundError: trimesh is not installed.
    """
    from trimesh.graph import smooth_shade

    parts = []
    for mesh, colour in _meshes(path):
        # Merge vertices within a micrometre, to which text files are typically rounded.
        mesh.merge_vertices(merge_tex=True, merge_norm=True, digits_vertex=6)
        mesh.update_faces(mesh.nondegenerate_faces())
        mesh = smooth_shade(mesh, angle=_CREASE, facet_minarea=None)
        vertices, normals, faces = mesh.vertices, mesh.vertex_normals, mesh.faces
        parts.append(
            MeshPart(
                vertices=np.array(vertices, dtype=np.float64),
                normals=np.array(normals, dtype=np.float64),
                faces=np.array(faces),
                colour=colour,
            )
        )
    return tuple(parts)


def mesh_points(path: str | Path) -> Float[np.ndarray, "points 3"]:
    """Corners of the triangles in a file that `read_mesh` reads [m].

    Raises:
        ValueError: The file is of another format, broken, or holds no triangle.
        ModuleNotFoundError: trimesh is not installed.
    """
    return np.concatenate([mesh.vertices[np.unique(mesh.faces)] for mesh, _ in _meshes(path)])


def _meshes(path: str | Path) -> list[tuple[Any, Colour | None]]:
    """Meshes in a file [m], each placed in the scene of the file, and with its colour."""
    try:
        import collada  # noqa: F401  # needed by trimesh for COLLADA
        import trimesh
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"{path}: meshes are read with {error.name}: pip install 'hrc-learn[meshes]'",
            name=error.name,
        ) from error

    try:
        scene = trimesh.load_scene(path, process=False)
    except Exception as error:  # trimesh raises errors of many types for broken files
        raise ValueError(f"{path} is not a mesh that trimesh reads: {error}") from error
    unit = str(scene.units or "").partition(" * ")[0]
    scale = float(unit) if unit[:1].isdigit() else 1.0
    found = []
    for mesh in scene.dump():
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            found.append((mesh.apply_scale(scale), _colour(mesh.visual)))
    if not found:
        raise ValueError(f"{path} holds no triangle: is it complete?")
    return found


def _colour(visual: Any) -> Colour | None:
    material = getattr(visual, "material", None)
    if material is None:
        return None
    red, green, blue = (material.main_color[:3] / 255).tolist()
    return (red, green, blue, 1.0)
