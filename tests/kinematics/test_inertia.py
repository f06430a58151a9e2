"""Mass matrices, against Pinocchio and MuJoCo."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from hrc_learn.kinematics import arm, panda
from hrc_learn.kinematics.inertia import MassMatrix

pinocchio = pytest.importorskip("pinocchio")


def installed(name: str) -> Path:
    """File of a description that the package `example-robot-data` brings."""
    described = arm("ur5").description
    assert described is not None
    return next(f for f in described.parents if f.name == "robots") / name


def postures(of, count=20):
    rng = torch.Generator().manual_seed(3)
    part = torch.rand(count, len(of.joint_names), generator=rng, dtype=torch.float64)
    return of.limits.lower + part * (of.limits.upper - of.limits.lower)


def by_pinocchio(path, arm_joints, q):
    """Mass matrices, with all joints but the arm's locked."""
    model = pinocchio.buildModelFromUrdf(str(path))
    neutral = pinocchio.neutral(model)
    locked = [i for i in range(1, model.njoints) if model.names[i] not in arm_joints]
    model = pinocchio.buildReducedModel(model, locked, neutral)
    data = model.createData()
    matrices = []
    for row in q.numpy():
        M = pinocchio.crba(model, data, row)
        matrices.append(np.triu(M) + np.triu(M, 1).T)
    return np.array(matrices)


def test_pandas_mass_matrix_is_pinocchios():
    path = installed("panda_description/urdf/panda.urdf")
    names, q = [f"panda_joint{i}" for i in range(1, 8)], postures(panda)
    # The description has two fingers of 15 g besides, and masses of more digits.
    torch.testing.assert_close(
        MassMatrix(panda)(q).numpy(), by_pinocchio(path, names, q), rtol=0, atol=0.03
    )


@pytest.mark.parametrize("name", ["ur5", "xarm7"])
def test_mass_matrix_of_a_description_is_pinocchios(name):
    described = arm(name)
    q = postures(described)
    expected = by_pinocchio(described.description, described.joint_names, q)
    np.testing.assert_allclose(MassMatrix(described)(q), expected, atol=1e-9)


MODEL = """<mujoco><compiler autolimits="true"/><worldbody><body name="base">
<geom size="0.03" mass="1"/><body name="a" pos="0 0 0.2" quat="0.9 0.1 0.3 0.2">
<joint name="j1" axis="0 0.6 0.8" range="-90 90"/>
<inertial pos="0.02 0.01 0.1" quat="0.8 0.2 0.5 0.1" mass="2" diaginertia="0.03 0.02 0.015"/>
<body name="b" pos="0.1 0 0.3"><joint name="j2" type="slide" axis="1 0 0" range="-0.3 0.3"/>
<inertial pos="0 0.03 0.05" mass="1.5" diaginertia="0.01 0.012 0.005"/>
<body name="c" pos="0 0 0.2"><joint name="j3" axis="0 1 0" range="-100 100"/>
<inertial pos="0 0 0.1" mass="0.7" diaginertia="0.004 0.003 0.002"/>
<body name="plate" pos="0 0.1 0.1" quat="0.7 0 0.7 0">
<inertial pos="0.01 0 0" mass="0.2" diaginertia="0.001 0.001 0.002"/>
<site name="tcp" pos="0 0 0.1"/></body></body></body></body></body></worldbody></mujoco>"""


@pytest.mark.parametrize("load", [0.0, 0.8])
def test_turning_and_sliding_joints_a_welded_plate_and_a_load_are_mujocos(tmp_path, load):
    path = tmp_path / "heron.xml"
    path.write_text(MODEL)
    described = arm(path, tip="tcp")
    spec = mujoco.MjSpec.from_file(str(path))
    if load:
        carried = spec.body("plate").add_body(pos=(0, 0, 0.1))
        carried.add_geom(size=(1e-4, 0, 0), mass=load)
    model = spec.compile()
    data = mujoco.MjData(model)
    q = postures(described)
    found = MassMatrix(described, rotor_inertia=0.05)(q, load)
    for row, M in zip(q.numpy(), found, strict=True):
        data.qpos[:] = row
        mujoco.mj_forward(model, data)
        full = np.zeros((3, 3))
        mujoco.mj_fullM(model, data, full)
        np.testing.assert_allclose(M, full + 0.05 * np.eye(3), atol=1e-7)


def test_masses_without_inertia_are_spread_over_the_capsules(tmp_path):
    bare = tmp_path / "bare.urdf"
    bare.write_text(
        '<robot name="bare"><link name="base"/><link name="rod"><inertial><mass value="3"/>'
        '</inertial><collision><origin xyz="0 0 0.7"/><geometry><cylinder radius="0.001" '
        'length="1"/></geometry></collision></link><joint name="j" type="revolute">'
        '<parent link="base"/><child link="rod"/><axis xyz="0 1 0"/>'
        '<limit lower="-1" upper="1" effort="10" velocity="1"/></joint></robot>'
    )
    # A thin rod of 1 m and 3 kg, its middle 0.7 m from the axis: m (l^2/12 + 0.7^2).
    M = MassMatrix(arm(bare))(torch.zeros(2, 1, dtype=torch.float64))
    assert M.flatten().tolist() == pytest.approx(2 * [3 * (1 / 12 + 0.49)], rel=0.02)


def test_bodies_that_move_together_add_up_and_their_inertia_is_mujocos(tmp_path):
    """In frames of the joints, and zero for a flange and a tool that carry nothing."""
    path = tmp_path / "heron.xml"
    path.write_text(MODEL)
    described = arm(path, tip="tcp")
    assert described.shape.masses == pytest.approx((1.0, 2.0, 1.5, 0.9, 0.0, 0.0))
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    frames = described.link_poses([0.0, 0.0, 0.0]).matrix().numpy()
    moving = {"a": 0, "b": 1, "c": 2, "plate": 2}
    expected = np.zeros((3, 4, 4))
    for name, number in moving.items():
        body = model.body(name).id
        R, mass = data.ximat[body].reshape(3, 3), model.body_mass[body]
        moments = model.body_inertia[body]
        # Second moments about the axes from moments of inertia about them.
        second = np.diag(moments.sum() / 2 - moments)
        inner = np.zeros((4, 4))
        inner[:3, :3], inner[3, 3] = second, mass
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, data.xipos[body]
        T = np.linalg.inv(frames[number]) @ T
        expected[number] += T @ inner @ T.T
    for found, wanted in zip(described.shape.inertia[1:4], expected, strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-9)
    for empty in described.shape.inertia[4:]:
        np.testing.assert_array_equal(empty, np.zeros((4, 4)))
