"""Dataset statistics, features and processors common to all policies."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig
from lerobot.utils.constants import OBS_STATE
from safetensors import SafetensorError
from torch import Tensor

from hrc_learn.demos.format.metadata import flatten_names
from hrc_learn.lerobot.policy.networks import Observation, ObservationEncoder

logger = logging.getLogger(__name__)

OUTLIER = 25.0
"""Spreads from the mean from which on a value is no motion: one glitch among n frames is
sqrt(n) spreads away, a gripper that opens for every 600th frame as many."""
TWO_LEVEL = 0.9
"""Fraction of the largest variance possible between minimum and maximum (Bhatia and Davis 2000,
"A better bound on the variance") from which a column counts as two-level: 1 if it only takes
its extremes.
"""


@dataclass
class MotionPolicyConfig(PreTrainedConfig):
    """Settings of any policy that plans motions, and its names from the dataset."""

    chunk_size: int = 50
    """Actions predicted at once."""
    n_action_steps: int = 25
    """Actions carried out before the next chunk is predicted."""
    vision_backbone: str = "small"
    """Image backbone: "small", four convolutions, or a ResNet of torchvision such as
    "resnet18"; no weights are downloaded.
    """
    vision_weights: str | None = None
    """File of weights for such a ResNet to begin with, safetensors by torchvision's names;
    None: it begins with random ones, or has been given its weights."""
    vision_pretrained: bool = False
    """True if the ResNet started from torchvision's weights; set by `vision_weights`."""
    n_keypoints: int = 32
    """Places in each image that the network looks for."""
    fit_episodes: list[int] | None = None
    """Episodes to start from in closed form; None: all. Leave out here what is held out."""
    fps: float | None = None
    """Actions a second; that of the dataset, unless given."""
    state_names: list[str] | None = None
    """Components of observation.state, from the dataset."""
    action_feature_names: list[str] | None = None
    """Components of the action, from the dataset."""
    optimizer_lr: float = 3e-4
    optimizer_weight_decay: float = 1e-4
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(
            ("VISUAL", "STATE", "ENV", "ACTION"), NormalizationMode.IDENTITY
        )
    )
    """Identity: the policy normalises internally, where start and actions have one space."""

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
        # LeRobot overwrites the field before it hands over the dataset.
        self._trained_for = self.action_feature_names
        self._trained_on = self.state_names

    @property
    def reward_delta_indices(self) -> None:
        """Rewards play no part."""
        return None

    def get_optimizer_preset(self) -> AdamWConfig:
        """AdamW, as the network starts from what is already close."""
        return AdamWConfig(lr=self.optimizer_lr, weight_decay=self.optimizer_weight_decay)

    def validate_features(self) -> None:
        """See whether the policy can work with its inputs and outputs.

        Raises:
            ValueError: There is no action, or nothing to see.
        """
        if self.action_feature is None:
            raise ValueError(
                f"the policy {self.type!r} needs the feature 'action' among its outputs"
            )
        if not self.input_features:
            raise ValueError(
                f"the policy {self.type!r} needs something to see: observation.state, "
                "observation.environment_state or images"
            )

    def set_dataset_feature_metadata(self, features: dict[str, dict[str, Any]]) -> None:
        """Take the names of components from a dataset; LeRobot calls this.

        Raises:
            ValueError: The policy was trained for other actions, or on other states or these
                in another order.
        """
        self.action_feature_names = _names(features, "action")
        self.state_names = _names(features, "observation.state")
        if self._trained_for not in (None, self.action_feature_names):
            raise ValueError(
                f"the policy in {self.pretrained_path} was trained for the actions "
                f"{', '.join(self._trained_for)}; the dataset has "
                f"{', '.join(self.action_feature_names or ['no names'])}"
            )
        if self._trained_on not in (None, self.state_names):
            raise ValueError(
                f"the policy in {self.pretrained_path} was trained on observation.state with "
                f"{', '.join(self._trained_on)}, in this order; the dataset has "
                f"{', '.join(self.state_names or ['no names'])}"
            )


def _names(features: dict[str, dict[str, Any]], key: str) -> list[str] | None:
    names = flatten_names(features.get(key, {}).get("names"))
    return None if names is None else list(names)


def make_encoder(config: MotionPolicyConfig, widths: Mapping[str, int]) -> ObservationEncoder:
    """Image backbone of a policy, with initial weights unless a checkpoint is loaded.

    Raises:
        ValueError: There is no such backbone, or no weights for it.
    """
    config.vision_pretrained |= config.vision_weights is not None
    encoder = ObservationEncoder(
        widths,
        {key: feature.shape[0] for key, feature in config.image_features.items()},
        backbone=config.vision_backbone,
        n_keypoints=config.n_keypoints,
        pretrained=config.vision_pretrained,
    )
    if config.vision_weights is not None:
        encoder.load_vision(Path(config.vision_weights))
        config.vision_weights = None
    return encoder


def frame_rate(config: Any, dataset_meta: Any) -> float:
    """Actions a second, of the settings or the dataset.

    Raises:
        ValueError: Neither says, or they do not agree.
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
            "resample it, or train a policy of its own"
        )
    return trained


def require_numbers(
    config: MotionPolicyConfig, widths: Mapping[str, int], batch: Observation
) -> None:
    """See whether an observation holds the numbers that a policy was trained with.

    Raises:
        ValueError: Numbers are missing, of another width, or not finite.
    """
    for key, width in widths.items():
        if key not in batch:
            raise ValueError(
                f"the policy {config.type!r} needs {key}; it is not in the observation"
            )
        if batch[key].shape[-1] != width:
            raise ValueError(
                f"the policy {config.type!r} was trained with {width} values in {key}, but the "
                f"observation has {batch[key].shape[-1]}"
            )
        bad = (~batch[key].isfinite()).flatten(0, -2).any(0).nonzero().flatten().tolist()
        if bad:
            names = config.state_names if key == OBS_STATE else None
            which = ", ".join(names[i] if names else str(i) for i in bad)
            raise ValueError(f"{key} is not finite in {which}: see to the sensor")


def require_statistics(
    stats: Mapping[str, Mapping[str, Any]],
    key: str,
    width: int,
    names: tuple[str, ...] = ("mean", "std"),
) -> None:
    """Check that a dataset's statistics are finite for each component.

    Warns of components with an outlier so large that all other values look alike.

    Raises:
        ValueError: A statistic is missing or not finite.
    """
    for name in names:
        if name not in stats.get(key, {}):
            raise ValueError(f"the dataset's statistics (meta/stats.json) lack {name} of {key}")
        values = torch.as_tensor(stats[key][name])
        if values.shape != (width,) or not values.isfinite().all():
            raise ValueError(
                f"the dataset's statistics (meta/stats.json) must have {width} finite numbers "
                f"as {name} of {key}, got {values.tolist()}"
            )
    mean, std, low, high = (
        torch.as_tensor(stats[key].get(name, stats[key]["mean"])).double()
        for name in ("mean", "std", "min", "max")
    )
    farthest = torch.maximum(high - mean, mean - low)
    if wild := (farthest > OUTLIER * std).nonzero().flatten().tolist():
        values = ", ".join(
            f"component {i}: {low[i]:.4g} to {high[i]:.4g}, spread {std[i]:.4g}" for i in wild
        )
        logger.warning(
            "%s has values more than %g spreads from the mean (%s): repair the dataset, or "
            "what is usual there looks like standing still",
            key,
            OUTLIER,
            values,
        )


def two_level_columns(mean: Tensor, std: Tensor, low: Tensor, high: Tensor) -> list[int]:
    """Columns that are at their least or their largest value, such as a gripper's.

    Args:
        mean: Mean of each column, (A).
        std: Standard deviation of each column.
        low: Minimum of each column.
        high: Maximum of each column.
    """
    largest = (high - mean) * (mean - low)
    return ((std > 0) & (std.square() > TWO_LEVEL * largest)).nonzero().flatten().tolist()


def require_any_statistics(stats: Mapping[str, Any] | None, dataset_meta: Any) -> None:
    """See whether a dataset that is trained on has statistics at all.

    Raises:
        ValueError: It has not.
    """
    if dataset_meta is not None and not stats:
        raise ValueError(
            f"the dataset in {dataset_meta.root} has no statistics (meta/stats.json), by which "
            "the policy whitens what it sees and does: compute them with LeRobot's "
            "`lerobot-edit-dataset --operation.type recompute_stats`, or record it again"
        )


def load_weights(load: Callable[..., Any], model: Any, file: str, *arguments: Any) -> Any:
    """Load weights as LeRobot does.

    Raises:
        ValueError: The file is damaged.
    """
    try:
        return load(model, file, *arguments)
    except SafetensorError as error:
        raise ValueError(
            f"{file} is damaged ({error}): copy or train the policy again"
        ) from error
