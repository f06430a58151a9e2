"""Admit clients: check host and origin of each request, and its secret."""

from __future__ import annotations

import hmac
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from hrc_learn.teleoperation.gate.address import Address, AddressConfig, network_name

Right = Literal["act", "watch"]
"""Right of a client: to act on the arm or the data, or only to watch."""

# Number of wrong secrets allowed at once, and per second. At this rate, a secret of 144 bits
# cannot be guessed.
_WRONG_SECRETS, _FORGIVEN = 20.0, 1.0
_DEFAULT_PORTS = {"http": 80, "https": 443}

_POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob: data:; "
    "connect-src 'self' blob: data:; frame-ancestors 'none'; form-action 'none'"
)
"""Content security policy: the page may load from and send to its own origin only, and no page
may show it in a frame."""

HEADERS = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Permissions-Policy": "xr-spatial-tracking=(self)",
}
"""Security headers sent with every response."""


@dataclass(kw_only=True)
class Bucket:
    """Token bucket that bounds a rate and allows a burst."""

    rate: float
    """Tokens added per second [1/s]."""
    burst: float
    clock: Callable[[], float] = time.monotonic
    left: float = field(init=False)
    last: float = field(init=False)

    def __post_init__(self) -> None:
        self.left, self.last = self.burst, self.clock()

    def take(self) -> bool:
        """Take one token; False if none is left."""
        now = self.clock()
        self.left = min(self.burst, self.left + self.rate * (now - self.last))
        self.last = now
        if self.left < 1:
            return False
        self.left -= 1
        return True


class RefusedError(Exception):
    """Refusal of a request, with its HTTP status code."""

    def __init__(self, code: int, words: str):
        super().__init__(words)
        self.code = code


class Admission:
    """Checks of the host, the origin and the secret of a request.

    The secret travels in a header or a WebSocket subprotocol, never in a cookie. Browsers send
    the cookies of a host to all ports of this host, and so to other servers.

    Attributes:
        address: Address of the page, with its secrets.
    """

    def __init__(self, config: AddressConfig, port: int, *, tls: bool):
        """
        Args:
            config: Host and name of the page.
            port: Port of the page.
            tls: True if the page is served by TLS.
        """
        scheme = "https" if tls else "http"
        self.address = Address(scheme=scheme, host=network_name(config), port=port)
        names = {self.address.host.lower(), "localhost", "127.0.0.1", "::1"}
        hosts = {f"[{name}]" if ":" in name else name for name in names}
        self._hosts = {f"{host}:{port}" for host in hosts}
        if port == _DEFAULT_PORTS[scheme]:  # browsers omit default ports
            self._hosts |= hosts
        self._wrong = Bucket(rate=_FORGIVEN, burst=_WRONG_SECRETS)

    def is_ours(self, host: str) -> bool:
        """True if a Host header names this server. Another name may have been bound to our
        address (DNS rebinding).
        """
        return host.lower() in self._hosts

    def from_ours(self, origin: str) -> bool:
        """True if an Origin header is that of our own page: scheme, host and port."""
        scheme, _, host = origin.partition("://")
        return scheme == self.address.scheme and self.is_ours(host)

    def right(self, secret: str) -> Right:
        """Right of a client with this secret.

        Raises:
            RefusedError: The secret is empty or wrong.
        """
        if not secret:
            raise RefusedError(
                401, "Open the whole address that the terminal shows: it has a secret."
            )
        if same_secret(secret, self.address.token):
            return "act"
        if same_secret(secret, self.address.watch_token):
            return "watch"
        if self._wrong.take():
            raise RefusedError(
                403, "This secret is not valid: open the address that the terminal shows."
            )
        raise RefusedError(429, "Too many wrong secrets.")


def same_secret(given: str, secret: str) -> bool:
    """Compare two strings in constant time.

    Args:
        given: Text sent by a client; it may contain bytes that are not valid text, as headers
            may.
        secret: ASCII characters other than `?`.
    """
    return hmac.compare_digest(given.encode(errors="replace"), secret.encode())
