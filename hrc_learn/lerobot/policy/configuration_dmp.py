"""Settings of the policy `dmp`."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from hrc_learn.lerobot.policy.common import MotionPolicyConfig

EARLIEST = -1_000_000
"""Offset [frames] at which LeRobot, as it stays within the episode, takes its first frame."""


@PreTrainedConfig.register_subclass("dmp")
@dataclass
class DMPConfig(MotionPolicyConfig):
    """One movement primitive an episode, corrected by what is seen with every chunk."""

    n_basis: int = 50
    """Basis functions a coordinate."""
    hidden_dim: int = 128
    """Width of the network that corrects the primitive."""

    @property
    def observation_delta_indices(self) -> list[int]:
        """The first observation of the episode, and the current one."""
        return [EARLIEST, 0]

    @property
    def action_delta_indices(self) -> list[int]:
        """The chunk."""
        return list(range(self.chunk_size))

    def get_scheduler_preset(self) -> None:
        """A constant rate."""
        return
