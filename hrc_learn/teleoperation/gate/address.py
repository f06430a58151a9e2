"""Address of the page: host and port, secret, TLS certificate, and a QR code for phones."""

from __future__ import annotations

import errno
import ipaddress
import secrets
import shutil
import socket
import ssl
import subprocess
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hrc_learn.store import cache_home

_FIRST_PORTS = range(8080, 8180)  # tried in turn if no port is given
_NO_ADDRESS = {errno.EADDRNOTAVAIL, socket.EAI_NONAME, socket.EAI_AGAIN, socket.EAI_FAIL}
_VALID_DAYS = 800  # browsers refuse certificates of more than 825 days
_LEAST = 7 * 24 * 3600  # remaining validity below which our own certificate is replaced [s]


@dataclass(frozen=True, kw_only=True)
class AddressConfig:
    """Host, port, certificate and client limit of a page."""

    host: str = "127.0.0.1"
    """Address to serve at. By default, only this machine can reach it. At a network address,
    the page uses TLS."""
    port: int | None = None
    """Port to serve at, which must be free. 0: any free port; None: the first free port from
    8080 on."""
    name: str = ""
    """Name by which browsers reach this machine on the network; empty: its address."""
    certificate: Path | None = None
    """Certificate for TLS (PEM); None: a self-signed certificate, with a browser warning."""
    key: Path | None = None
    """Private key of the certificate (PEM)."""
    most_clients: int = 32
    """Largest number of browsers connected at once."""

    def __post_init__(self) -> None:
        if self.port is not None and not 0 <= self.port <= 65535:
            raise ValueError(f"port must be 0 to 65535, but is {self.port}.")
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate and key must be given together, or neither.")
        if not self.most_clients >= 1:
            raise ValueError(f"most_clients must be at least 1, but is {self.most_clients}.")

    @property
    def local(self) -> bool:
        """True if only this machine can reach the page."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"


def _secret() -> str:
    return secrets.token_urlsafe(18)


@dataclass(frozen=True, kw_only=True)
class Address:
    """Address of a page that is being served."""

    scheme: str
    host: str
    port: int
    token: str = field(default_factory=_secret, repr=False)
    """Secret that opens the page; new with each start."""
    watch_token: str = field(default_factory=_secret, repr=False)
    """Secret that opens the page for watching only."""

    @property
    def origin(self) -> str:
        """Address without the secret."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.scheme}://{host}:{self.port}"

    def link(self, path: str = "/", *, watch: bool = False) -> str:
        """Address with a secret in its fragment, which browsers send to no server.

        Args:
            path: Path of the page.
            watch: True for a link for watching only. With any other link, a person can move
                the arm.
        """
        return f"{self.origin}{path}#token={self.watch_token if watch else self.token}"


def network_name(config: AddressConfig) -> str:
    """Name or address by which browsers reach the page."""
    if config.name or config.local or config.host not in ("0.0.0.0", "::"):
        return config.name or config.host
    # Connecting a datagram socket sends nothing; it only selects the address that this machine
    # would use. The destination is reserved for documentation (RFC 5737).
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
        except OSError:
            return socket.gethostname()
        return probe.getsockname()[0]


def listening_socket(config: AddressConfig) -> socket.socket:
    """Socket that listens at the configured port, or at the first free port from 8080 on.

    Raises:
        ValueError: No such port is free, or the host is not an address of this machine.
    """
    family = socket.AF_INET6 if ":" in config.host else socket.AF_INET
    ports = _FIRST_PORTS if config.port is None else (config.port,)
    last: OSError | None = None
    for port in ports:
        try:
            return socket.create_server((config.host, port), family=family)
        except OSError as error:
            last = error
            if error.errno in _NO_ADDRESS:
                raise ValueError(
                    f"host {config.host} is no address of this machine: {error.strerror}"
                ) from error
    assert last is not None
    if last.errno == errno.EADDRINUSE:
        why, cure = "is in use", "give another port, or none for the first that is free"
    else:
        why, cure = f"cannot be served at: {last.strerror}", "give another port"
    which = f"port {ports[0]}" if len(ports) == 1 else f"each port from {ports[0]} on"
    raise ValueError(f"{which} of {config.host} {why}; {cure}.") from last


def tls_context(config: AddressConfig) -> ssl.SSLContext | None:
    """TLS context of a page on the network; None if only this machine can reach the page and
    no certificate is configured.

    Without a configured certificate, `openssl` makes a certificate. It is kept in the cache
    folder and used again while it is valid, so that browsers warn about it only once.

    Raises:
        ValueError: There is neither a certificate nor `openssl`, or the certificate is invalid.
    """
    if config.local and config.certificate is None:
        return None
    certificate, key = config.certificate, config.key
    if certificate is None or key is None:
        certificate, key = _own_certificate(network_name(config))
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(certificate, key)
    except (OSError, ssl.SSLError) as error:
        raise ValueError(f"certificate {certificate} with key {key}: {error}") from error
    return context


def _own_certificate(name: str) -> tuple[Path, Path]:
    folder = cache_home() / "hrc_learn" / "tls"
    certificate, key = folder / f"{name}.pem", folder / f"{name}.key"
    openssl = shutil.which("openssl")
    if certificate.is_file() and key.is_file() and (openssl is None or _lasts(certificate)):
        return certificate, key
    if openssl is None:
        raise ValueError(
            "a page on the network needs TLS: install openssl, which makes a certificate, or "
            "give page.certificate and page.key."
        )
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    try:
        kind = f"IP:{ipaddress.ip_address(name)}"
    except ValueError:
        kind = f"DNS:{name}"
    made = folder / f"{secrets.token_hex(4)}.new"
    run = subprocess.run(
        [
            *(openssl, "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256"),
            *("-nodes", "-days", str(_VALID_DAYS), "-subj", "/CN=hrc page"),
            *("-addext", f"subjectAltName={kind}"),
            *("-keyout", str(made.with_suffix(".key")), "-out", str(made)),
        ],
        capture_output=True,
        text=True,
    )
    if run.returncode:
        raise ValueError(f"openssl cannot make a certificate: {run.stderr.strip()}")
    made.with_suffix(".key").replace(key)
    made.replace(certificate)
    return certificate, key


def _lasts(certificate: Path) -> bool:
    """True if the certificate stays valid for a few more days."""
    command = ["openssl", "x509", "-noout", "-checkend", str(_LEAST), "-in", str(certificate)]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


def qr_code(text: str) -> str:
    """QR code for a terminal, dark on light, with two rows of the code per line.

    Args:
        text: Text to encode.

    Returns:
        Lines of text; empty if OpenCV cannot encode it.
    """
    try:
        import cv2

        code = cv2.QRCodeEncoder.create().encode(text)
    except (ImportError, AttributeError):
        return ""
    # A code has an odd number of rows; on a dark terminal it needs light borders.
    light = np.pad(code // 255, ((0, 1), (1, 1)), constant_values=1)
    blocks = np.array([[" ", "▄"], ["▀", "█"]])
    return "\n".join("".join(row) for row in blocks[light[::2], light[1::2]].tolist())
