"""Command lines of the commands that move the arm, and of what is made from their runs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from hrc_learn.cli._options import Detail, More
from hrc_learn.cli.arguments import (
    Configuration,
    Experiment,
    Led,
    Measured,
    OfRobot,
    Shelf,
    Variant,
    WayMaking,
    Written,
)


@dataclass(frozen=True, kw_only=True)
class Imperfect:
    """What all that run in the simulated work cell have in common."""

    imperfections: float = 1.0
    """Errors of arm, camera, calibration and objects, so many times their nominal size."""
    ideal: bool = False
    """Without any: --imperfections 0."""


@dataclass(frozen=True, kw_only=True)
class Demo(Imperfect, OfRobot, Measured):
    """Do the whole main job in simulation: demonstrate, learn, grasp, place.

    Records demonstrations of placing and of servoing, fits a movement primitive and an image
    Jacobian to them, then grasps a box with an uncalibrated camera while a scripted person
    draws the elbow aside, carries it to the cabinet along the learned motion, and puts it on a
    shelf. Demonstrations and models of an older demo in the folder are kept where they are what
    this one would make; the run is replaced. Exit status 1 if the job failed or a target was
    missed.
    """

    out: Path = Path("outputs/demo")
    """Folder for demonstrations, models and the run."""
    shelf: Shelf = "middle"
    """Where to put the object; the middle shelf is the demonstrated one."""
    seed: int = 0
    """Seed of where the object lies and of image noise."""
    film: bool = True
    """Make a film of the run, in its folder and its report."""
    verbose: bool = False
    """Show all that was measured, not just the first of it."""
    again: More[bool] = False
    """Record and learn anew, even what is there and unchanged."""


@dataclass(frozen=True, kw_only=True)
class RunExperiment(Imperfect, OfRobot, Led, Written):
    """What the paper's three experiments have in common."""

    out: Path
    """Folder for recordings, report and measured values."""
    seed: int = 0
    """First seed of the run and of its repetitions."""
    trials: int = 0
    """Repeat with so many seeds besides, and sum up."""
    processes: int = 1
    """Of the repetitions, at once."""
    curve: More[tuple[float, ...]] = ()
    """Repeat with these sizes of the imperfections besides, in multiples of the nominal ones,
    and draw success and errors against them."""
    film: More[bool] = True
    """Make a film of the run, in the folder and in the report."""
    verbose: More[bool] = False
    """Show all that was measured, not just the first of it."""
    serve: bool = False
    """Serve the dashboard in the browser while the run goes on."""
    serving: Configuration = Detail("hrc_learn.experiments.run_recording", "LiveViewConfig")
    """Where, with --serve."""


type MarkedPoint = tuple[float, float, float, float, float]
type DrawnBox = tuple[float, float, float, float, float, float, float, float]


@dataclass(frozen=True, kw_only=True)
class RunServoing(RunExperiment):
    """What those with a camera have in common."""

    camera: str = "auto"
    """Camera: rendered by "egl", or "synthetic", which needs no OpenGL; "auto" renders where
    it can. For a real arm: number or path of a device, URL of a stream, or a video file."""
    gains: More[Path | None] = None
    """gains.json of `hrc tune`, in place of those of the controller."""
    page: bool = False
    """Serve a page in the browser, from which people watch, draw where to, and pull at the
    elbow."""
    port: int | None = None
    """Port of that page."""
    draw_region: More[tuple[DrawnBox, ...]] = ()
    """Regions that a scripted person draws while the arm servoes: start and duration [s], x y z
    of the centre and of the half edges [m]."""
    mark_target: More[tuple[MarkedPoint, ...]] = ()
    """Targets that they mark: start and duration [s], x y z [m]."""
    turn_tool: More[tuple[MarkedPoint, ...]] = ()
    """How they turn the end effector on top of the planned orientation: start and duration [s],
    rotation vector [deg]."""


@dataclass(frozen=True, kw_only=True)
class RunPlacing(RunExperiment):
    """Place an object on three shelves by a motion that was demonstrated for one of them.

    In simulation, with the object held between the fingers: the demonstrated motion once more
    and faster, then the other shelves, as the paper does it (joint space, shifted goal) and in
    task space with the learned null-space posture; the demonstration with and without that
    posture; on request from many random starts. Writes Rerun recordings, a report and the
    measured values. Exit status 1 if a target was missed.
    """

    placing: Path | None = None
    """Folder of `hrc fit`, from demonstrations of placing. Those of `hrc demo` when not given,
    made first where they are missing."""
    out: Path = Path("outputs/placing")
    demonstrations: Path | None = None
    """Dataset the motion was learned from; the one named in that folder when None."""
    speed: float = 1.5
    """How many times faster than demonstrated."""
    shelf: More[Shelf] = "middle"
    """Where to put the object with a real arm, which begins with it in its hand."""
    trials: int = 0
    """Random starts from which to place on each shelf besides."""
    noise: float = 0.1
    """Standard deviation of each joint at these starts, about home [rad]."""
    taught: bool = True
    """Lead the arm once to the place on the demonstrated shelf, and correct all places by what
    its encoders read there: else its calibration counts."""
    ablation: int = 0
    """Further demonstrations with and without the null-space posture."""
    pictures: bool = True
    """Whether to render pictures of the arm, where this machine can."""


@dataclass(frozen=True, kw_only=True)
class RunGrasping(RunServoing):
    """Grasp an object from afar with a camera that nobody calibrated.

    In simulation: the arm starts anywhere within its joint limits, the camera was turned or
    moved since the image Jacobian was learned, and the controller is not told. The learned
    Jacobian with a Kalman filter has to do it; the paper's law, no adaptation and other
    estimators are run on the same setting for comparison. Writes Rerun recordings, a report and
    the measured values. Exit status 1 if the default failed or a target was missed.
    """

    aiming: Path | None = None
    """Folder of `hrc fit image-jacobian`. That of `hrc demo` when not given, made first where
    it is missing."""
    out: Path = Path("outputs/grasping")
    camera_roll: float = 60.0
    """By how much the camera was turned about its axis since the demonstrations [deg]."""
    random_camera: bool = False
    """Draw where the camera stands, how it is tilted and turned, instead."""
    variants: tuple[Variant, ...] = ("learned", "kalman", "composite", "paper", "fixed")
    """What to compare. A Kalman filter from the learned Jacobian and from the paper's guess;
    from that guess also the composite law, the paper's law and no adaptation; "unadapted", the
    learned Jacobian as it is. "none" for nothing."""
    config: Configuration = Detail("hrc_learn.skills.grasping", "GraspingConfig")
    """How objects are grasped."""
    trials: int = 0
    """Grasps besides, each with a random camera, start and object, by the default alone
    and seen by the synthetic camera."""


@dataclass(frozen=True, kw_only=True)
class RunCollaboration(RunServoing):
    """Grasp objects beside a person, carry them to the cabinet and put them on shelves.

    In simulation: the learned skills run on MuJoCo's arm, an uncalibrated camera watches, and a
    scripted person pulls the elbow aside while the arm servoes. The camera may be moved between
    two objects, the marker may be hidden, images may be late or lost. Writes a Rerun recording,
    a report and the measured values. Exit status 1 if the job failed or a target was missed.

    The paper's third experiment: --shelves lower middle upper --occlusion 0 4.
    """

    placing: Path | None = None
    """Folder of `hrc fit`, from demonstrations of placing. Those of `hrc demo` when not given,
    made first where they are missing."""
    aiming: Path | None = None
    """Folder of `hrc fit image-jacobian`. That of `hrc demo` when not given, likewise."""
    out: Path = Path("outputs/collaboration")
    shelf: Shelf = "middle"
    """Where to put the object."""
    shelves: tuple[Shelf, ...] = ()
    """Where to put each of two or three objects, in place of --shelf."""
    shelf_x: More[float | None] = None
    """Where along the board [m], in the robot's base frame; None: as the cell is laid out."""
    shelf_depth: More[float | None] = None
    """How far behind the board's front edge [m]; likewise."""
    occlusion: More[tuple[tuple[float, float], ...]] = ()
    """Intervals in which a board occludes the marker: start and duration [s]."""
    camera_moved: More[bool] = False
    """Move and turn the camera between two objects."""
    camera_change: Configuration = Detail("hrc_learn.sim", "CameraChange")
    """How far, with --camera-moved."""
    latency: More[float] = 0.0
    """From an image being taken until its markers are known [s]; more than by imperfections."""
    frame_loss: More[float] = 0.0
    """Share of the images that are lost."""
    pulls: Literal["scripted", "random", "none"] = "scripted"
    """When a scripted person pulls the elbow: where the robot waits for them, at random moments
    of the whole job, or never."""
    mapping: More[Literal["transpose", "pinv"]] = "transpose"
    """How these pulls act: as forces, by the transposed Jacobian of the joint pulled, or as the
    paper's velocities, by its pseudo-inverse, which can move the joint against the pull."""
    worker: bool = False
    """Whether a worker comes and reaches under the arm. He puts something on the table first,
    leaves again, and makes no way for the robot; how near he comes is measured."""
    handover: bool = False
    """Whether somebody hands the last object over. The robot goes to meet their hand when its
    motion says so, and waits through their other movements."""
    config: Configuration = Detail("hrc_learn.skills.pick_and_place", "PickAndPlaceConfig")
    """How the job is done."""


@dataclass(frozen=True, kw_only=True)
class Report(Measured):
    """Make one page from the folders of one or several runs.

    The page holds their figures, what they measured beside its targets and the paper's claims,
    their configuration and versions, and the commands that run them again. It needs no network:
    mail it, print it, keep it.
    """

    runs: Positional[tuple[Path, ...]]
    """Folders of runs, in the order of the page; each holds a report.json."""
    out: Path
    """HTML file to write; replaces an older one."""
    title: str = "Runs"
    """Heading above several runs."""


@dataclass(frozen=True, kw_only=True)
class Sweep(OfRobot, Written):
    """Thousands of simulated grasps as batches: how often, how fast and how safely.

    Random starts, targets and uncalibrated cameras, turned by up to 180 degrees from what the
    controller believes, against the kinematics of the arm. Prints what was measured beside its
    target, for all acceptance figures about grasping and human effort with --suite acceptance.
    Exit status 1 if a target was missed.
    """

    suite: Literal["acceptance", "estimators", "paper", "mujoco", "stress", "all"] = (
        "acceptance"
    )
    """Which experiments: those of the acceptance figures; rival estimators; the paper's law as
    printed, and what each of its faults costs; both laws in MuJoCo; random runs that look for
    broken limits alone."""
    only: More[tuple[Experiment, ...]] = ()
    """Names of single experiments, instead of a suite."""
    trials: int = 1000
    """Trials of near, global, fixed, literal, unmixed, printed, printed_box and each stress
    test."""
    variants: int = 400
    """Trials of each of the others."""
    seed: int = 0
    """Seed of starts, targets, cameras and noise, the same for all experiments."""
    ray: bool = False
    """Spread the trials over processes or machines with Ray; the figures stay the same."""
    out: Path | None = None
    """Folder for the figures, the picture and the recording, all at once."""
    figure: Path | None = None
    """Receives a picture of the times to the target by experiment, as .png or .svg."""
    recording: Path | None = None
    """Receives a Rerun recording: success by class of camera, and arrival over time."""


@dataclass(frozen=True, kw_only=True)
class SweepWorker(OfRobot, Imperfect, Written):
    """Many arms at their job, each beside a worker who does not look at it.

    Another worker comes in each run, puts something on the table, reaches for markers under the
    arm and walks away. The arms keep the protective distance of ISO/TS 15066 from what a
    tracker sees, and make way in several manners; others stop and wait while anybody is nearer
    than a fixed distance. Exit status 1 if an arm that keeps the distance violated it.
    """

    placing: Path
    """Folder of the placing skill."""
    aiming: Path
    """Folder of the visual-servoing skill, whose orientation above the table is taken."""
    runs: int = 1000
    """Of each manner, the same workers in all of them."""
    seed: int = 0
    """Of workers, trackers, encoders and objects."""
    modes: tuple[WayMaking, ...] = ("none", "expert", "automatic", "both")
    """Who moves the null space."""
    stop_distances: tuple[float, ...] = (0.1, 0.2, 0.3, 0.5, 0.8)
    """Of arms that stop and wait [m]."""
    cycles: int = 24
    """Different cycles of the job, to one shelf after the other; several arms do each."""
    out: Path | None = None
    """Folder for the figures and the picture."""
    figure: Path | None = None
    """Receives a picture of cycle times over smallest distances, as .png or .svg."""


@dataclass(frozen=True, kw_only=True)
class Serve(OfRobot, Led, Measured):
    """Run the controller at a fixed rate on an arm, and report how fast it answers.

    The arm servoes on a marker that an uncalibrated camera sees at 31 Hz, both calculated from
    its joints: no camera is needed, but a real arm does move. Step latency is the
    time from reading the joints to the command, lateness how long ago the tick was due, or the
    first of those that were missed before it; both in wall-clock time. A tick is missed when
    the loop, physics included, was still busy when the next one was due.
    """

    duration: float = 8.0
    """How long to run [s]."""
    rate: float = 500.0
    """Control steps a second; the physics takes steps of the same length."""
    step: Literal["fastest", "eager"] = "fastest"
    """Whether to compile the step ahead of time, where there is a C++ compiler."""
    packages: Path | None = None
    """Folder in which compiled steps are kept; default: the user's cache. The first start
    compiles, in a minute or two; later ones, at any rate, take a tenth of a second."""


@dataclass(frozen=True, kw_only=True)
class ServePage(OfRobot, Led, Measured):
    """Lead the arm in a browser, and record demonstrations of your own.

    Open the address that is printed, or in a headset or on a phone the other one. Drag a link
    or a knob of the arm, or of its virtual twin, to move it in its null space; drag the end
    effector's gizmo, such as to a green field on a shelf. Start, stop, save. Ends with
    "Finish", with Ctrl-C, or after --duration, and leaves a LeRobot dataset if anything was
    saved.
    """

    out: Path
    """Folder of the dataset to record; must not exist."""
    port: int | None = None
    """Port of the page, which must be free; the first free one from 8080 on when not given."""
    task: str = "put the object on the middle shelf"
    """What is to be shown, in words; it can be changed on the page."""
    beside: Literal["nothing", "gamepad", "keyboard", "haptic"] = "nothing"
    """A device for the other hand, which moves the end effector: a gamepad (extra `gamepad`),
    the keys of the terminal this runs in, or a haptic device of Force Dimension (extra
    `haptic`; not run on hardware)."""
    duration: float | None = None
    """End after this time [s]; None: when the person finishes."""
    page: Configuration = Detail("hrc_learn.teleoperation.page", "PageConfig")
    """The page."""
    session: Configuration = Detail("hrc_learn.teleoperation.page_session", "PageSessionConfig")
    """The session."""
