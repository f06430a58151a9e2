"""What may act on a primitive over a step, besides itself."""

from typing import TypedDict

from hrc_learn.dmp.arrays import ArrayLike


class Influences(TypedDict):
    """Arguments of `JointDMP.step` that an orientation passes on."""

    goal_filter: float | None
    coupling: ArrayLike | None
    """Second derivative added to the error, or to what stands for it, per s^2."""
    slowdown: ArrayLike | None
    amplitude: ArrayLike | None
