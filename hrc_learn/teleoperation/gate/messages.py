"""Schemas of all messages that browsers may send, from our own clients and from viser's page.

A message that fits no schema raises `MessageError`. Decoders parse no deeper than the schema.
"""

import math
from functools import partial
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from hrc_learn.protocols import Request

REACH = 10.0
"""Largest accepted coordinate of a point near an arm [m]; the longest arm reaches 3 m."""
_LONGEST_TEXT = 200
_MOST_GRIPS = 4

_Number = Annotated[float, Meta(ge=-1e9, le=1e9)]  # finite
_Coordinate = Annotated[float, Meta(ge=-REACH, le=REACH)]
_Pair = tuple[_Number, _Number]
_Vector = tuple[_Number, _Number, _Number]
Point = tuple[_Coordinate, _Coordinate, _Coordinate]
"""Point near the arm, in the base frame [m]."""
Quaternion = tuple[_Number, _Number, _Number, _Number]
_Time = Annotated[float, Meta(ge=0, le=1e12)]
_Text = Annotated[str, Meta(max_length=_LONGEST_TEXT)]
_Positive = Annotated[float, Meta(gt=0, le=REACH)]


class MessageError(ValueError):
    """A message that our own clients would never send."""


class _Message(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    pass


def _check_unit(orientation: Quaternion) -> None:
    if abs(math.hypot(*orientation) - 1) > 1e-3:  # browsers compute in single precision
        raise ValueError(f"an orientation must be a unit quaternion, but is {orientation}.")


class Beat(_Message, tag="beat"):
    """A sign of life, several times a second."""

    lag: _Time
    """Time since the page last responded to its web worker, which sends these messages [s]."""


class Hello(_Message, tag="hello"):
    """Subscription of a client: status only, or also the moving scene."""

    wants: Literal["status", "scene"]


class Lead(_Message, tag="lead"):
    """Request for control of the arm, or hand-over of control to a waiting client."""

    wish: Literal["ask", "hand_over"]


class Ask(_Message, tag="ask"):
    """Request such as start, stop or save."""

    request: Request


class Task(_Message, tag="task"):
    """Description of the task."""

    task: _Text


class Gripper(_Message, tag="gripper"):
    """Request to open or close the gripper."""

    # The widest of our parallel grippers opens by 0.14 m.
    width: Annotated[float, Meta(ge=0, le=0.3)]
    """Requested opening [m]."""


class Region(_Message, tag="region"):
    """Drawn box; an active box attracts the end effector."""

    centre: Point
    half_size: tuple[_Positive, _Positive, _Positive]
    active: bool


class Target(_Message, tag="target"):
    """Marked point; None: no target."""

    point: Point | None


class Grip(_Message):
    """Link or end effector held by one hand."""

    hand: Literal["left", "right", "touch"]
    joint: Annotated[int, Meta(ge=1, le=100)] | None
    """Joint that moves the held link, counted from 1; None: the end effector is held."""
    start: Point
    """Point at which the hand took hold, in the base frame [m]."""
    pointer: Point
    """Position of the hand, in the base frame [m]."""
    orientation: Quaternion | None = None
    """Rotation of the hand since it took hold (wxyz, base frame); None: no rotation is
    commanded.
    """

    def __post_init__(self) -> None:
        if self.orientation is not None:
            _check_unit(self.orientation)


class TrackedHand(_Message):
    """Tracked pose of a hand, which may hold something or not."""

    hand: Literal["left", "right"]
    position: Point
    """Point between thumb and index finger, or of the controller, in the base frame [m]."""
    orientation: Quaternion
    """Orientation of the hand's grip (wxyz, base frame)."""

    def __post_init__(self) -> None:
        _check_unit(self.orientation)


class Hands(_Message, tag="hands"):
    """Everything that is held now; whatever is not listed is released."""

    grips: Annotated[tuple[Grip, ...], Meta(max_length=_MOST_GRIPS)]
    tracked: Annotated[tuple[TrackedHand, ...], Meta(max_length=2)] = ()
    """Hands that are seen now."""
    sent: _Time = 0.0
    """Time by the client's clock, returned with the status to measure the round-trip time."""

    def __post_init__(self) -> None:
        for hands in (self.grips, self.tracked):
            if len({one.hand for one in hands}) < len(hands):
                raise ValueError("each hand may be listed only once.")


Message = Beat | Hello | Lead | Ask | Task | Gripper | Region | Target | Hands


class Decide(_Message, tag="decide"):
    """Decision on an episode of a dataset."""

    episode: int
    verdict: Literal["accept", "cut", "reject"] | None
    """None withdraws an earlier decision."""
    start: int = 0
    """First frame of the part that is kept."""
    stop: int = 0
    """Frame after the last frame that is kept."""


class Write(_Message, tag="write"):
    """Request to write the cleaned dataset."""


CurationMessage = Decide | Write


# Messages of viser's page, with viser's own names and fields. If a later version of viser adds
# a field, messages with it are refused until the field is listed here, and browser tests fail.


class _Camera(_Message, tag="ViewerCameraMessage"):
    wxyz: Quaternion
    position: _Vector
    fov: _Number
    near: _Number
    far: _Number
    image_height: int
    image_width: int
    look_at: _Vector
    up_direction: _Vector

    def __post_init__(self) -> None:
        _check_unit(self.wxyz)


class _StoredItem(_Message, tag="LocalStorageGetItemResponseMessage"):
    request_uuid: str
    value: str | None
    error: str | None


class GuiUpdate(_Message, tag="GuiUpdateMessage"):
    """Change of a control of the panel by a person."""

    uuid: str
    updates: dict[str, bool | _Number | str]


class _Drag(_Message, tag="SceneNodeDragMessage"):
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


class _Pointer(_Message, tag="ScenePointerMessage"):
    event_type: Literal["click", "rect-select"]
    ray_origin: _Vector | None
    ray_direction: _Vector | None
    screen_pos: Annotated[tuple[_Pair, ...], Meta(max_length=2)]
    modifier: str | None = None


class _Turned(_Message, tag="TransformControlsUpdateMessage"):
    name: str
    wxyz: Quaternion
    position: Point
    owner: str = ""

    def __post_init__(self) -> None:
        _check_unit(self.wxyz)


class _TurnStart(_Message, tag="TransformControlsDragStartMessage"):
    name: str
    owner: str = ""


class _TurnEnd(_TurnStart, tag="TransformControlsDragEndMessage"):
    pass


class _Command(_Message, tag="CommandTriggerMessage"):
    uuid: str


_Watching = _Camera | _StoredItem
ViewMessage = (
    _Watching | GuiUpdate | _Drag | _Pointer | _Turned | _TurnStart | _TurnEnd | _Command
)
"""A message of viser's page; see `acts`."""


def acts(message: Any) -> bool:
    """True if a message of viser's page acts on the arm or the session."""
    return not isinstance(message, _Watching)


def _decoded(decoder: Any, raw: str | bytes) -> Any:
    """Decode a message of a client.

    Raises:
        MessageError: The message fits no schema.
    """
    try:
        return decoder.decode(raw)
    # TypeError: text where viser's page sends bytes.
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, TypeError) as error:
        words = " ".join(str(error).split())  # the error may quote line breaks of the client
        raise MessageError(f"not a message of this page: {words}") from error


session_message = partial(_decoded, msgspec.json.Decoder(Message))
"""Decodes a message of our own clients, in JSON."""
curation_message = partial(_decoded, msgspec.json.Decoder(CurationMessage))
"""Decodes a message of the curation page, in JSON."""
view_message = partial(_decoded, msgspec.msgpack.Decoder(ViewMessage))
"""Decodes a message of viser's page, in MessagePack."""
