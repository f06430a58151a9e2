"""Evidence page: requirements of safety standards, with the values that runs have measured.

`evidence.toml` holds the requirements. The page claims no certification.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hrc_learn.store import read_toml
from hrc_learn.viz.report import Report, flatten, page_templates


@dataclass(frozen=True, kw_only=True)
class Clause:
    """A requirement, and how the package meets it."""

    standard: str
    """Standard with its edition, and the topic or annex."""
    requirement: str
    kept: str
    """Description of how the package meets it."""
    parameters: Sequence[Any]
    """In `evidence.toml`: ends of the names of settings. On a page: these settings with their
    values in the runs."""
    test: str
    """File of the test that checks it."""
    measured: Sequence[Any]
    """In `evidence.toml`: names of the metrics. On a page: the measurements of each run."""
    outside: str
    """Part of the requirement that this package cannot meet."""


@dataclass(frozen=True, kw_only=True)
class _Clauses:
    clause: list[Clause]


def clauses() -> list[Clause]:
    """All requirements."""
    return read_toml(Path(__file__).with_name("evidence.toml"), _Clauses).clause


def evidence_page(reports: Sequence[Report]) -> str:
    """Page of all requirements with the values of one or several runs, as HTML.

    Args:
        reports: Reports of the runs, in order; the report of a batch has values over all runs.

    Raises:
        ValueError: No run was made near a person.
    """
    if not any(m.name == "separation violations" for r in reports for m in r.table):
        raise ValueError(
            "none of these runs measured its distance from a person: name runs of "
            "`hrc run collaboration --worker`."
        )
    template = page_templates().get_template("evidence.html")
    shown = [_filled(clause, reports) for clause in clauses()]
    title = "Work near people: requirements and evidence"
    return template.render(title=title, reports=reports, clauses=shown)


def _filled(clause: Clause, reports: Sequence[Report]) -> Clause:
    """The requirement with the parameters and measurements of the runs."""
    settings = [flatten(report.configuration) for report in reports]
    parameters = [
        (name, list(dict.fromkeys(str(v) for s in settings for v in _ending(s, name))))
        for name in clause.parameters
    ]
    measured = [
        (number, [m for m in report.table if m.name in clause.measured])
        for number, report in enumerate(reports, start=1)
    ]
    return replace(clause, parameters=parameters, measured=measured)


def _ending(settings: dict[str, Any], name: str) -> list[Any]:
    """Values of the settings whose names end in `name`. If the work cell has such settings,
    only their values are returned.
    """
    found = {key: value for key, value in settings.items() if f".{key}".endswith(f".{name}")}
    cell = [value for key, value in found.items() if "cell." in key]
    return cell or list(found.values())
