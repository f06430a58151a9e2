"""How fast a task goes on: people near the arm slow it down, who leads it may pause it."""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hrc_learn.controller import ConstraintReport, Distances, SafetyConfig
from hrc_learn.skills.failures import TaskFailedError
from hrc_learn.skills.null_space_yielding import CHANGE_OF_RATE, changed_rate

# Part of the task that constraints take beyond rounding.
_SLOWED = 1e-3
# How much faster the arm might close in on people who do not hold it back [m/s]: what the
# program leaves unused is rounding. And pace below which it stands still.
_SPARE, _STANDS = 1e-3, 0.01


class TaskPace:
    """Shares of its speed that people leave the task, and the clock that runs by them.

    Attributes:
        time: The clock without what the task waited for people, or was paused by them [s].
        beside_people: Share of the wanted motion that people near the arm leave.
        led: Share of it that the person who leads the arm leaves: the task's own speed, or
            less while they pause it.
    """

    def __init__(self, *, time: float, dt: float, speed: float, longest_wait: float):
        """Begin at full pace.

        Args:
            time: Of the clock [s].
            dt: Control step [s].
            speed: Share of its speed that the task is done with.
            longest_wait: For which the arm stands still before somebody [s].
        """
        self._dt, self._speed, self._longest_wait = dt, speed, longest_wait
        self.time, self.beside_people, self.led = time, 1.0, speed
        self._stood = 0.0  # before somebody, at a stretch [s]

    @property
    def share(self) -> float:
        """Of its speed that the task has now."""
        return self.beside_people * self.led

    @property
    def undisturbed(self) -> bool:
        """Whether nobody slows the task down or pauses it."""
        return self.beside_people == 1 and self.led == self._speed

    def beside(self, share: float) -> None:
        """One step in which people near the arm left so much of the wanted motion.

        Raises:
            TaskFailedError: Somebody has been in the way for too long.
        """
        # It may drop at once; it rises as paths get under way.
        self.beside_people = min(share, self.beside_people + self._dt / CHANGE_OF_RATE)
        self.time += self.share * self._dt
        self._stood = self._stood + self._dt if self.beside_people < _STANDS else 0.0
        if self._stood > self._longest_wait:
            raise TaskFailedError(
                f"somebody has been in the way of the arm for {self._stood:.0f} s: free its "
                "way, or let it wait longer (longest_wait)."
            )

    def lead(self, pause: bool, tell: Callable[[str], None]) -> None:
        """One step of a person who leads the arm; what becomes of a pause is told them."""
        if pause and self.led == self._speed:
            tell("The task waits.")
        led = min(float(changed_rate(self.led, float(not pause), self._dt)), self._speed)
        if led == self._speed and self.led < self._speed:
            tell("The task goes on.")
        self.led = led


def people_bind(
    distances: Distances,
    sent: Float[Tensor, "*batch joints"],
    kept: ConstraintReport,
    safety: SafetyConfig,
) -> Bool[Tensor, "*batch"]:
    """Whether the arm was slowed down as it came as near to people as it may, or as it does not
    know where they are.

    Where only its own limits hold it back, a path must go on: it would wait for ever.

    Args:
        distances: From people.
        sent: To the arm [rad/s].
        kept: What keeping its limits took.
        safety: Of the filter, with constraints.
    """
    near = at_people(distances, sent, safety)
    return ~distances.known() | ~kept.solved | ((kept.slowed > _SLOWED) & near)


def at_people(
    distances: Distances, sent: Float[Tensor, "*batch joints"], safety: SafetyConfig
) -> Bool[Tensor, "*batch"]:
    """Whether a velocity takes the arm towards people as fast as it may.

    Args:
        distances: From people.
        sent: To the arm [rad/s].
        safety: Of the filter, with constraints.
    """
    assert safety.constraints is not None  # without them there are no limits to be met
    allowed = distances.closing_speed(safety.constraints, safety.separation)
    opening = torch.linalg.vecdot(distances.gradient, sent.unsqueeze(-2))
    return (allowed + opening <= _SPARE).any(-1)
