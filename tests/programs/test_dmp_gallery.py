"""The gallery: its program draws what its page shows."""

import importlib.util
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "concepts" / "dmp_gallery.md").read_text()
SHOWN = re.findall(r"images/dmp_(\w+)\.png", PAGE)


@pytest.fixture(scope="module")
def gallery():
    folder = ROOT / "tools" / "docs"
    sys.path.insert(0, str(folder))
    try:
        spec = importlib.util.spec_from_file_location("dmp_gallery", folder / "dmp_gallery.py")
        module = importlib.util.module_from_spec(spec)
        # Registered, as dataclasses look themselves up there.
        sys.modules["dmp_gallery"] = module
        spec.loader.exec_module(module)
        yield module
    finally:
        sys.path.remove(str(folder))


def test_the_page_shows_every_picture_once(gallery):
    assert sorted(SHOWN) == sorted(gallery.PICTURES)


@pytest.mark.parametrize("name", SHOWN)
def test_pictures_are_there_and_small(name):
    size = (ROOT / "docs" / "images" / f"dmp_{name}.png").stat().st_size
    assert 5_000 < size < 150_000


def test_the_program_draws_what_is_asked_for(gallery, tmp_path):
    gallery.main(gallery.Args(out=tmp_path, only=("moving_goal", "bases")))
    assert {p.name for p in tmp_path.iterdir()} == {"dmp_moving_goal.png", "dmp_bases.png"}
    for picture in tmp_path.iterdir():
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert picture.stat().st_size > 10_000


def test_unknown_pictures_are_refused(gallery, tmp_path):
    with pytest.raises(ValueError, match="no picture portrait; there are joint, scalings"):
        gallery.main(gallery.Args(out=tmp_path, only=("portrait",)))


def test_it_says_what_it_does(run_here):
    status, shown, _ = run_here("tools/docs/dmp_gallery.py", "--help")
    assert status == 0
    assert "Draw the pictures" in shown
    assert "--only" in shown
