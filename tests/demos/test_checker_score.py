"""The check finds every defect of a sound dataset, locates it, and never breaks down."""

from pathlib import Path

import pytest
from checker_score import KINDS, Checker, check_here, outcomes
from clean_sets import SETS, write_set

from hrc_learn.demos import check_dataset

# Whole datasets are written and read; shapes are checked in the other tests of this folder.
pytestmark = pytest.mark.simulation


def expected() -> dict[str, dict[str, tuple[int, list[str]]]]:
    """Number of findings and what they hold, by set and kind of defect."""
    found: dict[str, dict[str, tuple[int, list[str]]]] = {}
    path = Path(__file__).parents[1] / "defect_findings.txt"
    name = kind = ""
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("["):
            name = line.strip("[]")
            found[name] = {}
        elif line.startswith("    "):
            found[name][kind][1].append(line.strip())
        elif line and not line.startswith("#"):
            kind, _, count = line.rpartition(": ")
            found[name][kind] = int(count), []
    return found


FINDINGS = expected()


@pytest.fixture(
    scope="module",
    params=[pytest.param(x, marks=pytest.mark.long) if x == "v2.0" else x for x in SETS],
)
def name(request):
    return request.param


@pytest.fixture(scope="module")
def clean(name, tmp_path_factory):
    return write_set(tmp_path_factory.mktemp("clean") / "set", **SETS[name])


def assert_found(done):
    assert done
    for outcome in done:
        assert outcome.found, outcome
        assert not outcome.crash
        assert outcome.megabytes < 1000


def test_a_sound_set_has_no_errors(clean):
    report = check_dataset(clean)
    assert report.ok, str(report)
    assert all("no unit declared" in warning.message for warning in report.warnings)


@pytest.mark.long
def test_every_defect_is_found_with_level_place_and_figures(clean, name, tmp_path):
    """Each kind in one of the sets; tools/score_checker.py tests all in each, and real sets."""
    done = list(outcomes(clean, "set", FINDINGS[name], tmp_path, check_here))
    assert_found(done)
    assert len(done) == len(FINDINGS[name])
    for outcome in done:
        count, parts = FINDINGS[name][outcome.kind]
        text = "\n".join(outcome.said)
        for part in parts:
            level, _, rest = part.partition(": ")
            lines = [line for line in outcome.said if line.startswith(f"{level}: ")]
            assert any(rest in line for line in lines), f"{outcome.kind}: {part}\n{text}"
        assert len(outcome.said) == count, f"{outcome.kind}\n{text}"


def test_the_table_names_every_kind():
    assert sorted(kind for kinds in FINDINGS.values() for kind in kinds) == sorted(KINDS)


@pytest.mark.slow
def test_every_kind_of_defect_is_found(clean, tmp_path):
    assert len(KINDS) > 130
    assert_found(list(outcomes(clean, "set", KINDS, tmp_path, Checker())))
