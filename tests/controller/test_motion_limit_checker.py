"""Hostile ticks of the safety filter before the judge of franka-sim, in its own environment."""

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fr3_tables import FR3_TABLES
from hostile_streams import (
    HostileStreams,
    StreamConfig,
    hostile_streams,
)
from unchecked import shapes_unchecked

from hrc_learn.controller import SafetyFilter
from hrc_learn.kinematics import JointLimits, panda

ROOT = Path(__file__).parents[2]
PYTHON = ROOT / ".venv-franka-sim" / "bin" / "python"
pytestmark = pytest.mark.skipif(
    not PYTHON.exists(), reason="tools/make_franka_sim.sh builds franka-sim's environment"
)
# Of the Panda's limits the checker has none for joint motions: it is given them. Of the FR3 its
# own are those of libfranka.
JUDGES = {
    "panda": ("panda", panda.limits),
    "fr3 as it is": ("fr3", None),
    "fr3 documentation": ("fr3", FR3_TABLES["documentation"]),
    "fr3 description": ("fr3", FR3_TABLES["description"]),
}


def judged(sent: HostileStreams, limits: JointLimits | None, folder: Path, **more) -> dict:
    """What the checker says."""
    arrays = {"position": sent.position.numpy(), "velocity": sent.velocity.numpy()} | more
    if limits is not None:
        names = ("lower", "upper", "acceleration", "jerk", "velocity_offset", "deceleration")
        rows = {name: getattr(limits, name) for name in names} | {
            "max_velocity": limits.velocity
        }
        arrays |= {name: row.numpy() for name, row in rows.items() if row is not None}
    np.savez(folder / "sent.npz", **arrays)
    command = [PYTHON, ROOT / "tools" / "motion_limit_checker.py"]
    done = subprocess.run(
        [*command, "--sent", folder / "sent.npz"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("ticks", [4_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "judge",
    ["fr3 as it is"]
    + [pytest.param(j, marks=pytest.mark.long) for j in JUDGES if j != "fr3 as it is"],
)
def test_it_finds_nothing(judge, ticks, tmp_path):
    arm, limits = JUDGES[judge]
    # Of two seconds, to run into limits at full speed and back.
    count = ticks // 2000
    with shapes_unchecked():
        sent = hostile_streams(StreamConfig(arm=arm, count=count, ticks=2000, seed=11))
    verdict = judged(sent, limits, tmp_path)
    assert verdict["ticks"] == ticks
    assert verdict["findings"] == 0, verdict["shown"]


@pytest.mark.long
def test_it_finds_what_a_filter_with_other_limits_lets_pass(tmp_path):
    """The Panda's are no limits of the FR3, nor the other way round."""
    with shapes_unchecked():
        config = StreamConfig(arm="fr3", count=6, ticks=500)
        sent = hostile_streams(config, SafetyFilter(panda.limits))
    assert judged(sent, None, tmp_path)["findings"] > 100
    with shapes_unchecked():
        sent = hostile_streams(config)
    assert judged(sent, panda.limits, tmp_path)["findings"] > 100


def test_motions_one_after_another_begin_from_rest_each(tmp_path):
    """Cut out of the middle of one, the second does not begin at rest unless it is said so."""
    with shapes_unchecked():
        config = StreamConfig(arm="panda", count=1, ticks=400, seed=3)
        sent = hostile_streams(config)
        twice = replace(
            sent,
            position=torch.cat([sent.position, sent.position]),
            velocity=torch.cat([sent.velocity, sent.velocity]),
        )
    assert sent.velocity[-1].abs().max() > 0.05
    number = np.repeat([4, 9], 400)
    apart = judged(twice, panda.limits, tmp_path, motion=number)
    assert apart == {"ticks": 800, "findings": 0, "shown": []}
    as_one = judged(twice, panda.limits, tmp_path, motion=np.full(800, 4))
    assert as_one["findings"] > 0
    assert "tick 400" in as_one["shown"][0]
