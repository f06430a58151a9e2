"""From demonstrations as they were read to a recording to look at."""

import numpy as np
import torch

from ..demos import Demonstration, DemonstrationSet
from ..kinematics import panda
from ..viz import DemonstrationsRecording, JointLimits, ShownDemonstration
from .panda_bodies import panda_bodies


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


def _shown(demo: Demonstration, is_panda: bool) -> ShownDemonstration:
    q, position = demo.joint_position, demo.position
    bodies = ()
    if is_panda and q is not None:
        bodies = panda_bodies(q)
        if position is None:
            position = panda.forward(torch.from_numpy(q)).position.numpy()
    return ShownDemonstration(
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
