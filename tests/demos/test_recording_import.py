"""Images, next states and the preview of an import."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recording_samples import WAVES as Q
from scipy.spatial.transform import Rotation

from hrc_learn.demos import DatasetError
from hrc_learn.demos.demonstration import Demonstration
from hrc_learn.demos.recording_files import Recording, array_field
from hrc_learn.demos.recording_import import ImportPlan, _images, _with_next_states
from hrc_learn.demos.recording_meaning import understand
from hrc_learn.demos.recording_names import ImportOptions

pytestmark = pytest.mark.simulation


def test_images_are_read_in_batches_and_cropped():
    pixels = np.arange(100 * 17 * 18 * 3, dtype=np.uint8).reshape(100, 17, 18, 3)
    reads = []
    field = array_field("rgb", pixels)
    spied = replace(field, read=lambda a, b: (reads.append((a, b)), pixels[a:b])[1])
    index = np.array([0, 0, 5, 31, 32, 70])
    shown = [*_images(spied, index, (16, 18))]
    np.testing.assert_array_equal(np.stack(shown), pixels[index][:, :16])
    assert reads == [(0, 32), (32, 33), (70, 71)]


@pytest.mark.parametrize(
    ("pixels", "first"),
    [
        (np.full((2, 16, 16, 3), 0.5), 128),
        (np.full((2, 16, 16, 3), 1.0), 255),
        (np.full((2, 16, 16, 3), 1.5), 2),
        (np.full((2, 16, 16, 3), 300.0), 255),
        (np.full((2, 16, 16, 1), 7, np.uint8), 7),
        (np.full((2, 16, 16, 4), 7, np.uint8), 7),
        (np.full((2, 3, 16, 16), 7, np.uint8), 7),
        (np.full((2, 16, 16), 7, np.uint8), 7),
    ],
)
def test_images_of_any_form_become_rgb(pixels, first):
    shown = [*_images(array_field("rgb", pixels), np.array([0, 1]))]
    assert all(image.shape == (16, 16, 3) for image in shown)
    assert all(image.dtype == np.uint8 for image in shown)
    assert {int(v) for image in shown for v in image.ravel()} == {first}


def test_the_next_state_is_the_action_where_none_was_recorded():
    time = np.arange(4.0)
    q = np.arange(8.0).reshape(4, 2)
    demo = Demonstration(time=time, joint_position=q, joint_names=("a", "b"), fps=1)
    np.testing.assert_array_equal(_with_next_states(demo).command_position, q[[1, 2, 3, 3]])
    turn = Rotation.from_rotvec(np.outer(time / 9, [1, 0, 0]))
    pose = Demonstration(
        time=time,
        position=np.arange(12.0).reshape(4, 3),
        orientation=turn.as_quat(scalar_first=True),
        fps=1,
    )
    action = _with_next_states(pose).extra["action"]
    np.testing.assert_array_equal(action[:, :3], pose.position[[1, 2, 3, 3]])
    np.testing.assert_allclose(action[:, 3], [1 / 9, 2 / 9, 3 / 9, 3 / 9])
    bare = Demonstration(time=time, extra={"observation.state": q}, fps=1)
    np.testing.assert_array_equal(_with_next_states(bare).extra["action"], q[[1, 2, 3, 3]])


def plan_of(options=None, **arrays):
    fields = {name: array_field(name, np.asarray(array)) for name, array in arrays.items()}
    one = Recording(file=Path("run.npz"), fields=fields)
    given = ImportOptions(**(options or {}))
    return ImportPlan(recordings=(one, one), meaning=understand([one], given), options=given)


def test_a_preview_counts_and_names_ranges_of_fields():
    wide = np.hstack([Q, Q, Q])
    columns = {"joint_position": ["w[0:3]"], "joint_velocity": ["w[6:9]"], "action": "a"}
    plan = plan_of({"columns": columns, "fps": 10}, w=wide, a=Q, odd=Q[:, :1])
    assert plan.counts() == {
        "episodes": 2, "frames": 400, "understood": 2, "kept": 1, "left_out": 1,
    }  # fmt: skip
    text = "\n".join(plan.lines())
    assert "w[0:3]" in text
    assert "w[6:9]" in text
    assert "joint_position of 3" in text
    assert "2 episodes of 400 frames in all" in text
    assert "no commands" not in text
    assert '"a"' in plan.template()
    bare = plan_of({"fps": 10}, qpos=Q)
    assert "no commands were recorded: the next states are the actions" in [*bare.lines()]
    assert "no commands were recorded: the dataset has no actions" in [*bare.lines(False)]
    sure = [line.split() for line in bare.lines() if line.startswith("qpos")]
    assert sure[0][:6] == ["qpos", "joint_position", "of", "3", "rad", "95"]


def test_a_value_that_is_not_finite_is_named_with_its_frame():
    q = Q.copy()
    q[7, 1] = np.nan
    plan = plan_of({"fps": 10}, qpos=q)
    with pytest.raises(DatasetError, match="is nan at frame 7: cut or mend"):
        next(plan.episodes())
