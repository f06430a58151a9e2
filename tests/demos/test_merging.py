"""Merged datasets: columns by name, units and tasks of the first, videos as they were."""

import json

import numpy as np
import pytest
from clean_sets import CAMERA, write_video
from lerobot_folders import FPS, joint_path, read_info, write_folder, write_info

from hrc_learn.cli._commands import main
from hrc_learn.demos import (
    DatasetError,
    DatasetWriter,
    check_dataset,
    load_demos,
    merge_datasets,
)

STATE, ACTION = "observation.state", "action"
NAMES = ["shoulder.pos", "elbow.pos", "wrist.pos"]
HOBBY = ["shoulder_pan.pos", "elbow_flex.pos", "wrist_roll.pos"]


def write(root, motion, names=NAMES, **options):
    episodes = [{STATE: q, ACTION: q + 0.01} for q in motion]
    return write_folder(root, episodes, {STATE: names, ACTION: names}, **options)


def states(root):
    return [np.asarray(demo.joint_position) for demo in load_demos(root)]


@pytest.mark.parametrize("version", ["v3.0", "v2.1", "v2.0"])
def test_columns_and_tasks_are_matched_by_name(tmp_path, version):
    first, second = joint_path(60), joint_path(50, seed=1)
    order = [2, 0, 1]
    write(tmp_path / "a", [first], tasks=["pour"])
    names = [NAMES[i] for i in order]
    write(
        tmp_path / "b",
        [second[:, order]] * 2,
        names,
        version=version,
        tasks=["stir", "pour"],
    )
    report = merge_datasets([tmp_path / "a", tmp_path / "b"], tmp_path / "new")
    assert (report.episodes, report.frames, report.tasks) == (3, 160, 2)
    assert any("matched by name" in note for note in report.notes)
    made = states(tmp_path / "new")
    for q, expected in zip(made, [first, second, second], strict=True):
        np.testing.assert_allclose(q, expected, atol=1e-6)
    assert [demo.task for demo in load_demos(tmp_path / "new")] == ["pour", "stir", "pour"]
    assert not check_dataset(tmp_path / "new").errors
    assert read_info(tmp_path / "new")["features"].keys() == {
        *(STATE, ACTION, "timestamp", "frame_index", "episode_index", "index", "task_index")
    }


def test_values_take_the_unit_of_the_first(tmp_path):
    q = joint_path(60), joint_path(60, seed=1)
    write(tmp_path / "rad", [q[0]], [f"{n}_rad" for n in "abc"])
    write(tmp_path / "deg", [np.rad2deg(q[1])], [f"{n}_deg" for n in "abc"])
    for one, other, values in (("rad", "deg", q), ("deg", "rad", q[::-1])):
        sets = [tmp_path / one, tmp_path / other]
        report = merge_datasets(sets, tmp_path / f"from {one}")
        note = f"converted from {other} to {one}"
        assert sum(text.endswith(note) for text in report.notes) == 2
        for made, expected in zip(states(report.path), values, strict=True):
            np.testing.assert_allclose(made, expected, atol=1e-5)


def test_components_and_features_that_one_lacks(tmp_path):
    write(tmp_path / "a", [joint_path(60)])
    write(tmp_path / "b", [joint_path(60)], ["shoulder.pos", "elbow.pos", "hand.pos"])
    with pytest.raises(DatasetError, match=r"lacks the component wrist\.pos"):
        merge_datasets([tmp_path / "a", tmp_path / "b"], tmp_path / "new")
    episode = {STATE: joint_path(60), ACTION: joint_path(60), "observation.x": joint_path(60)}
    write_folder(tmp_path / "c", [episode], {STATE: NAMES, ACTION: NAMES})
    report = merge_datasets([tmp_path / "c", tmp_path / "a"], tmp_path / "new")
    assert any(note.startswith("observation.x: left out") for note in report.notes)
    assert "observation.x" not in read_info(tmp_path / "new")["features"]


def sidecar(root, **units):
    (root / "meta/hrc_learn.json").write_text(json.dumps({"format": 1, "units": units}))


def in_between(root):
    """Values of a hobby arm that may be degrees or fractions of the range."""
    swing = np.sin(np.linspace(0, 6, 60))[:, None] * [95, 90, 80]
    write(root, [swing], HOBBY)


@pytest.mark.parametrize(
    ("other", "fault"),
    [
        (
            lambda r: write_folder(r, [{STATE: joint_path(60)}], {STATE: HOBBY}),
            "has no action, unlike the others",
        ),
        (
            lambda r: write(
                r, [*(joint_path(60, seed=k) for k in range(3)), 57.3 * joint_path(60)], HOBBY
            ),
            "deg among rad",
        ),
        (
            in_between,
            r"declare the unit with `hrc check .*/b --units joint_position UNIT --keep",
        ),
        (
            lambda r: (write(r, [joint_path(60)], HOBBY), sidecar(r, joint_position="%")),
            "joint_position in %, but joint_position in rad in .*/a: one cannot be converted",
        ),
        (
            lambda r: write(r, [joint_path(60)], [HOBBY[0], HOBBY[0], HOBBY[2]]),
            "one to one|lacks the component",
        ),
    ],
)
def test_what_does_not_fit_the_first_is_refused(tmp_path, other, fault):
    write(tmp_path / "a", [joint_path(60)], HOBBY)
    other(tmp_path / "b")
    with pytest.raises(DatasetError, match=fault):
        merge_datasets([tmp_path / "a", tmp_path / "b"], tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_one_dataset_is_nothing_to_merge(tmp_path):
    write(tmp_path / "a", [joint_path(60)])
    with pytest.raises(ValueError, match="two datasets or more"):
        merge_datasets([tmp_path / "a"], tmp_path / "new")


def test_a_dataset_is_not_merged_with_itself(tmp_path):
    write(tmp_path / "a", [joint_path(60)])
    (tmp_path / "link").symlink_to(tmp_path / "a")
    with pytest.raises(ValueError, match="given twice"):
        merge_datasets([tmp_path / "a", tmp_path / "link"], tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_other_robots_and_columns_without_names_are_noted(tmp_path):
    write(tmp_path / "a", [joint_path(60)])
    write(tmp_path / "b", [joint_path(60)], None)
    write_info(tmp_path / "b", read_info(tmp_path / "b") | {"robot_type": "other"})
    notes = merge_datasets([tmp_path / "a", tmp_path / "b"], tmp_path / "new").notes
    assert f"{tmp_path / 'b'}: robot other; the merged dataset names test" in notes
    for key in (STATE, ACTION):
        order = f"{tmp_path / 'b'}: {key} matched by position, as not both datasets name it"
        assert notes.count(order) == 1


def test_other_rates_are_refused_or_resampled(tmp_path, capsys):
    write(tmp_path / "a", [joint_path(60)])
    write(tmp_path / "b", [joint_path(31)], fps=FPS / 2)
    words = ["merge", str(tmp_path / "a"), str(tmp_path / "b"), "--out", str(tmp_path / "new")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["hrc"])
        with pytest.raises(SystemExit) as ended:
            main(*words)
        assert ended.value.code == 2
        assert "--fps 50" in capsys.readouterr().err
        assert not (tmp_path / "new").exists()
        with pytest.raises(SystemExit) as ended:
            main(*words, "--fps", "50", "--json", str(tmp_path / "n.json"))
        assert ended.value.code == 0
    made = states(tmp_path / "new")
    assert [len(q) for q in made] == [60, 61]
    np.testing.assert_allclose(made[1][::2], joint_path(31), atol=1e-3)


def with_video(root, names, order, frames=60):
    """A dataset of version 2.1 with one episode and its video."""
    q = joint_path(frames)[:, order]
    write(root, [q], [names[i] for i in order], version="v2.1", videos=[CAMERA])
    info = read_info(root)
    info["video_path"] = "videos/chunk-000/{video_key}/episode_{episode_index:06d}.mp4"
    info["features"][CAMERA]["shape"] = [48, 64, 3]
    write_info(root, info)
    write_video(root / f"videos/chunk-000/{CAMERA}/episode_000000.mp4", frames, FPS)
    return root


def test_videos_are_copied_bit_by_bit(tmp_path):
    a = with_video(tmp_path / "a", NAMES, [0, 1, 2])
    b = with_video(tmp_path / "b", NAMES, [1, 2, 0], frames=40)
    merge_datasets([a, b], tmp_path / "new")
    made = sorted((tmp_path / "new/videos").glob("**/*.mp4"))
    old = [next((root / "videos").glob("**/*.mp4")) for root in (a, b)]
    assert [path.read_bytes() for path in made] == [path.read_bytes() for path in old]
    info = read_info(b)
    info["features"][CAMERA]["shape"] = [24, 32, 3]
    write_info(b, info)
    with pytest.raises(DatasetError, match="--no-videos"):
        merge_datasets([a, b], tmp_path / "other")
    merge_datasets([a, b], tmp_path / "other", videos=False)
    assert CAMERA not in read_info(tmp_path / "other")["features"]


@pytest.mark.slow
def test_lerobot_reads_a_merged_dataset_with_its_statistics(tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    lerobot_dataset = pytest.importorskip("lerobot.datasets").LeRobotDataset
    a = with_video(tmp_path / "a", NAMES, [0, 1, 2])
    b = with_video(tmp_path / "b", NAMES, [1, 2, 0], frames=40)
    merge_datasets([a, b], tmp_path / "new")
    dataset = lerobot_dataset("local/new", root=tmp_path / "new", video_backend="pyav")
    assert (dataset.num_episodes, dataset.num_frames) == (2, 100)
    np.testing.assert_allclose(dataset[70][STATE].numpy(), joint_path(40)[10], atol=1e-6)
    assert dataset[99][CAMERA].shape == (3, 48, 64)
    values = np.concatenate([joint_path(60), joint_path(40)])
    np.testing.assert_allclose(dataset.meta.stats[STATE]["mean"], values.mean(0), atol=1e-5)
    np.testing.assert_allclose(dataset.meta.stats[STATE]["std"], values.std(0), atol=1e-5)
    np.testing.assert_allclose(dataset.meta.stats[STATE]["max"], values.max(0), atol=1e-5)


def test_what_this_package_records_can_be_merged(tmp_path):
    for name in "ab":
        with DatasetWriter(tmp_path / name, 50, "any", ["j"]) as writer:
            writer.start_episode(name)
            for k in range(40):
                writer.add_frame(joint_position=[0.01 * k])
            writer.save_episode()
    report = merge_datasets([tmp_path / "a", tmp_path / "b"], tmp_path / "new")
    assert (report.episodes, report.notes) == (2, [])
    assert not check_dataset(tmp_path / "new").errors


def test_a_report_counts_episodes_frames_and_tasks(tmp_path):
    write(tmp_path / "a", [joint_path(60)], tasks=["pour"])
    write(tmp_path / "b", [joint_path(31)] * 2, fps=FPS / 2, tasks=["stir", "pour"])
    write(tmp_path / "c", [joint_path(20)], tasks=["cut"])
    sets = [tmp_path / name for name in "abc"]
    with pytest.raises(DatasetError, match=r"runs at 25 fps, but .*a at 50: --fps 50 --no-v"):
        merge_datasets(sets, tmp_path / "new")
    report = merge_datasets(sets, tmp_path / "new", fps=50)
    assert str(report).splitlines() == [
        f"{tmp_path / 'b'}: resampled from 25 to 50 fps",
        f"{tmp_path / 'new'}: 4 episodes, 202 frames, 3 tasks",
    ]
    demos = load_demos(tmp_path / "new")
    assert [demo.task for demo in demos] == ["pour", "stir", "pour", "cut"]
    other = merge_datasets(sets, tmp_path / "slow", fps=25)
    assert (other.frames, read_info(tmp_path / "slow")["fps"]) == (30 + 31 + 31 + 10, 25)
    assert [note.split(": ")[1] for note in other.notes] == ["resampled from 50 to 25 fps"] * 2


def test_features_that_some_lack_are_named_with_those_datasets(tmp_path):
    q = joint_path(60)
    for name in "abc":
        more = {"observation.x": q, "observation.y": q} if name == "b" else {"observation.y": q}
        more = {} if name == "c" else more
        write_folder(
            tmp_path / name, [{STATE: q, ACTION: q, **more}], {STATE: NAMES, ACTION: NAMES}
        )
    notes = merge_datasets([tmp_path / name for name in "abc"], tmp_path / "new").notes
    a, c = tmp_path / "a", tmp_path / "c"
    assert f"observation.x: left out, as {a}, {c} lacks it" in notes
    assert f"observation.y: left out, as {c} lacks it" in notes


def test_types_and_shapes_are_those_of_the_first(tmp_path):
    """Columns of one width are alike, whatever their nesting; a width of its own is refused."""
    q = joint_path(60)
    write(tmp_path / "a", [q])
    write(tmp_path / "b", [q], dtype="float64")
    info = read_info(tmp_path / "b")
    info["features"][STATE]["shape"] = [1, 3]
    write_info(tmp_path / "b", info)
    merge_datasets([tmp_path / "a", tmp_path / "b"], tmp_path / "new")
    assert read_info(tmp_path / "new")["features"][STATE]["dtype"] == "float32"
    assert read_info(tmp_path / "new")["features"][STATE]["shape"] == [3]
    merge_datasets([tmp_path / "b", tmp_path / "a"], tmp_path / "double")
    assert read_info(tmp_path / "double")["features"][STATE]["dtype"] == "float64"
    np.testing.assert_allclose(states(tmp_path / "double")[0], q, rtol=1e-12)
    write(tmp_path / "c", [q[:, :2]], NAMES[:2])
    fault = rf"{STATE}: is float32 of shape \[2\], but float32 of shape \[3\] in .*/a$"
    with pytest.raises(DatasetError, match=fault):
        merge_datasets([tmp_path / "a", tmp_path / "c"], tmp_path / "other")


def test_a_single_column_needs_no_name_and_equal_sets_no_note(tmp_path):
    q = joint_path(60)
    for name, given in (("a", NAMES), ("b", NAMES)):
        episode = {STATE: q, ACTION: q, "observation.force": q[:, :1]}
        write_folder(tmp_path / name, [episode], {STATE: given, ACTION: given})
    assert merge_datasets([tmp_path / "a", tmp_path / "b"], tmp_path / "new").notes == []


@pytest.mark.parametrize("same", [True, False])
def test_details_of_videos_are_kept_where_all_datasets_agree(tmp_path, same):
    a = with_video(tmp_path / "a", NAMES, [0, 1, 2])
    b = with_video(tmp_path / "b", NAMES, [0, 1, 2], frames=40)
    for root, codec in ((a, "h264"), (b, "h264" if same else "av1")):
        info = read_info(root)
        info["features"][CAMERA]["info"] = {"video.codec": codec}
        write_info(root, info)
    merge_datasets([a, b], tmp_path / "new")
    assert ("info" in read_info(tmp_path / "new")["features"][CAMERA]) == same
