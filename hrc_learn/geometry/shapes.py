"""Shapes to draw and to keep clear of, and the rigid bodies that carry them.

A body is a trajectory of poses with boxes, capsules or a mesh file attached to it.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

Colour = tuple[float, float, float, float]
"""Red, green, blue, opacity, each 0 to 1."""

PLAIN: Colour = (0.86, 0.87, 0.89, 1.0)
"""Colour of a robot link without a colour of its own."""


@dataclass(frozen=True, kw_only=True)
class Capsule:
    """A cylinder with round ends, in the frame of the body that carries it."""

    start: tuple[float, float, float]
    """[m]"""
    end: tuple[float, float, float]
    """[m]"""
    radius: float
    """[m]"""
    colour: Colour = PLAIN


@dataclass(frozen=True, kw_only=True)
class Box:
    """A box, axes along those of the body that carries it, or of the base frame."""

    centre: tuple[float, float, float]
    """[m]"""
    half_size: tuple[float, float, float]
    """[m]"""
    colour: Colour = (0.75, 0.62, 0.45, 1.0)
    name: str = ""


@dataclass(frozen=True, kw_only=True)
class MeshFile:
    """A drawn shape in a file (`read_mesh`), in the frame of the body that carries it."""

    path: Path
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """[m]"""
    orientation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Unit quaternion (w, x, y, z)."""
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors on the file's coordinates, along its own axes."""
    colour: Colour | None = None
    """Colour of parts without a colour in the file; None: the default."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Body:
    """Something rigid that moves: a link of the arm, a finger, the object it carries."""

    name: str
    position: Float[np.ndarray, "time 3"]
    """Origin in the base frame [m]."""
    orientation: Float[np.ndarray, "time 4"]
    """Unit quaternion (w, x, y, z)."""
    capsules: tuple[Capsule, ...] = ()
    boxes: tuple[Box, ...] = ()
    meshes: tuple[MeshFile, ...] = ()
    """Drawn in place of capsules and nameless boxes."""


def arm_bodies(
    position: Float[np.ndarray, "time links 3"],
    orientation: Float[np.ndarray, "time links 4"],
    *,
    radius: float = 0.045,
    colour: Colour = PLAIN,
) -> tuple[Body, ...]:
    """A stick arm for robots without a drawn model: a capsule from each frame to the next.

    The base stands at the origin.

    Args:
        position: Origins of the joint frames, from the base to the tool [m].
        orientation: Unit quaternions of the bodies (w, x, y, z).
        radius: Radius of the capsules [m].
        colour: Colour of the capsules.
    """
    origin = np.zeros_like(position[:, :1])
    upright = np.zeros_like(orientation[:, :1])
    upright[..., 0] = 1.0
    position = np.concatenate([origin, position], axis=1)
    orientation = np.concatenate([upright, orientation], axis=1)
    bodies = []
    for i in range(position.shape[1] - 1):
        # Joint i + 1 sits on link i, so its place in frame i is the same at every time.
        w, axis = orientation[0, i, 0], orientation[0, i, 1:]
        offset = position[0, i + 1] - position[0, i]
        turned = np.cross(axis, offset)
        end = offset + 2.0 * (np.cross(axis, turned) - w * turned)  # by the conjugate
        x, y, z = end.tolist()
        capsule = Capsule(start=(0.0, 0.0, 0.0), end=(x, y, z), radius=radius, colour=colour)
        bodies.append(
            Body(
                name=f"link{i}",
                position=position[:, i],
                orientation=orientation[:, i],
                capsules=(capsule,),
            )
        )
    return tuple(bodies)
