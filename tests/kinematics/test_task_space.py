"""Errors, ranks and bases of tasks of a tool, against NumPy and SciPy."""

import numpy as np
import pytest
import torch
from arm_samples import joint_positions
from sampling import generator
from scipy.spatial.transform import Rotation

from hrc_learn.geometry import Pose
from hrc_learn.kinematics import inverse, panda

pytestmark = pytest.mark.simulation

Q = joint_positions(12, rng=generator(3))
SHIFT = np.array([0.01, -0.02, 0.03])


def matrices(pose):
    return pose.matrix().numpy()[..., :3, :3]


def turned(pose, rotvec):
    """The pose turned by a rotation vector in the base frame."""
    R = Rotation.from_rotvec(rotvec + np.zeros((len(Q), 3))).as_matrix() @ matrices(pose)
    T = np.tile(np.eye(4), (len(Q), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, pose.position.numpy() + SHIFT
    return Pose.from_matrix(torch.from_numpy(T[:, :3]))


@pytest.mark.parametrize("task", inverse.TASK_ROWS)
def test_errors_lead_to_the_wanted_pose(task):
    now = panda.forward(Q)
    rotvec = np.random.default_rng(0).normal(size=(len(Q), 3)) * 0.6
    wanted = turned(now, rotvec)
    error, J = inverse.task_error_and_jacobian(panda, Q, wanted, task)
    rows = inverse.TASK_ROWS[task]
    assert error.shape == (len(Q), rows)
    assert J.shape == (len(Q), rows, 7)
    np.testing.assert_allclose(error[:, :3], np.tile(SHIFT, (len(Q), 1)))
    whole = panda.jacobian(Q).numpy()
    np.testing.assert_allclose(J[:, :3], whole[:, :3])
    if task in ("pose", "nearest pose"):
        np.testing.assert_allclose(error[:, 3:], rotvec, atol=1e-9)
        np.testing.assert_allclose(J, whole)
    if task == "position+axis":
        sides = matrices(wanted)[..., :2].transpose(0, 2, 1)
        np.testing.assert_allclose(J[:, 3:], sides @ whole[:, 3:])
        a, b = matrices(now)[..., 2], matrices(wanted)[..., 2]
        for k in range(len(Q)):
            axis = np.cross(a[k], b[k])
            angle = np.arctan2(np.linalg.norm(axis), a[k] @ b[k])
            turn = angle * axis / np.linalg.norm(axis)
            np.testing.assert_allclose(Rotation.from_rotvec(turn).apply(a[k]), b[k], atol=1e-9)
            np.testing.assert_allclose(error[k, 3:], sides[k] @ turn, atol=1e-9)


def test_a_turn_about_the_axis_is_no_error_and_the_other_way_round_is_half_a_turn():
    now = panda.forward(Q)
    z, x = matrices(now)[..., 2], matrices(now)[..., 0]
    for rotvec, size in ((1.2 * z, 0), (np.pi * x, np.pi)):
        pose = turned(now, rotvec)
        error, _ = inverse.task_error_and_jacobian(panda, Q, pose, "position+axis")
        np.testing.assert_allclose(error[:, 3:].norm(dim=-1), size, atol=1e-6)


@pytest.mark.parametrize("task", inverse.TASK_ROWS)
def test_what_a_task_leaves_is_its_null_space(task):
    q = torch.cat([Q, torch.zeros(1, 7, dtype=torch.float64)])  # stretched: singular
    _, J = inverse.task_error_and_jacobian(panda, q, panda.forward(q), task)
    expected = 7 - np.linalg.matrix_rank(J.numpy(), tol=1e-6 * np.linalg.norm(J, 2, (1, 2)))
    found = inverse.null_space_dimension(panda, q, task)
    np.testing.assert_array_equal(found, expected)
    assert (found[:-1] == 7 - inverse.TASK_ROWS[task]).all()
    shaped = inverse.null_space_dimension(panda, Q.view(3, 4, 7), task)
    np.testing.assert_array_equal(shaped, found[:-1].view(3, 4))
    assert inverse.null_space_dimension(panda, q[:1], task, below=1.0) >= 6
    assert inverse.task_rank(panda, task) == inverse.TASK_ROWS[task]


@pytest.mark.parametrize("task", inverse.TASK_ROWS)
def test_a_task_leads_orthonormal_twists(task):
    rank, R = inverse.TASK_ROWS[task], matrices(panda.forward(Q))
    B = inverse.task_basis(panda.jacobian(Q), panda.forward(Q).orientation, task, rank).numpy()
    assert B.shape == (len(Q), rank, 6)
    np.testing.assert_allclose(B @ B.transpose(0, 2, 1), np.tile(np.eye(rank), (12, 1, 1)),
                               atol=1e-9)  # fmt: skip
    np.testing.assert_allclose(B[:, :3], np.tile(np.eye(6)[:3], (12, 1, 1)))
    if task == "position+axis":
        # The turns are across the tool's axis, and the linear part is at rest.
        np.testing.assert_allclose(B[:, 3:, :3], 0)
        np.testing.assert_allclose(B[:, 3:, 3:] @ R[..., 2, None], 0, atol=1e-12)


@pytest.mark.parametrize("joints", [3, 4, 5])
def test_of_few_joints_the_position_comes_first(joints):
    """The rest are the rotations of the joints with the position at rest."""
    J = panda.jacobian(Q)[..., :joints]
    q4 = panda.forward(Q).orientation
    B = inverse.task_basis(J, q4, "pose", joints).numpy()
    assert B.shape == (len(Q), joints, 6)
    np.testing.assert_allclose(B[:, :3], np.tile(np.eye(6)[:3], (12, 1, 1)))
    for k in range(len(Q)):
        Vt = np.linalg.svd(J[k, :3].numpy())[2]
        turns = J[k, 3:].numpy() @ Vt[3:].T
        own = B[k, 3:, 3:].T
        np.testing.assert_allclose(B[k, 3:, :3], 0)
        np.testing.assert_allclose(own.T @ own, np.eye(joints - 3), atol=1e-9)
        # Both span the same rotations.
        np.testing.assert_allclose(own @ own.T @ turns, turns, atol=1e-9)


def test_a_task_of_which_an_arm_moves_less_leads_what_it_moves():
    J, q4 = panda.jacobian(Q)[..., :4], panda.forward(Q).orientation
    B = inverse.task_basis(J, q4, "position+axis", 4).numpy()
    assert B.shape == (len(Q), 4, 6)
    rows = inverse.task_basis(J, q4, "position+axis", 5).numpy()
    moved = rows @ J.numpy()
    for k in range(len(Q)):
        np.testing.assert_allclose(B[k] @ B[k].T, np.eye(4), atol=1e-9)
        own = rows[k] @ B[k].T
        np.testing.assert_allclose(own @ own.T @ moved[k], moved[k], atol=1e-9)


def test_comfortable_postures_are_far_from_limits_and_singularities_and_differ():
    q = joint_positions(60, rng=generator(8))
    q = torch.cat([q, q[:20] + 0.1, q[:20] + 0.2])
    lower, upper = panda.limits.lower.numpy(), panda.limits.upper.numpy()
    scores = []
    for one in q.numpy():
        margin = min((one - lower).min(), (upper - one).min())
        least = np.linalg.svd(panda.jacobian(torch.from_numpy(one)).numpy())[1][-1]
        scores.append(min(margin / 0.5, 1) + min(least / 0.2, 1))
    expected = []
    for k in np.argsort(-np.array(scores), kind="stable"):
        if all(np.linalg.norm(q[k].numpy() - other) > 0.5 for other in expected):
            expected.append(q[k].numpy())
    found = inverse.best_postures(panda, q)
    assert len(found) < len(q)
    np.testing.assert_array_equal(found, np.array(expected))
    assert len(inverse.best_postures(panda, q[:1])) == 1
