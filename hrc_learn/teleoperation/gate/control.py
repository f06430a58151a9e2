"""Control of the arm by one client at a time, as long as that client is alive."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from threading import RLock
from typing import Literal

Role = Literal["leads", "watches"]


@dataclass(frozen=True, kw_only=True)
class ControlView:
    """Control state as shown to one client."""

    role: Role
    taken: bool
    """True if any client has control."""
    asked: bool
    """For the controlling client: true if another client requests control. For a watching
    client: true if it has requested control itself.
    """
    may_lead: bool = True
    """False for a client that may only watch."""


_REMEMBERED = 3.0
"""Time for which the cause of a slow browser is shown [s], enough to read a sentence."""


class Control:
    """Gives control to one of several clients; the others watch and may request control.

    The first client to join has control and keeps it until it hands over or leaves. A client
    that requests control also gets it when the controlling client has been idle for `max_idle`.
    Control is never taken away during a drag. Safe to use from several threads.
    """

    def __init__(
        self,
        silence: float,
        timeout: float,
        *,
        max_idle: float = 10.0,
        clock: Callable[[], float] = time.monotonic,
    ):
        """Start without clients.

        Args:
            silence: Time without a sign of life after which the controlling client requests no
                motion [s].
            timeout: Time without a sign of life after which the client releases what it holds,
                and an unresponsive page counts as gone [s].
            max_idle: Idle time after which a waiting client gets control [s].
            clock: Monotonic clock [s].

        Raises:
            ValueError: Times are not positive, or silence is longer than timeout.
        """
        if not 0 < silence <= timeout:
            raise ValueError(
                "silence must be positive and no longer than timeout, but they are "
                f"{silence} and {timeout} s."
            )
        self._silence, self._timeout, self._max_idle = silence, timeout, max_idle
        self._clock = clock
        self._heard: dict[str, float] = {}
        self._lag: dict[str, float] = {}
        self._slow: dict[str, tuple[float, float, float]] = {}
        self._asking: dict[str, float] = {}
        self._able: set[str] = set()
        self._leader: str | None = None
        self._acted = float("-inf")
        self._turn = 0
        self._lock = RLock()

    def join(self, client: str, *, may_lead: bool = True) -> None:
        """Add a client. It gets control if no other client has it and it may lead."""
        with self._lock:
            self._heard[client] = self._clock()
            if may_lead:
                self._able.add(client)
                if self._leader is None:
                    self._give(client)

    def leave(self, client: str) -> None:
        """Remove a client."""
        with self._lock:
            for table in (self._heard, self._lag, self._slow, self._asking):
                table.pop(client, None)
            self._able.discard(client)
            if client == self._leader:
                # The only client left leads, as the first to come does: a page that is loaded
                # anew may come before the old one has left.
                alone = next(iter(self._able)) if len(self._able) == 1 else None
                self._give(min(self._asking, key=self._asking.__getitem__, default=alone))

    def hear(self, client: str, lag: float = 0.0) -> None:
        """Note a sign of life.

        Args:
            client: Client that gives it.
            lag: Time since its page last responded [s]; the worker may run on when the page
                hangs.
        """
        with self._lock:
            if client not in self._heard:
                return
            now = self._clock()
            silence = now - self._heard[client]
            self._heard[client], self._lag[client] = now, lag
            if silence > self._silence or lag > self._timeout / 2:
                self._slow[client] = now, silence, lag

    def act(self, client: str, *, idle: bool = False) -> bool:
        """True if a client may act now.

        Args:
            client: Client that wants to act.
            idle: True if its message changes nothing, such as a hand that holds nothing. Only
                other messages reset the idle time.
        """
        with self._lock:
            self._pass_on()
            if client != self._leader:
                return False
            if not idle:
                self._acted = self._clock()
            return True

    def keep(self) -> None:
        """Note that the leader holds something, which they may without saying so."""
        with self._lock:
            self._acted = self._clock()

    def ask(self, client: str) -> None:
        """Request control. A client gets it at once if it is free, else when the holder hands
        over.
        """
        with self._lock:
            if client not in self._able or client == self._leader:
                return
            if self._leader is None:
                self._give(client)
            else:
                self._asking.setdefault(client, self._clock())

    def hand_over(self, client: str) -> None:
        """Hand control over to the first client that requested it, or release control."""
        with self._lock:
            if client == self._leader:
                self._give(min(self._asking, key=self._asking.__getitem__, default=None))

    @property
    def turn(self) -> int:
        """Rises with each change of leader: what was held before then is held no more."""
        with self._lock:
            self._pass_on()
            return self._turn

    @property
    def present(self) -> bool:
        """True if the controlling client was heard from recently enough to move the arm."""
        return self._within(self._silence)

    @property
    def gone(self) -> bool:
        """True if the controlling client has been silent for longer than `timeout`."""
        return not self._within(self._timeout)

    @property
    def lag(self) -> float:
        """Time since the page of the controlling client last responded [s]."""
        with self._lock:
            return 0.0 if self._leader is None else self._lag.get(self._leader, 0.0)

    @property
    def slow(self) -> tuple[float, float]:
        """Silence and lag of the controlling client that slowed it down lately [s]; zero if
        nothing did.
        """
        with self._lock:
            time, silence, lag = self._slow.get(self._leader or "", (-math.inf, 0.0, 0.0))
            return (silence, lag) if self._clock() - time <= _REMEMBERED else (0.0, 0.0)

    @property
    def people(self) -> int:
        """Number of connected clients."""
        with self._lock:
            return len(self._heard)

    def view(self, client: str) -> ControlView:
        """Control state for a client."""
        with self._lock:
            self._pass_on()
            leads = client == self._leader
            return ControlView(
                role="leads" if leads else "watches",
                taken=self._leader is not None,
                asked=bool(self._asking) if leads else client in self._asking,
                may_lead=client in self._able,
            )

    def _within(self, limit: float) -> bool:
        with self._lock:
            heard = self._heard.get(self._leader or "")
            if heard is None:
                return False
            return self._clock() - heard <= limit and self.lag <= self._timeout

    def _give(self, client: str | None) -> None:
        self._leader, self._acted = client, self._clock()
        self._asking.pop(client or "", None)
        self._turn += 1

    def _pass_on(self) -> None:
        """Pass control on to a waiting client if the controlling client is idle or
        unresponsive.
        """
        if self._leader is None or not self._asking:
            return
        first = min(self._asking, key=self._asking.__getitem__)
        if self._clock() - max(self._acted, self._asking[first]) >= self._max_idle:
            self._give(first)
