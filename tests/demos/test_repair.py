"""A repair makes the permitted changes, and its result is a sound dataset."""

import json
import re
from fractions import Fraction
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from clean_sets import CAMERA, write_set
from lerobot_folders import (
    FPS,
    joint_path,
    one_step_of_act,
    read_info,
    rewrite,
    write_folder,
    write_info,
)
from scipy.spatial.transform import Rotation

from hrc_learn.demos import (
    DatasetError,
    DatasetWriter,
    RepairOptions,
    check_dataset,
    load_demos,
    repair_dataset,
)
from hrc_learn.demos.preprocessing import regular_grid
from hrc_learn.demos.read.contract import keep_contract

STATE = "observation.state"
NAMES = ["a.pos", "b.pos", "c.pos"]
VERSIONS = ["v3.0", "v2.1", "v2.0"]
QUIET = RepairOptions(trim=False, drop_late=False, unwrap=False, fix_signs=False)


def write(root, motions, names=NAMES, **options):
    options = {"dtype": "float64", **options}
    return write_folder(root, [{STATE: q} for q in motions], {STATE: names}, **options)


def repaired(tmp_path, motions, options, names=NAMES, **how):
    """Written, repaired, and found sound; what was said and what is there now."""
    root = write(tmp_path / "old", motions, names, **how)
    before = {p: p.read_bytes() for p in sorted(root.glob("**/*")) if p.is_file()}
    report = repair_dataset(root, tmp_path / "new", options)
    assert {p: p.read_bytes() for p in sorted(root.glob("**/*")) if p.is_file()} == before
    assert check_dataset(tmp_path / "new").ok, str(check_dataset(tmp_path / "new"))
    return report, load_demos(tmp_path / "new")


def trimmed(report):
    """Frames that were trimmed from the first episode: at its beginning and at its end."""
    cut = re.match(r"trimmed (\S+) s at the beginning, (\S+) s at", report.changes[0][0])
    return tuple(round(float(seconds) * FPS) for seconds in cut.groups())


@pytest.mark.parametrize("version", VERSIONS)
def test_a_repair_adds_no_feature_where_the_clock_is_regular(tmp_path, version):
    root = write(tmp_path / "old", [joint_path(60)], version=version)
    repair_dataset(root, tmp_path / "new")
    assert read_info(tmp_path / "new")["features"].keys() == read_info(root)["features"].keys()


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("without", [(), ("frame_index", "index", "task_index")])
def test_what_is_sound_stays_as_it_is_in_every_version(tmp_path, version, without):
    motions = [joint_path(60, seed=0), joint_path(45, seed=1)]
    how = {"version": version, "without": without, "tasks": ("reach", "place")}
    report, demos = repaired(tmp_path, motions, RepairOptions(trim=False), **how)
    assert report.changed == 0
    assert "episode 1: unchanged" in str(report)
    info = read_info(tmp_path / "new")
    assert (info["codebase_version"], info["robot_type"]) == ("v3.0", "test")
    assert [demo.task for demo in demos] == ["reach", "place"]
    for demo, q in zip(demos, motions, strict=True):
        np.testing.assert_array_equal(demo.joint_position, q)
        np.testing.assert_allclose(demo.time, np.arange(len(q)) / FPS, atol=1e-6)


@pytest.mark.parametrize("version", VERSIONS)
def test_standing_still_is_trimmed(tmp_path, version):
    q = joint_path(100, seed=2)
    waiting = np.concatenate([np.repeat(q[:1], 70, 0), q, np.repeat(q[-1:], 90, 0)])
    options = RepairOptions()
    report, (demo,) = repaired(tmp_path, [waiting], options, version=version)
    assert report.changes[0][0].startswith("trimmed 1.")
    assert 100 <= len(demo) <= 130
    assert report.frames_before == 260
    # Cut out in one piece.
    start, stop = trimmed(report)
    assert len(demo) == 260 - start - stop
    np.testing.assert_array_equal(demo.joint_position, waiting[start : start + len(demo)])


def test_repeated_frames_go_and_the_stamps_of_the_others_stay(tmp_path):
    q = joint_path(60)
    stalled = np.repeat(q[::2], 2, axis=0)
    options = RepairOptions(trim=False, drop_repeats=True)
    report, (demo,) = repaired(tmp_path, [stalled], options)
    assert report.changes == {0: ("dropped 30 repeated frames: 60 -> 30",)}
    np.testing.assert_array_equal(demo.joint_position, q[::2])
    np.testing.assert_allclose(demo.time, 2 * np.arange(30) / FPS, atol=1e-6)


def test_pauses_stay(tmp_path):
    q = joint_path(60)
    pausing = np.concatenate(
        [q[:30], np.repeat(q[30:31], 20, axis=0), q[31:40], q[40:41], q[40:]]
    )
    options = RepairOptions(trim=False, drop_repeats=True)
    report, (demo,) = repaired(tmp_path, [pausing], options)
    assert report.changes == {0: ("dropped 1 repeated frames: 80 -> 79",)}
    np.testing.assert_array_equal(demo.joint_position, np.delete(pausing, 60, axis=0))


def without_tasks(root):
    (root / "meta/tasks.jsonl").write_text("")
    lines = [{"episode_index": k, "length": 60} for k in range(2)]
    text = "".join(json.dumps(line) + "\n" for line in lines)
    (root / "meta/episodes.jsonl").write_text(text)


def set_rows(key, change):
    """Change a column of the first episode by a function of its values."""

    def damage(root):
        def replace(table):
            values = np.array(table.column(key).to_pylist())
            column = pa.array(list(change(values)), table.schema.field(key).type)
            return table.set_column(table.schema.get_field_index(key), key, column)

        rewrite(root / "data/chunk-000/episode_000000.parquet", replace)

    return damage


@pytest.mark.parametrize(
    ("damage", "options", "fault", "place"),
    [
        (lambda r: (r / "meta/episodes.jsonl").write_text(""), {}, "holds no episodes", None),
        (set_rows("task_index", lambda v: v + 99), {}, "task 99 is not in the list", 0),
        (
            set_rows(STATE, lambda v: np.nan * v),
            {"drop_bad_frames": True},
            "not finite: fewer than two frames are left",
            None,
        ),
        (
            set_rows(STATE, lambda v: np.where(np.arange(60)[:, None] == 17, np.inf, v)),
            {},
            "holds values that are not finite in 1 frames",
            17,
        ),
        (lambda _: None, {"fps": 0.5}, "1.18 s hold no two frames at 0.5 Hz", None),
        (set_rows(STATE, np.rad2deg), {}, "deg among rad", None),
    ],
)
def test_what_cannot_be_repaired_is_named_or_left_out(tmp_path, damage, options, fault, place):
    motions = [joint_path(60, seed=k) for k in range(4)]
    root = write(tmp_path / "old", motions, version="v2.1", tasks=("a", "b"))
    damage(root)
    with pytest.raises(DatasetError, match=fault) as raised:
        repair_dataset(root, tmp_path / "new", RepairOptions(**options))
    assert raised.value.frame == place
    assert not (tmp_path / "new").exists()
    if raised.value.episode is not None and "fps" not in options:
        options |= {"drop_bad_episodes": True, "dry_run": True}
        report = repair_dataset(root, tmp_path / "new", RepairOptions(**options))
        assert [*report.left_out] == [raised.value.episode]
        assert fault in report.left_out[0]


def test_only_a_rate_above_zero_can_be_resampled_to():
    for fps in (0, np.inf):
        with pytest.raises(ValueError, match=f"fps must be positive.*, got {fps}"):
            RepairOptions(fps=fps)
        with pytest.raises(ValueError, match=f"fps must be positive.*, got {fps}"):
            regular_grid(1.0, fps)


def test_offsets_that_are_not_finite_are_refused():
    for angle in (np.nan, np.inf):
        with pytest.raises(ValueError, match="offsets must be finite angles"):
            RepairOptions(offsets={"joint1": 1.0, "joint2": angle})


def test_stamps_of_lerobot_that_stall_are_counted_anew(tmp_path):
    root = write(tmp_path / "old", [joint_path(60)] * 2, version="v2.1")
    set_rows("timestamp", lambda v: np.concatenate([v[:20], v[19:-1]]))(root)
    report = repair_dataset(root, tmp_path / "new", QUIET)
    assert report.changes[0] == ("renewed the stamps: 1 steps that did not increase -> 0",)
    np.testing.assert_allclose(load_demos(tmp_path / "new")[0].time, np.arange(60) / FPS)


def test_a_dataset_of_neither_joints_nor_poses_is_not_trimmed(tmp_path):
    around = {"observation.environment_state": np.repeat(joint_path(2), 60, axis=0)}
    names = {"observation.environment_state": ["height_map_1", "height_map_2", "light"]}
    root = write_folder(tmp_path / "old", [around], names, version="v2.1")
    assert repair_dataset(root, tmp_path / "new").frames == 120


def test_card_licence_and_notes_of_others_are_copied(tmp_path):
    root = write(tmp_path / "old", [joint_path(60)] * 2, version="v2.1")
    without_tasks(root)
    for name in ("README.md", "LICENSE.txt", "meta/robot.json"):
        (root / name).write_text(name)
    (root / "meta/scan.json").write_bytes(bytes(2**20))
    (root / "meta/linked.json").symlink_to("robot.json")
    report = repair_dataset(root, tmp_path / "new")
    new = tmp_path / "new"
    assert [(new / n).read_text() for n in ("README.md", "LICENSE.txt", "meta/robot.json")] == [
        *("README.md", "LICENSE.txt", "meta/robot.json")
    ]
    assert not (new / "meta/scan.json").exists()
    assert not (new / "meta/linked.json").exists()
    assert read_info(new)["codebase_version"] == "v3.0"  # ours, not the old one
    assert "no task is listed: every episode shows 'unnamed task' now" in report.notes
    assert load_demos(new)[1].task == "unnamed task"


def test_images_are_not_resampled(tmp_path):
    with pytest.raises(DatasetError, match="its images cannot be resampled") as raised:
        repair_dataset(with_others(tmp_path / "old"), tmp_path / "new", RepairOptions(fps=25))
    assert raised.value.key == "observation.images.front"


def test_an_episode_whose_video_is_missing_is_named(tmp_path):
    root = write_set(tmp_path / "old", "v2.1", camera=True)
    next((root / "videos").glob("**/episode_000002.mp4")).unlink()
    with pytest.raises(DatasetError, match="video of this episode is missing") as raised:
        repair_dataset(root, tmp_path / "new", QUIET)
    assert (raised.value.episode, raised.value.key) == (2, CAMERA)


def test_frames_stamped_no_later_go(tmp_path):
    stamps = np.arange(60) / FPS
    stamps[20:23] = stamps[19] - 0.01
    episode = {STATE: joint_path(60), "observation.time": stamps[:, None]}
    root = write_folder(tmp_path / "old", [episode], {STATE: NAMES}, dtype="float64")
    with pytest.raises(DatasetError, match="stamps must increase"):
        repair_dataset(root, tmp_path / "new", QUIET)
    report = repair_dataset(root, tmp_path / "new", RepairOptions(trim=False))
    assert report.changes == {0: ("dropped 3 frames whose stamp does not increase: 60 -> 57",)}
    np.testing.assert_allclose(
        load_demos(tmp_path / "new")[0].time, np.delete(stamps, [20, 21, 22])
    )


def test_resampling_gives_a_regular_grid_at_any_rate(tmp_path):
    stamps = np.cumsum(np.random.default_rng(0).uniform(0.012, 0.028, 150))
    wave = np.stack([np.sin(stamps), np.cos(stamps), stamps], axis=1)
    episode = {
        STATE: wave,
        "observation.time": stamps[:, None],
        "observation.flag": stamps[:, None] > 1,
    }
    root = write_folder(tmp_path / "old", [episode], {STATE: NAMES}, dtype="float64")
    report = repair_dataset(root, tmp_path / "new", RepairOptions(trim=False, fps=100))
    assert report.changes[0][0].startswith("resampled 150 frames to ")
    assert read_info(tmp_path / "new")["fps"] == 100
    (demo,) = load_demos(tmp_path / "new")
    np.testing.assert_allclose(np.diff(demo.time), 0.01, atol=1e-6)
    t = demo.time + stamps[0]
    expected = np.stack([np.sin(t), np.cos(t), t], axis=1)
    np.testing.assert_allclose(demo.joint_position[3:-3], expected[3:-3], atol=1e-6)
    assert set(np.unique(demo.extra["observation.flag"])) == {0.0, 1.0}


@pytest.mark.parametrize(
    ("turn", "unit"), [(2 * np.pi, "rad"), (360.0, "deg"), (4096.0, "tick")]
)
def test_encoders_that_wrapped_are_unwrapped_in_their_own_unit(tmp_path, turn, unit):
    q = turn / (2 * np.pi) * (joint_path(60) + 1)
    q[30:, 1] += turn
    q[45:, 1] -= turn
    q[20:, 2] += 0.3 * turn  # a jump that is no turn
    root = write(tmp_path / "old", [q])
    options = RepairOptions(trim=False)
    report = repair_dataset(root, tmp_path / "new", options, units={"joint_position": unit})
    assert report.changes[0][0].startswith("unwrapped joint_position (b): largest step ")
    (demo,) = load_demos(tmp_path / "new")  # the unit is remembered
    smooth = q.copy()
    smooth[30:45, 1] -= turn
    np.testing.assert_allclose(demo.joint_position, 2 * np.pi / turn * smooth, rtol=1e-12)


@pytest.mark.parametrize("names", [["qw", "qx", "qy", "qz"], ["qx", "qy", "qz", "qw"]])
@pytest.mark.parametrize("fps", [None, 80])
def test_signs_of_quaternions_are_fixed_on_disk(tmp_path, names, fps):
    turn = Rotation.from_rotvec(np.linspace(0, 2, 60)[:, None] * np.array([0.6, 0, 0.8]))
    q = turn.as_quat(scalar_first=names[0] == "qw")
    q[17:40] *= -1
    pose = np.hstack([joint_path(60), q])
    options = RepairOptions(trim=False, fps=fps)
    report, (demo,) = repaired(tmp_path, [pose], options, ["x", "y", "z", *names])
    assert report.changes[0][0].startswith("fixed 2 jumps of the sign of quaternion")
    table = pq.read_table(tmp_path / "new/data/chunk-000/file-000.parquet")
    raw = np.array(table.column(STATE).to_pylist())[:, 3:]
    assert (np.sum(raw[1:] * raw[:-1], axis=1) > 0).all()
    expected = Rotation.from_rotvec(demo.time[:, None] * FPS / 59 * 2 * np.array([0.6, 0, 0.8]))
    found = Rotation.from_quat(demo.orientation, scalar_first=True)
    assert (found.inv() * expected).magnitude().max() < 1e-5


def test_rotation_vectors_are_unwrapped(tmp_path):
    turn = Rotation.from_rotvec(np.linspace(2, 5, 60)[:, None] * np.array([0, 0, 1]))
    pose = np.hstack([joint_path(60), turn.as_rotvec()])
    names = ["x", "y", "z", "wx", "wy", "wz"]
    report, _ = repaired(tmp_path, [pose], RepairOptions(trim=False), names)
    assert report.changes[0][0].startswith("unwrapped rotation_vector (2): largest step ")
    table = pq.read_table(tmp_path / "new/data/chunk-000/file-000.parquet")
    raw = np.array(table.column(STATE).to_pylist())[:, 5]
    np.testing.assert_allclose(raw, np.linspace(2, 5, 60), atol=1e-9)


@pytest.mark.parametrize("frames", [1, 2])
def test_an_episode_too_short_to_move_stays(tmp_path, frames):
    motions = [joint_path(60), joint_path(60)[:frames]]
    root = write(tmp_path / "old", motions)
    repair_dataset(root, tmp_path / "new")
    assert read_info(tmp_path / "new")["total_episodes"] == 2


def test_bad_frames_go_only_when_asked_for(tmp_path):
    q = joint_path(60)
    q[12, 1], q[40:42] = np.nan, np.inf
    root = write(tmp_path / "old", [joint_path(50, seed=1), q])
    with pytest.raises(
        DatasetError, match=r"not finite in 3 frames.*--drop bad-frames"
    ) as raised:
        repair_dataset(root, tmp_path / "new", QUIET)
    assert (raised.value.episode, raised.value.frame) == (1, 12)
    assert list(tmp_path.iterdir()) == [root]
    report = repair_dataset(
        root, tmp_path / "new", RepairOptions(trim=False, drop_bad_frames=True)
    )
    assert report.changes[1] == ("dropped 3 frames with values that are not finite",)
    assert check_dataset(tmp_path / "new").ok
    demo = load_demos(tmp_path / "new")[1]
    sound = np.isfinite(q).all(1)
    np.testing.assert_array_equal(demo.joint_position, q[sound])
    np.testing.assert_allclose(demo.time, np.arange(60)[sound] / FPS, atol=1e-6)


def test_bad_episodes_go_only_when_asked_for(tmp_path):
    motions = [joint_path(50, seed=i) for i in range(4)]
    motions[1][7] = np.nan
    root = write(tmp_path / "old", motions, version="v2.1", tasks=("a", "b", "c", "d"))
    (root / "data/chunk-000/episode_000002.parquet").write_bytes(b"PAR1")
    with pytest.raises(DatasetError, match="episode 1"):
        repair_dataset(root, tmp_path / "new")
    options = RepairOptions(trim=False, drop_bad_episodes=True)
    report = repair_dataset(root, tmp_path / "new", options)
    assert list(report.changes) == [0, 3]
    assert list(report.left_out) == [1, 2]
    assert "truncated" in report.left_out[2]
    assert "episode 3 (now 1): unchanged" in str(report)
    assert check_dataset(tmp_path / "new").ok
    assert [demo.task for demo in load_demos(tmp_path / "new")] == ["a", "d"]


def test_a_dataset_of_nothing_but_bad_episodes_is_none(tmp_path):
    root = write(tmp_path / "old", [np.ones((60, 3))])
    with pytest.raises(
        DatasetError, match=r"episode 0: .*rests all the time|fewer than two frames"
    ):
        repair_dataset(root, tmp_path / "new")
    with pytest.raises(DatasetError, match="no episode could be repaired"):
        repair_dataset(root, tmp_path / "new", RepairOptions(drop_bad_episodes=True))
    assert list(tmp_path.iterdir()) == [root]


def test_nothing_is_overwritten(tmp_path):
    root = write(tmp_path / "old", [joint_path(60)])
    with pytest.raises(FileExistsError, match="exists"):
        repair_dataset(root, root)
    assert len(load_demos(root)) == 1


def with_videos(root: Path) -> Path:
    """Two episodes whose images grow brighter by 5 a frame; the arm waits 0.5 s at first."""
    cameras = {"front": (32, 32)}
    with DatasetWriter(root, 50, "any", ["a"], cameras=cameras) as writer:
        for _ in range(2):
            writer.start_episode("look")
            for k in range(50):
                image = np.full((32, 32, 3), 5 * k, np.uint8)
                q = [0.02 * max(k - 25, 0)]
                writer.add_frame(joint_position=q, images={"front": image})
            writer.save_episode()
    return root


def test_trimmed_episodes_keep_the_part_of_their_video(tmp_path):
    root = with_videos(tmp_path / "old")
    repair_dataset(root, tmp_path / "new")
    assert check_dataset(tmp_path / "new").ok
    demos = load_demos(tmp_path / "new")
    rows = pq.read_table(tmp_path / "new/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    for row, demo in zip(rows, demos, strict=True):
        start = row["videos/observation.images.front/from_timestamp"]
        assert 0.3 < start < 0.6
        assert start == pytest.approx(demo.start_time)
        assert row["videos/observation.images.front/to_timestamp"] == pytest.approx(
            start + len(demo) / 50
        )
    videos = sorted((tmp_path / "new/videos").glob("**/*.mp4"))
    assert [v.read_bytes() for v in videos] == [
        v.read_bytes() for v in sorted((root / "videos").glob("**/*.mp4"))
    ]


def test_statistics_of_images_stay_where_no_frame_goes(tmp_path):
    root = with_videos(tmp_path / "old")
    repair_dataset(root, tmp_path / "new", RepairOptions(trim=False))
    old, new = (
        pq.read_table(made / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
        for made in (root, tmp_path / "new")
    )
    for name in ("count", "mean"):
        key = f"stats/observation.images.front/{name}"
        assert [row[key] for row in new] == [row[key] for row in old]


@pytest.mark.parametrize("options", [RepairOptions(trim=False, fps=25)])
def test_videos_that_would_need_new_frames_are_refused_or_left_out(tmp_path, options):
    root = with_videos(tmp_path / "old")
    with pytest.raises(DatasetError, match=r"encoded anew.*videos=False"):
        repair_dataset(root, tmp_path / "new", options)
    without = RepairOptions(trim=False, fps=25, videos=False)
    report = repair_dataset(root, tmp_path / "new", without)
    assert "observation.images.front: videos left out" in report.notes
    assert not (tmp_path / "new/videos").exists()
    assert check_dataset(tmp_path / "new").ok


def test_videos_that_are_not_there_are_no_longer_declared(tmp_path):
    how = {"videos": ["observation.images.front"], "version": "v2.1"}
    report, _ = repaired(tmp_path, [joint_path(60)], RepairOptions(trim=False), **how)
    assert any("no video of it is here" in note for note in report.notes)
    assert "observation.images.front" not in read_info(tmp_path / "new")["features"]


@pytest.mark.slow
@pytest.mark.parametrize("version", VERSIONS)
def test_lerobot_opens_what_it_refused(tmp_path, monkeypatch, version):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    lerobot_dataset = pytest.importorskip("lerobot.datasets").LeRobotDataset
    q = joint_path(60)
    q[30] = np.nan
    options = RepairOptions(trim=False, drop_bad_frames=True)
    how = {"version": version, "videos": ["observation.images.front"], "dtype": "float32"}
    repaired(tmp_path, [joint_path(50, seed=1), q], options, **how)
    dataset = lerobot_dataset("local/new", root=tmp_path / "new", video_backend="pyav")
    assert (dataset.num_episodes, dataset.num_frames) == (2, 109)
    np.testing.assert_allclose(dataset[108][STATE].numpy(), q[59], atol=1e-6)


@pytest.mark.slow
def test_lerobot_decodes_the_images_of_the_frames_that_are_left(tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    lerobot_dataset = pytest.importorskip("lerobot.datasets").LeRobotDataset
    root = with_videos(tmp_path / "old")
    repair_dataset(root, tmp_path / "new")
    old = lerobot_dataset("local/old", root=root, video_backend="pyav")
    new = lerobot_dataset("local/new", root=tmp_path / "new", video_backend="pyav")
    first = round(load_demos(tmp_path / "new")[0].start_time * 50)
    key = "observation.images.front"
    for k in (0, 5, 15):
        np.testing.assert_array_equal(new[k][key].numpy(), old[first + k][key].numpy())


def commanded(q, command, hand):
    return {STATE: np.hstack([q, hand]), "action": np.hstack([q + command, hand])}


HAND = [*NAMES, "left_finger_0.pos"]


def test_what_switches_between_levels_is_no_encoder_that_wrapped(tmp_path):
    """A hand that opens and closes between -3 and 3 rad stays as it is, state and command."""
    q, levels = joint_path(60), np.where(np.arange(60) // 9 % 2, 3.0, -3.0)[:, None]
    noisy = levels + 0.01 * np.sin(np.arange(60))[:, None]
    episodes = [commanded(q, 0.01, levels), commanded(q + 0.1, 0.01, noisy)]
    names = {STATE: HAND, "action": HAND}
    root = write_folder(tmp_path / "old", episodes, names, dtype="float64")
    report = repair_dataset(root, tmp_path / "new", RepairOptions(trim=False))
    assert report.changed == 0
    report = repair_dataset(root, tmp_path / "named", RepairOptions(trim=False, fps=30))
    for row in load_demos(tmp_path / "named", episodes=[0])[0].joint_position[:, 3]:
        assert abs(row) == 3.0  # resampled, with nothing in between


def test_joints_are_not_torn_from_their_commands(tmp_path):
    q = 4 * np.linspace(0, 1, 60)[:, None] * np.ones(3)
    wrapped = (q + np.pi) % (2 * np.pi) - np.pi
    episode = {STATE: wrapped, "action": (q + 0.05 + np.pi) % (2 * np.pi) - np.pi}
    names = {STATE: NAMES, "action": NAMES}
    root = write_folder(tmp_path / "old", [episode], names, dtype="float64")
    assert repair_dataset(root, tmp_path / "new", RepairOptions(trim=False)).changed == 0


@pytest.mark.parametrize("low", [-np.pi, 0.0])
@pytest.mark.parametrize(("turn", "unit"), [(2 * np.pi, "rad"), (360.0, "deg")])
def test_resampling_goes_on_where_joints_and_commands_wrap(tmp_path, turn, unit, low):
    q = (low + 2 * np.pi + np.linspace(-0.6, 1.4, 90))[:, None] * np.array([1.0, -1.0, 0.2])
    wrapped = (q - low) % (2 * np.pi) + low
    factor = turn / (2 * np.pi)
    # A hand whose levels happen to lie a turn apart.
    hand = np.where(np.arange(90) // 9 % 2, np.pi, -np.pi)[:, None]
    columns = factor * np.hstack([wrapped, hand])
    episode, names = {STATE: columns, "action": columns}, {STATE: HAND, "action": HAND}
    root = write_folder(tmp_path / "old", [episode], names, dtype="float64")
    units = {"joint_position": unit, "command_position": unit}
    options = RepairOptions(trim=False, fps=120)
    repair_dataset(root, tmp_path / "new", options, units=units)
    (demo,) = load_demos(tmp_path / "new")
    expected = np.stack(
        [np.interp(demo.time, np.arange(90) / FPS, column) for column in q.T], axis=1
    )
    expected += wrapped[0] - q[0]  # unwrapped from the first frame on
    for moved in (demo.joint_position, demo.command_position):
        values, fingers = moved[:, :3], moved[:, 3]
        np.testing.assert_allclose(np.abs(fingers), np.pi)
        assert 8 <= np.count_nonzero(np.diff(fingers)) <= 9
        np.testing.assert_allclose(values, expected, atol=1e-3)


def test_units_given_to_a_repair_overrule_an_older_contract(tmp_path):
    root = write(tmp_path / "old", [joint_path(60, seed=k) for k in range(2)])
    kept = check_dataset(root, units={"joint_position": "rad"}).contract
    assert kept is not None
    keep_contract(root, kept)
    repair_dataset(
        root, tmp_path / "new", RepairOptions(trim=False), units={"joint_position": "deg"}
    )
    degrees = np.deg2rad(joint_path(60, seed=0))
    np.testing.assert_allclose(load_demos(tmp_path / "new")[0].joint_position, degrees)


def test_trimming_waits_for_the_gripper_and_for_the_command(tmp_path):
    q = joint_path(100, seed=2)
    waiting = np.concatenate([np.repeat(q[:1], 100, 0), q, np.repeat(q[-1:], 100, 0)])
    opening = (np.arange(300) > 250)[:, None] * 1.0
    command = np.where(np.arange(300)[:, None] > 40, waiting + 0.02, waiting)
    episode = {STATE: np.hstack([waiting, opening]), "action": command}
    names = {STATE: [*NAMES, "gripper.pos"], "action": NAMES}
    root = write_folder(tmp_path / "old", [episode], names, dtype="float64")
    start, stop = trimmed(repair_dataset(root, tmp_path / "new"))
    assert (start, 299 - stop) == (40, 251)
    assert len(load_demos(tmp_path / "new")[0]) == 212


def test_a_dry_run_says_the_same_and_writes_nothing(tmp_path):
    q = joint_path(60)
    q[30:, 1] += 2 * np.pi
    root = write(tmp_path / "old", [q, joint_path(60, seed=1)])
    said = repair_dataset(root, tmp_path / "new", RepairOptions(trim=False, dry_run=True))
    assert [*tmp_path.iterdir()] == [root]
    assert "nothing written" in str(said)
    done = repair_dataset(root, tmp_path / "new", RepairOptions(trim=False))
    assert (done.changes, done.frames) == (said.changes, said.frames)


def picture(shade: int) -> bytes:
    """A PNG image of one shade."""
    import av

    stream = av.CodecContext.create("png", "w")
    stream.width, stream.height, stream.pix_fmt = 8, 6, "rgb24"
    frame = av.VideoFrame.from_ndarray(np.full((6, 8, 3), shade, np.uint8), format="rgb24")
    stream.time_base = Fraction(1, 50)
    return b"".join(bytes(packet) for packet in [*stream.encode(frame), *stream.encode()])


def with_others(root: Path) -> Path:
    """A column of images, one of texts and one of two axes, beside a state with a rest."""
    q = joint_path(60, seed=3)
    q = np.concatenate([np.repeat(q[:1], 60, 0), q])
    write_folder(root, [{STATE: q}, {STATE: q + 0.1}], {STATE: NAMES}, version="v2.1")
    info = read_info(root)
    info["features"] |= {
        "observation.images.front": {"dtype": "image", "shape": [6, 8, 3], "names": None},
        "note": {"dtype": "string", "shape": [1], "names": None},
        "grid": {"dtype": "float32", "shape": [2, 3], "names": None},
    }
    write_info(root, info)
    for episode in range(2):
        images = [{"bytes": picture(k), "path": None} for k in range(120)]
        grid = np.arange(720.0).reshape(120, 2, 3).tolist()
        rewrite(
            root / f"data/chunk-000/episode_{episode:06d}.parquet",
            lambda table, images=images, grid=grid: (
                table.append_column("observation.images.front", pa.array(images))
                .append_column("note", pa.array([f"frame {k}" for k in range(120)]))
                .append_column("grid", pa.array(grid, pa.list_(pa.list_(pa.float32()))))
            ),
        )
    return root


def test_images_texts_and_grids_stay_with_their_frames(tmp_path):
    repair_dataset(with_others(tmp_path / "old"), tmp_path / "new")
    assert check_dataset(tmp_path / "new").ok
    table = pq.read_table(tmp_path / "new/data/chunk-000/file-000.parquet")
    rows = table.slice(0, len(load_demos(tmp_path / "new")[0])).to_pylist()
    first = 120 - len(rows)
    assert 30 < first < 60
    assert [row["note"] for row in rows] == [f"frame {k}" for k in range(first, 120)]
    assert rows[5]["observation.images.front"]["bytes"] == picture(first + 5)
    assert rows[5]["grid"] == np.arange(720).reshape(120, 2, 3)[first + 5].tolist()
    stats = json.loads((tmp_path / "new/meta/stats.json").read_text())
    shades = np.arange(first, 120) / 255
    mean = np.ravel(stats["observation.images.front"]["mean"])
    np.testing.assert_allclose(mean, shades.mean(), atol=0.01)


@pytest.mark.slow
def test_lerobot_reads_images_texts_and_grids(tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    lerobot_dataset = pytest.importorskip("lerobot.datasets").LeRobotDataset
    repair_dataset(with_others(tmp_path / "old"), tmp_path / "new", RepairOptions(trim=False))
    dataset = lerobot_dataset("local/new", root=tmp_path / "new")
    assert dataset[7]["note"] == "frame 7"
    assert tuple(dataset[7]["grid"].shape) == (2, 3)
    np.testing.assert_allclose(dataset[7]["observation.images.front"].numpy(), 7 / 255)


@pytest.mark.slow
@pytest.mark.parametrize("pictures", [True, False])
def test_a_step_of_act_runs_on_what_was_repaired(tmp_path, monkeypatch, pictures):
    """The real policy of LeRobot, with its own statistics, learns from the result."""
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    pytest.importorskip("lerobot.policies.act")
    rng = np.random.default_rng(0)
    if pictures:
        root = tmp_path / "old"
        with DatasetWriter(root, 50, "any", ["a", "b"], cameras={"front": (64, 64)}) as writer:
            for _ in range(2):
                writer.start_episode("look")
                for k in range(50):
                    image = rng.integers(0, 255, (64, 64, 3), dtype=np.uint8)
                    q = [0.02 * max(k - 25, 0), 0.01 * k]
                    writer.add_frame(
                        joint_position=q, command_position=q, images={"front": image}
                    )
                writer.save_episode()
    else:
        q = joint_path(60)
        around = {"observation.environment_state": joint_path(60, seed=5)}
        episodes = [{STATE: q, "action": q + 0.01, **around} for _ in range(2)]
        root = write_folder(
            tmp_path / "old", episodes, {STATE: NAMES, "action": NAMES}, version="v2.0"
        )
    repair_dataset(root, tmp_path / "new")
    loss = one_step_of_act(tmp_path / "new")
    assert np.isfinite(loss)
    assert loss > 0
