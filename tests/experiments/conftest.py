"""What the tests of experiments share."""

from types import SimpleNamespace

import pytest

from hrc_learn.experiments import monte_carlo


@pytest.fixture(autouse=True)
def no_collection_after_trials(monkeypatch):
    """The trials of these tests leave nothing to collect, and looking takes seconds each."""
    monkeypatch.setattr(monte_carlo, "gc", SimpleNamespace(collect=lambda: 0))
