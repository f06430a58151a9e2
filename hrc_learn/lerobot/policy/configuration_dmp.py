"""Settings of the policy `dmp`."""

from dataclasses import dataclass, field
from typing import Any

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig

from hrc_learn.demos.format.metadata import flatten_names

EARLIEST = -1_000_000
"""Offset [frames] at which LeRobot, as it stays within the episode, takes its first frame."""


@PreTrainedConfig.register_subclass("dmp")
@dataclass
class DMPConfig(PreTrainedConfig):
    """One movement primitive an episode, corrected by what is seen with every chunk."""

    chunk_size: int = 50
    """Actions predicted at once."""
    n_action_steps: int = 25
    """Actions carried out before the next chunk is predicted."""
    n_basis: int = 50
    """Basis functions a coordinate."""
    hidden_dim: int = 128
    """Width of the network that corrects the primitive."""
    vision_backbone: str = "small"
    """Of images: "small", four convolutions, or a ResNet of torchvision such as "resnet18";
    no weights are downloaded."""
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
    """Nothing: the policy whitens inside, where start and actions share one space."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.n_action_steps <= self.chunk_size:
            raise ValueError(
                f"n_action_steps must be 1 to chunk_size ({self.chunk_size}), got "
                f"{self.n_action_steps}"
            )
        if self.n_obs_steps != 1:
            raise ValueError(
                f"the policy 'dmp' sees one step, got n_obs_steps={self.n_obs_steps}"
            )
        # LeRobot overwrites the field before it hands over the dataset.
        self._trained_for = self.action_feature_names
        self._trained_on = self.state_names

    @property
    def observation_delta_indices(self) -> list[int]:
        """The first observation of the episode, and the current one."""
        return [EARLIEST, 0]

    @property
    def action_delta_indices(self) -> list[int]:
        """The chunk."""
        return list(range(self.chunk_size))

    @property
    def reward_delta_indices(self) -> None:
        """Rewards play no part."""
        return None

    def get_optimizer_preset(self) -> AdamWConfig:
        """AdamW, as the network starts from what is already close."""
        return AdamWConfig(lr=self.optimizer_lr, weight_decay=self.optimizer_weight_decay)

    def get_scheduler_preset(self) -> None:
        """A constant rate."""
        return

    def validate_features(self) -> None:
        """See whether the policy can work with its inputs and outputs.

        Raises:
            ValueError: There is no action, or nothing to see.
        """
        if self.action_feature is None:
            raise ValueError("the policy 'dmp' needs the feature 'action' among its outputs")
        if not self.input_features:
            raise ValueError(
                "the policy 'dmp' needs something to see: observation.state, "
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
