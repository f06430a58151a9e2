"""Features found in videos: where they are, kept beside the dataset, whatever breaks off."""

from pathlib import Path

import numpy as np
import pytest
from lerobot_folders import joint_path, write_folder

from hrc_learn.demos import (
    DatasetError,
    DatasetWriter,
    RepairOptions,
    attach_features,
    extract_features,
    load_demos,
    open_demos,
    repair_dataset,
)
from hrc_learn.demos.image_features import FeatureCache, camera_key

# Whole datasets are written and read; shapes are checked in the other tests of this folder.
pytestmark = pytest.mark.simulation

SIZE = (48, 64)
FRAMES = (45, 50)


def path_of_spot(episode: int) -> np.ndarray:
    """Pixels (u, v) along an episode."""
    k = np.arange(FRAMES[episode])
    return np.stack([8 + k, 22 - 8 * np.sin(0.1 * k) * (1 + episode)], axis=1)


def draw(spot: np.ndarray) -> np.ndarray:
    """A bright square of 8 pixels on grey, anti-aliased by its position."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    inside = np.clip(4.5 - np.abs(u - spot[0]), 0, 1) * np.clip(4.5 - np.abs(v - spot[1]), 0, 1)
    return np.repeat((40 + 200 * inside)[..., None], 3, axis=2).astype(np.uint8)


def brightest(image: np.ndarray) -> np.ndarray | None:
    """Middle of what is bright, None where nothing is."""
    weight = np.clip(image[..., 1].astype(float) - 60, 0, None)
    if weight.sum() < 100:
        return None
    v, u = np.mgrid[: image.shape[0], : image.shape[1]]
    return np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()


def record(root, still=0):
    """Two episodes with a spot that moves; in frame 7 of each it is hidden."""
    with DatasetWriter(root, 50, "any", ["a"], cameras={"front": SIZE}) as writer:
        for episode in range(2):
            writer.start_episode("look")
            for k, spot in enumerate(path_of_spot(episode)):
                image = draw(np.array([-50.0, -50.0]) if k == 7 else spot)
                q = [0.02 * max(k - still, 0)]
                writer.add_frame(joint_position=q, images={"front": image})
            writer.save_episode()
    return root


def assert_tracks(demos, first=0):
    for demo in demos:
        truth = path_of_spot(demo.episode)
        seen = np.arange(len(truth)) != 7
        assert demo.feature_visible.tolist() == seen[first : first + len(demo)].tolist()
        rows = np.flatnonzero(demo.feature_visible)
        np.testing.assert_allclose(demo.feature[rows], truth[first:][rows], atol=0.5)


def test_features_are_found_where_they_are_and_loaded_without_asking(tmp_path):
    root = record(tmp_path / "set")
    before = {p: p.read_bytes() for p in sorted(root.glob("**/*")) if p.is_file()}
    assert load_demos(root)[0].feature is None
    done = extract_features(root, "spot", lambda: brightest)
    assert (done.name, done.episodes, done.known) == ("front.spot", 2, 0)
    assert (done.frames, done.seen, done.without_image) == (95, 93, 0)
    demos = load_demos(root)
    assert_tracks(demos)
    assert "front.spot" in " ".join(demos.notes)
    assert_tracks(open_demos(root))
    assert {p: p.read_bytes() for p in sorted(root.glob("**/*")) if p.is_file()} == before
    assert load_demos(root, mapping={"feature": None})[0].feature is None


def test_what_was_broken_off_goes_on_where_it_was(tmp_path):
    root, looked = record(tmp_path / "set"), []

    def unlucky(episodes):
        yield episodes[0]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        extract_features(root, "spot", lambda: brightest, progress=unlucky)
    demos = load_demos(root)
    assert_tracks(demos[:1])
    assert not demos[1].feature_visible.any()
    assert any("not extracted from 1 episodes (1)" in note for note in demos.notes)
    with pytest.raises(DatasetError, match=r"episode 1: front\.spot was not extracted"):
        attach_features(demos)

    def counting(image):
        looked.append(1)
        return brightest(image)

    done = extract_features(root, "spot", lambda: counting)
    assert (done.episodes, done.known, len(looked)) == (1, 1, 50)
    assert_tracks(load_demos(root))
    assert extract_features(root, "spot", lambda: counting).known == 2
    # Another video under the same name is another video.
    video = next(iter(sorted((root / "videos").glob("**/*.mp4"))))
    content = video.read_bytes()
    video.unlink()
    video.write_bytes(content)
    assert extract_features(root, "spot", lambda: counting).known == 1


def test_parts_of_videos_are_looked_at_from_their_own_start(tmp_path):
    root = record(tmp_path / "set", still=25)
    options = RepairOptions()
    repair_dataset(root, tmp_path / "part", options)
    extract_features(tmp_path / "part", "spot", lambda: brightest)
    demos = load_demos(tmp_path / "part")
    first = round(demos[0].start_time * 50)
    assert first > 8
    assert_tracks(demos, first)


def test_several_features_are_chosen_among(tmp_path):
    root = record(tmp_path / "set")
    extract_features(root, "spot", lambda: brightest)
    extract_features(root, "nothing", lambda: lambda image: None, camera="front")
    demos = load_demos(root)
    assert demos[0].feature is None
    assert_tracks(attach_features(demos, "front.spot"))
    assert not attach_features(demos, "front.nothing")[0].feature_visible.any()
    with pytest.raises(DatasetError, match=r"name the feature.*front\.nothing, front\.spot"):
        attach_features(demos)
    with pytest.raises(DatasetError, match="no feature 'left'"):
        attach_features(demos, "left")


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        (lambda video: video.write_bytes(video.read_bytes()[:200]), "cannot be decoded"),
        (lambda video: video.write_bytes(b""), "cannot be decoded"),
        (lambda video: video.unlink(), "its video is missing"),
    ],
)
def test_a_bad_video_is_listed_and_keeps_none_of_the_others_out(tmp_path, bad, said):
    root = record(tmp_path / "set")
    first, _ = sorted((root / "videos").glob("**/*.mp4"))
    whole = first.read_bytes()
    bad(first)
    done = extract_features(root, "spot", lambda: brightest)
    assert (done.episodes, done.frames, [*done.left_out]) == (1, 50, [0])
    assert said in done.left_out[0]
    alone = load_demos(root, episodes=[1])
    assert_tracks(alone)
    assert not any("not extracted" in note for note in alone.notes)
    demos = load_demos(root)
    assert not demos[0].feature_visible.any()
    assert_tracks(demos[1:])
    assert any("not extracted from 1 episodes (0)" in note for note in demos.notes)
    # Copied again, it is all that is left to look at.
    first.write_bytes(whole)
    done = extract_features(root, "spot", lambda: brightest)
    assert (done.episodes, done.known, done.left_out) == (1, 1, {})
    assert_tracks(load_demos(root))


def test_what_cannot_be_looked_at_is_told(tmp_path):
    root = record(tmp_path / "set")
    with pytest.raises(DatasetError, match=r"no camera 'side'; .*observation\.images\.front"):
        extract_features(root, "spot", lambda: brightest, camera="side")
    bare = write_folder(tmp_path / "bare", [{"state": joint_path()}], {})
    with pytest.raises(DatasetError, match="has videos of none"):
        extract_features(bare, "spot", lambda: brightest)


@pytest.mark.parametrize(
    ("count", "named"),
    [(0, None), (1, "(0)"), (5, "(0, 1, 2, 3, 4)"), (6, "(0, 1, 2, 3, 4, ...)")],
)
def test_episodes_without_a_feature_are_named(tmp_path, count, named):
    notes = FeatureCache(tmp_path / "set", "front.marker").note(range(count))
    assert len(notes) == (named is not None)
    assert all(f"was not extracted from {count} episodes {named} and" in note for note in notes)


@pytest.mark.parametrize(
    ("keys", "camera", "found"),
    [
        (["observation.images.a"], None, "observation.images.a"),
        (["observation.images.a", "observation.images.b"], "b", "observation.images.b"),
        (["observation.images.a", "x"], "x", "x"),
        (["observation.images.a", "x"], None, "name the camera; the dataset has videos of obs"),
        (
            ["observation.images.a"],
            "b",
            "there is no camera 'b'; the dataset has videos of obs",
        ),
        ([], None, "there is no camera None; the dataset has videos of none"),
    ],
)
def test_the_camera_is_the_named_or_the_only_one(keys, camera, found):
    if found in keys:
        assert camera_key(keys, camera) == found
    else:
        with pytest.raises(DatasetError, match=found):
            camera_key(keys, camera)


def test_features_of_the_folder_where_one_is_lie_next_to_it(tmp_path, monkeypatch):
    (tmp_path / "set").mkdir()
    monkeypatch.chdir(tmp_path / "set")
    for root in (".", "../set", tmp_path / "set"):
        path = FeatureCache(Path(root), "front.m").path(3)
        assert path.parent.resolve() == tmp_path / "set.features/front.m"
