"""Notices in a rollout of any policy that the camera was moved since the demonstrations.

A step of the policy's preprocessor: it compares where the marker of the tool is seen with where
the demonstrations say it must be (`CameraWatch`), and warns. Actions are left as they are.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep, ProcessorStepRegistry
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from hrc_learn.controller.interface import IMAGE_SIZE
from hrc_learn.demos import load_demos
from hrc_learn.demos.format.dataset_folder import read_info
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import CameraMotion, CameraReference, CameraWatch
from hrc_learn.learning.visual_servo_fitting import feature_trajectories
from hrc_learn.lerobot.smoothing import PREPROCESSOR, read_pipeline
from hrc_learn.lerobot.smoothing.limits import write_json

CAMERA_WATCH = "hrc_learn_camera_watch"
POSE_NAMES = ("ee.x", "ee.y", "ee.z", "ee.wx", "ee.wy", "ee.wz")
"""Of the values of a state that hold the tool's pose: position [m], rotation vector [rad]."""
FEATURE = "observation.image_feature"
"""Pixel u, v of the tool's marker, and whether it is seen."""


@ProcessorStepRegistry.register(CAMERA_WATCH)
@dataclass
class CameraWatchStep(ProcessorStep):
    """Warns once an episode when the camera does not stand where it stood.

    Belongs at the beginning of the preprocessor, where state and pixel have their units.
    """

    reference: dict[str, Any]
    """What `CameraReference.content` returned."""
    fps: float
    """Calls a second [1/s]."""
    pose_columns: list[int]
    """Of the state, the values called `POSE_NAMES`, in that order."""
    feature: str = FEATURE
    """Observation with the pixel and whether it is seen."""
    motion: CameraMotion | None = field(default=None, init=False, repr=False)
    """As seen last in this episode; None while the camera stands still."""

    def __post_init__(self) -> None:
        if not self.fps > 0:
            raise ValueError(f"fps must be positive, got {self.fps}.")
        if len(self.pose_columns) != len(POSE_NAMES):
            raise ValueError(
                f"pose_columns must be those of {', '.join(POSE_NAMES)}, got "
                f"{len(self.pose_columns)} of them."
            )
        self._watch = CameraWatch(CameraReference.from_content(self.reference))
        self._calls = 0

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        observation = transition.get(TransitionKey.OBSERVATION) or {}
        state, feature = observation.get(OBS_STATE), observation.get(self.feature)
        self._calls += 1
        if state is None or feature is None:
            return transition
        if state.ndim > 1 and len(state) > 1:
            raise ValueError(
                f"a camera is watched in one environment at a time, but this batch has "
                f"{len(state)}: set eval.batch_size to 1."
            )
        self._look(state.reshape(-1).double().cpu(), feature.reshape(-1).double().cpu())
        return transition

    def _look(self, state: Float[Tensor, " values"], feature: Float[Tensor, "3"]) -> None:
        u, v, visible = feature.tolist()
        vector = state[self.pose_columns]
        if visible < 0.5 or not (feature.isfinite().all() and vector.isfinite().all()):
            return
        pose = Pose(vector[:3], quaternion.exp(vector[3:]))
        seen = self._watch.update(self._calls / self.fps, pose, torch.tensor([u, v]).numpy())
        if seen is not None:
            if self.motion is None:
                logging.warning(
                    "%s since the demonstrations: move it back, or record and fit again.", seen
                )
            self.motion = seen

    def reset(self) -> None:
        self._watch.clear()
        self.motion = None

    def get_config(self) -> dict[str, Any]:
        return {
            "reference": self.reference,
            "fps": self.fps,
            "pose_columns": self.pose_columns,
            "feature": self.feature,
        }

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features


def add_camera_watch(
    checkpoint: Path, dataset: Path, image_size: tuple[int, int] = IMAGE_SIZE
) -> CameraReference:
    """Let a trained policy's camera be watched wherever its checkpoint is used.

    A step from an earlier call is replaced. Weights and all other steps stay as they are.

    Args:
        checkpoint: Folder `pretrained_model` of a checkpoint of any policy.
        dataset: It was trained on, with the tool's pose and its marker's pixel in every frame.
        image_size: Width and height of the camera's images [px].

    Returns:
        Where the camera stood.

    Raises:
        FileNotFoundError: The folder holds no preprocessor.
        ValueError: The dataset lacks a column; names it.
    """
    path = checkpoint / PREPROCESSOR
    content = read_pipeline(path, without=(CAMERA_WATCH,))
    names = list(read_info(dataset)["features"][OBS_STATE]["names"])
    if missing := [name for name in POSE_NAMES if name not in names]:
        raise ValueError(
            f"{dataset}: {OBS_STATE} has no {', '.join(missing)}: the tool's pose is needed to "
            "know where its marker must be seen."
        )
    demos = load_demos(dataset)
    watched = list(feature_trajectories(demos))
    fps = float(read_info(dataset)["fps"])
    reference = CameraReference.fit(watched, fps, image_size)
    step = CameraWatchStep(
        reference=reference.content(),
        fps=fps,
        pose_columns=[names.index(name) for name in POSE_NAMES],
    )
    content["steps"].insert(0, {"registry_name": CAMERA_WATCH, "config": step.get_config()})
    write_json(path, content)
    return reference
