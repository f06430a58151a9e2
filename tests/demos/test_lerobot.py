"""LeRobot itself is the judge of what our writer leaves."""

import json
import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest
from lerobot_folders import joint_path

from hrc_learn.demos import DatasetWriter, load_demos

# Whole datasets are written and read; shapes are checked in the other tests of this folder.
pytestmark = pytest.mark.simulation

JOINTS = ("joint_1", "joint_2", "joint_3")
MOTIONS = [joint_path(n, seed=i).astype(np.float32) for i, n in enumerate((120, 90, 150))]
TASKS = ("reach", "place", "reach")


@pytest.fixture(scope="module")
def lerobot_dataset():
    pytest.MonkeyPatch().setenv("HF_HUB_OFFLINE", "1")
    return pytest.importorskip("lerobot.datasets").LeRobotDataset


@pytest.fixture(scope="module")
def ours(tmp_path_factory):
    root = tmp_path_factory.mktemp("ours") / "set"
    with DatasetWriter(root, 50, "panda", JOINTS) as writer:
        for task, motion in zip(TASKS, MOTIONS, strict=True):
            writer.start_episode(task)
            for k, q in enumerate(motion):
                writer.add_frame(time=0.02 * k, joint_position=q, command_velocity=2 * q)
            writer.save_episode()
    return root


@pytest.fixture(scope="module")
def theirs(tmp_path_factory, lerobot_dataset):
    root = tmp_path_factory.mktemp("theirs") / "set"
    vector = {"dtype": "float32", "shape": (3,)}
    features = {
        "observation.state": vector | {"names": [f"{j}.pos" for j in JOINTS]},
        "action": vector | {"names": [f"{j}.vel" for j in JOINTS]},
        "time": {"dtype": "float64", "shape": (1,), "names": ["time"]},
    }
    dataset = lerobot_dataset.create(
        "local/set", 50, features, root=root, robot_type="panda", use_videos=False
    )
    for task, motion in zip(TASKS, MOTIONS, strict=True):
        for k, q in enumerate(motion):
            dataset.add_frame(
                {
                    "observation.state": q,
                    "action": 2 * q,
                    "time": np.array([0.02 * k]),
                    "task": task,
                }
            )
        dataset.save_episode()
    dataset.finalize()
    return root


def test_lerobot_opens_our_dataset(ours, lerobot_dataset):
    dataset = lerobot_dataset("local/set", root=ours, video_backend="pyav")
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (3, 360, 50)
    assert dataset.meta.robot_type == "panda"
    frames = np.concatenate(MOTIONS)
    for index in (0, 119, 120, 359):
        item = dataset[index]
        np.testing.assert_array_equal(item["observation.state"].numpy(), frames[index])
        np.testing.assert_array_equal(item["action"].numpy(), 2 * frames[index])
    assert (dataset[130]["task"], dataset[130]["episode_index"].item()) == ("place", 1)
    assert dataset[130]["timestamp"].item() == pytest.approx(0.2)


def test_lerobot_takes_episodes_and_chunks_from_it(ours, lerobot_dataset):
    dataset = lerobot_dataset(
        "local/set",
        root=ours,
        episodes=[1],
        delta_timestamps={"action": [0.0, 0.02]},
        video_backend="pyav",
    )
    assert len(dataset) == 90
    np.testing.assert_array_equal(dataset[5]["action"].numpy(), 2 * MOTIONS[1][5:7])


def test_lerobot_records_on_after_us(ours, lerobot_dataset, tmp_path):
    root = shutil.copytree(ours, tmp_path / "set")
    dataset = lerobot_dataset.resume("local/set", root=root)
    for k, q in enumerate(MOTIONS[0]):
        dataset.add_frame(
            {
                "observation.state": q,
                "action": q,
                "time": np.array([0.02 * k]),
                "task": "push",
            }
        )
    dataset.save_episode()
    dataset.finalize()
    demos = load_demos(root)
    assert [demo.task for demo in demos] == [*TASKS, "push"]
    np.testing.assert_array_equal(demos[3].joint_position, MOTIONS[0])


def test_our_metadata_are_those_lerobot_writes(ours, theirs):
    mine, other = read_json("info", ours, theirs)
    assert {**mine, "video_path": None} == {**other, "video_path": None}
    assert list(mine) == list(other)
    mine, other = read_json("stats", ours, theirs)
    assert mine.keys() == other.keys()
    for key in mine:
        assert mine[key].keys() == other[key].keys()
        for name in ("min", "max", "mean", "std", "count"):
            np.testing.assert_allclose(mine[key][name], other[key][name], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "file",
    [
        "data/chunk-000/file-000.parquet",
        "meta/tasks.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
    ],
)
def test_our_tables_have_the_columns_and_types_of_lerobots(ours, theirs, file):
    mine, other = pq.read_schema(ours / file), pq.read_schema(theirs / file)
    assert dict(zip(mine.names, map(str, mine.types), strict=True)) == dict(
        zip(other.names, map(str, other.types), strict=True)
    )
    mine, other = pq.read_table(ours / file), pq.read_table(theirs / file)
    shared = [name for name in mine.column_names if not name.startswith("stats/")]
    assert mine.select(shared).equals(other.select(shared))


def test_we_read_what_lerobot_wrote(theirs):
    demos = load_demos(theirs, units={"joint_position": "rad"})
    assert demos.joint_names == JOINTS
    for demo, motion, task in zip(demos, MOTIONS, TASKS, strict=True):
        assert demo.task == task
        np.testing.assert_array_equal(demo.joint_position, motion)
        np.testing.assert_array_equal(demo.command_velocity, 2 * motion)


def read_json(name, *roots):
    return [json.loads((root / f"meta/{name}.json").read_text()) for root in roots]
