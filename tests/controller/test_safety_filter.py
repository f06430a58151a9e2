import dataclasses
from typing import Any

import pytest
import sampling
import torch
from torch import Tensor
from unchecked import shapes_unchecked

from hrc_learn.controller import (
    INTERVENTIONS,
    ConstraintConfig,
    Distances,
    SafetyConfig,
    SafetyFilter,
    SafetyState,
)
from hrc_learn.kinematics import arm, panda

LIMITS = panda.limits
READY = panda.ready
# Rounding of q + v dt over thousands of steps.
ROUNDING = 1e-9


def inside(*batch: int, seed: int = 0) -> Tensor:
    rng = sampling.generator(seed)
    return sampling.within(LIMITS.lower, LIMITS.upper, *batch, rng=rng)


def commands(kind: str, *batch: int, rng: torch.Generator) -> Tensor:
    noise = torch.randn(*batch, 7, generator=rng, dtype=torch.float64)
    match kind:
        case "noise":
            return 3 * noise
        case "push":  # always the same way, far beyond every limit
            return 1e6 * torch.ones_like(noise)
        case "bang-bang":
            return 50 * torch.sign(noise[:1]).expand_as(noise)
        case "broken":
            draw = torch.rand(*batch, 7, generator=rng, dtype=torch.float64)
            u = torch.where(draw < 0.02, torch.nan, 5 * noise)
            return torch.where(draw > 0.98, torch.inf, u)
        case _:
            raise AssertionError(kind)


def at_the_brink(*batch: int, rng: torch.Generator) -> tuple[Tensor, Tensor]:
    """Joints so fast towards a limit that they must brake at once, and hard, to keep it."""
    config, A = SafetyConfig(), LIMITS.acceleration
    reserve = A**2 / (2 * LIMITS.jerk)
    share = torch.rand(*batch, 7, generator=rng, dtype=torch.float64)
    speed = (1 - config.velocity_margin) * LIMITS.velocity * share
    v_hat = speed + reserve
    room = v_hat**2 / (2 * A) + v_hat / config.rate + config.margin
    up = torch.rand(*batch, 7, generator=rng) < 0.5
    q = torch.where(up, LIMITS.upper - room, LIMITS.lower + room)
    # Fast joints 4 and 6 may need more room than their range has from the other side.
    return q.clamp(LIMITS.lower + 0.03, LIMITS.upper - 0.03), torch.where(up, speed, -speed)


@pytest.mark.parametrize("kind", ["noise", "push", "bang-bang", "broken"])
@pytest.mark.parametrize("dt", [0.001, 0.008, pytest.param(0.05, marks=pytest.mark.long)])
def test_no_command_breaks_a_limit(kind: str, dt: float):
    """Each step checks position, velocity, acceleration and jerk: from rest anywhere inside
    the limits, and from states that leave no choice but to brake."""
    safety = SafetyFilter(LIMITS)
    rng = sampling.generator(7)
    anywhere = inside(40, seed=1)
    # Some joints start right at a limit.
    anywhere = torch.where(torch.rand(40, 7, generator=rng) < 0.1, LIMITS.upper, anywhere)
    brink, speed = at_the_brink(40, rng=rng)
    q, v = torch.cat([anywhere, brink]), torch.cat([0 * speed, speed])
    state = safety.initial_state(q, v)
    before = state
    with shapes_unchecked():  # for speed
        for k in range(250):
            if k % 5 == 0:
                u = commands(kind, 80, rng=rng)
            v, state, _ = safety.step(state, q, u, dt)
            q = q + v * dt
            assert_limits_kept(q, before, state, dt)
            before = state


def assert_limits_kept(q: Tensor, before: SafetyState, state: SafetyState, dt: float) -> None:
    rounding = 1 + 1e-9
    a = (state.velocity - before.velocity) / dt
    assert (q <= LIMITS.upper + ROUNDING).all()
    assert (q >= LIMITS.lower - ROUNDING).all()
    allowed = (1 - SafetyConfig().velocity_margin) * LIMITS.velocity
    assert (state.velocity.abs() <= allowed).all()
    assert (a.abs() <= LIMITS.acceleration * rounding).all()
    assert ((a - before.acceleration).abs() <= LIMITS.jerk * dt * rounding).all()
    torch.testing.assert_close(state.acceleration, a, rtol=0, atol=1e-9)


@shapes_unchecked()  # for speed
def test_beyond_a_limit_it_brakes_as_hard_as_the_arm_can_and_no_harder():
    """Pushed across its limits at full speed, no admissible motion keeps them: those of
    acceleration and jerk hold all the same, the joints come to rest, and back when asked to."""
    dt, safety = 0.002, SafetyFilter(LIMITS)
    side = torch.tensor([[1.0], [-1.0]], dtype=torch.float64)
    wall = torch.stack([LIMITS.upper, LIMITS.lower])
    q = wall + side * 0.05
    state = safety.initial_state(q, side * 0.9 * LIMITS.velocity)
    hardest = torch.zeros(2, 7, dtype=torch.float64)
    for k in range(1250):
        before = state
        asked = side * LIMITS.velocity if k < 750 else -0.5 * side * LIMITS.velocity
        v, state, _ = safety.step(state, q, asked, dt)
        q = q + v * dt
        if k == 749:
            assert v.abs().max() < 1e-9
            assert (side * (q - wall) > 0.05).all()
        a = (v - before.velocity) / dt
        hardest = torch.maximum(hardest, -side * a)
        assert (a.abs() <= LIMITS.acceleration * (1 + 1e-9)).all()
        change = (a - before.acceleration).abs()
        assert (change <= LIMITS.jerk * dt * (1 + 1e-9)).all()
    torch.testing.assert_close(hardest, LIMITS.acceleration.expand(2, 7))
    assert LIMITS.contain(q).all()


@pytest.mark.parametrize("dt", [0.0005, 0.001, 0.002])
@shapes_unchecked()  # for speed
def test_a_stop_and_a_resume_are_smooth(dt: float):
    """Jerk limited, without overshoot, along a straight line in joint space, and the whole
    ramp hardly later than acceleration alone would have it."""
    safety = SafetyFilter(LIMITS)
    u = torch.tensor([0.5, -0.4, 0.3, 0.2, -0.1, 0.6, -0.7], dtype=torch.float64)
    state, q = safety.initial_state(READY, u), READY
    fastest = (u.abs() / LIMITS.acceleration).max().item()
    for target in (0 * u, u):
        speeds = []
        for _ in range(round((fastest + 0.02) / dt)):
            before = state
            v, state, _ = safety.step(state, q, u, dt, stop=torch.tensor(not target.any()))
            q = q + v * dt
            assert_limits_kept(q, before, state, dt)
            speeds.append(v @ u / (u @ u))
            torch.testing.assert_close(v, speeds[-1] * u, rtol=0, atol=1e-9)
        change = torch.stack(speeds).diff()
        assert (change <= 1e-12).all() or (change >= -1e-12).all()
        torch.testing.assert_close(v, target, rtol=0, atol=1e-6)


def test_it_stops_short_of_the_limit_by_the_margin():
    """And by the room it takes to start braking."""
    config = SafetyConfig(margin=0.05)
    safety = SafetyFilter(LIMITS, config)
    q = READY
    state = safety.initial_state(q)
    with shapes_unchecked():
        for _ in range(800):
            v, state, _ = safety.step(state, q, 9 * torch.ones(7, dtype=torch.float64), 0.01)
            q = q + v * 0.01
    v_hat = LIMITS.acceleration**2 / (2 * LIMITS.jerk)
    room = v_hat / config.rate + v_hat**2 / (2 * LIMITS.acceleration)
    torch.testing.assert_close(q, LIMITS.upper - 0.05 - room, rtol=0, atol=1e-6)


HALTS: dict[str, dict[str, Any]] = {
    "a command of zero": {"joint_velocity_command": torch.zeros(7, dtype=torch.float64)},
    "a stop": {"stop": torch.tensor(True)},
    "a command of NaN": {
        "joint_velocity_command": torch.full((7,), torch.nan, dtype=torch.float64)
    },
    "a lost joint position": {
        "joint_position": torch.full((7,), torch.nan, dtype=torch.float64)
    },
    "a person too near": {"human_distance": torch.tensor(0.05, dtype=torch.float64)},
    "a person lost": {"human_distance": torch.tensor(torch.nan, dtype=torch.float64)},
}


@pytest.mark.parametrize("depth", [0.0215, pytest.param(-0.2, marks=pytest.mark.long)])
@pytest.mark.parametrize("halt", HALTS)
@shapes_unchecked()  # for speed
def test_outside_its_limits_a_stopped_arm_rests_and_returns_when_asked(halt, depth):
    """Past the limits, within the margin, and nearer to it than it takes to start braking."""
    safety = SafetyFilter(LIMITS)
    q, dt = (
        torch.where(torch.arange(7) % 2 == 0, LIMITS.lower + depth, LIMITS.upper - depth),
        0.004,
    )
    inwards = 0.3 * torch.sign(LIMITS.middle - q)
    state = safety.initial_state(q)
    usual: dict[str, Any] = {
        "joint_position": q,
        "joint_velocity_command": -inwards,
        "jacobian": panda.jacobian(q),
    }
    for _ in range(50):
        v, state, _ = safety.step(state, **(usual | HALTS[halt]), dt=dt)
        assert (v == 0).all()
    if depth < 0.02:
        v, state, _ = safety.step(state, **usual, dt=dt)
        assert (v * inwards >= 0).all()
    for _ in range(100 if depth > 0 else 400):
        v, state, _ = safety.step(state, q, inwards, dt)
        q = q + v * dt
    assert ((q > LIMITS.lower + 0.02) & (q < LIMITS.upper - 0.02)).all()


def test_a_harmless_command_passes_unchanged():
    safety = SafetyFilter(LIMITS)
    u = torch.linspace(-0.3, 0.3, 7, dtype=torch.float64)
    v, state, report = safety.step(safety.initial_state(READY, u), READY, u, 0.001)
    torch.testing.assert_close(v, u, rtol=0, atol=1e-15)
    assert not report.flags.any()
    assert not state.counts.any()


def test_speed_and_acceleration_keep_the_direction():
    safety = SafetyFilter(LIMITS)
    u = torch.tensor([4.0, -1.0, 0.5, 0.2, 8.0, -2.0, 1.0], dtype=torch.float64)
    state = safety.initial_state(READY)
    v, state, report = safety.step(state, READY, u, 0.01)
    torch.testing.assert_close(v / v.norm(), u / u.norm())
    assert report.acted("velocity")
    assert report.acted("acceleration")
    for _ in range(100):
        v, state, _ = safety.step(state, READY, u, 0.01)
    allowed = (1 - SafetyConfig().velocity_margin) * LIMITS.velocity
    torch.testing.assert_close(v, u * allowed[4] / 8.0)


@shapes_unchecked()  # for speed
def test_the_tool_is_capped_where_a_jacobian_is_given():
    safety = SafetyFilter(LIMITS, SafetyConfig(tcp_speed=0.2))
    u = torch.tensor([1.5, 0.5, 0, 0, 0, 0, 0], dtype=torch.float64)
    J = panda.jacobian(READY)
    state = safety.initial_state(READY)
    for _ in range(300):
        v, state, report = safety.step(state, READY, u, 0.002, jacobian=J)
    # The rest is kept for the turning of the links and the ramps of the acceleration.
    assert 0.19 < (J @ v)[:3].norm().item() <= 0.2
    torch.testing.assert_close(v / v.norm(), u / u.norm())
    assert report.acted("tcp_speed")


@pytest.mark.parametrize(
    "fault",
    [
        {"q": torch.full((7,), torch.nan, dtype=torch.float64)},
        {"u": torch.full((7,), torch.inf, dtype=torch.float64)},
        {"stop": torch.tensor(True)},
    ],
)
def test_a_fault_brakes_to_rest_along_a_straight_line_and_resumes_smoothly(fault):
    safety = SafetyFilter(LIMITS)
    u = torch.tensor([0.5, -0.4, 0.3, 0.2, -0.1, 0.6, -0.7], dtype=torch.float64)
    state, q, dt = safety.initial_state(READY, u), READY, 0.004
    options = {k: w for k, w in fault.items() if k == "stop"}
    for _ in range(60):
        before = state.velocity
        v, state, report = safety.step(
            state, fault.get("q", q), fault.get("u", u), dt, **options
        )
        q = q + v * dt
        assert ((v - before).abs() <= LIMITS.acceleration * dt * (1 + 1e-9)).all()
        if v.norm() > 1e-12:  # below that rounding alone
            torch.testing.assert_close(v / v.norm(), u / u.norm())
        torch.testing.assert_close(state.position, q)
    assert v.norm() < 1e-12
    assert report.acted("stopped" if "stop" in fault else "invalid")
    v, state, _ = safety.step(state, q, u, dt)
    assert 0 < v.norm() < 0.2


def test_one_faulty_arm_of_a_batch_leaves_the_others_alone():
    safety = SafetyFilter(LIMITS)
    q, u = READY.expand(3, 7).clone(), 0.01 * torch.ones(3, 7, dtype=torch.float64)
    q[1, 3] = torch.nan
    v, _, report = safety.step(safety.initial_state(READY.expand(3, 7)), q, u, 0.01)
    assert report.acted("invalid").tolist() == [False, True, False]
    assert v[1].norm() == 0
    # Within a step but for what it takes to fade the acceleration out.
    torch.testing.assert_close(v[[0, 2]], u[[0, 2]], rtol=0.02, atol=0)


def test_interventions_are_counted_by_kind():
    safety = SafetyFilter(LIMITS)
    state = safety.initial_state(READY)
    fast = 3 * torch.ones(7, dtype=torch.float64)
    for u in (fast, fast, torch.full_like(fast, torch.nan)):
        _, state, _ = safety.step(state, READY, u, 0.01)
    assert state.count("velocity") == 2
    assert state.count("invalid") == 1
    assert state.count("position") == 0
    with pytest.raises(ValueError, match="velocity, position"):
        state.count("boredom")
    assert state.counts.shape == (len(INTERVENTIONS),)


@pytest.mark.parametrize(("beyond", "flagged"), [(1e-13, False), (1e-3, True)])
def test_rounding_is_no_intervention(beyond: float, flagged: bool):
    """Commands are often led exactly along a limit."""
    safety, dt = SafetyFilter(LIMITS), 0.002
    q = READY.clone()
    q[1] = LIMITS.upper[1] - 0.1
    u = torch.zeros_like(q)
    u[1] = safety.velocity_bounds(q)[1][1] * (1 + beyond)
    steady = safety.initial_state(q, u.clone())
    _, _, report = safety.step(steady, q, u, dt)
    assert bool(report.acted("position")) == flagged


@pytest.mark.parametrize("dt", [0.0, -0.01, 0.3])
def test_a_step_that_voids_the_guarantee_is_refused(dt: float):
    safety = SafetyFilter(LIMITS)
    with pytest.raises(ValueError, match="lower the filter's rate"):
        safety.step(safety.initial_state(READY), READY, READY, dt)


def test_a_batch_is_a_loop():
    safety = SafetyFilter(LIMITS)
    rng = sampling.generator(3)
    q, u = inside(4, 3, seed=3), 4 * torch.randn(4, 3, 7, generator=rng, dtype=torch.float64)
    state = safety.initial_state(q)
    v, _, report = safety.step(state, q, u, 0.01)
    for i in range(4):
        for j in range(3):
            one = SafetyState(
                **{f.name: getattr(state, f.name)[i, j] for f in dataclasses.fields(state)}
            )
            v_one, _, report_one = safety.step(one, q[i, j], u[i, j], 0.01)
            torch.testing.assert_close(v_one, v[i, j], rtol=0, atol=0)
            assert (report_one.flags == report.flags[i, j]).all()


def test_follows_its_dtype():
    safety = SafetyFilter(LIMITS).float()
    q = READY.float()
    v, state, _ = safety.step(safety.initial_state(q), q, torch.ones(7), 0.01)
    assert v.dtype == state.position.dtype == torch.float32


def test_single_precision_arrays_and_numbers_are_taken_as_the_filters_own():
    safety, u = SafetyFilter(panda), torch.full((7,), 0.1, dtype=torch.float64)
    q, J, state = READY.float(), panda.jacobian(READY), safety.initial_state(READY.float())
    distance = torch.tensor(0.5, dtype=torch.float64)
    expected, _, _ = safety.step(
        state, q.double(), u, 0.01, jacobian=J, joint_velocity=0 * u, human_distance=distance
    )
    for jacobian in (J.numpy(), J.tolist()):
        v, after, _ = safety.step(
            state,
            q,
            u.numpy(),
            0.01,
            jacobian=jacobian,
            joint_velocity=[0] * 7,
            human_distance=0.5,
            stop=False,
        )
        torch.testing.assert_close(v, expected, rtol=0, atol=0)
        assert after.position.dtype == torch.float64
    single, _, _ = safety.step(state, q, u.float(), 0.01, jacobian=J.float())
    torch.testing.assert_close(single, expected, rtol=0, atol=1e-6)  # rounding of float32
    _, _, report = safety.step(state, q, u, 0.01, stop=True)
    assert report.acted("stopped")
    assert safety.initial_state(torch.tensor([0, 0, 0, -1, 0, 1, 0])).dt > 0


@shapes_unchecked()  # the annotations refuse them earlier
def test_matrices_for_another_number_of_joints_are_refused_by_name():
    safety = SafetyFilter(panda, SafetyConfig(constraints=ConstraintConfig()))
    state, J, u = safety.initial_state(READY), panda.jacobian(READY), torch.zeros(7)
    with pytest.raises(ValueError, match="each row of jacobian needs 7 values"):
        safety.step(state, READY, u, 0.01, jacobian=J[:, :6])
    near = Distances(distance=u[:2], gradient=torch.zeros(2, 6), approach_speed=u[:2])
    with pytest.raises(ValueError, match=r"each row of distances\.gradient needs 7 values"):
        safety.step(state, READY, u, 0.01, jacobian=J, distances=near)
    with pytest.raises(ValueError, match="joint_velocity needs 7 values"):
        safety.step(state, READY, u, 0.01, jacobian=J, joint_velocity=u[:6])


def test_an_arm_gives_its_limits_and_arrays_and_lists_are_accepted():
    ur5e = arm("ur5e")
    by_arm, by_limits = SafetyFilter(ur5e), SafetyFilter(ur5e.limits)
    q, u = ur5e.ready, torch.full((6,), 0.3, dtype=torch.float64)
    expected, _, _ = by_limits.step(by_limits.initial_state(q), q, u, 0.01)
    for convert in (lambda x: x, lambda x: x.numpy(), lambda x: x.tolist()):
        state = by_arm.initial_state(convert(q))
        velocity, _, _ = by_arm.step(state, convert(q), convert(u), 0.01)
        torch.testing.assert_close(velocity, expected)


def test_a_wrong_number_of_joints_is_named():
    safety = SafetyFilter(arm("ur5e"))
    state = safety.initial_state(torch.zeros(6, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"joint_position needs 6 values.*\(7,\)"):
        safety.initial_state(torch.zeros(7, dtype=torch.float64))
    with pytest.raises(ValueError, match="joint_velocity_command needs 6 values"):
        safety.step(state, torch.zeros(6, dtype=torch.float64), [0.0] * 7, 0.01)


@pytest.mark.parametrize("moves", [1.0, -1.0])
def test_a_start_that_is_measured_at_rest_is_not_one_in_motion(moves):
    safety = SafetyFilter(LIMITS)
    state = safety.initial_state(READY, moves * 0.2 * LIMITS.velocity)
    still = torch.zeros_like(READY)
    v, after, report = safety.step(state, READY, still, 0.01, joint_velocity=still)
    assert report.acted("start")
    assert not v.any()
    assert after.count("start") == 1


def test_a_jacobian_that_is_not_finite_leaves_the_report_finite():
    safety = SafetyFilter(LIMITS, SafetyConfig(tcp_speed=0.2))
    u = 0.1 * torch.ones(7, dtype=torch.float64)
    J = panda.jacobian(READY)
    J[1, 2] = torch.nan
    v, after, report = safety.step(safety.initial_state(READY, u), READY, u, 0.01, jacobian=J)
    assert report.acted("invalid")
    assert float(report.speed_excess) == float(report.speed_excess_time) == 0.0
    assert ((v >= 0) & (v < u)).all()
    assert all(x.isfinite().all() for x in (after.velocity, after.acceleration, after.position))


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(("beyond", "wrong"), [(0.99, False), (1.01, True)])
def test_one_joint_that_is_not_as_fast_as_a_start_says_restarts_the_filter(beyond, wrong, side):
    """3 % of its highest velocity may be noise of the encoders."""
    safety = SafetyFilter(LIMITS)
    measured = torch.zeros(2, 7, dtype=torch.float64)
    highest = (1 - SafetyConfig().velocity_margin) * LIMITS.velocity
    measured[0, 3] = side * beyond * 0.03 * highest[3]
    q, still = READY.expand(2, 7), torch.zeros_like(measured)
    speeding_up = 0.5 * LIMITS.acceleration.expand(2, 7)
    state = safety.initial_state(q, still, speeding_up)
    u = 0.5 * torch.ones_like(q)
    v, after, report = safety.step(state, q, u, 0.004, joint_velocity=measured)
    assert report.acted("start").tolist() == [wrong, False]
    restarted = safety.initial_state(q, measured)
    start = restarted if wrong else state
    expected = [safety.step(x, q, u, 0.004)[0][k] for k, x in enumerate((start, state))]
    torch.testing.assert_close(v, torch.stack(expected), rtol=0, atol=0)
    assert not after.fresh.any()


def test_a_state_that_is_not_finite_restarts_at_rest_in_the_middle_of_the_range():
    safety = SafetyFilter(LIMITS)
    good = safety.initial_state(READY, 0.1 * LIMITS.velocity, 0.2 * LIMITS.acceleration)
    assert float(good.dt) == pytest.approx(0.001)
    assert bool(good.fresh)
    longest = safety.config.longest_step
    lost = dataclasses.replace(
        good,
        velocity=torch.full_like(READY, torch.nan),
        acceleration=torch.full_like(READY, torch.inf),
        position=torch.full_like(READY, torch.nan),
        too_fast=torch.tensor(torch.nan).double(),
    )
    found = safety.restored(lost)
    torch.testing.assert_close(found.position, LIMITS.middle)
    for rest in (found.velocity, found.acceleration, found.too_fast):
        assert not rest.any()
    kept = safety.restored(good)
    for name in ("velocity", "acceleration", "position", "dt"):
        assert torch.equal(getattr(kept, name), getattr(good, name))
    for dt, valid in ((longest, True), (1.001 * longest, False), (0.0, False), (1e-4, True)):
        state = dataclasses.replace(good, dt=torch.tensor(dt, dtype=torch.float64))
        assert float(safety.restored(state).dt) == pytest.approx(dt if valid else 0.001)
        # So with the step of an irregular clock.
        _, after, report = safety.step(
            good, READY, 0.1 * LIMITS.velocity, torch.tensor(dt, dtype=torch.float64)
        )
        assert report.acted("invalid") != valid
        assert float(after.dt) == pytest.approx(dt if valid else 0.001)
    safety.step(good, READY, READY, longest)


@pytest.mark.parametrize(("beyond", "flagged"), [(1e-7, False), (1e-5, True)])
def test_an_excess_above_a_millionth_is_reported(beyond, flagged):
    J = panda.jacobian(READY)
    u = torch.linspace(0.2, -0.3, 7, dtype=torch.float64)
    speed = float((J[:3] @ u).norm())
    config = SafetyConfig(tcp_speed=0.3)
    safety = SafetyFilter(LIMITS, config)

    def flags(u, **given):
        state = safety.initial_state(READY, u.clone())
        return safety.step(state, READY, u, 0.001, jacobian=J, **given)[2]

    near = torch.tensor(0.5, dtype=torch.float64)
    safe = float(config.separation.highest_speed(near))
    assert 0 < safe < 0.3
    report = flags((1 + beyond) * safe / speed * u, human_distance=near)
    assert bool(report.acted("separation")) == flagged
    alone = torch.zeros_like(u)
    alone[6] = -(1 + beyond) * (1 - config.velocity_margin) * LIMITS.velocity[6]
    assert bool(flags(alone).acted("velocity")) == flagged
    # A person so near that nothing may move is reported in any case.
    for distance, stops in ((0.01, True), (0.5, False)):
        near = torch.tensor(distance, dtype=torch.float64)
        assert bool(flags(0 * u, human_distance=near).acted("separation")) == stops


@pytest.mark.parametrize(("braking", "jitter"), [(0.3, 0.0), (1.0, 0.2), (0.6, 0.1)])
def test_the_driver_uses_a_part_of_acceleration_and_jerk_and_its_steps_vary(braking, jitter):
    dt, joint = 0.001, 5
    safety = SafetyFilter(LIMITS, SafetyConfig(braking=braking, jitter=jitter))
    u = torch.zeros(7, dtype=torch.float64)
    u[joint] = 2.0
    state, speeds = safety.initial_state(READY), [0.0, 0.0]
    for _ in range(60):
        v, state, _ = safety.step(state, READY, u, dt)
        speeds.append(float(v[joint]))
    a = torch.tensor(speeds, dtype=torch.float64).diff() / dt
    usable = braking * (1 - jitter)
    for found, limit in ((a, LIMITS.acceleration), (a.diff() / dt, LIMITS.jerk)):
        assert float(found.abs().max()) == pytest.approx(usable * float(limit[joint]), rel=1e-6)


def test_a_load_of_which_one_coordinate_is_unknown_brakes_its_arm_alone():
    safety, u = SafetyFilter(panda), 0.1 * torch.ones(2, 7, dtype=torch.float64)
    load = torch.tensor([[0.0, 0.0, 0.1], [torch.nan, 0.0, 0.1]], dtype=torch.float64)
    q = READY.expand(2, 7)
    state, J = safety.initial_state(q, u), panda.jacobian(q)
    v, _, report = safety.step(state, q, u, 0.002, jacobian=J, load=load)
    assert report.acted("invalid").tolist() == [False, True]
    torch.testing.assert_close(v[0], u[0])
    assert (v[1] < u[1]).all()


@shapes_unchecked()  # for speed
def test_each_arm_of_a_batch_is_capped_by_its_own_points():
    """Some are far below the cap, some meet it only by the end of their load."""
    safety, rng = SafetyFilter(panda, SafetyConfig(tcp_speed=0.25)), sampling.generator(5)
    q = READY + 0.3 * torch.randn(5, 7, generator=rng, dtype=torch.float64)
    scale = torch.tensor([0.02, 0.2, 0.5, 1.0, 2.0], dtype=torch.float64)[:, None]
    u = scale * torch.randn(5, 7, generator=rng, dtype=torch.float64)
    load = 0.3 * torch.randn(5, 3, generator=rng, dtype=torch.float64)
    state, J = safety.initial_state(q), panda.jacobian(q)
    alone = [safety.initial_state(x) for x in q]
    near = torch.tensor([2.0, 0.6, 2.0, 0.3, 0.5], dtype=torch.float64)
    for _ in range(20):
        v, state, report = safety.step(
            state, q, u, 0.01, jacobian=J, load=load, human_distance=near
        )
        for k in range(5):
            given = {"jacobian": J[k], "load": load[k], "human_distance": near[k]}
            one, alone[k], told = safety.step(alone[k], q[k], u[k], 0.01, **given)
            torch.testing.assert_close(v[k], one, rtol=0, atol=1e-12)
            assert torch.equal(told.flags, report.flags[k])
    capped = report.acted("tcp_speed") | report.acted("separation")
    assert 0 < capped.sum() < 5


@pytest.mark.parametrize("stops", [{"stop": torch.tensor(True)}, {"u": torch.nan}])
def test_a_stop_above_the_cap_brakes_as_hard_as_one_without_a_cap(stops):
    """Where the cap alone would let the arm ease off."""
    safety, q = SafetyFilter(panda), READY
    u = torch.tensor([0.9, 0.4, 0, 0, 0, 0, 0], dtype=torch.float64)
    asked = torch.full_like(u, stops["u"]) if "u" in stops else u
    stop = {name: value for name, value in stops.items() if name == "stop"}
    given = {"jacobian": panda.jacobian(q)}
    speed = float((given["jacobian"][:3] @ u).norm())
    for factor in (0.5, 0.97, 1.0):
        safety = SafetyFilter(panda, SafetyConfig(tcp_speed=factor * speed))
        state = safety.initial_state(q, u)
        hard, _, _ = safety.step(state, q, asked, 0.004, **stop)
        capped, _, report = safety.step(state, q, asked, 0.004, **given, **stop)
        assert not report.acted("tcp_speed")  # the stop is the reason
        torch.testing.assert_close(capped, hard, rtol=0, atol=0)
