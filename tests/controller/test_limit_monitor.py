import torch
from limit_monitor import LimitMonitor

from hrc_learn.kinematics import panda

LIMITS, DT = panda.limits, 0.001


def test_each_limit_is_seen_by_itself():
    """A motion of joint 1 that breaks one limit after the other."""
    q = panda.ready.clone()
    monitor = LimitMonitor(LIMITS, torch.zeros(7).double(), DT, cap=0.9)
    points = torch.zeros(2, 3, 7).double()
    points[1, 0, 0] = 0.5  # a point at a radius of 0.5 m

    def violations(velocity: float, position: float = 0.0) -> list[bool]:
        q[0] = position
        velocities = velocity * torch.eye(7).double()[0]
        return monitor.violations(q, velocities, points).tolist()

    assert violations(0.007) == [False] * 5  # 7 rad/s^2, at 7000 rad/s^3
    assert violations(0.014) == [False] * 5
    assert violations(0.014, position=2.9) == [True, False, False, False, False]
    assert violations(0.014 + 0.0076) == [False, False, False, True, False]
    assert violations(0.014 + 0.0076 + 0.0152) == [False, False, True, True, False]
    assert violations(1.79)[1::3] == [False, False]
    assert violations(1.81)[1::3] == [False, True]
    assert violations(3.0)[1]
