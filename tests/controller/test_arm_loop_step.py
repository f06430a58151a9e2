"""Single steps of the arm loop: the push, the pace near people, and commands that are sent."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from projections import null_space_projector
from torch.utils._pytree import tree_leaves

from hrc_learn.controller import (
    Command,
    ConstraintConfig,
    Distances,
    SafetyConfig,
    WayMakingConfig,
)
from hrc_learn.controller.arm_loop import ArmLoop
from hrc_learn.controller.arm_loop_state import (
    ArmLoopConfig,
    ArmReading,
    MoveJoints,
    PathState,
    TrackPose,
    WatchedPeople,
)
from hrc_learn.kinematics import panda

DOUBLE, DT = torch.float64, 0.01
Q = torch.tensor([0.4, 0.2, -0.3, -2.2, 0.1, 2.4, 0.6], dtype=DOUBLE)
U = torch.tensor([0.06, -0.05, 0.03, 0.04, -0.02, 0.05, -0.06], dtype=DOUBLE)
UNIT = torch.from_numpy(np.linalg.svd(panda.jacobian(Q).numpy())[2][6])


def people(scale=1.0, cap=torch.inf, distance=5.0):
    one = torch.ones((), dtype=DOUBLE)
    return WatchedPeople(
        distances=Distances(
            distance=distance * one[None],
            gradient=panda.jacobian(Q)[:1].clone(),
            approach_speed=0 * one[None],
            person=torch.ones(1, dtype=torch.bool),
        ),
        nearest=distance * one,
        age=0 * one,
        speed_scale=scale * one,
        speed_cap=cap * one,
    )


def reading(**values):
    pose, jacobian = panda.forward_and_jacobian(Q)
    plain = ArmReading(
        joint_position=Q,
        pose=pose,
        jacobian=jacobian,
        nullspace_input=torch.zeros_like(Q),
        pause=torch.tensor(False),
    )
    return replace(plain, **values)


def loop(**settings):
    return ArmLoop(panda, ArmLoopConfig(dt=DT, **settings))


def moving(law, velocity=U):
    """State of an arm that moves steadily, so that the filter changes nothing."""
    state = law.initial_state(Q)
    return replace(state, safety=law.safety.initial_state(Q, velocity.clone()))


def test_the_first_state_follows_no_path_and_reads_the_clock():
    state = loop(speed=0.7).initial_state(Q.expand(2, 7), 3.5, U.expand(2, 7))
    assert state.pace.time.tolist() == [3.5, 3.5]
    assert state.pace.speed_override.tolist() == [0.7, 0.7]
    torch.testing.assert_close(state.safety.velocity, U.expand(2, 7))
    path = PathState.none(Q.expand(2, 7), panda.forward(Q.expand(2, 7)))
    for found in (state.path, path):
        assert found.finished.all()
        assert (found.rate == 1).all()
        assert (found.nearest == torch.inf).all()
        for none in (found.progress, found.twist, found.waited, found.held, found.followed):
            assert not none.any()
    # The path of one sample ends with it.
    assert not replace(path, last=path.progress).finished.any()


@pytest.mark.parametrize(("scale", "cap"), [(0.6, 9.0), (1.0, 0.02), (0.1, 0.02)])
def test_people_slow_a_motion_down_by_the_stricter_of_scale_and_cap(scale, cap):
    law, h = loop(safety=SafetyConfig(constraints=ConstraintConfig())), 1e-6
    # All joints' origins and the tool, by differences.
    here, there = (panda.joint_origins(q) for q in (Q, Q + h * U))
    tool = (panda.forward(Q + h * U).position - panda.forward(Q).position).norm() / h
    fastest = max(float((there - here).norm(dim=-1).max() / h), float(tool))
    expected = min(scale, cap / fastest, 1.0)
    state = moving(law, expected * U)
    near = reading(people=people(scale, cap))
    sent, after, report = law.step(state, near, MoveJoints(joint_velocity=U))
    torch.testing.assert_close(sent, expected * U, rtol=1e-4, atol=1e-9)
    # The task loses the time: its scale falls at once, and rises within 0.2 s.
    assert float(after.pace.people_scale) == pytest.approx(expected, rel=1e-4)
    assert float(after.pace.time) == pytest.approx(expected * DT, rel=1e-4)
    later = law.step(
        replace(after, safety=moving(law).safety), reading(), MoveJoints(joint_velocity=U)
    )[1]
    rises = min(expected + DT / 0.2, 1.0)
    assert float(later.pace.people_scale) == pytest.approx(rises, rel=1e-4)
    assert report.slowed_by_people is None


def test_a_stop_takes_the_time_that_the_arm_loses():
    law = loop()
    sent, after, report = law.step(
        moving(law, 0.4 * U), reading(stop=torch.tensor(True)), MoveJoints(joint_velocity=U)
    )
    assert report.safety.acted("stopped")
    along = float(sent @ U / (U @ U))
    assert 0 < along < 0.4
    assert float(after.pace.people_scale) == pytest.approx(along)
    # Limits of the arm alone take none.
    rest = law.step(law.initial_state(Q), reading(), MoveJoints(joint_velocity=U))[1]
    assert float(rest.pace.people_scale) == 1.0


@pytest.mark.parametrize(("distance", "slowed"), [(5.0, False), (0.202, True)])
def test_distances_from_people_slow_the_task_down_where_the_arm_approaches(distance, slowed):
    law = loop(safety=SafetyConfig(constraints=ConstraintConfig()))
    towards = -panda.jacobian(Q)[0]
    u = 0.05 * towards / towards.norm()
    state = moving(law, u)
    for k in range(3):
        now = reading(people=people(distance=distance), explain=k == 2)
        _, state, report = law.step(state, now, MoveJoints(joint_velocity=u))
    assert bool(report.slowed_by_people) == slowed
    assert (float(state.pace.people_scale) < 0.99) == slowed
    # Away from them it goes on.
    away = moving(law, -u)
    _, away, _ = law.step(
        away, reading(people=people(distance=distance)), MoveJoints(joint_velocity=-u)
    )
    assert float(away.pace.people_scale) == 1.0
    # Unknown distances count as people.
    unknown = reading(people=people(distance=torch.nan))
    _, lost, _ = law.step(moving(law, u), unknown, MoveJoints(joint_velocity=u))
    assert float(lost.pace.people_scale) < 1


def test_a_push_is_the_null_space_velocity_by_the_damping():
    """A steady push comes to c_d^-1 N times it, scaled as people slow the arm down."""
    law, push = loop(), 0.3 * UNIT + 0.4 * torch.eye(7, dtype=DOUBLE)[2]
    N = null_space_projector(panda.jacobian(Q))
    for scale in (1.0, 0.5):
        steady = scale / 3.0 * (N @ push)
        state = replace(law.initial_state(Q), null_velocity=steady)
        now = reading(nullspace_input=push, people=people(scale))
        state, limitations = law.observe(state, now)
        assert limitations == ()
        torch.testing.assert_close(state.null_velocity, steady)
        assert state.pushed
    assert not law.initial_state(Q).pushed


def test_a_push_along_one_joint_counts_and_its_end_ends_it():
    """However small it is, it counts while it goes on; a slow motion ends with it at once."""
    law = loop()
    one = 0.03 * torch.eye(7, dtype=DOUBLE)[2]
    state = replace(law.initial_state(Q), null_velocity=0.012 * UNIT)
    state, _ = law.observe(state, reading(nullspace_input=one))
    assert state.pushed
    state, _ = law.observe(state, reading())
    assert not state.pushed
    # A larger one ends at the deceleration of the arm, of which it uses 0.6.
    fast = replace(state, null_velocity=0.3 * UNIT)
    after, limitations = law.observe(fast, reading(explain=True))
    change = (after.null_velocity - fast.null_velocity).abs()
    assert float((change / (DT * panda.limits.acceleration)).max()) == pytest.approx(0.6)
    names = [limitation.cause for limitation in limitations]
    assert names == ["task", "speed", "singularity", "joint_limit"]
    assert [float(limitation.kept) for limitation in limitations] == [1.0] * 4


def test_each_limitation_of_a_push_is_a_fraction_of_what_was_left():
    law, push = loop(), 9.0 * UNIT + 200 * panda.jacobian(Q)[0]
    _, (task, speed, singular, limit) = law.observe(
        law.initial_state(Q), reading(nullspace_input=push, explain=True)
    )
    inside = float((push @ UNIT).abs() / push.norm())
    assert inside < 0.1
    assert float(task.kept) == pytest.approx(inside)
    assert 0 < float(speed.kept) < 1
    assert float(singular.kept) == float(limit.kept) == 1.0
    bounds = law.path_law.task_margin.velocity_bounds(Q)
    wanted = (push @ UNIT) * UNIT
    ratio = torch.where(wanted > 0, bounds[1], bounds[0]) / wanted
    assert int(limit.joint) == int(ratio.argmin())


def test_a_pose_is_tracked_and_the_push_with_it():
    law = loop()
    twist = torch.tensor([0.02, 0.0, -0.01, 0.0, 0.03, 0.0], dtype=DOUBLE)
    J = panda.jacobian(Q + law.config.command_delay * U)
    state = moving(law)
    state = replace(state, null_velocity=0.05 * UNIT)
    task = torch.linalg.pinv(J) @ twist
    rest = null_space_projector(J) @ (0.05 * UNIT)
    pose = panda.forward(Q)
    _, after, report = law.act(state, reading(), TrackPose(pose=pose, twist=twist))
    wanted = law._track(state, reading(), TrackPose(pose=pose, twist=twist)).joint_velocity
    torch.testing.assert_close(wanted, task + rest, rtol=0, atol=1e-9)
    assert report.goal is pose
    assert report.limitations == ()
    assert not after.path.followed


@pytest.mark.parametrize(("off", "counts", "waited"), [(1.5, True, 2.0), (1.5, False, 1.0)])
def test_at_the_end_of_the_patience_coming_nearer_still_counts(off, counts, waited):
    still = PathState.none(Q, panda.forward(Q))
    one = torch.ones((), dtype=DOUBLE)
    path = replace(still, waited=waited * one, nearest=2.0 * one, rate=0 * one)
    after, nearest = path.waiting(off * one, torch.tensor(counts), 2.0, DT)
    assert float(after) == (0.0 if counts else waited)
    assert float(nearest) == off
    # Time on the way is subtracted, down to none.
    rested = replace(path, waited=0.004 * one, nearest=off * one, rate=one)
    assert float(rested.waiting(off * one, torch.tensor(True), 2.0, DT)[0]) == 0.0


@pytest.mark.parametrize(
    ("cap", "wanted", "elbow"),
    [(0.25, 0.25, 0.15), (0.25, 0.1, 0.1), (torch.inf, 0.25, 0.25), (torch.inf, 0.4, 0.25)],
)
def test_a_guided_elbow_keeps_a_margin_below_the_cap_on_the_arm(cap, wanted, elbow):
    law = loop(elbow_speed=wanted, safety=SafetyConfig(tcp_speed=cap))
    assert law.config.elbow_speed == pytest.approx(elbow)
    assert (law.initial_state(Q).pace.time == 0).all()


def test_each_arm_of_a_batch_has_its_own_push():
    law = loop()
    state = law.initial_state(Q.expand(3, 7))
    moving = torch.stack([0 * UNIT, 0 * UNIT, 0.1 * UNIT])
    state = replace(state, null_velocity=moving)
    pose, jacobian = panda.forward_and_jacobian(Q.expand(3, 7))
    now = ArmReading(
        joint_position=Q.expand(3, 7),
        pose=pose,
        jacobian=jacobian,
        nullspace_input=torch.stack([0 * UNIT, 3 * UNIT, 0 * UNIT]),
        pause=torch.zeros(3, dtype=torch.bool),
        explain=True,
    )
    after, limitations = law.observe(state, now)
    along = after.null_velocity @ UNIT
    assert along[0] == 0
    # 0.067 of the way to 1 rad/s, or 0.3 of the acceleration; the end is as hard as it can be.
    reach = DT * float((panda.limits.acceleration / UNIT.abs()).min())
    assert float(along[1]) == pytest.approx(min(DT / 0.15, 0.3 * reach))
    assert float(along[2]) == pytest.approx(0.1 - min(0.1, 0.6 * reach), abs=1e-9)
    assert len(limitations) == 4
    # Nothing is explained where nothing is pushed.
    still = replace(state, null_velocity=0 * moving)
    none = replace(now, nullspace_input=0 * moving)
    assert law.observe(still, none)[1] == ()


@pytest.mark.parametrize(
    ("mode", "followed", "rate", "pushed", "moves"),
    [
        ("both", True, 1.0, False, True),
        ("both", True, 0.9, False, False),
        ("both", True, -0.5, False, False),
        ("both", False, 0.0, False, True),
        ("both", True, 0.0, True, True),
        ("automatic", True, 0.0, True, False),
        ("automatic", True, 1.0, False, True),
        ("expert", True, 1.0, False, False),
        ("expert", True, 0.0, True, True),
        ("none", True, 1.0, True, False),
    ],
)
def test_way_making_does_not_keep_a_path_waiting(mode, followed, rate, pushed, moves):
    """A person may hold the arm aside while its path waits; the repulsion may not."""
    law = loop(way_making=WayMakingConfig(mode=mode))
    state = law.initial_state(Q)
    state = replace(
        state,
        path=replace(
            state.path,
            followed=torch.tensor(followed),
            rate=torch.tensor(rate, dtype=DOUBLE),
        ),
    )
    near = people(distance=0.1)
    near = replace(
        near,
        distances=replace(near.distances, gradient=UNIT.expand_as(near.distances.gradient)),
    )
    push = UNIT if pushed else 0 * UNIT
    after, _ = law.observe(state, reading(people=near, nullspace_input=push))
    assert bool(after.pushed) == moves


def test_a_push_while_a_pose_is_tracked_is_not_slowed_twice():
    law = loop(elbow_speed=0.005)
    state = replace(law.initial_state(Q), null_velocity=0.3 * UNIT)
    still = TrackPose(pose=panda.forward(Q), twist=torch.zeros(6, dtype=DOUBLE))
    _, _, report = law.act(state, reading(explain=True), still)
    kept = {limitation.cause: float(limitation.kept) for limitation in report.limitations}
    assert kept == {"speed": 1.0, "obstacle": 1.0, "joint_limit": 1.0}


def test_only_people_ahead_take_time_from_the_task():
    law = loop(safety=SafetyConfig(constraints=ConstraintConfig()))
    # Joint limits hold the task up, and people are far away.
    q = panda.limits.upper - 0.021
    pose, jacobian = panda.forward_and_jacobian(q)
    far = reading(joint_position=q, pose=pose, jacobian=jacobian, people=people())
    outward = MoveJoints(joint_velocity=0.1 * torch.ones_like(Q))
    _, after, report = law.step(law.initial_state(q), far, outward)
    assert float(report.safety.constraints.slowed) > 0.01
    assert float(after.pace.people_scale) == 1.0
    # A person at the protective distance is passed by an arm that gathers speed.
    towards = panda.jacobian(Q)[0]
    passing = 20 * (U - (U @ towards) / (towards @ towards) * towards)
    _, after, report = law.step(
        law.initial_state(Q),
        reading(people=people(distance=0.05)),
        MoveJoints(joint_velocity=passing),
    )
    assert float(report.safety.constraints.slowed) < 1e-3
    assert report.safety.acted("acceleration")
    assert float(after.pace.people_scale) == 1.0


def test_a_command_of_the_controller_keeps_the_counts_of_interventions():
    law, six, two = loop(), Q.new_zeros(6), Q.new_zeros(2)
    wanted = MoveJoints(joint_velocity=torch.full_like(Q, 99.0))
    _, state, report = law.step(law.initial_state(Q), reading(), wanted)
    assert state.safety.count("velocity") == 1
    sent = Command(
        joint_velocity=state.safety.velocity,
        twist=six,
        null_velocity=0 * Q,
        xi_x=two,
        xi_r=six,
        xi_q=0 * Q,
        s=six,
        image_jacobian=Q.new_zeros(2, 6),
        weight_norm=Q.new_zeros(()),
        vision_level=Q.new_zeros(()),
        potential=Q.new_zeros(()),
        potential_rate=Q.new_zeros(()),
        safety=report.safety,
    )
    velocity, after, _ = law.step(state, reading(), sent)
    torch.testing.assert_close(velocity, sent.joint_velocity)
    torch.testing.assert_close(after.safety.velocity, velocity)
    assert torch.equal(after.safety.counts, state.safety.counts)


@pytest.mark.parametrize("name", ["joint_position", "nullspace_input"])
def test_a_reading_that_is_not_finite_stops_the_arm_for_one_step(name):
    law, wanted, push = loop(), MoveJoints(joint_velocity=U), reading(nullspace_input=6 * UNIT)
    _, state, _ = law.step(moving(law), push, wanted)
    assert state.pushed
    broken = replace(push, **{name: torch.full_like(Q, torch.nan)})
    velocity, after, _ = law.step(state, broken, wanted)
    # As if the arm had to stop unpushed, or where its commands have led it.
    expected = reading(stop=torch.tensor(True))
    if name == "joint_position":
        q = state.safety.position
        pose, J = panda.forward_and_jacobian(q)
        expected = replace(push, stop=expected.stop, joint_position=q, pose=pose, jacobian=J)
    stopped, then, _ = law.step(state, expected, wanted)
    torch.testing.assert_close(velocity, stopped, rtol=0, atol=0)
    for ours, theirs in zip(tree_leaves(after), tree_leaves(then), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=0)
    assert law.step(after, push, wanted)[1].pushed
