"""Shapes of bodies as browsers draw them: triangles, by colour."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from hrc_learn.geometry import Body, Box, Capsule, read_mesh
from hrc_learn.geometry.shapes import Colour

_TRIANGLES = 1500
"""Most triangles for each colour of a body. The Panda then has 29,000 rather than 135,000, and
a browser without a graphics processor draws it in half the time.
"""
_AGGRESSION = 5
"""Aggression of fast-simplification, 0 to 10. At the triangles above, 99 % of the Panda's
surfaces stay within 1 mm, sockets of cables within 8 mm; at 7, its default, within 3 mm.
"""

_OFF = 0.002
"""Farthest that simplifying may move a side of the box around a mesh [m]. Of the UR5e and the
Sawyer it would take away whole parts: such meshes stay as they are."""


class Mesh(NamedTuple):
    """Triangles in the frame of a body."""

    vertices: Float[np.ndarray, "vertices 3"]
    """[m]"""
    faces: Int[np.ndarray, "faces 3"]
    """Corners of each triangle, counter-clockwise as seen from outside."""


def capsule_mesh(capsule: Capsule, segments: int = 20) -> Mesh:
    """A cylinder with round ends.

    Args:
        capsule: Ends and radius.
        segments: Around the axis; half as many from pole to pole.
    """
    start, end = np.array(capsule.start), np.array(capsule.end)
    axis = end - start
    length = float(np.linalg.norm(axis))
    w = axis / length if length > 0 else np.array([0.0, 0.0, 1.0])
    u = np.cross(w, np.eye(3)[np.abs(w).argmin()])
    u /= np.linalg.norm(u)
    v = np.cross(w, u)
    # Rings from pole to pole; the equator is there twice, once at each end of the cylinder.
    quarter = np.linspace(0, np.pi / 2, segments // 4 + 1)
    latitude = np.concatenate([quarter - np.pi / 2, quarter])
    origin = np.where(np.arange(len(latitude))[:, None] < len(quarter), start, end)
    longitude = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    around = np.cos(longitude)[:, None] * u + np.sin(longitude)[:, None] * v
    offset = np.cos(latitude)[:, None, None] * around + np.sin(latitude)[:, None, None] * w
    vertices = origin[:, None] + capsule.radius * offset
    return Mesh(vertices.reshape(-1, 3), _grid_faces(len(latitude), segments))


def _grid_faces(rings: int, segments: int) -> Int[np.ndarray, "faces 3"]:
    """Two triangles for each cell of a grid that closes around its second axis."""
    ring, k = np.meshgrid(np.arange(rings - 1), np.arange(segments), indexing="ij")
    here, right = ring * segments + k, ring * segments + (k + 1) % segments
    above, above_right = here + segments, right + segments
    faces = np.stack([here, right, above_right, here, above_right, above], axis=-1)
    return faces.reshape(-1, 3)


def box_mesh(box: Box) -> Mesh:
    """A box along the axes of its body."""
    corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    # Every side has corners of its own, so that shading keeps the edges sharp.
    vertices = np.concatenate([corner[list(side)] for side in sides])
    first = 4 * np.arange(6)[:, None]
    faces = np.concatenate([first + np.array(half) for half in ((0, 1, 2), (0, 2, 3))])
    return Mesh(np.array(box.centre) + vertices * box.half_size, faces)


def body_meshes(body: Body) -> dict[Colour, Mesh]:
    """All that a body looks like, one mesh for each colour: its own meshes, simplified, and the
    boxes with a name, or else its capsules and boxes in the colour of the first.
    """
    if not body.meshes:
        shapes = [*map(capsule_mesh, body.capsules), *map(box_mesh, body.boxes)]
        return {(*body.capsules, *body.boxes)[0].colour: joined(shapes)}
    parts: dict[Colour, list[Mesh]] = {}
    for file in body.meshes:
        for part in (part.placed(file) for part in read_mesh(file.path)):
            assert part.colour is not None  # a placed part has one
            parts.setdefault(part.colour, []).append(Mesh(part.vertices, part.faces))
    for box in body.boxes:
        if box.name:
            parts.setdefault(box.colour, []).append(box_mesh(box))
    return {colour: simplified(joined(meshes)) for colour, meshes in parts.items()}


def body_shape(body: Body) -> Mesh:
    """Shape of a body as one mesh, for drawing it in one colour."""
    return simplified(joined([*body_meshes(body).values()]))


def simplified(mesh: Mesh) -> Mesh:
    """The same surface, nearly, of as few triangles as a browser draws quickly.

    A mesh that would lose whole parts comes back as it is.
    """
    if len(mesh.faces) <= _TRIANGLES:
        return mesh
    import trimesh

    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    shape.merge_vertices(merge_norm=True)  # or edges with two normals would tear
    shape.update_faces(shape.nondegenerate_faces())
    few = shape.simplify_quadric_decimation(face_count=_TRIANGLES, aggression=_AGGRESSION)
    if np.abs(few.bounds - shape.bounds).max() > _OFF:
        return mesh
    return Mesh(np.asarray(few.vertices), np.asarray(few.faces))


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, first, strict=True)]),
    )
