"""Leftovers of killed writers are completed or removed."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from cakes import EXTENDED, KIND, cake, contents, fill
from power_cuts import cut_off

import hrc_learn
from hrc_learn import store
from hrc_learn.store import (
    MADE_BY,
    MANIFEST,
    new_file,
    recover,
)

PACKAGE = Path(hrc_learn.__file__).parent


def mend_by_recovery(out: Path) -> None:
    recover(out)


def mend_by_recovery_of_all(out: Path) -> None:
    recover(out.parent)


@pytest.mark.parametrize("mend", [mend_by_recovery, mend_by_recovery_of_all])
def test_a_file_cut_off_at_any_step_is_the_old_or_the_new(tmp_path, mend):
    path = tmp_path / "file"

    def write(text: str = "new") -> None:
        with new_file(path) as part:
            part.write_text(text)

    write("old")
    for _ in cut_off(write):
        assert path.read_text() in ("old", "new")
        mend(path)
        assert contents(tmp_path) in ({"file": "old"}, {"file": "new"})
        assert list(tmp_path.iterdir()) == [path]
        write("old")
    assert contents(tmp_path) == {"file": "new"}


@pytest.mark.parametrize("kind", [KIND, EXTENDED])
@pytest.mark.parametrize("before", [True, False])
def test_a_folder_cut_off_at_any_step_is_the_old_or_the_new(tmp_path, before, kind):
    """What was there before is there whole, or what replaces it is."""
    out, last = tmp_path / "out", 0
    own = {"out/notes": "mine"} if kind is EXTENDED and before else {}

    def begin() -> None:
        if out.exists():
            fill(out, "old", overwrite=True, kind=kind)
        elif before:
            fill(out, "old")
        if own and not (out / "notes").exists():
            (out / "notes").write_text("mine")

    def reset() -> None:
        if not before and out.exists():
            for file in sorted(out.rglob("*"), reverse=True):
                file.rmdir() if file.is_dir() else file.unlink()
            out.rmdir()
        begin()

    reset()
    for step in cut_off(lambda: fill(out, "new", overwrite=True, kind=kind)):
        recover(out)
        assert contents(tmp_path) in (cake("old") | own if before else {}, cake("new") | own)
        last = step
        assert [path.name for path in tmp_path.iterdir()] in ([], ["out"])
        reset()
    assert contents(tmp_path) == cake("new") | own
    assert last > 10  # so that it was cut off in the middle at least


def test_the_next_writer_mends_what_was_cut_off(tmp_path):
    out = tmp_path / "out"
    fill(out, "old")
    for _ in cut_off(lambda: fill(out, "new", overwrite=True)):
        fill(out, "next", overwrite=True)
        assert contents(tmp_path) == cake("next")
        assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_mending_may_be_cut_off_too(tmp_path):
    out, mended = tmp_path / "out", 0
    fill(out, "old")
    for _ in cut_off(lambda: fill(out, "new", overwrite=True)):
        for _ in cut_off(lambda: recover(out)):
            mended += 1
        assert contents(tmp_path) in (cake("old"), cake("new"))
        assert [path.name for path in tmp_path.iterdir()] == ["out"]
        fill(out, "old", overwrite=True)
    assert mended > 20


def test_who_reads_finds_the_old_or_the_new(tmp_path):
    """Also right after a kill between the two renames, when neither has the name."""
    out, missing = tmp_path / "out", 0
    fill(out, "old")
    for _ in cut_off(lambda: fill(out, "new", overwrite=True)):
        before, there = set(tmp_path.rglob("*")), out.exists()
        missing += not there
        store.settle(out / "layers" / "any")
        # A reader leaves alone what a writer may still be doing.
        assert not there or set(tmp_path.rglob("*")) == before
        assert (out / "result").read_text() in ("old", "new")
        fill(out, "old", overwrite=True)
    assert missing


def test_recovery_reports_the_unfinished_content_that_it_removed(tmp_path):
    out, unfinished = tmp_path / "out", 0
    fill(out, "old")
    for _ in cut_off(lambda: fill(out, "new", overwrite=True)):
        half = out.exists() and (tmp_path / ".out.writing" / "new").exists()
        unfinished += half
        assert (f"{out}: removed unfinished content" in recover(out)) == half
        fill(out, "old", overwrite=True)
    assert unfinished > 3


def test_nothing_else_is_deleted_when_something_takes_the_name_in_between(tmp_path):
    out = tmp_path / "out"
    fill(out, "old")
    for _ in cut_off(lambda: fill(out, "new", overwrite=True)):
        if not out.exists():
            break
        recover(out)
        fill(out, "old", overwrite=True)
    out.mkdir()
    (out / "thesis.tex").write_text("years")
    recover(out)
    theirs = {"out/thesis.tex": "years"}
    assert contents(tmp_path) == theirs | cake("old", "out.kept") | cake("new", "out.new")


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="tells files by /proc")
def test_everything_is_on_disk_before_it_takes_its_name(tmp_path, monkeypatch):
    """Else a power cut may keep the names and lose what the files hold."""
    out, done, rename = tmp_path / "out", [], os.rename

    def record(source, target):
        done.append("renamed " + Path(target).name)
        rename(source, target)

    monkeypatch.setattr(
        os, "fsync", lambda file: done.append(Path(os.readlink(f"/proc/self/fd/{file}")).name)
    )
    fill(out, "old")
    monkeypatch.setattr(os, "rename", record)
    done.clear()
    fill(out, "new", overwrite=True)
    away, here = done.index("renamed old"), done.index("renamed out")
    assert {"mark", "result", "layers", "new", MANIFEST, "owned.json"} <= set(done[:away])
    names = {tmp_path.name, ".out.writing"}
    assert names <= set(done[away:here])
    assert names <= set(done[here:])


def test_a_folder_inside_another_one_reaches_the_disk_with_it(tmp_path, monkeypatch):
    synced = []
    with store.new_folder(tmp_path / "out", {}) as folder:
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", synced.append)
            fill(folder / "inner", "once")
        assert not synced
    assert (tmp_path / "out" / "inner" / "result").read_text() == "once"


def test_nothing_is_recovered_where_nothing_was_interrupted(tmp_path):
    assert recover(tmp_path / "missing" / "out") == []
    assert not list(tmp_path.iterdir())


LOOP = """
import sys
sys.path.insert(0, sys.argv[2])
from store import new_folder

for number in range(1_000_000):
    with new_folder(sys.argv[1], {"number": number}, overwrite=True) as folder:
        for name in range(5):
            (folder / str(name)).write_text(str(number))
    print(number, flush=True)
"""


@pytest.mark.slow
def test_whenever_a_writer_is_killed(tmp_path):
    out = tmp_path / "out"
    for kill in range(20):
        process = subprocess.Popen(
            [sys.executable, "-c", LOOP, str(out), str(PACKAGE)],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None
        first = process.stdout.readline()
        time.sleep(0.01 * kill)
        process.kill()
        acknowledged = int([first, *process.stdout.readlines()][-1])
        process.wait()
        recover(out)
        found = store.read_made_by(out)["number"]
        assert acknowledged <= found <= acknowledged + 1
        files = {str(name): str(found) for name in range(5)}
        assert contents(out) == files | {
            MADE_BY: json.dumps({"number": found}, indent=2) + "\n"
        }
        assert [path.name for path in tmp_path.iterdir()] == ["out"]
