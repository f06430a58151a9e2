"""Draw the page's 3D scene (arm, its virtual twin, furniture), and react to the mouse, which
drags links, knobs and the end effector's gizmo.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from hrc_learn.geometry import Body, Box, Pose
from hrc_learn.geometry.shapes import Colour
from hrc_learn.kinematics import Arm
from hrc_learn.protocols import DrawnRegion
from hrc_learn.teleoperation.headset import PEDESTAL, body_meshes, body_shape, held_joint
from hrc_learn.teleoperation.page_operator import HeldGizmo, HeldGizmos
from hrc_learn.viz.palette import PERSON, SKY, TARGET, rgba

# viser is imported when a page is opened, and not before.
if TYPE_CHECKING:
    from viser import ViserServer as ViserServer
else:
    ViserServer = Any  # for type checks at run time


def in_loop[Event](callback: Callable[[Event], object]) -> Callable[[Event], Any]:
    """Make viser call a callback in its event loop rather than in a pool thread: viser's
    handles may be changed only in this loop.
    """

    async def called(event: Event) -> None:
        callback(event)

    return called


_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
# An edge runs along one axis, from -1 to 1.
_EDGES = np.array([(a, b) for a in _CORNERS for b in _CORNERS if sorted(b - a) == [0, 0, 2]])


def box_edges(half_size: tuple[float, float, float]) -> Float[np.ndarray, "12 2 3"]:
    """End points of the edges of a box that is centred at the origin [m]."""
    return _EDGES * np.array(half_size)


_TWIN: Colour = (rgba(SKY)[0] / 255, rgba(SKY)[1] / 255, rgba(SKY)[2] / 255, 0.45)
"""Colour of the virtual twin, a translucent copy of the arm that can be held instead of it."""
_TWIN_AT = (-0.1, 1.3, 0.0)
"""Position of the virtual twin relative to the arm, for a Panda [m]."""
_PARENTS = ("", "/twin")
_BASE_AXES = (1.0, 0.0, 0.0, 0.0)  # unit quaternion (wxyz)


class PageScene:
    """Draws the bodies at their poses, as the arm and as its twin, and reacts to the mouse.

    Callbacks are coroutines, so that viser calls them in its event loop and in the order of the
    browser's messages. Handles of viser send a property only if it has changed.

    Attributes:
        robot: The arm.
        held: Record of held gizmos.
        guides: True if the end effector can be held.
    """

    def __init__(
        self,
        server: ViserServer,
        bodies: Sequence[Body],
        boxes: Sequence[Box],
        held: HeldGizmos,
        robot: Arm,
        *,
        guides: bool,
        turns: bool,
    ):
        """Draw everything once.

        Args:
            server: Server of the page.
            bodies: Moving bodies with their shapes.
            boxes: Fixed boxes.
            held: Record of held gizmos.
            robot: The arm. If it has a null space, every second joint (shoulder, elbow, wrist)
                is marked by a knob. Links can be held, too.
            guides: True if the end effector can be held and has a gizmo.
            turns: True if the end effector has a gizmo with rings even if it cannot be held.
        """
        self._scene, self.held, self.guides = server.scene, held, guides
        self.robot, self._joints, self._size = robot, robot.joints, robot.hand_size
        self._twin_at = self._size * np.array(_TWIN_AT)
        self._twin = self._scene.add_frame(
            "/twin", False, position=self._twin_at, visible=False
        )
        # Carried objects have no twin, as they cannot be held.
        self._frames = [
            [self._draw(parent, body) for parent in _PARENTS[: 1 + self._can_be_held(body)]]
            for body in bodies
        ]
        knobs = range(2, self._joints, 2) if robot.null_space != "none" else ()
        self._knobs = {
            joint: [self._draw_knob(parent, joint) for parent in _PARENTS] for joint in knobs
        }
        for box in (*boxes, PEDESTAL):
            self._draw_box(box)
        self._surroundings(server)
        self._arrows = self._scene.add_arrows(
            "/pull",
            np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, 0.1]]]),
            rgba(PERSON)[:3],
            shaft_radius=0.008 * self._size,
            head_radius=0.022 * self._size,
            head_length=0.05 * self._size,
            visible=False,
        )
        self._region = self._scene.add_line_segments(
            "/active_region",
            np.zeros((12, 2, 3)),
            rgba(TARGET)[:3],
            thickness=0.003,
            visible=False,
        )
        self._gizmo = self._scene.add_transform_controls(
            "/end_effector",
            scale=0.2 * self._size,
            disable_axes=not guides,
            disable_sliders=not guides,
            disable_rotations=guides,
            depth_test=False,
            visible=guides or turns,
        )
        self._gizmo.on_update(self._gizmo_dragged)
        server.on_client_disconnect(in_loop(lambda client: held.release(client.client_id)))

    def move(
        self,
        positions: Float[np.ndarray, "bodies 3"],
        orientations: Float[np.ndarray, "bodies 4"],
        links: Pose,
    ) -> None:
        """Update all poses.

        Args:
            positions: Positions of the bodies [m].
            orientations: Orientations of the bodies (wxyz).
            links: Frames of the arm, for the knobs and the end effector's gizmo.
        """
        for frames, position, orientation in zip(
            self._frames, positions, orientations, strict=True
        ):
            for frame in frames:
                frame.position, frame.wxyz = position, orientation
        for joint, knobs in self._knobs.items():
            for knob in knobs:
                knob.position = links.position[joint - 1].numpy()
        gizmo = self._gizmo
        if not self.held.turning and all(name != gizmo.name for _, name in self.held.held()):
            gizmo.position, gizmo.wxyz = links.position[-1].numpy(), _BASE_AXES

    def show_twin(self, visible: bool) -> None:
        """Show or hide the twin."""
        self._twin.visible = visible

    def show_region(self, region: DrawnRegion | None) -> None:
        """Show the region into which a controller moves the end effector; None: no region."""
        self._region.visible = region is not None
        if region is not None:
            self._region.points = box_edges(region.half_size) + np.array(region.centre)

    def let_turn(self, rings: bool) -> None:
        """Show or hide the rings of the end effector's gizmo."""
        self._gizmo.disable_rotations = not rings

    def point(
        self,
        arrows: Float[np.ndarray, "arrows 2 3"],
        colour: str = PERSON,
        held: Collection[int | None] = (),
    ) -> None:
        """Show the pulls as arrows; the colour shows how far the arm follows.

        Args:
            arrows: Arrows from the held points to the pointers, in the base frame [m].
            colour: Colour of the arrows and of the held knobs.
            held: Joints that are held, counted from 1; None: the end effector.
        """
        for joint, knobs in self._knobs.items():
            for knob in knobs:
                knob.color = rgba(colour if joint in held else PERSON)[:3]
        self._arrows.visible = bool(len(arrows))
        if len(arrows):
            self._arrows.points = arrows.astype(np.float32)
            self._arrows.colors = np.array(rgba(colour)[:3], np.uint8)

    def _can_be_held(self, body: Body) -> bool:
        return held_joint(body, self._joints) != "nothing"

    def _draw(self, parent: str, body: Body) -> Any:
        path, joint = f"{parent}/arm/{body.name}", held_joint(body, self._joints)
        frame = self._scene.add_frame(
            path, position=body.position[0], wxyz=body.orientation[0], show_axes=False
        )
        shapes = {_TWIN: body_shape(body)} if parent else body_meshes(body)
        for k, ((red, green, blue, opacity), mesh) in enumerate(shapes.items()):
            node = self._scene.add_mesh_simple(
                f"{path}/{k}",
                mesh.vertices,
                mesh.faces,
                color=(round(255 * red), round(255 * green), round(255 * blue)),
                opacity=opacity if opacity < 1 else None,
                flat_shading=False,
                cast_shadow=not parent,
            )
            if joint != "nothing":
                self._connect(node, joint, parent)
        return frame

    def _draw_knob(self, parent: str, joint: int) -> Any:
        knob = self._scene.add_icosphere(
            f"{parent}/knobs/joint{joint}",
            radius=0.078 * self._size,
            subdivisions=2,
            color=rgba(PERSON)[:3],
            opacity=0.9,
            cast_shadow=False,
        )
        self._connect(knob, joint, parent)
        return knob

    def _connect(self, node: Any, joint: int | None, parent: str) -> None:
        if joint is None and not self.guides:
            return
        offset = self._twin_at if parent else np.zeros(3)

        @node.on_drag
        async def dragged(event: Any) -> None:
            key = event.client_id, node.name
            pointer = np.array(event.end_position) - offset
            if event.phase == "start":
                start = np.array(event.start_position) - offset
                self.held.grab(key, joint, start, pointer)
            elif event.phase == "update":
                self.held.move(key, pointer)
            else:
                self.held.release(*key)

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
        # Without a GPU, shadows halve the frame rate and an environment map reduces it by 40 %.
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
        usual = self._size * np.array([_CAMERA, _LOOK_AT])
        camera = server.initial_camera
        (camera.position, camera.look_at), camera.fov = usual, 0.9
        server.on_client_connect(partial(_step_back, usual=usual))

    async def _gizmo_dragged(self, event: Any) -> None:
        if event.client_id is None:
            return
        key, gizmo = (event.client_id, event.target.name), event.target
        pointer, orientation = gizmo.position.copy(), gizmo.wxyz.copy()
        if event.phase == "start":
            held = HeldGizmo(joint=None, held_at=np.zeros(3), pointer=pointer)
            self.held.take(key, held if self.guides else None, orientation)
        elif event.phase == "update":
            self.held.move(key, pointer, orientation)
        else:
            self.held.release(*key)


_CAMERA, _LOOK_AT = (2.65, 1.05, 1.15), (0.1, 0.47, 0.12)  # for a Panda [m]
_ASPECT = 1.2  # smallest aspect ratio at which both cabinet and twin are in view


async def _step_back(client: Any, usual: Float[np.ndarray, "2 3"]) -> None:
    """Move the camera back if its view is narrow, as on a phone, to show the same scene."""
    aspect, (camera, look_at) = client.camera.aspect, usual
    if aspect < _ASPECT:
        # Setting the position also shifts the point that it looks at.
        client.camera.position = look_at + _ASPECT / aspect * (camera - look_at)
        client.camera.look_at = look_at
