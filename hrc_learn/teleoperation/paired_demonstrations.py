"""A person leads the arm while it is recorded, and what was recorded becomes a LeRobot
dataset.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from hrc_learn.demos import DatasetWriter
from hrc_learn.kinematics import panda
from hrc_learn.protocols import Human
from hrc_learn.sim import World
from hrc_learn.store import DATASET, replacing
from hrc_learn.teleoperation.hand_guiding import Frame, LedArm, LedArmConfig

# Demonstrations of the Panda as a LeRobot dataset.


def write_lessons(
    path: Path,
    lessons: Iterable[Sequence[Frame]],
    task: str,
    fps: float,
    *,
    features: Mapping[str, Sequence[str]] | None = None,
    details: Mapping[str, object] | None = None,
    overwrite: bool = False,
) -> None:
    """Write demonstrations, one episode each, as they come.

    Args:
        path: Folder of the dataset.
        lessons: Frames of each demonstration.
        task: What is shown, in words.
        fps: Frames a second.
        features: Columns beyond the usual ones: key, and names of the components.
        details: Anything else worth keeping with the dataset.
        overwrite: Replace an older dataset in that folder.

    Raises:
        FileExistsError: If there is something at `path` that may not be replaced.
    """
    with (
        replacing(path, DATASET, overwrite) as folder,
        DatasetWriter(
            folder,
            fps=fps,
            robot_type="panda",
            joint_names=panda.joint_names,
            features=features,
            frames={"base": "panda_link0", "ee": "panda_hand_tcp"},
            details=details,
        ) as writer,
    ):
        for frames in lessons:
            writer.start_episode(task)
            for frame in frames:
                writer.add_frame(images=None, **frame)
            writer.save_episode()


# Letting a person lead the arm while it is recorded.


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
