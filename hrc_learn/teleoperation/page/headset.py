"""Headset client: its files and glTF scene, the scene state sent to it, and tracked hands."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import Body, Box, Pose
from hrc_learn.geometry.shapes import Colour
from hrc_learn.protocols import DrawnRegion
from hrc_learn.teleoperation.gate import Content
from hrc_learn.teleoperation.gate.messages import Grip, Hands, MessageError, TrackedHand
from hrc_learn.teleoperation.page.meshes import Mesh, body_meshes, box_mesh, joined
from hrc_learn.teleoperation.page.page_operator import AddedTurn, HeldGizmo, HeldGizmos
from hrc_learn.teleoperation.page.page_scene import PEDESTAL, held_joint

CLIENT = Path(__file__).parents[1] / "xr_client"
"""Sources of the client for headsets and phones; what is built of them lies in `built`."""
BUILD = "make xr"
"""Builds it."""

_HOLDER = "headset"
_NO_TURN = np.array([1.0, 0.0, 0.0, 0.0])


class HeadsetHands:
    """Turns what two hands hold into held gizmos, by the rules of the mouse.

    A message names all that is held; what an earlier one named and this one does not is let go.
    """

    def __init__(
        self,
        held: HeldGizmos,
        turn: AddedTurn,
        links: Callable[[], Pose | None],
        *,
        guides: bool,
    ):
        """Start with empty hands.

        Args:
            held: Record of held gizmos.
            turn: Rotation that a hand adds to the end effector's orientation.
            links: Frames of the arm as they are now; None before the arm is known.
            guides: True if the end effector can be held.
        """
        self._held, self._turn, self._links, self._guides = held, turn, links, guides
        self._grips: dict[str, Grip] = {}
        self._tracked: Mapping[str, TrackedHand] = {}
        self._noted = False

    @property
    def tracked(self) -> Mapping[str, TrackedHand]:
        """Tracked hands that are visible now, by name."""
        return self._tracked

    def hear(self, hands: Hands) -> None:
        """Take a message over.

        Raises:
            MessageError: It holds a joint that the arm does not have.
        """
        self._tracked = {seen.hand: seen for seen in hands.tracked}
        links = self._links()
        if links is None:
            return
        now = {
            grip.hand: grip for grip in hands.grips if self._guides or grip.joint is not None
        }
        if not self._noted:
            self._grips, self._noted = now, True
        for hand in self._grips.keys() - now.keys():
            self._held.release(_HOLDER, hand)
            self._turn.release((_HOLDER, hand))
        for hand, grip in now.items():
            before = self._grips.get(hand)
            if before is None or (before.joint, before.start) != (grip.joint, grip.start):
                self._take(grip, links)
            else:
                self._held.move(_HOLDER, hand, np.array(grip.pointer))
            if grip.joint is None and grip.orientation is not None:
                self._turn.move((_HOLDER, hand), np.array(grip.orientation))
        self._grips = now

    def forget(self) -> None:
        """Forget the hands when control changes; held gizmos move nothing until they are taken
        again.
        """
        self._noted, self._tracked = False, {}

    def _take(self, grip: Grip, links: Pose) -> None:
        start = torch.tensor(grip.start, dtype=torch.float64)
        if grip.joint is None:
            held_at = start - links[-1].position
            if grip.orientation is not None:
                self._turn.take((_HOLDER, grip.hand), _NO_TURN)
        elif grip.joint < len(links.position):
            held_at = links[grip.joint - 1].inverse().apply(start)
        else:
            raise MessageError(f"the arm has no joint {grip.joint}")
        gizmo = HeldGizmo(
            joint=grip.joint, held_at=held_at.numpy(), pointer=np.array(grip.pointer)
        )
        self._held.take(_HOLDER, grip.hand, gizmo)


def scene_state(
    positions: Float[np.ndarray, "bodies 3"],
    orientations: Float[np.ndarray, "bodies 4"],
    links: Pose,
    arrows: Float[np.ndarray, "arrows 2 3"],
    colour: str,
    followed: DrawnRegion | None,
    drawn: DrawnRegion | None,
    active: bool,
    plan: Float[np.ndarray, "points 3"] | None = None,
) -> dict[str, Any]:
    """Poses and regions of the scene, for a client that renders it itself.

    Args:
        positions: Positions of the bodies [m].
        orientations: Orientations of the bodies (wxyz).
        links: Frames of the arm; the last is the tool's.
        arrows: Arrows from the points held to the pointers [m].
        colour: Colour of the arrows, which shows how far the arm follows.
        followed: Region to which a controller takes the end effector.
        drawn: Region that the person draws.
        active: True if the drawn region attracts the end effector.
        plan: Planned path of the end effector [m]; None: there is none.
    """
    return {
        "bodies": np.concatenate([positions, orientations], axis=1).round(6).tolist(),
        "links": links.position.numpy().round(6).tolist(),
        "tool": links[-1].orientation.numpy().round(6).tolist(),
        "arrows": arrows.round(6).tolist(),
        "colour": colour,
        "followed": None if followed is None else vars(followed),
        "drawn": None if drawn is None else vars(drawn),
        "active": active,
        "plan": [] if plan is None else plan.round(4).tolist(),
    }


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
    bodies: Sequence[Body], boxes: Sequence[Box], **more: Any
) -> dict[str, Content]:
    """Scene for the headset client by path, for clients with the secret.

    Args:
        bodies: Moving bodies.
        boxes: Fixed boxes.
        more: Further entries of the description, such as the page's features.
    """
    made = {
        "scene.glb": scene_glb(bodies, [*boxes, PEDESTAL]),
        "scene.json": json.dumps({"bodies": [*map(_held, bodies)], **more}).encode(),
    }
    return {f"/xr/{name}": Content.of(name, body) for name, body in made.items()}


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
