"""An arm that follows positions, of a policy say, near a simulated worker."""

import numpy as np
import pytest

from hrc_learn.kinematics import panda
from hrc_learn.teleoperation.scenarios import ScenarioRun, make_scenario


def moved(mode, seed):
    """How far the tool gets in 0.8 s on its way aside while a worker reaches under it [m]."""
    run = ScenarioRun(make_scenario("grasping", "middle", panda), 50.0, seed=seed, worker=mode)
    q = run.scenario.workplace.hover_joints().numpy()
    run.world.reset(q)
    run.servo.restart()
    if run.visit is not None:
        run.world.data.time = float(run.visit.reaches[0].mean()) - 0.2
    start = run.world.arm.tcp_pose()[:3, 3].copy()
    for _ in range(40):
        run.command(q + np.array([0.3, 0, 0, 0, 0, 0, 0]), np.nan)
    return run, float(np.linalg.norm(run.world.arm.tcp_pose()[:3, 3] - start))


@pytest.mark.simulation
def test_a_policys_arm_waits_for_a_worker_and_less_where_it_may_touch():
    _, alone = moved(None, 1)
    apart, waits = moved("ssm", 1)
    both, goes_on = moved("ssm+pfl", 1)
    assert waits < 0.3 * alone
    assert waits + 0.02 < goes_on < alone
    # The worker is the seed's, whatever the reaction.
    assert apart.visit is not None
    assert both.visit is not None
    np.testing.assert_array_equal(apart.visit.poses, both.visit.poses)
    first = apart.visit
    apart.begin(2)
    assert apart.visit is not first
