"""Several sources of human input at once, and a filter that bounds its acceleration."""

from dataclasses import dataclass, replace

import numpy as np

from hrc_learn.protocols import ArmState, Human, HumanInput
from hrc_learn.teleoperation.interaction_force import capped


class CombinedInput:
    """Joins several sources, as the paper's mixed interface has a haptic device and a headset.

    Null-space inputs and twists add up. Of gripper, region and target the first source that
    sets them is used; requests of all are passed on.
    """

    def __init__(self, *sources: Human):
        """Join them.

        Raises:
            ValueError: There are none.
        """
        if not sources:
            raise ValueError("a combined input needs at least one source.")
        self._sources = sources

    def read(self, state: ArmState) -> HumanInput:
        """What all sources ask for together."""
        inputs = [source.read(state) for source in self._sources]
        return HumanInput(
            nullspace_input=np.sum([i.nullspace_input for i in inputs], axis=0),
            twist=np.sum([i.twist for i in inputs], axis=0),
            gripper=next((i.gripper for i in inputs if i.gripper is not None), None),
            region=next((i.region for i in inputs if i.region is not None), None),
            target=next((i.target for i in inputs if i.target is not None), None),
            requests=tuple(request for i in inputs for request in i.requests),
        )


@dataclass(frozen=True, kw_only=True)
class InputFilterConfig:
    """Bounds on the acceleration of the end effector."""

    linear: float = 1.5
    """[m/s^2]: from rest to a gizmo's full speed, and back, in a sixth of a second."""
    angular: float = 5.0
    """[rad/s^2]"""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"{name} must be positive, but is {value}.")


class InputFilter:
    """Passes human input on with the acceleration of the end effector bounded.

    A key that is pressed asks for full speed at once, and a gizmo that is released for none:
    unfiltered, the arm would jerk, and so would what is learned from it.
    """

    def __init__(self, human: Human, config: InputFilterConfig | None = None):
        """Start at rest.

        Args:
            human: Source of the input.
            config: Bounds.
        """
        self._human, self._config = human, config or InputFilterConfig()
        # The first reading has no predecessor: an infinite time makes its dt zero below.
        self._twist, self._time = np.zeros(6), np.inf

    def read(self, state: ArmState) -> HumanInput:
        """The filtered input now."""
        human_input, config = self._human.read(state), self._config
        dt = max(state.time - self._time, 0.0)
        change = human_input.twist - self._twist
        self._time = state.time
        self._twist = self._twist + np.concatenate(
            [capped(change[:3], config.linear * dt), capped(change[3:], config.angular * dt)]
        )
        return replace(human_input, twist=self._twist)
