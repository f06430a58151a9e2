"""Several sources of a person's input at once, and the filter that bounds the
acceleration of what they ask.
"""

from dataclasses import dataclass, replace

import numpy as np

from hrc_learn.protocols import ArmState, Human, HumanInput
from hrc_learn.teleoperation.interaction_force import capped

# Several sources of a person's input at once, as the paper's mixed interface has two.


class BothHands:
    """One hand leads the end effector by a device, the other the body in the browser.

    Efforts and motions add up. Of what is asked for otherwise, the first source that says
    anything is heard; requests of all are.
    """

    def __init__(self, *sources: Human):
        """Join them.

        Raises:
            ValueError: There are none.
        """
        if not sources:
            raise ValueError("a person needs at least one source of input.")
        self._sources = sources

    def read(self, state: ArmState) -> HumanInput:
        """What all sources ask for together."""
        inputs = [source.read(state) for source in self._sources]
        first, *others = inputs
        return HumanInput(
            effort=sum((other.effort for other in others), first.effort),
            twist=sum((other.twist for other in others), first.twist),
            gripper=next((i.gripper for i in inputs if i.gripper is not None), None),
            region=next((i.region for i in inputs if i.region is not None), None),
            target=next((i.target for i in inputs if i.target is not None), None),
            requests=tuple(request for i in inputs for request in i.requests),
        )


# A hand that is led starts and stops within bounds of its acceleration.


@dataclass(frozen=True, kw_only=True)
class EasingConfig:
    """How fast the motion of the hand may change."""

    linear: float = 1.5
    """[m/s^2]: from rest to a handle's full speed, and back, in a sixth of a second."""
    angular: float = 5.0
    """[rad/s^2]"""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"{name} must be positive, but is {value}.")


class Eased:
    """Hands on what a person asks for, with the motion of the hand eased.

    A key asks for full speed at once, and a handle that is let go for none: an arm that obeyed
    would jerk, and so would what is learned from it.
    """

    def __init__(self, human: Human, config: EasingConfig | None = None):
        """Start with a hand at rest.

        Args:
            human: The person.
            config: How fast the motion may change.
        """
        self._human, self._config = human, config or EasingConfig()
        self._twist, self._time = np.zeros(6), np.inf

    def read(self, state: ArmState) -> HumanInput:
        """What the person asks for now."""
        asked, config = self._human.read(state), self._config
        dt = max(state.time - self._time, 0.0)
        change = asked.twist - self._twist
        self._time = state.time
        self._twist = self._twist + np.concatenate(
            [capped(change[:3], config.linear * dt), capped(change[3:], config.angular * dt)]
        )
        return replace(asked, twist=self._twist)
