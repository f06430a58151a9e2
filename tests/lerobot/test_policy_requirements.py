"""What policies ask of a dataset before they learn from it, the same of each."""

from types import SimpleNamespace

import pytest
from lerobot_samples import config_for, features_of, reaching

from hrc_learn.lerobot import MotionChunkConfig
from hrc_learn.lerobot.policy.dmp_policy import DMPPolicy
from hrc_learn.lerobot.policy.motion_chunk_policy import MotionChunkPolicy

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
    with pytest.raises(
        ValueError, match=r"statistics \(meta/stats.json\) lack .*recompute_stats"
    ):
        make(name, dataset_stats=stats, dataset_meta=meta)
