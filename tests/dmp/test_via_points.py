import re

import numpy as np
import pytest
import torch
from demo_motions import arm_motion, minimum_jerk, turning_motion
from torch.autograd import gradcheck
from unchecked import shapes_unchecked

from hrc_learn.dmp import (
    JointDMP,
    OrientationDMP,
    PoseDMP,
    ProbabilisticDMP,
    fit_rhythmic,
)
from hrc_learn.geometry import Pose, quaternion

NAN = torch.nan
DENSE = torch.linspace(0, 3, 601, dtype=torch.float64)


def orientation(*vector):
    return quaternion.exp(torch.tensor(vector, dtype=torch.float64))


def pose_demonstration():
    time, columns = arm_motion(n_joints=5, moving_start=True)
    return time, columns[:, :3], turning_motion()[1], columns[:, 3:]


def fitted_pose(**options):
    time, position, turning, body = pose_demonstration()
    return PoseDMP.fit(time, position, turning, body=body, **options)


def test_via_points_are_passed_exactly_with_the_velocity_kept():
    dmp = JointDMP.fit(*arm_motion(n_joints=3))
    times = [0.4, 1.5, 2.2]
    via = torch.tensor([[0.4, NAN, 1.0], [NAN, NAN, -2.0], [5.0, NAN, NAN]]).double()
    there, plain = (d.rollout(time=times) for d in (dmp.condition(times, via), dmp))
    expected = torch.where(via.isnan(), there.position, via)
    torch.testing.assert_close(there.position, expected, rtol=0, atol=1e-10)
    kept = ~via.isnan()
    torch.testing.assert_close(there.velocity[kept], plain.velocity[kept], rtol=0, atol=1e-8)
    torch.testing.assert_close(there.position[:, 1], plain.position[:, 1])


def test_a_via_point_may_be_a_velocity_alone():
    dmp = JointDMP.fit(*arm_motion(n_joints=3))
    there = dmp.rollout(time=[1.5])
    wanted = there.velocity + torch.tensor([[0.4, -0.3, NAN]]).double()
    bent = dmp.condition([1.5], velocity=wanted)
    velocity = bent.rollout(time=[1.5]).velocity
    torch.testing.assert_close(velocity[:, :2], wanted[:, :2], rtol=0, atol=1e-9)
    moved = (bent.rollout(time=DENSE).position - dmp.rollout(time=DENSE).position).abs().amax(0)
    assert (moved < torch.tensor([0.2, 0.2, 1e-9])).all()


def test_no_via_points_leave_the_motion_as_it_is():
    time, position = arm_motion(n_joints=2)
    dmp = JointDMP.fit(time, position, 20)
    same = dmp.condition([], torch.zeros(0, 2))
    torch.testing.assert_close(same.weights, dmp.weights, rtol=0, atol=0)


def test_ends_stay_with_their_velocity():
    dmp = JointDMP.fit(*arm_motion(n_joints=2, moving_start=True))
    bent = dmp.condition([1.0], [[2.0, -1.0]])
    for name in ("position", "velocity"):
        one, other = (getattr(d.rollout(time=[0.0, 3.0]), name) for d in (bent, dmp))
        torch.testing.assert_close(one, other, rtol=0, atol=1e-9, msg=name)


def test_within_a_window_all_else_is_unchanged():
    dmp = JointDMP.fit(*arm_motion(n_joints=2))
    bent = dmp.condition([1.5], [[0.9, NAN]], within=(0.9, 2.1))
    outside = (DENSE < 0.9) | (DENSE > 2.1)
    change = (bent.rollout(time=DENSE).position - dmp.rollout(time=DENSE).position).abs()
    assert change[outside].max() < 1e-9
    assert change[~outside].max() > 0.1
    assert bent.rollout(time=[1.5]).position[0, 0].item() == pytest.approx(0.9, abs=1e-10)


def test_a_window_ends_where_the_motion_ends():
    dmp = JointDMP.fit(*arm_motion(n_joints=2))
    for wide, same in (((0.9, 10.0), (0.9, 3.0)), ((-1.0, 2.1), (0.0, 2.1))):
        one, other = (
            dmp.condition([1.5], [[0.9, NAN]], within=within).rollout(time=DENSE).position
            for within in (wide, same)
        )
        torch.testing.assert_close(one, other, rtol=0, atol=1e-12)


def flat(n_basis):
    """Nothing but the change is left of its motion."""
    return JointDMP.fit(DENSE, torch.zeros_like(DENSE), n_basis=n_basis)


def test_between_via_points_the_change_is_a_minimum_jerk_curve():
    bump = flat(100).condition([1.0, 2.4], [[1.0], [-2.0]]).rollout(time=DENSE).position[:, 0]
    before = minimum_jerk((DENSE / 1.0).clamp(max=1))
    between = 3 * minimum_jerk(((DENSE - 1.0) / 1.4).clamp(0, 1))
    after = 2 * minimum_jerk(((DENSE - 2.4) / 0.6).clamp(min=0))
    torch.testing.assert_close(bump, before - between + after, rtol=0, atol=2e-3)


def test_a_given_velocity_bends_the_curve_to_the_quintic_with_it():
    bent = flat(100).condition([1.2], [[0.5]], velocity=[[-1.5]]).rollout(time=DENSE)
    for begin, end, ends in ((0.0, 1.2, (0, 0, 0.5, -1.5)), (1.2, 3.0, (0.5, -1.5, 0, 0))):
        # Six conditions, with no acceleration at either knot.
        T = end - begin
        rows = [[t**k for k in range(6)] for t in (0, T)]
        rows += [[k * t ** max(k - 1, 0) for k in range(6)] for t in (0, T)]
        rows += [[k * (k - 1) * t ** max(k - 2, 0) for k in range(6)] for t in (0, T)]
        c = np.linalg.solve(rows, [ends[0], ends[2], ends[1], ends[3], 0, 0])
        t = DENSE[(begin <= DENSE) & (end >= DENSE)]
        expected = sum(c[k] * (t - begin) ** k for k in range(6))
        got = bent.position[(begin <= DENSE) & (end >= DENSE), 0]
        torch.testing.assert_close(got, expected, rtol=0, atol=1e-3)
    there = flat(100).condition([1.2], [[0.5]], velocity=[[-1.5]]).rollout(time=[1.2])
    assert there.velocity.item() == pytest.approx(-1.5, abs=1e-9)


@pytest.mark.parametrize("far", [10.0, -1e4])
def test_via_points_far_outside_of_the_demonstration_cause_no_overshoot(far):
    time, position = arm_motion(n_joints=1)
    dmp = JointDMP.fit(time, position)
    for at in (0.3, 1.5, 2.6):
        moved = dmp.condition([at], [[far]]).rollout(time=DENSE).position
        change = (moved - dmp.rollout(time=DENSE).position)[:, 0] / (
            far - dmp.rollout(time=[at]).position[0, 0]
        )
        assert change.max() < 1 + 1e-6
        assert change.min() > -1e-6


def test_as_conditioning_without_noise_it_passes_but_keeps_the_end():
    """`around` makes the least change of the forcing, wherever that leads to at the end."""
    dmp = JointDMP.fit(*arm_motion(n_joints=1))
    soft = ProbabilisticDMP.around(dmp).condition([1.2], [[0.7]]).mean_primitive()
    hard = dmp.condition([1.2], [[0.7]])
    for bent in (soft, hard):
        assert bent.rollout(time=[1.2]).position.item() == pytest.approx(0.7, abs=1e-5)
    end, softs, hards = (d.rollout(time=[3.0]).position.item() for d in (dmp, soft, hard))
    assert abs(hards - end) < 1e-10 < abs(softs - end)


def test_orientations_are_passed_by_either_sign_of_the_quaternion():
    dmp = OrientationDMP.fit(*turning_motion())
    times = torch.tensor([0.8, 1.9], dtype=torch.float64)
    via = torch.stack([orientation(0.5, -1.0, 0.3), orientation(2.0, 1.0, 0.0)])
    omega = torch.tensor([[0.1, -0.2, 0.3], [NAN, NAN, NAN]]).double()
    bent, other = (dmp.condition(times, q, omega) for q in (via, -via))
    there = bent.rollout(time=times)
    assert quaternion.angle(there.orientation, via).max() < 1e-7
    torch.testing.assert_close(there.angular_velocity[0], omega[0], rtol=0, atol=1e-8)
    torch.testing.assert_close(other.rollout().orientation, bent.rollout().orientation)
    assert quaternion.angle(bent.goal, dmp.goal) < 1e-7
    assert quaternion.angle(bent.start, dmp.start) < 1e-7


def test_a_via_orientation_past_a_turn_is_on_the_branch_of_the_motion():
    s = torch.linspace(0, 1, 500, dtype=torch.float64)
    axis = torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64)
    dmp = OrientationDMP.fit(s, quaternion.exp(12 * minimum_jerk(s)[:, None] * axis))
    via = orientation(*(6.3 * axis))[None]
    bent = dmp.condition([0.5], via)
    assert quaternion.angle(bent.rollout(time=[0.5]).orientation, via).max() < 1e-7
    way = bent.rollout().angular_velocity.norm(dim=-1).mean()
    assert way.item() == pytest.approx(12, rel=0.02)


def test_any_part_of_a_pose_is_passed():
    dmp = fitted_pose()
    position = torch.tensor([[0.2, NAN, 0.4], [NAN, NAN, NAN]], dtype=torch.float64)
    rotation = torch.stack([torch.full((4,), NAN).double(), orientation(0.3, 0.2, -0.5)])
    bent = dmp.condition([1.0, 2.0], Pose(position, rotation))
    there, plain = (d.rollout(time=[1.0, 2.0]) for d in (bent, dmp))
    torch.testing.assert_close(there.position[0, [0, 2]], position[0, [0, 2]])
    torch.testing.assert_close(there.position[:, 1], plain.position[:, 1])
    assert quaternion.angle(there.orientation[1], rotation[1]) < 1e-7
    torch.testing.assert_close(there.body, plain.body)


def test_a_batch_passes_points_of_its_own():
    demonstrations = [arm_motion(n_joints=2, seed=seed) for seed in range(3)]
    time, positions = demonstrations[0][0], torch.stack([y for _, y in demonstrations])
    dmp = JointDMP.fit(time, positions)
    times = torch.tensor([[0.5], [1.0], [1.5]], dtype=torch.float64)
    via = torch.tensor([[[1.0, NAN]], [[2.0, 0.0]], [[NAN, 3.0]]], dtype=torch.float64)
    together = dmp.condition(times, via).rollout().position
    for i in range(3):
        alone = JointDMP.fit(time, positions[i]).condition(times[i], via[i])
        torch.testing.assert_close(together[i], alone.rollout().position, rtol=0, atol=1e-8)


@pytest.mark.parametrize("scaling", ["amplitude", "paper"])
def test_scaled_forcing_passes_as_well(scaling):
    dmp = JointDMP.fit(*arm_motion(n_joints=2), scaling=scaling)
    there = dmp.condition([1.1], [[1.0, -1.0]]).rollout(time=[1.1]).position
    torch.testing.assert_close(there, torch.tensor([[1.0, -1.0]]).double())


def test_new_ends_become_a_primitives_own():
    dmp = fitted_pose(approach=1.0)
    goal = Pose(torch.tensor([0.4, 0.1, -0.2]).double(), orientation(1.0, 0.2, 0.6))
    moved = dmp.with_boundary(goal=goal, duration=2.0, goal_body=[0.3, 0.1])
    expected = dmp.rollout(goal=goal, duration=2.0, goal_body=[0.3, 0.1])
    own = moved.rollout()
    torch.testing.assert_close(own.position, expected.position)
    torch.testing.assert_close(own.body, expected.body)
    assert quaternion.angle(own.orientation, expected.orientation).max() < 1e-7
    via = Pose(torch.tensor([[0.9, 0.9, 0.9]]).double(), orientation(0.0, 0.5, 0.0)[None])
    there = moved.condition([0.8], via).rollout(time=[0.8, 2.0])
    torch.testing.assert_close(there.position[:1], via.position)
    torch.testing.assert_close(there.position[1], own.position[-1], rtol=0, atol=1e-9)
    with pytest.raises(ValueError, match="depends on start and goal"):
        JointDMP.fit(*arm_motion(), scaling="paper").with_boundary(goal=torch.zeros(7))


def test_gradients_are_exact():
    dmp = fitted_pose(n_basis=12)
    at = torch.tensor([1.3, 1.7], dtype=torch.float64)

    def moved(time, position, vector, twist):
        via = Pose(position, quaternion.exp(vector))
        motion = dmp.condition(time, via, twist).rollout(time=at)
        return motion.position, motion.orientation

    rng = torch.Generator().manual_seed(0)
    rand = [torch.rand(2, n, generator=rng, dtype=torch.float64) for n in (3, 3, 6)]
    # Off the times at which curves are compared, where the derivative by time has a step.
    inputs = [torch.tensor([0.907, 2.013], dtype=torch.float64), *rand]
    with shapes_unchecked():
        assert gradcheck(
            moved, [x.requires_grad_() for x in inputs], atol=1e-6, rtol=1e-5, fast_mode=True
        )


@pytest.mark.parametrize("n_basis", [12, 50])
def test_no_via_points_move_the_path_further_than_they_ask_or_they_are_refused(n_basis):
    """At the distance that the refusal names, the same changes are possible."""
    dmp, spacing = flat(n_basis), 3.0 / (n_basis - 1)
    for times, change in (
        (lambda d: [1.5, 1.5 + d], [1.0, -1.0]),
        (lambda d: [3.0 - d], [1.0]),
        (lambda d: [d], [1.0]),
        (lambda d: [1.0, 1.0 + d, 1.0 + 2 * d, 1.0 + 3 * d], [1.0, -1.0, 1.0, -1.0]),
    ):
        column = torch.tensor(change).double()[:, None]
        with pytest.raises(ValueError, match="too close") as refused:
            dmp.condition(times(spacing / 4), column)
        least = float(re.findall(r"Keep ([\d.e-]+) s", str(refused.value))[0])
        assert least == pytest.approx(2 * spacing, rel=1e-2)
        for distance in np.linspace(spacing / 4, 1.01 * least, 5):
            try:
                moved = dmp.condition(times(distance), column).rollout(time=DENSE).position
            except ValueError:
                assert distance < least
            else:
                assert moved.abs().max() < 1.5


def test_points_too_near_the_ends_of_a_window_are_refused():
    dmp = flat(50)
    with pytest.raises(ValueError, match=r"0\.367 s from the ends of `within`"):
        dmp.condition([1.0], [[1.0]], within=(0.8, 2.4))
    moved = dmp.condition([1.17], [[1.0]], within=(0.8, 2.4)).rollout(time=DENSE).position
    assert moved.abs().max() < 1.01


def test_what_cannot_be_is_refused():
    time, position = arm_motion(n_joints=1)
    dmp = JointDMP.fit(time, position, n_basis=10)
    with pytest.raises(ValueError, match="too many for the 10 basis functions"):
        dmp.condition([0.3, 0.5, 1.0, 1.5, 2.0], torch.zeros(5, 1))
    # Two equations for each point and two for the end: four of them it has functions for.
    times = [0.6, 1.2, 1.8, 2.4]
    there = dmp.rollout(time=times).position + 0.01
    bent = dmp.condition(times, there).rollout(time=times).position
    torch.testing.assert_close(bent, there, rtol=0, atol=1e-6)
    for times in ([3.0], [1.0, 1.0]):
        with pytest.raises(ValueError, match=r"between 0\.000 and 1\.000 of the duration"):
            dmp.condition(times, torch.zeros(len(times), 1))
    with pytest.raises(ValueError, match=r"value must have shape \(1, 1\), got \(1, 2\)"):
        dmp.condition([1.0], [[0.0, 0.0]])
    with pytest.raises(ValueError, match="non-negative"):
        dmp.condition([-1.0], [[0.0]])
    swing = fit_rhythmic(time, torch.sin(8 * time), period=np.pi / 4)
    with pytest.raises(ValueError, match="a rhythm has no via points"):
        swing.condition([1.0], [[0.0]])
    turning = OrientationDMP.fit(*turning_motion(), n_basis=5, formulation="ude")
    with pytest.raises(ValueError, match="'ude' is not linear"):
        turning.condition([1.0], orientation(0.0, 0.0, 0.0)[None])


@pytest.mark.parametrize("within", [(1.5, 0.5), (1.0, 1.0), (NAN, 1.5), (5.0, 6.0)])
def test_a_window_has_a_beginning_and_an_end(within):
    time, position = arm_motion(n_joints=2)
    dmp = JointDMP.fit(time, position, 20)
    with pytest.raises(ValueError, match="within must be two increasing times of the motion"):
        dmp.condition([1.0], [[0.1, 0.2]], within=within)


@pytest.mark.parametrize("kind", ["joints", "orientation"])
def test_via_points_are_mapped_like_a_loop(kind):
    """`vmap` over via points, as a search over them needs it."""
    if kind == "joints":
        dmp = JointDMP.fit(*arm_motion(n_joints=3))
        via = dmp.rollout([1.5]).position.detach() + 0.1 * torch.arange(4).double()[:, None]
    else:
        dmp = OrientationDMP.fit(*turning_motion())
        turned = quaternion.exp(
            0.1 * torch.arange(4).double()[:, None] * torch.ones(3).double()
        )
        via = quaternion.multiply(turned, dmp.rollout([1.5]).orientation.detach())

    def weights(value):
        return dmp.condition([1.5], value[None]).motion.weights

    with shapes_unchecked():
        mapped = torch.func.vmap(weights)(via)
        loop = torch.stack([weights(value) for value in via])
    torch.testing.assert_close(
        mapped, loop, rtol=0, atol=1e-9 * float(loop.detach().abs().max())
    )
