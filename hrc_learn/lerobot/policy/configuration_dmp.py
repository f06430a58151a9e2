"""Settings of the policy `dmp`."""

from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig


@PreTrainedConfig.register_subclass("dmp")
@dataclass
class DMPConfig(PreTrainedConfig):
    """Movement primitives that start where the last chunk ended."""

    chunk_size: int = 50
    """Actions predicted at once."""
    n_action_steps: int = 25
    """Actions carried out before the next chunk is asked for."""
    n_basis: int = 50
    """Basis functions of the forcing term."""
    normalization_mapping: dict[str, NormalizationMode] = field(default_factory=dict)
    """Nothing: the policy whitens inside, where start and actions share one space."""

    @property
    def observation_delta_indices(self) -> list[int] | None:
        """Of observations beside the current one."""
        return None

    @property
    def action_delta_indices(self) -> list[int]:
        """Of the actions learned from."""
        return list(range(self.chunk_size))

    @property
    def reward_delta_indices(self) -> None:
        """Rewards play no part."""
        return None

    def get_optimizer_preset(self) -> AdamWConfig:
        """AdamW."""
        return AdamWConfig(lr=1e-3, weight_decay=1e-4)

    def get_scheduler_preset(self) -> None:
        """A constant rate."""
        return None

    def validate_features(self) -> None:
        """Raise ValueError for features that the policy cannot work with."""
