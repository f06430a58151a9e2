"""What skills ask of the place they work in, whether simulated or real."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.kinematics import Arm
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
        """Height of the tool centre point while it servoes to an object [m]."""
        ...

    @property
    def fingertip(self) -> float:
        """How far the fingers reach beyond the tool centre point [m]."""
        ...

    @property
    def palm(self) -> float:
        """How far the palm stands back from the tool centre point [m]."""
        ...

    def lowering(self, half_size: tuple[float, float, float]) -> float:
        """How far an object of a size [m] may be let down from where it is released [m].

        Further, the hand itself would meet the board.
        """
        ...

    @property
    def hover_turns(self) -> tuple[float, float]:
        """Least and greatest turn of the end effector about the vertical there [rad]."""
        ...

    def hover(self) -> Pose:
        """End effector above the middle of the table."""
        ...

    def hover_joints(self) -> Float[Tensor, " joints"]:
        """Joint positions there [rad]."""
        ...

    def hover_postures(self) -> Sequence[Float[Tensor, " joints"]]:
        """Several joint positions there, the preferred ones first [rad]."""
        ...

    def home_joints(
        self, offset: Float[Tensor, "3"] | None = None, q7_offset: float = 0.0
    ) -> Float[Tensor, " joints"]:
        """Joint positions at home, where a placing motion starts [rad].

        Args:
            offset: Of the end effector from home [m].
            q7_offset: Change of joint 7, which moves the elbow about the line to the wrist
                [rad].

        Raises:
            UnreachableError: If no joint positions reach it.
        """
        ...

    def object_region(self) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        """Box in which objects may be on the table: centre and half edges [m]."""
        ...

    def shelf(self, name: str, half_size: tuple[float, float, float] | None = None) -> Pose:
        """End effector where it releases an object of a size [m] on a shelf.

        Raises:
            ValueError: If there is no such shelf.
        """
        ...


@runtime_checkable
class Collision(Protocol):
    """A contact that a planned path would make."""

    @property
    def first(self) -> str:
        """What moves."""
        ...

    @property
    def second(self) -> str:
        """What it meets."""
        ...

    @property
    def start(self) -> float:
        """Number of the first sample of the path in contact."""
        ...

    @property
    def depth(self) -> float:
        """Deepest penetration [m]."""
        ...


@runtime_checkable
class CollisionChecker(Protocol):
    """A geometric model of the workplace."""

    def collisions_along(
        self, path: Float[np.ndarray, "steps joints"], carried: str | None = None
    ) -> Sequence[Collision]:
        """Contacts along a path of joint positions [rad], with an object carried along."""
        ...


# The control loop.
