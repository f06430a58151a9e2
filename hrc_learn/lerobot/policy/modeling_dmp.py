"""The policy `dmp`: observations in, chunks of one continuous motion out."""

import logging
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from ...dmp.system.basis import GaussianBasis
from ...dmp.system.response import response_of
from ...dmp.system.spring import SpringDamper
from .chart import ActionChart
from .closed_form import fit_closed_form
from .columns import matched_columns, rotation_triples
from .configuration_dmp import DMPConfig
from .encoder import ObservationEncoder
from .episodes import read_episodes
from .motion import ContextualMotion, Primitives

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, eq=False)
class Start:
    """What a chunk starts from, in the coordinates of the primitives."""

    position: Float[Tensor, "B A"]
    velocity: Float[Tensor, "B A"]
    elapsed: Float[Tensor, "B"]
    """When the motion was there, since the start of the episode [s]."""
    lead: Float[Tensor, "B"]
    """From then to the first action of the chunk [s]: one step, or none in the first chunk."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Underway:
    """What is kept of an episode from one chunk to the next."""

    start: Start
    """Of the next chunk."""
    context: Float[Tensor, "B C"]
    first_seen: Float[Tensor, "B F"]
    """Context and features of the first observation."""


class DMPPolicy(PreTrainedPolicy):
    """A movement primitive an episode, told by the first observation, corrected by the others.

    Goal, weights, duration and, where it is not measured, start follow from what is seen; the
    chunk follows from them, and from where the motion is, by one linear map. As each chunk
    starts with the position and the velocity that the last one ended with, the motion is C1
    whatever is predicted.
    """

    config_class = DMPConfig
    name = "dmp"

    def __init__(
        self,
        config: DMPConfig,
        dataset_stats: Mapping[str, Mapping[str, Any]] | None = None,
        dataset_meta: Any = None,
        **_: Any,
    ):
        """Build the policy and, of a dataset, fit it in closed form.

        A policy that is loaded takes what it was trained with from its checkpoint.

        Args:
            config: With the features known.
            dataset_stats: Statistics that numbers are whitened by.
            dataset_meta: `LeRobotDatasetMetadata` to take the frame rate from, and the
                demonstrations where they lie on disk.

        Raises:
            ValueError: Features that the policy cannot work with, a frame rate that is unknown
                or another one, or demonstrations that cannot be fitted.
        """
        super().__init__(config)
        config.validate_features()
        config.fps = _frame_rate(config, dataset_meta)
        self.config = config
        self.encoder = ObservationEncoder(
            {
                key: _width(config, key)
                for key in (OBS_STATE, OBS_ENV_STATE)
                if _sees(config, key)
            },
            {key: feature.shape[0] for key, feature in config.image_features.items()},
            backbone=config.vision_backbone,
            n_keypoints=config.n_keypoints,
        )
        width = _width(config, ACTION)
        self.chart = ActionChart(width, rotation_triples(config.action_feature_names))
        self.motion = ContextualMotion(
            response_of(SpringDamper(), GaussianBasis(count=config.n_basis)),
            width,
            context=sum(self.encoder.widths.values()),
            features=2 * self.encoder.size,
            hidden=config.hidden_dim,
        )
        columns = _measured_columns(config)
        self.register_buffer("measured", torch.tensor(columns), persistent=False)
        if config.pretrained_path is None:
            self._whiten(dataset_stats)
            self._fit(dataset_meta)
        self.reset()

    def get_optim_params(self) -> Any:
        """All parameters alike."""
        return self.parameters()

    def reset(self) -> None:
        """Forget the motion that is under way: an episode begins."""
        self._underway: Underway | None = None
        self._action_queue: deque[Tensor] = deque()

    def forward(
        self, batch: dict[str, Tensor], reduction: str = "mean"
    ) -> tuple[Tensor, dict[str, float]]:
        """Mean square error of chunks, in the spread of each component of the action.

        A chunk starts where the motion told by the first observation has come to by then, as
        it does when the policy runs, and not from what was shown: differences of noisy actions
        make no velocity.

        Args:
            batch: As LeRobot loads it by the config's delta indices: observations (B, 2, ...),
                the first of the episode and the current one, `action` (B, chunk, A),
                `action_is_pad` and `timestamp`.
            reduction: "none" for one loss each, (B), else the mean over all actions.
        """
        keys = (*self.encoder.widths, *self.encoder.images)
        first, now = ({key: batch[key][:, i] for key in keys} for i in (0, 1))
        clock = batch["timestamp"].flatten().to(self.chart.mean)
        context, first_seen = self.encoder.numbers(first), self.encoder(first)
        start = self._later(context, first_seen, first, clock)
        primitives = self._primitives(context, first_seen, self.encoder(now), clock)
        predicted, _ = self._chunk(primitives, start)
        shown = self.chart.to_coordinates(batch[ACTION])
        present = ~batch[f"{ACTION}_is_pad"]
        square = (predicted - shown).square().mean(-1) * present
        mean = square.sum() / present.sum()
        rmse = {"rmse": float(mean.detach().sqrt())}
        return (square.sum(-1) / present.sum(-1) if reduction == "none" else mean), rmse

    @torch.no_grad()
    def predict_action_chunk(
        self, batch: dict[str, Tensor], **_: Any
    ) -> Float[Tensor, "B chunk A"]:
        """The next chunk, of which `n_action_steps` are taken for carried out.

        Until `reset`, each call goes on where those of the last one end.

        Args:
            batch: Observations (B, ...).
        """
        self.eval()
        seen, known = self.encoder(batch), self._underway
        context = self.encoder.numbers(batch) if known is None else known.context
        first_seen = seen if known is None else known.first_seen
        clock = seen.new_zeros(len(seen))
        if known is not None:
            clock = known.start.elapsed + known.start.lead
        primitives = self._primitives(context, first_seen, seen, clock)
        start = self._first_start(primitives, batch) if known is None else known.start
        position, velocity = self._chunk(primitives, start)
        last = self.config.n_action_steps - 1
        self._underway = Underway(
            start=Start(
                position=position[:, last],
                velocity=velocity[:, last],
                elapsed=clock + last * self._step,
                lead=torch.full_like(clock, self._step),
            ),
            context=context,
            first_seen=first_seen,
        )
        return self.chart.to_actions(position)

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **_: Any) -> Float[Tensor, "B A"]:
        """The next action; a new chunk is predicted when the last one is used up."""
        if not self._action_queue:
            chunk = self.predict_action_chunk(batch)
            self._action_queue.extend(chunk[:, : self.config.n_action_steps].unbind(1))
        return self._action_queue.popleft()

    @property
    def _step(self) -> float:
        assert self.config.fps is not None
        return 1 / self.config.fps

    def _primitives(
        self, context: Tensor, first_seen: Tensor, seen: Tensor, clock: Tensor
    ) -> Primitives:
        return self.motion(context, torch.cat([first_seen, seen], dim=-1), clock)

    def _chunk(self, primitives: Primitives, start: Start) -> tuple[Tensor, Tensor]:
        """Positions and velocities at the times of the chunk's actions."""
        steps = torch.arange(self.config.chunk_size).to(start.lead) * self._step
        return self.motion.continued(
            primitives,
            start.position,
            start.velocity,
            elapsed=start.elapsed,
            time=start.lead[:, None] + steps,
        )

    def _first_start(self, primitives: Primitives, observation: Mapping[str, Tensor]) -> Start:
        """Of an episode: where the arm is, as far as that is measured."""
        position = primitives.start
        if (self.measured >= 0).any():
            values = observation[OBS_STATE][..., self.measured.clamp_min(0)].to(position)
            seen = self.chart.to_coordinates(values[:, None])[:, 0]
            position = torch.where(self.measured >= 0, seen, position)
        clock = torch.zeros_like(primitives.duration)
        velocity = primitives.start_velocity
        return Start(position=position, velocity=velocity, elapsed=clock, lead=clock)

    def _later(
        self,
        context: Float[Tensor, "B C"],
        first_seen: Float[Tensor, "B F"],
        first: Mapping[str, Tensor],
        clock: Float[Tensor, "B"],
    ) -> Start:
        """Where the motion told by the first observation is one step before `clock`."""
        began = torch.zeros_like(clock)
        primitives = self._primitives(context, first_seen, first_seen, began)
        start = self._first_start(primitives, first)
        elapsed = (clock - self._step).clamp_min(0)
        position, velocity = self.motion.continued(
            primitives, start.position, start.velocity, elapsed=began, time=elapsed[:, None]
        )
        return Start(
            position=position[:, 0],
            velocity=velocity[:, 0],
            elapsed=elapsed,
            lead=clock - elapsed,
        )

    def _whiten(self, stats: Mapping[str, Mapping[str, Any]] | None) -> None:
        if stats is None:
            return
        self.encoder.whiten(stats)
        mean, std = (torch.as_tensor(stats[ACTION][k]) for k in ("mean", "std"))
        self.chart.whiten(std, mean)

    def _fit(self, dataset_meta: Any) -> None:
        """Start from the demonstrations, if they lie on disk as a whole."""
        if dataset_meta is None:
            return
        if not (Path(dataset_meta.root) / "data").is_dir():
            logger.warning(
                "no demonstrations in %s to fit: training starts from a motion that stands still",
                dataset_meta.root,
            )
            return
        keys = (ACTION, *self.encoder.widths)
        episodes = read_episodes(dataset_meta.root, keys, self.config.fit_episodes)
        actions = [episode[ACTION].float() for episode in episodes]
        self.chart.learn(actions)
        if not self.encoder.widths:
            contexts = torch.zeros(len(episodes), 0)
        else:
            first = [{key: e[key][0] for key in self.encoder.widths} for e in episodes]
            contexts = torch.stack([self.encoder.numbers(f) for f in first])
        coordinates = [self.chart.to_coordinates(a) for a in actions]
        error = fit_closed_form(self.motion, coordinates, contexts, 1 / self._step)
        logger.info(
            "fitted %d demonstrations in closed form; error of one left out: %.3f of the spread",
            len(episodes),
            error,
        )


def _sees(config: DMPConfig, key: str) -> bool:
    return key in (config.input_features or {})


def _width(config: DMPConfig, key: str) -> int:
    features = {**(config.input_features or {}), **(config.output_features or {})}
    (width,) = features[key].shape
    return width


def _measured_columns(config: DMPConfig) -> list[int]:
    if not _sees(config, OBS_STATE):
        return [-1] * _width(config, ACTION)
    widths = _width(config, ACTION), _width(config, OBS_STATE)
    return matched_columns(config.action_feature_names, config.state_names, widths)


def _frame_rate(config: DMPConfig, dataset_meta: Any) -> float:
    shown = None if dataset_meta is None else float(dataset_meta.fps)
    if config.fps is None and shown is None:
        raise ValueError(
            "the policy 'dmp' must know how many actions a second there are: train it on a "
            "dataset, or give fps (--policy.fps)"
        )
    if None not in (config.fps, shown) and config.fps != shown:
        raise ValueError(
            f"the policy is for {config.fps:g} actions a second, the dataset has {shown:g}: "
            "resample it, or train a policy of its own"
        )
    return shown if config.fps is None else config.fps
