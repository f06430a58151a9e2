import numpy as np
import pytest
from sample_runs import STEPS, camera_recording, sample_run

from hrc_learn.geometry import Body
from hrc_learn.log import CameraRecording

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
    body = Body(name="link0", position=np.zeros((5, 3)), orientation=np.zeros((5, 4)))
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
