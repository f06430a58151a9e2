"""Interfaces of the workplace of a skill, simulated or real."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.kinematics import Arm
from hrc_learn.protocols import Touch
from hrc_learn.vision import Marker


@runtime_checkable
class GraspObject(Protocol):
    """A box to grasp, with a marker on top."""

    @property
    def name(self) -> str:
        """Name of the object."""
        ...

    @property
    def half_size(self) -> tuple[float, float, float]:
        """Half edges [m]; the gripper closes along x."""
        ...

    @property
    def marker(self) -> Marker:
        """Marker by which the camera finds it."""
        ...


@runtime_checkable
class Workplace(Protocol):
    """Poses of a task: table, home and shelves, known roughly, in the base frame."""

    @property
    def robot(self) -> Arm:
        """The arm that works there."""
        ...

    @property
    def tool_marker(self) -> int:
        """ArUco number of the marker on the end effector."""
        ...

    @property
    def hover_height(self) -> float:
        """Height of the tool centre point during visual servoing [m]."""
        ...

    @property
    def fingertip(self) -> float:
        """Distance of the fingertips beyond the tool centre point [m]."""
        ...

    @property
    def palm(self) -> float:
        """Distance of the palm behind the tool centre point [m]."""
        ...

    def lowering(self, half_size: tuple[float, float, float]) -> float:
        """Largest distance that an object of a half size [m] may be lowered at its release [m].

        Beyond it, the gripper itself would touch the shelf.
        """
        ...

    @property
    def hover_turns(self) -> tuple[float, float]:
        """Smallest and largest turn of the end effector about the vertical there [rad]."""
        ...

    def hover(self) -> Pose:
        """Pose of the end effector above the middle of the table."""
        ...

    def hover_joints(self) -> Float[Tensor, " joints"]:
        """Preferred joint positions at the hover pose [rad]."""
        ...

    def hover_postures(self) -> Sequence[Float[Tensor, " joints"]]:
        """Several joint positions at the hover pose, the preferred ones first [rad]."""
        ...

    def home_joints(
        self, offset: Float[Tensor, "3"] | None = None, q7_offset: float = 0.0
    ) -> Float[Tensor, " joints"]:
        """Joint positions at home, the start of a placing motion [rad].

        Args:
            offset: Offset of the end effector from home [m].
            q7_offset: Change of joint 7, which moves the elbow about the line to the wrist
                [rad].

        Raises:
            UnreachableError: No joint positions reach the pose.
        """
        ...

    def object_region(self) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        """Box of the objects on the table: centre and half edges [m]."""
        ...

    def shelf(self, name: str, half_size: tuple[float, float, float] | None = None) -> Pose:
        """Pose of the end effector at the release of an object of a half size [m] on a shelf.

        Raises:
            ValueError: There is no such shelf.
        """
        ...


@runtime_checkable
class CollisionChecker(Protocol):
    """A geometric model of the workplace."""

    def collisions_along(
        self, path: Float[np.ndarray, "steps joints"], carried: str | None = None
    ) -> Sequence[Touch]:
        """Contacts along a path of joint positions [rad], with an object carried along.

        Their times are indices of the samples.
        """
        ...
