"""Demonstrations and learned image Jacobians as recordings to look at."""

from itertools import islice

import numpy as np
import torch

from hrc_learn.demos import Demonstration, DemonstrationSet
from hrc_learn.jacobian import EvidenceResult, RBFCenters
from hrc_learn.kinematics import panda
from hrc_learn.learning.visual_servo_fitting import Demonstrations, FeatureTrajectories
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.viz import (
    DemonstrationsRecording,
    DemonstrationTrace,
    ErrorMap,
    JointLimits,
    LearningRecording,
)
from hrc_learn.viz.arm_bodies import panda_bodies

# Paths drawn at most: more hide each other.
_MOST_PATHS = 30
# Distance of the error map under the lowest path, so that both can be seen [m].
_BELOW = 0.03


def learning_recording(
    skill: VisualServoSkill, demos: Demonstrations, title: str
) -> LearningRecording:
    """What is to be shown of a skill just fitted.

    Args:
        skill: With its held-out errors, and the rounds of learning if there were any.
        demos: That it was fitted to; the first of them are drawn.
        title: Of the recording.

    Raises:
        ValueError: If the skill was loaded: only one just fitted knows how it was learned.
    """
    measured, cells = skill.metrics(), skill.cells
    assert cells is not None  # or there would be no metrics
    paths = tuple(
        image_demonstrations.pose.position.numpy()
        for image_demonstrations in islice(FeatureTrajectories(demos), _MOST_PATHS)
    )
    height = float(np.mean([path[:, 2].mean() for path in paths]))
    x, y = cells.edges.mT.numpy()
    learned = skill.learned
    return LearningRecording(
        title=title,
        measured=measured,
        curves={} if learned is None else _curves(learned),
        best=0 if learned is None else learned.best,
        centers=_centers(learned, height),
        paths=paths,
        errors=ErrorMap(
            x=x,
            y=y,
            z=min(float(path[:, 2].min()) for path in paths) - _BELOW,
            share=cells.relative.numpy(),
        ),
    )


def _curves(learned: EvidenceResult) -> dict[str, np.ndarray]:
    rounds, configs = learned.rounds, [state.config for state in learned.rounds]
    return {
        "Error on demonstrations held out [px]": np.array([s.held_out_error for s in rounds]),
        "Negative log evidence per pair [-]": np.array([s.evidence for s in rounds]),
        "Width of the neurons [m, rad]": np.array([float(s.neurons.width) for s in rounds]),
        "Noise of the camera [px]": np.array([c.pixel_noise for c in configs]),
        "Prior deviation, common part [px/m]": np.array([c.bias_std for c in configs]),
        "Prior deviation, weights [px/m]": np.array([c.weight_std for c in configs]),
    }


def _centers(learned: EvidenceResult | None, height: float) -> np.ndarray:
    if learned is None:
        return np.zeros((1, 0, 3))
    return np.stack([_places(state.neurons, height) for state in learned.rounds])


def _places(neurons: RBFCenters, height: float) -> np.ndarray:
    """Where neurons stand [m]; those that do not see a coordinate, in the middle of it."""
    centers, places = neurons.centers.numpy(), np.zeros((len(neurons.centers), 3))
    places[:, 2] = height
    for column, component in enumerate(neurons.input_indices):
        if component < 3:
            places[:, component] = centers[:, column]
    return places


def demonstrations_recording(demos: DemonstrationSet, title: str) -> DemonstrationsRecording:
    """Everything worth looking at; a Panda is drawn, and its hand's path found if unrecorded.

    Args:
        demos: All by one robot.
        title: What they are.
    """
    names = demos[0].joint_names
    known = names == panda.joint_names
    limits = panda.limits
    return DemonstrationsRecording(
        title=title,
        joint_names=names,
        demonstrations=tuple(_shown(demo, known) for demo in demos),
        joint_limits=JointLimits(lower=limits.lower.numpy(), upper=limits.upper.numpy())
        if known
        else None,
        notes=tuple(str(note) for note in demos.notes),
    )


def _shown(demo: Demonstration, is_panda: bool) -> DemonstrationTrace:
    q, position = demo.joint_position, demo.position
    bodies = ()
    if is_panda and q is not None:
        bodies = panda_bodies(q)
        if position is None:
            position = panda.forward(torch.from_numpy(q)).position.numpy()
    return DemonstrationTrace(
        episode=demo.episode,
        task=demo.task,
        time=demo.time,
        joint_position=q,
        position=position,
        feature=_seen(demo),
        human_effort=demo.human_effort,
        gripper=demo.gripper,
        bodies=bodies,
    )


def _seen(demo: Demonstration) -> np.ndarray | None:
    """The feature, NaN where it was not seen."""
    if demo.feature is None or demo.feature_visible is None:
        return demo.feature
    return np.where(demo.feature_visible[:, None], demo.feature, np.nan)
