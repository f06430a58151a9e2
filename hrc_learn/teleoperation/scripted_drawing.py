"""A scripted person who draws regions, marks targets and turns the end effector."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hrc_learn.protocols import ArmState, DrawnRegion, Human, HumanInput


@dataclass(frozen=True, kw_only=True)
class DrawnInterval:
    """What is drawn during an interval.

    Raises:
        ValueError: If it has no duration.
    """

    start: float
    """[s]"""
    duration: float
    """[s]"""
    region: DrawnRegion | None = None
    """None: none."""
    target: tuple[float, float, float] | None = None
    """Point marked for the end effector, in the base frame [m]; None: none."""
    turn: tuple[float, float, float] | None = None
    """Rotation added to the end effector's orientation, as a rotation vector in the base frame
    [rad]; None: none."""

    def __post_init__(self) -> None:
        if not self.duration > 0:
            raise ValueError(f"duration must be positive, but is {self.duration}.")


class ScriptedDrawing(Human):
    """Draws by a script, and does nothing else; also beside others."""

    def __init__(self, script: Sequence[DrawnInterval], joints: int = 7):
        """Prepare.

        Args:
            script: What is drawn when. Where intervals overlap, the first that has a region,
                a target or a turn decides about that.
            joints: Number of joints of the arm.
        """
        self._script, self._still = tuple(script), np.zeros(joints)

    def read(self, state: ArmState) -> HumanInput:
        """What is drawn at the state's time."""
        now = [i for i in self._script if i.start <= state.time < i.start + i.duration]
        return HumanInput(
            nullspace_input=self._still,
            region=next((i.region for i in now if i.region is not None), None),
            target=next((i.target for i in now if i.target is not None), None),
            turn=next((i.turn for i in now if i.turn is not None), None),
        )
