import frankik
import torch
from sampling import generator, within
from torch.testing import assert_close

from hrc_learn.kinematics import panda


def test_position_limits_are_those_of_the_inverse_kinematics_library():
    def theirs(values):
        return torch.tensor(values, dtype=torch.float64)

    assert_close(panda.limits.lower, theirs(frankik.q_min_panda), rtol=0, atol=1e-4)
    assert_close(panda.limits.upper, theirs(frankik.q_max_panda), rtol=0, atol=1e-4)


def test_contain_tells_inside_from_outside():
    limits = panda.limits
    q = within(limits.lower, limits.upper, 3, 2, rng=generator(1))
    assert limits.contain(q).shape == (3, 2)
    assert bool(limits.contain(q).all())
    assert bool(limits.contain(limits.lower))
    for joint in range(7):
        outside = q.clone()
        outside[..., joint] = limits.upper[joint] + 1e-6
        assert not bool(limits.contain(outside).any())
    assert bool(limits.contain(limits.middle.float()))
