"""Placing skills on disk: what is read back, and what is refused with its reason."""

import numpy as np
import pytest
import torch
from sampling import generator

from hrc_learn.dmp import JointDMP, PoseDMP
from hrc_learn.kinematics import panda
from hrc_learn.kinematics.registry import arm
from hrc_learn.skills.placing import PlacingSkill

TIME = torch.linspace(0, 2, 40, dtype=torch.float64)
ROBOT = arm("panda")


def primitives(names=panda.joint_names):
    """A motion of every joint, and the pose of the end effector along it."""
    s = (TIME / 2)[:, None]
    far = 0.4 * torch.rand(7, generator=generator(0), dtype=torch.float64)
    joints = panda.ready + s**3 * (10 - 15 * s + 6 * s**2) * far
    pose = panda.forward(joints)
    joint = JointDMP.fit(TIME, joints, n_basis=12, joint_names=names)
    return joint, PoseDMP.fit(TIME, pose.position, pose.orientation, n_basis=12)


def test_a_skill_plans_after_the_disk_what_its_primitives_reproduce(tmp_path):
    joint, pose = primitives()
    joint.float().save(tmp_path / "joint")
    pose.float().save(tmp_path / "pose")
    skill = PlacingSkill.load(tmp_path, ROBOT)
    assert skill.joint.goal.dtype == skill.pose.start.position.dtype == torch.float64
    assert skill.robot is ROBOT
    shown = joint.double().rollout(TIME).position
    goal = panda.forward(shown[-1])
    plan = skill.plan(shown[0], goal, space="joint", dt=0.05)
    assert len(plan.path) == 41
    np.testing.assert_allclose(plan.path[0], shown[0], atol=1e-5)
    np.testing.assert_allclose(
        plan.path[20], joint.double().rollout(TIME[[0]] + 1).position[0], atol=2e-2
    )
    reached = panda.forward(torch.from_numpy(np.asarray(plan.path[-1])))
    np.testing.assert_allclose(reached.position.detach(), goal.position.detach(), atol=1e-3)


def test_joints_of_another_arm_are_named_with_what_to_do(tmp_path):
    joint, _ = primitives(tuple(f"j{i}" for i in range(7)))
    joint.save(tmp_path / "joint")
    with pytest.raises(ValueError, match=r"joints \('j0'.* but the panda has \('panda_joint1'"):
        PlacingSkill.load(tmp_path, ROBOT)


def test_a_model_without_poses_is_refused(tmp_path):
    primitives()[0].save(tmp_path / "joint")
    with pytest.raises(ValueError, match="holds no pose primitive"):
        PlacingSkill.load(tmp_path, ROBOT)
