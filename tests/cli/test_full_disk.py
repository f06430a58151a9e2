"""On a full disk a command ends in one line that names its result, and leaves nothing of it."""

import contextlib
import gc
import resource
import shutil

import numpy as np
import pytest
from clean_sets import SETS, write_set
from commands import done, hrc
from lerobot_folders import joint_path

from hrc_learn.demos import DatasetWriter, load_demos

COMMANDS = {
    "check": "check {set} --json {out}",
    "check to a folder": "check {set} --out {out}",
    "import": "import {npz} --out {out} --joints q --time t",
    "repair": "repair {set} {out}",
    "curate": "curate {set} --no-browser --reject 0 --write --out {out}",
    "show": "show {set} --out {out}.rrd",
    "fit": "fit {set} --out {out} --n-basis 10",
    "report": "report {fit} --out {out}",
}
"""Command lines that write to `out`."""


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """A recording, its dataset and a fit of it."""
    folder = tmp_path_factory.mktemp("sound")
    places = {name: folder / name for name in ("set", "fit")} | {"npz": folder / "pour.npz"}
    np.savez(places["npz"], t=0.02 * np.arange(60), q=joint_path(60, 7))
    done(
        "import",
        places["npz"],
        places["npz"],
        "--out",
        places["set"],
        "--joints",
        "q",
        "--time",
        "t",
    )
    done("fit", places["set"], "--out", places["fit"], "--n-basis", 10)
    return places


@contextlib.contextmanager
def small_files(size):
    """A limit on the size of files [bytes], for this process."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("size", [60, 3000])
@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
def test_a_full_disk_is_one_line(places, command, size, tmp_path):
    """A limit on the size of files stands for the full disk: it fails at the same calls."""
    if "--json" in command and size > 60:
        pytest.skip("figures fit into so large a file")
    words = command.format(out=tmp_path / "out", **places).split()
    with small_files(size):
        status, _, errors = hrc(*words)
    assert status == 2, errors
    last = errors.strip().splitlines()[-1]
    assert last.startswith("error: ")
    assert "File too large" in last
    assert "Traceback" not in errors
    assert ".writing" not in last
    # Only the saved episodes of a recording are kept, for `hrc repair`, and the line says so.
    left = {path.name for path in tmp_path.iterdir()}
    assert left == ({"out.recording"} if "hrc repair" in last else set())


def test_episodes_that_wait_for_room_on_the_disk_become_the_dataset(tmp_path):
    writer = DatasetWriter(tmp_path / "set", 20, "any")
    writer.start_episode("wait")
    for _ in range(30):
        writer.add_frame(position=[0.1, 0.2, 0.3])
    writer.save_episode()
    with small_files(60), pytest.raises(OSError, match="File too large") as full:
        writer.finalize()
    assert "hrc repair" in full.value.__notes__[0]
    done("repair", tmp_path)
    (demo,) = load_demos(tmp_path / "set")
    assert len(demo) == 30


def test_a_recording_that_does_not_fit_on_the_disk_leaves_nothing(tmp_path):
    with small_files(10), pytest.raises(OSError, match="File too large"):
        DatasetWriter(tmp_path / "set", 20, "any")
    assert not list(tmp_path.iterdir())


@pytest.mark.long
def test_a_dashboard_in_the_way_is_one_line(places, tmp_path, capfd):
    """Rerun writes its warnings past Python, to the process's own stderr."""
    out = tmp_path / "out.rrd"
    out.mkdir()
    status, _, errors = hrc("show", places["set"], "--out", out)
    assert (status, errors) == (2, f"error: {out} is a folder: choose another file\n")
    gc.collect()
    assert capfd.readouterr().err == ""


def test_a_full_device_is_one_line(places):
    status, _, errors = hrc("check", places["set"], "--json", "/dev/full")
    assert (status, errors) == (2, "error: /dev/full: No space left on device\n")


def test_a_decision_that_does_not_fit_keeps_those_before(places, tmp_path):
    shutil.copytree(places["set"], tmp_path / "set")
    done("curate", tmp_path / "set", "--no-browser", "--reject", 1)
    kept = (tmp_path / "set.curation.json").read_bytes()
    with small_files(60):
        status, _, errors = hrc("curate", tmp_path / "set", "--no-browser", "--reject", 0)
    assert (status, errors) == (2, f"error: {tmp_path}/set.curation.json: File too large\n")
    assert (tmp_path / "set.curation.json").read_bytes() == kept
    assert {path.name for path in tmp_path.iterdir()} == {"set", "set.curation.json"}


def test_a_feature_that_does_not_fit_on_the_disk_leaves_nothing(tmp_path):
    root = write_set(tmp_path / "set", **SETS["v3.0 with a camera"])
    with small_files(60):
        status, _, errors = hrc("fit", "image-jacobian", root, "--marker", 3)
    assert status == 2
    assert errors.strip().splitlines()[-1].endswith("episode_000000.parquet: File too large")
    (demo,) = load_demos(root, [0])
    assert demo.feature is None
