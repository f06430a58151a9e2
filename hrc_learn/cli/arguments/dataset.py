"""Command lines of the commands that read and write datasets."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional

from hrc_learn.cli._options import Detail, More
from hrc_learn.cli.arguments import Measured, Written, beside


@dataclass(frozen=True, kw_only=True)
class Check(Written):
    """Check a LeRobot dataset: what is broken, what is odd enough to look at before training.

    Every finding names the file, episode, frame and column as closely as is known; a table
    shows what each column means, in which unit, and why. Exit status: 0 no errors, 1 errors in
    the data, 2 no dataset there.
    """

    dataset: Path
    """Folder of the dataset, version 2.0, 2.1 or 3.0."""
    out: Path | None = None
    """Folder for findings.json and metrics.json; none are kept without."""
    units: dict[str, str] = field(default_factory=dict)
    """Units on disk by quantity, such as: joint_position deg position mm."""
    speed_limits: dict[str, float] = field(default_factory=dict)
    """Fastest each joint can turn [rad/s], such as: joint1 2.1 joint2 2.1."""
    mapping: More[dict[str, str]] = field(default_factory=dict)
    """Columns by quantity where they are not found, such as: command_position action[0:7]."""
    strict: bool = False
    """Count warnings as errors in the exit status."""
    full: bool = False
    """Every finding on a line of its own, instead of one for each kind."""
    keep_contract: bool = False
    """Keep what the columns mean, as the table shows it, in DATASET/meta/hrc_learn.json."""
    camera: bool = False
    """Also tell in which episodes the camera stood where, by the marker of the robot's tool."""
    findings: Path | None = None
    """Receives every finding: a JSON list of kind, message, file, episode, frame, key."""


@dataclass(frozen=True, kw_only=True)
class Repair(Measured):
    """Repair a LeRobot dataset into a new copy, and say what was changed in which episode.

    Standing still is trimmed, measured angles of the arm are unwrapped and signs of quaternions
    fixed; more on request. Commands, hands, grippers and whatever switches between levels stay
    as they are. Any version is read, version 3.0 is written; the old dataset is left as it is.

        hrc repair --dataset broken --out repaired
        hrc repair --dataset broken --out repaired --fps 50 --drop-bad-episodes --no-videos
    """

    dataset: Path
    """Folder of the dataset to repair, version 2.0, 2.1 or 3.0."""
    out: Path | None = None
    """Folder of the new one; must not exist. DATASET_repaired when not given."""
    trim: bool = True
    """Cut off standing still before and after the motion."""
    keep_rest: More[float] = 0.1
    """Standing still that is left at either end [s]."""
    drop_late: More[bool] = True
    """Drop frames that a column of true stamps has no later than the one before."""
    drop_repeats: bool = False
    """Drop frames that repeat the one before, commands and all, for up to 0.1 s."""
    unwrap: bool = True
    """Take whole turns out of measured joints and angles of the arm that jump by one."""
    unwrap_commands: More[bool] = False
    """Do so to commands too, and to joints whose command jumps along."""
    fix_signs: bool = True
    """Choose the signs of quaternions so that they do not jump."""
    drop_bad_frames: bool = False
    """Drop frames with values that are not finite."""
    drop_bad_episodes: bool = False
    """Leave out episodes that cannot be read or repaired."""
    fps: float | None = None
    """Resample to a regular grid of this rate [1/s]; None leaves the frames as they are."""
    videos: bool = True
    """Keep the videos. Frames dropped in the middle and resampling would need new ones."""
    dry_run: bool = False
    """Only say what would be changed; nothing is written."""
    units: dict[str, str] = field(default_factory=dict)
    """Units on disk by quantity, such as: joint_position deg position mm."""
    mapping: More[dict[str, str]] = field(default_factory=dict)
    """Columns by quantity where they are not found, such as: command_position action[0:7]."""

    @property
    def folder(self) -> Path:
        """Where the copy is written."""
        return self.out or beside(self.dataset, "repaired")


@dataclass(frozen=True, kw_only=True)
class Curate(Measured):
    """Look through the episodes of a LeRobot dataset, the most doubtful first, and decide which
    are accepted, cut or rejected.

    Opens a page in the browser with videos and curves; what is decided there is kept beside the
    dataset, in DATASET.curation.json, and the cleaned set is written to a new place. The same
    ranking in the terminal:

        hrc curate pour --no-browser
        hrc curate pour --no-browser --reject 3 7 --cut 12 30:410 --write
    """

    dataset: Path
    """Folder of the dataset, version 2.0, 2.1 or 3.0."""
    out: Path | None = None
    """Folder of the cleaned dataset; must not exist. DATASET_curated when not given."""
    browser: bool = True
    """Open the page in the browser."""
    reject: tuple[int, ...] = ()
    """Episodes that go."""
    accept: tuple[int, ...] = ()
    """Episodes that stay as they are."""
    cut: dict[int, str] = field(default_factory=dict)
    """Frames that stay of an episode, such as: 12 30:410."""
    write: bool = False
    """Write the cleaned dataset by what was decided, and serve no page."""
    full: bool = False
    """Every episode in the terminal, and not only the most doubtful."""
    units: dict[str, str] = field(default_factory=dict)
    """Units on disk by quantity, such as: joint_position deg position mm."""
    mapping: More[dict[str, str]] = field(default_factory=dict)
    """Columns by quantity where they are not found, such as: command_position action[0:7]."""
    page: Any = Detail("hrc_learn.teleoperation.gate.address", "AddressConfig")
    """Where the page is served."""

    @property
    def folder(self) -> Path:
        """Where the cleaned dataset is written."""
        return self.out or beside(self.dataset, "curated")


@dataclass(frozen=True, kw_only=True)
class ImportArrays(Measured):
    """Turn recordings kept as plain arrays (.npz, .npy, .csv) into a LeRobot dataset.

    Each file is one demonstration; an array of three axes (demonstrations, frames, components)
    is as many as it holds. The stamps are kept as they are in `observation.time`, whatever the
    frame rate LeRobot counts by.

        hrc import pour.npz --out pour --joints q --time t
        hrc import shelf.npy --out shelf --columns px,py,pz,qw,qx,qy,qz --duration 5
        hrc import run1.csv run2.csv --out runs --joints j1,j2,j3,j4,j5,j6 --time stamp
    """

    files: Positional[tuple[Path, ...]]
    """Recordings to import."""
    out: Path
    """Folder of the dataset to write; must not exist."""
    joints: str | None = None
    """Array with the joint positions, or columns joined by commas."""
    position: str | None = None
    """Array with the end effector's position, or columns joined by commas."""
    orientation: str | None = None
    """Array with its orientation (quaternion or rotation vector), or columns."""
    time: str | None = None
    """Array or column with the stamps."""
    columns: str = ""
    """Names of the columns of a .npy file, or of a .csv without a header, joined by commas.
    px,py,pz and qw,qx,qy,qz are poses, t is time, others are joints."""
    joint_names: tuple[str, ...] = ()
    """Names of the joints; joint1, joint2, ... where not given."""
    duration: float | None = None
    """Length of each demonstration [s] where there are no stamps."""
    fps: float | None = None
    """Frame rate [1/s] where there are no stamps."""
    actions: bool = True
    """Take what the next frame holds for the action of each, joints or else the pose, as is
    usual where a person led the arm: LeRobot's policies learn from actions alone."""
    joint_unit: Literal["rad", "deg"] = "rad"
    """Unit of the joint positions."""
    position_unit: Literal["m", "cm", "mm"] = "m"
    """Unit of the positions."""
    time_unit: More[Literal["s", "ms", "us", "ns"]] = "s"
    """Unit of the stamps."""
    quaternion_order: More[Literal["wxyz", "xyzw"]] = "wxyz"
    """Order of a quaternion's components."""
    robot_type: More[str] = "unknown"
    """Name of the robot, kept in the dataset."""
    task: str | None = None
    """What was shown, in words; the file's name where not given."""
    dtype: More[Literal["float32", "float64"]] = "float32"
    """Type on disk; LeRobot's policies want float32."""


@dataclass(frozen=True, kw_only=True)
class Show(Measured):
    """Look at a run, a fit, or the demonstrations of a LeRobot dataset in Rerun.

    Opens the dashboards that a command left in a folder. Of a dataset it makes one: paths of
    the end effector in 3D with the arm (a Panda; of other robots the paths alone), every joint
    of all demonstrations over one another, and for each what else was recorded: image feature,
    the person's effort, gripper, and of the first eight what the cameras saw.
    """

    path: Path
    """Folder of a run or a fit, a recording (.rrd), or the folder of a dataset of version 2.0,
    2.1 or 3.0."""
    out: Path | None = None
    """Recording of a dataset to write, as .rrd, instead of opening it; replaces an older
    one."""
    web: bool = False
    """Open it in the browser, as where there is no screen; ends with Ctrl-C."""
    episodes: tuple[int, ...] = ()
    """Episodes of a dataset to show; all when empty, or 200 spread over it of more."""
    units: dict[str, str] = field(default_factory=dict)
    """Units on disk by quantity, such as: joint_position deg position mm."""


@dataclass(frozen=True, kw_only=True)
class Extract(Measured):
    """Find a marker in the videos of a LeRobot dataset and keep its pixels beside the dataset.

    The result lies in NAME.features, where `load_demos` finds it; the dataset is not touched.
    What was broken off goes on where it was.

        hrc extract --dataset grasping --marker 3 --camera front
    """

    dataset: Path
    """Folder of the dataset, with its videos."""
    marker: int
    """Number of the marker, of OpenCV's ArUco dictionary 4x4_50."""
    camera: str | None = None
    """Name of the camera; may be left out where there is only one."""


@dataclass(frozen=True, kw_only=True)
class Push(Measured):
    """Check a LeRobot dataset and bring it to the Hugging Face Hub, with a card that says what
    is in it.

    The repository is made if it does not exist, and else brought up to the dataset; LeRobot
    finds it by the tag of its version, which moves when all is there. Log in with `hf auth
    login`.

        hrc push pour alice/pour --license cc-by-4.0
        hrc push pour alice/pour --dry-run
    """

    dataset: Path
    """Folder of the dataset, version 2.0, 2.1 or 3.0."""
    repo: str
    """OWNER/NAME on the Hub."""
    private: bool = True
    """Make a new repository private; one that exists stays as it is."""
    license: str | None = None
    """Identifier of the licence, such as cc-by-4.0; without one nobody may use it."""
    tags: tuple[str, ...] = ()
    """Tags besides LeRobot and the robot's name."""
    description: str = ""
    """What was recorded and how, in Markdown, for the card."""
    branch: More[str] = "main"
    """Branch; made if it does not exist."""
    videos: bool = True
    """Send the videos too."""
    unsound: bool = False
    """Send a dataset that has errors."""
    dry_run: bool = False
    """Only show the card, and which files would go."""


@dataclass(frozen=True, kw_only=True)
class Recover(Measured):
    """Recover what processes that were killed left behind, of a path and of anything below it.

    Interrupted recordings become datasets of their saved episodes, interrupted replacements are
    finished, and what was left unfinished is removed. What is being written is left alone.
    """

    path: Path
    """A dataset, model or folder of results, or a folder of several."""
