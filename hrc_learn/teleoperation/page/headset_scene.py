"""The scene as a glTF file, and what of it can be held, for clients that draw it themselves."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hrc_learn.geometry import Body, Box
from hrc_learn.geometry.shapes import Colour
from hrc_learn.teleoperation.gate import Content
from hrc_learn.teleoperation.page.meshes import Mesh, body_meshes, box_mesh, joined
from hrc_learn.teleoperation.page.page_scene import PEDESTAL, held_joint

CLIENT = Path(__file__).parents[1] / "xr_client"
"""Sources of the client for headsets and phones; what is built of them lies in `built`."""
BUILD = "make xr"
"""Builds it."""


def headset_contents(
    bodies: Sequence[Body], boxes: Sequence[Box], **more: Any
) -> dict[str, Content]:
    """Files of the headset client by path; empty if it has not been built.

    Args:
        bodies: Moving bodies.
        boxes: Fixed boxes.
        more: Further entries of the description, such as the page's features.
    """
    built = CLIENT / "built"
    if not (built / "client.js").is_file():
        return {}
    files = {
        "/xr": CLIENT / "index.html",
        "/xr/style.css": CLIENT / "style.css",
        "/xr/client.js": built / "client.js",
        "/xr/licences.txt": built / "licences.txt",
    }
    made = {
        "scene.glb": scene_glb(bodies, [*boxes, PEDESTAL]),
        "scene.json": json.dumps({"bodies": [*map(_held, bodies)], **more}).encode(),
    }
    return {
        **{path: Content.of(file.name, file.read_bytes()) for path, file in files.items()},
        **{f"/xr/{name}": Content.of(name, body) for name, body in made.items()},
    }


def scene_glb(bodies: Sequence[Body], boxes: Sequence[Box]) -> bytes:
    """All shapes as one binary glTF file, each in the frame of its body.

    Nodes are named `body<index>_<colour number>`, or `stands_<number>` for fixed ones.

    Args:
        bodies: Moving bodies; their poses are sent as they change.
        boxes: Fixed boxes, in the base frame.
    """
    import trimesh
    import trimesh.exchange.gltf
    import trimesh.visual.material

    scene = trimesh.Scene()

    def add(name: str, mesh: Mesh, colour: Colour) -> None:
        material = trimesh.visual.material.PBRMaterial(
            baseColorFactor=[round(255 * channel) for channel in colour],
            metallicFactor=0.0,
            roughnessFactor=0.75,
            alphaMode="OPAQUE" if colour[3] >= 1 else "BLEND",
        )
        # Corners are not merged: edges that have corners of their own stay sharp.
        shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        shape.visual = trimesh.visual.TextureVisuals(material=material)
        scene.add_geometry(shape, node_name=name, geom_name=name)

    for k, body in enumerate(bodies):
        for c, (colour, mesh) in enumerate(body_meshes(body).items()):
            add(f"body{k}_{c}", mesh, colour)
    for colour in dict.fromkeys(box.colour for box in boxes):
        parts = [box_mesh(box) for box in boxes if box.colour == colour]
        add(f"stands_{len(scene.geometry)}", joined(parts), colour)
    return trimesh.exchange.gltf.export_glb(scene, include_normals=True)


def _held(body: Body) -> dict[str, Any]:
    """Name, joint and capsules of a body, for picking it."""
    capsules = [[*c.start, *c.end, c.radius] for c in body.capsules]
    # A box is held as the ball around it.
    capsules += [
        [*box.centre, *box.centre, float(np.linalg.norm(box.half_size))] for box in body.boxes
    ]
    return {"name": body.name, "joint": held_joint(body), "capsules": capsules}
