"""The workplace as a camera sees it: rendered by OpenGL without a screen, or without OpenGL."""

import sys
import weakref
from collections.abc import Set
from typing import Literal

import mujoco
import numpy as np
from jaxtyping import UInt8

from hrc_learn.protocols import Camera
from hrc_learn.sim.camera_disturbances import occluding_boards
from hrc_learn.sim.world import World
from hrc_learn.vision import CameraModel, ImageNoise, Lens, Marker, SyntheticCamera

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.


CameraKind = Literal["auto", "egl", "synthetic"]


class RenderingUnavailableError(RuntimeError):
    """This machine cannot render without a screen."""


class OffscreenRenderer:
    """Renders a world from ideal pinhole cameras into arrays."""

    def __init__(self, world: World, width: int, height: int):
        """Open an OpenGL context.

        Raises:
            RenderingUnavailableError: If there is no EGL (on Linux) or no OpenGL to be had.
        """
        self._world = world
        self._size = (width, height)
        world.model.vis.global_.offwidth = max(width, world.model.vis.global_.offwidth)
        world.model.vis.global_.offheight = max(height, world.model.vis.global_.offheight)
        self._gl = _open_context(width, height)
        self._context = mujoco.MjrContext(world.model, mujoco.mjtFontScale.mjFONTSCALE_100)
        self._free = weakref.finalize(self, _free, self._gl, self._context)
        self._free.atexit = False
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(world.model, maxgeom=1000)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0

    def render(self, camera: CameraModel) -> UInt8[np.ndarray, "height width 3"]:
        """The image of an undistorted camera of the renderer's size, RGB."""
        width, height = self._size
        self._gl.make_current()
        mujoco.mjv_updateScene(
            self._world.model,
            self._world.data,
            mujoco.MjvOption(),
            None,
            mujoco.MjvCamera(),
            mujoco.mjtCatBit.mjCAT_ALL,
            self._scene,
        )
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
    # OpenGL frees by number, and another renderer that is current has the same numbers: its
    # images would be black from then on.
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
    # Pixel centres lie at whole numbers, so the image's edges lie half a pixel outside.
    view.frustum_center = near * ((camera.width - 1) / 2 - cx) / fx
    view.frustum_width = near * camera.width / fx / 2
    view.frustum_top = near * (cy + 0.5) / fy
    view.frustum_bottom = -near * (camera.height - 0.5 - cy) / fy
    view.orthographic = 0


class EGLCamera:
    """The workplace seen through a lens, noise and all."""

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
        """The image now, RGB."""
        ideal = self._renderer.render(self._lens.pinhole)
        return self._noise.degrade(self._lens.apply(ideal), self._rng)

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()


class MarkerVisibility:
    """Which markers are occluded, by casting rays from the camera."""

    def __init__(self, world: World, model: CameraModel, markers: list[Marker]):
        self._world = world
        self._centre = model.pose[:3, 3].copy()
        self._markers = {marker.id: marker for marker in markers}

    def hidden(self) -> Set[int]:
        """Ids of markers of which a corner or the centre cannot be seen now."""
        poses = self._world.marker_poses()
        return {
            id for id, pose in poses.items() if id in self._markers and self._blocked(id, pose)
        }

    def _blocked(self, id: int, pose: np.ndarray) -> bool:
        points = (
            np.vstack([np.zeros(3), self._markers[id].corners]) @ pose[:3, :3].T + pose[:3, 3]
        )
        geom = np.zeros(1, dtype=np.int32)
        normal = np.zeros(3)
        for point in points:
            ray = point - self._centre
            length = np.linalg.norm(ray)
            hit = mujoco.mj_ray(
                self._world.model,
                self._world.data,
                self._centre,
                ray / length,
                None,
                1,
                -1,
                geom,
                normal,
            )
            # The marker's own plate is hit at its full distance, give or take its thickness.
            if 0 <= hit < length - 5e-3:
                return True
        return False


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
        world: What to look at.
        kind: "egl" renders everything; "synthetic" draws the markers only and needs no
            OpenGL; "auto" renders where that is possible.
        model: Another camera than the world's own.
        rng: Source of the image noise.
        noise: Blur and noise of the sensor.

    Raises:
        RenderingUnavailableError: If `kind` is "egl" and this machine cannot render.
    """
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
    visibility = MarkerVisibility(world, model, markers)
    return SyntheticCamera(
        model,
        markers,
        world.marker_poses,
        rng=rng,
        noise=noise,
        hidden=visibility.hidden,
        occluders=lambda: occluding_boards(world, model),
    )
