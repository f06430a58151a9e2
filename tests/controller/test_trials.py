import math
from dataclasses import replace

import pytest
import torch

from hrc_learn.controller import comfortable_posture
from hrc_learn.controller.effort_trials import EffortConfig, run_effort_trials
from hrc_learn.controller.rehearsal import Imperfections
from hrc_learn.controller.trials import TrialConfig, TrialResult, run_trials
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import FixedEstimator, KalmanEstimator
from hrc_learn.kinematics import UnreachableError, panda

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


def test_the_same_seed_draws_the_same_trials():
    short = replace(QUICK, duration=0.2)
    one, same = run_trials(KalmanEstimator, short), run_trials(KalmanEstimator, short)
    other = run_trials(KalmanEstimator, replace(short, seed=1))
    assert (one.peak_speed == same.peak_speed).all()
    assert (one.peak_speed != other.peak_speed).any()


def test_a_run_that_left_the_target_again_is_no_success():
    """The summary counts what held to the end."""
    result = TrialResult(
        roll_class=torch.tensor([0, 1, 2, 3, 4]),
        success=torch.tensor([True, True, False, True, True]),
        time=torch.tensor([1.0, 2.0, math.inf, 3.0, 4.0], dtype=torch.float64),
        vision_time=torch.tensor([0.5, 0.5, math.nan, 1.0, 1.0], dtype=torch.float64),
        violations=torch.tensor([0, 0, 2, 0, 0]),
        peak_speed=torch.full((5,), 0.7, dtype=torch.float64),
        hand_overs=torch.ones(5, dtype=torch.int64),
    )
    summary = result.summary()
    assert summary["success"] == 0.8
    assert summary["t50"] == 3.0
    assert summary["t95"] == math.inf
    assert summary["violations"] == 2
    assert summary["vision_phase"] == 1.0
    assert summary["vision_phase_roll_60_90"] == math.inf
    assert summary["success_roll_60_90"] == 0
    assert summary["success_roll_0_30"] == 1


def test_a_comfortable_posture_reaches_the_pose_far_from_trouble():
    pose = Pose(
        torch.tensor([0.3, 0.4, 0.3], dtype=torch.float64),
        quaternion.normalize(torch.tensor([0.0, 1.0, 0.2, 0.0], dtype=torch.float64)),
    )
    q = comfortable_posture(panda, pose)
    reached = panda.forward(q)
    assert (reached.position - pose.position).norm() < 1e-9
    assert quaternion.angle(reached.orientation, pose.orientation) < 1e-9
    distance = torch.minimum(q - panda.limits.lower, panda.limits.upper - q)
    assert distance.min() > 0.3
    assert torch.linalg.svdvals(panda.jacobian(q))[-1] > 0.1


def test_a_pose_out_of_reach_is_refused():
    far = Pose(
        torch.tensor([2.0, 0.0, 0.3], dtype=torch.float64),
        torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64),
    )
    with pytest.raises(UnreachableError, match="move the goal"):
        comfortable_posture(panda, far)


def test_a_pull_moves_the_elbow_far_and_the_tool_hardly():
    config = EffortConfig(count=6, force=12.0, dt=0.01, away=1.5, back=0.5)
    summary = run_effort_trials(config).summary()
    assert summary["elbow_mm"] > 100
    assert summary["deviation_p95_mm"] < 0.2
    assert summary["turn_p95_deg"] < 0.05
