"""The true image Jacobian of a run whose camera was moved."""

from dataclasses import replace

import numpy as np

from hrc_learn.experiments.run_measures import true_image_jacobian
from hrc_learn.log import StepLog
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace


def test_each_step_has_the_camera_that_watched_it():
    workplace = Workplace()
    world, camera = World(workplace.scene), workplace.scene.camera
    later = replace(camera, focal=(900.0, 900.0))
    home = workplace.home_joints().numpy()
    world.reset(home, {})
    log = StepLog()
    for k in range(4):
        # The controller does not use its estimate in the second step.
        used = np.full((2, 6), np.nan if k == 1 else 0.0)
        log.append(time=0.5 * k, joint_position=home + 0.1 * k, image_jacobian=used)
    true = true_image_jacobian(log, world, [(0.0, camera), (1.0, later)])
    first, second = (true_image_jacobian(log, world, [(0.0, c)]) for c in (camera, later))
    assert np.isnan(true[1]).all()
    np.testing.assert_array_equal(true[0], first[0])
    np.testing.assert_array_equal(true[2:], second[2:])
    assert np.abs(first[2:] - second[2:]).max() > 1
