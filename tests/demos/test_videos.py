"""Videos of a dataset: found, decoded, passed on as encoded, and recorded."""

import io
import json
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot_folders import joint_path, read_info, write_folder, write_info

from hrc_learn.demos import Demonstration
from hrc_learn.demos.images import ImageReader, camera_images, thumbnails
from hrc_learn.demos.issues import DatasetError, ValidationReport
from hrc_learn.demos.quality import video_checks
from hrc_learn.demos.quality.video_checks import check_videos, read_stream
from hrc_learn.demos.read.dataset_folder import open_folder
from hrc_learn.demos.videos import (
    CameraRecorder,
    VideoSegment,
    decode,
    decode_image,
    encoded_samples,
    image_at,
    read_segments,
    subsampled,
    video_features,
    video_path,
)

av = pytest.importorskip("av")

FPS, SIZE = 20, (32, 48)


def write(path, levels, codec="libx264", rate=FPS, **options):
    """A video of grey images; a key frame every half a second and no images out of order."""
    given = {"g": "10", "bf": "0", **options}
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, options=given)
        stream.height, stream.width = SIZE
        stream.pix_fmt = "yuv420p"
        for level in levels:
            image = np.full((*SIZE, 3), level, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    return path


def copied(file, path, places=None, **options):
    """The same samples, some of them shown at the place of another one."""
    with av.open(str(file)) as source, av.open(str(path), "w", options=options) as sink:
        stream = source.streams.video[0]
        copy = sink.add_stream_from_template(stream)
        packets = [packet for packet in source.demux(stream) if packet.size]
        times = [packet.pts for packet in packets]
        for number, packet in enumerate(packets):
            packet.stream, packet.pts = copy, times[(places or {}).get(number, number)]
            packet.dts -= 2 * packet.duration
            sink.mux(packet)
    return path


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """200 images in 10 s, each as bright as its number."""
    return write(tmp_path_factory.mktemp("video") / "grey.mp4", range(200))


def segment(file, start, stop):
    return VideoSegment(file=file, start=start, stop=stop)


def levels(found):
    """Frames with the image that each of them shows."""
    return {frame: round(float(image.mean())) for frame, image in found}


def assert_levels(found, expected):
    assert [*found] == [*expected]
    # The encoder rounds.
    np.testing.assert_allclose([*found.values()], [*expected.values()], atol=2)


@pytest.mark.parametrize("start", [0.0, 1.0, 1.35, 3.2])
def test_frames_of_an_episode_count_from_its_start(file, start):
    first = round(start * FPS)
    found = levels(decode(segment(file, start, start + 2.5), FPS))
    assert_levels(found, {k: first + k for k in range(50)})


@pytest.mark.parametrize(
    "frames", [[0], [7, 8, 30], [0, 41, 42, 120], [3, 43, 84, 139], [139], range(0, 140, 45)]
)
def test_chosen_frames_are_those_of_the_whole_episode(file, frames):
    found = levels(decode(segment(file, 1.0, 8.0), FPS, frames=frames))
    assert_levels(found, {k: 20 + k for k in frames})


def test_frames_beyond_the_end_of_the_file_are_left_out(file):
    found = levels(decode(segment(file, 9.0, 12.0), FPS))
    assert_levels(found, {k: 180 + k for k in range(20)})
    assert [*decode(segment(file, 9.0, 12.0), FPS, frames=[20, 70])] == []


@pytest.mark.parametrize("rate", [10, 40])
def test_at_another_rate_each_frame_has_one_image_near_its_time(file, rate):
    found = levels(decode(segment(file, 1.0, 3.0), rate))
    assert [*found] == sorted({*found})
    for frame, level in found.items():
        # Within half a period of either, and rounding by the encoder.
        assert abs((level - 20) / FPS - frame / rate) <= 0.5 / rate + 2 / FPS
    assert len(found) >= 19 * min(1, rate / FPS)


def test_images_are_scaled_to_a_size(file):
    (_, image), *_ = decode(segment(file, 1.0, 2.0), FPS, size=(16, 20))
    assert image.shape == (16, 20, 3)
    assert abs(image.mean() - 20) < 3


def test_one_image_is_found_by_its_frame(file, tmp_path):
    one = segment(file, 2.0, 4.0)
    for frame in (0, 13, 39):
        assert abs(image_at(one, frame, FPS).mean() - 40 - frame) < 2
    with pytest.raises(DatasetError, match="ends before frame 160 of the episode"):
        image_at(one, 160, FPS)
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(file.read_bytes()[:500])
    with pytest.raises(DatasetError, match="cannot be decoded"):
        image_at(segment(broken, 0, 1), 0, FPS)


@pytest.mark.parametrize(
    ("start", "stop", "shown"),
    [
        (0.0, 10.0, range(200)),
        (1.0, 2.0, range(20, 40)),
        # Times are rounded by up to a millisecond.
        (0.9995, 2.0005, range(20, 40)),
        (1.0005, 1.9995, range(20, 40)),
        (9.5, 99.0, range(190, 200)),
    ],
)
def test_samples_of_an_episode_are_decoded_to_its_images(file, start, stop, shown):
    found = encoded_samples(segment(file, start, stop))
    assert found.codec == "h264"
    np.testing.assert_allclose(found.time, np.array(shown) / FPS - start, atol=1e-9)
    decoder = av.CodecContext.create("h264", "r")
    packets = [*map(av.Packet, found.samples), None]
    images = [image.to_ndarray(format="rgb24") for p in packets for image in decoder.decode(p)]
    np.testing.assert_allclose([image.mean() for image in images], shown, atol=2)


def test_some_videos_have_to_be_decoded(file, tmp_path):
    other = write(tmp_path / "other.mp4", range(20), "mpeg4")
    assert encoded_samples(segment(other, 0, 1)) is None
    # Images that are shown in another order than they are decoded in.
    swapped = copied(file, tmp_path / "swapped.mp4", {3: 4, 4: 3})
    assert encoded_samples(segment(swapped, 0, 1)) is None
    (tmp_path / "text.mp4").write_text("no video")
    for name in ("text.mp4", "absent.mp4"):
        with pytest.raises(DatasetError, match="cannot be read as a video"):
            encoded_samples(segment(tmp_path / name, 0, 1))


def test_vp9_needs_no_filter(tmp_path):
    path = write(tmp_path / "a.webm", range(0, 200, 20), "libvpx-vp9")
    found = encoded_samples(segment(path, 0, 1))
    assert found.codec == "vp9"
    np.testing.assert_allclose(found.time, np.arange(10) / FPS, atol=1e-3)


def test_an_image_file_is_decoded_and_scaled():
    from PIL import Image

    picture = np.random.default_rng(0).integers(0, 255, (6, 8, 3), np.uint8)
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, "png")
    np.testing.assert_array_equal(decode_image(stream.getvalue()), picture)
    assert decode_image(stream.getvalue(), (4, 10)).shape == (4, 10, 3)
    for content in (b"", b"no image", stream.getvalue()[:20]):
        with pytest.raises(DatasetError, match="holds an image that cannot be decoded"):
            decode_image(content)


@pytest.mark.parametrize(
    ("size", "stride"),
    [((40, 60), 1), ((299, 10), 1), ((10, 300), 2), ((480, 640), 4), ((450, 449), 3)],
)
def test_statistics_see_images_of_150_pixels(size, stride):
    image = np.random.default_rng(0).integers(0, 255, (*size, 3), np.uint8)
    np.testing.assert_array_equal(subsampled(image), image[::stride, ::stride])


# Datasets


def dataset(root, version, lengths=(30, 20)):
    episodes = [{"observation.state": joint_path(length)} for length in lengths]
    write_folder(root, episodes, {"observation.state": "abc"}, version=version, videos=["cam"])
    info = read_info(root)
    info["chunks_size"] = 1
    info["video_path"] = (
        "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
        if version == "v3.0"
        else "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
    )
    write_info(root, info)
    return root


def list_videos(root, **columns):
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    for name, values in columns.items():
        table = table.append_column(f"videos/cam/{name}", pa.array(values))
    pq.write_table(table, path)


def test_version_2_keeps_a_file_for_each_episode(tmp_path):
    root = dataset(tmp_path, "v2.1")
    made = root / "videos/chunk-001/cam/episode_000001.mp4"
    made.parent.mkdir(parents=True)
    made.touch()
    folder = open_folder(root)
    assert {index: {**found} for index, found in read_segments(folder).items()} == {
        0: {},
        1: {"cam": segment(made, 0.0, 0.4)},
    }
    every = read_segments(folder, missing=True)
    first = root / "videos/chunk-000/cam/episode_000000.mp4"
    assert every[0]["cam"] == segment(first, 0.0, 0.6)


def test_version_3_lists_the_part_of_each_episode(tmp_path):
    root = dataset(tmp_path, "v3.0", (30, 20, 10))
    list_videos(
        root,
        chunk_index=[0, 2, None],
        file_index=[1, 3, None],
        from_timestamp=[0.0, 7, None],
        to_timestamp=[0.6, 7.4, None],
    )
    folder = open_folder(root)
    one, two = root / "videos/cam/chunk-000/file-001.mp4", "videos/cam/chunk-002/file-003.mp4"
    assert {index: {**found} for index, found in read_segments(folder, True).items()} == {
        0: {"cam": segment(one, 0.0, 0.6)},
        1: {"cam": segment(root / two, 7.0, 7.4)},
        2: {},
    }
    assert not any(read_segments(folder).values())


def test_a_part_without_its_times_is_named(tmp_path):
    root = dataset(tmp_path, "v3.0")
    list_videos(root, chunk_index=[0, 0], file_index=[0, 0], from_timestamp=[0.0, None])
    with pytest.raises(DatasetError, match="must be a number, got None") as caught:
        read_segments(open_folder(root))
    issue = caught.value.issue
    assert (issue.episode, issue.key) == (0, "videos/cam/to_timestamp")


# Recording


def test_cameras_are_declared_as_videos():
    assert json.loads(json.dumps(video_features({"front": (4, 6)}))) == {
        "observation.images.front": {
            "dtype": "video",
            "shape": [4, 6, 3],
            "names": ["height", "width", "channels"],
        }
    }


@pytest.mark.parametrize("size", [(0, 2), (2, 0), (-2, 2), (3, 2), (2, 3)])
def test_sizes_that_a_video_cannot_have(tmp_path, size):
    with pytest.raises(ValueError, match="videos need even sizes"):
        CameraRecorder({"front": (2, 2), "side": size}, 50, tmp_path)


@pytest.mark.parametrize(
    ("fps", "rate"), [(20, Fraction(20)), (30000 / 1001, Fraction(30000, 1001)), (12.5, 12.5)]
)
def test_a_recorded_video_has_its_rate_and_every_second_image_is_whole(tmp_path, fps, rate):
    recorder = CameraRecorder({"front": SIZE}, fps, tmp_path)
    images = [np.full((*SIZE, 3), 10 * k, np.uint8) for k in range(13)]
    for image in images:
        recorder.append({"front": image})
    (key, statistics), *more = recorder.finish(7).items()
    assert (key, more) == ("observation.images.front", [])
    path = video_path(tmp_path, key, 7)
    assert [*tmp_path.iterdir()] == [path]
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.average_rate == rate
        packets = [packet for packet in container.demux(stream) if packet.size]
        assert [packet.is_keyframe for packet in packets] == [k % 2 == 0 for k in range(13)]
    assert_levels(
        levels(decode(segment(path, 0, 13 / fps), fps)), {k: 10 * k for k in range(13)}
    )
    # Every fifth image, each with all its pixels.
    values = np.repeat([0, 50, 100], SIZE[0] * SIZE[1]) / 255
    assert statistics["count"] == [3]
    for name, expected in (
        ("min", 0),
        ("max", values.max()),
        ("mean", values.mean()),
        ("std", values.std()),
    ):
        np.testing.assert_allclose(statistics[name], np.full((3, 1, 1), expected), atol=1e-12)
    assert recorder.finish(8) == {}


def test_a_discarded_episode_leaves_no_file_even_if_it_is_gone(tmp_path):
    recorder = CameraRecorder({"front": SIZE, "side": SIZE}, 20, tmp_path)
    image = np.zeros((*SIZE, 3), np.uint8)
    for _ in range(60):  # the encoder holds the first ones back
        recorder.append({"front": image, "side": image})
    assert len([*tmp_path.iterdir()]) == 2
    (tmp_path / "side.unfinished.mp4").unlink()
    recorder.discard()
    assert not [*tmp_path.iterdir()]
    recorder.append({"front": image, "side": image})
    recorder.finish(0)
    assert len([*tmp_path.iterdir()]) == 2


# Checks


def test_images_of_a_file_are_counted_with_its_rate_and_size(file):
    assert read_stream(file) == (200, FPS, SIZE)


def test_a_file_that_breaks_off_is_told(file, tmp_path):
    """The index comes first, as for streaming, and the images end early."""
    path = copied(file, tmp_path / "front.mp4", movflags="faststart")
    assert read_stream(path) == (200, FPS, SIZE)
    with av.open(str(path)) as container:
        last = [p for p in container.demux(video=0) if p.size][25]
        end = last.pos + last.size
    content = path.read_bytes()
    for size, fault in ((end, "breaks off: holds 26 of 200 images"), (end - 3, "damaged pack")):
        path.write_bytes(content[:size])
        with pytest.raises(DatasetError, match=fault):
            read_stream(path)
    path.write_text("no video")
    with pytest.raises(DatasetError, match="is no video that can be read"):
        read_stream(path)


def filmed(root, version="v2.1", lengths=(30, 20), size=SIZE, shown=None):
    """A dataset whose videos brighten by one level a frame, each from its own level on."""
    dataset(root, version, lengths)
    info = read_info(root)
    info["features"]["cam"]["shape"] = [*size, 3]
    write_info(root, info)
    for number, length in enumerate(lengths):
        path = root / f"videos/chunk-{number:03d}/cam/episode_{number:06d}.mp4"
        path.parent.mkdir(parents=True)
        levels = range(40 * number, 40 * number + length) if shown is None else shown(length)
        write(path, levels, rate=50)
    return root


def findings(root):
    report = ValidationReport(path=root)
    check_videos(open_folder(root), report)
    return [
        (one.level, one.episode, one.file, one.message)
        for one in (*report.errors, *report.warnings)
    ]


def second(root):
    return root / "videos/chunk-001/cam/episode_000001.mp4"


def test_sound_videos_have_no_findings(tmp_path):
    assert findings(filmed(tmp_path)) == []


def test_videos_that_are_missing(tmp_path):
    root = filmed(tmp_path)
    second(root).unlink()
    (found,) = findings(root)
    assert found[:2] == ("error", 1)
    assert found[2] == "videos/chunk-001/cam/episode_000001.mp4"
    assert "not found" in found[3]
    (root / "videos/chunk-000/cam/episode_000000.mp4").unlink()
    (found,) = findings(root)
    assert found[:3] == ("warning", None, "videos/**/cam")
    assert "no file of it is here" in found[3]


def test_an_episode_without_a_place_in_a_video(tmp_path):
    root = dataset(tmp_path, "v3.0", (30, 20))
    list_videos(
        root,
        chunk_index=[0, None],
        file_index=[0, None],
        from_timestamp=[0.0, None],
        to_timestamp=[0.6, None],
    )
    (root / "videos/cam/chunk-000").mkdir(parents=True)
    info = read_info(root)
    info["features"]["cam"]["shape"] = [*SIZE, 3]
    write_info(root, info)
    write(root / "videos/cam/chunk-000/file-000.mp4", range(30), rate=50)
    (found,) = findings(root)
    assert found == ("error", 1, None, "the list of episodes names no video")


def test_a_copy_of_a_video_is_named_with_its_original(tmp_path):
    root = filmed(tmp_path, lengths=(20, 20, 20))
    first = root / "videos/chunk-000/cam/episode_000000.mp4"
    second(root).write_bytes(first.read_bytes())
    third = root / "videos/chunk-002/cam/episode_000002.mp4"
    third.write_bytes(first.read_bytes())
    assert [(level, episode, text) for level, episode, _, text in findings(root)] == [
        ("warning", k, "is the same video as that of episode 0") for k in (1, 2)
    ]


def test_a_video_of_the_wrong_length_size_or_content(tmp_path):
    root = filmed(tmp_path)
    write(second(root), range(60, 82), rate=50)
    assert [found[3][:50] for found in findings(root)] == [
        "shows 22 images, but the episode has 20 frames: it"
    ]
    write(second(root), range(60, 80), rate=20)
    assert findings(root)[0][3] == "runs at 20 images a second, the dataset at 50"
    second(root).write_text("no video")
    ((level, episode, _, text),) = findings(root)
    assert (level, episode) == ("error", 1)
    assert "is no video that can be read" in text
    info = read_info(root)
    info["features"]["cam"]["shape"] = [SIZE[0], SIZE[1] + 2, 3]
    write_info(root, info)
    assert findings(root)[0][3] == "has images of 32 x 48, but [32, 50, 3] is declared"


def test_images_that_never_change_are_named(tmp_path):
    root = filmed(tmp_path, lengths=(20, 2, 3), shown=lambda length: [(90, 30, 200)] * length)
    still = [(episode, text) for _, episode, _, text in findings(root) if "shows" in text]
    text = "shows one colour at the beginning, in the middle and at the end"
    # Two images may be alike.
    assert still == [(0, text), (2, text)]
    # A camera that was frozen shows a picture.
    picture = np.linspace(40, 200, SIZE[1]).astype(int)[:, None]
    write(root / "videos/chunk-002/cam/episode_000002.mp4", [picture] * 3, rate=50, qp="0")
    assert findings(root)[-1][3] == text.replace("one colour", "the same image")
    # One image at a third of the episode differs.
    path = root / "videos/chunk-000/cam/episode_000000.mp4"
    write(path, [90] * 6 + [30] + [90] * 13, rate=50)
    assert [one[1] for one in findings(root) if "shows" in one[3]] == [2]
    write(path, [90] * 13 + [30] + [90] * 6, rate=50)
    assert [one[1] for one in findings(root) if "shows" in one[3]] == [2]


def test_of_many_files_only_so_many_are_examined(tmp_path, monkeypatch):
    root = filmed(tmp_path, lengths=(20, 20, 20))
    for number in (1, 2):
        (root / f"videos/chunk-{number:03d}/cam/episode_{number:06d}.mp4").write_text("x")
    monkeypatch.setattr(video_checks, "_MOST_FILES", 2)
    found = [(level, text[:35]) for level, _, _, text in findings(root)]
    assert found[1:] == [("warning", "1 further videos were not examined")]
    assert found[0][0] == "error"


# Readers


@pytest.mark.parametrize(
    ("shape", "size"),
    [
        ([32, 48, 3], (32, 48)),
        ([3, 32, 48], (32, 48)),
        ([1, 5, 7], (5, 7)),
        ([4, 6, 3], (4, 6)),
        ([3, 9, 4], (3, 9)),
        ([32, 48, 2], (32, 48)),
        ([32, 48], None),
    ],
)
def test_sizes_are_declared_with_channels_first_or_last(tmp_path, shape, size):
    root = dataset(tmp_path, "v2.1")
    info = read_info(root)
    info["features"]["cam"]["shape"] = shape
    write_info(root, info)
    reader = ImageReader(root)
    assert reader.cameras == ("cam",)
    if size is None:
        with pytest.raises(DatasetError, match=r"declares images of the shape \[32, 48\]"):
            reader.size("cam")
    else:
        assert reader.size("cam") == size


def test_images_of_an_episode_are_read_in_any_order(tmp_path):
    root = filmed(tmp_path)
    reader = ImageReader(root)
    assert reader.segment(1, "cam") == segment(second(root), 0.0, 0.4)
    assert (reader.available(1), reader.available(9)) == (("cam",), ())
    images = reader.read(1, frames=[19, 0, 0, 7])["cam"]
    assert images.shape == (4, 3, *SIZE)
    np.testing.assert_allclose(images.float().mean((1, 2, 3)), [59, 40, 40, 47], atol=2)
    assert len(reader.read(1)["cam"]) == 20
    assert reader.read(1, cameras=[]) == {}
    assert [frame for frame, _ in reader.stream(1, "cam", [3, 5])] == [3, 5]
    assert [*reader.stream(1, "cam", [])] == []
    for frames in ([-1], [3, 20]):
        with pytest.raises(DatasetError, match=f"has no frames {frames[0]} to"):
            reader.read(1, frames=frames)
    write(second(root), range(40, 50), rate=50)
    with pytest.raises(DatasetError, match="holds no image of frame 10") as caught:
        reader.read(1)
    assert (caught.value.issue.episode, caught.value.issue.frame) == (1, 10)


def test_thumbnails_are_five_a_second_and_spread_over_the_episode(tmp_path):
    root = filmed(tmp_path, lengths=(61, 20))
    reader = ImageReader(root)
    demos = [
        Demonstration(time=np.arange(n) / 50, gripper=np.zeros(n), fps=50, episode=k)
        for k, n in enumerate((61, 20))
    ]
    shown = thumbnails(reader, demos[0], "cam")
    # 1.2 s hold seven of them, from the first frame to the last.
    np.testing.assert_allclose(shown.time, np.arange(7) / 5, atol=1e-6)
    levels = [decode_image(file).mean() for file in shown.samples]
    np.testing.assert_allclose(levels, np.arange(0, 61, 10), atol=3)
    assert len(thumbnails(reader, demos[0], "cam", 3).time) == 3
    thin = replace(demos[1], time=10 * demos[1].time)
    assert len(thumbnails(reader, thin, "cam").time) == 20
    (found,) = camera_images(reader, demos[1])
    assert (found[0], found[1].codec) == ("cam", "h264")
    # A robot that was read more slowly than at the nominal rate is shown at its own stamps.
    ((_, late),) = camera_images(reader, replace(demos[1], time=1.2 * demos[1].time))
    np.testing.assert_allclose(found[1].time, demos[1].time, atol=1e-6)
    np.testing.assert_allclose(late.time, 1.2 * demos[1].time, atol=1e-6)
    second(root).write_text("no video")
    ((_, error),) = camera_images(reader, demos[1])
    assert isinstance(error, DatasetError)
