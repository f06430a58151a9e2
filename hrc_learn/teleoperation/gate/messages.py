"""Schemas of the messages that browsers may send: those of our own clients, and of viser's
page.

A message that fits no schema raises `MessageError` and is dropped.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from hrc_learn.protocols import Request

REACH = 10.0
"""Largest accepted coordinate of a point near an arm [m]; the longest arm reaches 3 m."""
_LONGEST_TEXT = 200
_MOST_GRIPS = 4

Point = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class MessageError(ValueError):
    """A message that no client of ours sends."""


def _near(*points: Point | None) -> None:
    for point in points:
        if point is not None and max(map(abs, point)) > REACH:
            raise ValueError(f"a point must lie within {REACH} m of the arm, but is {point}.")


def _unit(orientation: Quaternion) -> None:
    if abs(math.hypot(*orientation) - 1) > 1e-3:  # browsers compute in single precision
        raise ValueError(f"an orientation must be a unit quaternion, but is {orientation}.")


@dataclass(frozen=True, kw_only=True)
class Beat:
    """A sign of life, several times a second."""

    lag: float
    """Time since the page last responded [s]."""
    echo: float | None = None
    """Last server time that the client received, returned at once to measure the round trip."""

    def __post_init__(self) -> None:
        if self.lag < 0:
            raise ValueError(f"lag must not be negative, but is {self.lag}.")


@dataclass(frozen=True, kw_only=True)
class Hello:
    """Subscription of a client: status only, or also the moving scene."""

    wants: Literal["status", "scene"]


@dataclass(frozen=True, kw_only=True)
class Lead:
    """Request for control, or hand-over."""

    wish: Literal["ask", "hand_over"]


@dataclass(frozen=True, kw_only=True)
class Ask:
    """Start, stop, save, ..."""

    request: Request


@dataclass(frozen=True, kw_only=True)
class Task:
    """Description of the task."""

    task: str

    def __post_init__(self) -> None:
        if len(self.task) > _LONGEST_TEXT:
            raise ValueError(f"a task has {_LONGEST_TEXT} characters at most.")


@dataclass(frozen=True, kw_only=True)
class Gripper:
    """Open or close."""

    width: float
    """[m]"""

    def __post_init__(self) -> None:
        if not 0 <= self.width <= 0.3:  # the widest parallel gripper of ours opens by 0.14 m
            raise ValueError(f"width must be 0 to 0.3 m, but is {self.width}.")


@dataclass(frozen=True, kw_only=True)
class Region:
    """The box drawn."""

    centre: Point
    half_size: Point
    active: bool

    def __post_init__(self) -> None:
        _near(self.centre, self.half_size)
        if min(self.half_size) <= 0:
            raise ValueError(f"half_size must be positive, but is {self.half_size}.")


@dataclass(frozen=True, kw_only=True)
class Target:
    """The point marked; None: none is."""

    point: Point | None

    def __post_init__(self) -> None:
        _near(self.point)


@dataclass(frozen=True, kw_only=True)
class Grip:
    """Link or end effector held by one hand."""

    hand: Literal["left", "right", "touch"]
    joint: int | None
    """That moves the link held, counted from 1; None: the end effector."""
    start: Point
    """Point at which the hand took hold, in the base frame [m]."""
    pointer: Point
    """Position of the hand, in the base frame [m]."""
    orientation: Quaternion | None = None
    """Rotation of the hand since it took hold (wxyz, base frame); None: no rotation is
    commanded.
    """

    def __post_init__(self) -> None:
        _near(self.start, self.pointer)
        if self.joint is not None and self.joint < 1:
            raise ValueError(f"joints count from 1, but joint is {self.joint}.")
        if self.orientation is not None:
            _unit(self.orientation)


@dataclass(frozen=True, kw_only=True)
class TrackedHand:
    """Tracked pose of a hand, holding an object or not."""

    hand: Literal["left", "right"]
    position: Point
    """Between thumb and index finger, or of the controller, in the base frame [m]."""
    orientation: Quaternion
    """Orientation of the hand's grip (wxyz, base frame)."""

    def __post_init__(self) -> None:
        _near(self.position)
        _unit(self.orientation)


@dataclass(frozen=True, kw_only=True)
class Hands:
    """All that is held now: what is not named is let go."""

    grips: tuple[Grip, ...]
    tracked: tuple[TrackedHand, ...] = ()
    """Hands that are seen now."""
    sent: float = 0.0
    """Clock of the client, returned with the status: to measure the round trip."""

    def __post_init__(self) -> None:
        if len(self.grips) > _MOST_GRIPS:
            raise ValueError(f"{_MOST_GRIPS} hands at most.")
        if len({grip.hand for grip in self.grips}) < len(self.grips):
            raise ValueError("a hand holds one thing.")
        if len({seen.hand for seen in self.tracked}) < len(self.tracked):
            raise ValueError("a hand is in one place.")


Message = Beat | Hello | Lead | Ask | Task | Gripper | Region | Target | Hands
_MESSAGES = {
    kind.__name__.lower(): kind
    for kind in (Beat, Hello, Lead, Ask, Task, Gripper, Region, Target, Hands)
}


def session_message(raw: str | bytes) -> Message:
    """A message of our own clients, in JSON.

    Raises:
        MessageError: It fits no schema.
    """
    import msgspec

    try:
        content = msgspec.json.decode(raw)
        _check_finite(content)
        return msgspec.convert(content, _MESSAGES[content.pop("type")])
    except (msgspec.MsgspecError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise MessageError(f"no message of ours: {error}") from error


def _check_finite(content: Any, depth: int = 0) -> None:
    if isinstance(content, float) and not math.isfinite(content):
        raise ValueError("numbers must be finite")
    if depth > 8:  # the deepest of ours has 5
        raise ValueError("too deep")
    if isinstance(content, Mapping):
        content = [*content.values()]
    if isinstance(content, list | tuple):
        for part in content:
            _check_finite(part, depth + 1)


# Of viser's page. Names and fields are those of its own messages: what it adds in a later
# version is refused until it is listed here, which tests in a browser show.

_Pair = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class _Camera:
    wxyz: Quaternion
    position: Point
    fov: float
    near: float
    far: float
    image_height: int
    image_width: int
    look_at: Point
    up_direction: Point

    def __post_init__(self) -> None:
        _unit(self.wxyz)


@dataclass(frozen=True, kw_only=True)
class _StoredItem:
    request_uuid: str
    value: str | None
    error: str | None


@dataclass(frozen=True, kw_only=True)
class GuiUpdate:
    """A control of the panel that has been used."""

    uuid: str
    updates: dict[str, bool | float | str]


@dataclass(frozen=True, kw_only=True)
class _Drag:
    phase: Literal["start", "update", "end"]
    name: str
    start_position: Point
    start_screen_pos: _Pair
    end_position: Point
    end_screen_pos: _Pair
    instance_index: int | None = None
    button: Literal["left", "middle", "right"] = "left"
    modifier: str | None = None
    owner: str = ""

    def __post_init__(self) -> None:
        _near(self.start_position, self.end_position)


@dataclass(frozen=True, kw_only=True)
class _Pointer:
    event_type: Literal["click", "rect-select"]
    ray_origin: Point | None
    ray_direction: Point | None
    screen_pos: tuple[_Pair, ...]
    modifier: str | None = None


@dataclass(frozen=True, kw_only=True)
class _Turned:
    name: str
    wxyz: Quaternion
    position: Point
    owner: str = ""

    def __post_init__(self) -> None:
        _unit(self.wxyz)
        _near(self.position)


@dataclass(frozen=True, kw_only=True)
class _Named:
    name: str
    owner: str = ""


@dataclass(frozen=True, kw_only=True)
class _Command:
    uuid: str


_WATCHING: dict[str, type] = {
    "ViewerCameraMessage": _Camera,
    "LocalStorageGetItemResponseMessage": _StoredItem,
}
_LEADING: dict[str, type] = {
    "GuiUpdateMessage": GuiUpdate,
    "SceneNodeDragMessage": _Drag,
    "ScenePointerMessage": _Pointer,
    "TransformControlsUpdateMessage": _Turned,
    "TransformControlsDragStartMessage": _Named,
    "TransformControlsDragEndMessage": _Named,
    "CommandTriggerMessage": _Command,
}


@dataclass(frozen=True, kw_only=True)
class ViewMessage:
    """A message of viser's page that fits its schema."""

    content: Any
    acts: bool
    """True if the message acts on the arm or the session."""


def view_message(raw: str | bytes) -> ViewMessage:
    """A message of viser's page, in MessagePack.

    Raises:
        MessageError: It is none that the page needs, or does not fit its schema.
    """
    import msgspec

    try:
        if isinstance(raw, str):
            raise ValueError("viser's messages are binary")
        content = msgspec.msgpack.decode(raw)
        _check_finite(content)
        name = content.pop("type")
        acts = name in _LEADING
        schema = (_LEADING if acts else _WATCHING)[name]
        return ViewMessage(content=msgspec.convert(content, schema), acts=acts)
    except (msgspec.MsgspecError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise MessageError(f"no message of the page: {error}") from error
