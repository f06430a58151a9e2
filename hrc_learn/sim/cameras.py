"""Cameras of the workplace and their disturbances.

Images are rendered by OpenGL without a screen, or drawn without OpenGL. Disturbances are a
camera that is moved or refocused, and a marker that is occluded.
"""

from __future__ import annotations

import sys
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import mujoco
import numpy as np
import torch
from jaxtyping import Float, UInt8

from hrc_learn.geometry import quaternion
from hrc_learn.geometry.numerics import check_choice, check_settings
from hrc_learn.geometry.shapes import Line
from hrc_learn.protocols import Camera
from hrc_learn.sim.recorded_world import DrawnWorld, RecordedWorld
from hrc_learn.sim.scene import HAND_MARKER, NOWHERE, OCCLUDER
from hrc_learn.sim.world import World
from hrc_learn.vision import CameraModel, ImageNoise, Lens, Marker, SyntheticCamera

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.


CameraKind = Literal["auto", "egl", "synthetic"]


class RenderingUnavailableError(RuntimeError):
    """This machine cannot render without a screen."""


def _add_line(scene: mujoco.MjvScene, line: Line) -> None:
    """Add a line to a scene, unless the scene is full."""
    if scene.ngeom == scene.maxgeom:
        return
    kind = mujoco.mjtGeom.mjGEOM_ARROW if line.head else mujoco.mjtGeom.mjGEOM_CAPSULE
    geom, zero = scene.geoms[scene.ngeom], np.zeros(3)
    colour = np.array(line.colour, dtype=np.float32)
    mujoco.mjv_initGeom(geom, kind, zero, zero, np.eye(3).ravel(), colour)
    mujoco.mjv_connector(geom, kind, line.width, line.start, line.end)
    scene.ngeom += 1


class OffscreenRenderer:
    """Renders a world from ideal pinhole cameras into arrays."""

    def __init__(self, world: World | RecordedWorld, width: int, height: int):
        """Open an OpenGL context.

        Args:
            world: World, rendered in its current state, or the recording of a run.
            width: Width of the images [px].
            height: Height of the images [px].

        Raises:
            RenderingUnavailableError: If EGL (on Linux) or OpenGL is not available.
        """
        self._gl = _open_context(width, height)
        self._size = (width, height)
        self._drawn = DrawnWorld(world) if isinstance(world, World) else world
        model = self._drawn.model
        model.vis.global_.offwidth = max(width, model.vis.global_.offwidth)
        model.vis.global_.offheight = max(height, model.vis.global_.offheight)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        self._free = weakref.finalize(self, _free, self._gl, self._context)
        self._free.atexit = False
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(model, maxgeom=1000)
        shadows = int(model.vis.quality.shadowsize > 0)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0

    def render(
        self, camera: CameraModel, lines: Sequence[Line] = ()
    ) -> UInt8[np.ndarray, "height width 3"]:
        """RGB image from an undistorted camera with the renderer's image size.

        Args:
            camera: Camera to render.
            lines: Lines to draw in addition to the world.
        """
        width, height = self._size
        self._gl.make_current()
        self._drawn.update()
        mujoco.mjv_updateScene(
            self._drawn.model,
            self._drawn.data,
            mujoco.MjvOption(),
            None,
            mujoco.MjvCamera(),
            mujoco.mjtCatBit.mjCAT_ALL,
            self._scene,
        )
        for line in lines:
            _add_line(self._scene, line)
        for view in self._scene.camera:
            _set_view(view, camera)
        viewport = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(viewport, self._scene, self._context)
        image = np.empty((height, width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(image, None, viewport, self._context)
        return np.ascontiguousarray(image[::-1])

    def close(self) -> None:
        """Free the OpenGL context."""
        self._free()


def _free(gl, context: mujoco.MjrContext) -> None:
    # OpenGL frees objects of the current context by number. If the context of another renderer
    # were current, the other renderer would lose its objects and return black images.
    gl.make_current()
    context.free()
    gl.free()


def _open_context(width: int, height: int):
    try:
        if sys.platform == "linux":
            from mujoco.egl import GLContext
        else:
            from mujoco.gl_context import GLContext
        context = GLContext(width, height)
        context.make_current()
    except Exception as error:  # PyOpenGL fails in many ways where a library is missing
        raise RenderingUnavailableError(
            f"this machine cannot render without a screen ({error}). Install EGL (Debian: "
            "libegl1 and libgl1-mesa-dri), or use the camera that needs no OpenGL: 'synthetic'."
        ) from error
    return context


def _set_view(view: mujoco.MjvGLCamera, camera: CameraModel) -> None:
    """Give OpenGL's camera the pose and the frustum of a pinhole."""
    R = camera.pose[:3, :3]
    view.pos = camera.pose[:3, 3]
    view.forward = R[:, 2]
    view.up = -R[:, 1]
    near = view.frustum_near
    (fx, fy), (cx, cy) = camera.focal, camera.principal
    # Pixel centres lie at whole numbers, so the image's edges lie half a pixel further out.
    view.frustum_center = near * ((camera.width - 1) / 2 - cx) / fx
    view.frustum_width = near * camera.width / fx / 2
    view.frustum_top = near * (cy + 0.5) / fy
    view.frustum_bottom = -near * (camera.height - 0.5 - cy) / fy
    view.orthographic = 0


class EGLCamera:
    """Camera that renders the workplace with lens distortion, blur and noise."""

    def __init__(
        self,
        world: World,
        model: CameraModel | None = None,
        *,
        rng: np.random.Generator,
        noise: ImageNoise | None = None,
    ):
        """Open a renderer for the world's camera, or for another one.

        Raises:
            RenderingUnavailableError: If this machine cannot render without a screen.
        """
        self.model = model or world.config.camera
        self._lens = Lens(self.model)
        pinhole = self._lens.pinhole
        self._renderer = OffscreenRenderer(world, pinhole.width, pinhole.height)
        self._noise = noise or ImageNoise()
        self._rng = rng

    def read(self) -> UInt8[np.ndarray, "height width 3"]:
        """Current image, RGB."""
        ideal = self._renderer.render(self._lens.pinhole)
        return self._noise.degrade(self._lens.apply(ideal), self._rng)

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()


def hidden_markers(world: World, model: CameraModel, markers: list[Marker]) -> set[int]:
    """Ids of markers with an occluded corner or centre, found by casting rays."""
    eye, poses = model.pose[:3, 3].copy(), world.marker_poses()
    geom, normal = np.zeros(1, dtype=np.int32), np.zeros(3)
    hidden = set()
    for marker in markers:
        pose = poses[marker.id]
        for point in np.vstack([np.zeros(3), marker.corners]) @ pose[:3, :3].T + pose[:3, 3]:
            length = np.linalg.norm(point - eye)
            ray = (point - eye) / length
            hit = mujoco.mj_ray(world.model, world.data, eye, ray, None, 1, -1, geom, normal)
            # A ray to a visible point hits the plate itself, at most 5 mm before the point.
            if 0 <= hit < length - 5e-3:
                hidden.add(marker.id)
                break
    return hidden


def open_camera(
    world: World,
    kind: CameraKind = "auto",
    model: CameraModel | None = None,
    *,
    rng: np.random.Generator,
    noise: ImageNoise | None = None,
) -> Camera:
    """The world's fixed camera.

    Args:
        world: World to render.
        kind: "egl" renders everything; "synthetic" draws the markers only and needs no
            OpenGL; "auto" renders if this machine can.
        model: Camera to use instead of the world's own.
        rng: Source of the image noise.
        noise: Blur and noise of the sensor.

    Raises:
        RenderingUnavailableError: If `kind` is "egl" and this machine cannot render.
    """
    check_choice("kind", kind, get_args(CameraKind))
    if kind != "synthetic":
        try:
            return EGLCamera(world, model, rng=rng, noise=noise)
        except RenderingUnavailableError:
            if kind == "egl":
                raise
    model = model or world.config.camera
    markers = [item.marker for item in world.config.objects]
    if world.config.arm.marker is not None:
        markers.append(world.config.arm.marker.marker)
    return SyntheticCamera(
        model,
        markers,
        world.marker_poses,
        rng=rng,
        noise=noise,
        hidden=lambda: hidden_markers(world, model, markers),
    )


# Distance of the occluding board from the marker, towards the camera [m]; it keeps the board
# clear of the gripper.
_BOARD_HEIGHT = 0.10


@dataclass(frozen=True, kw_only=True)
class CameraChange:
    """Size of one change of a camera's pose and focus."""

    distance: float = 0.10
    """Translation in a random direction [m]."""
    angle: float = np.deg2rad(10.0)
    """Rotation about a random axis [rad]."""
    focus: float = 1.0
    """Factor on the focal length."""

    def __post_init__(self) -> None:
        check_settings(self, positive=["focus"], not_negative=["distance", "angle"])

    def applied(
        self,
        model: CameraModel,
        watched: Float[np.ndarray, "points 3"],
        rng: np.random.Generator,
        attempts: int = 10_000,
    ) -> CameraModel:
        """A changed camera that still sees the watched points.

        Args:
            model: The camera before the change.
            watched: Points that must stay in view [m].
            rng: Source of the directions.
            attempts: Largest number of random directions to try.

        Raises:
            ValueError: If no attempt keeps the points in view.
        """
        (fx, fy), s = model.focal, self.focus
        for _ in range(attempts):
            pose = model.pose.copy()
            pose[:3, 3] += self.distance * _direction(rng)
            turn = quaternion.exp(torch.from_numpy(self.angle * _direction(rng)))
            pose[:3, :3] = quaternion.to_matrix(turn).numpy() @ pose[:3, :3]
            changed = replace(model, pose=pose, focal=(s * fx, s * fy))
            if changed.in_view(watched).all():
                return changed
        raise ValueError(
            f"a camera moved by {self.distance:g} m, turned by {np.rad2deg(self.angle):.0f} "
            f"degrees and refocused by {s:g} does not see the workplace: change it less."
        )


class ChangingCamera:
    """Implements the `Camera` protocol with a camera that can be replaced at any time.

    Attributes:
        history: Start time and true model of each camera so far.
    """

    def __init__(self, model: CameraModel, opened: Callable[[CameraModel], Camera]):
        """Begin with a camera.

        Args:
            model: Model of the first camera.
            opened: Function that opens a camera.
        """
        self._open = opened
        self._camera = opened(model)
        self.history: list[tuple[float, CameraModel]] = [(-np.inf, model)]

    @property
    def model(self) -> CameraModel:
        """True model of the current camera."""
        return self.history[-1][1]

    def change(self, time: float, model: CameraModel) -> None:
        """Use another camera from now on.

        Args:
            time: Time of the change [s].
            model: Model of the new camera.
        """
        self._camera = self._open(model)
        self.history.append((time, model))

    def read(self) -> UInt8[np.ndarray, "height width 3"]:
        """Current image, RGB."""
        return self._camera.read()


def _direction(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


@dataclass(frozen=True, kw_only=True)
class OcclusionInterval:
    """An interval in which a marker is occluded."""

    start: float
    """Start of the interval [s]."""
    duration: float
    """Duration of the interval [s]."""
    marker: int = HAND_MARKER
    """ArUco number of the marker."""

    def __post_init__(self) -> None:
        check_settings(self, not_negative=["start", "duration"])


class ScriptedOcclusion:
    """Keeps a board between the camera and a marker, even while the marker moves."""

    def __init__(self, world: World, intervals: Sequence[OcclusionInterval]):
        self._world, self._intervals = world, tuple(intervals)

    def update(self) -> None:
        """Move the board in front of the marker that is occluded now; if none is, out of the
        scene.
        """
        world, place = self._world, np.array(NOWHERE)
        for interval in self._intervals:
            if 0 <= world.time - interval.start < interval.duration:
                marker = world.marker_poses()[interval.marker][:3, 3]
                towards = world.config.camera.pose[:3, 3] - marker
                place = marker + _BOARD_HEIGHT * towards / np.linalg.norm(towards)
        if self._intervals:
            world.move_obstacle(OCCLUDER, place)
