"""Command lines of `hrc record`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from hrc_learn.cli._options import Detail, More
from hrc_learn.cli.arguments import (
    Camera,
    Configuration,
    Led,
    Measured,
    OfRobot,
    Shelf,
    Written,
)


@dataclass(frozen=True, kw_only=True)
class RecordPlacing(OfRobot, Led, Written):
    """Record demonstrations of placing an object on a shelf, with the null-space posture.

    The scripted expert guides the simulated arm from home into the cabinet while pulling its
    elbow past the open door. Demonstrations that touch the cabinet are discarded and
    repeated. Writes a LeRobot dataset of version 3.0.
    """

    out: Path
    """Folder of the new dataset."""
    episodes: int = 3
    """Demonstrations to record."""
    shelf: Shelf = "middle"
    """Shelf to place on."""
    demonstration: Configuration = Detail(
        "hrc_learn.teleoperation.scripted_demonstrations", "PlacingDemonstrationConfig"
    )
    """How the expert demonstrates."""
    seed: int = 0
    """Seed of the tremor and of initial positions."""


@dataclass(frozen=True, kw_only=True)
class RecordServoing(OfRobot, Led, Written):
    """Record demonstrations of visual servoing to an object by an uncalibrated camera.

    The scripted expert moves the marked end effector over the table and ends right above an
    object. The camera's pose and lens are in none of the columns. Writes a LeRobot dataset of
    version 3.0.
    """

    out: Path
    """Folder of the new dataset."""
    episodes: int = 8
    """Demonstrations to record."""
    camera: Camera = "synthetic"
    """Camera: rendered by "egl", or "synthetic", which draws the markers only but is fast."""
    demonstration: Configuration = Detail(
        "hrc_learn.teleoperation.scripted_demonstrations", "ServoDemonstrationConfig"
    )
    """How the expert demonstrates."""
    seed: int = 1
    """Seed of objects, paths and image noise."""


@dataclass(frozen=True, kw_only=True)
class RecordExpert(OfRobot, Measured):
    """Record the scripted expert on LeRobot's simulated arm, in simulated time.

    Writes what lerobot-record would write with --robot.type=mujoco_arm and
    --teleop.type=arm_expert, but waits for no clock: every episode is shown to its end, as
    fast as the machine can. Demonstrations that fail are shown again.
    """

    out: Path
    """Folder of the new dataset; must not exist."""
    scenario: Literal["placing", "grasping"] = "placing"
    """What is shown."""
    shelf: Shelf = "middle"
    """Where to place."""
    episodes: int = 10
    """Demonstrations to write."""
    fps: int = 20
    """Frames a second."""
    action_space: Literal["joint", "ee"] = "joint"
    """What actions give: positions of the joints, or of the end effector."""
    pixels: More[bool] = True
    """Whether the pixel of the object to grasp is observed."""
    marker: More[bool] = False
    """Whether pose and marker of the tool are observed too, by which a moved camera is
    noticed."""
    seed: int = 0
    """Of the first initial configuration; each one after has the next."""
