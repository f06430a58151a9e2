"""One self-contained HTML page about what was done and measured.

No script, no font, no picture from elsewhere: it can be mailed, printed, and read on a phone
without a network.
"""

import base64
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DPI = 150


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """One measured value and what it had to reach."""

    name: str
    """What was measured, in words."""
    value: float | int
    unit: str = ""
    target: float | int | None = None
    """Bound that the value has to keep; None only reports it."""
    at_least: bool = False
    """Whether the target is a lower bound; it is an upper one otherwise."""

    @property
    def ok(self) -> bool | None:
        """Whether the target is kept, None without one. NaN keeps none."""
        if self.target is None:
            return None
        return self.value >= self.target if self.at_least else self.value <= self.target


@dataclass(frozen=True, kw_only=True)
class Section:
    """A heading, paragraphs and figures."""

    heading: str
    text: str = ""
    """Plain text; blank lines part paragraphs."""
    figures: Sequence[tuple["Figure", str]] = field(default_factory=tuple)
    """Each with its caption."""


def write_report(
    path: str | os.PathLike[str],
    *,
    title: str,
    summary: str,
    table: Sequence[Measurement],
    sections: Sequence[Section],
    configuration: Mapping[str, object],
    versions: Mapping[str, str],
    rerun_command: str,
) -> None:
    """Write the page; the file appears only when it is complete.

    Args:
        path: HTML file to write.
        title: Heading of the page.
        summary: What was done, in plain text; blank lines part paragraphs.
        table: Everything measured, with targets where there are any.
        sections: Text and figures, in order.
        configuration: What the run was configured with; nested mappings are flattened.
        versions: Of the software, by name.
        rerun_command: The command line that does all this again.
    """
    body = [
        f"<h1>{escape(title)}</h1>",
        _verdict(table),
        _paragraphs(summary),
        _measurements(table),
        *(_section(section, 1 + i) for i, section in enumerate(sections)),
        "<h2>Again</h2>",
        f"<pre>{escape(rerun_command)}</pre>",
        _details("Configuration", flatten(configuration)),
        _details("Versions", versions),
    ]
    html = _PAGE.format(title=escape(title), style=_STYLE, body="\n".join(body))
    path = Path(path)
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(html, encoding="utf-8")
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def flatten(mapping: Mapping[str, object], prefix: str = "") -> dict[str, object]:
    """Nested mappings as one, keys joined by dots."""
    flat: dict[str, object] = {}
    for key, value in mapping.items():
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def _verdict(table: Sequence[Measurement]) -> str:
    judged = [m.ok for m in table if m.ok is not None]
    if not judged:
        return ""
    missed = judged.count(False)
    if missed == 0:
        return f'<p class="verdict ok">All {len(judged)} targets reached.</p>'
    return f'<p class="verdict miss">{missed} of {len(judged)} targets missed.</p>'


def _measurements(table: Sequence[Measurement]) -> str:
    rows = "\n".join(_row(m) for m in table)
    return (
        '<div class="scroll"><table><thead><tr><th>Measured</th><th class="n">Value</th>'
        '<th class="n">Target</th><th></th></tr></thead>'
        f"<tbody>{rows}</tbody></table></div>"
    )


def _row(m: Measurement) -> str:
    unit = f" {m.unit}" if m.unit else ""
    target, mark = "", ""
    if m.target is not None:
        target = f"{'≥' if m.at_least else '≤'} {_number(m.target)}{unit}"
        mark = '<td class="ok">✓ ok</td>' if m.ok else '<td class="miss">✗ missed</td>'
    return (
        f'<tr><td>{escape(m.name)}</td><td class="n">{escape(_number(m.value) + unit)}</td>'
        f'<td class="n">{escape(target)}</td>{mark or "<td></td>"}</tr>'
    )


def _number(value: float | int) -> str:
    """Three significant digits; whole numbers in full."""
    return str(int(value)) if float(value).is_integer() and abs(value) < 1e9 else f"{value:.3g}"


def _section(section: Section, number: int) -> str:
    figures = "\n".join(
        f'<figure><img alt="{escape(caption)}" src="data:image/png;base64,{_png(figure)}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
        for figure, caption in section.figures
    )
    heading = f'<h2 id="s{number}">{escape(section.heading)}</h2>'
    return f"<section>{heading}{_paragraphs(section.text)}{figures}</section>"


def _png(figure: "Figure") -> str:
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI)
    return base64.b64encode(buffer.getvalue()).decode("ascii")


def _paragraphs(text: str) -> str:
    parts = [part.strip() for part in text.split("\n\n")]
    return "\n".join(f"<p>{escape(part)}</p>" for part in parts if part)


def _details(summary: str, values: Mapping[str, object]) -> str:
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
<style>{style}</style>
</head>
<body><main>
{body}
</main></body>
</html>
"""

_STYLE = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { margin: 0; background: #f4f5f7; color: #202124;
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
main { max-width: 54rem; margin: 2rem auto; padding: 2rem 2.5rem; background: #fff;
  border: 1px solid #e3e5e8; border-radius: 10px; }
h1 { margin: 0 0 .6rem; font-size: 1.7rem; line-height: 1.25; }
h2 { margin: 2.2rem 0 .5rem; font-size: 1.2rem; }
p { margin: .5rem 0; }
.scroll { overflow-x: auto; }
table { width: 100%; margin: 1rem 0; border-collapse: collapse; font-size: .93rem; }
th, td { padding: .4rem .6rem; text-align: left; vertical-align: top;
  border-bottom: 1px solid #e3e5e8; }
th { font-weight: 600; color: #5f6368; border-bottom-width: 2px; }
.n { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums; }
td.ok, td.miss { font-weight: 600; white-space: nowrap; }
.ok { color: #00664b; }
.miss { color: #a83f00; }
.verdict { display: inline-block; padding: .25rem .8rem; border-radius: 999px;
  font-weight: 600; background: #e3f4ee; }
.verdict.miss { background: #fdeadf; }
figure { margin: 1.2rem 0; text-align: center; break-inside: avoid; }
img { max-width: 100%; height: auto; }
figcaption { font-size: .88rem; color: #5f6368; }
pre { padding: .8rem 1rem; overflow-x: auto; background: #f4f5f7; border-radius: 6px;
  font-size: .88rem; }
details { margin: .8rem 0; }
summary { cursor: pointer; font-weight: 600; }
.plain td { font-family: ui-monospace, Menlo, Consolas, monospace; font-size: .84rem;
  overflow-wrap: anywhere; }
@media (max-width: 40rem) {
  main { margin: 0; padding: 1.1rem; border: 0; border-radius: 0; }
  th, td { padding: .35rem .4rem; }
}
@media print {
  body { background: #fff; font-size: 11pt; }
  main { max-width: none; margin: 0; padding: 0; border: 0; }
}
"""
