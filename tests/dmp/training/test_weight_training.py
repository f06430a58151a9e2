"""Trained weights: losses in task space, obstacles, limits, and when training ends."""

import pytest
import torch
from demo_motions import arm_motion, turning_motion

from hrc_learn.dmp import JointDMP, OrientationDMP, PoseDMP
from hrc_learn.dmp.training import (
    Bounds,
    Clearance,
    DescentConfig,
    Jerk,
    Sphere,
    Tracking,
    Via,
    train,
)
from hrc_learn.geometry import quaternion
from hrc_learn.kinematics import panda

SHORT = DescentConfig(steps=60, learning_rate=0.1)


def tool(q):
    return panda.forward(q).position


def reach(n_samples=30):
    """A minimum-jerk motion of the Panda's joints, and the straight line of its tool."""
    s = torch.linspace(0, 1, n_samples, dtype=torch.float64)
    m = (s**3 * (10 - 15 * s + 6 * s**2))[:, None]
    home = torch.tensor([0, -0.3, 0, -2.2, 0, 2.0, 0.8], dtype=torch.float64)
    way = torch.tensor([0.7, 0.3, -0.2, 0.2, 0.1, 0.2, 0.0], dtype=torch.float64)
    q = home + m * way
    start, goal = tool(q[0]), tool(q[-1])
    return 3 * s, q, start + m * (goal - start)


def flight(n_samples=60):
    """A straight motion in space that passes close by the origin."""
    s = torch.linspace(0, 1, n_samples, dtype=torch.float64)
    m = (s**3 * (10 - 15 * s + 6 * s**2))[:, None]
    start = torch.tensor([-0.4, 0.01, 0.005], dtype=torch.float64)
    return 2 * s, start - 2 * m * start


def test_the_tool_is_brought_to_a_line():
    time, q, line = reach()
    dmp = JointDMP.fit(time, q, 20)
    before = (tool(q) - line).norm(dim=-1).max()
    loss = Tracking(line, task=tool) + 1e-8 * Jerk()
    trained = train(dmp, loss, DescentConfig(steps=100, learning_rate=0.1)).dmp.rollout()
    after = (tool(trained.position) - line).norm(dim=-1).max()
    assert before > 0.02
    assert after < 5e-4
    untrained = dmp.rollout()
    for output in ("position", "velocity"):
        ends = getattr(trained, output)[[0, -1]], getattr(untrained, output)[[0, -1]]
        torch.testing.assert_close(*ends, rtol=0, atol=1e-9, msg=output)


def test_a_sphere_is_cleared_and_the_ends_stay():
    time, position = flight()
    dmp = JointDMP.fit(time, position, 20)
    ball = Sphere(centre=(0.0, 0.0, 0.0), radius=0.08)
    loss = Clearance([ball], margin=0.03) + 1e-2 * Tracking(position) + 1e-9 * Jerk()
    result = train(dmp, loss, DescentConfig(steps=80, learning_rate=0.1))
    moved = result.dmp.rollout(time=2 * torch.linspace(0, 1, 500, dtype=torch.float64))
    assert dmp.rollout().position.norm(dim=-1).min() < 0.02
    assert moved.position.norm(dim=-1).min() > 0.09
    torch.testing.assert_close(moved.position[0], position[0], rtol=0, atol=1e-9)
    assert (moved.position[-1] - dmp.rollout().position[-1]).norm() < 1e-9


def test_limits_are_kept():
    time, position = arm_motion(n_samples=60)
    dmp = JointDMP.fit(time, position, 20)
    middle = (position[0] + position[-1]) / 2
    width = 0.55 * (position[0] - position[-1]).abs() + 0.02
    limits = Bounds(middle - width, middle + width, margin=0.01)
    trained = train(dmp, limits + 1e-9 * Jerk(), SHORT).dmp.rollout().position
    assert ((position - middle).abs() > width).any()
    assert ((trained - middle).abs() < width).all()


def test_a_goal_is_learned_from_where_the_tool_shall_be():
    time, q, _ = reach()
    dmp = JointDMP.fit(time, q, 20)
    place = tool(q[-1]) + torch.tensor([0.03, -0.02, 0.02], dtype=torch.float64)
    config = DescentConfig(steps=150, learning_rate=0.03, patience=10)
    result = train(dmp, Via(place, task=tool), config, learn=["goal"])
    assert (tool(result.dmp.goal) - place).norm() < 1e-3
    assert torch.equal(result.dmp.weights, dmp.weights)


def test_a_via_point_between_two_samples():
    time, position = flight(31)
    dmp = JointDMP.fit(time, position, 15)
    target = torch.tensor([0.0, 0.1, 0.0], dtype=torch.float64)
    trained = train(dmp, Via(target, time=1.01), SHORT).dmp
    assert (trained.rollout(time=[1.01]).position[0] - target).norm() < 2e-3


@pytest.mark.parametrize("kind", ["orientation", "pose"])
def test_other_primitives_train_too(kind):
    time, orientation = turning_motion(n_samples=60)
    via = quaternion.multiply(quaternion.exp(torch.tensor([0.3, 0.0, 0.0])), orientation[30])
    if kind == "orientation":
        dmp = OrientationDMP.fit(time, orientation, 15)
    else:
        dmp = PoseDMP.fit(time, arm_motion(60, 3)[1], orientation, 15)

    def miss(motion):
        return quaternion.angle(motion.orientation[..., 30, :], via).square()

    result = train(dmp, miss, SHORT)
    assert miss(result.dmp.rollout()) < 1e-4 < miss(dmp.rollout())
    last = result.dmp.rollout().orientation[-1]
    assert quaternion.angle(last, dmp.rollout().orientation[-1]) < 1e-9


def test_a_batch_trains_each_of_its_motions():
    time, position = flight(40)
    dmp = JointDMP.fit(time, torch.stack([position, position * 1.3]), 10)
    targets = torch.tensor([[0.0, 0.1, 0.0], [0.1, 0.0, 0.0]], dtype=torch.float64)
    config = DescentConfig(steps=100, learning_rate=0.1)
    trained = train(dmp, Via(targets, time=1.0), config).dmp
    assert (trained.rollout(time=[1.0]).position[:, 0] - targets).norm(dim=-1).max() < 1e-2


def test_training_stops_when_there_is_no_progress():
    time, position = flight(40)
    dmp = JointDMP.fit(time, position, 10)
    config = DescentConfig(steps=1000, patience=5, halvings=2)
    history = train(dmp, Tracking(dmp.rollout().position), config).history
    assert history.converged
    assert len(history.loss) == 3 * 5 + 1
    assert history.best_step == 0


def test_what_is_held_out_decides():
    """A step in goals that are never tried is judged by them, and the best state is kept."""
    time, position = flight(40)
    dmp = JointDMP.fit(time, position, 10)

    def goals(rng):
        return {"goal": position[-1] + 0.1 * torch.randn(3, generator=rng, dtype=torch.float64)}

    held_out = [{"goal": position[-1] + 0.1}, {"goal": position[-1] - 0.1}]
    loss = Via([0.0, 0.1, 0.0], time=1.0)
    seen = []
    result = train(
        dmp,
        loss,
        SHORT,
        condition=goals,
        held_out=held_out,
        seed=3,
        progress=lambda step, best: seen.append((step, best)),
    )
    history = result.history
    mean = torch.stack([loss(result.dmp.rollout(**x)) for x in held_out]).mean()
    assert mean.item() == pytest.approx(history.best, rel=1e-9)
    assert history.best < 0.8 * history.criterion[0]
    assert seen[-1] == (len(history.loss) - 1, history.best)
    again = train(dmp, loss, SHORT, condition=goals, held_out=held_out, seed=3)
    assert again.history.loss == history.loss


def test_the_primitive_it_starts_from_stays():
    time, position = flight(40)
    dmp = JointDMP.fit(time, position, 10)
    before = dmp.weights.detach().clone()
    trained = train(dmp, Via([0.0, 0.1, 0.0], time=1.0), SHORT).dmp
    assert torch.equal(dmp.weights, before)
    assert dmp.weights.grad is None
    assert not torch.equal(trained.weights, before)


def test_a_rate_too_high_is_halved_and_the_best_state_kept():
    time, position = flight(40)
    dmp = JointDMP.fit(time, position, 10)
    wild = DescentConfig(steps=100, learning_rate=1e3, patience=3, halvings=20)
    history = train(dmp, Via([0.0, 0.1, 0.0], time=1.0), wild).history
    assert history.learning_rate[-1] < 1e3 / 2
    assert history.best == min(history.criterion)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"learn": ["centres"]}, "weights, goal, got centres"),
        ({"learn": []}, "got none"),
        ({"loss": Tracking(torch.zeros(3, 3))}, "one row is needed for each of its times"),
        ({"loss": Via([0.0, 0.0, 0.0], time=9.0)}, "9.0 s is outside the rollout"),
        ({"loss": lambda m: m.position.sum() * torch.nan}, "loss is nan before anything"),
        ({"dmp": torch.nn.Linear(2, 2)}, "Linear has no weights that could be trained"),
    ],
)
def test_mistakes_are_named(change, complaint):
    time, position = flight(40)
    arguments = {"dmp": JointDMP.fit(time, position, 10), "loss": Jerk()} | change
    with pytest.raises(ValueError, match=complaint):
        train(**arguments)


def test_bounds_of_nothing_are_refused():
    with pytest.raises(ValueError, match="no 'jerk' to bound"):
        Bounds([0.0], [1.0], of="jerk")


@pytest.mark.parametrize("bad", [{"steps": 0}, {"learning_rate": -1.0}, {"tolerance": 1.0}])
def test_impossible_settings_are_refused(bad):
    with pytest.raises(ValueError, match="needs"):
        DescentConfig(**bad)
