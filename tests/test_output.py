"""Files and folders of results: whole or not there at all."""

import json
from pathlib import Path

import pytest

from hrc_learn.output import MADE_BY, new_file, new_folder, replacing

MARK = "mark"


class WorkFailedError(Exception):
    pass


def fill(path: Path, text: str, overwrite: bool = False) -> None:
    with replacing(path, MARK, overwrite) as folder:
        folder.mkdir()
        (folder / MARK).touch()
        (folder / "result").write_text(text)


def fail_to_fill(path: Path, error: type[BaseException]) -> None:
    with replacing(path, MARK, overwrite=True) as folder:
        folder.mkdir()
        (folder / "result").write_text("half")
        raise error


def contents(path: Path) -> dict[str, str]:
    """All files below a folder, hidden ones too, by their relative path."""
    return {
        str(file.relative_to(path)): file.read_text()
        for file in path.rglob("*")
        if file.is_file()
    }


def test_a_file_appears_only_when_it_is_complete(tmp_path):
    path = tmp_path / "file"
    with new_file(path) as part:
        part.write_text("new")
        assert not path.exists()
    assert contents(tmp_path) == {"file": "new"}


def test_a_file_that_fails_leaves_the_old_one_alone(tmp_path):
    (tmp_path / "file").write_text("old")

    def fail() -> None:
        with new_file(tmp_path / "file") as part:
            part.write_text("half")
            raise WorkFailedError

    with pytest.raises(WorkFailedError):
        fail()
    assert contents(tmp_path) == {"file": "old"}


def test_a_folder_appears_only_when_it_is_complete(tmp_path):
    with replacing(tmp_path / "deep" / "out", MARK) as folder:
        assert not folder.exists()
        folder.mkdir()
        (folder / "result").write_text("new")
        assert not (tmp_path / "deep" / "out").exists()
        # A rename is one step only within one file system.
        assert folder.parent == tmp_path / "deep"
    assert contents(tmp_path) == {"deep/out/result": "new"}


@pytest.mark.parametrize("error", [WorkFailedError, KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("before", [None, "old"])
def test_a_failure_leaves_what_was_there(tmp_path, error, before):
    out = tmp_path / "out"
    if before is not None:
        fill(out, before)
    expected = contents(tmp_path)
    with pytest.raises(error):
        fail_to_fill(out, error)
    assert contents(tmp_path) == expected
    assert [path.name for path in tmp_path.iterdir()] == ([] if before is None else ["out"])


def test_work_that_made_nothing_leaves_the_old_folder(tmp_path):
    fill(tmp_path / "out", "old")
    with pytest.raises(FileNotFoundError), replacing(tmp_path / "out", MARK, overwrite=True):
        pass
    assert contents(tmp_path / "out")["result"] == "old"


def test_our_own_folder_is_overwritten_on_request(tmp_path):
    out = tmp_path / "out"
    fill(out, "old")
    (out / "left over").touch()
    fill(out, "new", overwrite=True)
    assert contents(tmp_path) == {"out/mark": "", "out/result": "new"}


def test_an_existing_folder_is_kept_unless_told(tmp_path):
    fill(tmp_path / "out", "old")
    with pytest.raises(FileExistsError, match="out exists: choose another folder"):
        fill(tmp_path / "out", "new")
    assert contents(tmp_path / "out")["result"] == "old"


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_what_is_not_ours_is_never_overwritten(tmp_path, kind):
    out = tmp_path / "out"
    precious = out if kind == "file" else out / "thesis.tex"
    precious.parent.mkdir(exist_ok=True)
    precious.write_text("years")
    with pytest.raises(FileExistsError, match="not ours to overwrite"):
        fill(out, "new", overwrite=True)
    assert precious.read_text() == "years"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_results_say_what_they_were_made_from(tmp_path):
    out = tmp_path / "out"
    with new_folder(out, {"dataset": Path("demos"), "seed": 3, "out": None}) as folder:
        assert not list(folder.iterdir())
        (folder / "model").write_text("weights")
    assert json.loads((out / MADE_BY).read_text()) == {
        "dataset": "demos",
        "seed": 3,
        "out": None,
    }
    assert contents(out)["model"] == "weights"


def test_results_replace_older_results_only(tmp_path):
    out = tmp_path / "out"
    with new_folder(out, {"seed": 1}):
        pass
    with new_folder(out, {"seed": 2}, overwrite=True):
        pass
    assert json.loads((out / MADE_BY).read_text()) == {"seed": 2}
    fill(tmp_path / "dataset", "demonstrations")
    with (
        pytest.raises(FileExistsError, match=MADE_BY),
        new_folder(tmp_path / "dataset", {}, overwrite=True),
    ):
        pass
    assert contents(tmp_path / "dataset")["result"] == "demonstrations"
