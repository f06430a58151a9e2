"""Command lines of all commands.

A command line is a frozen dataclass: each field is an option, and its docstring is the help.
This module imports only the standard library, so a mistyped option is reported at once. Choices
therefore repeat definitions of other modules; tests compare the two.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

Channel = Literal["joint", "position", "orientation", "pose"]
"""Keys of `hrc_learn.learning.primitive_fitting.CHANNELS`."""
Scaling = Literal["none", "paper", "amplitude", "rotation"]
"""Keys of `hrc_learn.dmp.forcing_scale.SCALINGS`."""


def sibling(dataset: Path, suffix: str) -> Path:
    """Folder DATASET_suffix next to a dataset; the dataset may be given as "." or ".."."""
    named = dataset if dataset.name not in ("", "..") else dataset.resolve()
    return named.with_name(f"{named.name}_{suffix}")


def refuse_given(args: Any, names: Iterable[str], reason: str) -> None:
    """Refuse options that differ from their defaults.

    Args:
        args: Arguments of a command.
        names: Fields that must have their defaults.
        reason: End of the message, after the name of the option.

    Raises:
        ValueError: An option was given.
    """
    for field_ in fields(args):
        made = field_.default_factory
        default = field_.default if made is MISSING else made()
        if field_.name in names and getattr(args, field_.name) != default:
            raise ValueError(f"--{field_.name.replace('_', '-')} {reason}")


def refuse_of_others(
    args: Any, kinds: Mapping[str, Sequence[str]], kind: str, command: str
) -> None:
    """Refuse options that do not belong to the chosen kind of a command.

    Args:
        args: Arguments of a command.
        kinds: Kinds that an option belongs to, by the name of its field.
        kind: Chosen kind.
        command: The command, for the message.

    Raises:
        ValueError: An option of another kind was given.
    """
    for name, having in kinds.items():
        if kind not in having:
            refuse_given(args, [name], f"is an option of {command} {', '.join(having)}")


@dataclass(frozen=True, kw_only=True)
class Measured:
    """A command that measures something."""

    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


@dataclass(frozen=True, kw_only=True)
class Written(Measured):
    """A command that writes a folder of results."""

    overwrite: bool = False
    """Replace an older result in that folder."""


@dataclass(frozen=True, kw_only=True)
class OnDataset(Measured):
    """A command that reads a LeRobot dataset."""

    dataset: Path
    """Folder of a LeRobot dataset, version 2.0, 2.1 or 3.0."""


@dataclass(frozen=True, kw_only=True)
class Columns:
    """Meaning of columns of a dataset, for columns whose meaning cannot be detected."""

    units: dict[str, str] = field(default_factory=dict)
    """Units on disk by quantity, such as: joint_position deg position mm. For LeRobot's values
    of -100 to 100, give the calibration: joint_position CALIBRATION.json; hrc repair converts
    them to degrees."""
    mapping: dict[str, str] = field(default_factory=dict)
    """Columns by quantity, such as: joint_position "observation.state[0:7]" gripper none."""


def columns(mapping: Mapping[str, str]) -> dict[str, str | list[str] | None]:
    """Columns by quantity: a feature, a range of a feature, names given as "a,b", or None."""
    texts = {role: text.split(",") if "," in text else text for role, text in mapping.items()}
    return {role: None if text == "none" else text for role, text in texts.items()}


@dataclass(frozen=True, kw_only=True)
class Check(Columns, OnDataset, Written):
    """Check a dataset and list its errors and oddities.

    Every finding names file, episode, frame and column. A table shows the meaning and unit of
    each column. Exit status: 0 no errors, 1 errors in the data, 2 no dataset.
    """

    out: Path | None = None
    """Folder for findings.json, contract.json and metrics.json."""
    strict: bool = False
    """Count warnings as errors in the exit status."""
    full: bool = False
    """Print one line per finding instead of one line per kind of finding."""
    keep_contract: bool = False
    """Store the meaning of the columns in DATASET/meta/hrc_learn.json."""
    robot: str = ""
    """Arm whose kinematics determine the units, given as in `hrc demo` (NAME or FILE). Default:
    the arm of the dataset's robot type."""
    camera: bool = False
    """Also detect between which episodes the camera was moved, from the tool's marker."""


@dataclass(frozen=True, kw_only=True)
class Repair(Columns, OnDataset):
    """Write a repaired copy of a dataset, or complete one that a killed process left.

    By default the copy is trimmed, measured angles are unwrapped and the signs of quaternions
    are made continuous. Commands, grippers and discrete columns stay as they are. The changes
    are listed by episode; the original dataset stays as it is.

    Work that a killed process left unfinished in DATASET or in a folder below it is completed
    first, in place: an interrupted recording becomes a dataset of its saved episodes, and an
    interrupted replacement is completed. If there was such work, a copy is written only with
    --out.

        hrc repair broken repaired
        hrc repair killed_recording
        hrc repair broken repaired --fps 50 --drop bad-episodes --no-videos
    """

    out: Path | None = None
    """Folder of the new dataset, which must not exist. Default: DATASET_repaired."""
    skip: tuple[Literal["trim", "unwrap", "signs", "late"], ...] = ()
    """Default repairs to leave out: trim (rest at both ends), unwrap (full turns of angles),
    signs (of quaternions), late (frames whose time stamp does not increase)."""
    drop: tuple[Literal["bad-frames", "bad-episodes", "repeats"], ...] = ()
    """Additional repairs: drop frames with non-finite values, episodes that cannot be repaired,
    or frames that repeat the previous one for up to 0.1 s."""
    offsets: dict[str, float] = field(default_factory=dict)
    """Angles to add to measured joints [deg], such as: joint_2 2.5 joint_4 -4."""
    fps: float | None = None
    """Resample to this frame rate [1/s]. Default: keep the frames."""
    videos: bool = True
    """Keep the videos. Dropping inner frames or resampling needs --no-videos."""
    dry_run: bool = False
    """List the changes without writing them."""

    @property
    def folder(self) -> Path:
        """Folder of the repaired copy."""
        return self.out or sibling(self.dataset, "repaired")


@dataclass(frozen=True, kw_only=True)
class Merge(Measured):
    """Merge datasets of one robot into a new one, and list their differences.

    Columns are matched by name and converted to the order and units of the first dataset. Tasks
    are matched by their texts. Videos are copied. Datasets that do not match are refused.

        hrc merge monday tuesday --out pour
    """

    datasets: tuple[Path, ...]
    """Folders of two or more LeRobot datasets."""
    out: Path
    """Folder of the new dataset, which must not exist."""
    fps: float | None = None
    """Resample datasets to this frame rate [1/s]. Needs --no-videos."""
    videos: bool = True
    """Keep the videos."""


@dataclass(frozen=True, kw_only=True)
class Curate(OnDataset):
    """Review the episodes of a dataset, the most doubtful first, and keep the good ones.

    Opens a page in the browser with videos and curves. Decisions are stored in
    DATASET.curation.json. The cleaned dataset goes to a new folder. In the terminal:

        hrc curate pour --no-browser
        hrc curate pour --no-browser --reject 3 7 --cut 12 30:410 --write
    """

    out: Path | None = None
    """Folder of the cleaned dataset, which must not exist. Default: DATASET_curated."""
    browser: bool = True
    """Open the page in the browser."""
    port: int | None = None
    """Port of the page. Default: the first free one from 8080."""
    reject: tuple[int, ...] = ()
    """Episodes to leave out."""
    accept: tuple[int, ...] = ()
    """Episodes to keep as they are."""
    cut: dict[int, str] = field(default_factory=dict)
    """Frames of an episode to keep: 12 30:410 keeps frames 30 to 409 of episode 12."""
    write: bool = False
    """Write the cleaned dataset from the stored decisions, without a page."""

    @property
    def folder(self) -> Path:
        """Folder of the cleaned dataset."""
        return self.out or sibling(self.dataset, "curated")


@dataclass(frozen=True, kw_only=True)
class Import(Measured):
    """Convert recordings of any format to a LeRobot dataset.

    Reads .npz, .npy, text tables (.csv, .tsv, .txt), Parquet, HDF5 (ALOHA, robomimic and
    others), zarr, .mat, RLDS, bags of ROS 1 and 2, MCAP, and folders of such files with videos.
    A preview lists the meaning assigned to each field; options or a mapping file correct it.
    Recorded commands become actions.

        hrc import pour.npz --out pour --joints q --time t
        hrc import episode_*.hdf5 --out aloha --fps 50
        hrc import demos.zarr --out set --fps 10 --dry-run --mapping map.json
        hrc import rosbag2_* --out bags
    """

    files: tuple[Path, ...]
    """Recordings to import: files and folders."""
    out: Path | None = None
    """Folder of the new dataset, which must not exist."""
    dry_run: bool = False
    """Show the preview and write no dataset."""
    mapping: Path | None = None
    """Mapping file (JSON or TOML): fields of each quantity, units, images. With --dry-run, a
    file that does not exist is written as a template."""
    joints: tuple[str, ...] = ()
    """Array of joint positions, or its columns."""
    command: tuple[str, ...] = ()
    """Array of commanded joint positions, or its columns. They become the action."""
    gripper: tuple[str, ...] = ()
    """Array or column of the gripper's opening."""
    position: tuple[str, ...] = ()
    """Array of the end effector's position, or its columns."""
    orientation: tuple[str, ...] = ()
    """Array of the end effector's orientation (quaternion, rotation vector, 6D or 4x4), or its
    columns."""
    time: str | None = None
    """Array or column of time stamps."""
    columns: tuple[str, ...] = ()
    """Column names for a .npy file or a table without a header. px py pz and qw qx qy qz form a
    pose, t is time, all others are joints."""
    joint_names: tuple[str, ...] = ()
    """Joint names. Default: those of the columns, or joint1, joint2, ..."""
    units: dict[str, str] = field(default_factory=dict)
    """Units by quantity, such as: joint_position deg position cm time ms."""
    quaternion_order: Literal["wxyz", "xyzw"] = "wxyz"
    """Order of a quaternion's components."""
    duration: float | None = None
    """Duration of each demonstration [s] if there are no time stamps."""
    fps: float | None = None
    """Frame rate [1/s] if there are no time stamps. Bags are reduced to this rate."""
    actions: bool = True
    """If no commands were recorded, use the state of the next frame as the action, because
    LeRobot's policies need actions."""
    robot_type: str = "unknown"
    """Robot type stored in the dataset."""
    task: str | None = None
    """Task in words. Default: the one recorded, or the file's name."""


@dataclass(frozen=True, kw_only=True)
class Show(Measured):
    """Open a run, a fit or the demonstrations of a dataset in Rerun.

    A dataset is shown with its arm in 3D, cameras, gripper, and commands next to measured
    joints. Each episode has its own timeline: select it in the time panel. The arm is given by
    the dataset's robot type, or by --robot.
    """

    dataset: Path
    """Folder of a run, a fit or a dataset, or a recording (.rrd)."""
    out: Path | None = None
    """Write the recording of a dataset to this file (.rrd) instead of opening it."""
    web: bool = False
    """Show it in the browser until Ctrl-C. This is the default without a screen."""
    episodes: tuple[int, ...] = ()
    """Episodes to show. Default: all, but at most 200 episodes or a million frames."""
    robot: str = ""
    """Arm to draw, given as in `hrc demo`. Default: the arm of the dataset's robot type."""


@dataclass(frozen=True, kw_only=True)
class Push(OnDataset):
    """Check a dataset and have LeRobot upload it to the Hugging Face Hub with a dataset card.

    Creates the repository if needed. Log in with `hf auth login` first. LeRobot accepts only
    datasets of version 3.0: `hrc repair` converts older ones.

        hrc push pour alice/pour --license cc-by-4.0
        hrc push pour alice/pour --dry-run
    """

    repo: str
    """OWNER/NAME on the Hub."""
    private: bool = True
    """Make a new repository private."""
    license: str | None = None
    """Licence identifier, such as cc-by-4.0. Without one, others may not use the data."""
    tags: tuple[str, ...] = ()
    """Tags in addition to those of LeRobot."""
    unsound: bool = False
    """Upload the dataset even if it has errors."""
    dry_run: bool = False
    """Check the dataset without uploading it."""


@dataclass(frozen=True, kw_only=True)
class Fit(OnDataset, Written):
    """A command that learns a model from demonstrations."""

    out: Path | None = None
    """Folder for the model. Default: DATASET_model."""
    episodes: tuple[int, ...] = ()
    """Episodes to learn from. Default: all."""

    @property
    def folder(self) -> Path:
        """Folder of the model."""
        return self.out or sibling(self.dataset, "model")


@dataclass(frozen=True, kw_only=True)
class FitPrimitives(Columns, Fit):
    """Fit movement primitives of joints and end effector to a dataset.

    Each demonstration is fitted, and one common model predicts new motions from start, goal and
    duration. The folder holds the primitives, the errors, figures and a Rerun recording.
    """

    channels: tuple[Channel, ...] = ()
    """Channels to learn. Default: joint and pose, if the dataset has them."""
    several: Literal["best", "mean", "distribution", "contextual", "streamed"] = "best"
    """Common model of several demonstrations. best: the model that predicts held-out
    demonstrations best, such as the mean, the nearest demonstration or the contextual model.
    mean: their mean. distribution: their mean and the primitive of each (for a
    ProbabilisticDMP). contextual: a function of the context. streamed: one primitive, fitted in
    a single pass over the data."""
    context: tuple[str, ...] = ()
    """Columns whose values in the first frame are the context. Default: start and goal."""
    n_basis: int | None = 60
    """Number of basis functions. None: chosen by the error on held-out samples."""
    method: Literal["trajectory", "ridge", "lwr"] = "trajectory"
    """trajectory: least squares on the motion. ridge: ridge regression on the forcing term.
    lwr: the paper's locally weighted regression."""
    scaling: Scaling = "none"
    """Scaling of the forcing term with start and goal."""
    joint_names: tuple[str, ...] = ()
    """Joints to learn, in this order. Default: all."""
    as_lerobot_policy: bool = False
    """Write a LeRobot policy of type dmp instead, which maps observations to actions."""


@dataclass(frozen=True, kw_only=True)
class FitImageJacobian(Fit):
    """Fit the image Jacobian of an uncalibrated camera to a dataset.

    Learns how the marker moves in the image when the end effector moves, and how uncertain this
    is. If an object was observed, the target in the image is learned, too. --marker first
    searches the videos for the marker: its pixels are stored in DATASET.features, so that an
    interrupted search can be resumed. Under torchrun, each process reads a part of the
    demonstrations.

        hrc fit image-jacobian grasping --marker 3 --camera front
        hrc fit image-jacobian --dataset grasping --markerless
    """

    marker: int | None = None
    """Number of the end effector's marker in OpenCV's ArUco dictionary 4x4_50. Default: use the
    pixels that the dataset holds or an earlier search found."""
    markerless: bool = False
    """Find tool and object in the videos without any marker."""
    camera: str | None = None
    """Camera to search with --marker or --markerless. Needed if there are several."""

    neurons: Literal["around", "grid"] = "around"
    """around: thirteen neurons around the demonstrated poses. grid: the paper's grid over x and
    y."""
    learn: bool = True
    """Learn neurons, noise and prior by gradient ascent on the evidence (marginal
    likelihood)."""
    config: tuple[str, ...] = ()
    """Settings of `learning` (EvidenceConfig) and `fit` (ImageJacobianFitConfig), as NAME=VALUE
    or TOML files."""


@dataclass(frozen=True, kw_only=True)
class Tokens(OnDataset, Written):
    """Fit a tokenizer of action chunks to a dataset, or report its token counts and errors.

    Every sequence of tokens decodes to a motion that continues from the arm's state and stays
    in the demonstrated range. Every fifth episode is held out of the fit, to measure errors.

        hrc tokens fit --dataset pouring --config tolerance=0.005 seconds=0.5
        hrc tokens report --dataset pouring --model pouring_tokens
    """

    action: Literal["fit", "report"]
    """Fit a tokenizer, or report the measured values of a fitted one."""
    model: Path | None = None
    """Folder written by hrc tokens fit, for the report."""
    out: Path | None = None
    """Folder for the tokenizer. Default: DATASET_tokens."""
    config: tuple[str, ...] = ()
    """Settings (TokenSettings: feature, seconds, vocabulary_size, tolerance, start_known,
    held_out), as NAME=VALUE or TOML files."""


@dataclass(frozen=True, kw_only=True)
class Evaluate(OnDataset, Written):
    """Evaluate a model of `hrc fit` on demonstrations that it has not seen.

    Primitives predict each demonstration from start, goal and duration. Without a model,
    primitives are first fitted to four fifths of the demonstrations. An image Jacobian is
    compared with the simulator's true one. Exit status 1 if a target was missed.
    """

    model: Path | None = None
    """Folder written by `hrc fit`."""
    out: Path | None = None
    """Folder for figures and measured values of primitives."""
    episodes: tuple[int, ...] = ()
    """Episodes to evaluate on. Default: those not used for the fit, or all."""
    most_nrmse: float | None = None
    """Exit status 1 if the median NRMSE of primitives exceeds this. Default: no limit."""


@dataclass(frozen=True, kw_only=True)
class Play(Written):
    """Write the motion of a fitted model to a goal: path, joints, film, table, LeRobot episode.

    With --robot, the path becomes joint positions within the limits of that arm, and the motion
    is slowed down if they require it. Without --robot, the path stays in the model's
    coordinates. Exit status 1 if the arm cannot follow the path.

        hrc play pour_model --goal 0.4 0.1 0.3 --robot panda
        hrc play pour_model --goal pose 0.4 0.1 0.3 0 1 0 0 --start episode 2 --robot panda
    """

    model: Path
    """Folder written by `hrc fit`."""
    goal: tuple[str, ...]
    """Joint positions, position [m], or pose with quaternion (w, x, y, z). The kind follows
    from the count of numbers, or from the word joints, position or pose before them. The end of
    a demonstration is a goal, too, such as: episode 2."""
    start: tuple[str, ...] = ()
    """Start, in the same form as the goal; an episode stands for its first frame. Default: the
    model's."""
    robot: str = ""
    """Arm, given as in `hrc demo`. Default: no arm."""
    duration: float | None = None
    """Duration [s]. Default: the model's."""
    out: Path | None = None
    """Folder for the motion. Default: MODEL_played."""

    @property
    def folder(self) -> Path:
        """Folder of the motion."""
        return self.out or sibling(self.model, "played")


@dataclass(frozen=True, kw_only=True)
class Smooth(Measured):
    """Limit velocity, acceleration and jerk of a trained LeRobot policy's actions.

    Adds two steps to the processors of a checkpoint. They limit the actions to what the
    demonstrators did, and blend consecutive action chunks. The weights stay as they are.
    """

    checkpoint: Path | None = None
    """Folder `pretrained_model` of the checkpoint. None: only write --limits."""
    dataset: Path | None = None
    """LeRobot dataset that the policy was trained on."""
    scale: float = 1.0
    """Allowed fraction of the demonstrators' velocity, acceleration and jerk."""
    urdf: Path | None = None
    """Description of the robot with position and velocity limits of its joints."""
    calibration: Path | None = None
    """LeRobot's calibration of the robot with the position limits of its motors."""
    degrees: bool = False
    """Actions are in degrees. Default: radians with --urdf, percent with --calibration."""
    limits: Path | None = None
    """File to write the limits to, for --robot.limits of a robot of type `smooth`."""
    remove: bool = False
    """Remove the two steps."""


@dataclass(frozen=True, kw_only=True)
class Report(Measured):
    """Make one HTML page of the reports of several runs.

    The page holds figures, measured values with their targets, configurations and commands. It
    needs no network.
    """

    runs: tuple[Path, ...]
    """Folders of runs, in the order of the page. Each holds a report.json."""
    out: Path
    """HTML file to write. Replaces an older one."""
    evidence: bool = False
    """List the requirements of ISO 10218:2025 for work near people, with measured values,
    instead of the reports."""


Shelf = Literal["lower", "middle", "upper"]
"""Shelves of `hrc_learn.sim.workplace.Workplace`."""
ArmDriver = Literal["sim", "franky", "franka", "lerobot", "ros2"]
"""The simulated arm, and `hrc_learn.experiments.real_arm.Driver`."""


@dataclass(frozen=True, kw_only=True)
class WithRobot(Measured):
    """A command for any arm."""

    robot: str = "panda"
    """Arm by name, or its URDF or MJCF file: FILE, FILE:TIP or FILE:BASE:TIP. TIP is the flange
    link, needed if the file has several end links."""


@dataclass(frozen=True, kw_only=True)
class WithDriver(WithRobot):
    """A command for a simulated or a real arm."""

    arm: ArmDriver = "sim"
    """Driver. sim: simulated arm. franky: the package franky. franka: this package's loop at
    1 kHz. lerobot: a robot of LeRobot, with its options such as --robot.type=so101_follower
    --robot.port=/dev/ttyACM0. ros2: topics of ROS 2, named by --config site.ros2.*."""
    ip: str = ""
    """Address of the arm's control box. "sim" starts a simulated control box."""
    config: tuple[str, ...] = ()
    """Further settings as NAME=VALUE or TOML files, such as site.speed=0.1. `--config help`
    lists them."""

    def drives_real_arm(self, simulated_only: Sequence[str] = ()) -> bool:
        """True if the command moves a real arm.

        Args:
            simulated_only: Options that only the simulated work cell has.

        Raises:
            ValueError: There is an address without a driver, a driver without an address, or an
                option of the simulated work cell for a real arm.
        """
        if self.arm in ("lerobot", "ros2"):
            text = "is for Franka arms: use --robot.port for LeRobot, ROS_DOMAIN_ID for ROS 2"
            refuse_given(self, ["ip"], text)
        elif self.arm == "sim" and self.ip:
            raise ValueError(f"--ip {self.ip} needs a driver: --arm franky or --arm franka.")
        elif self.arm != "sim" and not self.ip:
            raise ValueError(
                f"--arm {self.arm} needs --ip with the address of the arm's control box; "
                "--ip sim starts a simulated one."
            )
        real = self.arm != "sim" and self.ip != "sim"
        if real:
            refuse_given(self, simulated_only, "is for simulated arms, not for a real one")
        return real


@dataclass(frozen=True, kw_only=True)
class WithImperfections(Measured):
    """A command for the simulated work cell."""

    imperfections: float = 1.0
    """Scale of the errors of arm, camera, calibration and objects. 1: nominal."""
    ideal: bool = False
    """No imperfections, like --imperfections 0."""


@dataclass(frozen=True, kw_only=True)
class Demo(WithImperfections, WithRobot, Written):
    """Run the whole job in simulation: demonstrate, learn, grasp, place.

    Records demonstrations, and fits a movement primitive and an image Jacobian to them. Then
    grasps a box with an uncalibrated camera while a scripted person pulls the elbow aside, and
    places the box on a shelf. Demonstrations and models in the folder are kept if they are up
    to date. Exit status 1 if the job failed or a target was missed.
    """

    out: Path = Path("outputs/demo")
    """Folder for demonstrations, models and the run."""
    shelf: Shelf = "middle"
    """Shelf for the object. The middle one is demonstrated."""
    seed: int = 0
    """Random seed of the object's place and of image noise."""
    markerless: bool = False
    """Learn and servo from camera images without any marker; needs EGL."""
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
        hrc run grasping --config experiment.scene.random_camera=true processes=4 film=false
    """

    experiment: Literal["placing", "grasping", "collaboration"]
    """Experiment to run."""
    out: Path | None = None
    """Folder for recordings, report and measured values. Default: outputs/EXPERIMENT."""
    placing: Path | None = None
    """Folder written by `hrc fit` from demonstrations of placing. Default: the model of
    `hrc demo`, learned first if it is missing."""
    aiming: Path | None = None
    """Folder written by `hrc fit image-jacobian`. Default: the model of `hrc demo`."""
    seed: int = 0
    """Random seed of the run, and of the first trial; each further trial adds 1."""
    trials: int = 0
    """Number of repetitions with random conditions, for statistics."""
    camera: str = "auto"
    """Simulated camera: "egl" renders, "synthetic" only draws markers, "auto" renders if it
    can. For a real arm: device number or path, URL of a stream, or a video file."""
    markerless: bool = False
    """Detect gripper and object without any marker, among clutter and shadows; needs EGL."""
    shelf: tuple[Shelf, ...] = ("middle",)
    """Shelf for the object. With two or three shelves, one object is placed on each."""
    pulls: Literal["scripted", "random", "none"] = "scripted"
    """Pulls at the elbow. scripted: while the arm waits for a pull. random: at random moments.
    none: never."""
    camera_moved: bool = False
    """Move and turn the camera between two objects."""
    worker: bool = False
    """Simulate a worker that puts an object on the table and reaches under the arm."""
    handover: bool = False
    """Let a simulated person hand over the last object."""
    page: bool = False
    """Serve a page to watch, draw targets and pull at the elbow."""
    serve: bool = False
    """Serve the dashboard in the browser during the run."""


@dataclass(frozen=True, kw_only=True)
class Record(WithRobot, Written):
    """Record demonstrations by a scripted expert in simulation, or by a leader arm.

    placing: an object is carried to a shelf while the elbow is pulled past the cabinet's door.
    servoing: the marked end effector moves above an object, seen by an uncalibrated camera.
    expert: demonstrations with the columns of LeRobot's robots, for LeRobot's policies.
    leader: a LeRobot teleoperator guides a real LeRobot arm within the arm's limits:

        hrc record leader --robot so101 --out demos --robot.type=so101_follower
            --robot.port=/dev/ttyACM0 --teleop.type=so101_leader --teleop.port=/dev/ttyACM1
    """

    demonstration: Literal["placing", "servoing", "expert", "leader"]
    """Demonstrations to record."""
    out: Path
    """Folder of the new dataset."""
    episodes: int | None = None
    """Number of demonstrations. Default: placing 3, servoing 8, expert 10, leader 5."""
    seed: int | None = None
    """Random seed of initial positions, tremor and image noise. Default: servoing 1, others
    0."""
    shelf: Shelf = "middle"
    """Shelf to place on."""
    scenario: Literal["placing", "grasping"] = "placing"
    """Scenario of the expert, like `--robot.scenario` in LeRobot's commands."""
    config: tuple[str, ...] = ()
    """Further settings as NAME=VALUE or TOML files, such as demonstration.duration=5 or
    robot.fps=10. `--config help` lists them."""


@dataclass(frozen=True, kw_only=True)
class Multiply(OnDataset):
    """Make hundreds of judged demonstrations from a few, in new scenes or for another arm.

    Each demonstration is split where the gripper moves, and each segment is adapted to the pose
    of its object. Motions that miss their poses, break limits, collide or fail in physics are
    left out, and the reasons are listed. The same command continues an interrupted run.

        hrc multiply five --episodes 1000 --out thousand
        hrc multiply five --episodes 500 --out ur --robot ur5e
    """

    episodes: int
    """Number of new demonstrations. 0: list the segments and write nothing else."""
    out: Path | None = None
    """Folder of the new dataset, which must not exist. Default: DATASET_multiplied."""
    robot: str = ""
    """Arm of the new motions, by name or file. Default: that of the dataset."""
    judge: str = ""
    """Simulator that decides on success: grasping, placing, an MJCF file, or a Python function
    that makes an environment of gymnasium, as FILE.py:FUNCTION or MODULE:FUNCTION."""
    config: tuple[str, ...] = ()
    """Settings of scenes, variation and judge as NAME=VALUE or TOML files, such as
    objects.object.yaw=[-0.5,0.5] or judge.scene=none. `--config help` lists them."""

    @property
    def folder(self) -> Path:
        """Folder of the new dataset."""
        return self.out or sibling(self.dataset, "multiplied")


@dataclass(frozen=True, kw_only=True)
class ServePage(WithDriver):
    """Guide the arm in a browser and record demonstrations.

    Open the first printed address in a browser, the last one in a headset or on a phone. Drag a
    link to move the arm in its null space, drag the end effector's gizmo to move the tool. Ends
    with "Finish", Ctrl-C or after --duration, and leaves a LeRobot dataset of the saved
    demonstrations.
    """

    out: Path
    """Folder of the new dataset, which must not exist."""
    port: int | None = None
    """Port of the page. Default: the first free one from 8080."""
    host: str = "127.0.0.1"
    """Address to serve at. 0.0.0.0 serves the network, over TLS and with a token."""
    device: Literal["none", "gamepad", "keyboard", "haptic"] = "none"
    """Additional device that moves the end effector."""
    duration: float | None = None
    """End after this time [s]."""


@dataclass(frozen=True, kw_only=True)
class Serve(WithDriver):
    """Run the controller at a fixed rate and report its latency.

    The arm servoes the image of its marker to a target. The camera is always simulated, at 31
    Hz; with --arm, a real arm moves. The report lists the time from reading the joints to the
    command, the delay of each tick, and missed ticks. The first start takes about 10 s to
    compile the step; `--config step=eager` skips this. With --ros2, the controller is a
    lifecycle node instead: it receives goals, images and pushes from topics, and sends its
    commands to a standard ROS 2 controller.

        hrc serve --ros2 --robot /robot_description:tool0
    """

    ros2: bool = False
    """Run as a node of ROS 2."""
    duration: float | None = None
    """Duration [s]. Default: 8 s; the node runs until Ctrl-C."""
    rate: float = 500.0
    """Control rate [1/s]."""
