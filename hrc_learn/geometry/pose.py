"""Position and orientation of one frame in another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import quaternion
from hrc_learn.geometry.numerics import ArrayLike, as_tensor

_WHOLE = (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)


@dataclass(frozen=True)
class Pose:
    """Pose of a frame in its parent frame.

    Poses compose with `@`, have an inverse, and transform points to the parent frame. Fields
    may be given as NumPy arrays or lists. A pose is a pytree, so `torch.func`, `torch.compile`
    and `torch.export` accept it.
    """

    position: Float[Tensor, "*batch 3"]
    """Origin in the parent frame [m]."""
    orientation: Float[Tensor, "*batch 4"]
    """Unit quaternion (w, x, y, z); either sign."""

    def __post_init__(self):
        # Arrays, tables, lists and whole numbers become tensors of floats. Placeholders of
        # tracers and masks of a pytree pass unchanged.
        for name in ("position", "orientation"):
            value = getattr(self, name)
            whole = isinstance(value, Tensor) and value.dtype in _WHOLE
            array = not isinstance(value, Tensor) and hasattr(value, "__array__")
            if whole or array or isinstance(value, (list, tuple)):  # torch 2.15 traces this
                object.__setattr__(self, name, as_tensor(value))

    @staticmethod
    def stack(poses: Sequence[Pose]) -> Pose:
        """Poses as one batch, along a new first dimension."""
        position = torch.stack([pose.position for pose in poses])
        return Pose(position, torch.stack([pose.orientation for pose in poses]))

    @staticmethod
    def from_matrix(T: ArrayLike) -> Pose:
        """Pose of a homogeneous transform (*batch, 4, 4), or of its upper rows (R | p)."""
        T = as_tensor(T)
        return Pose(T[..., :3, 3], quaternion.from_matrix(T[..., :3, :3]))

    def matrix(self) -> Float[Tensor, "*batch 4 4"]:
        """Homogeneous transform."""
        R = quaternion.to_matrix(self.orientation)
        upper = torch.cat([R, self.position[..., None]], dim=-1)
        corner = upper.new_tensor([[0.0, 0.0, 0.0, 1.0]])
        return torch.cat([upper, corner.expand(*upper.shape[:-2], 1, 4)], dim=-2)

    @staticmethod
    def from_vector(r: ArrayLike) -> Pose:
        """Pose from a vector (position [m], rotation vector [rad]) of shape (*batch, 6)."""
        r = as_tensor(r)
        return Pose(r[..., :3], quaternion.exp(r[..., 3:]))

    def vector(self) -> Float[Tensor, "*batch 6"]:
        """Position [m] and rotation vector [rad] of the shortest rotation; r in equations."""
        return torch.cat([self.position, quaternion.log(self.orientation)], dim=-1)

    def __matmul__(self, other: Pose) -> Pose:
        """Pose of `other` in the parent of this frame; `other` is given in this frame."""
        return Pose(
            self.apply(other.position), quaternion.multiply(self.orientation, other.orientation)
        )

    def inverse(self) -> Pose:
        """Pose of the parent in this frame."""
        inverse = quaternion.conjugate(self.orientation)
        return Pose(-quaternion.rotate(inverse, self.position), inverse)

    def apply(self, points: ArrayLike) -> Float[Tensor, "*both 3"]:
        """Coordinates in the parent frame of points given in this frame [m].

        Args:
            points: Points (*points, 3) [m]; leading dimensions broadcast against the pose's.
                Arrays and lists are converted to the dtype and device of the pose.
        """
        like = None if isinstance(points, Tensor) else self.position
        return quaternion.rotate(self.orientation, as_tensor(points, like)) + self.position

    def twist_to(self, other: Pose) -> Float[Tensor, "*both 6"]:
        """Motion to `other` as (linear [m], angular [rad]) in the parent frame.

        The angular part is the rotation vector of R_other R_self^T. So for close poses this is
        the geometric Jacobian times the joint motion, unlike the difference of `vector()`s.
        """
        turn = quaternion.multiply(other.orientation, quaternion.conjugate(self.orientation))
        move = other.position - self.position
        return torch.cat(torch.broadcast_tensors(move, quaternion.log(turn)), dim=-1)

    def __getitem__(self, index: Any) -> Pose:
        """Index the batch dimensions."""
        batch = index if isinstance(index, tuple) else (index,)
        index = (*batch, slice(None))
        return Pose(self.position[index], self.orientation[index])


torch.export.register_dataclass(Pose, serialized_type_name="hrc_learn.geometry.Pose")
