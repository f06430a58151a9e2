"""Grasp an object from afar with an uncalibrated camera.

In simulation: the arm starts anywhere within its joint limits, the camera was turned or moved
since the image Jacobian was learned, and the controller is not told. The learned Jacobian with
a Kalman filter has to do it; the paper's law, no adaptation and other estimators are run on
the same scene for comparison. Writes Rerun recordings, a report and the measured values.
Exit status 1 if the default failed or a target was missed.
"""

import math
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from hrc_learn import cli
from hrc_learn.experiments.frame import RunOptions, conduct
from hrc_learn.experiments.grasping.experiment import GraspingExperiment
from hrc_learn.experiments.pose_randomization import GraspingSceneConfig
from hrc_learn.learning.tuning import with_gains
from hrc_learn.sim import CameraKind
from hrc_learn.skills.grasping import GraspingConfig


@dataclass(frozen=True, kw_only=True)
class Args(RunOptions):
    """What to run."""

    aiming: Path
    """Folder of training/fit_image_jacobian.py."""
    camera_roll: float = 60.0
    """By how much the camera was turned about its axis since the demonstrations [deg]."""
    random_camera: bool = False
    """Draw where the camera stands, how it is tilted and turned, instead. Trials always do."""
    variants: tuple[str, ...] = ("learned", "kalman", "composite", "paper", "fixed")
    """What to compare: a Kalman filter from the learned Jacobian and from the paper's guess;
    from that guess also the composite law, the paper's law and no adaptation; "unadapted", the
    learned Jacobian as it is. "none" for nothing."""
    camera: CameraKind = "auto"
    """Camera: rendered by "egl", or "synthetic", which needs no OpenGL; "auto" renders where
    it can. Trials use the synthetic one."""
    config: GraspingConfig = field(default_factory=GraspingConfig)
    """How objects are grasped."""
    gains: Path | None = None
    """gains.json of training/tune_controller.py, in place of those of the controller."""


def main(args: Args) -> int:
    controller = with_gains(args.config.controller, args.gains)
    experiment = GraspingExperiment(
        aiming=args.aiming.resolve(),
        variants=() if args.variants == ("none",) else args.variants,
        scene=GraspingSceneConfig(
            camera_roll=math.radians(args.camera_roll), random_camera=args.random_camera
        ),
        camera=args.camera,
        config=replace(args.config, controller=controller),
    )
    return conduct(experiment, args, configuration=asdict(args))


if __name__ == "__main__":
    cli.run(main, Args)
