"""Declared features, places of files and statistics of a dataset's metadata."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hrc_learn.demos import DatasetError
from hrc_learn.demos.read import metadata

pytestmark = pytest.mark.simulation


def declared(dtype="float32", shape=(3,), names=None):
    return metadata.read_feature("k", {"dtype": dtype, "shape": list(shape), "names": names})


@pytest.mark.parametrize(
    ("dtype", "shape", "fault"),
    [
        ("float32", [-1, 3], r"shape \(-1, 3\)"),
        ("float32", [3, -1], r"shape \(3, -1\)"),
        ("float32", [1] * 9, "shape"),
        ("float32", [1] * 8, None),
        ("float64", [100_000], None),
        ("float64", [100, 1001], "100100 numbers a frame"),
        ("int8", [100_001], "100001 numbers a frame"),
        ("video", [480, 640, 3], None),
        ("float32", ["a"], "invalid literal"),
        ("float32", 3, "not iterable"),
    ],
)
def test_bounds_of_a_declared_shape(dtype, shape, fault):
    given = {"dtype": dtype, "shape": shape}
    if fault is None:
        feature = metadata.read_feature("k", given)
        assert (feature.shape, feature.width) == (tuple(shape), np.prod(shape))
        assert feature.numeric == (dtype != "video")
        assert feature.is_picture == (dtype == "video")
        assert metadata.read_features({"features": {"k": given}}) == {"k": feature}
        return
    with pytest.raises(DatasetError, match=fault) as error:
        metadata.read_feature("k", given)
    assert "declaration is malformed" in str(error.value)


@pytest.mark.parametrize(
    ("names", "flat"),
    [
        (None, None),
        (["a", "b", "c"], ("a", "b", "c")),
        ({"axes": ["a", "b", "c"]}, ("a", "b", "c")),
        ({"left": ["a"], "right": {"x": ["b", "c"]}}, ("a", "b", "c")),
        # Two arms with joints of the same names, and names with their columns.
        ({"left": ["a", "b"], "right": ["a"]}, ("left_a", "left_b", "right_a")),
        ({"a": 0, "b": 1, "c": 2}, ("a", "b", "c")),
        ([["a", ["b"]], ("c",)], ("a", "b", "c")),
        ([1, None, "b", "c"], ("1", "b", "c")),
        (["a", "b"], None),
        ("vector", None),
    ],
)
def test_names_of_any_nesting_count_if_there_is_one_for_each_component(names, flat):
    feature = declared(names=names)
    assert feature.names == flat
    expected = flat or [f"component {i}" for i in range(3)]
    assert [feature.component(i) for i in range(3)] == [*expected]
    assert declared("image", (4, 6, 3), ["height", "width", "channels"]).names is None


@pytest.mark.parametrize(
    ("number", "path"), [(0, "000/file-000"), (999, "000/file-999"), (2001, "002/file-001")]
)
def test_a_chunk_holds_a_thousand_files(number, path):
    assert metadata.place(metadata.DATA_PATH, number) == f"data/chunk-{path}.parquet"
    video = metadata.place(metadata.VIDEO_PATH, number, video_key="top")
    assert video == f"videos/top/chunk-{path}.mp4"


def test_columns_have_the_types_of_the_library_datasets():
    datasets = pytest.importorskip("datasets")
    shapes = {"one": [1], "many": [4], "grid": [2, 3], "solid": [2, 3, 4], "picture": [4, 6, 3]}
    features = {
        key: {"dtype": "image" if key == "picture" else "float32", "shape": shape}
        for key, shape in shapes.items()
    }
    schema = pa.schema([(key, pa.float32()) for key in features])
    written = json.loads(metadata.data_schema(schema, features).metadata[b"huggingface"])
    assert datasets.Features.from_dict(written["info"]["features"]) == datasets.Features(
        one=datasets.Value("float32"),
        many=datasets.List(datasets.Value("float32"), 4),
        grid=datasets.Array2D((2, 3), "float32"),
        solid=datasets.Array3D((2, 3, 4), "float32"),
        picture=datasets.Image(),
    )


def test_tasks_are_the_index_of_their_table(tmp_path):
    pytest.importorskip("pandas")
    metadata.write_tasks(tmp_path / "tasks.parquet", ["lift", "place"])
    table = pq.read_table(tmp_path / "tasks.parquet").to_pandas()
    assert table.index.name == "task"
    assert table["task_index"].to_dict() == {"lift": 0, "place": 1}


@pytest.mark.parametrize(("fps", "dtype"), [(30.0, "video"), (29.97, "float32")])
def test_a_rate_stays_whole_and_a_video_has_a_path(fps, dtype):
    features = {"a": {"dtype": "float32"}, "b": {"dtype": dtype}}
    info = metadata.info_content(
        features, fps, "panda", {"episodes": 4, "frames": 90, "tasks": 2}
    )
    assert (info["fps"], type(info["fps"])) == (fps, int if fps == 30 else float)
    assert (info["video_path"] is None) == (dtype != "video")
    assert info["splits"] == {"train": "0:4"}
    totals = [info[f"total_{name}"] for name in ("episodes", "frames", "tasks")]
    assert totals == [4, 90, 2]


def test_statistics_over_episodes_are_those_of_all_frames():
    """Quantiles are averages, weighted by length."""
    rng = np.random.default_rng(0)
    parts = [rng.normal(k, 1 + k, (length, 2)) for k, length in enumerate((5, 40, 200))]
    each = [metadata.episode_statistics({"q": part})["q"] for part in parts]
    stacked = {name: np.stack([one[name] for one in each]) for name in each[0]}
    found = metadata.combined_statistics({"q": stacked})["q"]
    whole = np.concatenate(parts)
    for name in ("min", "max", "mean", "std"):
        np.testing.assert_allclose(found[name], getattr(whole, name)(0))
    assert found["count"] == [245]
    for name, level in metadata.QUANTILES.items():
        own = [np.quantile(part, level, axis=0) for part in parts]
        np.testing.assert_allclose(stacked[name], own)
        np.testing.assert_allclose(found[name], np.average(own, axis=0, weights=[5, 40, 200]))


def test_colours_count_from_0_to_1():
    images = np.random.default_rng(1).integers(0, 255, (3, 4, 5, 3), np.uint8)
    found = metadata.image_statistics(images)
    assert found["count"] == [3]
    for name in ("mean", "std", "min", "max"):
        expected = getattr(images / 255, name)(axis=(0, 1, 2))
        np.testing.assert_allclose(found[name], expected.reshape(3, 1, 1))
