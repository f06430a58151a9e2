"""On a full disk a command ends in one line that names its result, and leaves nothing of it."""

import resource

import numpy as np
import pytest
from commands import done, hrc
from lerobot_folders import joint_path

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


@pytest.mark.parametrize("size", [60, 3000])
@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
def test_a_full_disk_is_one_line(places, command, size, tmp_path):
    """A limit on the size of files stands for the full disk: it fails at the same calls."""
    if "--json" in command and size > 60:
        pytest.skip("figures fit into so large a file")
    words = command.format(out=tmp_path / "out", **places).split()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        status, _, errors = hrc(*words)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert status == 2, errors
    last = errors.strip().splitlines()[-1]
    assert last.startswith("error: ")
    assert last.endswith("File too large")
    assert "Traceback" not in errors
    assert ".writing" not in last
    # Only the saved episodes of a recording are kept, for `hrc recover`.
    assert {path.name for path in tmp_path.iterdir()} <= {"out.recording"}


def test_a_full_device_is_one_line(places):
    status, _, errors = hrc("check", places["set"], "--json", "/dev/full")
    assert (status, errors) == (2, "error: /dev/full: No space left on device\n")
