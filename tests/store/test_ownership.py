"""Only files written by this package are replaced or deleted."""

import errno
import json
import os
import shutil

import pytest
from cakes import EXTENDED, KIND, cake, contents, fill

from hrc_learn.store import (
    MADE_BY,
    MANIFEST,
    Kind,
    delete_files,
    new_folder,
    replacing,
)


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_what_is_not_ours_is_never_overwritten(tmp_path, kind):
    out = tmp_path / "out"
    precious = out if kind == "file" else out / "thesis.tex"
    precious.parent.mkdir(exist_ok=True)
    precious.write_text("years")
    with pytest.raises(FileExistsError, match="so it is not overwritten"):
        fill(out, "new", overwrite=True)
    assert precious.read_text() == "years"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("name", ["thesis.tex", "layers/own", "own/empty folder/"])
def test_a_folder_that_holds_files_of_the_users_own_is_not_replaced(tmp_path, name):
    out = tmp_path / "out"
    fill(out, "old")
    precious = out / name
    precious.parent.mkdir(exist_ok=True)
    precious.mkdir() if name.endswith("/") else precious.write_text("years")
    more = " and 1 more" if name.startswith("own/") else ""  # its folder is listed, too
    first = name.partition("/")[0] + "/" if more else name
    with pytest.raises(
        FileExistsError, match=f"not part of the cake and would be lost, {first}{more}:"
    ):
        fill(out, "new", overwrite=True)
    assert precious.exists()
    assert (out / "result").read_text() == "old"
    precious.rmdir() if name.endswith("/") else precious.unlink()


def test_a_folder_without_a_manifest_is_not_ours(tmp_path):
    fill(tmp_path / "out", "old")
    (tmp_path / "out" / MANIFEST).unlink()
    with pytest.raises(FileExistsError, match="so it is not overwritten"):
        fill(tmp_path / "out", "new", overwrite=True)
    assert contents(tmp_path) == cake("old")
    fill(tmp_path / "out", "new", overwrite=True, kind=EXTENDED)
    assert contents(tmp_path) == cake("new")


def test_an_empty_folder_may_be_filled(tmp_path):
    (tmp_path / "out").mkdir()
    fill(tmp_path / "out", "new", overwrite=True)
    assert contents(tmp_path) == cake("new")


@pytest.mark.parametrize("file_system_has_links", [True, False])
def test_files_of_other_origin_are_carried_over_if_it_can_be_extended(
    file_system_has_links, tmp_path, monkeypatch
):
    def refuse(*_, **__):
        raise OSError(errno.EPERM, "no links here")

    if not file_system_has_links:
        monkeypatch.setattr(os, "link", refuse)
    out = tmp_path / "out"
    fill(out, "old")
    (out / "notes").mkdir()
    (out / "notes" / "mine").write_text("years")
    (out / "link").symlink_to("notes/mine")
    for text in ("new", "newer"):  # and are not taken for results afterwards
        fill(out, text, overwrite=True, kind=EXTENDED)
        assert (out / "link").is_symlink()
        own = {"out/notes/mine": "years", "out/link": "years"}
        assert contents(tmp_path) == cake(text) | own
    with pytest.raises(FileExistsError, match="link and 2 more"):
        fill(out, "last", overwrite=True)


@pytest.mark.parametrize("made", ["", "extra", "extra/own"])
def test_foreign_folders_are_carried_over_whatever_the_new_folder_has(tmp_path, made):
    """Also out of a folder that we wrote once and no longer write."""
    out, plain = tmp_path / "out", Kind(name="plain", files=("part",))
    with replacing(out, plain) as folder:
        (folder / "extra" / "shared").mkdir(parents=True)
    (out / "extra" / "own" / "empty").mkdir(parents=True)
    (out / "extra" / "own" / "mine").write_text("years")
    (out / "extra" / "shared" / "mine").write_text("years")
    with replacing(out, plain, overwrite=True) as folder:
        (folder / made).mkdir(parents=True)
    mine = {"out/extra/own/mine": "years", "out/extra/shared/mine": "years"}
    assert contents(tmp_path) == mine
    assert (out / "extra" / "own" / "empty").is_dir()


def test_a_foreign_file_whose_name_is_taken_is_kept_aside(tmp_path):
    out = tmp_path / "out"
    fill(out, "old")
    (out / "notes").write_text("years")

    def write(name: str = "notes") -> None:
        with replacing(out, EXTENDED, overwrite=True) as folder:
            folder.mkdir()
            (folder / name).write_text("their")
            # Of one size and time: what it holds decides.
            shutil.copystat(out / name, folder / name)

    with pytest.warns(UserWarning, match=r"out\.kept"):
        write()
    assert contents(tmp_path) == {"out/notes": "their", "out.kept/notes": "years"}
    (out / "thesis").write_text("weeks")
    with pytest.warns(UserWarning, match=r"out\.kept-2"):
        write("thesis")
    kept = {"out.kept/notes": "years", "out.kept-2/thesis": "weeks"}
    assert contents(tmp_path) == {"out/thesis": "their"} | kept


def test_a_file_put_there_in_the_meantime_is_kept_aside(tmp_path):
    out = tmp_path / "out"
    fill(out, "old")

    def write() -> None:
        with replacing(out, KIND, overwrite=True) as folder:
            folder.mkdir()
            (out / "thesis.tex").write_text("years")

    with pytest.warns(UserWarning, match=r"out\.kept"):
        write()
    assert contents(tmp_path) == {"out.kept/thesis.tex": "years"}


def test_a_folder_put_there_in_the_meantime_is_not_replaced(tmp_path):
    out = tmp_path / "out"

    def write() -> None:
        with replacing(out, KIND) as folder:
            folder.mkdir()
            (folder / "result").write_text("hours")
            out.mkdir()
            (out / "thesis.tex").write_text("years")

    with pytest.raises(FileExistsError, match="exists") as raised:
        write()
    assert contents(tmp_path) == {"out/thesis.tex": "years", "out.new/result": "hours"}
    assert "out.new" in raised.value.__notes__[0]


def test_a_manifest_reaches_nothing_outside_its_folder(tmp_path):
    (tmp_path / "precious").write_text("years")
    out = tmp_path / "out"
    fill(out, "old")
    manifest = json.loads((out / MANIFEST).read_text())
    manifest["entries"] += ["../precious", str(tmp_path / "precious"), "../"]
    (out / MANIFEST).write_text(json.dumps(manifest))
    fill(out, "new", overwrite=True)
    assert contents(tmp_path) == cake("new") | {"precious": "years"}


def test_results_inside_results_belong_to_them_only_if_written_with_them(tmp_path):
    out = tmp_path / "out"

    def write(overwrite: bool = False) -> None:
        with new_folder(out, {}, overwrite) as folder:
            fill(folder / "inner", "old")

    write()
    fill(out / "inner", "again", overwrite=True)  # with other files than before
    write(overwrite=True)
    assert contents(tmp_path) == cake("old", "out/inner") | {f"out/{MADE_BY}": "{}\n"}
    fill(out / "another", "run")
    with pytest.raises(FileExistsError, match="another/"):
        write(overwrite=True)
    assert contents(out / "another") == {
        name.removeprefix("x/"): text for name, text in cake("run", "x").items()
    }


@pytest.mark.parametrize("foreign", [False, True])
def test_a_folder_of_temporary_files_is_deleted_with_nothing_else(foreign, tmp_path):
    folder = tmp_path / "staging"
    (folder / "data").mkdir(parents=True)
    (folder / "data" / "part-1").write_text("half")
    if foreign:
        (folder / "data" / "notes").write_text("years")
    assert delete_files(folder, ["data/part-*"]) is not foreign
    assert contents(tmp_path) == ({"staging/data/notes": "years"} if foreign else {})
