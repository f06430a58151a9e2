"""ArUco plates in a MuJoCo model.

The picture lies on a flat mesh with its own texture coordinates, so that the corners are
exact to the texel; a texture stretched over a box's six faces would not be.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from hrc_learn.vision import Marker, marker_texture

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.


_THICKNESS = 0.002
_TEXELS = 400


@dataclass(frozen=True, kw_only=True)
class Plate:
    """A square plate that carries one marker, facing +z of its own frame."""

    marker: Marker
    """Which marker, and the edge length of its black square [m]."""
    position: tuple[float, float, float]
    """Centre of the plate's face in the frame of the body that carries it [m]."""
    orientation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Orientation of the plate's frame (wxyz): x along the marker's top edge, y up its side."""
    solid: bool = True
    """Whether the plate touches objects. A sticker on a box does not."""


def add_plate(spec: mujoco.MjSpec, body, name: str, plate: Plate) -> None:
    """Add a plate to a body: geom `name` (picture), site `name` (frame of the marker)."""
    half = plate.marker.plate_size / 2
    _add_picture(spec, name, marker_texture(plate.marker.id, _TEXELS))
    mesh = spec.add_mesh(name=name)
    mesh.uservert = [-half, -half, 0, half, -half, 0, half, half, 0, -half, half, 0]
    mesh.userface = [0, 1, 2, 0, 2, 3]
    mesh.usertexcoord = [0, 1, 1, 1, 1, 0, 0, 0]
    mesh.userfacetexcoord = [0, 1, 2, 0, 2, 3]
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    pose = {"pos": plate.position, "quat": plate.orientation}
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=name,
        material=name,
        contype=0,
        conaffinity=0,
        mass=0.0,
        **pose,
    )
    body.add_site(name=name, group=4, **pose)  # groups above 2 are not drawn
    if plate.solid:
        normal = np.zeros(3)
        mujoco.mju_rotVecQuat(normal, np.array([0.0, 0.0, 1.0]), np.array(plate.orientation))
        body.add_geom(
            name=f"{name}_plate",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=(half, half, _THICKNESS / 2),
            # Just below the picture, or the two would flicker through each other.
            pos=np.array(plate.position) - 0.75 * _THICKNESS * normal,
            quat=plate.orientation,
            mass=0.02,
            rgba=(0.9, 0.9, 0.9, 1.0),
        )


def _add_picture(spec: mujoco.MjSpec, name: str, pixels: np.ndarray) -> None:
    texture = spec.add_texture(
        name=name,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=pixels.shape[1],
        height=pixels.shape[0],
        nchannel=3,
    )
    texture.data = np.repeat(pixels[..., None], 3, axis=-1).tobytes()
    material = spec.add_material(name=name, specular=0.0, shininess=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
