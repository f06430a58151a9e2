"""Addresses of pages: names, ports, secrets, certificates and the code for phones."""

import base64
import errno
import ipaddress
import os
import socket
import ssl
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from hrc_learn.teleoperation.gate import address, qr_code
from hrc_learn.teleoperation.gate.address import (
    Address,
    AddressConfig,
    listening_socket,
    network_name,
    tls_context,
)


def test_an_address_is_ours_alone_unless_asked_for():
    assert AddressConfig().local
    assert AddressConfig(host="localhost").local
    assert not AddressConfig(host="0.0.0.0").local
    assert tls_context(AddressConfig()) is None
    assert network_name(AddressConfig(host="192.0.2.7")) == "192.0.2.7"
    assert network_name(AddressConfig(host="0.0.0.0", name="arm.local")) == "arm.local"
    one, other = (Address(scheme="http", host="::1", port=8080) for _ in range(2))
    assert one.origin == "http://[::1]:8080"
    assert one.token != other.token
    assert one.token not in repr(one)
    assert one.link("/xr") == f"http://[::1]:8080/xr#token={one.token}"
    assert one.watch_token in one.link(watch=True)
    assert one.token not in one.link(watch=True)


def test_what_cannot_be_served_is_refused():
    assert AddressConfig(port=65535, most_clients=1).port == 65535
    with pytest.raises(ValueError, match="most_clients must be at least 1"):
        AddressConfig(most_clients=0)
    for port in (65536, -1):
        with pytest.raises(ValueError, match="port must be 0 to 65535"):
            AddressConfig(port=port)
    with pytest.raises(ValueError, match="given together"):
        AddressConfig(certificate=Path(__file__))
    with pytest.raises(ValueError, match=r"192\.0\.2\.1 is no address of this"):
        listening_socket(AddressConfig(host="192.0.2.1"))


def test_a_port_in_use_is_refused_and_without_one_the_next_free_is_taken():
    with listening_socket(AddressConfig()) as one:
        port = one.getsockname()[1]
        with pytest.raises(
            ValueError, match=f"port {port} of 127.0.0.1 is in use; give another"
        ):
            listening_socket(AddressConfig(port=port))
        with listening_socket(AddressConfig()) as other:
            assert other.getsockname()[1] > port
    with listening_socket(AddressConfig(port=0)) as any_free:
        assert any_free.getsockname()[1] > 1023


def test_a_page_on_the_network_has_a_certificate_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    config = AddressConfig(host="0.0.0.0", name="arm.local")
    assert isinstance(tls_context(config), ssl.SSLContext)
    folder = tmp_path / "hrc_learn" / "tls"
    made = {file.name: file.read_bytes() for file in folder.iterdir()}
    assert set(made) == {"arm.local.pem", "arm.local.key"}
    assert folder.stat().st_mode & 0o077 == 0
    tls_context(config)  # is used again
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == made
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ValueError, match="install openssl"):
        tls_context(AddressConfig(host="0.0.0.0", name="other.local"))
    (folder / "arm.local.pem").write_text("no certificate")
    with pytest.raises(ValueError, match=r"arm\.local\.pem"):
        tls_context(config)


def test_a_certificate_that_ends_is_made_anew(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(address, "_VALID_DAYS", 2)
    config = AddressConfig(host="0.0.0.0", name="arm.local")
    tls_context(config)
    certificate = tmp_path / "hrc_learn" / "tls" / "arm.local.pem"
    before = certificate.read_bytes()
    tls_context(config)
    assert certificate.read_bytes() != before


@pytest.mark.parametrize(("name", "kind"), [("192.0.2.7", "IP Address"), ("arm.local", "DNS")])
def test_a_certificate_names_its_page_and_is_served_where_it_is_given(
    tmp_path, monkeypatch, name, kind
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    tls_context(AddressConfig(host="0.0.0.0", name=name))
    folder = tmp_path / "hrc_learn" / "tls"
    pem, key = folder / f"{name}.pem", folder / f"{name}.key"
    shown = subprocess.run(
        ["openssl", "x509", "-noout", "-dates", "-ext", "subjectAltName", "-in", str(pem)],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert f"{kind}:{name}" in shown
    begins, ends = (
        ssl.cert_time_to_seconds(line.split("=")[1]) for line in shown.splitlines()[:2]
    )
    assert 790 <= (ends - begins) / 86400 <= 825
    # Given by name, it is served even to this machine alone, and nothing is made.
    own = {file: file.rename(tmp_path / file.name) for file in (pem, key)}
    context = tls_context(AddressConfig(certificate=own[pem], key=own[key]))
    assert isinstance(context, ssl.SSLContext)
    assert not list(folder.iterdir())
    with pytest.raises(ValueError, match=r"certificate .* with key"):
        tls_context(AddressConfig(certificate=own[key], key=own[pem]))


def test_every_address_is_reached_by_the_one_that_goes_out():
    name = network_name(AddressConfig(host="0.0.0.0"))
    assert name == network_name(AddressConfig(host="::"))
    assert name not in ("0.0.0.0", "::", "")
    if name != socket.gethostname():
        assert not ipaddress.ip_address(name).is_unspecified


def test_a_phone_reads_the_code():
    text = "https://192.0.2.7:8080/xr#token=" + "aB3_-x" * 4
    lines = qr_code(text).splitlines()
    cells = {"█": (1, 1), "▀": (1, 0), "▄": (0, 1), " ": (0, 0)}
    rows = [[cells[cell][half] for cell in line] for line in lines for half in (0, 1)]
    rows_of_code = len(rows[0]) - 2  # the code is square, with a light column to either side
    assert len(rows) == rows_of_code + 1
    assert all(row[0] and row[-1] for row in rows)
    assert all(all(row) for row in rows[rows_of_code:])
    image = np.kron(np.array(rows, np.uint8) * 255, np.ones((6, 6), np.uint8))
    assert cv2.QRCodeDetector().detectAndDecode(image)[0] == text


def test_each_secret_has_144_bits():
    one = Address(scheme="http", host="arm.local", port=8080)
    for secret in (one.token, one.watch_token):
        assert 8 * len(base64.urlsafe_b64decode(secret)) == 144


def test_where_all_first_ports_are_in_use_they_are_named(monkeypatch):
    with listening_socket(AddressConfig()) as one, listening_socket(AddressConfig()) as other:
        ports = [each.getsockname()[1] for each in (one, other)]
        monkeypatch.setattr(address, "_FIRST_PORTS", ports)
        with pytest.raises(
            ValueError, match=f"each port from {ports[0]} on of 127.0.0.1 is in use; give"
        ):
            listening_socket(AddressConfig())


def test_a_port_that_may_not_be_used_is_refused_with_the_reason(monkeypatch):
    def refused(*_, **__):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(socket, "create_server", refused)
    with pytest.raises(
        ValueError, match=r"^port 80 of .* at: Permission denied; give another port\.$"
    ):
        listening_socket(AddressConfig(port=80))


def test_a_host_that_has_no_address_is_refused():
    for port in (None, 0):
        with pytest.raises(ValueError, match="host no host is no address of this machine: "):
            listening_socket(AddressConfig(host="no host", port=port))


@pytest.mark.skipif(not socket.has_dualstack_ipv6(), reason="there is no IPv6")
def test_an_address_of_ipv6_is_served():
    with listening_socket(AddressConfig(host="::1", port=0)) as one:
        assert one.family == socket.AF_INET6
        with socket.create_connection(("::1", one.getsockname()[1]), timeout=10):
            pass


@pytest.mark.parametrize(("days", "made_anew"), [(7, True), (8, False)])
def test_a_certificate_is_used_while_it_lasts_another_week(
    tmp_path, monkeypatch, capfd, days, made_anew
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(address, "_VALID_DAYS", days)
    config = AddressConfig(host="0.0.0.0", name="arm.local")
    pem = tmp_path / "hrc_learn" / "tls" / "arm.local.pem"
    tls_context(config)
    before = pem.read_bytes()
    tls_context(config)
    assert (pem.read_bytes() != before) == made_anew
    assert capfd.readouterr() == ("", "")


def test_half_a_certificate_is_made_anew_and_a_whole_one_needs_no_openssl(
    tmp_path, monkeypatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    config = AddressConfig(host="0.0.0.0", name="arm.local")
    folder = tmp_path / "hrc_learn" / "tls"
    tls_context(config)
    for missing in ("pem", "key"):
        (folder / f"arm.local.{missing}").unlink()
        tls_context(config)
        assert (folder / f"arm.local.{missing}").is_file()
    assert len(list(folder.iterdir())) == 2
    monkeypatch.setenv("PATH", "")
    assert isinstance(tls_context(config), ssl.SSLContext)


def test_openssl_that_fails_is_an_error(tmp_path, monkeypatch):
    fake = tmp_path / "bin" / "openssl"
    fake.parent.mkdir()
    fake.write_text("#!/bin/sh\necho out of order >&2\nexit 3\n")
    fake.chmod(0o755)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("PATH", str(fake.parent))
    with pytest.raises(ValueError, match="out of order"):
        tls_context(AddressConfig(host="0.0.0.0", name="arm.local"))
