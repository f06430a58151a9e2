"""The page's 3D scene: the arm, its virtual twin and the furniture as meshes, and the mouse on
them: links, knobs and the end effector's gizmo.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.geometry import Body, Box, Pose
from hrc_learn.geometry.shapes import Colour
from hrc_learn.protocols import DrawnRegion
from hrc_learn.teleoperation.headset import (
    END_EFFECTOR_PARTS,
    PEDESTAL,
    body_meshes,
    body_shape,
    held_joint,
)
from hrc_learn.teleoperation.page_operator import AddedTurn, HeldGizmo, HeldGizmos
from hrc_learn.viz.palette import PERSON, SKY, TARGET, rgba

# viser is imported when a page is opened, and not before.
if TYPE_CHECKING:
    from viser import ClientHandle as ClientHandle
    from viser import FrameHandle as FrameHandle
    from viser import IcosphereHandle as IcosphereHandle
    from viser import MeshHandle as MeshHandle
    from viser import SceneClickEvent as SceneClickEvent
    from viser import SceneNodeDragEvent as SceneNodeDragEvent
    from viser import SceneRectSelectEvent as SceneRectSelectEvent
    from viser import ViserServer as ViserServer

    Holdable = MeshHandle | IcosphereHandle
else:
    # What checks annotations while the program runs must find something.
    ClientHandle = FrameHandle = IcosphereHandle = MeshHandle = Holdable = ViserServer = Any
    SceneClickEvent = SceneNodeDragEvent = SceneRectSelectEvent = Any


def in_loop[Event](callback: Callable[[Event], object]) -> Callable[[Event], Any]:
    """A callback that viser calls in its event loop, not in a thread of its pool: its handles
    may be changed in that loop only.
    """

    async def called(event: Event) -> None:
        callback(event)

    return called


def box_edges(half_size: tuple[float, float, float]) -> Float[np.ndarray, "12 2 3"]:
    """Both ends of each edge of a box about the origin [m]."""
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    # An edge goes up along one axis, from -1 to 1.
    pairs = [(a, b) for a in corners for b in corners if sorted(b - a) == [0, 0, 2]]
    return np.array(pairs) * np.array(half_size)


_KNOBS = (2, 4, 6)
"""Joints marked by a knob: shoulder, elbow, wrist. Between them the links are held."""
_PERSON = rgba(PERSON)[:3]


_TWIN: Colour = (rgba(SKY)[0] / 255, rgba(SKY)[1] / 255, rgba(SKY)[2] / 255, 0.45)
"""Opacity of the virtual twin."""


class _DrawnBody(NamedTuple):
    """A body on the page."""

    frame: FrameHandle
    meshes: Sequence[MeshHandle]


class PageScene:
    """Draws bodies where they are, once as the arm itself and once as its twin."""

    def __init__(
        self,
        server: ViserServer,
        bodies: Sequence[Body],
        boxes: Sequence[Box],
        twin: tuple[float, float, float],
    ):
        """Draw everything once.

        Args:
            server: Server of the page.
            bodies: Moving bodies with their shapes.
            boxes: Fixed boxes.
            twin: Position of the virtual twin relative to the arm [m].
        """
        self._scene = server.scene
        self.twin = np.array(twin)
        self._scene.add_frame("/twin", position=twin, show_axes=False)
        self._bodies = tuple(bodies)
        self._own = [self._draw("", body) for body in bodies]
        # Objects that are carried have no twin: what matters is what can be held.
        self._copies = [
            self._draw("/twin", body)
            if body.name.startswith("link") or body.name in END_EFFECTOR_PARTS
            else None
            for body in bodies
        ]
        self._knobs = {joint: self._draw_knob("", joint) for joint in _KNOBS}
        self._twin_knobs = {joint: self._draw_knob("/twin", joint) for joint in _KNOBS}
        for box in boxes:
            self._draw_box(box)
        self._surroundings(server)
        self._arrows = None
        self._knob_colours = dict.fromkeys(_KNOBS, PERSON)
        self._region_shown: DrawnRegion | None = None
        self._region = self._scene.add_line_segments(
            "/active_region",
            np.zeros((12, 2, 3)),
            rgba(TARGET)[:3],
            thickness=0.003,
            visible=False,
        )

    def holdables(self) -> Iterator[tuple[Holdable, int | None, np.ndarray]]:
        """All that can be held: node, joint (None: end effector), offset from the arm [m]."""
        here = np.zeros(3)
        for body, own, copy in zip(self._bodies, self._own, self._copies, strict=True):
            joint = held_joint(body)
            if joint != "nothing":
                yield from ((mesh, joint, here) for mesh in own.meshes)
                if copy is not None:
                    yield from ((mesh, joint, self.twin) for mesh in copy.meshes)
        for joint in _KNOBS:
            yield self._knobs[joint], joint, here
            yield self._twin_knobs[joint], joint, self.twin

    def move(
        self,
        positions: Float[np.ndarray, "bodies 3"],
        orientations: Float[np.ndarray, "bodies 4"],
        joints: Float[np.ndarray, "links 3"],
    ) -> None:
        """Put everything where it is.

        Args:
            positions: Positions of the bodies [m].
            orientations: Orientations of the bodies (wxyz).
            joints: Origins of the arm's frames, for the knobs [m].
        """
        nodes = zip(self._own, self._copies, positions, orientations, strict=True)
        for own, copy, position, orientation in nodes:
            for node in (own, copy):
                if node is not None:
                    node.frame.position, node.frame.wxyz = position, orientation
        for knobs in (self._knobs, self._twin_knobs):
            for joint, knob in knobs.items():
                knob.position = joints[joint - 1]

    def show_twin(self, visible: bool) -> None:
        """Show or hide the twin."""
        for copy in self._copies:
            if copy is not None:
                copy.frame.visible = visible
        for knob in self._twin_knobs.values():
            knob.visible = visible

    def show_region(self, region: DrawnRegion | None) -> None:
        """Show the region to which a controller takes the end effector; None: there is none."""
        if region == self._region_shown:
            return
        self._region_shown = region
        self._region.visible = region is not None
        if region is not None:
            self._region.points = box_edges(region.half_size) + np.array(region.centre)

    def point(
        self,
        arrows: Float[np.ndarray, "arrows 2 3"],
        colour: str = PERSON,
        held: Collection[int | None] = (),
    ) -> None:
        """Show where from and where to the arm is pulled, and how far it follows.

        Args:
            arrows: Arrows from the points held to the pointers, in the base frame [m].
            colour: Colour of the arrows and of the knobs held.
            held: Joints that are held, counted from 1; None: the end effector.
        """
        for joint, before in self._knob_colours.items():
            now = colour if joint in held else PERSON
            if now != before:
                self._knob_colours[joint] = now
                for knobs in (self._knobs, self._twin_knobs):
                    knobs[joint].color = rgba(now)[:3]
        if self._arrows is not None and not len(arrows):
            self._arrows.remove()
            self._arrows = None
        elif self._arrows is not None:  # to draw them anew would cost the browser more
            self._arrows.points = arrows.astype(np.float32)
            self._arrows.colors = np.array(rgba(colour)[:3], np.uint8)
        elif len(arrows):
            self._arrows = self._scene.add_arrows(
                "/pull",
                arrows,
                rgba(colour)[:3],
                shaft_radius=0.008,
                head_radius=0.022,
                head_length=0.05,
            )

    def _draw(self, parent: str, body: Body) -> _DrawnBody:
        path = f"{parent}/arm/{body.name}"
        frame = self._scene.add_frame(
            path, position=body.position[0], wxyz=body.orientation[0], show_axes=False
        )
        shapes = {_TWIN: body_shape(body)} if parent else body_meshes(body)
        meshes = [
            self._scene.add_mesh_simple(
                f"{path}/{k}",
                mesh.vertices,
                mesh.faces,
                color=(round(255 * red), round(255 * green), round(255 * blue)),
                opacity=opacity if opacity < 1 else None,
                flat_shading=False,
                cast_shadow=not parent,
            )
            for k, ((red, green, blue, opacity), mesh) in enumerate(shapes.items())
        ]
        return _DrawnBody(frame, meshes)

    def _draw_knob(self, parent: str, joint: int) -> IcosphereHandle:
        return self._scene.add_icosphere(
            f"{parent}/knobs/joint{joint}",
            radius=0.078,
            subdivisions=2,
            color=_PERSON,
            opacity=0.9,
            cast_shadow=False,
        )

    def _draw_box(self, box: Box) -> None:
        r, g, b, opacity = box.colour
        self._scene.add_box(
            f"/furniture/{box.name}",
            color=(round(255 * r), round(255 * g), round(255 * b)),
            dimensions=2 * np.array(box.half_size),
            position=box.centre,
            opacity=opacity if opacity < 1 else None,
        )

    def _surroundings(self, server: ViserServer) -> None:
        self._scene.world_axes.visible = False
        # Shadows cost a machine without a GPU half its frames, an environment map 40 %.
        self._scene.configure_default_lights(cast_shadow=False)
        self._scene.configure_environment_map(None)
        self._scene.add_light_hemisphere(
            "/sky",
            sky_color=(255, 255, 255),
            ground_color=(120, 115, 110),
            intensity=1.6,
            position=(0.0, 0.0, 1.0),  # light comes from there
        )
        self._scene.add_grid(
            "/floor", width=6.0, height=6.0, cell_size=0.25, position=(0.0, 0.5, -0.72)
        )
        self._draw_box(PEDESTAL)
        server.initial_camera.position = _CAMERA
        server.initial_camera.look_at = _LOOK_AT
        server.initial_camera.fov = 0.9
        server.on_client_connect(_step_back)


_CAMERA, _LOOK_AT = (2.65, 1.05, 1.15), (0.1, 0.47, 0.12)
_ASPECT = 1.2  # of a view at which cabinet and twin are both in it


async def _step_back(client: ClientHandle) -> None:
    """Let a camera stand back whose view is narrow, as a phone's is: what is seen stays."""
    aspect = client.camera.aspect
    if aspect < _ASPECT:
        look_at = np.array(_LOOK_AT)
        # Its position takes along what it looks at.
        client.camera.position = look_at + _ASPECT / aspect * (np.array(_CAMERA) - look_at)
        client.camera.look_at = _LOOK_AT


_BASE_AXES = (1.0, 0.0, 0.0, 0.0)  # unit quaternion (wxyz)


class Gizmos:
    """Lets people hold links, knobs and the end effector's gizmo with the mouse.

    Callbacks are coroutines: the browser's messages then come in their order, and in viser's
    event loop.
    """

    def __init__(
        self,
        server: ViserServer,
        scene: PageScene,
        held_gizmos: HeldGizmos,
        links: Callable[[], Pose | None],
        turn: AddedTurn,
        *,
        guides: bool = True,
        turns: bool = False,
    ):
        """Connect the gizmos to the scene.

        Args:
            server: Server of the page.
            scene: Scene with the bodies that can be held.
            held_gizmos: Record of held gizmos.
            links: Present frames of the arm (see `SerialChain.link_poses`); None before the arm
                is known.
            turn: Rotation added by the rings of the end effector's gizmo.
            guides: True if the end effector can be held and has a gizmo.
            turns: True if its gizmo has rings even where it cannot be held.
        """
        self._held_gizmos, self._links, self._turns = held_gizmos, links, False
        self._turn = turn
        for node, joint, offset in scene.holdables():
            if guides or joint is not None:
                self._connect(node, joint, offset)
        self._gizmo = None
        if guides or turns:
            self._gizmo = server.scene.add_transform_controls(
                "/end_effector",
                scale=0.2,
                disable_axes=not guides,
                disable_sliders=not guides,
                disable_rotations=guides,
                depth_test=False,
            )
            self._gizmo.on_update(self._gizmo_dragged if guides else self._gizmo_turned)
        server.on_client_disconnect(self._release)

    def follow(self, pose: Pose) -> None:
        """Keep the end effector's gizmo at the end effector while it is not held."""
        gizmo = self._gizmo
        if gizmo is None or self._turn.holder is not None:
            return
        if any(name == gizmo.name for _, name in self._held_gizmos.held()):
            return
        gizmo.position = pose.position.numpy()
        # Without rotation it moves along the axes of the base.
        gizmo.wxyz = pose.orientation.numpy() if self._turns else _BASE_AXES

    def let_turn(self, rings: bool, absolute: bool) -> None:
        """Say what rings the end effector's gizmo has.

        Args:
            rings: True if it has rings to turn it by.
            absolute: True if the end effector takes its gizmo's orientation; otherwise what the
                rings are turned by is added to its orientation.
        """
        self._turns = absolute
        if self._gizmo is not None:
            self._gizmo.disable_rotations = not rings

    async def _release(self, client: ClientHandle) -> None:
        """Forget a client that has left."""
        self._held_gizmos.release_all(client.client_id)
        self._turn.release(client.client_id)

    def _connect(
        self, node: Holdable, joint: int | None, offset: Float[np.ndarray, "3"]
    ) -> None:
        @node.on_drag
        async def dragged(event: SceneNodeDragEvent) -> None:
            pointer = np.array(event.end_position) - offset
            if event.phase == "start":
                held = np.array(event.start_position) - offset
                self._take(event.client_id, node.name, joint, held, pointer)
            elif event.phase == "update":
                self._held_gizmos.move(event.client_id, node.name, pointer)
            else:
                self._held_gizmos.release(event.client_id, node.name)

    def _take(
        self,
        holder: int,
        name: str,
        joint: int | None,
        held: Float[np.ndarray, "3"],
        pointer: Float[np.ndarray, "3"],
    ) -> None:
        links = self._links()
        if links is None:
            return
        if joint is None:
            held_at = held - links[-1].position.numpy()
        else:
            held_at = links[joint - 1].inverse().apply(torch.from_numpy(held)).numpy()
        self._held_gizmos.take(
            holder, name, HeldGizmo(joint=joint, held_at=held_at, pointer=pointer)
        )

    async def _gizmo_dragged(self, event: Any) -> None:
        name, pointer = event.target.name, event.target.position.copy()
        if event.client_id is None:
            return
        if event.phase == "start":
            held = HeldGizmo(joint=None, held_at=np.zeros(3), pointer=pointer)
            self._held_gizmos.take(event.client_id, name, held)
        elif event.phase == "update":
            self._held_gizmos.move(event.client_id, name, pointer, event.target.wxyz.copy())
        else:
            self._held_gizmos.release(event.client_id, name)
        if not self._turns:
            await self._gizmo_turned(event)

    async def _gizmo_turned(self, event: Any) -> None:
        if event.client_id is None:
            return
        if event.phase == "start":
            self._turn.take(event.client_id, event.target.wxyz.copy())
        elif event.phase == "update":
            self._turn.move(event.client_id, event.target.wxyz.copy())
        else:
            self._turn.release(event.client_id)
