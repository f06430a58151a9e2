"""LeRobot processors of the policy `dmp`: batching and device."""

from typing import Any

from lerobot.processor import (
    PolicyAction,
    PolicyProcessorPipeline,
    make_default_pre_post_processors,
)

from hrc_learn.lerobot.policy.configuration_dmp import DMPConfig


def make_dmp_pre_post_processors(
    config: DMPConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """The usual steps; the policy's normalisation is the identity."""
    return make_default_pre_post_processors(config, dataset_stats)
