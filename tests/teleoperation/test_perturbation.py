import numpy as np
import pytest
import torch

from hrc_learn.kinematics import null_space_projector, panda
from hrc_learn.protocols import ArmState
from hrc_learn.teleoperation import (
    ScriptedForce,
    ScriptedPerturbation,
    force_to_nullspace_input,
)


def random_configurations(n, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(panda.limits.lower.numpy(), panda.limits.upper.numpy(), size=(n, 7))


@pytest.mark.parametrize("joint", [3, 4, 5, 6])
def test_a_pull_never_moves_the_joint_against_it(joint):
    rng = np.random.default_rng(joint)
    for q in random_configurations(50, seed=joint):
        pull = rng.normal(size=3)
        d = torch.from_numpy(force_to_nullspace_input(panda, q, joint, pull))
        q_t = torch.from_numpy(q)
        motion = null_space_projector(panda.jacobian(q_t)) @ d
        velocity = panda.joint_jacobian(q_t, joint)[:3] @ motion
        assert float(velocity @ torch.from_numpy(pull)) > -1e-9


def test_the_papers_mapping_asks_for_the_velocity_pulled():
    for q in random_configurations(20):
        velocity = np.array([0.05, -0.02, 0.03])
        d = torch.from_numpy(force_to_nullspace_input(panda, q, 4, velocity, mapping="pinv"))
        J = panda.joint_jacobian(torch.from_numpy(q), 4)[:3]
        # Joint 4 cannot leave the sphere around the shoulder: only the part along it is met.
        reachable = (J @ torch.linalg.pinv(J, rtol=1e-6)).numpy() @ velocity
        np.testing.assert_allclose((J @ d).numpy(), reachable, atol=1e-9)


def test_the_papers_mapping_can_move_the_elbow_against_the_pull():
    rng = np.random.default_rng(1)
    worst = 0.0
    for q in random_configurations(300, seed=2):
        pull = rng.normal(size=3)
        d = torch.from_numpy(force_to_nullspace_input(panda, q, 4, pull, mapping="pinv"))
        q_t = torch.from_numpy(q)
        motion = null_space_projector(panda.jacobian(q_t)) @ d
        along = float(panda.joint_jacobian(q_t, 4)[:3] @ motion @ torch.from_numpy(pull))
        worst = min(worst, along)
    assert worst < -1e-3


def test_a_spell_is_soft_at_both_ends_and_over_outside():
    spell = ScriptedForce(start=1.0, duration=3.0, towards=(5.0, 0.0, 0.0), ramp=0.5)
    assert spell.end == 4.0
    assert [spell.strength(t) for t in (0.0, 1.0, 4.0, 5.0)] == [0.0] * 4
    assert spell.strength(2.5) == 1.0
    assert spell.strength(1.25) == pytest.approx(0.5)
    times = np.linspace(1.0, 1.5, 50)
    assert (np.diff([spell.strength(t) for t in times]) > 0).all()


def test_a_spell_pulls_like_a_spring_up_to_its_strongest():
    spell = ScriptedForce(
        start=0.0, duration=2.0, towards=(1.0, 0.0, 0.0), stiffness=10.0, max_force=5.0
    )
    np.testing.assert_allclose(spell.force(1.0, np.array([0.8, 0.0, 0.0])), [2.0, 0.0, 0.0])
    np.testing.assert_allclose(spell.force(1.0, np.array([1.0, 3.0, 4.0])), [0.0, -3.0, -4.0])
    np.testing.assert_allclose(spell.force(1.0, np.array([1.0, 0.0, 0.0])), 0.0)


def test_a_person_without_spells_leaves_the_arm_alone():
    q = panda.ready.numpy()
    state = ArmState(time=0.0, joint_position=q, joint_velocity=np.zeros(7), gripper_width=0.08)
    asked = ScriptedPerturbation(panda, []).read(state)
    assert not asked.nullspace_input.any()
    assert not asked.twist.any()
