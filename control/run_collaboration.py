"""Grasp objects beside a person, carry them to the cabinet and place them on shelves.

In simulation: the learned skills run on MuJoCo's arm, an uncalibrated camera watches, and a
scripted person pushes the elbow aside while the arm servoes. The camera may be moved between
two objects, the marker may be hidden, images may be late or lost. Writes a Rerun recording, a
report and the measured values. Exit status 1 if the job failed or a target was missed.

The paper's third experiment: --shelves lower middle upper --occlusion 0 4.
"""

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from hrc_learn import cli
from hrc_learn.experiments.collaboration.experiment import CollaborationExperiment
from hrc_learn.experiments.collaboration.trial import Disturbances
from hrc_learn.experiments.frame import RunOptions, conduct
from hrc_learn.learning.tuning import with_gains
from hrc_learn.sim import CameraChange, CameraKind, Occlusion
from hrc_learn.skills.marker_sensor import TransportConfig
from hrc_learn.skills.pick_and_place import CollaborationConfig
from hrc_learn.skills.work_cell import StationConfig
from hrc_learn.teleoperation.page import PageConfig


@dataclass(frozen=True, kw_only=True)
class Args(RunOptions):
    """What to run."""

    placing: Path
    """Folder of training/fit_dmp.py, from demonstrations of placing."""
    aiming: Path
    """Folder of training/fit_image_jacobian.py."""
    shelf: str = "middle"
    """Where to place the object: lower, middle or upper."""
    shelves: tuple[str, ...] = ()
    """Where to place each of two or three objects, instead of --shelf."""
    shelf_x: float = 0.40
    """Where along the board [m], in the robot's base frame."""
    shelf_depth: float = 0.10
    """How far behind the board's front edge [m]."""
    occlusion: tuple[tuple[float, float], ...] = ()
    """Intervals in which a board hides the gripper's marker: start and duration [s]."""
    camera_moved: bool = False
    """Move and turn the camera between two objects."""
    camera_change: CameraChange = field(default_factory=CameraChange)
    """How far, with --camera-moved."""
    latency: float = 0.0
    """From an image being taken until its markers are known [s]."""
    frame_loss: float = 0.0
    """Fraction of the images that are lost."""
    camera: CameraKind = "auto"
    """Camera: rendered by "egl", or "synthetic", which needs no OpenGL; "auto" renders where
    it can. Trials use the synthetic one."""
    person: bool = True
    """Whether the scripted person pushes the elbow."""
    page: bool = False
    """Serve a page in the browser, from which people watch and push the elbow too. The run
    takes as long as it would on a real arm then."""
    port: int = 8080
    """Port of that page."""
    config: CollaborationConfig = field(default_factory=CollaborationConfig)
    """How the job is done."""
    gains: Path | None = None
    """gains.json of training/tune_controller.py, in place of those of the controller."""


def main(args: Args) -> int:
    controller = with_gains(args.config.grasping.controller, args.gains)
    grasping = replace(args.config.grasping, controller=controller)
    experiment = CollaborationExperiment(
        aiming=args.aiming.resolve(),
        placing=args.placing.resolve(),
        shelves=args.shelves or (args.shelf,),
        shelf_x=args.shelf_x,
        shelf_depth=args.shelf_depth,
        person=args.person,
        disturbances=Disturbances(
            occlusions=tuple(Occlusion(start=s, duration=d) for s, d in args.occlusion),
            camera_change=args.camera_change if args.camera_moved else None,
        ),
        station=StationConfig(
            transport=TransportConfig(latency=args.latency, dropped=args.frame_loss)
        ),
        config=replace(args.config, grasping=grasping),
        camera=args.camera,
        page=PageConfig(port=args.port) if args.page else None,
    )
    return conduct(experiment, args, configuration=asdict(args))


if __name__ == "__main__":
    cli.run(main, Args)
