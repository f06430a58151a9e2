"""A scripted person that draws regions, targets and turns."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from hrc_learn.protocols import ArmState, DrawnRegion, Human, HumanInput


@dataclass(frozen=True, kw_only=True)
class DrawnInterval:
    """Region drawn during an interval."""

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


class ScriptedDrawing(Human):
    """Person that only draws, by a script; can be combined with others."""

    def __init__(self, script: Sequence[DrawnInterval]):
        """Prepare.

        Args:
            script: Intervals with their drawn regions. If intervals overlap, the first that has
                a region, a target or a turn decides about that.
        """
        self._script = tuple(script)

    def read(self, state: ArmState) -> HumanInput:
        """Region drawn at the state's time."""
        now = [i for i in self._script if i.start <= state.time < i.start + i.duration]

        def first(name: str) -> Any:
            found = (getattr(one, name) for one in now)
            return next((value for value in found if value is not None), None)

        return HumanInput(**{name: first(name) for name in ("region", "target", "turn")})
