"""Programs of the films in docs/images: their parts, on small examples."""

import sys
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from sample_runs import sample_run

from hrc_learn.vision.landmarks import Finding

sys.path.append(str(Path(__file__).parents[2] / "tools" / "docs"))
import film_pictures  # pyright: ignore[reportMissingImports]
import markerless_film  # pyright: ignore[reportMissingImports]
import multiply_film  # pyright: ignore[reportMissingImports]
import policy_film  # pyright: ignore[reportMissingImports]
import readme_film  # pyright: ignore[reportMissingImports]


def test_noise_of_a_camera_does_not_change_pictures():
    rng = np.random.default_rng(0)
    grey = np.full((40, 60, 3), 120, np.uint8)
    noisy = [grey + rng.integers(-4, 5, grey.shape).astype(np.int8) for _ in range(3)]
    noisy = [picture.astype(np.uint8) for picture in noisy]
    noisy[2][10:20, 10:20] = 200
    first, second, third = film_pictures.still(iter(noisy))
    assert np.array_equal(first, noisy[0])
    assert np.array_equal(second, first)
    assert (third[10:20, 10:20] == 200).all()
    third[10:20, 10:20] = first[10:20, 10:20]
    assert np.array_equal(third, first)


def test_a_film_has_titles_at_both_ends(tmp_path):
    shown = []

    def picture(time):
        shown.append(time)
        return np.full((120, 160, 3), 100 + time, np.uint8)

    out = tmp_path / "film.webp"
    film_pictures.write_film(out, picture, (90.0, 0.0, 100.0), ("first", "last"))
    film = Image.open(BytesIO(out.read_bytes()))
    grey = [film.convert("L").getpixel((80, 20))]
    film.seek(film.n_frames - 1)
    grey.append(film.convert("L").getpixel((80, 20)))
    assert grey == pytest.approx([190, 200], abs=6)
    assert np.asarray(film.convert("L"))[110, 2] < 40  # bar of the title
    assert (shown[0], shown[1], shown[-1]) == (90.0, 0.0, 100.0)
    assert len(shown) == 1 + round(film_pictures.SECONDS * film_pictures.RATE)


def test_captions_of_a_policy_follow_the_speed_of_the_arm():
    assert "waits" in policy_film.said(0.05)
    assert "slows" in policy_film.said(0.5)
    assert "policy moves" in policy_film.said(1.0)
    assert "catches up" in policy_film.said(1.5)
    assert "rests" in policy_film.said(np.nan)


def test_speeds_are_relative_to_those_of_the_policy():
    time = np.arange(100)[:, None] / policy_film.FPS
    wanted = np.repeat(0.5 * np.minimum(time, 3.0), 7, axis=1)
    speed = policy_film.relative(0.2 * wanted, wanted)
    assert speed.shape == (100,)
    assert speed[20:60] == pytest.approx(0.2)
    assert np.isnan(speed[90:]).all()


def test_the_film_shows_a_hand_at_the_elbow_while_it_is_pulled():
    time = np.linspace(0.0, 30.0, 200)
    elbow, push = np.array([0.15, 0.15, 0.56]), np.full((200, 2, 3), np.nan)
    pulled = ((time > 9.9) & (time < 14.1)) | ((time > 19.9) & (time < 22.1))
    push[pulled] = elbow, [0.5, 0.0, 0.56]
    expert = readme_film.expert_in(sample_run(time=time, push=push))

    def reach(at):
        lines, pulls = expert(at)
        return min((np.linalg.norm(line.end - elbow) for line in lines), default=9.0), pulls

    for at in (10.0, 12.0, 13.9, 20.5):
        near, pulls = reach(at)
        assert pulls
        assert near < 0.1  # of the palm: the hand closes round the elbow
    waiting, pulls = reach(17.0)
    assert not pulls
    assert waiting > 0.3
    assert expert(5.0) == ([], False)  # not yet there
    assert expert(29.0) == ([], False)  # gone


def test_the_film_begins_with_the_person_who_pulls_beside_the_worker():
    time = np.linspace(0.0, 30.0, 200)
    push = np.full((200, 2, 3), np.nan)
    push[(time > 9.9) & (time < 14.1)] = [0.15, 0.15, 0.56], [0.5, 0.0, 0.56]
    nearest = np.zeros((200, 2, 3))
    nearest[:, 1, 0] = 0.1 + np.abs(time - 13.0) + 2 * (time < 10.0)
    times = np.linspace(0.0, 30.0, 61).tolist()
    alone = sample_run(time=time, push=push, worker_nearest=None)
    assert readme_film.telling(alone, times) == pytest.approx(12.0, abs=0.5)
    run = sample_run(time=time, push=push, worker_nearest=nearest)
    assert readme_film.telling(run, times) == pytest.approx(13.0, abs=0.2)
    nearest[:, 1, 0] = 1 - 0.5 * (time < 5)  # nearest while nobody pulls
    assert 9.5 < readme_film.telling(run, times) < 14.5


def test_the_film_is_a_picture_that_moves():
    levels = [20, 90, 160, 230]
    pictures = (np.full((60, 640, 3), level, np.uint8) for level in levels)
    shown = Image.open(BytesIO(readme_film.moving_picture(pictures)))
    assert (shown.size, shown.n_frames) == ((640, 60), 4)
    for number, level in enumerate(levels):
        shown.seek(number)
        assert np.asarray(shown.convert("RGB")).mean() == pytest.approx(level, abs=8)


def test_few_motions_appear_first_and_all_at_the_end():
    counts = [multiply_film.count(fraction, 1000) for fraction in (0.0, 0.1, 0.5, 1.0)]
    assert counts == [1, 10, 250, 1000]


def test_the_share_counts_the_motions_that_failed():
    still = np.zeros((2, 4, 4))
    parts = {"joints": still[:, :, 0], "gripper": still[:, 0, 0], "item": still, "duration": 1}
    made = [
        multiply_film.Motion(**parts, path=still[:, 0, :3], tried=tried, judged_by=judge)
        for tried, judge in ((1, "physics: grasping"), (3, "physics: grasping"))
    ]
    assert multiply_film.share(made) == "2 of 4 succeed in physics"


def test_findings_are_drawn_where_they_were_found():
    size, scale = markerless_film.CAMERA, markerless_film.FINE * 360 / 1080
    grey = Image.new("RGB", tuple(markerless_film.FINE * side for side in size), (90, 90, 90))
    points = np.array([[300.0, 300.0], [600.0, 300.0], [600.0, 600.0], [300.0, 600.0]])
    tool = Finding(pixel=np.array([450.0, 450.0]), covariance=0.25 * np.eye(2), points=points)
    target = np.array([900.0, 450.0])
    picture, labels = markerless_film.drawn(grey, {"tool": tool}, target, scale)
    assert picture.size == size
    assert labels[0] == ("arm: 4 points, ± 0.5 px", markerless_film.ARM)
    changed = (np.asarray(picture) != 90).any(axis=-1)
    assert changed[100, 150]  # edge of the outline
    assert changed[150, 150]  # the arm's pixel
    assert changed[145:156, 290:311].any()  # ring around the target
    assert not changed[250:, :].any()
    _, labels = markerless_film.drawn(grey, {}, np.full(2, np.nan), scale)
    assert labels == []
