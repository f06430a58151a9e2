"""Reports in the folders of runs: written once, read again to be put beside others."""

import json
import math
import os
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from hrc_learn.store import new_file
from hrc_learn.viz.report.content import Measurement, Picture, Report, Section, flatten
from hrc_learn.viz.report.html import reports_page

REPORT = "report.json"
"""File that tells the folder of a run that has a report."""
PAGE = "report.html"
FIGURES = "figures"
FORMAT = "hrc_learn report"
VERSION = 1


def write_report(folder: str | os.PathLike[str], report: Report) -> None:
    """Write `report.json`, `figures/*.png` and the self-contained page `report.html`.

    Args:
        folder: Of the run. Each file appears only when it is complete, `report.json` last.
        report: What was done and measured.
    """
    folder = Path(folder)
    report = _drawn(report)
    (folder / FIGURES).mkdir(parents=True, exist_ok=True)
    for picture in report.pictures:
        with new_file(folder / FIGURES / f"{picture.name}.png") as part:
            part.write_bytes(picture.png())
    with new_file(folder / PAGE) as part:
        part.write_text(reports_page(report.title, [report]), encoding="utf-8")
    with new_file(folder / REPORT) as part:
        text = json.dumps(_to_json(report), indent=2, ensure_ascii=False, allow_nan=False)
        part.write_text(text + "\n", encoding="utf-8")


def read_report(folder: str | os.PathLike[str]) -> Report:
    """Read what `write_report` left in a folder.

    Raises:
        FileNotFoundError: If there is no such folder, or a picture of the report is missing.
        ValueError: If the folder holds no report, or one that this version cannot read.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is not a folder.")
    path = folder / REPORT
    if not path.is_file():
        raise ValueError(
            f"{folder} holds no {REPORT}: it is not the folder of a run, or of one that failed "
            "before there was anything to report."
        )
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(f"{path} is not a report of ours.")
    if content["version"] != VERSION:
        raise ValueError(
            f"{path} is of version {content['version']}; this package reads {VERSION}. "
            "Read it with the package that wrote it, or run the program again."
        )
    return _from_json(content, folder)


def _drawn(report: Report) -> Report:
    """The report with every figure drawn, so that none is drawn twice."""
    sections = [
        replace(section, figures=[replace(p, drawing=p.png()) for p in section.figures])
        for section in report.sections
    ]
    return replace(report, sections=sections)


def _to_json(report: Report) -> dict[str, Any]:
    configuration = flatten(report.configuration)
    return {
        "format": FORMAT,
        "version": VERSION,
        "title": report.title,
        "summary": report.summary,
        "command": report.command,
        "table": [asdict(m) | {"value": _finite(m.value)} for m in report.table],
        "sections": [
            {
                "heading": section.heading,
                "text": section.text,
                "figures": [{"name": p.name, "caption": p.caption} for p in section.figures],
            }
            for section in report.sections
        ],
        "configuration": {key: _plain(value) for key, value in configuration.items()},
        "versions": dict(report.versions),
    }


def _from_json(content: Mapping[str, Any], folder: Path) -> Report:
    sections = [
        Section(
            heading=section["heading"],
            text=section["text"],
            figures=[
                Picture(
                    figure["name"],
                    (folder / FIGURES / f"{figure['name']}.png").read_bytes(),
                    figure["caption"],
                )
                for figure in section["figures"]
            ],
        )
        for section in content["sections"]
    ]
    table = [
        Measurement(**row | {"value": math.nan if row["value"] is None else row["value"]})
        for row in content["table"]
    ]
    same = ("title", "summary", "command", "configuration", "versions")
    return Report(table=table, sections=sections, **{name: content[name] for name in same})


def _finite(value: float | int) -> float | int | None:
    """JSON has no numbers that are not finite."""
    return value if math.isfinite(value) else None


def _plain(value: object) -> object:
    """What JSON knows as it is, everything else as text."""
    known = isinstance(value, (bool, int, str, type(None)))
    return value if known or (isinstance(value, float) and math.isfinite(value)) else str(value)
