"""Thumbnails: few, small, and each at the time of its frame."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from clean_sets import CAMERA, SIZE, bar, write_set

from hrc_learn.demos import load_demos, load_images
from hrc_learn.demos.images import ImageReader, thumbnail_size, thumbnails
from hrc_learn.demos.videos import decode_image

# Whole datasets are written and read; shapes are checked in the other tests of this folder.
pytestmark = pytest.mark.simulation


@pytest.mark.parametrize("version", ["v3.0", "v2.1"])
def test_thumbnails_are_few_and_small_and_at_the_times_of_their_frames(version, tmp_path):
    root = write_set(tmp_path / "set", version, camera=True)
    demo = load_demos(root)[1]
    # One whose frames were thinned, as the fit of a long one does.
    few = np.linspace(0, len(demo) - 1, 12).round().astype(int)
    thinned = replace(
        demo,
        **{name: getattr(demo, name)[few] for name in demo.recorded},
        fps=demo.fps * 11 / (len(demo) - 1),
        extra={},
    )
    every = load_images(root, 1)[CAMERA]
    for read in (demo, thinned):
        shown = thumbnails(ImageReader(root), read, CAMERA)
        time, files = shown.time, shown.samples
        assert len(files) == len(time) == 1 + int(5 * demo.duration)
        assert (time[0], time[-1]) == (0, pytest.approx(demo.duration))
        for at, file in zip(time, files, strict=True):
            frame = round(at * demo.fps)
            seen = torch.from_numpy(decode_image(file)).permute(2, 0, 1)
            assert seen.shape[1:] == SIZE  # lower than 240 rows already
            assert abs(bar(seen) - bar(every[frame])) <= 1


def test_of_long_episodes_only_so_many_are_taken(tmp_path):
    root = write_set(tmp_path / "set", "v2.1", camera=True)
    demo = load_demos(root)[0]
    shown = thumbnails(ImageReader(root), demo, CAMERA, 4)
    assert len(shown.samples) == 4
    np.testing.assert_allclose(np.diff(shown.time), demo.duration / 3, atol=1 / demo.fps)


def test_tall_images_are_scaled_to_even_sides():
    assert thumbnail_size(480, 641) == (240, 320)
    assert thumbnail_size(241, 97) == (240, 96)
    assert thumbnail_size(100, 75) == (100, 76)
