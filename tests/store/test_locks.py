"""One process at a time writes a thing."""

import errno
import os
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


def test_a_folder_that_is_no_workspace_of_ours_is_left_alone(tmp_path):
    (tmp_path / ".out.writing").mkdir()
    (tmp_path / ".out.writing" / "thesis.tex").write_text("years")
    with pytest.raises(FileExistsError, match="move it elsewhere"):
        fill(tmp_path / "out", "new")
    assert recover(tmp_path) == []
    assert contents(tmp_path) == {".out.writing/thesis.tex": "years"}
