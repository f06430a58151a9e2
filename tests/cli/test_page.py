"""`hrc page` as it is started."""

import os
import socket
import subprocess
import sys

import pytest

pytest.importorskip("viser", reason="the extra `ui` is not installed")


def page(tmp_path, *options):
    """Run it; what it leaves behind is looked at as well."""
    command = [sys.executable, "-m", "hrc_learn.cli", "page", "--out", str(tmp_path / "demos")]
    done = subprocess.run(
        [*command, *options],
        env={**os.environ, "COLUMNS": "80"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.stdout == ""
    assert list(tmp_path.iterdir()) == []
    return done.returncode, done.stderr


def test_no_port_and_a_port_in_use_end_in_one_line(tmp_path):
    status, said = page(tmp_path, "--port", "99999")
    assert (status, said.count("\n")) == (2, 1)
    assert "port must be 0 to 65535" in said
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        status, said = page(tmp_path, "--port", str(port))
    assert (status, said.count("\n")) == (2, 1)
    assert said.startswith(f"error: port {port} of 127.0.0.1 is in use; give another port")
