"""From demonstrations of visual servoing: image Jacobian, target in the image, approach; and a
recording of what was learned.
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import islice
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.demos import Demonstration, DemonstrationSet, DemonstrationSource
from hrc_learn.geometry import Pose
from hrc_learn.jacobian import (
    EvidenceConfig,
    EvidenceResult,
    EvidenceRound,
    ImageDemonstration,
    ImageJacobianFitConfig,
    RBFCenters,
    RBFImageJacobian,
    cross_validate,
    fit_focal_length,
    maximize_evidence,
)
from hrc_learn.kinematics import panda
from hrc_learn.kinematics.tool_orientation import Approach
from hrc_learn.learning.channels import LazyMap
from hrc_learn.skills.marker_angle import AngleDemonstration, MarkerAngle
from hrc_learn.skills.visual_skill import (
    ANGLE_FEATURE,
    OBJECT_FEATURE,
    VisualServoSkill,
    VisualTarget,
)
from hrc_learn.vision.camera_model import IMAGE_SIZE
from hrc_learn.viz import (
    ErrorMap,
    LearningRecording,
)

type Demonstrations = DemonstrationSet | DemonstrationSource
"""In memory, or read one by one."""

_REST = 0.3
"""Time at the end of a demonstration in which the end effector rests above the object [s]."""


def fit_visual_servo(
    demos: Demonstrations,
    neurons: RBFCenters | None = None,
    config: ImageJacobianFitConfig | None = None,
    learning: EvidenceConfig | None = None,
    on_round: Callable[[int, EvidenceRound], None] = lambda number, state: None,
) -> VisualServoSkill:
    """Fit image Jacobian and, where an object was watched, visual target and approach.

    Args:
        demos: With image features and end-effector poses, or joint positions of a Panda.
        neurons: Of the network; None: about the poses that were shown.
        config: Noise, prior and choice of key frames.
        learning: How to learn neurons, noise and prior; None: not at all. Too few
            demonstrations to hold one out are fitted without.
        on_round: Told of every round of learning.

    Raises:
        ValueError: If a demonstration lacks a column; names it and the episode.
    """
    camera = feature_trajectories(demos)
    config = config or ImageJacobianFitConfig()
    neurons = neurons or RBFCenters.around(camera)
    learned = None
    if learning is not None and len(demos) >= learning.hold_out:
        learned = maximize_evidence(camera, neurons, config, learning, on_round)
        neurons, config = learned.neurons, learned.config
    network = RBFImageJacobian.fit_demonstrations(camera, neurons, config)
    cells = cross_validate(camera, network, config).by_cell()
    ends = _ends(demos, network)
    focal = fit_focal_length(camera, copy.deepcopy(network).double(), IMAGE_SIZE)
    return VisualServoSkill(
        jacobian=network,
        target=_visual_target(ends, focal) if ends else None,
        approach=Approach.fit([end.path for end in ends]) if ends else None,
        angle=_marker_angle([end.angle for end in ends if end.angle is not None]),
        learned=learned,
        cells=cells,
    )


def feature_trajectories(demos: Demonstrations) -> Sequence[ImageDemonstration]:
    """Demonstrations as the fit of an image Jacobian takes them, read when asked for."""
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
    """Of the end effector, as recorded or from the joints of a known arm."""
    if demo.position is not None and demo.orientation is not None:
        position, orientation = map(torch.from_numpy, (demo.position, demo.orientation))
        return Pose(position.double(), orientation.double())
    if demo.joint_position is not None and demo.joint_names == panda.joint_names:
        return panda.forward(torch.from_numpy(demo.joint_position).double())
    return None


class _End(NamedTuple):
    """How a demonstration came to stand above the object."""

    object_pixel: Float[np.ndarray, "2"]
    hand_pixel: Float[np.ndarray, "2"]
    jacobian: Float[np.ndarray, "2 6"]
    path: Pose
    orientation: Tensor
    angle: AngleDemonstration | None


def _ends(demos: Demonstrations, network: RBFImageJacobian) -> list[_End]:
    """Of all demonstrations if an object was watched in them; none if in none."""
    ends, without = [], []
    network = copy.deepcopy(network).double()
    for demo in demos:
        if OBJECT_FEATURE in demo.extra:
            ends.append(_end(demo, demos.source, network))
        else:
            without.append(demo.episode)
    if ends and without:
        raise ValueError(
            f"{demos.source}, episode {without[0]}: no {OBJECT_FEATURE}, which others have."
        )
    return ends


def _end(demo: Demonstration, source: str, network: RBFImageJacobian) -> _End:
    """Means over the rest at the end."""
    watched = _watched(demo, source)
    at_rest = torch.from_numpy(demo.time > demo.time[-1] - _REST)
    last = (watched.visible & at_rest).nonzero()[:, 0]
    if not len(last):
        raise ValueError(
            f"{source}, episode {demo.episode}: the end effector's marker is not seen in "
            f"the last {_REST} s, where it is above the object. Leave this episode out."
        )
    with torch.no_grad():
        jacobian = network(watched.pose[last]).mean(dim=0)
    return _End(
        object_pixel=demo.extra[OBJECT_FEATURE][last.numpy(), :2].mean(axis=0),
        hand_pixel=watched.feature[last].mean(dim=0).numpy(),
        jacobian=jacobian.numpy(),
        path=watched.pose,
        orientation=watched.pose.orientation[last[-1]],
        angle=_angles(demo, watched, int(last[-1])),
    )


def _angles(
    demo: Demonstration, watched: ImageDemonstration, last: int
) -> AngleDemonstration | None:
    """Directions of the markers along a demonstration; None where they were not recorded."""
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
        np.array([end.hand_pixel for end in ends]),
        np.array([end.jacobian for end in ends]),
        torch.stack([end.orientation for end in ends]),
        focal,
    )


# Paths drawn at most: more hide each other.
_MOST_PATHS = 30
# Distance of the error map under the lowest path, so that both can be seen [m].
_BELOW = 0.03


def learning_recording(
    skill: VisualServoSkill,
    demos: Demonstrations,
    title: str,
    images: Mapping[str, bytes] | None = None,
) -> LearningRecording:
    """What is to be shown of a skill just fitted.

    Args:
        skill: With its held-out errors, and the rounds of learning if there were any.
        demos: That it was fitted to; the first of them are drawn.
        title: Of the recording.
        images: JPEG files by what they show.

    Raises:
        ValueError: If the skill was loaded: only one just fitted knows how it was learned.
    """
    measured, cells = skill.metrics(), skill.cells
    assert cells is not None  # or there would be no metrics
    shown = islice(feature_trajectories(demos), _MOST_PATHS)
    paths = tuple(watched.pose.position.numpy() for watched in shown)
    height = float(np.mean([path[:, 2].mean() for path in paths]))
    x, y = cells.edges.mT.numpy()
    learned = skill.learned
    return LearningRecording(
        title=title,
        measured=measured,
        curves={} if learned is None else _curves(learned),
        best=0 if learned is None else learned.best,
        centers=np.zeros((1, 0, 3))
        if learned is None
        else np.stack([_places(state.neurons, height) for state in learned.rounds]),
        paths=paths,
        errors=ErrorMap(
            x=x,
            y=y,
            z=min(float(path[:, 2].min()) for path in paths) - _BELOW,
            share=cells.relative.numpy(),
        ),
        images=images or {},
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


def _places(neurons: RBFCenters, height: float) -> np.ndarray:
    """Where neurons stand [m]; those that do not see a coordinate, in the middle of it."""
    centers, places = neurons.centers.numpy(), np.zeros((len(neurons.centers), 3))
    places[:, 2] = height
    for column, component in enumerate(neurons.input_indices):
        if component < 3:
            places[:, component] = centers[:, column]
    return places
