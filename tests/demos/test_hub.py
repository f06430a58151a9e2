"""What the real client pushes to a stub of the Hub, and fetches from it, is the dataset."""

import json
import shutil
import sys

import huggingface_hub
import pytest
import yaml
from clean_sets import write_set
from commands import hrc
from hub_stub import FIRST_ATTRIBUTES, TOKEN, serving_hub
from huggingface_hub import constants

from hrc_learn.demos import DatasetError, load_demos, push_dataset

# Whole datasets are written and read; shapes are checked in the other tests of this folder.
pytestmark = pytest.mark.simulation


@pytest.fixture
def hub(monkeypatch, tmp_path):
    # Its content-addressed storage is a service of its own, which no stub can be.
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    with serving_hub() as served:
        yield served


@pytest.fixture
def filmed(tmp_path):
    return write_set(tmp_path / "reach", "v3.0", camera=True)


@pytest.fixture
def dataset(tmp_path):
    return write_set(tmp_path / "reach", "v3.0")


def client(hub, token=TOKEN):
    return huggingface_hub.HfApi(endpoint=hub.endpoint, token=token)


def contents(root):
    files = (path for path in root.rglob("*") if path.is_file())
    return {str(path.relative_to(root)): path.read_bytes() for path in files}


def test_what_is_fetched_is_what_was_pushed_with_a_card(hub, filmed, tmp_path):
    dataset = filmed
    before = contents(dataset)
    (dataset / "notes.txt").write_text("not of the dataset")
    pushed = push_dataset(
        dataset, "alice/reach", license="mit", tags=["reach"], api=client(hub)
    )
    repo = hub.repositories["alice/reach"]
    assert repo.private
    assert pushed.url == f"{hub.endpoint}/datasets/alice/reach"
    assert repo.tags == {"v3.0": repo.branches["main"]}
    assert before.items() <= repo.files().items()
    assert repo.files().keys() - before.keys() == {".gitattributes", "README.md"}
    assert pushed.files.keys() == before.keys()
    assert contents(dataset).keys() - before.keys() == {"notes.txt"}
    # Tables and videos are large files, metadata can be read in a clone.
    assert {path.rsplit(".")[-1] for path in repo.large} == {"parquet", "mp4"}
    assert FIRST_ATTRIBUTES.encode() in repo.files()[".gitattributes"]
    fetched = client(hub).snapshot_download(
        "alice/reach", repo_type="dataset", revision="v3.0", local_dir=tmp_path / "fetched"
    )
    assert load_demos(fetched).frames == load_demos(dataset).frames
    card = repo.files()["README.md"].decode()
    _, head, body = card.split("---\n", 2)
    info = json.loads((dataset / "meta/info.json").read_text())
    assert yaml.safe_load(head) == {
        "license": "mit",
        "tags": ["LeRobot", info["robot_type"], "reach"],
        "task_categories": ["robotics"],
        "configs": [{"config_name": "default", "data_files": "data/*/*.parquet"}],
    }
    frames = info["total_frames"]
    for told in (
        f"5 demonstrations by {info['robot_type']}, {frames} frames",
        "0 errors",
    ):
        assert told in body
    assert "| observation.state/joint1.pos .. joint6.pos | arm | rad |" in body
    assert "`observation.images.front`" in body


def test_a_shorter_dataset_leaves_nothing_of_the_longer_one(hub, dataset):
    extra = dataset / "data/chunk-000/file-009.parquet"
    shutil.copy(dataset / "data/chunk-000/file-000.parquet", extra)
    push_dataset(dataset, "alice/reach", unsound=True, api=client(hub))
    repo = hub.repositories["alice/reach"]
    first = repo.tags["v3.0"]
    assert "data/chunk-000/file-009.parquet" in repo.files()
    extra.unlink()
    push_dataset(dataset, "alice/reach", private=False, api=client(hub))
    assert "data/chunk-000/file-009.parquet" not in repo.files()
    assert repo.private  # that is the owner's to change
    assert repo.tags["v3.0"] == repo.branches["main"] != first


def test_the_tag_moves_when_all_is_there(hub, dataset, monkeypatch):
    push_dataset(dataset, "alice/reach", api=client(hub))
    repo = hub.repositories["alice/reach"]
    first = dict(repo.tags)

    def break_off(*_args, **_kwargs):
        raise ConnectionResetError

    api = client(hub)
    monkeypatch.setattr(api, "upload_folder", break_off)
    (dataset / "README.md").write_text("# Mine\n")
    with pytest.raises(ConnectionResetError):
        push_dataset(dataset, "alice/reach", api=api)
    assert repo.tags == first
    assert repo.branches["main"] != first["v3.0"]


def test_a_card_of_its_own_is_kept(hub, dataset):
    own = "---\nlicense: cc-by-4.0\ntags: [mine]\npretty_name: Reach\n---\n# Mine\n\nBy hand.\n"
    (dataset / "README.md").write_text(own)
    push_dataset(dataset, "alice/reach", api=client(hub))
    card = hub.repositories["alice/reach"].files()["README.md"].decode()
    _, head, body = card.split("---\n", 2)
    assert body.strip() == "# Mine\n\nBy hand."
    completed = yaml.safe_load(head)
    assert completed["tags"][:2] == ["mine", "LeRobot"]
    assert (completed["license"], completed["pretty_name"]) == ("cc-by-4.0", "Reach")
    assert (dataset / "README.md").read_text() == own


def test_what_has_errors_stays_here(hub, dataset):
    (dataset / "data/chunk-000/file-000.parquet").write_bytes(b"PAR1")
    with pytest.raises(DatasetError, match=r"1 errors: .*--unsound.*The first: data/chunk"):
        push_dataset(dataset, "alice/reach", api=client(hub))
    assert not hub.requests


@pytest.mark.parametrize("name", ["reach", "alice/reach/x", "alice/re ach", "../reach"])
def test_a_name_that_is_none(dataset, name):
    with pytest.raises(ValueError, match=r"OWNER/NAME|Repo id"):
        push_dataset(dataset, name)


def test_without_the_hubs_libraries_the_command_names_the_extra(dataset, monkeypatch):
    monkeypatch.setitem(sys.modules, "httpx", None)
    status, _, error = hrc("push", dataset, "alice/reach", "--dry-run")
    assert status == 1
    assert "pip install 'hrc-learn[hub]'" in error


def test_the_command(hub, dataset, tmp_path, monkeypatch):
    # As HF_ENDPOINT sets them before the library is imported.
    template = hub.endpoint + "/{repo_id}/resolve/{revision}/{filename}"
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
    monkeypatch.setattr(constants, "ENDPOINT", hub.endpoint)
    shown = ("push", dataset, "alice/reach", "--dry-run")
    status, text, _ = hrc(*shown)
    assert status == 0
    assert "nothing sent" in text
    assert "meta/info.json" in text
    assert not hub.requests
    monkeypatch.setenv("HF_TOKEN", "hf_of_nobody")
    status, _, error = hrc("push", dataset, "alice/reach")
    assert status == 1
    assert "hf auth login" in error
    assert error.count("\n") == 1
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    figures = tmp_path / "values.json"
    status, text, error = hrc("push", dataset, "alice/reach", "--json", figures)
    assert status == 0, error
    assert f"{hub.endpoint}/datasets/alice/reach" in text
    assert "no licence" in text
    files = hub.repositories["alice/reach"].files()
    assert json.loads(figures.read_text())["files"] == len(files) - 2
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    status, _, error = hrc("push", dataset, "alice/reach")
    assert (status, error.count("\n")) == (1, 1)
    assert "cannot be reached" in error
