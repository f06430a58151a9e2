"""LeRobot processors of the policy `motion_chunk`: batching and device."""

from typing import Any

from lerobot.processor import (
    PolicyAction,
    PolicyProcessorPipeline,
    make_default_pre_post_processors,
)

from hrc_learn.lerobot.policy.configuration_motion_chunk import MotionChunkConfig


def make_motion_chunk_pre_post_processors(
    config: MotionChunkConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """The usual steps; the policy's normalisation is the identity."""
    return make_default_pre_post_processors(config, dataset_stats)
