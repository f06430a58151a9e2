"""From demonstrations of visual servoing: image Jacobian, visual target, approach direction."""

import copy
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, overload

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
    maximize_evidence,
)
from hrc_learn.kinematics import panda
from hrc_learn.kinematics.tool_orientation import Approach
from hrc_learn.skills.visual_skill import OBJECT_FEATURE, VisualServoSkill, VisualTarget

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
    camera = FeatureTrajectories(demos)
    config = config or ImageJacobianFitConfig()
    neurons = neurons or RBFCenters.around(camera)
    learned = None
    if learning is not None and len(demos) >= learning.hold_out:
        learned = maximize_evidence(camera, neurons, config, learning, on_round)
        neurons, config = learned.neurons, learned.config
    network = RBFImageJacobian.fit_demonstrations(camera, neurons, config)
    cells = cross_validate(camera, network, config).by_cell()
    ends = _ends(demos, network)
    return VisualServoSkill(
        jacobian=network,
        target=_visual_target(ends) if ends else None,
        approach=Approach.fit([end.path for end in ends]) if ends else None,
        learned=learned,
        cells=cells,
    )


class FeatureTrajectories(Sequence[ImageDemonstration]):
    """Demonstrations as the fit of an image Jacobian takes them, read when asked for."""

    def __init__(self, demos: Sequence[Demonstration], source: str | None = None):
        self._demos = demos
        self._source = getattr(demos, "source", "") if source is None else source

    @overload
    def __getitem__(self, index: int) -> ImageDemonstration: ...
    @overload
    def __getitem__(self, index: slice) -> "FeatureTrajectories": ...
    def __getitem__(self, index):
        if isinstance(index, slice):
            return FeatureTrajectories(self._demos[index], self._source)
        return _watched(self._demos[index], self._source)

    def __len__(self) -> int:
        return len(self._demos)

    def __iter__(self) -> Iterator[ImageDemonstration]:
        return (_watched(demo, self._source) for demo in self._demos)


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
        return Pose(_double(demo.position), _double(demo.orientation))
    if demo.joint_position is not None and demo.joint_names == panda.joint_names:
        return panda.forward(_double(demo.joint_position))
    return None


def _double(values: np.ndarray) -> Tensor:
    return torch.from_numpy(values).double()


class _End(NamedTuple):
    """How a demonstration came to stand above the object."""

    object_pixel: Float[np.ndarray, "2"]
    hand_pixel: Float[np.ndarray, "2"]
    jacobian: Float[np.ndarray, "2 6"]
    path: Pose


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
    image_demonstrations = _watched(demo, source)
    at_rest = torch.from_numpy(demo.time > demo.time[-1] - _REST)
    last = (image_demonstrations.visible & at_rest).nonzero()[:, 0]
    if not len(last):
        raise ValueError(
            f"{source}, episode {demo.episode}: the end effector's marker is not seen in "
            f"the last {_REST} s, where it is above the object. Leave this episode out."
        )
    with torch.no_grad():
        jacobian = network(image_demonstrations.pose[last]).mean(dim=0)
    return _End(
        object_pixel=demo.extra[OBJECT_FEATURE][last.numpy(), :2].mean(axis=0),
        hand_pixel=image_demonstrations.feature[last].mean(dim=0).numpy(),
        jacobian=jacobian.numpy(),
        path=image_demonstrations.pose,
    )


def _visual_target(ends: Sequence[_End]) -> VisualTarget:
    return VisualTarget.fit(
        np.array([end.object_pixel for end in ends]),
        np.array([end.hand_pixel for end in ends]),
        np.array([end.jacobian for end in ends]),
    )
