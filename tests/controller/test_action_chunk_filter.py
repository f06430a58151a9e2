"""Chunks followed within limits: for certain, without lag, and without overshoot."""

import itertools
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from unchecked import shapes_unchecked

from hrc_learn.controller import LIMIT_KINDS, ActionChunkFilter
from hrc_learn.kinematics import MotionLimits, panda

DT = 0.02


def limits(lower=-3.0, upper=3.0, velocity=1.0, acceleration=3.0, jerk=30.0, joints=1):
    values = {
        "lower": lower,
        "upper": upper,
        "velocity": velocity,
        "acceleration": acceleration,
        "jerk": jerk,
    }
    full = {k: torch.full((joints,), v, dtype=torch.float64) for k, v in values.items()}
    return MotionLimits(**full)


def worst(positions, start, given, dt):
    """Largest velocity, acceleration and jerk from rest, as shares of their limits."""
    rest = start.expand(*positions.shape[:-2], 3, -1)
    path, shares = torch.cat([rest, positions], dim=-2), []
    for limit in (given.velocity, given.acceleration, given.jerk):
        path = path.diff(dim=-2) / dt
        shares.append(float((path.abs() / limit).max()))
    return shares


def follow(smoother, chunks, start):
    """All positions handed out for chunks that follow each other, and the reports."""
    state, out, reports = smoother.initial_state(start), [], []
    with shapes_unchecked():
        for chunk in chunks:
            smooth, state, report = smoother(chunk, state)
            out.append(smooth)
            reports.append(report)
    return torch.cat(out, dim=-2), state, reports


def wave(steps, dt=DT, start=0):
    """A motion that keeps `limits()`."""
    t = torch.arange(start + 1, start + steps + 1, dtype=torch.float64) * dt
    return (0.3 * (1 - torch.cos(1.5 * t)))[:, None]


HOSTILE = st.one_of(
    st.floats(-10, 10),
    st.floats(allow_nan=True, allow_infinity=True),
    st.sampled_from([-1e12, 1e12, 0.99, -0.99, 0.0]),
)


@settings(max_examples=40, deadline=None)
@given(
    chunks=st.lists(st.lists(HOSTILE, min_size=1, max_size=30), min_size=1, max_size=3),
    velocity=st.floats(0.05, 50),
    brake_time=st.floats(0.02, 2.0),
    ramp_time=st.floats(0.01, 1.0),
    dt=st.floats(0.002, 0.1),
)
def test_limits_hold_for_any_chunks(chunks, velocity, brake_time, ramp_time, dt):
    acceleration = velocity / brake_time
    given_limits = limits(-1.0, 1.0, velocity, acceleration, acceleration / ramp_time)
    start = torch.zeros(1, dtype=torch.float64)
    hostile = [torch.tensor(c, dtype=torch.float64)[:, None] for c in chunks]
    positions, _, _ = follow(ActionChunkFilter(given_limits, dt), hostile, start)
    assert positions.isfinite().all()
    assert positions.abs().max() <= 1 + 1e-9
    assert max(worst(positions, start, given_limits, dt)) <= 1 + 1e-6


@pytest.mark.parametrize("size", [1, 3, 25])
def test_a_motion_that_keeps_the_limits_comes_out_as_it_went_in(size):
    motion = wave(120)
    start = torch.zeros(1, dtype=torch.float64)
    positions, _, reports = follow(ActionChunkFilter(limits(), DT), motion.split(size), start)
    torch.testing.assert_close(positions, motion, rtol=0, atol=1e-12)
    assert not any(report.broken.any() for report in reports)


@pytest.mark.parametrize(
    ("step", "slope", "size"), [(0.02, 0.0, 1), (0.3, 0.4, 1), (-1.0, 0.4, 50), (0.3, 0.0, 50)]
)
def test_a_step_between_chunks_is_blended_without_overshoot(step, slope, size):
    first, second = wave(60), wave(200, start=60)
    seam = torch.arange(1, 201, dtype=torch.float64)[:, None] * DT
    second = second + step + slope * seam.clamp(max=1.0)
    chunks = [*first.split(size), *second.split(size)]
    start = torch.zeros(1, dtype=torch.float64)
    positions, _, reports = follow(ActionChunkFilter(limits(), DT), chunks, start)
    asked = torch.cat(chunks)
    assert max(worst(positions, start, limits(), DT)) <= 1 + 1e-6
    assert max(worst(asked, start, limits(), DT)) > 100
    assert any(report.broken[..., LIMIT_KINDS.index("jerk")].any() for report in reports)
    left = (positions - asked)[60:110] * -torch.sign(torch.tensor(step))
    assert left.min() > -2e-3  # does not pass the chunk by
    torch.testing.assert_close(positions[-50:], asked[-50:], rtol=0, atol=2e-4)


def test_a_step_settles_nearly_as_fast_as_can_be():
    """Against the shortest time from rest to rest at any speed, 2 sqrt(d/A) + A/j."""
    given_limits = limits(velocity=10.0, acceleration=3.0, jerk=60.0)
    smoother = ActionChunkFilter(given_limits, DT)
    for distance in (0.3, 0.8):
        chunk = torch.full((150, 1), distance, dtype=torch.float64)
        positions, _, _ = smoother(chunk, smoother.initial_state(torch.zeros(1)))
        arrived = DT * int((positions - distance).abs().gt(1e-3).sum())
        shortest = 2 * (distance / 3.0) ** 0.5 + 3.0 / 60.0
        assert shortest < arrived + 2 * DT
        assert arrived < 1.6 * shortest


def test_noise_is_followed_as_far_as_the_limits_let_it():
    rng = torch.Generator().manual_seed(0)
    motion = wave(250)
    noise = 3e-4 * torch.randn(250, 1, generator=rng, dtype=torch.float64)
    start = torch.zeros(1, dtype=torch.float64)
    positions, _, _ = follow(ActionChunkFilter(limits(), DT), (motion + noise).split(50), start)
    assert max(worst(positions, start, limits(), DT)) <= 1 + 1e-6
    assert (positions - motion).abs().max() < 5e-3


@pytest.mark.parametrize("batch", [(), (1,), (2, 3)])
def test_batches_and_joints_are_followed_one_by_one(batch):
    rng = torch.Generator().manual_seed(1)
    smoother = ActionChunkFilter(panda.limits, DT)
    start = panda.ready.expand(*batch, 7).clone()
    chunks = start.unsqueeze(-2) + torch.randn(
        *batch, 12, 7, generator=rng, dtype=torch.float64
    )
    together, _, report = smoother(chunks, smoother.initial_state(start))
    assert report.broken.shape == (*batch, 12, 4)
    torch.testing.assert_close(report.change, together - chunks)
    for index in itertools.product(*map(range, batch)):
        for j in range(7):
            own = {k: v if v is None else v[j : j + 1] for k, v in vars(limits()).items()} | {
                name: getattr(panda.limits, name)[j : j + 1]
                for name in ("lower", "upper", "velocity", "acceleration", "jerk")
            }
            alone = ActionChunkFilter(MotionLimits(**own), DT)
            state = alone.initial_state(start[index][j : j + 1])
            positions, _, _ = alone(chunks[index][:, j : j + 1], state)
            torch.testing.assert_close(together[index][:, j], positions[:, 0])


def test_the_report_says_when_any_joint_would_break_a_limit():
    """Against plain loops over samples and joints, for limits that a tenth of them break."""
    rng = torch.Generator().manual_seed(3)
    joints, steps = 2, 40
    chunk = 0.1 * torch.randn(steps, joints, generator=rng, dtype=torch.float64)
    start = torch.zeros(joints, dtype=torch.float64)
    derivatives = [torch.cat([start.expand(3, joints), chunk])]
    for _ in range(3):
        derivatives.append(derivatives[-1].diff(dim=0) / DT)
    values = [x[-steps:] for x in derivatives]
    tenth = [x.abs().quantile(0.9, dim=0) for x in values]
    given_limits = MotionLimits(
        lower=-tenth[0],
        upper=0.9 * tenth[0],
        velocity=tenth[1],
        acceleration=tenth[2],
        jerk=tenth[3],
    )
    smoother = ActionChunkFilter(given_limits, DT)
    # The filter may lower its own limit of acceleration, which is not what a chunk breaks.
    tenth[2] = smoother.barrier.acceleration
    _, _, report = smoother(chunk, smoother.initial_state(start))
    for k in range(steps):
        expected = [False] * 4
        for j in range(joints):
            expected[0] |= bool(values[0][k, j] > 0.9 * tenth[0][j])
            expected[0] |= bool(values[0][k, j] < -tenth[0][j])
            for kind in (1, 2, 3):
                expected[kind] |= bool(values[kind][k, j].abs() > tenth[kind][j])
        assert report.broken[k].tolist() == expected
    share = report.broken.double().mean(dim=0)
    assert share[0] < 0.5
    assert share[1] < 0.5
    assert (share > 0).all()


def test_what_is_not_finite_is_taken_for_what_came_before():
    smoother, start = ActionChunkFilter(limits(), DT), torch.zeros(1, dtype=torch.float64)
    chunk = wave(10)
    broken, mended = chunk.clone(), chunk.clone()
    broken[3:5], mended[3:5] = torch.tensor([[float("nan")], [float("inf")]]), chunk[2]
    ours, _, _ = smoother(broken, smoother.initial_state(start))
    expected, _, _ = smoother(mended, smoother.initial_state(start))
    torch.testing.assert_close(ours, expected)


def test_single_precision_goes_in_and_out():
    smoother = ActionChunkFilter(limits(), DT)
    chunk = wave(5).float()
    smooth, state, _ = smoother(chunk, smoother.initial_state(torch.zeros(1)))
    assert smooth.dtype == torch.float32
    assert state.position.dtype == torch.float64


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"jerk": torch.zeros(1)}, "jerk must be positive"),
        ({"velocity": torch.full((1,), float("inf"))}, "velocity must be positive and finite"),
        ({"lower": torch.full((1,), 4.0)}, "below the upper"),
    ],
)
def test_limits_that_make_no_sense_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        ActionChunkFilter(replace(limits(), **change), DT)


def test_dt_must_be_positive():
    with pytest.raises(ValueError, match="dt must be positive"):
        ActionChunkFilter(limits(), 0.0)


@pytest.mark.parametrize("dt", [0.001, 0.1])
def test_it_can_stop_within_a_tenth_of_the_range_and_gives_up_no_more(dt):
    """The larger of both terms of the way that braking from rest takes is half of that."""
    j = torch.logspace(0, 4, 40, dtype=torch.float64)
    limits = MotionLimits(
        lower=-torch.ones_like(j),
        upper=torch.full_like(j, 2.0),
        velocity=torch.ones_like(j),
        acceleration=torch.full_like(j, 15.0),
        jerk=j,
    )
    used = ActionChunkFilter(limits, dt).barrier.acceleration
    way = torch.maximum(used**3 / (8 * j**2), used**2 * dt / (2 * j))
    lowered = used < 15.0
    assert lowered.any()
    assert not lowered.all()
    torch.testing.assert_close(way[lowered], torch.full_like(way[lowered], 3.0 / 20))
    assert (way[~lowered] <= 3.0 / 20).all()
