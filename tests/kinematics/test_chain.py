"""Forward kinematics and Jacobians against derivatives and against MuJoCo."""

import mujoco
import pytest
import sampling
import torch
from arm_samples import joint_positions
from graphs import library_calls
from sampling import generator
from torch.testing import assert_close
from unchecked import shapes_unchecked

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import SerialChain, panda
from hrc_learn.kinematics.chain import transform_and_jacobian

BATCHES = [(), (1,), (3, 1, 2)]


@pytest.fixture(scope="module")
def mujoco_arm():
    """A model of bare frames: each body placed and turned as the table says."""

    def placed(T):
        q = quaternion.from_matrix(T[:3, :3])
        return {"pos": T[:3, 3].tolist(), "quat": q.tolist()}

    spec = mujoco.MjSpec()
    body = spec.worldbody
    for name, mount in zip(panda.joint_names, panda.mounts, strict=True):
        body = body.add_body(name=name, mass=1, inertia=[1, 1, 1], **placed(mount))
        body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1])
    body.add_site(name="flange", **placed(panda.flange))
    body.add_site(name="tcp", **placed(panda.flange @ panda.tcp))
    model = spec.compile()
    return model, mujoco.MjData(model)


def solve_mujoco(mujoco_arm, q):
    model, data = mujoco_arm
    data.qpos[:] = q.numpy()
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return model, data


def test_agrees_with_mujoco(mujoco_arm):
    for q in joint_positions(50, rng=generator(1)):
        model, data = solve_mujoco(mujoco_arm, q)
        links, J = panda.link_poses(q), panda.jacobian(q)
        positions = torch.cat([torch.tensor(data.xpos[1:]), torch.tensor(data.site_xpos)])
        rotations = torch.cat([torch.tensor(data.xmat[1:]), torch.tensor(data.site_xmat)])
        linear, angular = torch.zeros(2, 3, 7, dtype=torch.float64).numpy()
        mujoco.mj_jacSite(model, data, linear, angular, model.site("tcp").id)
        assert_close(links.position, positions, rtol=0, atol=1e-12)
        assert_close(
            quaternion.to_matrix(links.orientation), rotations.view(9, 3, 3), rtol=0, atol=1e-12
        )
        assert_close(J[:3], torch.from_numpy(linear), rtol=0, atol=1e-12)
        assert_close(J[3:], torch.from_numpy(angular), rtol=0, atol=1e-12)


@pytest.mark.parametrize("joint", range(1, 8))
def test_joint_jacobian_agrees_with_mujoco(mujoco_arm, joint):
    for q in joint_positions(10, rng=generator(2)):
        model, data = solve_mujoco(mujoco_arm, q)
        linear, angular = torch.zeros(2, 3, 7, dtype=torch.float64).numpy()
        mujoco.mj_jacBody(model, data, linear, angular, joint)
        J = panda.joint_jacobian(q, joint)
        assert_close(J[:3], torch.from_numpy(linear), rtol=0, atol=1e-12)
        assert_close(J[3:], torch.from_numpy(angular), rtol=0, atol=1e-12)


def test_ready_posture_points_the_gripper_down():
    """From link lengths alone: upper arm 45 deg back, forearm level, hand straight down."""
    h = 0.5**0.5
    x = (-0.316 + 0.0825) * h + 0.384 + 0.088
    z = 0.333 + (0.316 + 0.0825) * h + 0.0825 - 0.107
    flange = panda.link_poses(panda.ready)[7]
    assert_close(flange.position, torch.tensor([x, 0, z], dtype=torch.float64))
    tcp = panda.forward(panda.ready)
    down = torch.tensor([0.0, 0, -1], dtype=torch.float64)
    assert_close(tcp.position, flange.position + 0.1034 * down)
    assert_close(quaternion.rotate(tcp.orientation, -down), down)


@pytest.mark.parametrize("batch", BATCHES)
def test_jacobian_is_the_derivative_of_the_pose(batch):
    q = joint_positions(*batch, rng=generator(4))
    J, step = panda.jacobian(q), 1e-6
    for i in range(7):
        dq = torch.zeros(7, dtype=torch.float64)
        dq[i] = step
        twist = panda.forward(q - dq).twist_to(panda.forward(q + dq)) / (2 * step)
        assert_close(J[..., i], twist, rtol=0, atol=1e-9)


@pytest.mark.parametrize("joint", [1, 4, 7])
def test_joint_jacobian_is_the_derivative_of_the_link_pose(joint):
    q, step = joint_positions(5, rng=generator(5)), 1e-6
    J = panda.joint_jacobian(q, joint)
    for i in range(7):
        dq = torch.zeros(7, dtype=torch.float64)
        dq[i] = step
        before, after = panda.link_poses(q - dq), panda.link_poses(q + dq)
        twist = before[..., joint - 1].twist_to(after[..., joint - 1]) / (2 * step)
        assert_close(J[..., i], twist, rtol=0, atol=1e-9)


def test_position_rows_are_the_autograd_derivative():
    q = joint_positions(rng=generator(6))
    linear = torch.func.jacrev(lambda q: panda.forward(q).position)(q)
    assert_close(linear, panda.jacobian(q)[:3], rtol=0, atol=1e-13)


def test_angular_rows_are_the_autograd_derivative():
    q = joint_positions(rng=generator(7))
    now = panda.forward(q)

    def turn(q):
        return now.twist_to(panda.forward(q))[3:]

    assert_close(torch.func.jacrev(turn)(q), panda.jacobian(q)[3:], rtol=0, atol=1e-13)


@pytest.mark.parametrize("batch", BATCHES)
def test_all_entry_points_agree(batch):
    q = joint_positions(*batch, rng=generator(8))
    pose, J = panda.forward_and_jacobian(q)
    links = panda.link_poses(q)
    assert links.position.shape == (*batch, 9, 3)
    assert_close(links[..., 8].matrix(), pose.matrix())
    assert_close(panda.forward(q).matrix(), pose.matrix())
    assert_close(panda.jacobian(q), J)
    # The frame of joint 7 turns with the tool: the angular rows are the same.
    assert_close(panda.joint_jacobian(q, 7)[..., 3:, :], J[..., 3:, :])


def test_float32_follows_the_input():
    q = joint_positions(100, rng=generator(9))
    pose, J = panda.forward_and_jacobian(q.float())
    assert {pose.position.dtype, pose.orientation.dtype, J.dtype} == {torch.float32}
    assert_close(pose.position, panda.forward(q).position.float(), rtol=0, atol=2e-6)


def test_vmaps_and_differentiates_in_a_dtype_met_for_the_first_time():
    """Constants made inside a transform must not outlive it."""
    chain = SerialChain(
        joint_names=panda.joint_names,
        mounts=panda.mounts,
        flange=panda.flange,
        tcp=panda.tcp,
        limits=panda.limits,
        ready=panda.ready,
    )
    q = joint_positions(4, rng=generator(10))

    def height(q):
        return chain.transform_and_jacobian(q)[0][2, 3]

    gradient = torch.vmap(torch.func.grad(height))(q)
    assert_close(gradient, panda.jacobian(q)[:, 2], rtol=0, atol=1e-13)
    assert_close(torch.vmap(height)(q), panda.forward(q).position[:, 2])
    assert_close(chain.jacobian(q), panda.jacobian(q))


class ForwardAndJacobian(torch.nn.Module):
    def forward(self, q):
        return panda.forward_and_jacobian(q)


@pytest.mark.long
def test_exports_for_any_batch_size():
    q = joint_positions(5, rng=generator(11))
    with shapes_unchecked():
        program = torch.export.export(
            ForwardAndJacobian(), (q,), dynamic_shapes={"q": {0: torch.export.Dim("batch")}}
        )
    other = joint_positions(3, rng=generator(12))
    pose, J = program.module()(other)
    assert isinstance(pose, Pose)
    assert_close(J, panda.jacobian(other))
    assert_close(pose.matrix(), panda.forward(other).matrix())


@pytest.mark.parametrize("joint", [0, 8, -1])
def test_unknown_joint_is_refused(joint):
    with pytest.raises(ValueError, match="joint must be 1 to 7"):
        panda.joint_jacobian(panda.ready, joint)


def test_chain_with_missing_names_is_refused():
    with pytest.raises(ValueError, match="6 names, 7 mounts"):
        SerialChain(
            joint_names=panda.joint_names[:6],
            mounts=panda.mounts,
            flange=panda.flange,
            tcp=panda.tcp,
            limits=panda.limits,
            ready=panda.ready,
        )


MOUNTS, TIP = panda.mounts.tolist(), (panda.flange @ panda.tcp).tolist()


def postures(*batch: int) -> torch.Tensor:
    count = int(torch.tensor(batch).prod()) if batch else 1
    lower, upper = panda.limits.lower, panda.limits.upper
    return sampling.within(lower, upper, count, rng=sampling.generator()).reshape(*batch, 7)


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2), (100,)])
def test_it_equals_the_matrix_form(batch):
    q = postures(*batch)
    T, J = transform_and_jacobian(q, MOUNTS, TIP)
    expected_T, expected_J = panda.transform_and_jacobian(q)
    torch.testing.assert_close(T, expected_T, rtol=0, atol=1e-14)
    torch.testing.assert_close(J, expected_J, rtol=0, atol=1e-14)


def test_the_batch_is_last_in_memory():
    q = postures(5)
    T, J = transform_and_jacobian(q, MOUNTS, TIP)
    assert (T.stride(), J.stride()) == ((1, 20, 5), (1, 35, 5))


def test_the_jacobian_is_the_derivative():
    q = postures()

    def position(q: torch.Tensor) -> torch.Tensor:
        return transform_and_jacobian(q, MOUNTS, TIP)[0][:, 3]

    expected = torch.autograd.functional.jacobian(position, q)
    assert isinstance(expected, torch.Tensor)
    J = transform_and_jacobian(q, MOUNTS, TIP)[1]
    torch.testing.assert_close(J[:3], expected, rtol=0, atol=1e-14)


def test_a_traced_chain_is_written_out_and_equal():
    class Chain(torch.nn.Module):
        def forward(self, q: torch.Tensor) -> tuple[torch.Tensor, ...]:
            pose, J = panda.forward_and_jacobian(q)
            return pose.position, pose.orientation, J

    q = postures(4)
    with shapes_unchecked():
        program = torch.export.export(Chain(), (q,), strict=False)
        traced, eager = program.module()(q), Chain()(q)
    assert not library_calls(program)
    torch.testing.assert_close(traced, eager, rtol=0, atol=1e-13)
