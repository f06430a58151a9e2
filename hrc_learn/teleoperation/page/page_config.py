"""Settings of the page, and what it is told to show."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from hrc_learn.protocols import DrawnRegion
from hrc_learn.teleoperation.interaction_force import InteractionForceConfig


@dataclass(frozen=True, kw_only=True)
class PageConfig:
    """The page's own settings."""

    host: str = "127.0.0.1"
    """Address to serve at. Whoever reaches it can move the arm."""
    port: int = 8080
    """Port to serve at; the next free one is taken if it is in use."""
    forces: InteractionForceConfig = field(default_factory=InteractionForceConfig)
    """How strongly gizmos act."""
    timeout: float = 0.6
    """Time without a sign of life from a browser after which its grips are let go [s]."""
    refresh: float = 25.0
    """Times a second that the page follows the arm, and efforts are computed anew [1/s]."""
    twin: tuple[float, float, float] = (-0.1, 1.3, 0.0)
    """Where the virtual twin stands, from the arm [m]."""

    def __post_init__(self) -> None:
        for name in ("timeout", "refresh"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, but is {getattr(self, name)}.")


FIRST_REGION = DrawnRegion(centre=(0.35, 0.45, 0.22), half_size=(0.14, 0.14, 0.10))
"""Where the region is before anybody has drawn one."""


@dataclass(frozen=True, kw_only=True)
class PageStatus:
    """What the session lets the page show."""

    title: str = ""
    """What is guided here."""
    doing: str = ""
    """What an arm that works by itself is doing; empty where a person leads and records."""
    recording: Literal["ready", "recording", "stopped"] = "ready"
    """Stopped: a demonstration waits to be saved or discarded."""
    seconds: float = 0.0
    """Length of the demonstration in hand, or how long the arm has been at work [s]."""
    saved: int = 0
    """Demonstrations saved."""
    note: str = ""
    """What became of the last request."""
    interventions: Mapping[str, int] = field(default_factory=dict)
    """Steps in which each kind of intervention of the safety filter was needed."""
    contacts: int = 0
    """Touches of the surroundings."""
