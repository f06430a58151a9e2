import numpy as np
import pytest
import torch
from demo_motions import arm_motion

from hrc_learn.dmp import JointDMP, SpringDamper, Stepper

pytestmark = pytest.mark.simulation

SPRINGS = [
    SpringDamper(),
    SpringDamper(alpha=30.0, beta=2.0),
    SpringDamper(alpha=12.0, beta=20.0),
]


@pytest.mark.parametrize(
    ("scaling", "spring", "approach"),
    [
        ("none", SPRINGS[0], 0.7),
        ("none", SPRINGS[1], 0.0),
        ("paper", SPRINGS[2], 0.7),
        ("paper", SPRINGS[0], 0.0),
        ("amplitude", SPRINGS[1], 0.7),
        ("amplitude", SPRINGS[2], 0.0),
    ],
)
def test_it_does_what_the_primitive_does(scaling, spring, approach):
    """Over new goals, pushes, slow-downs, steps of all lengths and far past the end."""
    time, position = arm_motion(moving_start=True)
    dmp = JointDMP.fit(time, position, scaling=scaling, spring=spring, approach=approach)
    stepper = Stepper(dmp)
    ends = {"start": position[0].numpy() + 0.1, "duration": 2.0}
    state, numpy_state = dmp.initial_state(**ends), stepper.initial_state(**ends)
    rng = np.random.default_rng(0)
    for k in range(30):
        dt = 10 ** rng.uniform(-3, 0)
        change = {"phase_stopping": 1.0} if k % 3 == 0 else {}
        change |= {"goal": rng.standard_normal(7)} if k % 7 == 0 else {}
        change |= {"coupling": rng.standard_normal(7)} if k % 5 == 0 else {}
        state = dmp.step(state, dt, **change)
        numpy_state = stepper.step(numpy_state, dt, **change)
        for name in ("position", "velocity"):
            expected = getattr(state, name).detach().numpy()
            np.testing.assert_allclose(getattr(numpy_state, name), expected, atol=1e-9)
    assert numpy_state.s > 1.5


def test_defaults_and_start_velocity_are_the_primitives():
    time, position = arm_motion(moving_start=True)
    dmp = JointDMP.fit(time, position)
    state = Stepper(dmp).initial_state()
    np.testing.assert_allclose(state.velocity, dmp.start_velocity.numpy())
    pushed = Stepper(dmp).initial_state(start_velocity=np.ones(7), duration=1.3)
    np.testing.assert_allclose(pushed.velocity, np.ones(7))


def test_a_batch_is_refused():
    time, position = arm_motion()
    with pytest.raises(ValueError, match=r"one primitive, got a batch \(2,\)"):
        Stepper(JointDMP.fit(time, torch.stack([position, position])))
