"""`hrc page`: what it prints and measures, and ports that it cannot serve at."""

import json
import re
import socket

import pytest
from commands import done
from unchecked import shapes_unchecked

from hrc_learn.teleoperation.gate import qr_code

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


@pytest.mark.long
@pytest.mark.simulation
def test_a_page_on_the_network_runs_for_its_duration(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    where = ("--host", "0.0.0.0", "--port", 0, "--config", "page.name=arm.local")
    limits = ("--duration", 0.1, "--json", tmp_path / "values.json")
    with shapes_unchecked():  # also in the threads of the page
        output = done("page", "--out", tmp_path / "demos", *where, *limits).output
    address = r"(https://arm\.local:\d+/#token=\S{24})\n"
    (url,) = re.findall(f"\nPage at {address}", output)
    assert output.startswith("Preparing arm and work cell; the first start takes longer\n")
    (watching,) = re.findall(f"\nTo watch only: {address}", output)
    assert url.split("#")[0] == watching.split("#")[0]
    assert url != watching
    assert f"Anyone with this address can move the arm:\n{qr_code(url)}\n" in output
    assert "No demonstration was saved, so there is no dataset" in output
    assert not (tmp_path / "demos").exists()
    values = json.loads((tmp_path / "values.json").read_text())
    assert (values["steps"], values["episodes"]) == (10, 0)  # of 10 ms each
    assert values["latest_s"] > 0 <= values["missed_ticks"]
