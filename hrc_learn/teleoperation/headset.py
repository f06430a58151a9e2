"""Prepare the scene for browsers: meshes of bodies, files and data of the headset client."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from contextlib import suppress
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from hrc_learn.geometry import Body, Box, Capsule, read_mesh
from hrc_learn.geometry.shapes import Colour
from hrc_learn.store import cache_home, new_file
from hrc_learn.teleoperation.gate import Content

if TYPE_CHECKING:
    from trimesh import Trimesh as Trimesh
else:
    Trimesh = Any

END_EFFECTOR_PARTS = ("hand", "finger_left", "finger_right")
"""Bodies that move with the end effector, like the last link. Dragging one of them guides the
end effector."""


PEDESTAL = Box(
    name="pedestal",
    centre=(-0.03, 0.0, -0.36),
    half_size=(0.12, 0.12, 0.36),
    colour=(0.30, 0.30, 0.32, 1.0),
)
"""Pedestal of the arm."""

_TRIANGLES = 1500
"""Largest number of triangles per colour of a body. The Panda then has 29,000 triangles rather
than 135,000, and a browser without a graphics processor draws the arm in half the time.
"""
_AGGRESSION = 5
"""Parameter `aggression` of fast-simplification, 0 to 10. With this value and `_TRIANGLES`,
99 % of the Panda's surfaces move by less than 1 mm, and cable sockets by less than 8 mm. With
the default of 7, 99 % move by less than 3 mm.
"""

_OFF = 0.002
"""Largest change of a mesh's bounding box by simplification [m]. A mesh that would change more
stays as it is: some meshes of the UR5e and the Sawyer would lose whole parts."""


CLIENT = Path(__file__).parent / "xr_client"
"""Sources of the client for headsets and phones; the built client is in `built`."""
BUILD = "make xr"
"""Command that builds the client."""


def held_joint(body: Body, joints: int) -> int | Literal["nothing"] | None:
    """Joint that moves a link, counted from 1; None for bodies of the end effector, "nothing"
    for bodies that cannot be held.

    Args:
        body: Body, identified by its name.
        joints: Number of joints of the arm.
    """
    if body.name in (*END_EFFECTOR_PARTS, f"link{joints}"):
        return None
    link = re.fullmatch(r"link([1-9]\d*)", body.name)
    return int(link[1]) if link else "nothing"


def headset_contents() -> dict[str, Content]:
    """Public files of the headset client by path; empty if it has not been built."""
    built = CLIENT / "built"
    if not (built / "client.js").is_file():
        return {}
    files = {
        "/xr": CLIENT / "index.html",
        "/xr/style.css": CLIENT / "style.css",
        "/xr/client.js": built / "client.js",
        "/xr/licences.txt": built / "licences.txt",
    }
    return {path: Content.of(file.name, file.read_bytes()) for path, file in files.items()}


def headset_data(
    bodies: Sequence[Body], boxes: Sequence[Box], joints: int, **more: Any
) -> dict[str, Content]:
    """Scene for the headset client by path, for clients with the secret.

    Args:
        bodies: Moving bodies.
        boxes: Fixed boxes.
        joints: Number of joints of the arm.
        more: Further entries of the description, such as the page's features.
    """
    description = {"bodies": [_held(body, joints) for body in bodies], **more}
    made = {
        "scene.glb": scene_glb(bodies, [*boxes, PEDESTAL]),
        "scene.json": json.dumps(description).encode(),
    }
    return {f"/xr/{name}": Content.of(name, body) for name, body in made.items()}


def scene_glb(bodies: Sequence[Body], boxes: Sequence[Box]) -> bytes:
    """All shapes as one binary glTF file, each in the frame of its body.

    Nodes are named `body<index>_<colour number>`, or `stands_<number>` for fixed boxes.

    Args:
        bodies: Moving bodies; their poses are sent as they change.
        boxes: Fixed boxes, in the base frame.
    """
    import trimesh
    from trimesh.exchange.gltf import export_glb
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    scene = trimesh.Scene()

    def add(name: str, mesh: Trimesh, colour: Colour) -> None:
        material = PBRMaterial(
            baseColorFactor=[round(255 * channel) for channel in colour],
            metallicFactor=0.0,
            roughnessFactor=0.75,
            alphaMode="OPAQUE" if colour[3] >= 1 else "BLEND",
        )
        mesh.visual = TextureVisuals(material=material)
        scene.add_geometry(mesh, node_name=name, geom_name=name)

    for k, body in enumerate(bodies):
        for c, (colour, mesh) in enumerate(body_meshes(body).items()):
            add(f"body{k}_{c}", mesh, colour)
    for colour in dict.fromkeys(box.colour for box in boxes):
        parts = [box_mesh(box) for box in boxes if box.colour == colour]
        add(f"stands_{len(scene.geometry)}", _joined(parts), colour)
    return export_glb(scene, include_normals=True)


def _held(body: Body, joints: int) -> dict[str, Any]:
    """Description of a body for the client: name, joint, and capsules for picking the body."""
    capsules = [[*c.start, *c.end, c.radius] for c in body.capsules]
    # A box is picked by its bounding sphere.
    capsules += [
        [*box.centre, *box.centre, float(np.linalg.norm(box.half_size))] for box in body.boxes
    ]
    return {"name": body.name, "joint": held_joint(body, joints), "capsules": capsules}


def capsule_mesh(capsule: Capsule, segments: int = 20) -> Trimesh:
    """Mesh of a capsule with the given number of segments around and along it."""
    import trimesh

    start, end = np.array(capsule.start), np.array(capsule.end)
    length = float(np.linalg.norm(end - start))
    mesh = trimesh.creation.capsule(
        height=length, radius=capsule.radius, count=(segments, segments)
    )
    if length > 0:
        mesh.apply_transform(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], end - start))
    mesh.apply_translation((start + end) / 2)
    return mesh


def box_mesh(box: Box) -> Trimesh:
    """Mesh of a box along its body's axes; each face has its own vertices, for sharp edges."""
    import trimesh

    mesh = trimesh.creation.box(extents=2 * np.array(box.half_size))
    mesh.unmerge_vertices()
    mesh.apply_translation(box.centre)
    return mesh


def body_meshes(body: Body) -> dict[Colour, Trimesh]:
    """Meshes that show a body, one per colour: its own meshes, simplified, and its named boxes.
    A body without meshes is shown by its capsules and boxes, in the colour of its first shape.
    """
    import trimesh

    if not body.meshes:
        shapes = [*map(capsule_mesh, body.capsules), *map(box_mesh, body.boxes)]
        return {(*body.capsules, *body.boxes)[0].colour: _joined(shapes)}
    parts: dict[Colour, list[Trimesh]] = {}
    for file in body.meshes:
        for part in (part.placed(file) for part in read_mesh(file.path)):
            assert part.colour is not None  # a placed part has a colour
            # Vertices are not merged, so that sharp edges stay sharp.
            mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
            parts.setdefault(part.colour, []).append(mesh)
    for box in body.boxes:
        if box.name:
            parts.setdefault(box.colour, []).append(box_mesh(box))
    return {colour: simplified(_joined(meshes)) for colour, meshes in parts.items()}


def body_shape(body: Body) -> Trimesh:
    """Shape of a body as one mesh, for drawing it in one colour."""
    return simplified(_joined([*body_meshes(body).values()]))


def simplified(mesh: Trimesh) -> Trimesh:
    """Approximate a surface by at most `_TRIANGLES` triangles, which browsers draw quickly.

    A mesh that would lose whole parts is returned unchanged. As the work takes seconds for an
    arm, results are kept in the user's cache. Damaged files there are replaced.
    """
    if len(mesh.faces) <= _TRIANGLES:
        return mesh
    code = Path(__file__).read_bytes() + version("fast-simplification").encode()
    key = sha256(code + mesh.vertices.tobytes() + mesh.faces.tobytes()).hexdigest()
    path = cache_home() / "hrc_learn" / "meshes" / f"{key}.npz"
    with suppress(Exception), np.load(path) as kept:  # checks the checksums in the file
        return type(mesh)(kept["vertices"], kept["faces"], process=False)
    few = _decimated(mesh)
    with suppress(OSError):  # without a cache, everything works, only later
        path.parent.mkdir(parents=True, exist_ok=True)
        with new_file(path) as part:
            np.savez(part, vertices=few.vertices, faces=few.faces)
    return few


def _decimated(mesh: Trimesh) -> Trimesh:
    shape = mesh.copy()
    shape.merge_vertices(merge_norm=True)  # otherwise, edges with two normals would tear
    shape.update_faces(shape.nondegenerate_faces())
    few = shape.simplify_quadric_decimation(face_count=_TRIANGLES, aggression=_AGGRESSION)
    return mesh if np.abs(few.bounds - shape.bounds).max() > _OFF else few


def _joined(meshes: Sequence[Trimesh]) -> Trimesh:
    import trimesh

    mesh = trimesh.util.concatenate(list(meshes))
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh
