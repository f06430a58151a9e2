"""`hrc page` with ports that it cannot serve at."""

import socket

import pytest
from commands import done

pytest.importorskip("viser", reason="the extra `ui` is not installed")


def test_a_wrong_port_and_a_port_in_use_end_in_one_line(tmp_path):
    page = ("page", "--out", tmp_path / "demos", "--port")
    said = done(*page, "99999", status=2).error
    assert "port must be 0 to 65535" in said
    assert said.count("\n") == 1
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        said = done(*page, port, status=2).error
    assert said.count("\n") == 1
    assert said.startswith(f"error: port {port} of 127.0.0.1 is in use; give another port")
    assert not list(tmp_path.iterdir())
