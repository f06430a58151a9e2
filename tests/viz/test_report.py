import base64
import math
from html.parser import HTMLParser
from io import BytesIO

import pytest
from matplotlib.figure import Figure
from PIL import Image

from hrc_learn.viz.report import Measurement, Section, flatten, write_report

VOID = {"meta", "img", "br", "link", "hr"}
NASTY = '<script>alert("x")</script> & co'


class Page(HTMLParser):
    """Checks that tags nest, and collects text, images and attributes."""

    def __init__(self, html: str):
        super().__init__()
        self.open: list[str] = []
        self.texts: list[str] = []
        self.images: list[str] = []
        self.rows: list[list[str]] = []
        self.tags: set[str] = set()
        self.feed(html)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        values = dict(attrs)
        if tag == "img":
            self.images.append(values["src"])
        assert "href" not in values
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


def write(path, **changes) -> Page:
    content = {
        "title": "Grasp",
        "summary": "First.\n\nSecond.",
        "table": [Measurement(name="Goal error", value=0.312, unit="mm", target=2)],
        "sections": [Section(heading="Path", text="Text.", figures=[(figure(), "A caption")])],
        "configuration": {"controller": {"k_v": 0.3}, "seed": 0},
        "versions": {"numpy": "2.2.6"},
        "rerun_command": "python run.py --seed 0",
    }
    write_report(path, **(content | changes))
    return Page(path.read_text(encoding="utf-8"))


def test_the_page_holds_everything_it_was_given(tmp_path):
    page = write(tmp_path / "report.html")
    text = " ".join(page.texts)
    for part in ("Grasp", "First.", "Second.", "Path", "A caption", "python run.py --seed 0"):
        assert part in text
    assert ["Goal error", "0.312 mm", "≤ 2 mm", "✓ ok"] in page.rows
    assert ["controller.k_v", "0.3"] in page.rows
    assert ["numpy", "2.2.6"] in page.rows
    assert [file.name for file in tmp_path.iterdir()] == ["report.html"]


def test_every_image_is_in_the_page_and_can_be_decoded(tmp_path):
    section = Section(heading="Two", figures=[(figure(), "one"), (figure(), "two")])
    page = write(tmp_path / "report.html", sections=[section])
    assert len(page.images) == 2
    for source in page.images:
        kind, data = source.split(",", 1)
        assert kind == "data:image/png;base64"
        assert Image.open(BytesIO(base64.b64decode(data))).size == (450, 300)


def test_nothing_is_fetched_from_elsewhere(tmp_path):
    page = write(tmp_path / "report.html")
    html = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "http" not in html
    assert "url(" not in html
    assert not {"script", "link", "iframe"} & page.tags


def test_all_text_is_escaped(tmp_path):
    page = write(
        tmp_path / "report.html",
        title=NASTY,
        summary=NASTY,
        table=[Measurement(name=NASTY, value=1.0, unit=NASTY, target=2.0)],
        sections=[Section(heading=NASTY, text=NASTY, figures=[(figure(), f"{NASTY}'\"")])],
        configuration={NASTY: NASTY},
        versions={NASTY: NASTY},
        rerun_command=NASTY,
    )
    assert "script" not in page.tags
    assert "".join(page.texts).count(NASTY) >= 12


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
def test_targets_are_judged(tmp_path, value, target, at_least, ok):
    m = Measurement(name="x", value=value, target=target, at_least=at_least)
    assert m.ok is ok
    page = write(tmp_path / "report.html", table=[m])
    marks = {True: "✓ ok", False: "✗ missed", None: ""}
    (row,) = [row for row in page.rows if row and row[0] == "x"]
    assert row[3] == marks[ok]
    assert row[2].startswith("" if target is None else "≥" if at_least else "≤")


def test_the_verdict_counts_what_was_missed(tmp_path):
    good = Measurement(name="a", value=1, target=2)
    bad = Measurement(name="b", value=3, target=2)
    free = Measurement(name="c", value=3)
    verdicts = {
        (good, free): "All 1 targets reached.",
        (good, bad, free): "1 of 2 targets missed.",
    }
    for table, verdict in verdicts.items():
        assert verdict in write(tmp_path / "report.html", table=table).texts
    assert not any("target" in t for t in write(tmp_path / "r.html", table=[free]).texts[4:8])


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
def test_numbers_are_short(tmp_path, value, text):
    page = write(tmp_path / "report.html", table=[Measurement(name="x", value=value)])
    assert ["x", text, "", ""] in page.rows


def test_a_failed_report_leaves_the_old_one_alone(tmp_path):
    path = tmp_path / "report.html"
    path.write_text("old")
    broken = figure()
    broken.savefig = None
    with pytest.raises(TypeError):
        write(path, sections=[Section(heading="x", figures=[(broken, "x")])])
    assert path.read_text() == "old"


def test_nested_configuration_is_flattened():
    nested = {"a": {"b": {"c": 1}}, "d": 2}
    assert flatten(nested) == {"a.b.c": 1, "d": 2}
