"""The check finds what was done to a sound dataset, says where, and never breaks down."""

import pytest
from checker_score import KINDS, Checker, outcomes
from clean_sets import SETS, write_set

from hrc_learn.demos import check_dataset

SAMPLE = [*KINDS][::12]
"""Of all kinds; tools/score_checker.py does every one, on real sets too."""


@pytest.fixture(scope="module", params=SETS)
def clean(request, tmp_path_factory):
    return write_set(tmp_path_factory.mktemp("clean") / "set", **SETS[request.param])


def assert_found(clean, kinds, folder):
    done = list(outcomes(clean, "set", kinds, folder, Checker()))
    assert done
    for outcome in done:
        assert outcome.found, outcome
        assert not outcome.crash
        assert outcome.megabytes < 1000


def test_a_sound_set_has_no_errors(clean):
    report = check_dataset(clean)
    assert report.ok, str(report)
    assert all("no unit declared" in warning.message for warning in report.warnings)


def test_defects_are_found(clean, tmp_path):
    assert_found(clean, SAMPLE, tmp_path)


@pytest.mark.slow
def test_every_kind_of_defect_is_found(clean, tmp_path):
    assert len(KINDS) > 130
    assert_found(clean, KINDS, tmp_path)
