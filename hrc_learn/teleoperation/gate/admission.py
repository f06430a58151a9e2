"""Admission of clients: the secret of the address, a session cookie, and checks of host and
origin.
"""

from __future__ import annotations

import hmac
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from urllib.parse import parse_qs, urlsplit

from hrc_learn.teleoperation.gate.address import Address, AddressConfig, network_name

_WRONG_TOKENS, _FORGIVEN = 20.0, 1.0  # at once, then one a second: 144 bits cannot be guessed

_POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob: data:; "
    "connect-src 'self' blob: data:; frame-ancestors 'none'; form-action 'none'"
)
"""The page loads from, sends to and is framed by its own origin only."""

HEADERS = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
"""Security headers sent with every response."""


@dataclass(kw_only=True)
class Bucket:
    """Lets so many through a second, and so many at once."""

    rate: float
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


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Early response to a request that is refused or redirected."""

    code: int
    """HTTP status code."""
    words: str = ""
    headers: dict[str, str] = field(default_factory=dict)


class Admission:
    """Checks if a request comes from an authorised client.

    The secret of the address is exchanged for a cookie, which no other site can send.

    Attributes:
        address: Address of the page, with its secret.
    """

    def __init__(self, config: AddressConfig, port: int, *, tls: bool):
        """
        Args:
            config: Host and name of the page.
            port: Port of the page.
            tls: True if the page is served by TLS.
        """
        self.address = Address(
            scheme="https" if tls else "http", host=network_name(config), port=port
        )
        self._cookie = f"hrc_page_{port}"
        self._hosts = {self.address.host, "localhost", "127.0.0.1", "::1"}
        self._wrong = Bucket(rate=_FORGIVEN, burst=_WRONG_TOKENS)

    def refuse(
        self, target: str, host: str, cookies: Iterable[str], known: Callable[[str], bool]
    ) -> Verdict | None:
        """Check a request.

        Args:
            target: Requested path and query.
            host: Host header.
            cookies: Cookie headers.
            known: True for paths that exist.

        Returns:
            The response that refuses or redirects the request; None if it may pass.
        """
        if not self.is_ours(host):
            return Verdict(code=403, words="This page is not served under that name.")
        try:
            parts = urlsplit(target)
        except ValueError:
            return Verdict(code=403, words="That is no address of this page.")
        if "token" in (query := parse_qs(parts.query)):
            return self._enter(query["token"][0], parts.path if known(parts.path) else "/")
        if not self._knows(cookies):
            return Verdict(
                code=401,
                words="Open the whole address that the terminal shows: it has a secret.",
            )
        return None

    def is_ours(self, host: str) -> bool:
        """True if a Host header names this server. Another name may have been bound to our
        address (DNS rebinding).
        """
        with suppress(ValueError):
            parts = urlsplit(f"//{host}")
            return parts.hostname in self._hosts and parts.port in (self.address.port, None)
        return False

    def from_ours(self, origin: str) -> bool:
        """True if an Origin header is that of our own page."""
        with suppress(ValueError):
            parts = urlsplit(origin)
            return parts.scheme == self.address.scheme and self.is_ours(parts.netloc)
        return False

    def _enter(self, token: str, path: str) -> Verdict:
        if not same_secret(token, self.address.token):
            if self._wrong.take():
                return Verdict(code=403, words="That secret is not the one of this start.")
            return Verdict(code=429, words="Too many wrong secrets.")
        secure = "; Secure" if self.address.scheme == "https" else ""
        cookie = f"{self._cookie}={token}; HttpOnly; SameSite=Strict; Path=/{secure}"
        return Verdict(code=303, headers={"Location": path, "Set-Cookie": cookie})

    def _knows(self, cookies: Iterable[str]) -> bool:
        for cookie in "; ".join(cookies).split(";"):
            name, _, value = cookie.strip().partition("=")
            if name == self._cookie:
                return same_secret(value, self.address.token)
        return False


def same_secret(given: str, secret: str) -> bool:
    """Compare two strings in constant time.

    Args:
        given: Text sent by a client; may hold bytes that are not valid text, as headers may.
        secret: ASCII characters other than `?`.
    """
    return hmac.compare_digest(given.encode(errors="replace"), secret.encode())
