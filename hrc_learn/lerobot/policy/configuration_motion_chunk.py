"""Settings of the policy `motion_chunk`."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig
from lerobot.optim import CosineDecayWithWarmupSchedulerConfig

from hrc_learn.lerobot.policy.common import MotionPolicyConfig


@PreTrainedConfig.register_subclass("motion_chunk")
@dataclass
class MotionChunkConfig(MotionPolicyConfig):
    """Chunks of actions, each a motion that goes on from what is being carried out."""

    n_basis: int | None = None
    """Basis functions a coordinate and chunk; None: 10, or two for five actions."""
    hidden_dim: int = 256
    """Width of the network."""
    dropout: float = 0.1
    """Dropout probability of hidden features in training."""
    history: int = 2
    """Frames over which the velocity of observation.state is seen, where every frame is shown
    (`select_action`); 0: it is not. Training loads a second frame of everything for it."""
    state_noise: float = 0.0
    """Noise on observation.state in training, relative to its spread. With 0.15, plans return
    to the demonstrations from nearby states. This helps where demonstrations hardly vary, such
    as scripted ones; human variation has the same effect, and noise would blur the intent.
    """
    n_plans: int = 3
    """Plans for each observation, of which one is carried out: as many ways to go as the
    demonstrations may show from one place."""
    sample_plans: bool = False
    """First plan of a motion: drawn by likelihood if true, else the most likely one."""
    two_level_actions: list[int] | None = None
    """Components of the action that know two levels only, such as a gripper that is open or
    shut, and jump between them; None: those that the dataset's statistics show to be such."""
    blend_time: float | None = None
    """About how long a chunk takes from what is carried out to what is planned [s]; None: 0.05
    s or one action, or less where the basis functions of a chunk are so close to each other
    that its acceleration is uneven within that time, with which the motion would go on."""
    optimizer_lr: float = 1e-3
    optimizer_weight_decay: float = 1e-2
    scheduler_decay_steps: int = 20_000
    """Steps along which the learning rate falls to nothing; no more than are trained."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("n_basis", "hidden_dim", "n_plans"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        if self.blend_time is not None and self.blend_time <= 0:
            raise ValueError(f"blend_time must be positive seconds, got {self.blend_time}")
        if self.history < 0:
            raise ValueError(f"history must be 0 frames or more, got {self.history}")
        if self.state_noise < 0:
            raise ValueError(f"state_noise must not be negative, got {self.state_noise}")
        if self.chunk_size < 4:
            raise ValueError(f"chunk_size must be at least 4, got {self.chunk_size}")

    @property
    def observation_delta_indices(self) -> list[int] | None:
        """The current observation, and one before."""
        return [-self.history, 0] if self.history else None

    @property
    def action_delta_indices(self) -> list[int]:
        """The chunk, and the action after it."""
        return list(range(self.chunk_size + 1))

    def get_scheduler_preset(self) -> CosineDecayWithWarmupSchedulerConfig:
        """Cosine decay of the learning rate to zero."""
        return CosineDecayWithWarmupSchedulerConfig(
            num_warmup_steps=min(100, self.scheduler_decay_steps),
            num_decay_steps=self.scheduler_decay_steps,
            peak_lr=self.optimizer_lr,
            decay_lr=0.0,
        )
