import torch

from hrc_learn.controller.monitors import LimitWatch
from hrc_learn.kinematics import panda

LIMITS, DT = panda.limits, 0.001


def test_each_limit_is_seen_by_itself():
    """A motion of joint 1 that breaks one limit after the other."""
    q = panda.ready.clone()
    watch = LimitWatch(LIMITS, torch.zeros(7).double(), DT)

    def beyond(velocity: float, position: float = 0.0) -> list[bool]:
        q[0] = position
        return watch.beyond(q, velocity * torch.eye(7).double()[0]).tolist()

    assert beyond(0.007) == [False] * 4  # 7 rad/s^2, at 7000 rad/s^3
    assert beyond(0.014) == [False] * 4
    assert beyond(0.014, position=2.9) == [True, False, False, False]
    assert beyond(0.014 + 0.0076) == [False, False, False, True]
    assert beyond(0.014 + 0.0076 + 0.0152) == [False, False, True, True]
    assert beyond(3.0)[1]
