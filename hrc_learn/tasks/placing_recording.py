"""A placing run as a recording to look at."""

import numpy as np
import torch

from .. import viz
from ..kinematics import panda
from .placing_experiment import PlacingExperiment, shown_joints
from .placing_figures import hand_path
from .placing_run import PlacingRun
from .station import SAFETY_COLUMNS


def record_placing(run: PlacingRun, experiment: PlacingExperiment) -> viz.RunRecording:
    """Everything worth looking at in a run, beside the demonstration."""
    log, demonstration = run.station.log, experiment.demonstration
    joints, safety = log["joint_position"], log["safety"]
    shown = np.full_like(joints, np.nan)
    shown[run.transfer] = shown_joints(demonstration, run.time / run.time[-1])
    return viz.RunRecording(
        title=f"Placing on the {run.shelf} shelf",
        time=log["time"],
        joint_names=panda.joint_names,
        joint_position=joints,
        joint_limits=PANDA_LIMITS,
        demo_joint_position=shown,
        position=panda.forward(torch.from_numpy(joints)).position.numpy(),
        demo_path=hand_path(demonstration),
        plan_path=run.plan.hand.position.numpy(),
        bodies=run.motion.bodies(),
        boxes=tuple(experiment.workplace.scene.boxes()),
        safety={name: safety[:, i] for i, name in enumerate(SAFETY_COLUMNS)},
        phases=tuple(log.events),
    )


PANDA_LIMITS = viz.JointLimits(
    lower=panda.limits.lower.numpy(), upper=panda.limits.upper.numpy()
)
"""To be drawn beside joint positions."""
