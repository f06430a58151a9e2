"""Images of a dataset as tensors: each beside its frame, or an error that names it."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from clean_sets import CAMERA, SIZE, bar, write_set, write_video
from lerobot_folders import read_info, rewrite, write_info
from unchecked import shapes_unchecked

from hrc_learn.demos import DatasetError, ImageReader, load_demos, load_images, videos
from hrc_learn.demos.images import jpeg
from hrc_learn.demos.read.dataset_folder import open_folder
from hrc_learn.demos.videos import decode_image, read_segments

# Whole datasets are written and read; shapes are checked in the other tests of this folder.
pytestmark = pytest.mark.simulation


@pytest.fixture(params=["v3.0", "v2.1"])
def root(request, tmp_path):
    return write_set(tmp_path / "set", request.param, camera=True)


def test_every_frame_has_its_own_image(root):
    start = 0
    for demo in load_demos(root):
        images = load_images(root, demo.episode)[CAMERA]
        assert images.shape == (len(demo), 3, *SIZE)
        assert images.dtype == torch.uint8
        # The bar moves by a column a frame, through the file or through the episode.
        for k in (0, 1, len(demo) // 2, len(demo) - 1):
            assert abs(bar(images[k]) - (start + k) % (SIZE[1] - 6)) <= 1
        if (root / f"videos/{CAMERA}").is_dir():  # one video of all episodes
            start += len(demo)


def test_frames_come_in_the_order_asked_for_and_scaled(root):
    every = load_images(root, 1)[CAMERA]
    wanted = [140, 3, 3, 75, 4]
    assert (load_images(root, 1, frames=wanted)[CAMERA] == every[wanted]).all()
    small = load_images(root, 1, [CAMERA], frames=[9], size=(24, 32))[CAMERA]
    assert small.shape == (1, 3, 24, 32)
    assert abs(bar(small[0]) - bar(every[9]) / 2) <= 1
    assert load_images(root, 1, frames=[]) == {}


EPISODES = "meta/episodes/chunk-000/file-000.parquet"


@pytest.mark.parametrize("version", ["3.0", 3.0])
def test_the_version_may_be_written_otherwise(tmp_path, version):
    root = write_set(tmp_path / "set", "v3.0", camera=True)
    write_info(root, read_info(root) | {"codebase_version": version})
    with shapes_unchecked():  # a number is no text
        images = load_images(root, 0, frames=[9])[CAMERA]
    assert bar(images[0]) == pytest.approx(9, abs=1)


@pytest.mark.parametrize("name", ["file_index", "from_timestamp", "to_timestamp"])
def test_a_video_without_a_place_is_named(tmp_path, name):
    root = write_set(tmp_path / "set", "v3.0", camera=True)
    column = f"videos/{CAMERA}/{name}"
    rewrite(root / EPISODES, lambda table: table.drop_columns([column]))
    with pytest.raises(DatasetError, match=f"{EPISODES}, episode 0, {column}: must be"):
        ImageReader(root)


def test_of_the_list_of_episodes_only_the_places_of_videos_are_read(tmp_path, monkeypatch):
    root = write_set(tmp_path / "set", "v3.0", camera=True)
    rewrite(
        root / EPISODES,
        lambda table: table.append_column("stats/action/mean", pa.array([[0.0]] * len(table))),
    )
    read, rows = set(), videos.read_rows

    def watched(*args, **options):
        found = rows(*args, **options)
        read.update(*found)
        return found

    monkeypatch.setattr(videos, "read_rows", watched)
    assert len(read_segments(open_folder(root))) == 5
    assert {name.split("/")[0] for name in read} == {"episode_index", "videos"}


def test_a_video_without_the_last_images_names_the_first_that_is_missing(tmp_path):
    root = write_set(tmp_path / "set", "v2.1", camera=True)
    length = len(load_demos(root)[2])
    path = root / f"videos/chunk-000/{CAMERA}/episode_000002.mp4"
    path.unlink()
    write_video(path, length - 10)
    with pytest.raises(DatasetError, match="holds no image") as caught:
        load_images(root, 2)
    assert (caught.value.issue.episode, caught.value.issue.frame) == (2, length - 10)
    assert len(load_images(root, 2, frames=range(length - 10))[CAMERA]) == length - 10
    path.unlink()
    with pytest.raises(DatasetError, match="is missing"):
        load_images(root, 2)
    assert ImageReader(root).available(2) == ()
    path.write_bytes(b"no video")
    with pytest.raises(DatasetError, match="cannot be decoded"):
        load_images(root, 2)


@pytest.mark.parametrize(
    ("episode", "cameras", "frames", "message"),
    [
        (9, None, None, "no such episode"),
        (0, ["observation.images.left"], None, "no such camera"),
        (0, None, [-1], "no frames"),
        (0, None, [9999], "no frames"),
    ],
)
def test_what_is_not_there_is_named(root, episode, cameras, frames, message):
    with pytest.raises(DatasetError, match=message):
        load_images(root, episode, cameras, frames)


def test_columns_of_images_are_read_like_videos(tmp_path):
    root = write_set(tmp_path / "set", "v2.0")
    lengths = [len(demo) for demo in load_demos(root)]
    rng = np.random.default_rng(0)
    colours = {}
    for episode, length in enumerate(lengths):
        file = root / f"data/chunk-000/episode_{episode:06d}.parquet"
        colours[episode] = rng.integers(0, 255, (length, 3))
        content = [
            {"bytes": jpeg(np.broadcast_to(c, (16, 24, 3)).astype(np.uint8)), "path": None}
            for c in colours[episode]
        ]
        pq.write_table(pq.read_table(file).append_column(CAMERA, pa.array(content)), file)
    info = root / "meta/info.json"
    feature = f'"features": {{"{CAMERA}": {{"dtype": "image", "shape": [16, 24, 3]}}, '
    info.write_text(info.read_text().replace('"features": {', feature, 1))
    images = load_images(root, 3, frames=[5, 40])[CAMERA]
    assert images.shape == (2, 3, 16, 24)
    # Even colours survive JPEG but for its rounding of hues.
    shown = images.float().mean((2, 3)).numpy()
    np.testing.assert_allclose(shown, colours[3][[5, 40]], atol=6)


def test_jpeg_keeps_the_image():
    ramp = np.linspace(0, 255, 64)[None, :, None] * np.ones((48, 1, 3))
    image = ramp.astype(np.uint8)
    assert np.abs(decode_image(jpeg(image)).astype(int) - image).max() < 12
