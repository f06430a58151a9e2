"""One process at a time writes a thing."""

import errno
import os
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from cakes import contents, fill

import hrc_learn
from hrc_learn import store
from hrc_learn.store import (
    BusyError,
    Claim,
    new_file,
    recover,
)

PACKAGE = Path(hrc_learn.__file__).parent

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


def test_file_systems_without_locks_are_written_to(tmp_path, monkeypatch):
    """Some network file systems have none."""
    fcntl = pytest.importorskip("fcntl")

    def refuse(*_):
        raise OSError(errno.ENOLCK, "no locks")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with new_file(tmp_path / "file") as part:
        part.write_text("ours")
    assert contents(tmp_path) == {"file": "ours"}


def test_a_second_claim_in_the_same_process_is_refused(tmp_path):
    with Claim(tmp_path / "out"), pytest.raises(BusyError, match=str(os.getpid())):
        Claim(tmp_path / "out")
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(os.name == "nt", reason="deletes no open file")
def test_a_lock_is_held_until_it_is_gone(tmp_path, monkeypatch):
    """Else who has opened it meanwhile would hold the lock of a file that nobody finds."""
    import fcntl

    unlink, seen = os.unlink, []

    def check(path, **options):
        if Path(path).name == "lock":
            seen.append(path)
            with open(path, encoding="utf-8") as other, pytest.raises(BlockingIOError):
                fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        unlink(path, **options)

    monkeypatch.setattr(os, "unlink", check)
    with new_file(tmp_path / "file") as part:
        part.write_text("new", encoding="utf-8")
    assert len(seen) == 1
    assert contents(tmp_path) == {"file": "new"}


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


@pytest.mark.parametrize("name", [".out.writing/thesis.tex", ".out.writing"])
def test_a_folder_that_is_no_workspace_of_ours_is_left_alone(tmp_path, name):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("years")
    with pytest.raises(FileExistsError, match="move it elsewhere"):
        fill(tmp_path / "out", "new")
    assert recover(tmp_path) == []
    assert contents(tmp_path) == {name: "years"}
    (tmp_path / ".link.writing").symlink_to(tmp_path / "nowhere")
    with pytest.raises(FileExistsError, match="move it elsewhere"):
        fill(tmp_path / "link", "new")


@pytest.mark.parametrize(
    ("signed", "said"),
    [("", "another process"), ("12 far\n", "process 12 on far"), ("12 {here}\n", "process 12")],
)
def test_the_writer_in_the_way_is_named_with_its_host(tmp_path, signed, said):
    """Also a writer that has locked the file and not signed it yet."""
    with Claim(tmp_path / "out") as claim:
        lock = claim.workspace / "lock"
        lock.write_text(signed.format(here=socket.gethostname()))
        with pytest.raises(BusyError, match=f"written by {said}: wait until that ends"):
            Claim(tmp_path / "out")
        lock.unlink()  # by hand, as a lock left over
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("gone", ["after a look", "before the lock", "with the lock"])
def test_a_writer_that_comes_while_another_ends_takes_the_next_lock(
    tmp_path, monkeypatch, gone
):
    """The other one removes the workspace at any moment in between."""
    opened, path_open, mkdir = [], Path.open, os.mkdir

    def look(path, *arguments):
        mkdir(path, *arguments)
        if gone == "after a look" and not opened:
            opened.append(path)
            os.rmdir(path)
            raise FileExistsError(errno.EEXIST, "there", str(path))

    def race(path, *arguments, **options):
        if path.name == "lock" and not opened:
            opened.append(path)
            if gone == "before the lock":
                path.parent.rmdir()
            else:
                file = path_open(path, *arguments, **options)
                path.unlink()
                return file
        return path_open(path, *arguments, **options)

    monkeypatch.setattr(os, "mkdir", look)
    monkeypatch.setattr(Path, "open", race)
    with Claim(tmp_path / "out") as claim:
        assert (claim.workspace / "lock").read_text().startswith(f"{os.getpid()} ")
        with pytest.raises(BusyError):
            Claim(tmp_path / "out")
    assert opened


def test_a_claim_that_cannot_be_prepared_holds_no_lock(tmp_path, monkeypatch):
    """A full disk, for example, refuses the signature."""

    def refuse(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", refuse)
        with pytest.raises(OSError, match=r"No space.*out"):
            Claim(tmp_path / "out")
    assert not list(tmp_path.iterdir())
    Claim(tmp_path / "out").release()
