"""Pages of runs and of the site under axe, a checker of accessibility, on phone and desktop."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from page_in_browser import chromium

import hrc_learn.teleoperation
from hrc_learn.viz.report import Measurement, Picture, Report, Section, reports_page

CLIENT = Path(hrc_learn.teleoperation.__file__).parent / "xr_client"
AXE = CLIENT / "node_modules" / "axe-core" / "axe.min.js"
"""Installed with the tools that build the client (`make xr`)."""

pytestmark = [pytest.mark.browser, pytest.mark.slow]


def report(title: str) -> Report:
    drawn = Figure(figsize=(7.2, 3.0), layout="constrained")
    for axes in drawn.subplots(1, 2):
        axes.plot([0, 1], [0, 1])
    photograph = np.full((300, 400, 3), 120, np.uint8)
    table = [
        Measurement(name="place error", value=4.3, unit="mm", target=5, claim="in a " * 20),
        Measurement(name="place tilt", value=9.0, unit="deg", target=3),
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


@pytest.mark.parametrize("runs", [1, 2])
def test_reports_are_accessible_and_fit_a_phone(axe, runs, tmp_path):
    page = tmp_path / "report.html"
    content = reports_page("Runs", [report(f"Run {i}") for i in range(runs)])
    page.write_text(content, encoding="utf-8")
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


def test_the_site_has_no_serious_fault_and_fits_a_phone(axe, tmp_path):
    root = Path(__file__).parents[2]
    build = [sys.executable, root / "tools" / "build_docs.py", "--out", tmp_path / "site"]
    subprocess.run(build, check=True)
    names = ("index", "tutorial", "howto/index", "benchmarks/dmp", "api/hrc_learn.dmp")
    with chromium(tmp_path / "profile") as tab:
        for name in names:
            for width in (390, 1280):
                for scheme in ("default", "slate"):
                    tab.set_viewport_size({"width": width, "height": 844})
                    tab.goto((tmp_path / "site" / f"{name}.html").as_uri())
                    # Colours that fade to the other scheme would be measured on their way.
                    tab.evaluate(
                        "document.head.appendChild(document.createElement('style')).textContent"
                        " = '* {transition: none !important}'"
                    )
                    tab.evaluate(f"document.body.dataset.mdColorScheme = '{scheme}'")
                    assert tab.evaluate("document.documentElement.scrollWidth") <= width
                    tab.evaluate(axe)
                    found = tab.evaluate("axe.run()")["violations"]
                    assert [
                        (name, v["id"], v["nodes"][0]["html"])
                        for v in found
                        if v["impact"] in {"serious", "critical"}
                    ] == []
