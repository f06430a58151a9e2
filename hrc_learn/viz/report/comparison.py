"""What several runs measured, side by side."""

from collections import Counter
from collections.abc import Sequence
from html import escape

from .content import Measurement, Report


def side_by_side(reports: Sequence[Report]) -> str:
    """A table, as HTML, of everything that two runs or more measured; empty without any.

    A column stands for a run, numbered as in the overview. A value that missed its target is
    marked.
    """
    tables = [{m.name: m for m in report.table} for report in reports]
    shared = [name for name, n in Counter(n for t in tables for n in t).items() if n > 1]
    if not shared:
        return ""
    compared = [i for i, table in enumerate(tables) if table.keys() & set(shared)]
    heads = "".join(f'<th class="n"><a href="#run{i + 1}">{i + 1}</a></th>' for i in compared)
    rows = "\n".join(_row(name, [tables[i].get(name) for i in compared]) for name in shared)
    return (
        '<h2>Side by side</h2><div class="scroll"><table><thead>'
        f"<tr><th>Measured</th>{heads}</tr></thead><tbody>{rows}</tbody></table></div>"
    )


def _row(name: str, measured: Sequence[Measurement | None]) -> str:
    return f"<tr><td>{escape(name)}</td>{''.join(_cell(m) for m in measured)}</tr>"


def _cell(m: Measurement | None) -> str:
    if m is None:
        return "<td></td>"
    missed = ' class="n miss"' if m.ok is False else ' class="n"'
    return f"<td{missed}>{escape(m.shown)}</td>"
