"""The policy `dmp` as LeRobot calls it, and its checkpoint without training."""

import logging
import math
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from lerobot.configs import FeatureType
from lerobot.policies import make_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from lerobot.utils.feature_utils import dataset_to_policy_features
from torch import Tensor

from hrc_learn.dmp import GaussianBasis, SpringDamper, response_of
from hrc_learn.lerobot.policy.closed_form import read_episodes
from hrc_learn.lerobot.policy.common import (
    frame_rate,
    load_weights,
    make_encoder,
    require_any_statistics,
    require_numbers,
    require_statistics,
)
from hrc_learn.lerobot.policy.configuration_dmp import DMPConfig
from hrc_learn.lerobot.policy.motion_planner import (
    ActionEncoding,
    InitialPlan,
    MotionPlanner,
    Start,
    matched_columns,
    rotation_triples,
)
from hrc_learn.lerobot.policy.networks import ContextualMotion

logger = logging.getLogger(__name__)


class DMPPolicy(PreTrainedPolicy):
    """Policy that executes one movement primitive an episode, predicted from the first
    observation and corrected by later ones.

    Goal, weights, duration and, where it is not measured, the start are predicted from
    observations. A chunk follows from them and from the state of the motion by one linear map.
    Each chunk starts with the position and velocity that the last one ended with, so the motion
    is C1 for any prediction.
    """

    config_class = DMPConfig  # pyright: ignore[reportAssignmentType]
    name = "dmp"  # pyright: ignore[reportAssignmentType]
    config: DMPConfig

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
            config: Configuration with known features.
            dataset_stats: Statistics that numbers are whitened by.
            dataset_meta: `LeRobotDatasetMetadata` to take the frame rate from, and the
                demonstrations where they lie on disk.

        Raises:
            ValueError: Features that the policy cannot work with, a frame rate that is unknown
                or another one, or demonstrations that cannot be fitted.
        """
        super().__init__(config)
        config.validate_features()
        config.fps = frame_rate(config, dataset_meta)
        self.config = config
        self.planner = _planner(config, 1 / config.fps)
        self.left_out_error = math.nan
        """Cross-validated error of the closed form, relative to the spread of the actions."""
        if config.pretrained_path is None:
            require_any_statistics(dataset_stats, dataset_meta)
            self._whiten(dataset_stats)
            self._fit(dataset_meta)
        self.reset()

    def get_optim_params(self) -> Any:
        """All parameters alike."""
        return self.parameters()

    def reset(self) -> None:
        """Forget the motion that is under way: an episode begins."""
        self._underway: tuple[InitialPlan, Start] | None = None
        self._action_queue: deque[Tensor] = deque()

    def forward(
        self, batch: dict[str, Any], reduction: str = "mean"
    ) -> tuple[Tensor, dict[str, float]]:
        """Mean square error of chunks, in the spread of each component of the action.

        Actions after the end of an episode count as none.

        Args:
            batch: Batch as LeRobot loads it by the config's delta indices: observations (B, 2,
                ...), the first of the episode and the current one, `action` (B, chunk, A),
                `action_is_pad` and `timestamp`.
            reduction: "none" for one loss each, (B), else their mean.

        Returns:
            The loss, and the root mean square error of the actions present.
        """
        encoder, encoding = self.planner.encoder, self.planner.encoding
        keys = (*encoder.widths, *encoder.images)
        first, now = ({key: batch[key][:, i] for key in keys} for i in (0, 1))
        clock = batch["timestamp"].flatten().to(encoding.mean)
        predicted = self.planner.condition(first, now, clock).position
        difference = predicted - encoding.to_coordinates(batch[ACTION])
        present = ~batch[f"{ACTION}_is_pad"]
        square = difference.square().mean(-1) * present
        rmse = {"rmse": float((square.detach().sum() / present.sum()).sqrt())}
        # By chunks, not by the actions present: so batches of several processes average alike.
        each = square.mean(-1)
        return (each if reduction == "none" else each.mean()), rmse

    @torch.no_grad()
    def predict_action_chunk(
        self, batch: dict[str, Any], **_: Any
    ) -> Float[Tensor, "B chunk A"]:
        """The next chunk, of which `n_action_steps` are taken for carried out.

        Until `reset`, each call goes on where those of the last one end.

        Args:
            batch: Observations (B, ...).

        Raises:
            ValueError: Numbers are missing, of another width, or not finite.
        """
        self.eval()
        require_numbers(self.config, self.planner.encoder.widths, batch)
        if self._underway is None:
            plan_start = self.planner.initial_plan(batch)
            start = plan_start.start
        else:
            plan_start, start = self._underway
        chunk = self.planner.plan(plan_start, batch, start)
        start = chunk.start_after(self.config.n_action_steps, self.planner.step)
        self._underway = plan_start, start
        return self.planner.encoding.to_actions(chunk.position)

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **_: Any) -> Float[Tensor, "B A"]:
        """The next action; a new chunk is predicted when the last one is used up."""
        if not self._action_queue:
            chunk = self.predict_action_chunk(batch)
            self._action_queue.extend(chunk[:, : self.config.n_action_steps].unbind(1))
        return self._action_queue.popleft()

    @property
    def _width(self) -> int:
        return len(self.planner.encoding.mean)

    @classmethod
    def _load_as_safetensor(
        cls, model: Any, model_file: str, map_location: str, strict: bool
    ) -> Any:
        load = super()._load_as_safetensor
        return load_weights(load, model, model_file, map_location, strict)

    def _whiten(self, stats: Mapping[str, Mapping[str, Any]] | None) -> None:
        if stats is None:
            return
        for key, width in (*self.planner.encoder.widths.items(), (ACTION, self._width)):
            require_statistics(stats, key, width)
        self.planner.encoder.whiten(stats)
        mean, std = (torch.as_tensor(stats[ACTION][k]) for k in ("mean", "std"))
        self.planner.encoding.whiten(std, mean)

    def _fit(self, dataset_meta: Any) -> None:
        """Start from the demonstrations, if they lie on disk."""
        if dataset_meta is None:
            return
        root = Path(dataset_meta.root)
        if not (root / "data").is_dir():
            logger.warning("no demonstrations in %s: training starts from standing still", root)
            return
        keys = (ACTION, *self.planner.encoder.widths)
        episodes = read_episodes(root, keys, self.config.fit_episodes)
        self.left_out_error = self.planner.fit(episodes, ACTION)
        logger.info(
            "fitted %d demonstrations in closed form, error of one left out %.3f of the spread",
            len(episodes),
            self.left_out_error,
        )


def _planner(config: DMPConfig, step: float) -> MotionPlanner:
    inputs = config.input_features or {}
    widths = {k: inputs[k].shape[0] for k in (OBS_STATE, OBS_ENV_STATE) if k in inputs}
    encoder = make_encoder(config, widths)
    (width,) = (config.output_features or {})[ACTION].shape
    names = config.action_feature_names
    states = config.state_names if OBS_STATE in widths else None
    return MotionPlanner(
        encoder,
        ActionEncoding(width, rotation_triples(names)),
        ContextualMotion(
            response_of(SpringDamper(), GaussianBasis(count=config.n_basis)),
            width,
            context=sum(widths.values()),
            features=2 * encoder.size,
            hidden=config.hidden_dim,
        ),
        measured=matched_columns(names, states, (width, widths.get(OBS_STATE, 0))),
        step=step,
        chunk_size=config.chunk_size,
    )


def write_closed_form_policy(
    dataset: Path, folder: Path, *, n_basis: int, episodes: Sequence[int] | None = None
) -> dict[str, float]:
    """Fit the policy to a dataset and write what LeRobot loads, trains on and rolls out.

    Images are left out: what to see in them takes gradients to learn.

    Args:
        dataset: LeRobot dataset with actions, and a state or an environment state.
        folder: Existing folder for the checkpoint.
        n_basis: Basis functions a coordinate.
        episodes: Episodes to learn from; None: all.

    Returns:
        How many demonstrations, and the error of those left out, in the spread of the actions.

    Raises:
        ValueError: The dataset cannot be read or holds nothing to learn a policy from.
    """
    from lerobot.datasets import LeRobotDatasetMetadata  # not needed to run a policy

    if not (dataset / "meta" / "info.json").is_file():
        raise FileNotFoundError(f"there is no LeRobot dataset in {dataset}")
    meta = LeRobotDatasetMetadata(f"local/{dataset.name}", root=dataset)
    features = dataset_to_policy_features(meta.features)
    if not any(feature.type is FeatureType.ACTION for feature in features.values()):
        raise ValueError(
            f"{dataset} has no actions, which are what policies learn: record them, or import "
            f"arrays with them (hrc import --actions)"
        )
    config = DMPConfig(
        n_basis=n_basis,
        fit_episodes=None if episodes is None else list(episodes),
        input_features={k: features[k] for k in (OBS_STATE, OBS_ENV_STATE) if k in features},
        output_features={k: f for k, f in features.items() if f.type is FeatureType.ACTION},
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
