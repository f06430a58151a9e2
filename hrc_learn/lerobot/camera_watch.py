"""Detect in rollouts of any policy that the camera was moved since the demonstrations.

A step of the policy's preprocessor compares the pixel of the tool's marker with the pixel that
the demonstrations predict (`CameraWatch`), and warns if the camera has moved. On request, the
step also replaces the pixels that the policy receives by those that the camera would see from
its old pose (`CameraCorrection`). Actions are not changed.
"""

from __future__ import annotations

import logging
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, cast

import torch
from jaxtyping import Float
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep, ProcessorStepRegistry
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from hrc_learn.demos.read.dataset_folder import read_info
from hrc_learn.demos.read.metadata import flatten_names
from hrc_learn.geometry import Pose
from hrc_learn.jacobian import (
    CameraCorrection,
    CameraMotion,
    CameraReference,
    CameraWatch,
    ImageDemonstration,
    object_height,
)
from hrc_learn.lerobot.arm_values import HAND, MARKER, PIXELS
from hrc_learn.lerobot.policy.policy_base import read_episodes
from hrc_learn.lerobot.smoothing import PREPROCESSOR, read_pipeline
from hrc_learn.store import json_text, parse_json, write_json
from hrc_learn.vision.camera_model import IMAGE_SIZE

CAMERA_WATCH = "hrc_learn_camera_watch"


@ProcessorStepRegistry.register(CAMERA_WATCH)
@dataclass
class CameraWatchStep(ProcessorStep):
    """Warns once per episode if the camera has moved since the demonstrations.

    This step belongs at the beginning of the preprocessor, where state and pixels still have
    their units.
    """

    reference: dict[str, Any]
    """Fields of a `CameraReference`."""
    fps: float
    """Calls a second [1/s]."""
    pose_columns: list[int]
    """Indices of the values `HAND` in the state, in the order of `HAND`."""
    marker_columns: list[int]
    """Indices of the values `MARKER` in the state, in the order of `MARKER`."""
    correct: bool = False
    """Replace pixels by those that the camera would see from its original pose."""
    object_columns: list[int] | None = None
    """Indices of the values `PIXELS` in the state, which are corrected, too; None: no object's
    pixel is corrected."""
    object_height: float = 0.0
    """Height of the plane on which the object lies, from `jacobian.object_height` [m]."""
    motion: CameraMotion | None = field(default=None, init=False, repr=False)
    """Latest detected motion of the camera; None: no motion, or a false alarm. `reset` clears
    it unless pixels are corrected."""

    def __post_init__(self) -> None:
        if not 0 < self.fps < torch.inf:
            raise ValueError(f"fps must be positive, got {self.fps}.")
        text = json_text(self.reference)
        reference = parse_json(text, CameraReference, "reference of the camera watch")
        self._watch = CameraCorrection(reference) if self.correct else CameraWatch(reference)
        self._calls = 0
        # Last pixel of the marker as seen and as corrected [px].
        self._last: tuple[Tensor, Tensor] | None = None

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        observation = transition.get(TransitionKey.OBSERVATION) or {}
        state = observation.get(OBS_STATE)
        self._calls += 1
        if state is None:
            return transition
        if state.ndim > 1 and len(state) > 1:
            raise ValueError(
                f"a camera is watched in one environment at a time, but this batch has "
                f"{len(state)}: set eval.batch_size to 1, or train before adding the watch."
            )
        values = state.reshape(-1).double().cpu()
        marker = values[self.marker_columns]
        pose = self._look(values, marker)
        if not (isinstance(self._watch, CameraCorrection) and self._watch.motion):
            return transition
        values = values.clone()
        if self.object_columns is not None:
            pixel = self._watch.object(self.object_height, values[self.object_columns])
            values[self.object_columns] = pixel
        if pose is not None:
            self._last = marker[:2], self._watch.marker(pose, marker[:2])
        # While the marker is hidden, a robot may repeat its last pixel.
        if self._last is not None and torch.equal(marker[:2], self._last[0]):
            values[self.marker_columns[:2]] = self._last[1]
        corrected = {**observation, OBS_STATE: values.to(state).reshape(state.shape)}
        return cast(EnvTransition, {**transition, TransitionKey.OBSERVATION: corrected})

    def _look(self, state: Float[Tensor, " values"], marker: Float[Tensor, "3"]) -> Pose | None:
        """Update the watch; return the tool's pose, or None if the marker is hidden."""
        vector = state[self.pose_columns]
        if marker[2] < 0.5 or not (marker.isfinite().all() and vector.isfinite().all()):
            return None
        pose = Pose.from_vector(vector)
        seen = self._watch.update(self._calls / self.fps, pose, marker[:2])
        if seen is not None:
            if self.correct:
                logging.warning("%s since the demonstrations: its pixels are corrected.", seen)
            elif self.motion is None:
                logging.warning(
                    "%s since the demonstrations: move it back, or record and fit again.", seen
                )
            self.motion = seen
        if isinstance(self._watch, CameraCorrection):
            self.motion = self._watch.motion
        return pose

    def reset(self) -> None:
        self._watch.clear()
        self._last = None
        if not self.correct:
            self.motion = None

    def get_config(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in fields(self) if f.init}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features


def add_camera_watch(
    checkpoint: str | Path,
    dataset: str | Path,
    image_size: tuple[int, int] = IMAGE_SIZE,
    *,
    correct: bool = False,
) -> CameraReference:
    """Add a watch of the camera to a trained policy's checkpoint.

    A step from an earlier call is replaced. Weights and all other steps stay as they are.

    Args:
        checkpoint: Folder `pretrained_model` of a checkpoint of any policy.
        dataset: Training data, with the tool's pose and its marker's pixel in every frame.
        image_size: Width and height of the camera's images [px].
        correct: True to correct the pixels of the marker, and of an object if there is one. The
            object's pixel must be known in the first frame of each episode, and the tool must
            be lowest where it grasps the object.

    Returns:
        Reference of the camera in the demonstrations.

    Raises:
        FileNotFoundError: The folder holds no preprocessor.
        ValueError: The dataset lacks a column, which the message names, or the object was not
            grasped where it was seen.
    """
    path = Path(checkpoint, PREPROCESSOR)
    content = read_pipeline(path, without=(CAMERA_WATCH,))
    info = read_info(Path(dataset))
    names = flatten_names(info["features"].get(OBS_STATE, {}).get("names")) or ()
    index = {f"{name.removesuffix('.pos')}.pos": i for i, name in enumerate(names)}
    if missing := [name for name in (*HAND, *MARKER) if name not in index]:
        raise ValueError(
            f"{dataset}: {OBS_STATE} has no {', '.join(missing)}: record the tool's pose and "
            "its marker's pixel (robot.hand=true, robot.marker=true)."
        )
    pose_columns, marker_columns = ([index[n] for n in x] for x in (HAND, MARKER))
    object_columns = [index[name] for name in PIXELS if name in index] or None
    states = [episode[OBS_STATE].double() for episode in read_episodes(dataset, [OBS_STATE])]
    watched = [
        ImageDemonstration(
            pose=Pose.from_vector(x[:, pose_columns]),
            feature=x[:, marker_columns[:2]],
            visible=x[:, marker_columns[2]] > 0.5,
        )
        for x in states
    ]
    fps = float(info["fps"])
    reference = CameraReference.fit(watched, fps, image_size)
    height = 0.0
    if correct and object_columns is not None:
        lowest = [x[x[:, pose_columns[2]].argmin(), pose_columns[:3]] for x in states]
        seen = torch.stack([x[0, object_columns] for x in states])
        height = object_height(reference, torch.stack(lowest), seen)
    step = CameraWatchStep(
        reference=asdict(reference),
        fps=fps,
        pose_columns=pose_columns,
        marker_columns=marker_columns,
        correct=correct,
        object_columns=object_columns if correct else None,
        object_height=height,
    )
    content["steps"].insert(0, {"registry_name": CAMERA_WATCH, "config": step.get_config()})
    write_json(path, content)
    return reference
