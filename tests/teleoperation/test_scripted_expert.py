"""Scripted people: the expert, and one who pulls."""

import math

import numpy as np
import pytest
import torch
from projections import null_space_projector

from hrc_learn.geometry import quaternion
from hrc_learn.kinematics import coarse_orientation, gripper_down, panda
from hrc_learn.protocols import ArmState
from hrc_learn.teleoperation import (
    InteractionForceConfig,
    ScriptedForce,
    ScriptedPerturbation,
    force_to_nullspace_input,
)
from hrc_learn.teleoperation.scripted_expert import GuidedPath, ScriptedExpert, Tremor

# The force stands for the same velocity: what is tested is the mapping.
PINV = InteractionForceConfig(mapping="pinv", rate=1.0, stiffness=1.0, speed=1e9, damping=1.0)
WAYPOINTS = np.array([[0.4, 0.0, 0.5], [0.42, -0.2, 0.45], [0.4, -0.35, 0.4], [0.4, -0.6, 0.4]])


def test_the_rule_tilts_with_the_sideways_position_and_then_no_further():
    y = torch.tensor([0.0, -0.3, -0.6, -0.9, 0.6], dtype=torch.float64)
    position = torch.stack([torch.zeros_like(y), y, torch.zeros_like(y)], dim=-1)
    approach = quaternion.to_matrix(coarse_orientation(position))[..., :, 2]
    s = math.sqrt(0.5)
    expected = torch.tensor(
        [[0, 0, -1], [0, -s, -s], [0, -1, 0], [0, -1, 0], [0, 1, 0]], dtype=torch.float64
    )
    torch.testing.assert_close(approach, expected, atol=1e-12, rtol=0)
    # The fingers keep closing along x, so that a board never stands in their way.
    closing = quaternion.to_matrix(coarse_orientation(position))[..., :, 1]
    torch.testing.assert_close(closing, torch.tensor([1.0, 0, 0]).double().expand(5, 3))
    torch.testing.assert_close(coarse_orientation(position)[0], gripper_down())


def test_a_guided_path_passes_its_waypoints_from_rest_to_rest():
    path = GuidedPath(WAYPOINTS, duration=10.0, start=2.0)
    np.testing.assert_allclose(path.position(0.0), WAYPOINTS[0])
    np.testing.assert_allclose(path.position(12.0), WAYPOINTS[-1], atol=1e-12)
    for time in (2.0, 12.0, 20.0):
        np.testing.assert_allclose(path.velocity(time), 0.0, atol=1e-9)
    samples = np.array([path.position(t) for t in np.linspace(2, 12, 2001)])
    for waypoint in WAYPOINTS:
        assert np.linalg.norm(samples - waypoint, axis=1).min() < 1e-3
    for time in (3.3, 6.1, 9.7):
        numeric = (path.position(time + 1e-5) - path.position(time - 1e-5)) / 2e-5
        np.testing.assert_allclose(path.velocity(time), numeric, atol=1e-6)


def test_tremor_has_the_amplitude_asked_for_and_its_drift_three_times_that():
    tremor, dt = Tremor(5e-4, np.random.default_rng(0)), 0.05
    # All four waves pass through whole periods in 100 s, so each has a line of its own.
    velocity = np.array([tremor.velocity(t) for t in np.arange(0, 100, dt)])
    spectrum = 2 * np.abs(np.fft.rfft(velocity, axis=0)) / len(velocity)
    frequency = np.fft.rfftfreq(len(velocity), dt)
    moves = spectrum > 1e-6
    for axis in range(3):
        np.testing.assert_allclose(frequency[moves[:, axis]], [0.22, 0.35, 7.2, 8.0])
        size = spectrum[moves[:, axis], axis] / (2 * np.pi * frequency[moves[:, axis]])
        np.testing.assert_allclose(size, [1.5e-3, 1.5e-3, 3.5e-4, 5e-4])


def test_the_experts_hand_reaches_the_end_of_the_path():
    start = torch.tensor([0.2402, -0.5026, -0.1803, -2.1236, -0.0934, 1.6267, -0.7]).double()
    position = panda.forward(start).position.numpy()
    goal = position + np.array([0.05, -0.2, -0.1])
    path = GuidedPath(np.stack([position, goal]), duration=4.0)
    still = Tremor(0.0, np.random.default_rng(0))
    expert = ScriptedExpert(
        panda, path, lambda position, _: coarse_orientation(position), still
    )
    q, dt = start, 0.01
    for k in range(600):
        state = ArmState(
            time=k * dt, joint_position=q.numpy(), joint_velocity=np.zeros(7), gripper_width=0.0
        )
        q = q + dt * torch.linalg.pinv(panda.jacobian(q)) @ torch.from_numpy(
            expert.read(state).twist
        )
    pose = panda.forward(q)
    np.testing.assert_allclose(pose.position.numpy(), path.position(6.0), atol=1e-4)
    assert float(quaternion.angle(pose.orientation, coarse_orientation(pose.position))) < 1e-3


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
        d = torch.from_numpy(force_to_nullspace_input(panda, q, 4, velocity, PINV))
        J = panda.joint_jacobian(torch.from_numpy(q), 4)[:3]
        # Joint 4 cannot leave the sphere around the shoulder: only the part along it is met.
        reachable = (J @ torch.linalg.pinv(J, rtol=1e-6)).numpy() @ velocity
        np.testing.assert_allclose((J @ d).numpy(), reachable, atol=1e-9)


def test_the_papers_mapping_can_move_the_elbow_against_the_pull():
    rng = np.random.default_rng(1)
    worst = 0.0
    for q in random_configurations(300, seed=2):
        pull = rng.normal(size=3)
        d = torch.from_numpy(force_to_nullspace_input(panda, q, 4, pull, PINV))
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


def test_a_script_counts_from_zero_or_from_when_it_begins():
    pull = ScriptedForce(start=0.1, duration=1.0, towards=(0.5, 0.3, 0.6))

    def effort(person, time):
        q = panda.ready.numpy()
        state = ArmState(time=time, joint_position=q, joint_velocity=0 * q, gripper_width=0.08)
        return person.read(state).effort(7)

    person = ScriptedPerturbation(panda, [pull])
    pulled = effort(person, 0.6)
    assert pulled.any()
    assert not effort(person, 0.05).any()
    assert not effort(person, 1.2).any()
    waiting = ScriptedPerturbation(panda, [pull], begin=None)
    assert not effort(waiting, 0.6).any()
    waiting.begin(2.0)
    assert not effort(waiting, 2.05).any()
    np.testing.assert_array_equal(effort(waiting, 2.6), pulled)
