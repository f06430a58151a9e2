"""The loop of the arm: one law for a single arm and for a batch."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.utils import _pytree
from unchecked import shapes_unchecked

from hrc_learn.controller import ConstraintConfig, Distances, SafetyConfig
from hrc_learn.controller.arm_loop import ArmLoop
from hrc_learn.controller.arm_loop_state import (
    ArmLoopConfig,
    ArmReading,
    FollowPath,
    MoveJoints,
    TrackPose,
    WatchedPeople,
)
from hrc_learn.controller.joint_path import JointPaths
from hrc_learn.kinematics import panda

ARMS, STEPS, DT = 4, 120, 0.01
GENTLE = torch.tensor([4.0, 0.0, -4.0, 0.0, 3.0, 0.0, 0.0], dtype=torch.float64)


def clearance(q):
    """A wall beside the elbow."""
    return panda.joint_origins(q)[..., 3, 1] + 0.12


def loop(**options):
    constraints = ConstraintConfig(distance_weight=0.1)
    config = ArmLoopConfig(safety=SafetyConfig(constraints=constraints), **options)
    return ArmLoop(panda, config, clearance)


def paths():
    far = torch.tensor([-0.9, 0.3, 0.1, 0.3, -0.1, 0.3, -0.3], dtype=torch.float64)
    s = torch.linspace(0, 1, 200, dtype=torch.float64)[:, None]
    lines = [panda.ready + s * far, panda.ready - 0.5 * s[:150] * far]
    return JointPaths.of(panda, [line.numpy() for line in lines], DT)


def reading(k, q):
    """Pushes, people, pauses and stops, different for each arm."""
    pose, jacobian = panda.forward_and_jacobian(q)
    pushed = torch.tensor([k > 5, k < 60, 30 < k < 70, False])
    near = torch.tensor([2.0, 2.0, 2.0, 1.0 - 0.01 * k], dtype=torch.float64)
    return ArmReading(
        joint_position=q,
        pose=pose,
        jacobian=jacobian,
        nullspace_input=pushed[:, None] * torch.tensor([[1.0], [-2], [0.5], [0]]) * GENTLE,
        pause=torch.tensor([False, False, 20 < k < 50, False]),
        people=WatchedPeople(
            distances=Distances(
                distance=near[:, None],
                gradient=jacobian[:, :1, :].contiguous(),
                approach_speed=torch.zeros(ARMS, 1, dtype=torch.float64),
                person=torch.ones(ARMS, 1, dtype=torch.bool),
            ),
            nearest=near,
            age=torch.zeros_like(near),
            speed_scale=near.clamp(max=1.0),
            speed_cap=torch.full_like(near, torch.inf),
        ),
        stop=torch.tensor([False, False, False, k > 110]),
        explain=True,
    )


def request(k, table, q, which):
    if k < 80:
        return FollowPath(paths=table, path=which)
    if k < 100:
        return TrackPose(pose=panda.forward(q), twist=torch.zeros(*q.shape[:-1], 6).double())
    return MoveJoints(joint_velocity=0.1 * torch.ones_like(q))


def element(tree, k):
    return _pytree.tree_map(lambda x: x[k], tree)


@shapes_unchecked()
def test_a_batch_does_what_each_arm_does_alone():
    law, table = loop(), paths()
    which = torch.tensor([0, 1, 0, 1])
    q = table.position[which, 0] + 0.02 * torch.arange(ARMS).double()[:, None]
    follow = FollowPath(paths=table, path=which)
    state = law.path_law.begin(law.initial_state(q), q, follow)
    alone = [element(state, k) for k in range(ARMS)]
    aside, waited = False, False
    with torch.inference_mode():
        for k in range(STEPS):
            now = reading(k, q)
            before = state
            velocity, state, report = law.step(state, now, request(k, table, q, which))
            # Each step starts from the state of the batch, so a sixth of them is enough.
            for arm in range(ARMS if k % 6 == 0 else 0):
                single = _pytree.tree_map(lambda x, arm=arm: x[arm], now)
                own, alone[arm], told = law.step(
                    element(before, arm), single, request(k, table, q[arm], which[arm])
                )
                # Accelerations are differences of rounded velocities, divided by the step.
                torch.testing.assert_close(velocity[arm], own, rtol=0, atol=1e-10)
                assert kept(report, arm) == pytest.approx(kept(told), abs=1e-9)
            together = _stack(alone) if k % 6 == 0 else state
            for both, one in zip(
                _pytree.tree_leaves(state), _pytree.tree_leaves(together), strict=True
            ):
                # Accelerations are differences of velocities, divided by the step.
                torch.testing.assert_close(both, one, rtol=0, atol=1e-9)
            # The time for which a push holds a path up does not run while the path goes on.
            assert not state.path.held[~state.pushed].any()
            goes_on = before.path.rate > 0.5
            assert (state.path.held <= before.path.held + 1e-12)[goes_on].all()
            aside = aside or bool(state.aside.any())
            waited = waited or bool((state.path.rate < 1).any())
            q = q + DT * velocity
    assert aside
    assert waited


def kept(report, arm=...):
    """Fraction of the push that all causes leave together."""
    return np.prod([float(limitation.kept[arm]) for limitation in report.limitations])


def _stack(states):
    return _pytree.tree_map(lambda *x: torch.stack(x), *states)


@pytest.mark.parametrize("blocked", [False, True])
@shapes_unchecked()
def test_joints_that_find_no_way_back_return_directly(blocked):
    away = panda.ready + torch.tensor([0.0, 0.3, 0, 0.3, 0, 0, 0], dtype=torch.float64)

    def obstacle(q):
        # Clear at both ends of the way.
        near = (q[..., None, :] - torch.stack([panda.ready, away])).norm(dim=-1).amin(-1)
        return torch.where(near < 0.05, 0.5, -0.5 if blocked else 0.5)

    law = ArmLoop(panda, clearance=obstacle)
    table = JointPaths.of(panda, [np.repeat(panda.ready.numpy()[None], 3000, axis=0)], DT)
    follow, q = FollowPath(paths=table, path=torch.tensor(0)), away
    state = law.path_law.begin(law.initial_state(q), q, follow)
    state = replace(state, path=replace(state.path, waited=torch.tensor(21.0).double()))
    fastest = 0.0
    with torch.inference_mode():
        for _ in range(300):
            pose, jacobian = panda.forward_and_jacobian(q)
            now = ArmReading(
                joint_position=q,
                pose=pose,
                jacobian=jacobian,
                nullspace_input=torch.zeros(7, dtype=torch.float64),
                pause=torch.tensor(False),
            )
            velocity, state, _ = law.step(state, now, follow)
            if blocked:
                break
            q, fastest = q + DT * velocity, max(fastest, float(velocity.abs().max()))
    direct = state.path.direct_return
    assert bool(direct.blocked) == blocked
    if not blocked:
        assert not direct.active
        torch.testing.assert_close(q, panda.ready, rtol=0, atol=0.01)
        assert fastest < 1.3 * law.config.return_speed


def test_the_speed_must_be_a_fraction():
    with pytest.raises(ValueError, match="speed must be"):
        ArmLoopConfig(speed=1.5)


def test_what_follows_a_push_is_named():
    with pytest.raises(ValueError, match="must be return or stay, but is 'go'"):
        ArmLoopConfig(after_push="go")  # pyright: ignore[reportArgumentType]


DIVISORS = ["dt", "damping", "nullspace_rise", "pose_gain", "elbow_speed", "return_speed"]
TIMES = ["longest_wait", "back_after", "direct_return_after"]


@pytest.mark.parametrize("name", DIVISORS + TIMES)
def test_a_setting_that_is_a_divisor_or_a_time_is_above_zero(name):
    with pytest.raises(ValueError, match=f"{name} must be positive, but is 0"):
        ArmLoopConfig(**{name: 0.0})


@pytest.mark.parametrize("name", ["command_delay", "limit_margin", "clearance"])
def test_delays_and_margins_are_not_negative(name):
    ArmLoopConfig(**{name: 0.0})
    with pytest.raises(ValueError, match=f"{name} must not be negative"):
        ArmLoopConfig(**{name: -0.01})
