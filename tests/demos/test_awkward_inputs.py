"""Datasets of unusual but plausible content are read as a person would, or doubted in words."""

import json

import numpy as np
import pytest
import torch
from lerobot_folders import joint_path, write_folder

from hrc_learn.demos import check_dataset, load_demos, repair_dataset
from hrc_learn.demos.quality.repair import RepairOptions
from hrc_learn.geometry import quaternion

# Whole datasets are written and read; shapes are checked in the other tests of this folder.
pytestmark = pytest.mark.simulation

FRAMES, EPISODES = 90, 4
ARM = [f"joint_{i}" for i in range(1, 7)]


def arms():
    return [joint_path(FRAMES, 6, seed) for seed in range(EPISODES)]


def opening(most):
    """A gripper that closes within ten frames [0..most]."""
    return most * np.clip((np.arange(FRAMES) - 40) / 10, 0, 1)[:, None]


def write(root, states, names, actions=None):
    episodes = [{"observation.state": np.vstack([s[:1]] * 3 + [s[:-3]])} for s in states]
    for episode, action in zip(episodes, actions or states, strict=True):
        episode["action"] = action
    return write_folder(root, episodes, dict.fromkeys(("observation.state", "action"), names))


def words(root):
    return str(check_dataset(root))


@pytest.mark.parametrize("rounded", [True, False])
def test_a_gripper_that_ends_at_255_counts_bytes(tmp_path, rounded):
    grip = opening(255.0)
    grip = np.round(grip) if rounded else grip
    root = write(tmp_path / "set", [np.hstack([q, grip]) for q in arms()], [*ARM, "gripper"])
    with pytest.warns(UserWarning, match="byte"):
        demo = load_demos(root)[0]
    assert demo.gripper[[0, -1]] == pytest.approx([0, 1])


def test_a_gripper_in_ticks_is_asked_about(tmp_path):
    states = [np.hstack([np.round(2048 + 650 * q), 1700 + opening(500.0)]) for q in arms()]
    root = write(tmp_path / "set", states, [*ARM, "gripper"])
    with pytest.warns(UserWarning, match="gripper is in mm.*30 % sure"):
        load_demos(root)


def turning():
    """Position [m], and rotation matrices about a skew axis."""
    angle, axis = np.linspace(0.3, 1.4, FRAMES)[:, None], np.array([0.8, 0.5, 0.33])
    q = quaternion.exp(torch.from_numpy(angle * axis / np.linalg.norm(axis)))
    place = np.stack([0.4 + 0.1 * np.sin(angle[:, 0]), 0.1 * angle[:, 0], 0.3 + 0 * q[:, 0]], 1)
    return place, q.numpy(), quaternion.to_matrix(q).numpy()


@pytest.mark.parametrize("role", ["rotation_6d", "rotation_6d_rows"])
def test_six_numbers_of_a_rotation_are_columns_or_rows_as_is_said(tmp_path, role):
    place, q, R = turning()
    six = R[:, :2].reshape(-1, 6) if role.endswith("rows") else R[:, :, :2].mT.reshape(-1, 6)
    names = [*"xyz", *(f"rot6d_{k}" for k in range(6))]
    root = write(tmp_path / "set", [np.hstack([place, six])] * EPISODES, names)
    assert "rotation_6d_rows" in words(root)
    demo = load_demos(root, mapping={role: "observation.state[3:9]"})[0]
    np.testing.assert_allclose(demo.orientation[3:], q[:-3], atol=1e-6)


def test_fewer_names_than_components_are_no_names(tmp_path):
    root = write(tmp_path / "set", arms(), ARM[:4])
    assert "4 names for 6 components" in words(root)
    demo = load_demos(root)[0]
    assert demo.joint_position.shape == (FRAMES, 6)
    repair_dataset(root, tmp_path / "out", RepairOptions(trim=False))
    info = json.loads((tmp_path / "out/meta/info.json").read_text())
    assert info["features"]["observation.state"]["names"] is None
    np.testing.assert_array_equal(
        load_demos(tmp_path / "out")[0].joint_position, demo.joint_position
    )
