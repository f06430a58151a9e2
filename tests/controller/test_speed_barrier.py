"""The cap on the speed of tool, elbow and load, under hostile commands and at odd starts."""

import math

import pytest
import torch
from bench_limits import Search, points_of, search
from sampling import generator, within

from hrc_learn.controller import (
    ArmLoop,
    ArmLoopConfig,
    ArmReading,
    SafetyConfig,
    SafetyFilter,
    SafetyState,
)
from hrc_learn.controller.arm_loop_state import MoveJoints
from hrc_learn.kinematics import arm, panda

pytestmark = pytest.mark.simulation

READY = panda.ready


@pytest.mark.parametrize(
    ("name", "dt", "changes"),
    [
        ("panda", 0.008, {}),
        ("ur5e", 0.0, {"dtype": torch.float32}),
        ("ur5e", 0.008, {"late": 1, "encoder_error": 0.002, "reserve": 0.01}),
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in [
                ("panda", 0.02, {"path": "layer", "batch": 16}),
                ("xarm7", 0.0, {"model_error": 0.02, "reserve": 0.025}),
            ]
        ),
        # `benchmarks/bench_limits.py` searches with each of these for a million steps.
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in [
                ("panda", 0.001, {"dtype": torch.float32, "steps": 200, "batch": 32}),
                ("so101", 0.02, {}),
                ("xarm7", 0.004, {"cap": 0.25}),
                ("panda", 0.008, {"late": 3}),
            ]
        ),
    ],
)
def test_a_search_over_commands_breaks_no_limit(name, dt, changes):
    options = {"batch": 64, "steps": 80, "rounds": 3} | changes
    found = search(Search(arm=name, dt=dt, **options))
    assert not any(found.beyond.values())
    assert found.reported == 0
    assert found.fastest > 0.6  # the cap was in the way


@pytest.mark.parametrize("name", ["panda", "ur5e", "so101"])
@pytest.mark.parametrize("dt", [0.002, 0.01])
def test_the_bound_holds_on_the_whole_way_to_rest(name, dt):
    """Against the speeds of a simulated arm that eases off as the barrier assumes."""
    robot, rng = arm(name), generator(3)
    limits = robot.limits
    barrier = SafetyFilter(robot).speed_barrier
    q = within(limits.lower, limits.upper, 200, rng=rng)
    v = within(-0.4 * limits.velocity, 0.4 * limits.velocity, 200, rng=rng)
    v[100:] *= 0.3  # as slow as with a cap
    bound = barrier.highest_speed(points_of(robot, q), v, torch.zeros_like(v), dt)
    largest, a = torch.zeros_like(bound), torch.zeros_like(v)
    for _ in range(math.ceil(0.6 / dt)):
        speeds = [points_of(robot, q), points_of(robot, q + dt * v)]
        speeds = torch.einsum("bpin,bn->bpi", torch.cat(speeds, dim=1), v).norm(dim=-1)
        largest = torch.maximum(largest, speeds.amax(-1, keepdim=True))
        q = q + dt * v
        wanted = -v / barrier.braking_time(v).clamp(min=dt)
        a = wanted.clamp(a - dt * limits.jerk, a + dt * limits.jerk)
        v = v + dt * a
    assert (largest <= bound).all()
    assert (bound / largest)[100:].median() < 1.4  # and is not far away


def test_a_cap_that_falls_too_fast_is_reported_until_it_is_kept():
    safety, dt = SafetyFilter(panda), 0.004
    u = torch.tensor([0.9, 0.4, 0, 0, 0, 0, 0], dtype=torch.float64)
    q, state = READY, safety.initial_state(READY, u)
    speeds, excesses, times = [], [], []
    for k in range(100):
        J = panda.jacobian(q)
        near = torch.tensor(0.45 if k >= 10 else 5.0, dtype=torch.float64)
        v, state, report = safety.step(state, q, u, dt, jacobian=J, human_distance=near)
        q = q + dt * v
        speeds.append(float((J[:3] @ v).norm()))
        excesses.append(float(report.speed_excess))
        times.append(float(report.speed_excess_time))
    cap = float(safety.config.separation.highest_speed(near))
    above = [speed > cap for speed in speeds[10:]]
    too_long = above.index(False)
    assert 2 < too_long < 60
    assert not any(above[too_long:])
    assert excesses[10 : 10 + too_long] == pytest.approx(
        [speed - cap for speed in speeds[10 : 10 + too_long]]
    )
    assert times[10 + too_long - 1] == pytest.approx(too_long * dt)
    assert not any(excesses[:10])
    assert not any(times[10 + too_long :])


def test_a_start_from_the_measured_motion_continues_it():
    """Also where the caller said that the arm rests: then the report says so."""
    safety, dt = SafetyFilter(panda), 0.002
    v0 = 0.9 * panda.limits.velocity
    told = safety.initial_state(READY, v0, torch.zeros_like(v0))
    wrong = safety.initial_state(READY)
    reach = panda.limits.acceleration * dt * (1 + 1e-9)

    def step(state: SafetyState, measured: torch.Tensor | None):
        return safety.step(state, READY, torch.zeros_like(v0), dt, joint_velocity=measured)

    expected, _, report = step(told, v0)
    assert not report.acted("start")
    assert ((expected - v0).abs() <= reach).all()
    v, state, report = step(wrong, v0)
    torch.testing.assert_close(v, expected)
    assert report.acted("start")
    # Only a start is corrected: later, encoders may err.
    v, after, report = step(state, torch.zeros_like(v0))
    assert ((v - state.velocity).abs() <= reach).all()
    assert after.count("start") == 1
    # Nor is a start by noise, or by a velocity that is not a number.
    for measured in (0.01 * v0, torch.full_like(v0, torch.nan)):
        v, _, report = step(wrong, measured)
        assert not v.any()
        assert not report.acted("start")


def test_more_points_than_the_tool_are_capped():
    safety = SafetyFilter(panda, SafetyConfig(tcp_speed=0.2))
    u = torch.tensor([0.0, 1.5, 0, -1.5, 0, 0, 0], dtype=torch.float64)
    elbow = panda.joint_jacobian(READY, panda.elbow)[:3]
    J = panda.jacobian(READY)
    end = torch.tensor([0.0, 0.3, 0.0], dtype=torch.float64)
    load = J[:3] + torch.linalg.cross(J[3:], end[:, None], dim=0)
    for given, point in (({"jacobian": 0 * J}, elbow), ({"jacobian": J, "load": end}, load)):
        state = safety.initial_state(READY)
        for _ in range(200):
            v, state, _ = safety.step(state, READY, u, 0.004, **given)
        assert 0.17 < (point @ v).norm() <= 0.2


@pytest.mark.parametrize("loaded", [True, False])
def test_the_arm_loop_caps_the_end_of_a_load(loaded):
    loop = ArmLoop(panda, ArmLoopConfig(safety=SafetyConfig(tcp_speed=0.2)))
    pose, J = panda.forward_and_jacobian(READY)
    end = torch.tensor([0.0, 0.0, 0.3], dtype=torch.float64)
    reading = ArmReading(
        joint_position=READY,
        pose=pose,
        jacobian=J,
        nullspace_input=torch.zeros_like(READY),
        pause=torch.tensor(False),
        load=end if loaded else None,
    )
    wanted = MoveJoints(joint_velocity=torch.tensor([0.0, 0, 0, 0, 0, 1.5, 0]).double())
    state = loop.initial_state(READY)
    for _ in range(100):
        v, state, _ = loop.step(state, reading, wanted)
    arm_of_load = (pose.apply(end) - pose.position)[:, None]
    speed = ((J[:3] + torch.linalg.cross(J[3:], arm_of_load, dim=0)) @ v).norm()
    assert (0.17 < speed <= 0.2) == loaded
