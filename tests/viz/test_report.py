import base64
import math
import platform
import re
import shutil
import sys
from dataclasses import replace
from html.parser import HTMLParser
from io import BytesIO

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from hrc_learn.viz.report import (
    Film,
    Measurement,
    Picture,
    Report,
    Section,
    flatten,
    leading,
    read_report,
    reports_page,
    show_command,
    show_measurements,
    software_versions,
    write_report,
)

VOID = {"meta", "img", "br", "link", "hr", "source"}
NASTY = '<script>alert("x")</script> & co'


class Page(HTMLParser):
    """Checks that tags nest, and collects text, images and attributes."""

    def __init__(self, html: str):
        super().__init__()
        self.open: list[str] = []
        self.texts: list[str] = []
        self.images: list[str] = []
        self.links: list[str] = []
        self.anchors: list[str] = []
        self.rows: list[list[str]] = []
        self.tags: set[str] = set()
        self.feed(html)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        values = dict(attrs)
        if tag == "img":
            self.images.append(values["src"])
        if "href" in values:
            self.links.append(values["href"])
        if "id" in values:
            self.anchors.append(values["id"])
        if tag == "tr":
            self.rows.append([])
        if tag == "td":
            self.rows[-1].append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)
        if "td" in self.open:
            self.rows[-1][-1] += data


def figure() -> Figure:
    fig = Figure(figsize=(3, 2))
    fig.subplots().plot([0, 1], [1, 0])
    return fig


def report(**changes) -> Report:
    content = {
        "title": "Grasp",
        "summary": "First.\n\nSecond.",
        "table": [Measurement(name="Goal error", value=0.312, unit="mm", target=2)],
        "sections": [
            Section(
                heading="Path", text="Text.", figures=[Picture("path", figure(), "A caption")]
            )
        ],
        "configuration": {"controller": {"k_v": 0.3}, "seed": 0},
        "versions": {"numpy": "2.2.6"},
        "command": "python run.py --seed 0",
    }
    return Report(**(content | changes))


def page(**changes) -> Page:
    return Page(reports_page("Page", [report(**changes)]))


def row(m: Measurement) -> list[str]:
    (found,) = [row for row in page(table=[m]).rows if row and row[0] == m.name]
    return found


def test_the_page_holds_everything_it_was_given():
    shown = page()
    text = " ".join(" ".join(shown.texts).split())  # words of the command are apart
    for part in ("Grasp", "First.", "Second.", "Path", "A caption", "python run.py --seed 0"):
        assert part in text
    assert ["Goal error", "0.312 mm", "≤ 2 mm", "✓ ok"] in shown.rows
    assert ["controller.k_v", "0.3"] in shown.rows
    assert ["numpy", "2.2.6"] in shown.rows


def test_empty_parts_of_a_report_are_left_out():
    shown = Page(reports_page("Page", [Report(title="Bare", summary="Text.")]))
    assert not {"table", "details", "pre", "section"} & shown.tags


def test_every_picture_is_in_the_page_and_can_be_decoded():
    image = np.zeros((4, 6, 3), dtype=np.uint8)
    image[1, 2] = (10, 200, 30)
    pictures = [Picture("one", figure(), "one"), Picture("two", image, "two")]
    images = []
    for source in page(sections=[Section(heading="Two", figures=pictures)]).images:
        kind, data = source.split(",", 1)
        assert kind == "data:image/png;base64"
        images.append(Image.open(BytesIO(base64.b64decode(data))))
    assert [image.size for image in images] == [(450, 300), (6, 4)]
    np.testing.assert_array_equal(np.asarray(images[1]), image)


def test_figures_for_phones_have_their_panels_above_one_another():
    wide = Figure(figsize=(7.2, 3.0), layout="constrained")
    for axes in wide.subplots(1, 2):
        axes.plot([0, 1], [0, 1], label="a curve")
        axes.legend()
    picture = Picture("two", wide, "Two panels")
    assert Image.open(BytesIO(picture.png)).size == (1080, 450)
    width, height = Image.open(BytesIO(picture.narrow)).size
    assert width < 600 < height
    first, second = (axes.get_position() for axes in wide.axes)
    assert first.y0 > second.y1
    assert first.x0 == pytest.approx(second.x0)
    photo = Picture("photo", np.zeros((4, 6, 3), dtype=np.uint8))
    assert photo.png
    assert not photo.narrow  # dark pages leave it as it is


def test_a_report_with_several_sections_has_contents():
    sections = [Section(heading="Path & way"), Section(heading="Joints")]
    shown = page(sections=sections)
    assert "nav" in shown.tags
    assert shown.links == ["#run1-1", "#run1-2", "#run1-again"]
    assert set(shown.links) <= {f"#{anchor}" for anchor in shown.anchors}


def test_nothing_is_fetched_from_elsewhere():
    html = reports_page("Page", [report(), report()])
    assert "http" not in html
    assert "url(" not in html
    assert '"Segoe UI"' in html  # the style, unescaped
    assert not {"script", "link", "iframe"} & Page(html).tags


def test_all_text_is_escaped():
    hurt = report(
        title=NASTY,
        summary=NASTY,
        table=[Measurement(name=NASTY, value=1.0, unit=NASTY, target=2.0, claim=NASTY)],
        sections=[
            Section(heading=NASTY, text=NASTY, figures=[Picture("x", figure(), f"{NASTY}'\"")])
        ],
        configuration={NASTY: NASTY},
        versions={NASTY: NASTY},
        command=NASTY,
    )
    for shown in (
        Page(reports_page(NASTY, [hurt])),
        Page(reports_page(NASTY, [hurt, hurt])),
    ):
        assert "script" not in shown.tags
        assert "".join(shown.texts).count(NASTY) >= 13


@pytest.mark.parametrize(
    ("value", "target", "at_least", "ok"),
    [
        (1.9, 2.0, False, True),
        (2.0, 2.0, False, True),
        (2.1, 2.0, False, False),
        (99.0, 100.0, True, False),
        (100.0, 100.0, True, True),
        (0.0, 0.0, False, True),
        (math.nan, 2.0, False, False),
        (math.nan, 2.0, True, False),
        (5.0, None, False, None),
    ],
)
def test_targets_are_judged(value, target, at_least, ok):
    m = Measurement(name="x", value=value, target=target, at_least=at_least)
    assert m.ok is ok
    marks = {True: "✓ ok", False: "✗ missed", None: ""}
    _, _, bound, mark = row(m)
    assert mark == marks[ok]
    assert bound.startswith("" if target is None else "≥" if at_least else "≤")


def test_verdicts_on_numpy_values_are_true_or_false():
    """Programs ask whether a verdict `is False`, which numpy's own never is."""
    missed = Measurement(name="error", value=np.float64(3.0), target=2.0)
    assert missed.ok is False


GOOD = Measurement(name="a", value=1, target=2)
BAD = Measurement(name="b", value=3, target=2)
FREE = Measurement(name="c", value=3)


@pytest.mark.parametrize(
    ("table", "verdict"),
    [
        ((GOOD, FREE), "The target reached."),
        ((GOOD, GOOD), "All 2 targets reached."),
        ((GOOD, BAD, FREE), "1 of 2 targets missed."),
        ((FREE,), ""),
    ],
)
def test_the_verdict_counts_what_was_missed(table, verdict):
    said = [text for text in page(table=table).texts if "target" in text]
    assert said == ([verdict] if verdict else [])


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (12345, "12345"),
        (8.13e-5, "8.13e-05"),
        (0.31234, "0.312"),
        (math.nan, "nan"),
    ],
)
def test_numbers_are_short(value, text):
    assert row(Measurement(name="x", value=value)) == ["x", text, "", ""]


def test_claims_of_the_paper_have_a_column_where_there_are_any():
    claimed = Measurement(name="time", value=10.5, unit="s", claim="10 s (Fig. 8)")
    shown = page(table=[claimed, FREE])
    assert "The paper says" in shown.texts
    assert ["time", "10.5 s", "", "", "10 s (Fig. 8)"] in shown.rows
    assert ["c", "3", "", "", ""] in shown.rows
    assert "The paper says" not in page(table=[FREE]).texts


def test_only_tables_with_claims_have_their_column():
    claimed = Measurement(name="last", value=1, claim="2 (Fig. 8)")
    table = [*(replace(GOOD, name=f"v{i}") for i in range(6)), claimed]
    seen, folded = reports_page("x", [report(table=table)]).split("<details>", 1)
    assert "The paper says" not in seen
    assert "The paper says" in folded.split("</details>")[0]


@pytest.mark.parametrize(
    ("name", "unit", "key"),
    [
        ("goal error at the shelf, angle", "deg", "goal_error_at_the_shelf_angle_deg"),
        ("Joint-limit violations", "", "joint_limit_violations"),
    ],
)
def test_keys_are_single_words(name, unit, key):
    assert Measurement(name=name, value=1, unit=unit).key == key


def test_measurements_are_printed_beside_their_targets(capsys):
    show_measurements([GOOD, BAD, FREE])
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert "│ a │ 1 │ ≤ 2 │ ok │" in lines
    assert "│ b │ 3 │ ≤ 2 │ missed │" in lines
    assert "│ c │ 3 │ │ │" in lines


def test_the_first_values_are_those_missed_and_those_with_targets(capsys):
    table = [FREE, GOOD, replace(BAD, name="worst"), replace(FREE, name="d")]
    assert leading(table, 2) == ((table[1], table[2]), (table[0], table[3]))
    assert leading(table, 0) == ((table[2],), (table[0], table[1], table[3]))
    show_measurements([replace(GOOD, name=f"v{i}") for i in range(20)])
    shown = capsys.readouterr().out
    assert "v7" in shown
    assert "v8" not in shown
    assert "12 more: the report" in shown


def test_other_values_are_folded():
    html = reports_page("x", [report(table=[replace(GOOD, name=f"v{i}") for i in range(9)])])
    seen, folded = html.split("<summary>3 more values</summary>")
    assert "<td>v5</td>" in seen
    assert "<td>v6</td>" in folded.split("</details>")[0]


def test_the_command_that_opens_a_dashboard_is_that_of_this_python(monkeypatch, tmp_path):
    python = tmp_path / "bin" / "python"
    monkeypatch.setattr(sys, "executable", str(python))
    monkeypatch.setattr(shutil, "which", lambda name: None)
    monkeypatch.chdir(tmp_path)
    assert show_command("a run") == "bin/python -m hrc_learn.cli show 'a run'"
    python.parent.mkdir()
    (tmp_path / "bin" / "hrc").touch()
    assert show_command("run") == "bin/hrc show run"
    monkeypatch.setattr(shutil, "which", lambda name: str(tmp_path / "bin" / "hrc"))
    assert show_command("run") == "hrc show run"


def test_a_film_is_in_the_page_and_in_the_folder(tmp_path):
    film = Film(b"an mp4", "The run & more")
    write_report(tmp_path, report(film=film))
    assert (tmp_path / "film.mp4").read_bytes() == film.mp4
    assert read_report(tmp_path).film == film
    html = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "video" in Page(html).tags
    encoded = re.search(r"data:video/mp4;base64,([^\"]+)", html)
    assert encoded
    assert base64.b64decode(encoded[1]) == film.mp4
    assert "The run &amp; more" in html


def test_several_reports_are_listed_with_their_verdicts_first():
    reports = [report(title=f"Run {i}", table=[m]) for i, m in enumerate((GOOD, BAD), 1)]
    shown = Page(reports_page("Both", reports))
    assert shown.rows[:2] == [
        ["1", "Run 1", "The target reached."],
        ["2", "Run 2", "1 of 1 targets missed."],
    ]
    assert shown.links == ["#run1", "#run2"]
    assert [a for a in shown.anchors if "-" not in a] == ["run1", "run2"]
    assert {f"#{anchor}" for anchor in shown.anchors} >= set(shown.links)
    assert len(shown.images) == 2
    with pytest.raises(ValueError, match="at least one report"):
        reports_page("None", [])


def test_common_values_of_several_runs_are_compared():
    def run(error: float, **others: float) -> Report:
        table = [Measurement(name="error", value=error, unit="mm", target=2)]
        table += [Measurement(name=name, value=value) for name, value in others.items()]
        return report(table=table)

    alone = report(table=[Measurement(name="alone", value=1)])
    html = reports_page("All", [run(1, time=3), alone, run(5, jerk=4), run(2, time=9)])
    shown = Page(html)
    heads = html.split("Side by side")[1].split("</thead>")[0]
    assert re.findall(r"#run(\d)", heads) == ["1", "3", "4"]
    start = 4 + 1  # after the overview and the head of the table
    end = shown.rows.index([], start)  # the head of the first report's own table
    assert shown.rows[start:end] == [
        ["error", "1 mm", "5 mm", "2 mm"],
        ["time", "3", "", "9"],
    ]
    assert 'class="n miss">5 mm' in html


def test_a_folder_holds_page_pictures_and_data(tmp_path):
    write_report(tmp_path, report())
    files = {str(f.relative_to(tmp_path)) for f in tmp_path.rglob("*") if f.is_file()}
    pictures = {"figures/path.png", "figures/narrow/path.png"}
    assert files == {"report.html", "report.json", *pictures}
    assert Image.open(tmp_path / "figures/path.png").size == (450, 300)
    html = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert html == reports_page("Grasp", [read_report(tmp_path)])


def test_the_page_links_to_other_files_of_the_run(tmp_path):
    for name in ("run.rrd", "log.npz", "a & b.rrd", "measured.json"):
        (tmp_path / name).touch()
    write_report(tmp_path, report(film=Film(b"an mp4", "The run")))
    html = (tmp_path / "report.html").read_text(encoding="utf-8")
    links = re.findall(r'<a href="([^"]+)"', html)
    assert links == ["a%20%26%20b.rrd", "film.mp4", "log.npz", "run.rrd"]
    assert "a &amp; b.rrd" in html
    assert "hrc show" in html
    alone = reports_page("x", [report()])
    assert "<a " not in alone


def test_a_report_is_read_as_it_was_written(tmp_path):
    table = [
        Measurement(name="a", value=math.nan, unit="s", target=1.5, claim="“none” ≤ 2"),
        Measurement(name="b", value=7, target=1, at_least=True),
    ]
    configuration = {"out": tmp_path, "gains": {"k": 0.3}, "pulls": (1, 2), "loose": None}
    write_report(tmp_path, report(table=table, configuration=configuration))
    read = read_report(tmp_path)
    assert math.isnan(read.table[0].value)
    assert replace(read.table[0], value=0) == replace(table[0], value=0)
    assert read.table[1] == table[1]
    assert read.configuration == {
        "out": str(tmp_path),
        "gains.k": 0.3,
        "pulls": [1, 2],
        "loose": None,
    }
    (section,) = read.sections
    assert (section.heading, section.text) == ("Path", "Text.")
    assert read.versions == {"numpy": "2.2.6"}
    assert read.command == "python run.py --seed 0"
    assert read.pictures[0].drawing == (tmp_path / "figures/path.png").read_bytes()


def test_a_failed_report_leaves_the_old_one_alone(tmp_path):
    write_report(tmp_path, report())
    before = {f: f.read_bytes() for f in tmp_path.rglob("*") if f.is_file()}
    broken = figure()
    broken.savefig = None
    pictures = [Picture("path", np.zeros((2, 2, 3), np.uint8), ""), Picture("b", broken, "")]
    with pytest.raises(TypeError):
        write_report(tmp_path, report(sections=[Section(heading="x", figures=pictures)]))
    assert {f: f.read_bytes() for f in tmp_path.rglob("*") if f.is_file()} == before


def test_folders_that_are_no_runs_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere is not a folder"):
        read_report(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"has no report\.json: .* not the folder of a run"):
        read_report(tmp_path)
    for text, complaint in (
        ("{", r"report\.json: not valid JSON"),
        ('{"title": "x"}', "lacks the field"),
        ('{"format": "cake"}', "format: unknown value 'cake'"),
        ('{"format": "hrc_learn report", "version": 99}', "version: unknown value 99"),
    ):
        (tmp_path / "report.json").write_text(text)
        with pytest.raises(ValueError, match=complaint):
            read_report(tmp_path)


def test_a_missing_picture_is_named(tmp_path):
    write_report(tmp_path, report())
    (tmp_path / "figures/path.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"path\.png"):
        read_report(tmp_path)


def test_pictures_need_names_that_files_can_have():
    with pytest.raises(ValueError, match=r"picture name '\.\./a b'"):
        Picture("../a b", b"", "")
    twice = Section(heading="x", figures=[Picture("a", b"", ""), Picture("a", b"", "")])
    with pytest.raises(ValueError, match="two pictures named 'a'"):
        report(sections=[twice])


def test_versions_name_the_software():
    versions = software_versions()
    assert versions["python"] == platform.python_version()
    assert versions["torch"] == torch.__version__.split("+")[0]


def test_nested_configuration_is_flattened():
    nested = {"a": {"b": {"c": 1}}, "d": 2}
    assert flatten(nested) == {"a.b.c": 1, "d": 2}
