"""The check finds every defect of a sound dataset, locates it, and never breaks down."""

import pytest
from checker_score import KINDS, Checker, check_here, outcomes
from clean_sets import SETS, write_set

from hrc_learn.demos import check_dataset

# Whole datasets are written and read; shapes are checked in the other tests of this folder.
pytestmark = pytest.mark.simulation

SAMPLE = {name: [*KINDS][12 * k :: 36] for k, name in enumerate(SETS)}
"""Every 36th kind of defect for each set, other kinds for other sets; tools/score_checker.py
tests all of them, on real sets too."""


@pytest.fixture(scope="module", params=SETS)
def name(request):
    return request.param


@pytest.fixture(scope="module")
def clean(name, tmp_path_factory):
    return write_set(tmp_path_factory.mktemp("clean") / "set", **SETS[name])


def assert_found(clean, kinds, folder, check):
    done = list(outcomes(clean, "set", kinds, folder, check))
    assert done
    for outcome in done:
        assert outcome.found, outcome
        assert not outcome.crash
        assert outcome.megabytes < 1000


def test_a_sound_set_has_no_errors(clean):
    report = check_dataset(clean)
    assert report.ok, str(report)
    assert all("no unit declared" in warning.message for warning in report.warnings)


def test_defects_are_found(clean, name, tmp_path):
    assert_found(clean, SAMPLE[name], tmp_path, check_here)


@pytest.mark.slow
def test_every_kind_of_defect_is_found(clean, tmp_path):
    assert len(KINDS) > 130
    assert_found(clean, KINDS, tmp_path, Checker())
