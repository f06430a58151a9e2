"""Pages of runs and of the site under axe, a checker of accessibility, on phone and desktop."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from page_in_browser import chromium

import hrc_learn.teleoperation
from hrc_learn.viz.evidence import evidence_page
from hrc_learn.viz.report import Measurement, Picture, Report, Section, reports_page

CLIENT = Path(hrc_learn.teleoperation.__file__).parent / "xr_client"
AXE = CLIENT / "node_modules" / "axe-core" / "axe.min.js"
"""Installed with the tools that build the client (`make xr`)."""

pytestmark = pytest.mark.browser


def report(title: str) -> Report:
    drawn = Figure(figsize=(7.2, 3.0), layout="constrained")
    for axes in drawn.subplots(1, 2):
        axes.plot([0, 1], [0, 1])
    photograph = np.full((300, 400, 3), 120, np.uint8)
    table = [
        Measurement(name="place error", value=4.3, unit="mm", target=5, claim="in a " * 20),
        Measurement(name="place tilt", value=9.0, unit="deg", target=3),
        Measurement(name="separation violations", value=0, target=0),
        *(Measurement(name=f"further quantity {i}", value=i, unit="s") for i in range(9)),
    ]
    sections = [
        Section(heading="Motion", text="Text.", figures=[Picture("motion", drawn, "Paths.")]),
        Section(heading="View", figures=[Picture("view", photograph, "The camera's image.")]),
    ]
    return Report(
        title=title,
        summary="A summary.",
        table=table,
        sections=sections,
        configuration={"a_long_key": {"of_a_setting": "/a/long/path" * 12}},
        versions={"python": "3.12"},
        command="hrc demo --out " + "folder/" * 30,
    )


@pytest.fixture(scope="module")
def axe():
    if not AXE.is_file():
        pytest.skip(f"no axe-core: run npm ci in {CLIENT}")
    return AXE.read_text(encoding="utf-8")


def written(folder: Path, runs: int, evidence: bool) -> Path:
    """A page about this number of runs."""
    reports = [report(f"Run {i}") for i in range(runs)]
    page = folder / "report.html"
    content = evidence_page(reports) if evidence else reports_page("Runs", reports)
    page.write_text(content, encoding="utf-8")
    return page


@pytest.mark.slow
@pytest.mark.parametrize("evidence", [False, True])
@pytest.mark.parametrize("runs", [1, 2])
def test_reports_are_accessible_and_fit_a_phone(axe, runs, evidence, tmp_path):
    page = written(tmp_path, runs, evidence)
    with chromium(tmp_path / "profile") as tab:
        for width in (390, 820, 1280):
            for scheme in ("light", "dark"):
                tab.set_viewport_size({"width": width, "height": 844})
                tab.emulate_media(color_scheme=scheme)
                tab.goto(page.as_uri())
                tab.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
                assert tab.evaluate("document.documentElement.scrollWidth") <= width
                tab.evaluate(axe)
                found = tab.evaluate("axe.run()")["violations"]
                assert [(v["id"], v["nodes"][0]["html"]) for v in found] == []


def test_names_of_rows_and_options_are_not_broken(tmp_path):
    lines = "e => { const r = document.createRange(); r.selectNodeContents(e); return " + (
        "new Set([...r.getClientRects()].map(b => Math.round(b.top))).size }"
    )
    with chromium(tmp_path / "profile") as tab:
        for width in (390, 820):
            tab.set_viewport_size({"width": width, "height": 844})
            tab.goto(written(tmp_path, 1, evidence=True).as_uri())
            for name in ("Requirement", "Parameters", "Measured"):
                row = tab.get_by_role("rowheader", name=name, exact=True).first
                assert row.evaluate(lines) == 1, name
            option = tab.locator("pre span", has_text="--out").first
            assert option.evaluate(lines) == 1


@pytest.mark.parametrize(
    ("size", "drawer"), [((390, 844), True), ((844, 390), False), ((1280, 800), False)]
)
def test_the_controls_of_the_ar_page_leave_the_arm_free(tmp_path, size, drawer):
    style = (CLIENT / "style.css").read_text("utf-8")
    page = (
        (CLIENT / "index.html").read_text("utf-8").replace("</head>", f"<style>{style}</style>")
    )
    with chromium(tmp_path / "profile", size) as tab:
        tab.set_content(page)
        tab.evaluate("""() => {
          const list = document.getElementById("buttons");
          list.before(document.createElement("input"));
          for (let k = 0; k < 13; k++)
            list.append(Object.assign(document.createElement("button"), {textContent: "Draw"}));
        }""")
        box = tab.locator("#overlay").bounding_box()
        field = tab.locator("#overlay input").bounding_box()
        assert field["width"] > 0.9 * (box["width"] - 20)
        if drawer:  # the arm stands in the middle
            assert box["y"] > size[1] / 2
            assert box["y"] + box["height"] == pytest.approx(size[1])
        else:
            assert box["x"] + box["width"] < size[0] / 2


@pytest.fixture(scope="module")
def check_site():
    """The program that checks the site."""
    path = Path(__file__).parents[2] / "tools" / "check_site.py"
    spec = importlib.util.spec_from_file_location("check_site", path)
    # Registered, as dataclasses look themselves up there.
    sys.modules["check_site"] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.long
@pytest.mark.usefixtures("axe")
def test_the_site_has_no_serious_fault_and_fits_a_phone(check_site, tmp_path):
    """A sample; the program checks all pages."""
    build = [sys.executable, "tools/build_docs.py", "--out", tmp_path / "site"]
    subprocess.run(build, check=True, cwd=check_site.ROOT)
    pages = ("index", "tutorial", "howto/index", "benchmarks/dmp", "api/hrc_learn.dmp")
    assert check_site.check_pages(tmp_path / "site", pages, AXE) == []


@pytest.mark.long
@pytest.mark.usefixtures("axe")
def test_the_program_finds_faults(check_site, tmp_path):
    page = """<!doctype html><html lang="en"><title>Page</title><main><h1>Page</h1>
        <div style="width: 600px">wide</div><img src="none.png"><button></button></main>"""
    (tmp_path / "wide.html").write_text(page, "utf-8")
    found = check_site.check_pages(tmp_path, ("wide",), AXE)
    faults = [line.removeprefix("wide, ").partition(" (")[0] for line in found]
    assert faults[0].startswith("390 px, slate: 6")
    assert faults[0].endswith(" px wide")
    named = ("button-name", "image-alt")
    assert faults[1:3] == [f"390 px, slate: {name}" for name in named]
    assert faults[3:] == [f"1280 px, default: {name}" for name in named]


def test_pages_that_are_not_built_are_named(check_site, tmp_path):
    with pytest.raises(ValueError, match="has no page lost: build it first"):
        check_site.check_pages(tmp_path, ("lost",), AXE)
