"""The policy `motion_chunk`: chunks of actions as motions that continue smoothly.

LeRobot finds policy and processors in the module of the configuration.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from lerobot.configs import PreTrainedConfig
from lerobot.optim import CosineDecayWithWarmupSchedulerConfig
from lerobot.processor import (
    make_default_pre_post_processors as make_motion_chunk_pre_post_processors,
)
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor, nn
from torch.nn import functional as F

from hrc_learn.geometry.numerics import check_settings
from hrc_learn.lerobot.policy.action_encoding import (
    ActionEncoding,
    rotation_triples,
    two_level_columns,
)
from hrc_learn.lerobot.policy.motion_chunks import (
    LEFT_OVER,
    ChunkDecoder,
    ChunkNetwork,
    ContinuedMotion,
    MotionChunk,
    Plans,
)
from hrc_learn.lerobot.policy.observation_encoder import Observation, divisors
from hrc_learn.lerobot.policy.policy_base import MotionPolicy, MotionPolicyConfig, Statistics

__all__ = ["MotionChunkConfig", "MotionChunkPolicy", "make_motion_chunk_pre_post_processors"]

UNKNOWN = 0.3
"""Fraction of samples trained without the velocity of the state, as after a reset. This also
keeps policies from relying on their own past motion regardless of observations.
"""
VELOCITY_WEIGHT = 0.005
"""Weight of the velocity error, in spreads per second, relative to the weight of the position
error."""
SCORE_WEIGHT = 0.1
"""Weight of the error of the plan scores, relative to the error of the plans; it is small
because a classification learns faster."""
SAME_WAY = 3.0
"""Smallest distance at which plans count as distinct, relative to the error of the nearest
plan. The mean of closer plans is nearer to the demonstration than any of them; the mean of
distinct plans is not a valid plan. If three plans quantise one normal distribution, they are
2.8 times their error apart (Max 1960, "Quantizing for minimum distortion").
"""
LEAST_ERROR = 1e-3
"""Smallest value of the nearest plan's error, in spreads. Without motion the error is zero, but
plans must still count as the same."""
FORGETTING = 0.01
"""Decay of the running mean of the nearest plan's error, at each training step."""

SMALLEST_TURN = 0.05
"""Smallest spread of orientations [rad]: a hand that points down in all demonstrations varies
by only 1e-5, but tilts more as soon as anything differs from the demonstrations."""
SLOWEST = 0.3
"""Smallest scale of velocities, relative to the median velocity; slower columns are not
amplified.
"""
MOST_CHUNKS = 50_000
"""Largest number of chunks in the regression; from more chunks, evenly spaced ones are used."""


@PreTrainedConfig.register_subclass("motion_chunk")
@dataclass
class MotionChunkConfig(MotionPolicyConfig):
    """Settings of a policy that predicts chunks of actions, as parts of one smooth motion."""

    n_basis: int | None = None
    """Basis functions per coordinate and chunk; None: 10, or in short chunks two for every five
    actions."""
    hidden_dim: int = 256
    """Width of the network."""
    dropout: float = 0.1
    """Dropout probability of hidden features in training."""
    history: int = 2
    """Frames over which the velocity of observation.state is measured, if the policy receives
    every frame (`select_action`); 0: the velocity is not used. To measure the velocity,
    training loads a second frame of all inputs."""
    state_noise: float = 0.0
    """Noise on observation.state in training, relative to its spread. With 0.15, plans return
    to the demonstrations from nearby states. This helps with demonstrations that hardly vary,
    such as scripted ones. Human demonstrations vary enough; noise would blur their intent.
    """
    n_plans: int = 3
    """Number of plans for each observation. From one state, the demonstrations may continue in
    at most this many distinct motions. The most likely plan is executed."""
    two_level_actions: list[int] | None = None
    """Indices of the action's components that jump between two levels, such as a gripper that
    is open or closed; None: detected from the dataset's statistics."""
    blend_time: float | None = None
    """Approximate time in which a chunk changes from the executed motion to the plan [s]; None:
    the longer of 0.05 s and one action period, but at most 0.3 of the spacing of basis
    functions. A smaller spacing causes larger errors of a plan's acceleration, which the next
    chunk continues for this time."""
    optimizer_lr: float = 1e-3
    optimizer_weight_decay: float = 1e-2
    scheduler_decay_steps: int = 20_000
    """Steps over which the learning rate decays to zero; fewer if training is shorter."""

    def __post_init__(self) -> None:
        super().__post_init__()
        positive = "n_basis", "hidden_dim", "n_plans", "blend_time"
        check_settings(self, positive=positive, not_negative=("history", "state_noise"))
        if self.chunk_size < 4:
            raise ValueError(f"chunk_size must be at least 4, got {self.chunk_size}")

    @property
    def observation_delta_indices(self) -> list[int] | None:
        """The observation `history` frames ago, and the current one."""
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


class MotionChunkPolicy(MotionPolicy):
    """Policy whose chunks continue the executed motion with continuous acceleration (C2).

    From each observation and the velocity of its state, a network plans the next second or two.
    Among the motions that start with the position, velocity and acceleration to which the
    previous actions lead, the one nearest to the plan is executed. There is no clock: chunks
    can be requested at any time and, after `reset`, from any state.
    """

    config_class = MotionChunkConfig  # pyright: ignore[reportAssignmentType]
    name = "motion_chunk"  # pyright: ignore[reportAssignmentType]
    config: MotionChunkConfig

    def _build(self, stats: Statistics | None) -> None:
        config = self.config
        widths, width = self.encoder.widths, len(self.encoding.mean)
        states = config.state_names if OBS_STATE in widths else None
        # Rotation vectors in the state are encoded like those of actions, so they do not jump.
        self.turning = ActionEncoding(widths.get(OBS_STATE, 0), rotation_triples(states))
        self.error = nn.Buffer(torch.ones(()))
        """Root mean square distance of the nearest plan from the demonstrations, in spreads."""
        self.levels = nn.Buffer(torch.tensor([[-1.0], [1.0]]).repeat(1, width))
        """Smallest and largest value of each component of the action, whitened, (2, A)."""
        moving = widths.get(OBS_STATE, 0) if config.history else 0
        self.velocity_spread = nn.Buffer(torch.ones(moving))
        """Root mean square velocity of the demonstrated states, whitened, (F,) [1/s]; empty if
        velocities are not used."""
        if stats is not None:
            self._find_levels(stats)
        config.two_level_actions = config.two_level_actions or []
        self._stepped = sorted(config.two_level_actions)
        if not set(self._stepped) < set(range(width)):
            raise ValueError(
                f"two_level_actions must be some of the action's components 0 to {width - 1}, "
                f"not all of them; got {self._stepped}"
            )
        self._smooth = [k for k in range(width) if k not in self._stepped]
        self.decoder = ChunkDecoder(
            config.chunk_size, self._step, config.n_basis, config.blend_time
        )
        self.network = ChunkNetwork(
            numbers=sum(widths.values()),
            features=self.encoder.size,
            moving=moving,
            columns=len(self._smooth),
            two_level=len(self._stepped),
            decoder=self.decoder,
            n_plans=config.n_plans,
            hidden=config.hidden_dim,
            dropout=config.dropout,
        )
        self.motion = ContinuedMotion(self.decoder, self._compose)

    def supports_rtc(self) -> bool:
        """True: chunks continue the leftover actions exactly, without guidance."""
        return True

    def reset(self) -> None:
        """Forget the present motion: the next one begins at the measured position."""
        self.motion.reset()
        self._states: deque[Tensor] = deque(maxlen=self.config.history + 1)
        self._action_queue: deque[Tensor] = deque()

    def forward(
        self, batch: dict[str, Any], reduction: str = "mean"
    ) -> tuple[Tensor, dict[str, float]]:
        """Error of the nearest plan in position and velocity, plus errors of scores and levels.

        Actions before the beginning of an episode and after its end do not count.

        Args:
            batch: Batch as LeRobot loads it by the config's delta indices: observations (B, 2,
                ...) of `history` frames ago and of now, or (B, ...) of now only; `action` (B,
                chunk + 1, A) and `action_is_pad`.
            reduction: "none": the loss of each sample, (B); else the mean over samples.

        Returns:
            The loss, and the root mean square error of the nearest plans, relative to the
            spread of each component of the action.
        """
        shown = self.encoding.to_coordinates(batch[ACTION])
        batch, velocity, known = self._now(batch)
        if self.training:
            known = known * (torch.rand_like(known) > UNKNOWN)
        features = self.encoder(batch)
        if self.training and self.config.state_noise:
            own = self.encoder.widths.get(OBS_STATE, 0)  # states come first among the features
            noise = self.config.state_noise * torch.randn_like(features[:, :own])
            features = torch.cat([features[:, :own] + noise, features[:, own:]], dim=-1)
        plans = self.network(features, velocity, known)
        present = (~batch[f"{ACTION}_is_pad"]).to(shown)
        error = self.decoder.positions(plans.coefficients) - shown[:, None, :, self._smooth]
        rate = error.diff(dim=2) / self._step
        each = (error.abs().mean(-1) * present[:, None]).mean(-1)
        each = each + VELOCITY_WEIGHT * (rate.abs().mean(-1) * present[:, None, 1:]).mean(-1)
        best = each.argmin(1)
        row = torch.arange(len(best), device=best.device)
        loss = (1 - LEFT_OVER) * each[row, best] + LEFT_OVER * each.mean(1)
        loss = loss + SCORE_WEIGHT * F.cross_entropy(plans.scores, best, reduction="none")
        if self._stepped:
            low, high = self.levels[:, self._stepped]
            up = (shown[..., self._stepped] > (low + high) / 2).to(shown)
            wrong = F.binary_cross_entropy_with_logits(plans.levels, up, reduction="none")
            loss = loss + (wrong.mean(-1) * present).mean(-1)
        square = error.detach()[row, best].square().mean(-1) * present
        rmse = (square.sum() / present.sum()).sqrt()
        if self.training:
            self.error.lerp_(rmse, FORGETTING)
        return (loss if reduction == "none" else loss.mean()), {"rmse": float(rmse)}

    @torch.no_grad()
    def predict_action_chunk(
        self,
        batch: dict[str, Any],
        inference_delay: int = 0,
        prev_chunk_left_over: Tensor | None = None,
        **_: Any,
    ) -> Float[Tensor, "B chunk A"]:
        """The next chunk; its first action belongs to the time of the observation.

        The chunk continues the last chunk from its present step. Leftover actions determine
        this step exactly; without them, the step nearest to the plan for the observation is
        used. After `reset`, the chunk begins at the measured position.

        Args:
            batch: Observations (B, ...).
            inference_delay: Number of actions that will be executed before the chunk is
                available. These are leftover actions, and the chunk begins with them.
            prev_chunk_left_over: Actions of the last chunk that are not executed yet, (n, A) or
                (1, n, A), as LeRobot's real-time chunking passes them.

        Raises:
            ValueError: Numbers are missing, of another width, or not finite; or the delay is
                negative.
        """
        self.eval()
        if inference_delay < 0:
            raise ValueError(f"inference_delay must not be negative, got {inference_delay}")
        self._require_numbers(batch)
        self._states.clear()  # Callers that request chunks do not pass every frame.
        plans = self._plans(batch)
        if prev_chunk_left_over is not None:
            before = self.motion.left_over(prev_chunk_left_over)
        elif self.motion.chunk is not None:
            # State in which the plan would begin if it could begin anywhere.
            now = self.decoder.states(self._chosen(plans, None))[:, 0, 0]
            before = self.motion.nearest(now)
        else:
            before = None
        return self._go_on(batch, plans, before, inference_delay)

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **_: Any) -> Float[Tensor, "B A"]:
        """The next action; a new chunk is predicted when the last one is used up."""
        if OBS_STATE in batch:
            self._states.append(batch[OBS_STATE].clone())  # the caller may reuse its memory
        if not self._action_queue:
            self.eval()
            self._require_numbers(batch)
            steps = self.config.n_action_steps
            chunk = self._go_on(batch, self._plans(batch), self.motion.after(steps), 0)
            self._action_queue.extend(chunk[:, :steps].unbind(1))
        return self._action_queue.popleft()

    def _turned(self, batch: Observation) -> Observation:
        """The observation, with rotation vectors in the state encoded without jumps."""
        if not self.turning.triples:
            return batch
        state = batch[OBS_STATE]
        turned = self.turning.to_coordinates(state.reshape(-1, 1, state.shape[-1]))
        return {**batch, OBS_STATE: turned.reshape(state.shape)}

    def _velocity(self, states: Float[Tensor, "B frames F"]) -> Float[Tensor, "B F"]:
        """Whitened velocity between the first and the last state, `history` frames apart."""
        moved = (states[:, -1] - states[:, 0]) / self.encoder.std[: states.shape[-1]]
        return moved / (self.config.history * self._step * self.velocity_spread)

    def _now(self, batch: Mapping[str, Any]) -> tuple[dict[str, Any], Tensor, Tensor]:
        """Encoded present observations, velocities of the states, and 1 where they are
        known.
        """
        now = dict(self._turned(batch))
        velocity = batch[ACTION].new_zeros(len(batch[ACTION]), len(self.velocity_spread))
        known = velocity.new_zeros(len(velocity))
        dims = dict.fromkeys(self.encoder.widths, 2) | dict.fromkeys(self.encoder.images, 4)
        for key in (key for key, n in dims.items() if now[key].ndim > n):
            if key == OBS_STATE and len(self.velocity_spread):
                velocity = self._velocity(now[key])
                known = (~batch[f"{key}_is_pad"][:, 0]).to(velocity)
            now[key] = now[key][:, -1]
        return now, velocity, known

    def _go_on(
        self, batch: Observation, plans: Plans, before: MotionChunk | None, delay: int
    ) -> Float[Tensor, "B chunk A"]:
        """Continue the executed actions to the best plan; store and return the new chunk.

        Args:
            batch: Observations (B, ...).
            plans: Plans for the observations.
            before: Remainder of the previous chunk; None: the motion begins.
            delay: Number of actions of `before` to execute before the new chunk is available.
        """
        planned = self._chosen(plans, before)
        beginning = None
        if before is None:
            beginning = self._beginning(batch, self.decoder.states(planned)[:, 0])
        upper = (plans.levels > 0).to(plans.coefficients)
        actions = self.motion.go_on(planned, upper, before, beginning=beginning, delay=delay)
        return actions[:, :-1]

    def _plans(self, batch: Observation) -> Plans:
        """Plans for the present observation and its velocity."""
        features = self.encoder(self._turned(batch))
        velocity = features.new_zeros(len(features), len(self.velocity_spread))
        known = features.new_zeros(len(features))
        if self._states.maxlen == len(self._states) > 1:
            states = torch.stack([self._states[0], self._states[-1]], dim=1)
            velocity = self._velocity(self._turned({OBS_STATE: states})[OBS_STATE])
            known = velocity.isfinite().all(-1).to(features)
        return self.network(features, velocity.nan_to_num(), known)

    def _chosen(self, plans: Plans, before: MotionChunk | None) -> Float[Tensor, "B D M"]:
        """Most likely plan, preferably near the present motion; close plans are averaged."""
        scores = plans.scores.log_softmax(-1)
        same = SAME_WAY * self.error.clamp_min(LEAST_ERROR)
        positions = self.decoder.positions(plans.coefficients)
        if before is not None:
            off = positions - before.states[:, None, :, 0].to(positions)
            scores = scores - off.square().mean((-2, -1)) / (2 * same**2)
        chosen = scores.argmax(-1)
        row = torch.arange(len(chosen), device=chosen.device)
        apart = (positions - positions[row, chosen][:, None]).square().mean((-2, -1))
        weight = scores.masked_fill(apart >= same**2, -torch.inf).softmax(-1)
        return (weight[..., None, None] * plans.coefficients).sum(1)

    def _beginning(
        self, batch: Observation, planned: Float[Tensor, "B 3 D"]
    ) -> Float[Tensor, "B 3 D"]:
        """State in which a motion begins: as planned, but at measured positions if observed."""
        if OBS_STATE not in self.encoder.widths:
            return planned
        # The index -1 (not measured) selects the last value, which is not used below.
        values = batch[OBS_STATE][:, None, self.measured]
        seen = self.encoding.to_coordinates(values.to(self.encoding.mean))[:, 0]
        seen, there = seen[:, self._smooth].to(planned), self.measured[self._smooth] >= 0
        position = torch.where(there, seen, planned[:, 0])
        return torch.cat([position[:, None], planned[:, 1:]], dim=1)

    def _compose(self, position: Tensor, upper: Tensor) -> Float[Tensor, "B samples A"]:
        """Actions from whitened positions and two-level columns (1: upper level, else 0)."""
        low, high = self.levels[:, self._stepped]
        coordinates = self.encoding.mean.new_zeros(*position.shape[:2], self.levels.shape[1])
        coordinates[..., self._smooth] = position.to(coordinates)
        coordinates[..., self._stepped] = low + upper * (high - low)
        return self.encoding.to_actions(coordinates)

    def _find_levels(self, stats: Statistics) -> None:
        """Set levels and two-level columns from a dataset's statistics."""
        mean, std, low, high = (
            torch.as_tensor(stats[ACTION][k]).to(self.encoding.mean)
            for k in ("mean", "std", "min", "max")
        )
        self.levels.copy_((torch.stack([low, high]) - mean) / self.encoding.std)
        if self.config.two_level_actions is None:
            turning = {i for triple in self.encoding.triples for i in triple}
            found = [i for i in two_level_columns(mean, std, low, high) if i not in turning]
            self.config.two_level_actions = found if len(found) < len(mean) else []

    @torch.no_grad()
    def fit(self, demonstrations: list[dict[str, Tensor]]) -> None:
        """Fit the linear part in closed form, after the statistics for whitening are set.

        Args:
            demonstrations: Columns by key, (frames, components).

        Raises:
            ValueError: An orientation is more than half a turn away from the mean.
        """
        actions = [shown[ACTION].to(self.encoding.mean) for shown in demonstrations]
        if self.encoding.triples:
            low, high = (self.levels * self.encoding.std + self.encoding.mean).unbind()
            self.encoding.learn(actions)
            self.levels.copy_(
                (torch.stack([low, high]) - self.encoding.mean) / self.encoding.std
            )
        episodes = [
            {key: shown[key] for key in self.encoder.widths}
            | {ACTION: self.encoding.to_coordinates(action)}
            for shown, action in zip(demonstrations, actions, strict=True)
        ]
        if OBS_STATE in self.encoder.widths:
            states = [e[OBS_STATE].to(self.encoding.mean) for e in episodes]
            self.keep_measured(states, [e[ACTION] for e in episodes])
            if self.turning.triples:
                self._learn_turning(states)
        if len(self.velocity_spread):
            turned = [self._turned({OBS_STATE: x})[OBS_STATE] for x in states]
            moved = torch.cat([x.diff(dim=0) for x in turned]) / self._step
            rates = (moved / self.encoder.std[: moved.shape[1]]).square().mean(0).sqrt()
            self.velocity_spread.copy_(divisors(rates, SLOWEST))
        columns = {key: torch.cat([e[key] for e in episodes]) for key in episodes[0]}
        lengths = torch.tensor([len(e[ACTION]) for e in episodes])
        last = (lengths.cumsum(0) - 1).repeat_interleave(lengths)
        shown = torch.arange(0, len(last), -(-len(last) // MOST_CHUNKS))
        ahead = shown[:, None] + torch.arange(self.decoder.samples)
        chunks = columns[ACTION][torch.minimum(ahead, last[shown, None])][..., self._smooth]
        numbers = chunks.new_zeros(len(chunks), 0)
        if self.encoder.widths:
            seen = {key: columns[key][shown] for key in self.encoder.widths}
            numbers = self.encoder.numbers(self._turned(seen))
        self.network.fit(numbers, self.decoder.project(chunks))
        linear = self.network.linear(numbers).unflatten(-1, self.network.mean.shape)
        planned = self.decoder.positions(linear * self.network.spread + self.network.mean)
        self.error.copy_((planned - chunks).square().mean().sqrt())

    def _learn_turning(self, states: list[Tensor]) -> None:
        """Set reference orientations of states, and mean and spread of the encoded states."""
        turning = self.turning
        turning.learn(states)
        turning.whiten(torch.ones_like(turning.std), torch.zeros_like(turning.mean))
        turned = torch.cat([turning.to_coordinates(x[:, None])[:, 0] for x in states])
        mean, std = self.encoder.mean, self.encoder.std
        first = slice(0, len(turning.mean))  # states come first among the numbers
        mean[first] = turned.mean(0)
        std[first] = divisors(turned.std(0))
        for triple in turning.triples:
            std[triple] = std[triple].clamp_min(SMALLEST_TURN)
