"""One page from several runs, and the page of experiments in docs/."""

import importlib.util
import json
import re
import sys
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from commands import done
from PIL import Image

from hrc_learn.experiments import run_report
from hrc_learn.viz import palette
from hrc_learn.viz.film import film_mp4
from hrc_learn.viz.report import (
    Measurement,
    Picture,
    Report,
    Section,
    write_report,
)

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "docs" / "images"


def load(path: Path):
    """A program as a module."""
    name = f"{path.parent.name}_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    # Registered, as dataclasses look themselves up there.
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def runs(tmp_path):
    """Folders of two runs, the second of which missed a target."""
    shades = np.arange(1200, dtype=np.uint8)[None, :, None]
    image = np.broadcast_to(shades, (600, 1200, 3)).copy()
    folders = []
    for i, error in enumerate((0.3, 3.0), 1):
        table = [
            Measurement(name="error", value=error, unit="mm", target=2, claim="none | small"),
            Measurement(name="time", value=10 * i, unit="s"),
        ]
        section = Section(heading="Paths", figures=[Picture("paths", image, "A path")])
        report = Report(title=f"Run number {i}", summary="", table=table, sections=[section])
        folders.append(tmp_path / f"run_{i}")
        write_report(folders[-1], report)
    return folders


def test_one_page_is_made_from_several_runs(runs, tmp_path):
    out, figures = tmp_path / "new" / "page.html", tmp_path / "figures.json"
    done("report", *runs, "--out", out, "--json", figures)
    html = out.read_text(encoding="utf-8")
    for part in ("<h1>Runs</h1>", "Run number 1", "Run number 2", "Side by side"):
        assert part in html
    assert html.count("data:image/png") == 2
    assert json.loads(figures.read_text()) == {
        "run_1_error_mm": 0.3,
        "run_1_time_s": 10,
        "run_2_error_mm": 3.0,
        "run_2_time_s": 20,
    }


def test_runs_in_folders_of_the_same_name_keep_their_values(runs, tmp_path):
    named = [tmp_path / place / "run" for place in "ab"]
    for run, place in zip(runs, named, strict=True):
        place.parent.mkdir()
        run.rename(place)
    figures = tmp_path / "figures.json"
    done("report", *named, "--out", tmp_path / "page.html", "--json", figures)
    found = json.loads(figures.read_text())
    assert (found["run_1_error_mm"], found["run_2_error_mm"]) == (0.3, 3.0)


def test_a_single_run_has_its_own_page(runs, tmp_path):
    done("report", runs[0], "--out", tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert page == (runs[0] / "report.html").read_text(encoding="utf-8")


def test_folders_without_a_report_are_bad_input(runs, tmp_path):
    out = tmp_path / "page.html"
    (line,) = done("report", runs[0], tmp_path, "--out", out, status=2).error.splitlines()
    assert f"{tmp_path} has no report.json" in line
    assert not out.exists()


PAGE = """# Page
![paths](images/placing_paths.png) and ![other](images/grasping_paths.png)
<!-- placing measured -->
old
<!-- end -->
kept
"""


@pytest.fixture
def experiments():
    return load(ROOT / "tools" / "docs" / "experiments.py")


def test_pictures_and_tables_of_the_page_are_refreshed(runs, tmp_path, experiments):
    page = tmp_path / "page.md"
    page.write_text(PAGE)
    experiments.main(experiments.Args(placing=runs[1], page=page, images=tmp_path / "images"))
    text = page.read_text()
    assert text.startswith(PAGE[: PAGE.index("old")])
    assert text.endswith(PAGE[PAGE.index("<!-- end") :])
    assert "| measured | value | target | the paper says |" in text
    assert "| error | 3 mm **(missed)** | ≤ 2 mm | none \\| small |" in text
    assert "| time | 20 s |  |  |" in text
    assert "old" not in text
    assert [path.name for path in (tmp_path / "images").iterdir()] == ["placing_paths.png"]
    picture = Image.open(BytesIO((tmp_path / "images/placing_paths.png").read_bytes()))
    assert picture.size == (1000, 500)


def test_pictures_alone_leave_the_table(runs, tmp_path, experiments):
    page = tmp_path / "page.md"
    page.write_text(PAGE)
    args = {"placing": runs[1], "page": page, "images": tmp_path / "images"}
    experiments.main(experiments.Args(**args, pictures_only=True))
    assert page.read_text() == PAGE
    assert (tmp_path / "images" / "placing_paths.png").is_file()


def test_pictures_are_those_of_all_pages_of_the_site(runs, tmp_path, experiments, monkeypatch):
    """The page of concepts shows pictures that the page of results does not show."""
    page, concepts = tmp_path / "benchmarks.md", tmp_path / "concepts.md"
    page.write_text("no picture")
    concepts.write_text("![posture](images/placing_posture.png)")
    monkeypatch.setattr(experiments, "DOCS", tmp_path)
    monkeypatch.setattr(experiments, "PAGE", page)
    with pytest.raises(ValueError, match="'posture' of placing, but the report has paths"):
        experiments.main(experiments.Args(placing=runs[1], page=page, images=tmp_path))


@pytest.mark.parametrize("kind", ["placing", "grasping", "collaboration"])
def test_the_site_shows_only_pictures_that_reports_have(kind):
    """Else `experiments.py` stops before it has made the others."""
    pages = "\n".join(page.read_text() for page in (ROOT / "docs").rglob("*.md"))
    shown = {*re.findall(rf"images/{kind}_([\w-]+)\.png", pages)}
    captions = {
        name for section in run_report._TEXTS.section.values() for name in section.captions
    }
    assert shown
    assert shown <= captions


@pytest.mark.egl
def test_the_picture_of_the_posture_shows_the_contact_with_the_door(tmp_path):
    posture = load(ROOT / "tools" / "docs" / "null_space_posture.py")
    posture.main(posture.Args(out=tmp_path / "posture.png"))
    picture = np.asarray(Image.open(tmp_path / "posture.png").convert("RGB")).astype(int)
    red = np.abs(picture - palette.rgba(palette.LIMIT)[:3]).max(axis=-1) < 12
    height, width = red.shape
    assert (height, width) == (posture.SIZE[1], 2 * posture.SIZE[0] + posture.GAP)
    assert red[:, : posture.SIZE[0]].sum() > 100  # a circle around the contact
    assert not red[:, posture.SIZE[0] :].any()


def test_lines_keep_their_colours_beside_a_photograph(experiments):
    rng = np.random.default_rng(0)
    photograph = rng.integers(150, 220, size=(300, 400, 3), dtype=np.uint8)
    lines = {40: (0, 114, 178), 80: (0, 158, 115), 120: (230, 159, 0)}
    for row, colour in lines.items():
        photograph[row] = colour
    small = experiments.small(Picture("x", photograph, "").png)
    shown = np.asarray(Image.open(BytesIO(small)).convert("RGB")).astype(int)
    for row, colour in lines.items():
        assert np.abs(shown[row] - colour).max() < 10


def test_a_film_becomes_a_smaller_picture_that_moves(tmp_path):
    program = load(ROOT / "tools" / "docs" / "moving_picture.py")
    film = tmp_path / "film.mp4"
    levels = [20, 20, 120, 120, 220, 220]
    film.write_bytes(film_mp4((np.full((60, 120, 3), x, np.uint8) for x in levels), 30.0))
    out = tmp_path / "film.webp"
    program.main(program.Args(film=film, out=out, width=60, rate=15.0))
    shown = Image.open(out)
    assert (shown.size, shown.n_frames) == ((60, 30), 3)
    for number, level in enumerate(levels[::2]):
        shown.seek(number)
        assert shown.convert("L").getpixel((30, 15)) == pytest.approx(level, abs=10)
        assert shown.info["duration"] == 67
    with pytest.raises(ValueError, match=r"film\.gif: name a file \.webp"):
        program.main(program.Args(film=film, out=tmp_path / "film.gif"))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("![](images/placing_joints.png)", "'joints' of placing, but the report has paths"),
        ("<!-- placing measured -->", "is not followed by <!-- end -->"),
    ],
)
def test_a_page_that_a_run_cannot_fill_is_left_alone(
    runs, tmp_path, experiments, text, complaint
):
    page = tmp_path / "page.md"
    page.write_text(text)
    with pytest.raises(ValueError, match=complaint):
        experiments.main(experiments.Args(placing=runs[0], page=page))
    assert page.read_text() == text
    assert not (tmp_path / "images").exists()


def test_a_page_needs_a_run(experiments):
    with pytest.raises(ValueError, match="no run: give --placing"):
        experiments.main(experiments.Args())


def test_the_pictures_of_the_page_are_there_and_small():
    text = (ROOT / "docs" / "concepts" / "experiments.md").read_text()
    shown = {part.split(")")[0] for part in text.split("(../images/")[1:]}
    for name in shown:
        assert 5_000 < (IMAGES / name).stat().st_size < 200_000, name


class Viewer:
    """A page that draws these pictures, one a screenshot, the last one for ever."""

    def __init__(self, *pictures: bytes):
        self.pictures, self.mouse = list(pictures), self

    def wait_for_timeout(self, milliseconds: float) -> None:
        pass

    def move(self, x: float, y: float) -> None:
        pass

    def screenshot(self, **_: object) -> bytes:
        return self.pictures.pop(0) if len(self.pictures) > 1 else self.pictures[0]


def test_a_dashboard_is_photographed_once_it_stays_the_same():
    dashboards = load(ROOT / "tools" / "docs" / "dashboards.py")
    viewer = Viewer(b"arm", b"arm and plot", b"all", b"all", b"later")
    assert dashboards._settled(viewer, 1.0) == b"all"
    slow = Viewer(b"story", b"story", b"story", b"person", b"person")
    assert dashboards._settled(slow, 1.0, before=b"story") == b"person"
    restless = Viewer(*(bytes([k]) for k in range(100)))
    with pytest.raises(ValueError, match=r"draws for longer than 20 s: raise --pause"):
        dashboards._settled(restless, 1.0)
