"""Episodes that LeRobot's recorder saved before it ended early come back, value by value."""

import itertools
import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from clean_sets import write_set

from hrc_learn.demos import DatasetError, check_dataset, load_demos, repair_dataset
from hrc_learn.demos.quality.repair import RepairOptions
from hrc_learn.demos.read.dataset_files import finished_parquet, is_unfinished

# Whole datasets are written and read; shapes are checked in the other tests of this folder.
pytestmark = pytest.mark.simulation

AS_IT_IS = RepairOptions(trim=False, unwrap=False, fix_signs=False)


def without_footer(table, groups, **options):
    """Bytes of a Parquet file whose writer never closes it, one row group for each range."""
    sink = pa.BufferOutputStream()
    writer = pq.ParquetWriter(sink, table.schema, compression="snappy", **options)
    for first, stop in groups:
        writer.write_table(table.slice(first, stop - first))
    writer.close()
    content = sink.getvalue().to_pybytes()
    return content[: len(content) - 8 - int.from_bytes(content[-8:-4], "little")]


def kill(root, *, sessions=1):
    """Leave of a sound dataset what the recorder leaves: the last session without footers."""
    info = json.loads((root / "meta/info.json").read_text())
    (listed,) = (root / "meta/episodes").glob("*/*.parquet")
    rows = pq.read_table(listed).to_pylist()
    (file,) = (root / "data").glob("*/*.parquet")
    table, kept = pq.read_table(file), len(rows) * (sessions - 1) // sessions
    ends = [(row["dataset_from_index"], row["dataset_to_index"]) for row in rows]
    table = table.replace_schema_metadata(None)
    if kept:
        pq.write_table(table.slice(0, ends[kept][0]), file)
        columns = pq.read_table(listed)
        pq.write_table(columns.slice(0, kept), listed)
        file = file.with_name("file-001.parquet")
    else:
        listed.unlink()
    file.write_bytes(without_footer(table, ends[kept:]))
    assert info["total_episodes"] == len(rows)
    return file


def same(one, two):
    assert len(one) == len(two)
    for a, b in zip(one, two, strict=True):
        assert (a.task, len(a)) == (b.task, len(b))
        np.testing.assert_array_equal(a.joint_position, b.joint_position)
        np.testing.assert_array_equal(a.command_position, b.command_position)


@pytest.fixture
def root(tmp_path):
    return write_set(tmp_path / "reach", "v3.0")


@pytest.mark.parametrize("sessions", [1, 2])
def test_all_saved_episodes_come_back(root, tmp_path, sessions):
    before = load_demos(root)
    file = kill(root, sessions=sessions)
    left = {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}
    assert is_unfinished(file)
    assert not check_dataset(root).ok
    report = repair_dataset(root, tmp_path / "out", AS_IT_IS)
    assert f"{file.relative_to(root)}" in str(report)
    assert "episodes lost: 0" in str(report)
    same(load_demos(tmp_path / "out"), before)
    assert check_dataset(tmp_path / "out").ok
    assert {path: path.read_bytes() for path in root.rglob("*") if path.is_file()} == left
    assert [*tmp_path.glob(".*")] == []


def test_an_episode_that_was_being_written_is_lost_and_said(root, tmp_path):
    before = load_demos(root)
    file = kill(root)
    file.write_bytes(file.read_bytes()[:-40])
    report = repair_dataset(root, tmp_path / "out", AS_IT_IS)
    assert "episodes lost: 1" in str(report)
    same(load_demos(tmp_path / "out"), before[: len(before) - 1])


def test_videos_follow_their_episodes(tmp_path):
    root = write_set(tmp_path / "reach", "v3.0", camera=True)
    sound = shutil.copytree(root, tmp_path / "sound")
    kill(root)
    repair_dataset(root, tmp_path / "out", AS_IT_IS)
    repair_dataset(sound, tmp_path / "other", AS_IT_IS)
    key = "videos/observation.images.front/from_timestamp"
    found, wanted = (
        pq.read_table(tmp_path / name / "meta/episodes")[key].to_pylist()
        for name in ("out", "other")
    )
    assert found == pytest.approx(wanted)
    assert check_dataset(tmp_path / "out").ok


def test_nothing_saved_is_said(root, tmp_path):
    file = kill(root)
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(DatasetError, match="no complete episode"):
        repair_dataset(root, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def fail_to_save(root, index, *, again, listed):
    """Leave what the recorder leaves after the save of an episode fails; it went on or ended.

    The rows of the episode are there. If it is recorded `again`, the new one has its index.
    """
    (lists,) = (root / "meta/episodes").glob("*/*.parquet")
    (file,) = (root / "data").glob("*/*.parquet")
    rows, table = pq.read_table(lists), pq.read_table(file)
    begin, end = (rows[f"dataset_{edge}_index"][index].as_py() for edge in ("from", "to"))
    if again:
        failed = table.slice(begin, end - begin - 7)  # the operator began anew
        spoilt = pa.array((np.array(failed["action"].to_pylist()) + 1.0).tolist())
        place = failed.schema.get_field_index("action")
        failed = failed.set_column(place, "action", spoilt.cast(failed["action"].type))
        table = pa.concat_tables([table.slice(0, begin), failed, table.slice(begin)])
    else:
        rows = rows.slice(0, index)
        info = json.loads((root / "meta/info.json").read_text())
        info |= {"total_episodes": index, "total_frames": begin}
        (root / "meta/info.json").write_text(json.dumps(info))
    pq.write_table(table, file)
    if listed:
        pq.write_table(rows, lists)
    else:
        lists.unlink()


@pytest.mark.parametrize("listed", [True, False])
@pytest.mark.parametrize(("index", "again"), [(4, False), (2, True), (0, True)])
def test_an_episode_whose_save_failed_takes_no_other_along(
    root, tmp_path, index, again, listed
):
    before = load_demos(root)
    fail_to_save(root, index, again=again, listed=listed)
    found = check_dataset(root)
    assert "hrc repair recovers" in str(found.errors[0])
    report = repair_dataset(root, tmp_path / "out", AS_IT_IS)
    assert ("1 episode whose save failed" if listed else "is missing") in str(report)
    assert "episodes lost: 0" in str(report)
    same(load_demos(tmp_path / "out"), before)
    assert check_dataset(tmp_path / "out").ok


def test_an_episode_whose_video_was_not_saved_is_left_out(tmp_path):
    root = write_set(tmp_path / "reach", "v3.0", camera=True)
    before = load_demos(root)
    fail_to_save(root, 4, again=False, listed=True)
    report = repair_dataset(root, tmp_path / "out", AS_IT_IS)
    assert "episode 4: left out: the video of this episode is missing" in str(report)
    same(load_demos(tmp_path / "out"), before[:4])
    report = repair_dataset(root, tmp_path / "blind", RepairOptions(trim=False, videos=False))
    assert not report.left_out


def test_repeated_frames_are_no_failed_save(root, tmp_path):
    (file,) = (root / "data").glob("*/*.parquet")
    table = pq.read_table(file)
    pq.write_table(
        pa.concat_tables([table.slice(0, 20), table.slice(10, 10), table[20:]]), file
    )
    with pytest.raises(DatasetError, match="the list of episodes promises"):
        repair_dataset(root, tmp_path / "out", AS_IT_IS)


@pytest.mark.parametrize("rows", [(3,), (1, 400, 7), (25_000,)])
@pytest.mark.parametrize("version", ["1.0", "2.0"])
def test_a_new_footer_gives_every_kind_of_column_back(rows, version):
    rng = np.random.default_rng(len(rows))
    count = sum(rows)
    texts = [f"frame {k % 7}" for k in range(count)]
    table = pa.table(
        {
            "done": pa.array(rng.random(count) < 0.5),
            "state": pa.FixedSizeListArray.from_arrays(pa.array(rng.random(6 * count)), 6),
            "matrix": pa.array(rng.random((count, 2, 3)).tolist()),
            "image": pa.array([{"bytes": text.encode(), "path": None} for text in texts]),
            "task": pa.array(texts),
            "index": pa.array(np.arange(count)),
            "flags": pa.FixedSizeListArray.from_arrays(
                pa.array(rng.random(2 * count) < 0.5), 2
            ),
        }
    )
    ends = np.cumsum([0, *rows]).tolist()
    groups = [*itertools.pairwise(ends)]
    content = without_footer(table, groups, data_page_version=version, data_page_size=8192)
    example = table.slice(0, 1)
    found = pq.read_table(pa.BufferReader(finished_parquet(content, example)))
    assert found.equals(table)
    # Broken off anywhere, whole row groups remain.
    for cut in rng.integers(4, len(content), 20).tolist():
        found = pq.read_table(pa.BufferReader(finished_parquet(content[:cut], example)))
        assert found.num_rows in ends
        assert found.equals(table.slice(0, found.num_rows))


KILLED = """
import os, signal, sys
import numpy as np
from lerobot.datasets import LeRobotDataset
root, video = sys.argv[1], sys.argv[2] == "video"
names = [f"joint{i}.pos" for i in range(1, 7)]
features = {key: {"dtype": "float32", "shape": (6,), "names": names}
            for key in ("action", "observation.state")}
if video:
    features["observation.images.front"] = {
        "dtype": "video", "shape": (64, 96, 3), "names": ["height", "width", "channels"]}
dataset = LeRobotDataset.create("local/x", 30, features, root=root, use_videos=video)
for episode in range(12 if not video else 3):
    for k in range(40 + episode):
        state = np.sin(0.05 * k + np.arange(6, dtype=np.float32)) + np.float32(episode)
        frame = {"action": state, "observation.state": state, "task": f"task {episode % 2}"}
        if video:
            frame["observation.images.front"] = np.full((64, 96, 3), 20 * episode + k, np.uint8)
        dataset.add_frame({**frame})
    dataset.save_episode()
dataset.add_frame(frame)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["numbers", "video"])
def test_lerobot_loads_what_its_killed_recorder_had_saved(kind, tmp_path):
    lerobot = pytest.importorskip("lerobot.datasets")
    given = [sys.executable, "-c", KILLED, str(tmp_path / "killed"), kind]
    subprocess.run(given, env={**os.environ, "HF_HUB_OFFLINE": "1"}, capture_output=True)
    repair_dataset(tmp_path / "killed", tmp_path / "out", AS_IT_IS)
    dataset = lerobot.LeRobotDataset("local/x", root=tmp_path / "out", video_backend="pyav")
    count = 12 if kind == "numbers" else 3
    assert dataset.num_episodes == count
    assert dataset.num_frames == sum(40 + episode for episode in range(count))
    row = 0
    for episode in range(count):
        for k in (0, 39):
            frame = dataset[row + k]
            wanted = np.sin(0.05 * k + np.arange(6, dtype=np.float32)) + np.float32(episode)
            np.testing.assert_array_equal(frame["observation.state"], wanted.astype("f4"))
            assert frame["task"] == f"task {episode % 2}"
            if kind == "video":
                level = 255 * float(frame["observation.images.front"].mean())
                assert level == pytest.approx(20 * episode + k, abs=4)
        row += 40 + episode


FAILED = """
import sys
import numpy as np
from lerobot.datasets import LeRobotDataset
root, ending = sys.argv[1:]
names = [f"joint{i}.pos" for i in range(1, 7)]
features = {key: {"dtype": "float32", "shape": (6,), "names": names}
            for key in ("action", "observation.state")}
dataset = LeRobotDataset.create("local/x", 30, features, root=root, use_videos=False)
def record(take):
    for k in range(40 + take):
        state = np.sin(0.05 * k + np.arange(6, dtype=np.float32)) + np.float32(take)
        dataset.add_frame({"action": state, "observation.state": state, "task": "reach"})
    dataset.save_episode()
def full(*args):
    raise OSError(28, "No space left on device")
record(0), record(1)
if ending == "frame":
    dataset.add_frame({"action": np.zeros(5)})
sound, dataset.meta.save_episode = dataset.meta.save_episode, full
try:
    record(2)
except OSError:
    pass
dataset.meta.save_episode = sound
dataset.clear_episode_buffer()
if "on" in ending:
    record(3), record(4)
if "finalized" in ending:
    dataset.finalize()
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ending", "takes"),
    [
        ("frame", [0, 1]),
        ("exit", [0, 1, 2]),
        ("exit, finalized", [0, 1, 2]),
        ("on", [0, 1, 3, 4]),
        ("on, finalized", [0, 1, 3, 4]),
    ],
)
def test_lerobot_loads_what_its_recorder_had_saved_before_it_raised(ending, takes, tmp_path):
    lerobot = pytest.importorskip("lerobot.datasets")
    given = [sys.executable, "-c", FAILED, str(tmp_path / "failed"), ending]
    subprocess.run(given, env={**os.environ, "HF_HUB_OFFLINE": "1"}, capture_output=True)
    repair_dataset(tmp_path / "failed", tmp_path / "out", AS_IT_IS)
    dataset = lerobot.LeRobotDataset("local/x", root=tmp_path / "out")
    assert dataset.num_episodes == len(takes)
    row = 0
    for take in takes:
        for k in (0, 39 + take):
            wanted = np.sin(0.05 * k + np.arange(6, dtype=np.float32)) + np.float32(take)
            np.testing.assert_array_equal(
                dataset[row + k]["observation.state"], wanted.astype("f4")
            )
        row += 40 + take
