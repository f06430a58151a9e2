"""Straight lines of the end effector and of the joints, paths along poses, and their checks."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from unchecked import shapes_unchecked

from hrc_learn.dmp import JointDMP, PoseDMP
from hrc_learn.geometry import Pose, minimum_jerk, quaternion
from hrc_learn.kinematics import arm_angle, panda
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.arm_motion import StraightLine, joint_line
from hrc_learn.skills.placing import (
    PlacingSkill,
    Plan,
    check_plan,
    follow_pose,
    plan_candidates,
)
from hrc_learn.skills.work_cell import BlockedPathError


def random_configurations(n, seed):
    rng = torch.Generator().manual_seed(seed)
    lower, upper = panda.limits.lower, panda.limits.upper
    return lower + (upper - lower) * torch.rand(n, 7, generator=rng, dtype=torch.float64)


def test_minimum_jerk_starts_and_ends_at_rest():
    assert minimum_jerk(-1.0) == (0.0, 0.0)
    assert minimum_jerk(2.0) == (1.0, 0.0)
    x, h = 0.37, 1e-6
    slope = (minimum_jerk(x + h)[0] - minimum_jerk(x - h)[0]) / (2 * h)
    assert minimum_jerk(x)[1] == pytest.approx(slope, abs=1e-8)


def test_a_straight_line_ends_at_its_goal_and_its_twists_integrate_to_it():
    start = panda.forward(panda.ready)
    turn = quaternion.exp(torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64))
    goal = Pose(
        start.position + torch.tensor([0.1, -0.2, 0.05], dtype=torch.float64),
        quaternion.multiply(turn, start.orientation),
    )
    dt = 0.005
    line = StraightLine(start, goal, speed=0.2)
    steps = round(line.duration / dt)
    assert 0.2 * line.duration == pytest.approx(float((goal.position - start.position).norm()))
    samples = [line.at(k * dt) for k in range(1, steps + 1)]
    last, twist = samples[-1]
    torch.testing.assert_close(last.position, goal.position, atol=1e-4, rtol=0)
    assert float(quaternion.angle(last.orientation, goal.orientation)) < 1e-3
    assert float(twist.norm()) < 1e-2
    travelled = dt * torch.stack([twist[:3] for _, twist in samples]).sum(dim=0)
    torch.testing.assert_close(travelled, goal.position - start.position, atol=1e-4, rtol=0)
    for pose, _ in samples:
        offset = pose.position - start.position
        along = goal.position - start.position
        assert float(torch.linalg.cross(offset, along).norm()) < 1e-12


def test_a_line_in_joint_space_keeps_its_speed():
    start, goal = random_configurations(2, seed=1)
    path = joint_line(start, goal, speed=0.5, dt=0.01)
    torch.testing.assert_close(path[0], start)
    torch.testing.assert_close(path[-1], goal)
    speed = path.diff(dim=0).abs().max() / 0.01
    assert 0.45 < float(speed) < 0.51
    # It ends within the last samples, and does not linger.
    duration = 1.875 * float((goal - start).abs().max()) / 0.5
    assert duration <= 0.01 * (len(path) - 1) <= duration + 0.0151
    same = joint_line(start, start, speed=0.5, dt=0.01)
    torch.testing.assert_close(same, start.expand_as(same))


DT, STEPS = 0.01, 21


def follow(start, pose, angle=None):
    """Path that follows a pose at rest."""
    poses = Pose(pose.position.expand(STEPS, 3), pose.orientation.expand(STEPS, 4))
    twist = torch.zeros(STEPS, 6, dtype=torch.float64)
    return follow_pose(panda.chain, start, poses, twist, angle, DT)


def test_errors_of_a_followed_pose_decay_at_ten_per_second():
    here = panda.forward(panda.ready)
    turn = quaternion.exp(torch.tensor([0.05, -0.03, 0.04], dtype=torch.float64))
    aside = torch.tensor([0.01, -0.02, 0.015], dtype=torch.float64)
    goal = Pose(here.position + aside, quaternion.multiply(turn, here.orientation))
    path = follow(panda.ready, goal)
    errors = torch.stack([panda.forward(q).twist_to(goal) for q in path])
    expected = (1 - 10 * DT) ** torch.arange(STEPS)[:, None] * errors[0]
    # The arm bends its motion of each step a little.
    torch.testing.assert_close(errors, expected, rtol=0.01, atol=2e-5)


@pytest.mark.parametrize("offset", [0.1 - 2 * np.pi, 2 * np.pi - 0.1])
def test_the_arm_angle_takes_the_shorter_way_at_four_per_second(offset):
    start = float(arm_angle(panda.chain, panda.ready))
    pose = panda.forward(panda.ready)
    path = follow(panda.ready, pose, torch.full((STEPS,), start + offset).double())
    angle = torch.stack([arm_angle(panda.chain, q) for q in path]) - start
    shorter = (offset + np.pi) % (2 * np.pi) - np.pi
    expected = shorter * (1 - (1 - 4 * DT) ** torch.arange(STEPS, dtype=torch.float64))
    torch.testing.assert_close(angle, expected, rtol=0.03, atol=1e-9)
    assert float(panda.forward(path[-1]).twist_to(pose).norm()) < 1e-4
    # An angle that moves is followed without a lag of a quarter of a second.
    moving = start + 0.5 * DT * torch.arange(STEPS, dtype=torch.float64)
    last = arm_angle(panda.chain, follow(panda.ready, pose, moving)[-1])
    assert float(last) == pytest.approx(float(moving[-1]), abs=2e-3)


def test_without_an_angle_the_null_space_leaves_a_joint_limit():
    start, upper = panda.ready.clone(), float(panda.limits.upper[6])
    start[6] = upper - 0.05
    path = follow(start, pose := panda.forward(start))
    assert bool((path[1:, 6] < path[:-1, 6]).all())
    assert float(panda.forward(path[-1]).twist_to(pose).norm()) < 1e-4


class Touching:
    """Scene in which the arm touches the shelf from a sample on."""

    def __init__(self, first=None):
        self.first, self.samples = first, np.zeros(0)

    def collisions_along(self, samples, carried):
        self.samples, self.carried = samples, carried
        touch = SimpleNamespace(start=self.first, first="hand", second="shelf", depth=0.0123)
        return [] if self.first is None else [touch]


def planned(path, dt=0.01):
    return Plan(goal=panda.forward(panda.ready), dt=dt, path=path, chain=panda.chain)


@shapes_unchecked()
@pytest.mark.parametrize(("dt", "every"), [(0.01, 4), (0.04, 1), (0.1, 1)])
def test_a_plan_is_checked_every_forty_milliseconds_and_at_its_end(dt, every):
    path = panda.ready.numpy() + 1e-4 * np.arange(11)[:, None]
    free = Touching()
    check_plan(planned(path, dt), free, "box")
    assert free.carried == "box"
    np.testing.assert_array_equal(free.samples, path[[*range(0, 10, every), 10]])
    with pytest.raises(
        BlockedPathError,
        match=f"after {2 * every * dt:.1f} s hand would hit shelf, 12 mm deep",
    ):
        check_plan(planned(path, dt), Touching(2))


@shapes_unchecked()
@pytest.mark.parametrize("side", ["lower", "upper"])
def test_a_plan_may_reach_limits_of_joints_and_speed_but_not_pass_them(side):
    limit = getattr(panda.limits, side)[3].item()
    inward = 1.0 if side == "lower" else -1.0
    path = np.tile(panda.ready.numpy(), (30, 1))
    path[:, 3] = limit + inward * 0.02 * np.arange(30)[::-1]
    check_plan(planned(path), Touching())
    path[-1, 3] = limit - inward * 1e-6
    with pytest.raises(BlockedPathError, match=r"range of panda_joint4 after 0\.3 s, at"):
        check_plan(planned(path), Touching())
    fastest = panda.limits.velocity[3].item()
    path[:, 3] = panda.ready[3].item()
    for fraction in (0.999, 1.001):
        path[20:, 3] = path[0, 3] + inward * fraction * fastest * 0.01
        if fraction < 1:
            check_plan(planned(path), Touching())
    with pytest.raises(BlockedPathError, match=r"joint4 after 0\.2 s, above its limit"):
        check_plan(planned(path), Touching())


@shapes_unchecked()
def test_other_plans_are_higher_or_go_round_near_home():
    place = Workplace()
    home, goal = place.home_joints(), place.shelf("middle")

    def straight(start, goal, *, space, dt, speed):
        assert (space, dt, speed) == ("pose", 0.05, 1.5)
        return Plan(goal=goal, dt=dt, path=np.stack([start, 0 * start]), chain=panda.chain)

    skill = SimpleNamespace(plan=straight)
    learned, raised, *others = plan_candidates(goal, home, skill, place, dt=0.05, speed=1.5)
    np.testing.assert_array_equal(learned.path[0], home)
    assert learned.goal == goal
    np.testing.assert_allclose(raised.goal.position - goal.position, (0, 0, 0.008), atol=1e-12)
    np.testing.assert_array_equal(raised.path[0], home)
    aside = []
    for plan in others:
        assert plan.goal == goal
        np.testing.assert_allclose(plan.path[0], home)
        first = plan.path[:-1]
        assert np.abs(np.diff(first, axis=0)).max() < 0.6 * 0.05 + 1e-9
        there = panda.forward(torch.from_numpy(first[-1])).position
        aside.append((there - place.home().position).numpy())
    offsets = [(0, 0, 0.12), (-0.14, 0, 0.06), (0.08, 0, 0.1), (0, 0, 0), (0, 0, 0)]
    np.testing.assert_allclose(aside, offsets, atol=1e-3)
    # The last two turn the elbow both ways.
    inward, outward = (plan.path[-2, 6] - home.numpy()[6] for plan in others[-2:])
    assert inward == pytest.approx(-0.35)
    assert outward == pytest.approx(0.35)


@pytest.fixture(scope="module")
@shapes_unchecked()
def shown():
    """A motion of two seconds, from rest to rest, and the skill learned from it."""
    time = torch.linspace(0.0, 2.0, 101, dtype=torch.float64)
    turned = torch.tensor([-0.5, 0.1, 0.2, -0.2, 0.1, 0.3, -0.2], dtype=torch.float64)
    progress = torch.tensor([minimum_jerk(t / 2)[0] for t in time.tolist()]).double()
    q = panda.ready + progress[:, None] * turned
    pose, angle = panda.forward(q), arm_angle(panda.chain, q)
    return q, PlacingSkill(
        joint=JointDMP.fit(time, q, 40, joint_names=panda.joint_names),
        pose=PoseDMP.fit(time, pose.position, pose.orientation, 40, body=angle),
        robot=panda,
    )


@shapes_unchecked()
@pytest.mark.parametrize("space", ["joint", "pose"])
@pytest.mark.parametrize("speed", [1.0, 1.6])
def test_a_plan_repeats_what_was_shown_at_its_speed(shown, space, speed):
    q, skill = shown
    goal = panda.forward(q[-1])
    plan = skill.plan(q[0], goal, space=space, dt=0.05, speed=speed)
    assert plan.duration == pytest.approx(2.0 / speed)
    assert plan.goal is goal
    every = np.linspace(0, 100, len(plan.path))
    expected = np.stack([np.interp(every, np.arange(101), row) for row in q.numpy().T], axis=-1)
    # In pose space, steps of 50 ms follow with a lag of one.
    np.testing.assert_allclose(plan.path, expected, atol=2e-3 if space == "joint" else 0.06)
    error = plan.tool_pose[-1].twist_to(goal)
    assert float(error.norm()) < 2e-3


@shapes_unchecked()
def test_a_plan_in_pose_space_keeps_the_shown_arm_angle_from_another_start(shown):
    q, skill = shown
    start = follow(q[0], panda.forward(q[0]), torch.full((STEPS,), 0.2).double())[-1]
    plan = skill.plan(start, panda.forward(q[-1]), space="pose", dt=0.05)
    np.testing.assert_array_equal(plan.path[0], start)
    angles = arm_angle(panda.chain, torch.from_numpy(plan.path[[0, -1]]))
    shown_last = float(arm_angle(panda.chain, q[-1]))
    assert float(angles[0]) > 0.05
    assert float(angles[1]) == pytest.approx(shown_last, abs=0.02)
