import subprocess
import sys

import numpy as np
import pytest
from sample_runs import STEPS, camera_recording, sample_fit, sample_run

from hrc_learn.geometry import arm_bodies
from hrc_learn.viz import CameraRecording

SHORT = np.zeros(STEPS - 1)


@pytest.mark.parametrize(
    "change",
    [
        {"joint_position": np.zeros((STEPS - 1, 7))},
        {"weight_norm": SHORT},
        {"potentials": {"vision": SHORT}},
        {"safety": {"velocity limit": SHORT > 0}},
        {"camera": camera_recording(SHORT + 1.0)},
    ],
)
def test_a_series_of_another_length_is_named(change):
    # Set afterwards, since the checks of array shapes in tests would speak first.
    run = sample_run()
    ((name, value),) = change.items()
    object.__setattr__(run, name, value)
    with pytest.raises(ValueError, match=rf"time has {STEPS} samples, but {name}.*has 199"):
        run.__post_init__()


def test_a_body_of_another_length_is_named():
    (body,) = arm_bodies(np.zeros((5, 1, 3)), np.tile([1.0, 0, 0, 0], (5, 1, 1)))
    with pytest.raises(ValueError, match=r"link0\.position has 5"):
        sample_run(bodies=(body,))


def test_every_image_needs_a_time():
    camera = camera_recording(np.arange(10.0))
    with pytest.raises(ValueError, match="2 entries for 3 images"):
        CameraRecording(
            model=camera.model,
            feature=camera.feature,
            target=camera.target,
            image_time=np.zeros(2),
            images=camera.images,
        )


def test_pixel_error_is_unknown_where_feature_or_target_is():
    run = sample_run()
    assert run.camera is not None
    assert np.isnan(run.camera.error[[0, 19, 50, 59]]).all()
    expected = 40 * np.exp(-run.time[100]) * np.hypot(1.0, 0.5)
    assert run.camera.error[100] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"time": ()}, "hold 0, 3 and 3"),
        (
            {"reproductions": tuple(d[:-1] for d in sample_fit().demos)},
            "demonstration 0 has 80",
        ),
    ],
)
def test_a_fit_needs_matching_samples(change, message):
    with pytest.raises(ValueError, match=message):
        sample_fit(**change)


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


def test_importing_viz_imports_no_library_that_draws():
    code = (
        "import sys, hrc_learn.viz, hrc_learn.viz.panels, hrc_learn.viz.report;"
        "print({'rerun', 'matplotlib', 'cv2', 'PIL'} & sys.modules.keys())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "set()", done.stderr
