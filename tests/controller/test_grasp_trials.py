"""Batched closed loops of the controller: grasps, and a person's force on the elbow."""

from dataclasses import replace

import pytest
from closed_loop import Imperfections
from disturbance_trials import EffortConfig, run_effort_trials
from grasp_trials import TrialConfig, run_trials

from hrc_learn.jacobian import FixedEstimator, KalmanEstimator

pytestmark = [pytest.mark.simulation, pytest.mark.long]

QUICK = TrialConfig(
    count=20, duration=6.0, dt=0.02, imperfections=Imperfections(frame_steps=2, noise=0.5)
)


def test_adaptation_succeeds_where_the_fixed_jacobian_cannot():
    adaptive = run_trials(KalmanEstimator, QUICK)
    fixed = run_trials(FixedEstimator, replace(QUICK, duration=4.0))
    assert adaptive.success.double().mean() >= 0.9
    assert not fixed.success[fixed.roll_class == 4].any()
    for result in (adaptive, fixed):
        assert not result.violations.any()
        assert result.peak_speed.max() <= 1
    assert (adaptive.vision_time[adaptive.success] <= adaptive.time[adaptive.success]).all()


def test_a_pull_moves_the_elbow_far_and_the_tool_hardly():
    config = EffortConfig(count=6, force=12.0, dt=0.01, away=1.5, back=0.5)
    summary = run_effort_trials(config).summary()
    assert summary["elbow_mm"] > 100
    assert summary["deviation_p95_mm"] < 0.2
    assert summary["turn_p95_deg"] < 0.05
