"""Settings and construction common to all policies, and the demonstrations they learn from."""

import logging
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig, LRSchedulerConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from safetensors import SafetensorError
from torch import Tensor, nn

from hrc_learn.demos.read.dataset_folder import open_folder, select_episodes
from hrc_learn.demos.read.frames import read_frames
from hrc_learn.demos.read.metadata import flatten_names
from hrc_learn.lerobot.policy.action_encoding import (
    ActionEncoding,
    matched_columns,
    rotation_triples,
)
from hrc_learn.lerobot.policy.observation_encoder import Observation, ObservationEncoder

logger = logging.getLogger(__name__)

Statistics = Mapping[str, Mapping[str, Any]]
"""Mean, spread, minimum and maximum of each feature of a dataset, by key."""


@dataclass
class MotionPolicyConfig(PreTrainedConfig):
    """Settings of any policy that plans motions, and names of values in its dataset."""

    chunk_size: int = 50
    """Number of actions in a predicted chunk."""
    n_action_steps: int = 25
    """Number of actions that are executed before the next chunk is predicted."""
    vision_backbone: str = "small"
    """Image backbone: "small" (four convolutions), or a ResNet of torchvision, such as
    "resnet18"; no weights are downloaded.
    """
    vision_weights: str | None = None
    """Safetensors file of initial weights for the ResNet, with torchvision's names; None:
    random weights, or the weights of the checkpoint."""
    vision_pretrained: bool = False
    """True if the ResNet started from torchvision's weights; set by `vision_weights`."""
    n_keypoints: int = 32
    """Number of keypoints that the network finds in each image."""
    fit_episodes: list[int] | None = None
    """Episodes for the fit in closed form; None: all. Exclude held-out episodes here."""
    fps: float | None = None
    """Actions a second; None: frame rate of the dataset."""
    state_names: list[str] | None = None
    """Names of the components of observation.state, from the dataset."""
    action_feature_names: list[str] | None = None
    """Names of the components of the action, from the dataset."""
    optimizer_lr: float = 3e-4
    optimizer_weight_decay: float = 1e-4
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(
            ("VISUAL", "STATE", "ENV", "ACTION"), NormalizationMode.IDENTITY
        )
    )
    """Identity: the policy normalises internally, with the same scale for start and actions."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.n_action_steps <= self.chunk_size:
            raise ValueError(
                f"n_action_steps must be 1 to chunk_size ({self.chunk_size}), got "
                f"{self.n_action_steps}"
            )
        if self.n_obs_steps != 1:
            raise ValueError(
                f"the policy {self.type!r} sees one step, got n_obs_steps={self.n_obs_steps}"
            )
        # LeRobot overwrites these fields before it passes the dataset.
        self._trained_for = self.action_feature_names
        self._trained_on = self.state_names

    @property
    def reward_delta_indices(self) -> None:
        """Rewards are not used."""
        return None

    def get_optimizer_preset(self) -> AdamWConfig:
        """AdamW; training starts from the fit in closed form, which is close to a solution."""
        return AdamWConfig(lr=self.optimizer_lr, weight_decay=self.optimizer_weight_decay)

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        """Constant learning rate."""
        return None

    def validate_features(self) -> None:
        """Check that the policy can work with its inputs and outputs.

        Raises:
            ValueError: There is no action, or no input.
        """
        if self.action_feature is None:
            raise ValueError(f"the policy {self.type!r} needs 'action' among its outputs")
        if not self.input_features:
            raise ValueError(
                f"the policy {self.type!r} needs an input: observation.state, "
                "observation.environment_state or images"
            )

    def set_dataset_feature_metadata(self, features: dict[str, dict[str, Any]]) -> None:
        """Read the names of components from a dataset; LeRobot calls this method.

        Raises:
            ValueError: The policy was trained for other actions, on other states, or on states
                in another order.
        """
        self.action_feature_names = _names(features, "action")
        self.state_names = _names(features, "observation.state")
        for before, now, of in (
            (self._trained_for, self.action_feature_names, "for the actions"),
            (self._trained_on, self.state_names, "on observation.state in the order"),
        ):
            if before not in (None, now):
                raise ValueError(
                    f"the policy in {self.pretrained_path} was trained {of} "
                    f"{', '.join(before)}; the dataset has {', '.join(now or ['no names'])}"
                )


def _names(features: dict[str, dict[str, Any]], key: str) -> list[str] | None:
    names = flatten_names(features.get(key, {}).get("names"))
    return None if names is None else list(names)


class MotionPolicy(PreTrainedPolicy):
    """Base class of policies that plan motions and start from a fit in closed form."""

    config_class = MotionPolicyConfig  # pyright: ignore[reportAssignmentType]
    name = "motion"  # pyright: ignore[reportAssignmentType]

    config: Any

    def __init__(
        self,
        config: MotionPolicyConfig,
        dataset_stats: Statistics | None = None,
        dataset_meta: Any = None,
        **_: Any,
    ):
        """Build the policy and, given a dataset, fit it in closed form.

        A loaded policy takes its statistics and weights from the checkpoint instead.

        Args:
            config: Configuration with known features.
            dataset_stats: Statistics for whitening the numbers.
            dataset_meta: `LeRobotDatasetMetadata` with the frame rate and, if the dataset is on
                disk, the folder of the demonstrations.

        Raises:
            ValueError: The policy cannot work with the features, the frame rate is unknown or
                differs from the dataset's, statistics are missing, or the demonstrations
                cannot be fitted.
        """
        super().__init__(config)
        config.validate_features()
        config.fps = frame_rate(config, dataset_meta)
        config.vision_pretrained |= config.vision_weights is not None
        inputs = config.input_features or {}
        widths = {k: inputs[k].shape[0] for k in (OBS_STATE, OBS_ENV_STATE) if k in inputs}
        self.encoder = ObservationEncoder(
            widths,
            {key: feature.shape[0] for key, feature in config.image_features.items()},
            backbone=config.vision_backbone,
            n_keypoints=config.n_keypoints,
            pretrained=config.vision_pretrained,
        )
        if config.vision_weights is not None:
            self.encoder.load_vision(Path(config.vision_weights))
            config.vision_weights = None  # a checkpoint holds the weights itself
        (width,) = (config.output_features or {})[ACTION].shape
        names = config.action_feature_names
        states = config.state_names if OBS_STATE in widths else None
        self.encoding = ActionEncoding(width, rotation_triples(names))
        columns = matched_columns(names, states, (width, widths.get(OBS_STATE, 0)))
        self.measured = nn.Buffer(torch.tensor(columns))
        """State columns that measure the action's components, (A,); -1: not measured."""
        if config.pretrained_path is not None:
            self._build(None)
        else:
            self._whiten(dataset_stats, dataset_meta)
            self._build(dataset_stats)
            self._fit_dataset(dataset_meta)
        self.reset()

    @abstractmethod
    def _build(self, stats: Statistics | None) -> None:
        """Make the network, after the encoders.

        Args:
            stats: Statistics of the dataset; None: unknown, or loaded with the weights.
        """

    def get_optim_params(self) -> Any:
        """All parameters, in one group."""
        return self.parameters()

    @abstractmethod
    def fit(self, demonstrations: list[dict[str, Tensor]]) -> None:
        """Fit demonstrations in closed form, once their statistics are known.

        Args:
            demonstrations: Columns by key, (frames, components).
        """

    def keep_measured(self, states: Sequence[Tensor], actions: Sequence[Tensor]) -> None:
        """Ignore state columns that differ too much from the actions of the same name, such as
        positions if the actions are changes per step.

        Args:
            states: States of each demonstration, (frames, S).
            actions: Coordinates of its actions, (frames, A).
        """
        coordinates = torch.cat([*actions])
        values = torch.cat([*states])[None, :, self.measured.clamp_min(0)].to(coordinates)
        off = self.encoding.to_coordinates(values)[0] - coordinates
        far = off.square().mean(0).sqrt() > MEASURED
        for triple in self.encoding.triples:
            far[triple] = far[triple].any()
        self.measured[far] = -1

    @property
    def _step(self) -> float:
        """Time between actions [s]."""
        return 1 / self.config.fps

    def _require_numbers(self, batch: Observation) -> None:
        """Check that an observation holds the numbers that the policy was trained with.

        Raises:
            ValueError: Numbers are missing, of another width, or not finite.
        """
        kind = self.config.type
        for key, width in self.encoder.widths.items():
            if key not in batch:
                raise ValueError(f"the policy {kind!r} needs {key} in the observation")
            if batch[key].shape[-1] != width:
                raise ValueError(
                    f"the policy {kind!r} was trained with {width} values in {key}, but the "
                    f"observation has {batch[key].shape[-1]}"
                )
            bad = (~batch[key].isfinite()).flatten(0, -2).any(0).nonzero().flatten().tolist()
            if bad:
                names = self.config.state_names if key == OBS_STATE else None
                which = ", ".join(names[i] if names else str(i) for i in bad)
                raise ValueError(f"{key} is not finite in {which}: check the sensor")

    def _whiten(self, stats: Statistics | None, dataset_meta: Any) -> None:
        """Set means and spreads from a dataset's statistics.

        Raises:
            ValueError: Statistics are missing or not finite.
        """
        if stats is None and dataset_meta is None:
            return
        stats = stats or {}
        for key, width in self.encoder.widths.items():
            _require_statistics(stats, key, width, ("mean", "std"))
        width = len(self.encoding.mean)
        _require_statistics(stats, ACTION, width, ("mean", "std", "min", "max"))
        self.encoder.whiten(stats)
        mean, std = (torch.as_tensor(stats[ACTION][k]) for k in ("mean", "std"))
        self.encoding.whiten(std, mean)

    def _fit_dataset(self, dataset_meta: Any) -> None:
        """Fit the demonstrations of a dataset, if they are on disk."""
        if dataset_meta is None:
            return
        root = Path(dataset_meta.root)
        if not (root / "data").is_dir():
            logger.warning("no demonstrations in %s: training starts from a resting arm", root)
            return
        keys = (ACTION, *self.encoder.widths)
        self.fit(read_episodes(root, keys, self.config.fit_episodes))

    @classmethod
    def _load_as_safetensor(
        cls, model: Any, model_file: str, map_location: str, strict: bool
    ) -> Any:
        try:
            return super()._load_as_safetensor(model, model_file, map_location, strict)
        except SafetensorError as error:
            raise ValueError(
                f"{model_file} is damaged ({error}): copy or train the policy again"
            ) from error


def frame_rate(config: MotionPolicyConfig, dataset_meta: Any) -> float:
    """Actions a second, from the settings or the dataset.

    Raises:
        ValueError: Neither has a frame rate, or the two do not agree.
    """
    trained, shown = config.fps, None if dataset_meta is None else float(dataset_meta.fps)
    if trained is None:
        if shown is None:
            raise ValueError(
                f"the policy {config.type!r} must know how many actions a second there are: "
                "train it on a dataset, or give fps (--policy.fps)"
            )
        return shown
    if shown not in (None, trained):
        raise ValueError(
            f"the policy is for {trained:g} actions a second, the dataset has {shown:g}: "
            "resample it, or train another policy on it"
        )
    return trained


def _require_statistics(
    stats: Statistics, key: str, width: int, names: tuple[str, ...]
) -> None:
    for name in names:
        if name not in stats.get(key, {}):
            raise ValueError(
                f"the dataset's statistics (meta/stats.json) lack {name} of {key}, by which "
                "the policy whitens its numbers: compute them with LeRobot's "
                "`lerobot-edit-dataset --operation.type recompute_stats`, or record again"
            )
        values = torch.as_tensor(stats[key][name])
        if values.shape != (width,) or not values.isfinite().all():
            raise ValueError(
                f"the dataset's statistics (meta/stats.json) must have {width} finite numbers "
                f"as {name} of {key}, got {values.tolist()}"
            )


MEASURED = 0.5
"""Largest root mean square difference, in spreads of the action, at which a value of the state
counts as the measurement of the action's value of the same name."""
MOST = 256
"""Largest number of demonstrations that are read; from more, evenly spaced ones are chosen."""


def read_episodes(
    root: str | Path, keys: Sequence[str], episodes: Sequence[int] | None = None
) -> list[dict[str, Tensor]]:
    """Columns of whole episodes, (frames, components) each, unchanged from disk.

    Args:
        root: Folder of a LeRobot dataset.
        keys: Columns wanted.
        episodes: Indices of episodes; None: all. If there are more than 256, 256 are read.

    Raises:
        DatasetError: A part of the dataset cannot be read; the message names it. This is a
            `ValueError`.
    """
    folder = open_folder(root)
    chosen = select_episodes(folder, episodes)
    if len(chosen) > MOST:
        spread = np.linspace(0, len(chosen) - 1, MOST).round().astype(int)
        chosen = tuple(chosen[i] for i in spread)
    entries = sorted(chosen, key=lambda entry: (entry.file, entry.start))
    return [
        {key: torch.from_numpy(np.array(frames[key])) for key in keys}
        for _, frames in read_frames(folder, entries, keys)
    ]
