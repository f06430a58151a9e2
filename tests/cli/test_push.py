"""`hrc push` has LeRobot upload a sound dataset to a stub of the Hub, or says why not."""

import json
import sys
from types import SimpleNamespace

import httpx
import pytest
import yaml
from clean_sets import write_set
from commands import hrc
from hub_stub import TOKEN, serving_hub

from hrc_learn.demos import load_demos

# Whole datasets are written and read; shapes are checked in the tests of their folders.
pytestmark = pytest.mark.simulation


@pytest.fixture
def dataset(tmp_path):
    return write_set(tmp_path / "reach", "v3.0")


@pytest.fixture
def hub(monkeypatch, tmp_path):
    from huggingface_hub import constants

    with serving_hub() as served:
        # As HF_ENDPOINT sets them before the library is imported.
        template = served.endpoint + "/{repo_id}/resolve/{revision}/{filename}"
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
        monkeypatch.setattr(constants, "ENDPOINT", served.endpoint)
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
        # Its content-addressed storage is a service of its own, which no stub can be.
        monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
        monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
        monkeypatch.setenv("HF_TOKEN", TOKEN)
        yield served


def test_what_has_errors_stays_here(hub, dataset):
    file = dataset / "data/chunk-000/file-000.parquet"
    file.write_bytes(file.read_bytes()[:-100])
    status, _, error = hrc("push", dataset, "alice/reach")
    assert status == 2
    assert "--unsound" in error
    assert "data/chunk-000/file-000.parquet" in error
    assert not hub.requests


def test_a_trial_run_sends_nothing(hub, dataset, tmp_path):
    figures = tmp_path / "values.json"
    status, text, error = hrc("push", dataset, "alice/reach", "--dry-run", "--json", figures)
    assert status == 0, error
    assert "MB" in text
    count = sum(path.is_file() for path in dataset.rglob("*"))
    assert json.loads(figures.read_text())["files"] == count
    assert not hub.requests


@pytest.mark.parametrize("repo", ["a/b/c", "alice/reach/", "alice/-reach", "alice reach"])
def test_a_name_that_the_hub_refuses_is_refused_at_once(hub, dataset, repo):
    status, _, error = hrc("push", dataset, repo, "--dry-run")
    assert (status, error.count("\n")) == (2, 1)
    assert repo in error
    assert not hub.requests


def test_without_lerobot_the_command_names_the_extra(dataset, monkeypatch):
    monkeypatch.setitem(sys.modules, "lerobot.datasets", None)
    status, _, error = hrc("push", dataset, "alice/reach")
    assert status == 1
    assert "pip install 'hrc-learn[lerobot]'" in error


@pytest.mark.slow
def test_what_is_fetched_is_what_was_pushed_with_card_and_tag(
    hub, dataset, tmp_path, monkeypatch
):
    from huggingface_hub import RepoCard, constants, snapshot_download

    # Its address of the service that validates cards cannot be set.
    monkeypatch.setattr(RepoCard, "validate", lambda *_args, **_kwargs: None)
    given = ("push", dataset, "alice/reach", "--license", "mit", "--tags", "reach")
    monkeypatch.setenv("HF_TOKEN", "hf_of_another")
    status, _, error = hrc(*given)
    assert status == 1
    assert "hf auth login" in error
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    status, text, error = hrc(*given)
    assert status == 0, error
    assert "uploaded to alice/reach" in text
    repo = hub.repositories["alice/reach"]
    assert repo.private
    assert repo.tags["v3.0"] == repo.branches["main"]
    fetched = snapshot_download("alice/reach", repo_type="dataset", local_dir=tmp_path / "copy")
    assert load_demos(fetched).frames == load_demos(dataset).frames
    card = yaml.safe_load(repo.files()["README.md"].decode().split("---\n", 2)[1])
    assert card["license"] == "mit"
    assert {"LeRobot", "reach"} <= {*card["tags"]}
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    status, _, error = hrc(*given)
    assert status == 1
    assert "not uploaded" in error


@pytest.mark.parametrize("fails", [False, True])
def test_the_status_says_whether_lerobot_has_uploaded(dataset, monkeypatch, fails):
    """A stand-in of LeRobot keeps what it is asked for."""
    calls = []

    class Dataset:
        def __init__(self, repo, root):
            calls.append((repo, root))

        def push_to_hub(self, **options):
            calls.append(options)
            if fails:
                raise httpx.ConnectError("no route\nto the Hub")

    monkeypatch.setitem(
        sys.modules, "lerobot.datasets", SimpleNamespace(LeRobotDataset=Dataset)
    )
    given = ("push", dataset, "alice/reach", "--license", "mit", "--tags", "a", "b")
    status, text, error = hrc(*given, "--no-private")
    assert calls == [
        ("alice/reach", dataset),
        {"tags": ["a", "b"], "license": "mit", "private": False},
    ]
    assert status == fails
    assert ("uploaded to alice/reach" in text) != fails
    assert ("error: not uploaded" in error and "no route" in error) == fails
