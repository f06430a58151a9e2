"""What policies ask of a dataset before they learn from it, the same of each."""

import logging
from copy import deepcopy
from types import SimpleNamespace

import pytest
from lerobot_samples import STATE, config_for, features_of, reaching, stats_of

from hrc_learn.lerobot import MotionChunkConfig
from hrc_learn.lerobot.policy.common import OUTLIER
from hrc_learn.lerobot.policy.modeling_dmp import DMPPolicy
from hrc_learn.lerobot.policy.modeling_motion_chunk import MotionChunkPolicy

SHOWN = reaching(4)


def make(name, **arguments):
    if name == "dmp":
        return DMPPolicy(config_for(SHOWN[0]), **arguments)
    config = MotionChunkConfig(**features_of(SHOWN[0]), fps=20.0, device="cpu")
    return MotionChunkPolicy(config, **arguments)


@pytest.mark.parametrize("name", ["dmp", "motion_chunk"])
@pytest.mark.parametrize("stats", [None, {}])
def test_a_dataset_without_statistics_is_refused(tmp_path, name, stats):
    meta = SimpleNamespace(root=tmp_path, fps=20.0)
    with pytest.raises(ValueError, match=r"no statistics \(meta/stats.json\).*recompute_stats"):
        make(name, dataset_stats=stats, dataset_meta=meta)


@pytest.mark.parametrize("name", ["dmp", "motion_chunk"])
@pytest.mark.parametrize(("share", "warned"), [(0.96, False), (1.04, True)])
def test_an_outlier_is_told(caplog, name, share, warned):
    stats = deepcopy(stats_of(SHOWN))
    state = stats[STATE]
    state["min"][0] = state["mean"][0] - share * OUTLIER * state["std"][0]
    with caplog.at_level(logging.WARNING):
        make(name, dataset_stats=stats)
    assert ("observation.state has values more than 25 spreads" in caplog.text) == warned
    assert ("component 0: " in caplog.text) == warned
