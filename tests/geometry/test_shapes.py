import numpy as np

from hrc_learn.geometry import arm_bodies


def rotation(axis: np.ndarray, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Quaternion (wxyz) and matrix of a turn, the matrix by Rodrigues' formula."""
    x, y, z = axis
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    R = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
    return np.array([np.cos(angle / 2), *np.sin(angle / 2) * axis]), R


def test_capsules_of_a_stick_arm_join_its_frames_in_every_posture():
    rng = np.random.default_rng(0)
    offsets = rng.normal(size=(3, 3))
    axes = rng.normal(size=(3, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    positions, orientations, matrices = [], [], []
    for angles in rng.uniform(-2, 2, size=(4, 3)):
        p, R, frames = np.zeros(3), np.eye(3), []
        for offset, axis, angle in zip(offsets, axes, angles, strict=True):
            p = p + R @ offset
            # Frames turn about axes fixed in space here: simple, and still a rigid arm
            # because each offset is carried by the frame before it.
            q, R = rotation(axis, angle)
            frames.append((p, q, R))
        positions.append([f[0] for f in frames])
        orientations.append([f[1] for f in frames])
        matrices.append([f[2] for f in frames])
    position = np.array(positions)
    bodies = arm_bodies(position, np.array(orientations), radius=0.05)
    assert [body.name for body in bodies] == ["link0", "link1", "link2"]
    for step in range(4):
        for i, body in enumerate(bodies):
            (capsule,) = body.capsules
            assert capsule.radius == 0.05
            R = np.eye(3) if i == 0 else matrices[step][i - 1]
            end = body.position[step] + R @ capsule.end
            np.testing.assert_allclose(end, position[step, i], atol=1e-12)
