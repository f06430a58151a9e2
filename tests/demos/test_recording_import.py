"""Images, next states and the preview of an import."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recording_samples import WAVES as Q
from scipy.spatial.transform import Rotation

from hrc_learn.demos import DatasetError
from hrc_learn.demos.demonstration import Demonstration, float_array
from hrc_learn.demos.recording_files import Recording, array_field
from hrc_learn.demos.recording_import import ImportPlan, _images, _with_next_states, plan_import
from hrc_learn.demos.recording_meaning import understand
from hrc_learn.demos.recording_names import ImportOptions

pytestmark = pytest.mark.simulation


def test_images_are_read_in_batches_and_cropped():
    pixels = np.arange(100 * 17 * 19 * 3, dtype=np.uint8).reshape(100, 17, 19, 3)
    reads = []
    field = array_field("rgb", pixels)
    spied = replace(field, read=lambda a, b: (reads.append((a, b)), pixels[a:b])[1])
    index = np.array([0, 0, 5, 31, 32, 70])
    shown = [*_images(spied, index)]
    np.testing.assert_array_equal(np.stack(shown), pixels[index][:, :16, :18])
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


def test_complex_numbers_are_no_joint_positions(tmp_path):
    np.savez(tmp_path / "waves.npz", q=Q + 1j, t=np.arange(len(Q)) / 30)
    options = ImportOptions(columns={"joint_position": ["q"]}, time="t")
    with pytest.raises(DatasetError, match=r"waves.npz, q: holds no real numbers"):
        plan_import([tmp_path / "waves.npz"], options)
    with pytest.raises(ValueError, match="must be real numbers, but are complex"):
        float_array(np.full((2, 1), 1j))


@pytest.mark.parametrize(("brightest", "first"), [(1.0, 255), (200.0, 200)])
def test_black_images_at_the_beginning_do_not_decide_on_the_range(brightest, first):
    pixels = np.zeros((70, 16, 16, 3), np.float32)
    pixels[40:] = brightest
    shown = np.stack([*_images(array_field("rgb", pixels), np.arange(70))])
    assert not shown[:40].any()
    assert (shown[40:] == first).all()


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


def test_names_of_columns_that_no_file_takes_are_refused(tmp_path):
    np.savez(tmp_path / "own.npz", qpos=Q, time=np.arange(len(Q)))
    named = ImportOptions(fps=10)
    with pytest.raises(ValueError, match=r"--columns x, y: the files already name"):
        plan_import([tmp_path / "own.npz"], named, ["x", "y"])
    np.save(tmp_path / "bare.npy", Q)
    files = [tmp_path / "bare.npy"]
    names = [f"j{k}" for k in range(Q.shape[1])]
    assert {*names} <= {*plan_import(files, named, names).recordings[0].fields}


def test_a_value_that_is_not_finite_is_named_with_its_frame():
    q = Q.copy()
    q[7, 1] = np.nan
    plan = plan_of({"fps": 10}, qpos=q)
    with pytest.raises(DatasetError, match="is nan at frame 7: cut or mend"):
        next(plan.episodes())


def again(plan):
    """Options of a plan's mapping file."""
    content = json.loads(plan.template())
    return ImportOptions(**content | {"joint_names": tuple(content["joint_names"])})


@pytest.mark.parametrize(
    ("options", "tokens"),
    [
        ({"joint_position": "w", "action": "a"}, {"joint_position": ["w"], "action": ["a"]}),
        ({"joint_position": ["w[2]", "w[0:2]"]}, {"joint_position": ["w[2:3]", "w[0:2]"]}),
        ({"joint_position": ["w[1:3]", "v"]}, {"joint_position": ["w[1:3]", "v"]}),
        (
            {"position": "w[0:3]", "observation.other": ["w[3]", "a[0:2]"]},
            {"position": ["w[0:3]"], "observation.other": ["w[3:4]", "a[0:2]"]},
        ),
        ({"joint_position": ["w[2]", "w[1]"]}, {"joint_position": ["w[2:3]", "w[1:2]"]}),
    ],
)
def test_a_mapping_file_says_the_same_again(options, tokens):
    wide = np.hstack([Q, Q[:, :1] / 2])
    arrays = {"w": wide, "v": Q[:, :1], "a": Q, "time": np.arange(200) / 20}
    plan = plan_of({"columns": options}, **arrays)
    content = json.loads(plan.template())
    assert content["columns"] == tokens
    assert content["time"] == "time"
    given = again(plan)
    twin = replace(plan, meaning=understand(plan.recordings[:1], given), options=given)
    assert json.loads(twin.template()) == content
    for one, other in zip(plan.episodes(), twin.episodes(), strict=True):
        for name in one.demonstration.recorded:
            ours, theirs = (getattr(e.demonstration, name) for e in (one, other))
            np.testing.assert_array_equal(ours, theirs)


def episode_of(options=None, *, task="", **arrays):
    plan = plan_of(options, **arrays)
    plan = replace(plan, recordings=(replace(plan.recordings[0], task=task),))
    (one,) = plan.episodes()
    return one.demonstration


@pytest.mark.parametrize(
    ("step", "given", "fps"),
    [(1 / 30, None, 30), (0.0334, None, 30), (0.45, None, 2), (2.0, None, 1), (0.05, 50, 50)],
)
def test_an_episode_has_a_whole_frame_rate_and_its_true_stamps(step, given, fps):
    time = 1e9 + 5 + np.arange(200) * step
    demo = episode_of({"fps": given, "units": {"time": "s"}}, qpos=Q, time=time)
    assert demo.fps == fps
    assert demo.start_time == time[0]
    np.testing.assert_allclose(demo.time, np.arange(200) * step, atol=1e-6)


def test_the_task_is_the_callers_then_the_files_then_its_name():
    given = {"fps": 10}
    assert episode_of(given | {"task": "pour"}, task="stir", qpos=Q).task == "pour"
    assert episode_of(given, task="stir", qpos=Q).task == "stir"
    assert episode_of(given, qpos=Q).task == "run"


def test_quantities_are_in_si_units_and_what_is_kept_is_as_recorded():
    opening = 40 + 30 * Q[:, 0]
    units = {"joint_position": "deg", "gripper": "mm"}
    grip = np.hstack([20 * Q, opening[:, None]])
    demo = episode_of(
        {"fps": 10, "units": units}, qpos=20 * Q, gripper=opening, action=grip, other=Q
    )
    np.testing.assert_allclose(demo.joint_position, np.deg2rad(20 * Q))
    np.testing.assert_allclose(demo.command_position, np.deg2rad(20 * Q))
    np.testing.assert_allclose(demo.gripper, 1e-3 * opening)
    # The gripper's command has the unit of the gripper.
    np.testing.assert_allclose(demo.extra["action"][:, 0], 1e-3 * opening)
    kept = {"joint_position": "q", "observation.more": "other", "action": "u"}
    demo = episode_of({"fps": 10, "columns": kept}, q=Q, other=7 * Q, u=5 * Q)
    np.testing.assert_array_equal(demo.extra["observation.more"], 7 * Q)
    np.testing.assert_array_equal(demo.extra["action"], 5 * Q)


def test_a_preview_has_a_row_for_each_field_and_a_line_for_each_reason():
    images = np.zeros((200, 16, 24, 3), np.uint8)
    coded = np.array([b"\xff\xd8\xff"] * 200, object)
    plan = plan_of(
        {"units": {"joint_position": "deg"}},
        qpos=20 * Q,
        state=Q,
        reward=Q[:, 0],
        done=Q[:, 0],
        odd=Q,
        cam=images,
        top=coded,
        time=np.arange(200) / 20,
        action=Q[:, :2],
    )
    lines = [*plan.lines()]
    rows = {line.split("  ")[0]: line.split() for line in lines}
    assert lines[0].split() == ["fields", "understood", "as", "unit", "sure", "evidence"]
    assert rows["qpos"] == ["qpos", "joint_position", "of", "3", "deg", "100", "%", "given"]
    assert rows["cam"] == ["cam", "camera", "cam", "16x24x3"]
    assert rows["top"] == ["top", "camera", "top", "image", "files"]
    assert rows["time"] == ["time", "time", "s", "by", "its", "name"]
    assert rows["action"][:5] == ["action", "action,", "as", "recorded", "?"]
    left = [line for line in lines if line.startswith("left out: ")]
    assert "left out: reward, done (a counter, a reward, or the next frame)" in left
    assert len(left) == len({*plan.meaning.left_out.values()}) == 3
    assert not any("no commands" in line for line in lines)
    assert plan.has_actions
    assert plan.counts()["understood"] == 3
