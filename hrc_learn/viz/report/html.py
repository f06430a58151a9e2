"""Reports as one self-contained HTML page.

No script, no font, no picture from elsewhere: it can be mailed, printed, and read on a phone
without a network.
"""

import base64
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files

from hrc_learn.viz.report.content import (
    Measurement,
    Picture,
    Report,
    Section,
    flatten,
    side_by_side,
)


def reports_page(title: str, reports: Sequence[Report]) -> str:
    """One page about one or several runs, as HTML.

    Args:
        title: Of the page.
        reports: In order. Several are listed with their verdicts first.

    Raises:
        ValueError: If there is no report.
    """
    if not reports:
        raise ValueError("a page needs at least one report.")
    if len(reports) == 1:
        body = _report(reports[0], "run1")
    else:
        articles = [
            f"<article>{_report(report, f'run{i}')}</article>"
            for i, report in enumerate(reports, 1)
        ]
        heading = f"<h1>{escape(title)}</h1>"
        body = "\n".join([heading, _overview(reports), side_by_side(reports), *articles])
    style = files(__package__).joinpath("style.css").read_text(encoding="utf-8")
    return _PAGE.format(title=escape(title), style=style, body=body)


def _overview(reports: Sequence[Report]) -> str:
    rows = "\n".join(
        f'<tr><td class="n">{i}</td><td><a href="#run{i}">{escape(report.title)}</a></td>'
        f"<td>{_verdict(report)}</td></tr>"
        for i, report in enumerate(reports, 1)
    )
    return f'<table class="overview"><tbody>{rows}</tbody></table>'


def _report(report: Report, anchor: str) -> str:
    return "\n".join(
        [
            f'<h1 id="{anchor}">{escape(report.title)}</h1>',
            _verdict(report),
            _paragraphs(report.summary),
            _measurements(report.table),
            *(_section(section) for section in report.sections),
            _again(report.command),
            _details("Configuration", flatten(report.configuration)),
            _details("Versions", report.versions),
        ]
    )


def _verdict(report: Report) -> str:
    if not report.targets:
        return ""
    if not report.missed:
        reached = "The target" if report.targets == 1 else f"All {report.targets} targets"
        return f'<span class="verdict ok">{reached} reached.</span>'
    missed = f"{len(report.missed)} of {report.targets} targets missed."
    return f'<span class="verdict miss">{missed}</span>'


def _measurements(table: Sequence[Measurement]) -> str:
    if not table:
        return ""
    claims = any(m.claim for m in table)
    heads = '<th>Measured</th><th class="n">Value</th><th class="n">Target</th><th></th>'
    if claims:
        heads += "<th>The paper says</th>"
    rows = "\n".join(_row(m, claims) for m in table)
    return (
        f'<div class="scroll"><table><thead><tr>{heads}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div>"
    )


def _row(m: Measurement, claims: bool) -> str:
    marks = {
        True: '<td class="ok">✓ ok</td>',
        False: '<td class="miss">✗ missed</td>',
        None: "<td></td>",
    }
    claim = f"<td>{escape(m.claim)}</td>" if claims else ""
    return (
        f'<tr><td>{escape(m.name)}</td><td class="n">{escape(m.shown)}</td>'
        f'<td class="n">{escape(m.bound)}</td>{marks[m.ok]}{claim}</tr>'
    )


def _section(section: Section) -> str:
    figures = "\n".join(_figure(picture) for picture in section.figures)
    heading = f"<h2>{escape(section.heading)}</h2>"
    return f"<section>{heading}{_paragraphs(section.text)}{figures}</section>"


def _figure(picture: Picture) -> str:
    data = base64.b64encode(picture.png()).decode("ascii")
    caption = escape(picture.caption)
    return (
        f'<figure><img alt="{caption}" src="data:image/png;base64,{data}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _paragraphs(text: str) -> str:
    parts = [part.strip() for part in text.split("\n\n")]
    return "\n".join(f"<p>{escape(part)}</p>" for part in parts if part)


def _again(command: str) -> str:
    return f"<h2>Again</h2>\n<pre>{escape(command)}</pre>" if command else ""


def _details(summary: str, values: Mapping[str, object]) -> str:
    if not values:
        return ""
    rows = "\n".join(
        f"<tr><td>{escape(str(key))}</td><td>{escape(str(value))}</td></tr>"
        for key, value in values.items()
    )
    return (
        f"<details><summary>{escape(summary)}</summary>"
        '<div class="scroll"><table class="plain"><tbody>'
        f"{rows}</tbody></table></div></details>"
    )


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
{style}</style>
</head>
<body><main>
{body}
</main></body>
</html>
"""
