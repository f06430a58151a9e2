"""Small LeRobot datasets in every version, written without the code under test."""

import json
from collections.abc import Mapping, Sequence
from itertools import chain, islice, repeat
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

FPS = 50
INDEX_TYPES = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}


def joint_path(frames: int = 60, joints: int = 3, seed: int = 0) -> np.ndarray:
    """A smooth joint motion (frames, joints) [rad], slow enough for any arm."""
    rng = np.random.default_rng(seed)
    s = np.linspace(0, 1, frames)[:, None]
    start, goal, bend = rng.uniform(-1, 1, (3, joints))
    return start + (goal - start) * s + bend * np.sin(np.pi * s)


def write_folder(
    root: Path,
    episodes: Sequence[Mapping[str, np.ndarray]],
    names: Mapping[str, object],
    *,
    version: str = "v3.0",
    fps: float = FPS,
    tasks: Sequence[str] = ("reach",),
    ragged_lists: bool = False,
    dtype: str = "float32",
    without: Sequence[str] = (),
    videos: Sequence[str] = (),
) -> Path:
    """Write a dataset.

    Args:
        root: Its folder.
        episodes: Column -> values (frames, width), episode by episode.
        names: Column -> `names` as they shall stand in info.json, in any nesting.
        version: "v3.0", "v2.1" or "v2.0".
        fps: Frame rate.
        tasks: Task of each episode, repeated as needed.
        ragged_lists: Columns as `list` instead of `fixed_size_list`.
        dtype: Type of the columns.
        without: Index columns to leave out.
        videos: Video features to declare, without a file.
    """
    texts = list(dict.fromkeys(tasks))
    tables, start = [], 0
    for index, episode in enumerate(episodes):
        frames = len(next(iter(episode.values())))
        task = texts.index(tasks[index % len(tasks)])
        tables.append(_table(episode, index, start, task, fps, ragged_lists, dtype, without))
        start += frames
    features = {
        key: {"dtype": dtype, "shape": [np.shape(values)[1]], "names": names.get(key)}
        for key, values in episodes[0].items()
    }
    features |= {
        key: {
            "dtype": "float32" if key == "timestamp" else "int64",
            "shape": [1],
            "names": None,
        }
        for key in ("timestamp", "frame_index", "episode_index", "index", "task_index")
        if key not in without
    }
    features |= {key: {"dtype": "video", "shape": [4, 6, 3], "names": None} for key in videos}
    info = {
        "codebase_version": version,
        "robot_type": "test",
        "fps": fps,
        "total_episodes": len(episodes),
        "total_frames": start,
        "total_tasks": len(texts),
        "chunks_size": 1000,
        "features": features,
    }
    (root / "meta").mkdir(parents=True)
    (root / "data/chunk-000").mkdir(parents=True)
    (root / "meta/stats.json").write_text("{}")
    lengths = [len(table) for table in tables]
    episode_tasks = [tasks[i % len(tasks)] for i in range(len(episodes))]
    if version.startswith("v3"):
        info["data_path"] = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
        _write_v3(root, tables, lengths, episode_tasks, texts)
    else:
        info["data_path"] = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
        _write_v2(root, tables, lengths, episode_tasks, texts)
    write_info(root, info)
    return root


def one_step_of_act(root: Path, steps: int = 1) -> float:
    """Loss of the last training step of LeRobot's ACT on a dataset, by its own factory.

    ACT takes no state alone: where there are neither images nor a state of the environment, it
    sees the robot's state as that of the environment.
    """
    import torch
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.datasets import LeRobotDataset
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.factory import make_policy, make_pre_post_processors

    config = ACTConfig(
        chunk_size=8,
        n_action_steps=8,
        device="cpu",
        pretrained_backbone_weights=None,
        dim_model=64,
        n_heads=2,
        dim_feedforward=64,
        push_to_hub=False,
    )
    torch.manual_seed(0)
    fps = read_info(root)["fps"]
    dataset = LeRobotDataset(
        "local/new",
        root=root,
        video_backend="pyav",
        delta_timestamps={"action": [k / fps for k in range(8)]},
    )
    loader = torch.utils.data.DataLoader(dataset, batch_size=4, shuffle=True, drop_last=True)
    stats, state, around = (
        dataset.meta.stats,
        "observation.state",
        "observation.environment_state",
    )
    blind = not any("image" in key or key == around for key in dataset.meta.features)
    if blind:
        shape = tuple(dataset.meta.features[state]["shape"])
        config.input_features = {around: PolicyFeature(type=FeatureType.ENV, shape=shape)}
        stats = stats | {around: stats[state]}
    policy = make_policy(config, ds_meta=dataset.meta)
    assert any(f.type is FeatureType.ACTION for f in policy.config.output_features.values())
    preprocess, _ = make_pre_post_processors(config, dataset_stats=stats)
    optimizer = torch.optim.Adam(policy.parameters(), 1e-4)
    loss = torch.zeros(())
    for batch in islice(chain.from_iterable(repeat(loader)), steps):
        if blind:
            batch[around] = batch[state]
        loss, _ = policy.forward(preprocess(batch))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return float(loss.detach())


def read_info(root: Path) -> dict:
    return json.loads((root / "meta/info.json").read_text())


def write_info(root: Path, info: dict) -> None:
    (root / "meta/info.json").write_text(json.dumps(info))


def rewrite(file: Path, change) -> None:
    """Replace a parquet file by what `change` makes of its table."""
    pq.write_table(change(pq.read_table(file)), file)


def _table(episode, index, start, task, fps, ragged_lists, dtype, without) -> pa.Table:
    frames = len(next(iter(episode.values())))
    columns = {}
    for key, values in episode.items():
        values = np.asarray(values, dtype=dtype)
        flat = pa.array(values.reshape(-1))
        if values.shape[1] == 1:
            columns[key] = flat
        elif ragged_lists:
            offsets = np.arange(frames + 1) * values.shape[1]
            columns[key] = pa.ListArray.from_arrays(pa.array(offsets, pa.int32()), flat)
        else:
            columns[key] = pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    count = np.arange(frames)
    indices = {
        "timestamp": (count / fps).astype(np.float32),
        "frame_index": count,
        "episode_index": np.full(frames, index),
        "index": count + start,
        "task_index": np.full(frames, task),
    }
    return pa.table(columns | {k: v for k, v in indices.items() if k not in without})


def _write_v3(root, tables, lengths, episode_tasks, texts) -> None:
    (root / "meta/episodes/chunk-000").mkdir(parents=True)
    with pq.ParquetWriter(root / "data/chunk-000/file-000.parquet", tables[0].schema) as writer:
        for table in tables:
            writer.write_table(table)
    stops = np.cumsum(lengths)
    episodes = {
        "episode_index": range(len(tables)),
        "tasks": [[task] for task in episode_tasks],
        "length": lengths,
        "data/chunk_index": [0] * len(tables),
        "data/file_index": [0] * len(tables),
        "dataset_from_index": stops - lengths,
        "dataset_to_index": stops,
    }
    table = pa.table({key: list(values) for key, values in episodes.items()})
    pq.write_table(table, root / "meta/episodes/chunk-000/file-000.parquet")
    tasks = pa.table({"task_index": range(len(texts)), "task": texts})
    # LeRobot writes the texts as the index of a pandas table.
    kinds = {"task_index": ("int64", "int64"), "task": ("unicode", "object")}
    columns = [
        {"name": k, "field_name": k, "pandas_type": a, "numpy_type": b, "metadata": None}
        for k, (a, b) in kinds.items()
    ]
    index = {"index_columns": ["task"], "column_indexes": [], "columns": columns}
    tasks = tasks.replace_schema_metadata({"pandas": json.dumps(index)})
    pq.write_table(tasks, root / "meta/tasks.parquet")


def _write_v2(root, tables, lengths, episode_tasks, texts) -> None:
    for index, table in enumerate(tables):
        pq.write_table(table, root / f"data/chunk-000/episode_{index:06d}.parquet")
    episodes = [
        {"episode_index": i, "tasks": [task], "length": length}
        for i, (task, length) in enumerate(zip(episode_tasks, lengths, strict=True))
    ]
    tasks = [{"task_index": i, "task": task} for i, task in enumerate(texts)]
    for name, rows in (("episodes", episodes), ("tasks", tasks)):
        lines = "".join(json.dumps(row) + "\n" for row in rows)
        (root / f"meta/{name}.jsonl").write_text(lines)
