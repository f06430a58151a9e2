"""Letting a person lead the arm while it is recorded."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from ..kinematics import panda
from ..protocols import Human
from ..sim import World
from .led_arm import Frame, LedArm, LedArmConfig


@dataclass(frozen=True, kw_only=True)
class TeachingConfig:
    """How an arm is led."""

    tremor: float = 4e-4
    """Amplitude of the hand's tremor [m]."""
    settle: float = 1.0
    """Rest at the end of a demonstration [s]."""
    dt: float = 0.01
    """Control step [s]."""
    record_every: int = 2
    """Control steps from one recorded frame to the next."""
    damping: float = 3.0
    """c_d [N m s/rad]."""

    def __post_init__(self) -> None:
        if not (self.dt > 0 and self.record_every >= 1 and self.damping > 0):
            raise ValueError(
                "dt and damping must be positive and record_every at least 1, but are "
                f"{self.dt}, {self.damping} and {self.record_every}."
            )

    @property
    def fps(self) -> float:
        """Recorded frames a second."""
        return 1.0 / (self.dt * self.record_every)


def teach(
    world: World,
    human: Human,
    duration: float,
    config: TeachingConfig,
    observe: Callable[[], Frame] = dict,
) -> Iterator[Frame]:
    """Let a person lead the arm, and yield what is to be recorded.

    Args:
        world: The workplace, reset to where the demonstration starts.
        human: Gives hand motion and pulls.
        duration: Of the demonstration [s].
        config: How the arm is led.
        observe: Further columns of a frame, asked for when it is taken.

    Yields:
        A frame every `record_every` control steps.
    """
    led = LedArm(panda, world.arm, human, LedArmConfig(dt=config.dt, damping=config.damping))
    for k in range(round(duration / config.dt)):
        instant = led.step()
        if k % config.record_every == 0:
            yield {**instant.frame(), **observe()}
        world.advance(config.dt)
