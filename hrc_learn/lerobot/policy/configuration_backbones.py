"""Settings of LeRobot's own policies with their chunks decoded as motions."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig


@dataclass
class DecodingConfig:
    """Conversion of chunks to motions."""

    n_basis: int | None = None
    """Basis functions a coordinate and chunk; None: 10, or two for five actions."""
    blend_time: float | None = None
    """About how long a chunk takes from what is carried out to what is planned [s]; None: 0.05
    s or one action, or less where basis functions are close to each other."""
    two_level_actions: list[int] | None = None
    """Components of the action that know two levels only, such as a gripper that is open or
    shut, and are left as they are predicted; None: those that the dataset's statistics show to
    be such."""
    fps: float | None = None
    """Actions a second; that of the dataset, unless given."""

    def require_room(self, executed: int, predicted: int) -> None:
        """See whether a chunk is longer than what is carried out of it.

        Raises:
            ValueError: It is not, or it has no basis functions.
        """
        if self.n_basis is not None and self.n_basis < 1:
            raise ValueError(f"n_basis must be at least 1, got {self.n_basis}")
        if not executed < predicted:
            raise ValueError(
                f"n_action_steps must be less than the {predicted} actions predicted from the "
                f"present one on, as the next chunk goes on from the one after; got {executed}"
            )


@PreTrainedConfig.register_subclass("act_dmp")
@dataclass
class ActDmpConfig(DecodingConfig, ACTConfig):
    """ACT, whose chunks are motions of one primitive that goes on from chunk to chunk."""

    chunk_size: int = 100
    n_action_steps: int = 50

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_room(self.n_action_steps, self.chunk_size)
        if self.temporal_ensemble_coeff is not None:
            raise ValueError(
                "act_dmp takes no temporal_ensemble_coeff: its chunks go on from each other "
                "instead of being averaged"
            )

    @property
    def action_delta_indices(self) -> list[int]:
        """Those of a chunk and, for the state that it ends in, the one after its last."""
        return list(range(self.chunk_size + 1))


@PreTrainedConfig.register_subclass("diffusion_dmp")
@dataclass
class DiffusionDmpConfig(DecodingConfig, DiffusionConfig):
    """Diffusion Policy, whose chunks are motions that go on from chunk to chunk."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_room(self.n_action_steps, self.horizon - self.n_obs_steps + 1)
