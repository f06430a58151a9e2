"""A checkpoint of the policy `dmp` without training: demonstrations fitted in closed form."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lerobot.configs import FeatureType
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import make_pre_post_processors
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from lerobot.utils.feature_utils import dataset_to_policy_features

from hrc_learn.lerobot.policy.configuration_dmp import DMPConfig
from hrc_learn.lerobot.policy.modeling_dmp import DMPPolicy


def write_closed_form_policy(
    dataset: Path, folder: Path, *, n_basis: int, episodes: Sequence[int] | None = None
) -> dict[str, float]:
    """Fit the policy to a dataset and write what LeRobot loads, trains on and rolls out.

    Images are left out: what to see in them takes gradients to learn.

    Args:
        dataset: LeRobot dataset with actions, and a state or an environment state.
        folder: Existing folder for the checkpoint.
        n_basis: Basis functions a coordinate.
        episodes: To learn from; None: all.

    Returns:
        How many demonstrations, and the error of those left out, in the spread of the actions.

    Raises:
        ValueError: The dataset cannot be read or holds nothing to learn a policy from.
    """
    if not (dataset / "meta" / "info.json").is_file():
        raise FileNotFoundError(f"there is no LeRobot dataset in {dataset}")
    meta = LeRobotDatasetMetadata(f"local/{dataset.name}", root=dataset)
    features = dataset_to_policy_features(meta.features)
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
