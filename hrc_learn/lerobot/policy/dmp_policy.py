"""The policy `dmp`, with one movement primitive per episode, and its fit without training.

LeRobot finds policy and processors in the module of the configuration.
"""

import logging
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot.processor import make_default_pre_post_processors as make_dmp_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from lerobot.utils.feature_utils import dataset_to_policy_features
from torch import Tensor

from hrc_learn.dmp import ContinuedTrajectory, GaussianBasis, SpringDamper, response_of
from hrc_learn.lerobot.policy.contextual_motion import ContextualMotion, fit_closed_form
from hrc_learn.lerobot.policy.observation_encoder import Observation
from hrc_learn.lerobot.policy.policy_base import MotionPolicy, MotionPolicyConfig, Statistics

__all__ = ["DMPConfig", "DMPPolicy", "make_dmp_pre_post_processors", "write_closed_form_policy"]

logger = logging.getLogger(__name__)

EARLIEST = -1_000_000
"""Offset that LeRobot clamps to the first frame of the episode [frames]."""


@PreTrainedConfig.register_subclass("dmp")
@dataclass
class DMPConfig(MotionPolicyConfig):
    """Settings of a policy with one movement primitive per episode."""

    n_basis: int = 50
    """Number of basis functions for each coordinate."""
    hidden_dim: int = 128
    """Width of the network that corrects the primitive."""

    @property
    def observation_delta_indices(self) -> list[int]:
        """The first observation of the episode, and the current one."""
        return [EARLIEST, 0]

    @property
    def action_delta_indices(self) -> list[int]:
        """Actions of a chunk."""
        return list(range(self.chunk_size))


@dataclass(frozen=True, kw_only=True, eq=False)
class Underway:
    """State of an episode's motion at one time, in the coordinates of the primitives."""

    context: Float[Tensor, "B C"]
    """Numbers (not images) of the first observation, whitened."""
    features: Float[Tensor, "B F"]
    """Features of the first observation."""
    position: Float[Tensor, "B A"]
    """Whitened action at this time."""
    velocity: Float[Tensor, "B A"]
    """Rate of change of the whitened action [1/s]."""
    elapsed: Float[Tensor, "B"]
    """Time of this state since the start of the episode [s]."""
    lead: Float[Tensor, "B"]
    """Time from this state to the first action of the next chunk [s]: one step, or zero in the
    first chunk.
    """


class DMPPolicy(MotionPolicy):
    """Policy that executes one movement primitive per episode, predicted from the first
    observation and corrected by later observations.

    Goal, weights and duration are predicted from observations; so is the start, if it is not
    measured. One linear map turns the primitive and the state of the motion into a chunk of
    actions. Each chunk starts with the position and velocity with which the last chunk ended,
    so the motion is C1 (of continuous velocity) for any prediction.
    """

    config_class = DMPConfig  # pyright: ignore[reportAssignmentType]
    name = "dmp"  # pyright: ignore[reportAssignmentType]
    config: DMPConfig

    def _build(self, stats: Statistics | None) -> None:
        self.motion = ContextualMotion(
            response_of(SpringDamper(), GaussianBasis(count=self.config.n_basis)),
            len(self.encoding.mean),
            context=sum(self.encoder.widths.values()),
            features=2 * self.encoder.size,
            hidden=self.config.hidden_dim,
        )
        self.left_out_error = math.nan
        """Cross-validated error of the closed form, relative to the spread of the actions."""

    def reset(self) -> None:
        """Forget the present motion: an episode begins."""
        self._underway: Underway | None = None
        self._action_queue: deque[Tensor] = deque()

    def fit(self, demonstrations: list[dict[str, Tensor]]) -> None:
        """Fit primitives to demonstrations in closed form (see `fit_closed_form`).

        Args:
            demonstrations: Columns by key, (frames, components).
        """
        actions = [shown[ACTION].to(self.encoding.mean) for shown in demonstrations]
        self.encoding.learn(actions)
        first = [{key: d[key][0] for key in self.encoder.widths} for d in demonstrations]
        contexts = torch.stack([self.encoder.numbers(seen) for seen in first])
        coordinates = [self.encoding.to_coordinates(shown) for shown in actions]
        if OBS_STATE in self.encoder.widths:
            self.keep_measured([shown[OBS_STATE] for shown in demonstrations], coordinates)
        error = fit_closed_form(self.motion, coordinates, contexts, 1 / self._step)
        self.left_out_error = error
        logger.info(
            "fitted %d demonstrations in closed form, cross-validated error %.3f of the spread",
            len(demonstrations),
            error,
        )

    def forward(
        self, batch: dict[str, Any], reduction: str = "mean"
    ) -> tuple[Tensor, dict[str, float]]:
        """Mean square error of chunks, relative to the spread of each component of the action.

        Actions after the end of an episode do not count. Chunks start from the policy's own
        motion, as in execution: a noisy demonstration gives no valid velocity.

        Args:
            batch: Batch as LeRobot loads it by the config's delta indices: the first and the
                current observation of the episode (B, 2, ...), `action` (B, chunk, A),
                `action_is_pad` and `timestamp`.
            reduction: "none": the loss of each sample, (B); else the mean over samples.

        Returns:
            The loss, and the root mean square error of the actions before the episode's end.
        """
        keys = (*self.encoder.widths, *self.encoder.images)
        first, now = ({key: batch[key][:, i] for key in keys} for i in (0, 1))
        clock = batch["timestamp"].flatten().to(self.encoding.mean)
        underway = self.begin(first)
        elapsed = (clock - self._step).clamp_min(0)
        position, velocity = self._continued(underway, underway.features, elapsed[:, None])
        underway = replace(
            underway,
            position=position[:, 0],
            velocity=velocity[:, 0],
            elapsed=elapsed,
            lead=clock - elapsed,
        )
        predicted, _ = self._chunk(underway, now)
        difference = predicted - self.encoding.to_coordinates(batch[ACTION])
        present = ~batch[f"{ACTION}_is_pad"]
        square = difference.square().mean(-1) * present
        rmse = {"rmse": float((square.detach().sum() / present.sum()).sqrt())}
        # Average over chunks, not over the actions before the episode's end: otherwise, the
        # mean over several processes would be biased.
        each = square.mean(-1)
        return (each if reduction == "none" else each.mean()), rmse

    @torch.no_grad()
    def predict_action_chunk(
        self, batch: dict[str, Any], **_: Any
    ) -> Float[Tensor, "B chunk A"]:
        """The next chunk; its first `n_action_steps` actions count as executed.

        Until `reset`, each call continues where the executed actions of the last call end.

        Args:
            batch: Observations (B, ...).

        Raises:
            ValueError: Numbers are missing, of another width, or not finite.
        """
        self.eval()
        self._require_numbers(batch)
        underway = self.begin(batch) if self._underway is None else self._underway
        position, velocity = self._chunk(underway, batch)
        k = self.config.n_action_steps - 1
        self._underway = replace(
            underway,
            position=position[:, k],
            velocity=velocity[:, k],
            elapsed=underway.elapsed + underway.lead + k * self._step,
            lead=torch.full_like(underway.lead, self._step),
        )
        return self.encoding.to_actions(position)

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **_: Any) -> Float[Tensor, "B A"]:
        """The next action; a new chunk is predicted when the last one is used up."""
        if not self._action_queue:
            chunk = self.predict_action_chunk(batch)
            self._action_queue.extend(chunk[:, : self.config.n_action_steps].unbind(1))
        return self._action_queue.popleft()

    def begin(self, observation: Observation) -> Underway:
        """State at the start of an episode, with measured positions where they are known, else
        predicted positions.
        """
        context, features = self.encoder.numbers(observation), self.encoder(observation)
        start = features.new_zeros(len(features))
        primitives = self.motion(context, features.repeat(1, 2), start)
        position = primitives.start
        if (self.measured >= 0).any():
            values = observation[OBS_STATE][:, None, self.measured.clamp_min(0)].to(position)
            seen = self.encoding.to_coordinates(values)[:, 0]
            position = torch.where(self.measured >= 0, seen, position)
        return Underway(
            context=context,
            features=features,
            position=position,
            velocity=primitives.start_velocity,
            elapsed=start,
            lead=start,
        )

    def _chunk(self, underway: Underway, now: Observation) -> tuple[Tensor, Tensor]:
        """Position and velocity at the actions of a chunk, (B, chunk, A) each."""
        steps = self._step * torch.arange(self.config.chunk_size).to(underway.lead)
        return self._continued(underway, self.encoder(now), underway.lead[:, None] + steps)

    def _continued(
        self, underway: Underway, seen: Float[Tensor, "B F"], time: Float[Tensor, "B T"]
    ) -> tuple[Tensor, Tensor]:
        """Position and velocity of the motion after a state of the episode, (B, T, A) each.

        Args:
            underway: State of the episode.
            seen: Features of a later observation, which correct the primitive.
            time: Times after the state [s].
        """
        clock = underway.elapsed + underway.lead
        features = torch.cat([underway.features, seen], dim=-1)
        primitives = self.motion(underway.context, features, clock)
        duration = primitives.duration.double()
        since = underway.elapsed.double() / duration
        motion = ContinuedTrajectory(
            coordinates=primitives.from_rest().double(),
            s=since[:, None] + time.double() / duration[:, None],
            duration=duration,
            response=self.motion.response,
            since=since,
            position=underway.position.double(),
            velocity=underway.velocity.double(),
        )
        return motion.position.to(time), motion.velocity.to(time)


def write_closed_form_policy(
    dataset: Path, folder: Path, *, n_basis: int, episodes: Sequence[int] | None = None
) -> dict[str, float]:
    """Fit the policy to a dataset, and write a checkpoint that LeRobot can train or roll out.

    Images are ignored, because learning from them takes gradients.

    Args:
        dataset: LeRobot dataset with actions, and a state or an environment state.
        folder: Existing folder for the checkpoint.
        n_basis: Number of basis functions for each coordinate.
        episodes: Episodes to learn from; None: all.

    Returns:
        Number of demonstrations, and the cross-validated error relative to the spread of the
        actions.

    Raises:
        FileNotFoundError: The folder holds no dataset.
        ValueError: The dataset cannot be read, or lacks actions or numeric observations.
    """
    from lerobot.datasets import LeRobotDatasetMetadata  # not needed to run a policy

    if not (dataset / "meta" / "info.json").is_file():
        raise FileNotFoundError(f"there is no LeRobot dataset in {dataset}")
    meta = LeRobotDatasetMetadata(f"local/{dataset.name}", root=dataset)
    features = dataset_to_policy_features(meta.features)
    actions = {k: f for k, f in features.items() if f.type is FeatureType.ACTION}
    if not actions:
        raise ValueError(
            f"{dataset} has no actions, which a policy must learn: record them, or import "
            f"arrays with them (hrc import --actions)"
        )
    config = DMPConfig(
        n_basis=n_basis,
        fit_episodes=None if episodes is None else list(episodes),
        input_features={k: features[k] for k in (OBS_STATE, OBS_ENV_STATE) if k in features},
        output_features=actions,
        device="cpu",
        push_to_hub=False,
    )
    config.set_dataset_feature_metadata(meta.features)
    stats: Any = meta.stats
    policy = DMPPolicy(config, dataset_stats=stats, dataset_meta=meta)
    policy.save_pretrained(folder)
    for processor in make_pre_post_processors(config, dataset_stats=stats):
        processor.save_pretrained(folder)
    shown = meta.total_episodes if episodes is None else len(episodes)
    return {"demonstrations": float(shown), "left_out_error": policy.left_out_error}
