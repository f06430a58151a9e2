"""Programs of the films in docs/images: their parts, on small examples."""

import sys
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

sys.path.append(str(Path(__file__).parents[2] / "tools" / "docs"))
import film_pictures  # pyright: ignore[reportMissingImports]


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
    policy_film = pytest.importorskip("policy_film")
    assert "waits" in policy_film.said(0.05)
    assert "slows" in policy_film.said(0.5)
    assert "policy moves" in policy_film.said(1.0)
    assert "catches up" in policy_film.said(1.5)
    assert "rests" in policy_film.said(np.nan)


def test_speeds_are_relative_to_those_of_the_policy():
    policy_film = pytest.importorskip("policy_film")
    time = np.arange(100)[:, None] / policy_film.FPS
    wanted = np.repeat(0.5 * np.minimum(time, 3.0), 7, axis=1)
    speed = policy_film.relative(0.2 * wanted, wanted)
    assert speed.shape == (100,)
    assert speed[20:60] == pytest.approx(0.2)
    assert np.isnan(speed[90:]).all()
