"""Visual servoing skills of demonstrations: image Jacobian, target in the image, approach."""

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.demos import Demonstration, DemonstrationSet, DemonstrationSource
from hrc_learn.geometry import Pose
from hrc_learn.jacobian import (
    EvidenceConfig,
    EvidenceRound,
    ImageDemonstration,
    ImageJacobianFitConfig,
    RBFCenters,
    RBFImageJacobian,
    cross_validate,
    fit_camera,
    maximize_evidence,
    unexplained,
)
from hrc_learn.kinematics import panda
from hrc_learn.kinematics.tool_orientation import Approach
from hrc_learn.learning.large_datasets import LazyMap
from hrc_learn.skills.marker_sensor import AngleDemonstration, MarkerAngle
from hrc_learn.skills.visual_skill import (
    ANGLE_FEATURE,
    OBJECT_FEATURE,
    VisualServoSkill,
    VisualTarget,
)
from hrc_learn.vision.camera_model import IMAGE_SIZE

type Demonstrations = DemonstrationSet | DemonstrationSource
"""Demonstrations in memory, or read one by one."""

_REST = 0.3
"""Time at the end of a demonstration in which the end effector rests above the object [s]."""


def fit_visual_servo(
    demos: Demonstrations,
    neurons: RBFCenters | None = None,
    config: ImageJacobianFitConfig | None = None,
    learning: EvidenceConfig | None = None,
    on_round: Callable[[int, EvidenceRound], None] = lambda number, state: None,
) -> VisualServoSkill:
    """Fit the image Jacobian and, if an object was observed, target and approach.

    Args:
        demos: Demonstrations with image features and end-effector poses, or a Panda's joints.
        neurons: Neurons of the network. Default: around the demonstrated poses.
        config: Noise, prior and choice of key frames of what the camera leaves.
        learning: Learning of neurons, noise and prior. None, or too few demonstrations to hold
            one out: they stay as they are.
        on_round: Called after every round of learning.

    Raises:
        ValueError: A demonstration lacks a column; the message names it and the episode.
    """
    watched = feature_trajectories(demos)
    camera = fit_camera(watched, IMAGE_SIZE)
    config = config or ImageJacobianFitConfig.of_residual()
    neurons = neurons or RBFCenters.around(watched)
    learned = None
    if learning is not None and len(demos) >= learning.hold_out:
        left = unexplained(watched, camera.camera)
        learned = maximize_evidence(left, neurons, config, learning, on_round)
        neurons, config = learned.neurons, learned.config
    network = RBFImageJacobian.fit(watched, neurons, config, camera)
    held_out = cross_validate(watched, network, config, IMAGE_SIZE)
    assert network.report is not None
    network.report = replace(
        network.report,
        motion=float(held_out.motion.square().sum(-1).mean().sqrt()),
        held_out_error=float(held_out.error.square().sum(-1).mean().sqrt()),
    )
    cells = held_out.by_cell()
    ends = _ends(demos, network)
    focal = float(camera.camera[0].exp())
    return VisualServoSkill(
        jacobian=network,
        target=_visual_target(ends, focal) if ends else None,
        approach=Approach.fit([end.path for end in ends]) if ends else None,
        angle=_marker_angle([end.angle for end in ends if end.angle is not None]),
        learned=learned,
        cells=cells,
    )


def feature_trajectories(demos: Demonstrations) -> Sequence[ImageDemonstration]:
    """Poses and image features of demonstrations, read on access."""
    return LazyMap(demos, partial(_watched, source=demos.source))


def _watched(demo: Demonstration, source: str) -> ImageDemonstration:
    missing = [name for name in ("feature", "feature_visible") if getattr(demo, name) is None]
    pose = _pose(demo)
    missing += ["position, orientation"] if pose is None else []
    if missing or pose is None or demo.feature is None or demo.feature_visible is None:
        raise ValueError(
            f"{source}, episode {demo.episode}: no {', '.join(missing)}. An image Jacobian "
            "needs the end effector's pose and its marker's pixel in every frame."
        )
    return ImageDemonstration(
        pose=pose,
        feature=torch.from_numpy(demo.feature).double(),
        visible=torch.from_numpy(demo.feature_visible),
    )


def _pose(demo: Demonstration) -> Pose | None:
    """Pose of the end effector, recorded or computed from a Panda's joints."""
    if demo.position is not None and demo.orientation is not None:
        position, orientation = map(torch.from_numpy, (demo.position, demo.orientation))
        return Pose(position.double(), orientation.double())
    if demo.joint_position is not None and demo.joint_names == panda.joint_names:
        return panda.forward(torch.from_numpy(demo.joint_position).double())
    return None


class _End(NamedTuple):
    """Final state of a demonstration, at rest above the object."""

    object_pixel: Float[np.ndarray, "2"]
    tool_pixel: Float[np.ndarray, "2"]
    jacobian: Float[np.ndarray, "2 6"]
    path: Pose
    orientation: Tensor
    angle: AngleDemonstration | None


def _ends(demos: Demonstrations, network: RBFImageJacobian) -> list[_End]:
    """Final states of all demonstrations, or none if no object was observed."""
    ends, without = [], []
    network = copy.deepcopy(network).double()
    for demo in demos:
        if OBJECT_FEATURE in demo.extra:
            ends.append(_end(demo, demos.source, network))
        else:
            without.append(demo.episode)
    if ends and without:
        raise ValueError(
            f"{demos.source}, episode {without[0]}: no {OBJECT_FEATURE}, as in other episodes."
        )
    return ends


def _end(demo: Demonstration, source: str, network: RBFImageJacobian) -> _End:
    """Final state of a demonstration, averaged over the rest at its end."""
    watched = _watched(demo, source)
    at_rest = torch.from_numpy(demo.time > demo.time[-1] - _REST)
    last = (watched.visible & at_rest).nonzero()[:, 0]
    if not len(last):
        raise ValueError(
            f"{source}, episode {demo.episode}: the end effector's marker is not visible in "
            f"the last {_REST} s, at rest above the object. Leave this episode out."
        )
    with torch.no_grad():
        jacobian = network(watched.pose[last]).mean(dim=0)
    return _End(
        object_pixel=demo.extra[OBJECT_FEATURE][last.numpy(), :2].mean(axis=0),
        tool_pixel=watched.feature[last].mean(dim=0).numpy(),
        jacobian=jacobian.numpy(),
        path=watched.pose,
        orientation=watched.pose.orientation[last[-1]],
        angle=_angles(demo, watched, int(last[-1])),
    )


def _angles(
    demo: Demonstration, watched: ImageDemonstration, last: int
) -> AngleDemonstration | None:
    """Directions of the markers along a demonstration; None if they were not recorded."""
    if ANGLE_FEATURE not in demo.extra:
        return None
    tool, item = torch.from_numpy(demo.extra[ANGLE_FEATURE]).double().T
    return AngleDemonstration(
        pose=watched.pose,
        tool=torch.where(watched.visible, tool, torch.nan),
        item=float(item[last]),
        final=float(tool[last]),
    )


def _marker_angle(demonstrations: Sequence[AngleDemonstration]) -> MarkerAngle | None:
    return MarkerAngle.fit(demonstrations) if demonstrations else None


def _visual_target(ends: Sequence[_End], focal: float) -> VisualTarget:
    return VisualTarget.fit(
        np.array([end.object_pixel for end in ends]),
        np.array([end.tool_pixel for end in ends]),
        np.array([end.jacobian for end in ends]),
        torch.stack([end.orientation for end in ends]),
        focal,
    )
