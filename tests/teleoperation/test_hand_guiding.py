"""An arm that is led, on one that does exactly as it is told."""

import numpy as np
import pytest
import torch

from hrc_learn.kinematics import panda
from hrc_learn.protocols import ArmState, DrawnRegion, HumanInput
from hrc_learn.sim.workplace import Workplace
from hrc_learn.teleoperation.hand_guiding import HandGuidedArm, HandGuidingConfig


class IdealArm:
    def __init__(self):
        self.time, self.q = 0.0, Workplace().home_joints().numpy()
        self.velocity = np.zeros(7)

    def read(self):
        return ArmState(
            time=self.time,
            joint_position=self.q.copy(),
            joint_velocity=self.velocity.copy(),
            gripper_width=0.08,
        )

    def command(self, joint_velocity):
        self.velocity = joint_velocity.copy()

    def hand(self):
        return panda.forward(torch.from_numpy(self.q))


class Wish:
    """A person who always asks for the same."""

    def __init__(self, **asked):
        self.asked = HumanInput(**asked)

    def read(self, state):
        return self.asked


def lead(seconds, dt=0.04, **asked):
    arm = IdealArm()
    led = HandGuidedArm(panda, arm, Wish(**asked), HandGuidingConfig(dt=dt))
    start = arm.hand()
    for _ in range(round(seconds / dt)):
        led.step()
        arm.q += dt * arm.velocity
        arm.time += dt
    return arm, start


def test_the_hand_goes_where_it_is_led():
    way = np.array([0.0, 0.1, -0.05])
    arm, start = lead(1.0, twist=np.concatenate([way, np.zeros(3)]))
    moved = (arm.hand().position - start.position).numpy()
    # It takes a moment to come up to speed, and steps of 40 ms cut curves.
    np.testing.assert_allclose(moved, way, atol=0.05 * 0.1)
    assert np.linalg.norm(start.twist_to(arm.hand())[3:]) < 5e-3


def test_a_pull_at_the_body_leaves_the_hand_where_it_is():
    q = Workplace().home_joints()
    effort = 3.0 * panda.joint_jacobian(q, 4)[:3].mT.numpy() @ np.array([0.0, 4.0, 0.0])
    arm, start = lead(0.6, dt=0.01, nullspace_input=effort)
    assert np.abs(arm.q - q.numpy()).max() > 0.05
    # What is left is the drift of a step of 10 ms.
    assert float(start.twist_to(arm.hand()).norm()) < 3e-3


def test_a_region_draws_the_hand_in_no_faster_than_it_may():
    region = DrawnRegion(centre=(0.45, 0.25, 0.35), half_size=(0.08, 0.08, 0.08))
    arm, start = lead(1.0, region=region)
    distance = float((arm.hand().position - start.position).norm())
    assert distance <= HandGuidingConfig().attraction * 1.0 + 1e-6
    arm, _ = lead(8.0, region=region)
    offset = np.abs(arm.hand().position.numpy() - region.centre)
    # The last of the way in decays: within a few millimetres of the wall.
    assert (offset < 0.085).all()


def test_a_target_is_reached():
    target = (0.5, 0.1, 0.4)
    arm, _ = lead(6.0, target=target)
    np.testing.assert_allclose(arm.hand().position.numpy(), target, atol=3e-3)


def test_the_hand_that_leads_knows_better_than_the_region():
    region = DrawnRegion(centre=(0.45, 0.25, 0.35), half_size=(0.08, 0.08, 0.08))
    away = np.array([0.0, -0.1, 0.0, 0.0, 0.0, 0.0])
    led, _ = lead(1.0, region=region, twist=away)
    alone, _ = lead(1.0, twist=away)
    np.testing.assert_allclose(led.q, alone.q, atol=1e-12)


def test_limits_hold_whatever_is_asked():
    arm, _ = lead(
        3.0, twist=np.array([0.0, 0.0, 5.0, 0.0, 0.0, 0.0]), nullspace_input=np.full(7, 1e3)
    )
    assert (arm.q >= panda.limits.lower.numpy()).all()
    assert (arm.q <= panda.limits.upper.numpy()).all()


@pytest.mark.parametrize("name", ["dt", "damping", "attraction", "approach_rate"])
def test_settings_that_make_no_sense_are_refused(name):
    with pytest.raises(ValueError, match=f"{name} must be positive"):
        HandGuidingConfig(**{name: 0.0})
