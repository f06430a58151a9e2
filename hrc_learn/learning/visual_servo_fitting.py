"""Fit a visual servoing skill to demonstrations: image Jacobian, visual target, approach."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.demos import Demonstration, DemonstrationSet, DemonstrationSource
from hrc_learn.distributed import LazyMap
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
from hrc_learn.skills.visual_skill import (
    ANGLE_FEATURE,
    OBJECT_FEATURE,
    MarkerAngle,
    VisualServoSkill,
)
from hrc_learn.skills.visual_target import VisualTarget
from hrc_learn.vision.camera_model import IMAGE_SIZE
from hrc_learn.vision.landmarks import Landmarks

type Demonstrations = DemonstrationSet | DemonstrationSource
"""Demonstrations in memory, or demonstrations on disk that are read one by one."""

_REST = 0.3
"""Duration of the rest above the object at the end of each demonstration [s]."""


def fit_visual_servo(
    demos: Demonstrations,
    neurons: RBFCenters | None = None,
    config: ImageJacobianFitConfig | None = None,
    learning: EvidenceConfig | None = None,
    on_round: Callable[[int, EvidenceRound], None] = lambda number, state: None,
    landmarks: Landmarks | None = None,
) -> VisualServoSkill:
    """Fit the image Jacobian and, if an object was observed, visual target and approach.

    Args:
        demos: Demonstrations with image features, and with end-effector poses or the joint
            positions of a Panda.
        neurons: Neurons of the network. Default: neurons around the demonstrated poses.
        config: Noise, prior and key frames for the network, which learns the residual of the
            fitted camera.
        learning: Settings for learning neurons, noise and prior. These are not learned if
            `learning` is None or there are fewer than `learning.hold_out` demonstrations.
        on_round: Called with the number and result of each round of learning.
        landmarks: Landmarks whose pixels are the image features. None: the image features are
            pixels of markers.

    Raises:
        ValueError: A demonstration lacks a column; the message names it and the episode.
    """
    watched = feature_trajectories(demos)
    image_size = IMAGE_SIZE if landmarks is None else landmarks.image_size
    camera = fit_camera(watched, image_size)
    config = config or ImageJacobianFitConfig.of_residual()
    neurons = neurons or RBFCenters.around(watched)
    learned = None
    if learning is not None and len(demos) >= learning.hold_out:
        left = unexplained(watched, camera.camera)
        learned = maximize_evidence(left, neurons, config, learning, on_round)
        neurons, config = learned.kept.neurons, learned.kept.config
    network = RBFImageJacobian.fit(watched, neurons, config, camera)
    held_out = cross_validate(watched, network, config, image_size)
    assert network.report is not None
    network.report = replace(
        network.report,
        motion=float(held_out.motion.square().sum(-1).mean().sqrt()),
        held_out_error=float(held_out.error.square().sum(-1).mean().sqrt()),
    )
    ends = _ends(demos, partial=landmarks is not None)
    target = None
    if ends:
        objects = np.array([end.object_pixel for end in ends], dtype=np.float64)
        target = VisualTarget.fit(
            camera.camera, objects, Pose.stack([end.pose for end in ends])
        )
    return VisualServoSkill(
        jacobian=network,
        target=target,
        approach=Approach.fit([end.path for end in ends]) if ends else None,
        angle=None if target is None else _marker_angle(ends, camera.camera, target),
        learned=learned,
        landmarks=landmarks,
        cells=held_out.by_cell(),
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
    """End of a demonstration, at rest above the object.

    Attributes:
        object_pixel: Pixel of the object's marker, mean over the rest [px].
        pose: Pose of the end effector at rest.
        path: Poses of the end effector along the whole demonstration.
        angle: Direction of the object's marker in the image [rad]; None: not recorded.
    """

    object_pixel: Float[np.ndarray, "2"]
    pose: Pose
    path: Pose
    angle: float | None


def _ends(demos: Demonstrations, *, partial: bool = False) -> list[_End]:
    """Ends of the demonstrations that show an object.

    Raises:
        ValueError: Only some demonstrations show an object, and `partial` is False.
    """
    ends, without = [], []
    for demo in demos:
        if OBJECT_FEATURE in demo.extra:
            ends.append(_end(demo, demos.source))
        else:
            without.append(demo.episode)
    if ends and without and not partial:
        raise ValueError(
            f"{demos.source}, episode {without[0]}: no {OBJECT_FEATURE}, unlike other episodes."
        )
    return ends


def _end(demo: Demonstration, source: str) -> _End:
    """End of a demonstration, with positions and pixels averaged over the rest."""
    watched = _watched(demo, source)
    # The columns are u, v and a flag, which is 1 while the object is visible.
    objects = demo.extra[OBJECT_FEATURE]
    at_rest = torch.from_numpy((demo.time > demo.time[-1] - _REST) & (objects[:, 2] > 0))
    last = (watched.visible & at_rest).nonzero()[:, 0]
    if not len(last):
        raise ValueError(
            f"{source}, episode {demo.episode}: end effector and object are not visible in "
            f"the last {_REST} s, at rest above the object. Leave this episode out."
        )
    angles = demo.extra.get(ANGLE_FEATURE)
    place = watched.pose.position[last].mean(dim=0)
    return _End(
        object_pixel=objects[last.numpy(), :2].mean(axis=0),
        pose=Pose(place, watched.pose.orientation[last[-1]]),
        path=watched.pose,
        angle=None if angles is None else float(angles[int(last[-1]), 1]),
    )


def _marker_angle(
    ends: Sequence[_End], camera: Float[Tensor, "13"], target: VisualTarget
) -> MarkerAngle | None:
    """Turn of the end effector relative to the object's marker; None if no demonstration gives
    the direction of that marker.
    """
    known = [end for end in ends if end.angle is not None and np.isfinite(end.angle)]
    if not known:
        return None
    objects = np.array([end.object_pixel for end in known], dtype=np.float64)
    angles = [end.angle for end in known if end.angle is not None]
    return MarkerAngle.fit(
        camera, objects, angles, Pose.stack([end.pose for end in known]), target
    )
