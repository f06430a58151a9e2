"""The gallery: every picture of docs/images is made by one of its commands."""

import re
import shlex
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2] / "tools"))
import build_gallery  # pyright: ignore[reportMissingImports]

ROOT = Path(__file__).parents[2]
NAMED = re.compile(r"\]\([^)\s]*images/([\w.-]+)\)")
"""Picture that a page shows or links to."""
PICTURES = [file for program in build_gallery.PROGRAMS for file in program.pictures]


def test_every_picture_is_made_by_one_command():
    there = [path.name for path in (ROOT / "docs" / "images").iterdir()]
    assert sorted(PICTURES) == sorted(there)


def test_every_picture_that_a_page_shows_is_made():
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    shown = {name: page for page in pages for name in NAMED.findall(page.read_text("utf-8"))}
    assert shown
    assert {name: page.name for name, page in shown.items() if name not in PICTURES} == {}


def test_commands_are_programs_of_the_checkout():
    for program in build_gallery.PROGRAMS:
        word, script, *_ = shlex.split(program.command)
        assert word == "python"
        assert (ROOT / script).is_file()
        assert set(program.needs) <= build_gallery.RUNS.keys()
        assert program.captions.keys() <= set(program.pictures)


def test_single_pictures_and_the_runs_they_need(tmp_path):
    made = build_gallery.commands(["dmp_pose", "dmp_bases", "dashboard_story"], tmp_path)
    assert made == [
        "hrc demo",
        "hrc run collaboration --pulls random --worker --out outputs/near_worker",
        "python tools/docs/dashboards.py --run outputs/near_worker/run.rrd --tabs story",
        "python tools/docs/dmp_gallery.py --out docs/images --only pose bases",
    ]
    (tmp_path / "outputs/demo").mkdir(parents=True)
    assert build_gallery.commands(["film"], tmp_path) == ["python tools/docs/readme_film.py"]


def test_all_pictures_are_made_by_default_and_runs_once(tmp_path):
    made = build_gallery.commands([], tmp_path)
    assert made.count("hrc demo") == 1
    assert {program.command for program in build_gallery.PROGRAMS} <= set(made)
    assert set(made) >= set(build_gallery.RUNS.values())


def test_unknown_pictures_are_refused(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["build_gallery.py", "--only", "portrait"])
    assert build_gallery.main() == 2
    assert "no picture portrait; there are film, " in capsys.readouterr().err


def test_commands_that_fail_are_named(monkeypatch, capsys):
    run = []
    monkeypatch.setattr(build_gallery, "run", lambda line: run.append(line) or "ar" in line)
    monkeypatch.setattr(sys, "argv", ["build_gallery.py", "--only", "ar", "dmp_joint"])
    monkeypatch.setattr(build_gallery, "commands", lambda *_: ["make ar", "make dmp"])
    assert build_gallery.main() == 1
    assert run == ["make ar", "make dmp"]
    assert capsys.readouterr().out == "failed, or missed a target: make ar\n"


def test_the_page_shows_all_pictures_with_captions_and_commands():
    page = build_gallery.page(ROOT)
    for program in build_gallery.PROGRAMS:
        assert f"\n{program.command}\n" in page
    for file in PICTURES:
        assert page.count(f"](images/{file})") == 1
    assert "\n\nA run: overview\n" in page


def test_a_checkout_without_pictures_has_an_empty_page(tmp_path: Path):
    assert build_gallery.page(tmp_path) == "# Gallery\n"


def test_no_command_changes_the_tables_of_a_page():
    lines = [p.command for p in build_gallery.PROGRAMS if "experiments.py" in p.command]
    assert len(lines) == 3
    assert all("--pictures-only" in line for line in lines)
