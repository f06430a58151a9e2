"""Camera images recorded as video: LeRobot decodes them, frame for frame."""

import multiprocessing

import numpy as np
import pytest
from clean_sets import SETS, write_set
from lerobot_folders import read_info, write_info
from unchecked import shapes_unchecked

from hrc_learn.demos import DatasetWriter, check_dataset, load_demos, recover_dataset
from hrc_learn.demos.videos import VideoSegment, decode, video_path

# Whole datasets are written and read; shapes are checked in the other tests of this folder.
pytestmark = pytest.mark.simulation

SIZE = (96, 128)


def image(k: int) -> np.ndarray:
    """A grey that brightens with the frame, and a bright bar that wanders."""
    picture = np.full((*SIZE, 3), 20 + 4 * k, np.uint8)
    picture[:, 3 * k : 3 * k + 8] = (250, 40, 40)
    return picture


def record(root, lengths=(30, 20), then=None):
    with DatasetWriter(root, 50, "panda", ["a"], cameras={"front": SIZE}) as writer:
        for length in lengths:
            writer.start_episode("look")
            for k in range(length):
                writer.add_frame(joint_position=[0.01 * k], images={"front": image(k)})
            writer.save_episode()
        if then is not None:
            raise then


def test_lerobot_decodes_our_videos(tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    datasets = pytest.importorskip("lerobot.datasets")
    record(tmp_path / "set")
    dataset = datasets.LeRobotDataset("local/set", root=tmp_path / "set", video_backend="pyav")
    key = "observation.images.front"
    for index, k in ((0, 0), (17, 17), (29, 29), (30, 0), (49, 19)):
        decoded = 255 * dataset[index][key].numpy().transpose(1, 2, 0)
        assert np.abs(decoded - image(k)).mean() < 4
    statistics = dataset.meta.stats[key]
    assert statistics["mean"].shape == (3, 1, 1)
    assert 0 <= statistics["min"].min() <= statistics["mean"].max() <= 1
    assert check_dataset(tmp_path / "set").ok
    assert len(load_demos(tmp_path / "set")[1]) == 20


def test_videos_survive_a_broken_recording(tmp_path):
    root = tmp_path / "set"
    with pytest.raises(OSError, match="lost"):
        record(root, then=OSError("lost"))
    recover_dataset(root)
    videos = sorted(root.glob("videos/observation.images.front/chunk-000/*.mp4"))
    assert [path.name for path in videos] == ["file-000.mp4", "file-001.mp4"]


def test_discarded_images_leave_no_file(tmp_path):
    with DatasetWriter(tmp_path / "set", 50, "any", ["a"], cameras={"front": SIZE}) as writer:
        for keep in (False, True):
            writer.start_episode("look")
            for k in range(12):
                writer.add_frame(joint_position=[k], images={"front": image(k + 10 * keep)})
            if not keep:
                writer.discard_episode()
                assert not list((tmp_path / "set.recording").glob("*.mp4"))
        writer.save_episode()
        assert video_path(tmp_path / "set.recording", "observation.images.front", 0).exists()


@pytest.mark.parametrize(
    ("images", "message"),
    [
        (None, "images of no camera, expected front"),
        ({"side": image(0)}, "images of side, expected front"),
        ({"front": image(0)[1:]}, r"images of front are \(96, 128, 3\), got \(95, 128, 3\)"),
    ],
)
def test_images_that_do_not_fit_are_refused(tmp_path, images, message):
    with DatasetWriter(tmp_path / "set", 50, "any", ["a"], cameras={"front": SIZE}) as writer:
        writer.start_episode("look")
        with pytest.raises(ValueError, match=message):
            writer.add_frame(joint_position=[0.0], images=images)
        writer.add_frame(joint_position=[0.0], images={"front": image(0)})
        writer.save_episode()
    assert len(load_demos(tmp_path / "set")[0]) == 1


def test_images_of_another_type_leave_no_row_without_an_image(tmp_path):
    with DatasetWriter(tmp_path / "set", 50, "any", ["a"], cameras={"front": SIZE}) as writer:
        writer.start_episode("look")
        refused = pytest.raises(ValueError, match=r"front must be uint8.*got float64")
        with shapes_unchecked(), refused:
            writer.add_frame(joint_position=[0.0], images={"front": image(0) / 255})
        writer.add_frame(joint_position=[0.0], images={"front": image(0)})
        writer.save_episode()
    assert len(load_demos(tmp_path / "set")[0]) == 1


def test_odd_sizes_are_refused_before_anything_is_written(tmp_path):
    with pytest.raises(ValueError, match="even sizes"):
        DatasetWriter(tmp_path / "set", 50, "any", cameras={"front": (95, 128)})
    assert list(tmp_path.iterdir()) == []


def test_a_version_without_its_letter_is_the_same_version(tmp_path):
    root = write_set(tmp_path / "set", **SETS["v3.0 with a camera"])
    before = check_dataset(root)
    write_info(root, read_info(root) | {"codebase_version": 3.0})
    after = check_dataset(root)
    assert after.ok
    assert list(map(str, after.warnings)) == list(map(str, before.warnings))


def read_beginnings(file) -> None:
    """Begin to read a video again and again, while FFmpeg logs through Python."""
    import av

    av.logging.set_level(av.logging.DEBUG)
    for _ in range(100):
        assert next(decode(VideoSegment(file=file, start=0, stop=2), 20))[0] == 0


def test_a_reader_that_ends_early_does_not_wait_for_threads_that_log(tmp_path):
    import av

    file = tmp_path / "video.mp4"
    with av.open(str(file), "w") as container:
        stream = container.add_stream("libx264", rate=20, options={"g": "2"})
        stream.width, stream.height = SIZE[::-1]
        for frame in (*(av.VideoFrame.from_ndarray(image(k)) for k in range(40)), None):
            container.mux(stream.encode(frame))
    # This process reads, too: what PyAV keeps of it lacks its threads in a fork.
    assert len([*decode(VideoSegment(file=file, start=0, stop=2), 20)]) == 40
    reader = multiprocessing.get_context("fork").Process(target=read_beginnings, args=(file,))
    reader.start()
    reader.join(30)
    hangs = reader.is_alive()
    reader.kill()
    assert not hangs
    assert reader.exitcode == 0
