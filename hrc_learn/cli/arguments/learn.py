"""Command lines of the commands that learn from demonstrations and measure what was learned."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from hrc_learn.cli._options import Detail, More
from hrc_learn.cli.arguments import (
    Channel,
    Configuration,
    Measured,
    OfRobot,
    Scaling,
    Written,
    beside,
)


@dataclass(frozen=True, kw_only=True)
class Fit(Written):
    """Where demonstrations are, and where the model goes."""

    dataset: Path
    """LeRobot dataset with the demonstrations."""
    out: Path | None = None
    """Folder for the model. DATASET_model when not given."""
    episodes: tuple[int, ...] = ()
    """Episodes to learn from; all when empty."""
    verbose: More[bool] = False
    """Show all that was measured, not just what matters first."""

    @property
    def folder(self) -> Path:
        """Where the model is written."""
        return self.out or beside(self.dataset, "model")


@dataclass(frozen=True, kw_only=True)
class FitPrimitives(Fit):
    """Fit movement primitives to the demonstrations of a LeRobot dataset.

    Learns the motion of the joints, of any robot, and that of the end effector where its pose
    is recorded. Several demonstrations give one primitive each and what they have in common:
    their mean, their distribution, a function of a context, or one primitive fitted to all of
    them in one pass. Writes a folder with the primitives, the measured errors, demonstrations
    beside reproductions as figures and a Rerun recording, and what it was made from.
    """

    channels: tuple[Channel, ...] = ()
    """What to learn; joint and pose, or what there is of them, when empty."""
    several: Literal["best", "mean", "distribution", "contextual", "streamed"] = "best"
    """What to keep of several demonstrations. Their mean and, of joints and positions, whatever
    predicts held-out ones clearly better: a function of start and goal, or the nearest of
    them. Their mean alone; all of them as well, which a DMPDistribution is made of; a
    primitive for every context; or one fitted to all in one pass, one demonstration in memory
    at a time, and under torchrun in several processes."""
    context: More[tuple[str, ...]] = ()
    """Columns whose first row is the context; start and goal when empty."""
    n_basis: int | None = 60
    """Number of basis functions; None: chosen by the error on samples held out."""
    method: Literal["trajectory", "ridge", "lwr"] = "trajectory"
    """Least squares on the motion, ridge regression on its force, or the paper's locally
    weighted regression."""
    robust: More[Literal["huber", "tukey"] | None] = None
    """Trust samples that lie far off less."""
    scaling: More[Scaling] = "none"
    """How forcing scales with start and goal."""
    joint_names: More[tuple[str, ...]] = ()
    """Joints to learn, by name and in this order; all when empty."""
    units: More[dict[str, str]] = field(default_factory=dict)
    """Units on disk by quantity, such as: joint_position deg position mm."""
    mapping: More[dict[str, str]] = field(default_factory=dict)
    """Columns by quantity where they are not found, such as: joint_position action[0:7]."""
    keep_contract: More[bool] = True
    """Keep what the columns mean in DATASET/meta/hrc_learn.json, where nothing says it yet."""
    as_lerobot_policy: bool = False
    """Write the folder of a trained LeRobot policy instead, of type dmp: from observations to
    the dataset's own actions, joints or the end effector, in closed form."""
    seed: int = 0
    """Of whatever is drawn at random."""


@dataclass(frozen=True, kw_only=True)
class FitImageJacobian(Fit):
    """Fit the image Jacobian of an uncalibrated camera to demonstrations.

    Learns how the image of the marker moves with the end effector, as a radial basis function
    network over the workspace, with its uncertainty; and, where an object was watched, where
    that image should be to stand right above it. Neurons, noise and prior are learned by the
    gradient of the evidence until demonstrations held out say stop. Writes the model, the
    measured errors, figures of them and a Rerun recording of how learning converged. Under
    torchrun each process reads its share of the demonstrations.
    """

    neurons: Literal["around", "grid"] = "around"
    """Thirteen over the whole pose, placed about what was demonstrated; or a grid that
    sees x and y, as in the paper."""
    x: More[tuple[float, float, int]] = (0.05, 0.35, 3)
    """Of a grid: first and last centre along x [m], and how many (paper, Table I)."""
    y: More[tuple[float, float, int]] = (0.35, 0.65, 3)
    """Of a grid: along y."""
    width: More[float] = 0.1
    """Of a grid: standard deviation of a neuron [m]."""
    learn: bool = True
    """Whether neurons, noise and prior are learned. Needs --learning.hold-out demonstrations,
    fewer are fitted without."""
    learning: Configuration = Detail("hrc_learn.jacobian", "EvidenceConfig")
    """How they are learned."""
    fit: Configuration = Detail("hrc_learn.jacobian", "ImageJacobianFitConfig")
    """What is compared, and what is believed before; where learning starts."""


@dataclass(frozen=True, kw_only=True)
class EvaluatePrimitives(Written):
    """Evaluate fitted movement primitives on demonstrations, such as those held out.

    Each demonstration is predicted by the common primitive of `hrc fit`, told its start, goal
    and duration. Prints error, goal error, smoothness and orientation error of the eight worst
    demonstrations, and writes figures of all. Without a model, primitives are fitted to four of
    every five demonstrations first, and evaluated on the others. Exit status 1 if --most-nrmse
    was missed.
    """

    model: Path | None = None
    """Folder of `hrc fit`. Fitted to four of every five demonstrations when not given."""
    dataset: Path
    """LeRobot dataset with the demonstrations."""
    out: Path | None = None
    """Folder for figures and measured values; none are kept without."""
    episodes: tuple[int, ...] = ()
    """Episodes to evaluate on; when empty those that were not learned from, or all."""
    units: More[dict[str, str]] = field(default_factory=dict)
    """Units on disk by quantity; those the model was fitted with when empty."""
    mapping: More[dict[str, str]] = field(default_factory=dict)
    """Columns by quantity; those the model was fitted with when empty."""
    most_nrmse: float | None = None
    """Largest median error that passes."""
    verbose: More[bool] = False
    """Print every demonstration, not just the worst."""


@dataclass(frozen=True, kw_only=True)
class EvaluateImageJacobian(Measured):
    """Measure a learned image Jacobian against the truth, which the simulator knows.

    For models of `hrc fit image-jacobian` from demonstrations of `hrc record servoing`. Prints
    the error against the true Jacobian on a grid inside the demonstrated workspace, how honest
    its uncertainty is, and how much sooner the marker reaches its target than from the
    paper's fixed initial Jacobian, over many starts and with the camera turned by any angle.
    Exit status 1 if a target was missed.
    """

    model: Path
    """Folder of `hrc fit image-jacobian`."""
    dataset: Path
    """The demonstrations it was learned from."""
    tilt: float = 0.1
    """Of the end effector, in the second of two grids [rad]; the first has it pointing down."""
    closed_loop: bool = True
    """Whether to run the closed loops, which take a minute or more."""
    starts: Configuration = Detail("hrc_learn.experiments.jacobian_evaluation", "StartsConfig")
    """How starts are drawn."""


@dataclass(frozen=True, kw_only=True)
class Tune(OfRobot, Written):
    """Tune gains of the controller: the marker sooner at its target, in simulation.

    Searches the gains over a batch of closed loops against the workplace's camera, turned by
    any angle: the same starts, targets and noise for all gains that are compared, others for
    the final figures. The search is by an evolution strategy: times to a target have kinks, and
    the caps that matter most have no gradient where they do not bind. Writes gains.json, which
    `hrc run collaboration` takes as --gains, the figures, and the way there. An interrupted
    search goes on with --resume.
    """

    out: Path
    """Folder for the gains."""
    generations: int = 12
    """Rounds of the search."""
    population: int = 8
    """Gains tried in each."""
    starts: Configuration = Detail(
        "hrc_learn.experiments.jacobian_evaluation", "StartsConfig", {"count": 48}
    )
    """How closed loops are drawn; their seed is that of the search."""
    held_out_seed: int = 1000
    """Seed of the closed loops of the final figures."""
    resume: bool = False
    """Go on from OUT.search.json, which an interrupted search leaves."""


@dataclass(frozen=True, kw_only=True)
class Smooth(Measured):
    """Let a trained LeRobot policy's actions be smoothed: any policy, wherever it is run.

    Adds two steps to the processors of a checkpoint. They keep actions within limits of
    position, velocity, acceleration and jerk, and blend the seams between chunks. The limits
    are how abruptly the demonstrators of its dataset moved. Weights stay as they are; --remove
    takes the steps out. With --limits they are also written to a file, for a robot of
    `--robot.type=smooth`, which leads any other at the rate of its motors.
    """

    checkpoint: Path | None = None
    """Folder `pretrained_model` of the checkpoint; None: only --limits are written."""
    dataset: Path | None = None
    """LeRobot dataset it was trained on; not needed to remove the steps."""
    share: float = 1.0
    """Share of the demonstrators' velocity, acceleration and jerk to allow."""
    urdf: Path | None = None
    """Positions and velocities of the joints that it names, beside the demonstrators'."""
    calibration: Path | None = None
    """LeRobot's calibration of the robot: the positions that its motors were moved through."""
    degrees: bool = False
    """Actions are in degrees, where there is a URDF or a calibration; else in radians, or
    percent of what was calibrated."""
    limits: Path | None = None
    """Receives the limits, as a file for --robot.limits of a `smooth` robot."""
    remove: bool = False
    """Take the steps out again."""
