"""Command lines of the commands that move an arm, simulated or real."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

from hrc_learn.cli.arguments import Measured, Written

Shelf = Literal["lower", "middle", "upper"]
"""Shelves of `hrc_learn.sim.workplace.Workplace`."""
ArmDriver = Literal["sim", "franky", "franka"]
"""The simulated arm, and `hrc_learn.experiments.on_arm.Driver`."""


@dataclass(frozen=True, kw_only=True)
class WithRobot(Measured):
    """A command for any arm."""

    robot: str = "panda"
    """Arm by name, or its URDF or MJCF file."""
    tip: str = ""
    """Flange link in such a file, or BASE:TIP. Default: from the root to the only end."""


@dataclass(frozen=True, kw_only=True)
class WithDriver(WithRobot):
    """A command for a simulated or a real arm."""

    arm: ArmDriver = "sim"
    """Driver: simulated, the package franky, or our own loop at 1 kHz (franka)."""
    ip: str = ""
    """Address of the arm's control box. "sim" serves the simulated arm there."""
    config: tuple[str, ...] = ()
    """Further settings as NAME=VALUE or TOML files, such as site.speed=0.1. `--config help`
    lists them."""

    def drives_real_arm(self, simulated_only: Sequence[str] = ()) -> bool:
        """True if the command moves a real arm.

        Args:
            simulated_only: Options that only the simulated work cell has.

        Raises:
            ValueError: An address without a driver, a driver without an address, or an option
                of the simulated work cell.
        """
        if self.arm == "sim":
            if self.ip:
                raise ValueError(
                    f"--ip {self.ip} needs a driver: --arm franky or --arm franka."
                )
            return False
        if self.ip == "sim":
            return False
        if not self.ip:
            raise ValueError(
                f"--arm {self.arm} needs --ip with the address of the arm's control box; "
                "--ip sim serves the simulated arm there."
            )
        defaults = {field.name: field.default for field in fields(self)}
        if given := [name for name in simulated_only if getattr(self, name) != defaults[name]]:
            option = given[0].replace("_", "-")
            raise ValueError(f"--{option} is for simulated arms, not for a real one (--ip).")
        return True


@dataclass(frozen=True, kw_only=True)
class WithImperfections(Measured):
    """A command for the simulated work cell."""

    imperfections: float = 1.0
    """Scale of the errors of arm, camera, calibration and objects. 1: nominal."""
    ideal: bool = False
    """No imperfections, as --imperfections 0."""


@dataclass(frozen=True, kw_only=True)
class Demo(WithImperfections, WithRobot, Written):
    """Run the whole job in simulation: demonstrate, learn, grasp, place.

    Records demonstrations, fits a movement primitive and an image Jacobian, then grasps a box
    with an uncalibrated camera while a scripted person pulls the elbow aside, and places it on
    a shelf. Demonstrations and models in the folder are kept if they are up to date. Exit
    status 1 if the job failed or a target was missed.
    """

    out: Path = Path("outputs/demo")
    """Folder for demonstrations, models and the run."""
    shelf: Shelf = "middle"
    """Shelf for the object. The middle one is demonstrated."""
    seed: int = 0
    """Seed of the object's place and of image noise."""
    overwrite: bool = False
    """Record and learn again, even if models are up to date."""


@dataclass(frozen=True, kw_only=True)
class Run(WithImperfections, WithDriver, Written):
    """Run one of the paper's experiments: placing, grasping or collaboration.

    Placing repeats a demonstrated motion for other shelves. Grasping uses an uncalibrated
    camera that was moved after the demonstrations. Collaboration is the whole job near a
    person. Writes Rerun recordings, a report and the measured values. Exit status 1 if
    the run failed or a target was missed.

        hrc run collaboration --trials 10 --pulls random --worker
        hrc run grasping --config experiment.scene.random_camera=true
    """

    experiment: Literal["placing", "grasping", "collaboration"]
    """Experiment to run."""
    out: Path | None = None
    """Folder for recordings, report and measured values. Default: outputs/EXPERIMENT."""
    placing: Path | None = None
    """Folder of `hrc fit` on demonstrations of placing. Default: that of `hrc demo`, which is
    made first if it is missing."""
    aiming: Path | None = None
    """Folder of `hrc fit image-jacobian`. Default: that of `hrc demo`."""
    seed: int = 0
    """Seed of the run, and the first one of its trials."""
    trials: int = 0
    """Number of repetitions with random conditions, for statistics."""
    processes: int = 1
    """Processes that run the trials."""
    camera: str = "auto"
    """Simulated camera: "egl" renders, "synthetic" only draws markers, "auto" renders if it
    can. For a real arm: device number or path, URL of a stream, or a video file."""
    shelf: tuple[Shelf, ...] = ("middle",)
    """Shelf for the object. Two or three shelves: as many objects."""
    pulls: Literal["scripted", "random", "none"] = "scripted"
    """Pulls at the elbow: while the arm waits for them, at random moments, or never."""
    camera_moved: bool = False
    """Move and turn the camera between two objects."""
    worker: bool = False
    """Simulate a worker who puts an object on the table and reaches under the arm."""
    handover: bool = False
    """A person hands over the last object."""
    page: bool = False
    """Serve a page to watch, draw targets and pull at the elbow."""
    serve: bool = False
    """Serve the dashboard in the browser during the run."""
    film: bool = True
    """Make a film of the run."""


@dataclass(frozen=True, kw_only=True)
class Record(WithRobot, Written):
    """Record demonstrations by a scripted expert in simulation.

    Placing carries an object to a shelf, the elbow pulled past the cabinet's door. Servoing
    moves the marked end effector above an object, watched by an uncalibrated camera. Expert
    records the columns of LeRobot's robots, for its policies.
    """

    scenario: Literal["placing", "servoing", "expert"]
    """Demonstrations to record."""
    out: Path
    """Folder of the new dataset."""
    episodes: int | None = None
    """Number of demonstrations. Default: 3 of placing, 8 of servoing, 10 of the expert."""
    seed: int | None = None
    """Seed of initial positions, tremor and image noise. Default: 0, of servoing 1."""
    shelf: Shelf = "middle"
    """Shelf to place on."""
    camera: Literal["auto", "egl", "synthetic"] = "synthetic"
    """Camera for servoing: "egl" renders, "synthetic" only draws markers."""
    task: Literal["placing", "grasping"] = "placing"
    """Task of the expert."""
    config: tuple[str, ...] = ()
    """Further settings as NAME=VALUE or TOML files, such as demonstration.duration=5 or
    robot.fps=10. `--config help` lists them."""


@dataclass(frozen=True, kw_only=True)
class ServePage(WithDriver):
    """Guide the arm in a browser and record demonstrations.

    Open the printed address in a browser, the other one in a headset or on a phone. Drag a link
    to move the arm in its null space, drag the end effector's gizmo to move the tool. Ends with
    "Finish", Ctrl-C or after --duration, and leaves a LeRobot dataset of the saved
    demonstrations.
    """

    out: Path
    """Folder of the new dataset, which must not exist."""
    port: int | None = None
    """Port of the page. Default: the first free one from 8080."""
    host: str = "127.0.0.1"
    """Address to serve at. 0.0.0.0 serves the network, by TLS and with a token."""
    task: str = "put the object on the middle shelf"
    """Task in words. It can be changed on the page."""
    device: Literal["none", "gamepad", "keyboard", "haptic"] = "none"
    """Additional device that moves the end effector."""
    duration: float | None = None
    """End after this time [s]."""


@dataclass(frozen=True, kw_only=True)
class Serve(WithDriver):
    """Run the controller at a fixed rate and report its latency.

    The arm servoes to a marker that a simulated camera sees at 31 Hz; a real arm does move.
    Reported are the time from reading the joints to the command, the delay of each tick, and
    the ticks that were missed.
    """

    duration: float = 8.0
    """Duration [s]."""
    rate: float = 500.0
    """Control rate [1/s]."""
    step: Literal["fastest", "eager"] = "fastest"
    """Compile the step ahead of time if there is a C++ compiler, or do not. The first start
    compiles, in a minute or two."""
