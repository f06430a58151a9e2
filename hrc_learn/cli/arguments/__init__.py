"""Command lines of the commands: what can be asked for, known without importing how.

Nothing here imports torch, numpy, a simulator or a file format when it is imported. Choices are
written out, so that a mistyped one is found before any work; tests hold each to its source.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Suppress

from hrc_learn.cli._options import Detail, More

Configuration = Annotated[Any, Suppress]
"""Type of an option that has a `Detail` for default."""

Shelf = Literal["lower", "middle", "upper"]
"""Of `hrc_learn.sim.workplace.Workplace`."""
Camera = Literal["auto", "egl", "synthetic"]
"""`hrc_learn.sim.CameraKind`."""
ArmDriver = Literal["sim", "franky", "franka"]
"""The simulated arm itself, and `hrc_learn.experiments.on_arm.Driver`."""
Channel = Literal["joint", "position", "orientation", "pose"]
"""Keys of `hrc_learn.learning.channels.CHANNELS`."""
Scaling = Literal["none", "paper", "amplitude", "rotation"]
"""Keys of `hrc_learn.dmp.forcing_scale.SCALINGS`."""
Variant = Literal["learned", "unadapted", "kalman", "composite", "paper", "fixed", "none"]
"""Keys of `hrc_learn.experiments.grasping.experiment.VARIANTS`, and none of them."""
WayMaking = Literal["none", "expert", "automatic", "both"]
"""`hrc_learn.experiments.collaboration.worker_study.MODES`."""
Experiment = Literal[
    "near",
    "global",
    "fixed",
    "jacobian_0.3",
    "jacobian_3",
    "row_flipped",
    "rows_swapped",
    "noise",
    "latency",
    "slow_camera",
    "tilt",
    "marker_lost",
    "effort",
    "effort_noise",
    "faulty_images",
    "encoder_noise",
    "encoder_noise_unknown",
    "composite",
    "least_squares",
    "broyden",
    "corners",
    "paper",
    "literal",
    "unmixed",
    "printed",
    "printed_fixed",
    "printed_kalman",
    "printed_z",
    "literal_box",
    "unmixed_box",
    "printed_box",
    "box_fixed",
    "box_gain_1e7",
    "box_gain_1e8",
    "box_kalman",
    "box_global",
    "mujoco_near",
    "mujoco_literal",
    "mujoco_printed",
    "mujoco_kalman",
    "stress",
    "stress_nan",
    "stress_late",
    "stress_lost",
    "stress_1khz",
    "stress_poison",
    "stress_plant",
    "stress_plant_worse",
]
"""Keys of `controller_experiments.EXPERIMENTS`."""


def beside(dataset: Path, what: str) -> Path:
    """The folder DATASET_what; "." and ".." go by their true name."""
    named = dataset if dataset.name not in ("", "..") else dataset.resolve()
    return named.with_name(f"{named.name}_{what}")


@dataclass(frozen=True, kw_only=True)
class OfRobot:
    """A command that some arm carries out."""

    robot: str = "panda"
    """Arm by its name, or its URDF or MJCF file."""
    base: More[str] = ""
    """Link of such a file that is the arm's base; its root when not given."""
    tip: More[str] = ""
    """Link of such a file that is the arm's flange; its only end when not given."""


@dataclass(frozen=True, kw_only=True)
class Measured:
    """A command that measures something."""

    json: Path | None = None
    """Receives the measured values as one flat object of numbers."""


@dataclass(frozen=True, kw_only=True)
class Led:
    """A command that leads an arm."""

    arm: ArmDriver = "sim"
    """Driver of a real arm, or the simulated one. "franky" is the package of that name,
    "franka" our own loop at 1 kHz (docs/hardware.md)."""
    ip: More[str] = ""
    """Address of the arm, for a driver; "sim" serves the simulated one there."""
    site: Configuration = Detail("hrc_learn.experiments.on_arm", "ArmSite")
    """The real arm, and what it stands before."""


@dataclass(frozen=True, kw_only=True)
class Written(Measured):
    """A command that writes a folder of results."""

    overwrite: bool = False
    """Replace an older result in that folder."""
