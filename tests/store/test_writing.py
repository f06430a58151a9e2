"""Files and folders are whole or not there at all, whatever happens to their writer."""

import errno
import json
import math
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from cakes import KIND, WorkFailedError, cake, contents, fail_to_fill, fill

from hrc_learn import store
from hrc_learn.demos import DatasetWriter
from hrc_learn.store import (
    Claim,
    new_file,
    new_folder,
    replacing,
    write_text,
)
from hrc_learn.store._folder import carry_over


def test_a_file_appears_only_when_it_is_complete(tmp_path):
    path = tmp_path / "file.txt"
    with new_file(path) as part:
        part.write_text("new")
        assert part.name == path.name  # as some writers tell the format by that
        assert not path.exists()
    assert contents(tmp_path) == {"file.txt": "new"}
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_fails_leaves_the_old_one_alone(tmp_path):
    (tmp_path / "file").write_text("old")

    def fail() -> None:
        with new_file(tmp_path / "file") as part:
            part.write_text("half")
            raise WorkFailedError

    with pytest.raises(WorkFailedError):
        fail()
    assert contents(tmp_path) == {"file": "old"}


def test_a_file_replaces_no_folder(tmp_path):
    (tmp_path / "name").mkdir()
    with pytest.raises(FileExistsError, match="is a folder"), new_file(tmp_path / "name"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["name"]


def test_the_folder_of_a_file_must_exist(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        Claim(tmp_path / "missing" / "file")
    with pytest.raises(FileExistsError, match="/ cannot be written: name a file"):
        Claim("/")


def test_a_device_is_written_to_and_not_replaced():
    with new_file("/dev/null") as part:
        part.write_text("gone")
    assert Path("/dev/null").is_char_device()


def test_a_folder_appears_only_when_it_is_complete(tmp_path):
    with replacing(tmp_path / "far" / "deep" / "out", KIND) as folder:
        assert not folder.exists()
        folder.mkdir()
        (folder / "result").write_text("new")
        assert not (tmp_path / "far" / "deep" / "out").exists()
        # A rename is one step only within one file system.
        assert folder.is_relative_to(tmp_path / "far" / "deep")
    assert contents(tmp_path) == {"far/deep/out/result": "new"}


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
    with pytest.raises(FileNotFoundError), replacing(tmp_path / "out", KIND, overwrite=True):
        pass
    assert contents(tmp_path) == cake("old")


@pytest.mark.parametrize("before", [None, "old"])
@pytest.mark.parametrize("taken", [False, True])
def test_a_folder_that_cannot_take_its_name_leaves_what_was_there(
    tmp_path, monkeypatch, before, taken
):
    """And if others took the name between the renames, both contents are kept aside."""
    out, rename = tmp_path / "out", os.rename
    if before is not None:
        fill(out, before)
    expected = contents(tmp_path)

    def refuse(source, target):
        if Path(source).name == "new" and Path(target) == out:
            if taken:
                out.mkdir()
                (out / "thesis.tex").write_text("years")
            raise OSError(errno.EACCES, os.strerror(errno.EACCES), str(target))
        rename(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", refuse)
        with pytest.raises(PermissionError):
            fill(out, "new", overwrite=True)
    if taken:
        expected = {"out/thesis.tex": "years"}
        if before is not None:
            expected |= cake("old", "out.kept") | cake("new", "out.new")
    assert contents(tmp_path) == expected


def test_our_own_folder_is_overwritten_on_request(tmp_path):
    fill(tmp_path / "out", "old")
    fill(tmp_path / "out", "new", overwrite=True)
    assert contents(tmp_path) == cake("new")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_an_existing_folder_is_kept_unless_told(tmp_path):
    fill(tmp_path / "out", "old")
    with (
        pytest.raises(FileExistsError, match="out exists: choose another folder"),
        replacing(tmp_path / "out", KIND),
    ):
        pass
    assert contents(tmp_path) == cake("old")


@pytest.mark.parametrize("before", [True, False])
def test_a_link_stays_a_link(tmp_path, before):
    target, link = tmp_path / "disk" / "out", tmp_path / "out"
    target.parent.mkdir()
    if before:
        fill(target, "old")
    link.symlink_to(target)
    fill(link, "new", overwrite=True)
    assert link.is_symlink()
    assert contents(tmp_path / "disk") == cake("new")
    file, link = tmp_path / "disk" / "file", tmp_path / "file"
    link.symlink_to(file)
    with new_file(link) as part:
        part.write_text("new")
    assert link.is_symlink()
    assert file.read_text() == "new"


def test_results_say_what_they_were_made_from(tmp_path):
    out = tmp_path / "out"
    with new_folder(out, {"dataset": Path("demos"), "seed": 3, "out": None}) as folder:
        assert not list(folder.iterdir())
        (folder / "model").write_text("weights")
    assert store.read_made_by(out) == {"dataset": "demos", "seed": 3, "out": None}
    assert contents(out)["model"] == "weights"


def test_inputs_that_cannot_be_saved_are_refused_before_the_work(tmp_path):
    name = os.fsdecode(b"caf\xe9")  # a folder of an older system, not in UTF-8
    with (
        pytest.raises(ValueError, match="surrogates"),
        new_folder(tmp_path / "results", {"dataset": Path(name)}),
    ):
        pytest.fail("the work began")
    assert not list(tmp_path.iterdir())


def test_a_folder_remembers_the_identifier_of_its_source(tmp_path):
    with replacing(tmp_path / "made", KIND, source="recording 7") as folder:
        folder.mkdir()
    assert store.source_of(tmp_path / "made") == "recording 7"
    (tmp_path / "foreign").mkdir()
    assert store.source_of(tmp_path / "foreign") == ""


def test_results_replace_older_results_only(tmp_path):
    out = tmp_path / "out"
    with new_folder(out, {"seed": 1}):
        pass
    with pytest.raises(FileExistsError, match="out exists"), new_folder(out, {"seed": 2}):
        pass
    with new_folder(out, {"seed": 2}, overwrite=True):
        pass
    assert store.read_made_by(out) == {"seed": 2}
    fill(tmp_path / "cake", "sweet")
    with (
        pytest.raises(FileExistsError, match="so it is not overwritten"),
        new_folder(tmp_path / "cake", {}, overwrite=True),
    ):
        pass
    assert contents(tmp_path / "cake")["result"] == "sweet"


def test_folders_of_texts_and_values_are_made_where_they_are_missing(tmp_path):
    path = tmp_path / "far" / "away" / "text"
    for text in ("süß\n", "newer\n"):
        store.write_text(path, text)
        assert path.read_text(encoding="utf-8") == text
    values = {"a": np.float32(0.5), "b": torch.tensor(3), "c": math.inf, "d": True}
    store.write_json(path.with_name("values"), values)
    written = json.loads(path.with_name("values").read_text())
    assert written == {"a": 0.5, "b": 3, "c": None, "d": True}


def test_a_folder_that_takes_no_new_files_is_an_error_at_once():
    """/proc, like a network folder that is away, reports that the new file does not exist."""
    with pytest.raises(FileNotFoundError, match="hrc"), new_file(Path("/proc/hrc")):
        pass


@pytest.mark.parametrize(("given", "place"), [("caches", "caches"), ("", "home/.cache")])
def test_caches_are_where_the_user_keeps_them(tmp_path, monkeypatch, given, place):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / given) if given else "")
    assert store.cache_home() == tmp_path / place


@pytest.mark.parametrize("exists", [False, True])
def test_missing_folders_above_are_created(tmp_path, exists):
    """Of files, folders of results, datasets and copies; folders that exist are used."""
    above = tmp_path / "two" / "levels"
    if exists:
        above.mkdir(parents=True)
    write_text(above / "text" / "a.txt", "text")
    write_text(above / "text" / "b.txt", "more")
    assert (above / "text" / "a.txt").read_text() == "text"

    above = tmp_path / "results" / "of" / "today"
    if exists:
        above.mkdir(parents=True)
    for name in ("first", "second"):
        with new_folder(above / name, {}) as folder:
            (folder / "values.json").write_text("{}")
        assert (above / name / "values.json").is_file()

    root = tmp_path / "sets" / "of" / "alice" / "reach"
    if exists:
        root.parent.mkdir(parents=True)
    with DatasetWriter(root, 10, "any", ["a"]) as writer:
        writer.start_episode("reach")
        for k in range(3):
            writer.add_frame(joint_position=[0.1 * k])
        writer.save_episode()
    assert (root / "meta" / "info.json").is_file()


def test_entries_are_carried_over_with_the_folders_above_them(tmp_path):
    source, target = tmp_path / "source", tmp_path / "target"
    (source / "a" / "b" / "empty").mkdir(parents=True)
    (source / "a" / "b" / "file").write_text("content")
    target.mkdir()
    # Only the innermost entries are named.
    names = ["a/b/empty/", "a/b/file"]
    assert carry_over(names, source, target) == {*names}
    assert (target / "a" / "b" / "file").read_text() == "content"
    assert (target / "a" / "b" / "empty").is_dir()
    assert carry_over(names, source, target) >= {"a/b/empty/"}
