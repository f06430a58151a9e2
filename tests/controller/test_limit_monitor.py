import torch
from limit_monitor import LimitMonitor

from hrc_learn.kinematics import panda

LIMITS, DT = panda.limits, 0.001


def test_each_limit_is_seen_by_itself():
    """A motion of joint 1 that breaks one limit after the other."""
    q = panda.ready.clone()
    monitor = LimitMonitor(LIMITS, torch.zeros(7).double(), DT)

    def violations(velocity: float, position: float = 0.0) -> list[bool]:
        q[0] = position
        return monitor.violations(q, velocity * torch.eye(7).double()[0]).tolist()

    assert violations(0.007) == [False] * 4  # 7 rad/s^2, at 7000 rad/s^3
    assert violations(0.014) == [False] * 4
    assert violations(0.014, position=2.9) == [True, False, False, False]
    assert violations(0.014 + 0.0076) == [False, False, False, True]
    assert violations(0.014 + 0.0076 + 0.0152) == [False, False, True, True]
    assert violations(3.0)[1]
