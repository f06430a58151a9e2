"""Fixtures of the tests of experiments."""

from types import SimpleNamespace

import pytest

from hrc_learn.experiments import trials


@pytest.fixture(autouse=True)
def no_collection_after_trials(monkeypatch):
    """The trials of these tests leave nothing to collect, and looking takes seconds each."""
    monkeypatch.setattr(trials, "gc", SimpleNamespace(collect=lambda: 0))
