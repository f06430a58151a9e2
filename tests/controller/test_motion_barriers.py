"""The argument that the limits can always be kept, checked by itself in plain numbers."""

import math

import sampling
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hrc_learn.controller.limit_barrier import LimitBarrier
from hrc_learn.kinematics import panda

LIMITS = panda.limits


@settings(max_examples=400)
@given(
    A=st.floats(1.0, 30.0),
    j=st.floats(100.0, 1e5),
    rate=st.floats(0.5, 20.0),
    a_share=st.floats(-1.0, 1.0),
    v=st.floats(-3.0, 3.0),
    spare=st.floats(0.0, 0.1),
    dt_share=st.floats(1e-4, 1.0),
)
def test_braking_stays_in_the_set_and_short_of_the_limit(
    A, j, rate, a_share, v, spare, dt_share
):
    """From any state of the set, one step of a_k - j dt (no less than -A), for any dt."""
    dt = dt_share / rate

    def needed(v_hat: float) -> float:
        """Q, and its odd continuation past the limit: the distance that a speed needs."""
        return math.copysign(v_hat**2 / (2 * A) + abs(v_hat) / rate, v_hat)

    a = a_share * A
    v_hat = v + (a + A) ** 2 / (2 * j)
    delta = needed(v_hat) + spare
    if delta < 0:
        return  # past the limit already
    gone = delta - v * dt
    a_next = max(a - j * dt, -A)
    v_next = v + a_next * dt
    rounding = 1e-12
    assert gone >= -rounding
    assert needed(v_next + (a_next + A) ** 2 / (2 * j)) <= gone + rounding


def test_the_bounds_on_acceleration_reach_the_edge_of_the_set():
    """Put back into v_hat they give the bound on velocity, plus the reserve."""
    rng = sampling.generator()
    barrier = LimitBarrier(LIMITS, margin=0.02, rate=5.0)
    q = sampling.within(LIMITS.lower, LIMITS.upper, 50, rng=rng)
    lower, upper = bounds = barrier.velocity_bounds(q)
    unit = torch.rand(50, 7, generator=rng, dtype=torch.float64)
    v, dt = torch.lerp(lower, upper, unit), 0.001
    least, most = barrier.acceleration_bounds(v, bounds, dt)
    A, j = LIMITS.acceleration, LIMITS.jerk
    for sign, a, bound in ((1, most, upper), (-1, least, lower)):
        v_hat = sign * (v + a * dt) + (sign * a + A) ** 2 / (2 * j)
        torch.testing.assert_close(v_hat, sign * bound + A**2 / (2 * j), rtol=0, atol=1e-12)
    # Slow joints far from limits may use all of their acceleration.
    free = barrier.acceleration_bounds(
        torch.zeros(7).double(), (-LIMITS.velocity, LIMITS.velocity), dt
    )
    assert (free[1] > A).all()
    assert (free[0] < -A).all()
