"""Files and folders of results: whole or not there at all, whatever happens to their writer."""

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from power_cuts import cut_off

import hrc_learn
from hrc_learn import store
from hrc_learn.store import (
    MADE_BY,
    MANIFEST,
    BusyError,
    Claim,
    Kind,
    new_file,
    new_folder,
    recover,
    replacing,
)

PACKAGE = Path(hrc_learn.__file__).parent
KIND = Kind(name="cake", mark="mark", files=("mark", "result", "layers/*"))


class WorkFailedError(Exception):
    pass


def fill(path, text: str, overwrite: bool = False, **options) -> None:
    with replacing(path, KIND, overwrite, **options) as folder:
        (folder / "layers").mkdir(parents=True)
        (folder / "mark").touch()
        (folder / "result").write_text(text)
        (folder / "layers" / text).touch()


def fail_to_fill(path: Path, error: type[BaseException]) -> None:
    with replacing(path, KIND, overwrite=True) as folder:
        folder.mkdir()
        (folder / "result").write_text("half")
        raise error


def contents(path: Path) -> dict[str, str]:
    """All files below a folder, hidden ones too, but manifests, by their relative path."""
    return {
        str(file.relative_to(path)): file.read_text()
        for file in path.rglob("*")
        if file.is_file() and file.name != MANIFEST
    }


def cake(text: str, name: str = "out") -> dict[str, str]:
    return {f"{name}/mark": "", f"{name}/result": text, f"{name}/layers/{text}": ""}


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


def test_a_device_is_written_to_and_not_replaced():
    with new_file("/dev/null") as part:
        part.write_text("gone")
    assert Path("/dev/null").is_char_device()


def test_a_folder_appears_only_when_it_is_complete(tmp_path):
    with replacing(tmp_path / "deep" / "out", KIND) as folder:
        assert not folder.exists()
        folder.mkdir()
        (folder / "result").write_text("new")
        assert not (tmp_path / "deep" / "out").exists()
        # A rename is one step only within one file system.
        assert folder.is_relative_to(tmp_path / "deep")
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
    with pytest.raises(FileNotFoundError), replacing(tmp_path / "out", KIND, overwrite=True):
        pass
    assert contents(tmp_path) == cake("old")


def test_our_own_folder_is_overwritten_on_request(tmp_path):
    fill(tmp_path / "out", "old")
    fill(tmp_path / "out", "new", overwrite=True)
    assert contents(tmp_path) == cake("new")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_an_existing_folder_is_kept_unless_told(tmp_path):
    fill(tmp_path / "out", "old")
    with pytest.raises(FileExistsError, match="out exists: choose another folder"):
        fill(tmp_path / "out", "new")
    assert contents(tmp_path) == cake("old")


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


@pytest.mark.parametrize("with_manifest", [True, False])
@pytest.mark.parametrize("name", ["thesis.tex", "layers/own", "own/empty folder/"])
def test_a_folder_that_holds_files_of_the_users_own_is_not_replaced(
    tmp_path, with_manifest, name
):
    out = tmp_path / "out"
    fill(out, "old")
    if not with_manifest:
        if name == "layers/own":
            pytest.skip("without a manifest its name makes it ours")
        (out / MANIFEST).unlink()
    precious = out / name
    precious.parent.mkdir(exist_ok=True)
    precious.mkdir() if name.endswith("/") else precious.write_text("years")
    with pytest.raises(FileExistsError, match="out holds more than a cake"):
        fill(out, "new", overwrite=True)
    assert precious.exists()
    assert (out / "result").read_text() == "old"
    precious.rmdir() if name.endswith("/") else precious.unlink()


def test_what_older_versions_wrote_is_replaced(tmp_path):
    fill(tmp_path / "out", "old")
    (tmp_path / "out" / MANIFEST).unlink()
    fill(tmp_path / "out", "new", overwrite=True)
    assert contents(tmp_path) == cake("new")


def test_an_empty_folder_may_be_filled(tmp_path):
    (tmp_path / "out").mkdir()
    fill(tmp_path / "out", "new", overwrite=True)
    assert contents(tmp_path) == cake("new")


def test_files_of_other_origin_are_carried_over_on_request(tmp_path):
    out = tmp_path / "out"
    fill(out, "old")
    (out / "notes").mkdir()
    (out / "notes" / "mine").write_text("years")
    (out / "link").symlink_to("notes/mine")
    for text in ("new", "newer"):  # and are not taken for results afterwards
        fill(out, text, overwrite=True, others="keep")
        assert (out / "link").is_symlink()
        own = {"out/notes/mine": "years", "out/link": "years"}
        assert contents(tmp_path) == cake(text) | own
    with pytest.raises(FileExistsError, match="link and 2 more"):
        fill(out, "last", overwrite=True)


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


def test_results_replace_older_results_only(tmp_path):
    out = tmp_path / "out"
    with new_folder(out, {"seed": 1}):
        pass
    with new_folder(out, {"seed": 2}, overwrite=True):
        pass
    assert store.read_made_by(out) == {"seed": 2}
    fill(tmp_path / "cake", "sweet")
    with (
        pytest.raises(FileExistsError, match=MADE_BY),
        new_folder(tmp_path / "cake", {}, overwrite=True),
    ):
        pass
    assert contents(tmp_path / "cake")["result"] == "sweet"


WRITER = """
import sys
sys.path.insert(0, sys.argv[2])  # the store alone: it needs nothing of the package around it
from store import new_file

with new_file(sys.argv[1]) as part:
    part.write_text("theirs")
    print("writing", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def other_writer(tmp_path):
    """Another process that writes `tmp_path / "file"` until its input ends."""
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(tmp_path / "file"), str(PACKAGE)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"writing\n"
    yield process
    process.kill()
    process.communicate()


def test_a_second_writer_is_told_of_the_first(tmp_path, other_writer):
    """And neither a reader nor `recover` disturbs the first."""
    path = tmp_path / "file"
    with pytest.raises(BusyError, match=f"by process {other_writer.pid}:"), new_file(path):
        pass
    with pytest.raises(BusyError):
        recover(path)
    assert recover(tmp_path) == []
    store.settle(path)
    other_writer.communicate(timeout=60)
    assert contents(tmp_path) == {"file": "theirs"}


def test_the_lock_of_a_dead_process_does_not_block(tmp_path, other_writer):
    other_writer.kill()
    other_writer.wait()
    assert (tmp_path / ".file.writing").is_dir()
    with new_file(tmp_path / "file") as part:
        part.write_text("ours")
    assert contents(tmp_path) == {"file": "ours"}
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_second_claim_in_the_same_process_is_refused(tmp_path):
    with Claim(tmp_path / "out"), pytest.raises(BusyError, match=str(os.getpid())):
        Claim(tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_claims_that_wait_come_one_after_another(tmp_path):
    """Each adds one to a number; none is lost, though the workspace comes and goes."""
    path = tmp_path / "number"
    path.write_text("0")

    def add() -> None:
        for _ in range(10):
            with Claim(path, wait=True) as claim, new_file(claim) as part:
                part.write_text(str(int(path.read_text()) + 1))

    threads = [threading.Thread(target=add) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert contents(tmp_path) == {"number": "30"}


def test_a_folder_that_is_no_workspace_of_ours_is_left_alone(tmp_path):
    (tmp_path / ".out.writing").mkdir()
    (tmp_path / ".out.writing" / "thesis.tex").write_text("years")
    with pytest.raises(FileExistsError, match="move it elsewhere"):
        fill(tmp_path / "out", "new")
    assert recover(tmp_path) == []
    assert contents(tmp_path) == {".out.writing/thesis.tex": "years"}


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


@pytest.mark.parametrize("others", ["refuse", "keep"])
@pytest.mark.parametrize("before", [True, False])
def test_a_folder_cut_off_at_any_step_is_the_old_or_the_new(tmp_path, before, others):
    """What was there before is there whole, or what replaces it is."""
    out, last = tmp_path / "out", 0
    own = {"out/notes": "mine"} if others == "keep" and before else {}

    def begin() -> None:
        if out.exists():
            fill(out, "old", overwrite=True, others=others)
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
    for step in cut_off(lambda: fill(out, "new", overwrite=True, others=others)):
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
        missing += not out.exists()
        store.settle(out / "layers" / "any")
        assert (out / "result").read_text() in ("old", "new")
        fill(out, "old", overwrite=True)
    assert missing


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


DEAD = 2**22 + 1
"""Larger than any process number of Linux."""


def test_what_older_versions_left_is_mended(tmp_path):
    (tmp_path / f".out.partial.{DEAD}").mkdir()
    (tmp_path / f".out.partial.{DEAD}.recording").mkdir()
    results = tmp_path / f".out.old.{DEAD}"
    results.mkdir()
    (results / MADE_BY).write_text("{}")
    assert recover(tmp_path)
    assert contents(tmp_path) == {f"out/{MADE_BY}": "{}"}
    # A later kill, when the new results had their name already.
    results.mkdir()
    (results / MADE_BY).write_text("{}")
    (results / "thesis.tex").write_text("years")
    alive = tmp_path / f".out.partial.{os.getpid()}"
    alive.mkdir()
    with new_folder(tmp_path / "out", {}, overwrite=True):
        pass
    assert contents(tmp_path) == {f"out/{MADE_BY}": "{}\n", "out.kept/thesis.tex": "years"}
    assert alive.exists()


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
