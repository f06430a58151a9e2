"""LeRobot's own policies with their chunks decoded as motions: `act_dmp`, `diffusion_dmp`.

What is learned, seen and normalised is theirs. The chunk that they predict is taken for the
motion of a movement primitive that is nearest to it, and that motion begins as the actions
before will have led it: with their position, velocity and acceleration. So chunks join without
a jump, and no action jumps within a chunk either.
"""

from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from lerobot.policies.act.modeling_act import ACT, ACTPolicy
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.utils.constants import ACTION
from torch import Tensor

from hrc_learn.lerobot.policy.chunk_network import ChunkDecoder
from hrc_learn.lerobot.policy.common import frame_rate, two_level_columns
from hrc_learn.lerobot.policy.configuration_backbones import (
    ActDmpConfig,
    DecodingConfig,
    DiffusionDmpConfig,
)
from hrc_learn.lerobot.policy.continued_motion import ContinuedMotion, MotionChunk


class ChunkMotion(ContinuedMotion):
    """Motion of chunks that are predicted action by action, whitened by whatever they are."""

    def __init__(self, config: DecodingConfig, predicted: int, width: int):
        """Begin with nothing under way.

        Args:
            config: Configuration with the frame rate and the two-level columns.
            predicted: Samples of a chunk: its actions and the one after.
            width: A, components of an action.
        """
        assert config.fps is not None
        stepped = sorted(config.two_level_actions or [])
        if not set(stepped) < set(range(width)):
            raise ValueError(
                f"two_level_actions must be some of the action's components 0 to {width - 1}, "
                f"not all of them; got {stepped}"
            )
        order = [k for k in range(width) if k not in stepped] + stepped
        self.smooth, self.stepped = order[: width - len(stepped)], stepped
        self._place = [order.index(k) for k in range(width)]
        super().__init__(
            ChunkDecoder(predicted - 1, 1 / config.fps, config.n_basis, config.blend_time),
            self._compose,
            self._decompose,
        )

    def decode(self, chunk: Float[Tensor, "B samples A"]) -> Float[Tensor, "B samples A"]:
        """The motion nearest to a chunk, wherever it begins."""
        smooth, stepped = self._decompose(chunk)
        return self._compose(self.decoder.positions(self.decoder.project(smooth)), stepped)

    def begin(
        self,
        chunk: Float[Tensor, "B samples A"],
        before: MotionChunk | None,
        delay: int,
    ) -> Float[Tensor, "B samples_1 A"]:
        """The motion nearest to a chunk that goes on as the last one did, without the last."""
        smooth, stepped = self._decompose(chunk)
        actions = self.go_on(self.decoder.project(smooth), stepped, before, delay=delay)
        return actions[:, :-1]

    def _compose(self, smooth: Tensor, stepped: Tensor) -> Tensor:
        return torch.cat([smooth, stepped.to(smooth)], dim=-1)[..., self._place]

    def _decompose(self, actions: Tensor) -> tuple[Tensor, Tensor]:
        return actions[..., self.smooth], actions[..., self.stepped]


class DecodedPolicy:
    """Common part of both policies, a wrapper of a LeRobot policy of whole chunks."""

    config: Any
    motion: ChunkMotion

    def decode_by(self, predicted: int) -> None:
        """Take chunks of so many samples for motions from now on."""
        self.motion = ChunkMotion(self.config, predicted, self.config.action_feature.shape[0])
        self.decoder = self.motion.decoder  # a module: goes where the policy goes

    def supports_rtc(self) -> bool:
        """Chunks go on from what is left of the one before: without guidance, exactly."""
        return True

    def reset(self) -> None:
        """Forget the motion that is under way: the next begins as it is planned."""
        super().reset()  # pyright: ignore[reportAttributeAccessIssue]
        self._carried_out: int | None = None
        if hasattr(self, "motion"):  # LeRobot resets while it builds
            self.motion.reset()

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **settings: Any) -> Float[Tensor, "B A"]:
        """The next action; a new chunk is predicted when the last one is used up."""
        self._carried_out = self.config.n_action_steps
        try:
            select = super().select_action  # pyright: ignore[reportAttributeAccessIssue]
            return select(batch, **settings)
        finally:
            self._carried_out = None

    def go_on(
        self,
        chunk: Float[Tensor, "B samples A"],
        inference_delay: int,
        prev_chunk_left_over: Tensor | None,
    ) -> Float[Tensor, "B samples_1 A"]:
        """The chunk as a motion that goes on from what is carried out.

        Where the actions that are left over say where that has got to, it is exact; else it
        is taken to be at the action of the last chunk that is nearest to the new one's first.

        Raises:
            ValueError: A delay that is negative.
        """
        if inference_delay < 0:
            raise ValueError(f"inference_delay must not be negative, got {inference_delay}")
        if prev_chunk_left_over is not None:
            before = self.motion.left_over(prev_chunk_left_over)
        elif self._carried_out is not None:
            before = self.motion.after(self._carried_out)
        else:
            before = self.motion.nearest(chunk[:, 0, self.motion.smooth])
        return self.motion.begin(chunk, before, inference_delay)


def _know_dataset(
    config: DecodingConfig, stats: Mapping[str, Mapping[str, Any]] | None, dataset_meta: Any
) -> None:
    """Take the frame rate and the columns with two levels from the dataset."""
    config.fps = frame_rate(config, dataset_meta)
    if config.two_level_actions is not None:
        return
    config.two_level_actions = []
    names = ("mean", "std", "min", "max")
    if stats is not None and all(name in stats.get(ACTION, {}) for name in names):
        numbers = [torch.as_tensor(stats[ACTION][name]).double() for name in names]
        found = two_level_columns(*numbers)
        if len(found) < len(numbers[0]):
            config.two_level_actions = found


class _MotionACT(ACT):
    """ACT whose chunks are motions while it learns, too."""

    def __init__(self, config: ActDmpConfig, motion: ChunkMotion):
        super().__init__(config)
        self._decode = motion.decode

    def forward(self, batch: dict[str, Any]) -> Any:
        """Same as ACT."""
        actions, latent = super().forward(batch)
        return self._decode(actions), latent


class ActDmpPolicy(DecodedPolicy, ACTPolicy):
    """ACT, decoded by movement primitives."""

    config_class = ActDmpConfig  # pyright: ignore[reportAssignmentType]
    name = "act_dmp"  # pyright: ignore[reportAssignmentType]

    def __init__(
        self,
        config: ActDmpConfig,
        dataset_stats: Mapping[str, Mapping[str, Any]] | None = None,
        dataset_meta: Any = None,
        **_: Any,
    ):
        """Build the policy.

        Args:
            config: Configuration with known features.
            dataset_stats: Statistics that tell which components of the action jump.
            dataset_meta: `LeRobotDatasetMetadata` to take the frame rate from.

        Raises:
            ValueError: Features that the policy cannot work with, or a frame rate that is
                unknown or another one.
        """
        _know_dataset(config, dataset_stats, dataset_meta)
        super().__init__(config)
        # One action more, which is where the chunk ends.
        whole = replace(config, chunk_size=config.chunk_size + 1)
        self.decode_by(whole.chunk_size)
        self.model = _MotionACT(whole, self.motion)

    @torch.no_grad()
    def predict_action_chunk(
        self,
        batch: dict[str, Any],
        inference_delay: int = 0,
        prev_chunk_left_over: Tensor | None = None,
        **_: Any,
    ) -> Float[Tensor, "B chunk A"]:
        """The next chunk, as `motion_chunk` has it."""
        chunk = super().predict_action_chunk(batch)
        return self.go_on(chunk, inference_delay, prev_chunk_left_over)


class DiffusionDmpPolicy(DecodedPolicy, DiffusionPolicy):
    """Diffusion Policy, decoded by movement primitives."""

    config_class = DiffusionDmpConfig  # pyright: ignore[reportAssignmentType]
    name = "diffusion_dmp"  # pyright: ignore[reportAssignmentType]

    def __init__(
        self,
        config: DiffusionDmpConfig,
        dataset_stats: Mapping[str, Mapping[str, Any]] | None = None,
        dataset_meta: Any = None,
        **_: Any,
    ):
        """Build the policy, as `ActDmpPolicy`."""
        _know_dataset(config, dataset_stats, dataset_meta)
        super().__init__(config)
        predicted = config.horizon - config.n_obs_steps + 1
        self.decode_by(predicted)
        # All that it generates from the present action on, not what is carried out alone.
        self.diffusion.config = copy(config)
        self.diffusion.config.n_action_steps = predicted

    @torch.no_grad()
    def predict_action_chunk(
        self,
        batch: dict[str, Any],
        noise: Tensor | None = None,
        inference_delay: int = 0,
        prev_chunk_left_over: Tensor | None = None,
        **_: Any,
    ) -> Float[Tensor, "B chunk A"]:
        """The next chunk, as `motion_chunk` has it."""
        chunk = super().predict_action_chunk(batch, noise=noise)
        chunk = self.go_on(chunk, inference_delay, prev_chunk_left_over)
        return chunk if self._carried_out is None else chunk[:, : self._carried_out]
