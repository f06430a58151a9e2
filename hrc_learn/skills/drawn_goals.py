"""Goals from a person's drawing: a region or a target for the end effector, and a turn.

The paper's expert draws the Cartesian region in the AR interface and adjusts the coarse
orientation (section VII), here called the turn. As in the paper (equation CaFun), the region is
a box, given by the walls that the person drew.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.controller import Goals
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.geometry.numerics import check_positive
from hrc_learn.protocols import DrawnRegion, HumanInput
from hrc_learn.regions import PositionRegion


@dataclass(frozen=True, kw_only=True)
class DrawnGoalsConfig:
    """Effect of a person's drawing on the goals."""

    rate: float = 4.0
    """Rate at which the end effector returns into a region [1/s], equal to the rate of the
    planned box. Arms with a delay of 30 ms return without overshoot."""
    target_half_size: float = 0.003
    """Half edge of the box around a drawn target [m], equal to the half height of the planned
    box."""
    wall: float = 0.02
    """Depth inside the walls of a region over which vision feedback fades in [m]: the distance
    that the arm covers at its full speed of 0.25 m/s during the 80 ms delay of images and
    servos."""
    largest_turn: float = 0.5
    """Largest turn relative to the planned orientation [rad]. The marker on the end effector is
    detected up to about twice this tilt."""
    settling: float = 0.15
    """A changed drawing is applied after this time without further changes [s]: a dragged
    pointer changes the drawing 25 times a second, and each applied change has to be checked."""

    __post_init__ = check_positive


class Drawing(NamedTuple):
    """Region and target of the end effector drawn by a person."""

    region: DrawnRegion | None
    target: tuple[float, float, float] | None

    def __bool__(self) -> bool:
        return self.region is not None or self.target is not None

    @property
    def words(self) -> str:
        """Name of the drawing, for messages."""
        if self.target is None:
            return "the drawn region"
        return "the target" if self.region is None else "the target in the drawn region"


_NOTHING = Drawing(None, None)
# Avoids a division by zero [rad].
_TINY_TURN = 1e-9


def drawn_position(
    drawing: Drawing, planned: PositionRegion, config: DrawnGoalsConfig
) -> PositionRegion:
    """Position region of the controller for a drawing.

    The region's vertical walls are those of the drawn box, moved inwards by the margin over
    which vision feedback fades. The image shows little about height, so the region stays as
    flat as planned. The height of the region is the planned height, or the nearest height in
    the drawn box. For a target, the region is a small box around the target, within the drawn
    box.

    Args:
        drawing: Drawn region, target or both.
        planned: Region without a drawing.
        config: Rate and sizes.
    """
    centre, half_size = planned.centre, planned.half_size
    box = drawing.region
    if box is None:
        low, high = torch.full_like(centre, -math.inf), torch.full_like(centre, math.inf)
    else:
        middle, half = centre.new_tensor(box.centre), centre.new_tensor(box.half_size)
        low, high = middle - half, middle + half
        flat = torch.minimum(half_size[2], half[2])
        height = centre[2].clamp(low[2] + flat, high[2] - flat)
        centre = torch.cat([middle[:2], height[None]])
        half_size = torch.cat([half[:2] - _margin(half, config), flat[None]])
    if drawing.target is not None:
        half_size = ((high - low) / 2).clamp(max=config.target_half_size)
        target = centre.new_tensor(drawing.target)
        centre = target.clamp(low + half_size, high - half_size)
    x, y, z = (config.rate / 4 * half_size.square()).tolist()
    return PositionRegion(
        centre=centre, half_size=half_size, stiffness=(x, y, z), formulation="saturated"
    )


def vision_scale(
    box: DrawnRegion, position: Float[Tensor, "3"], config: DrawnGoalsConfig
) -> float:
    """Scale of vision feedback, 0 to 1; it is zero at the vertical walls of a box and outside.

    Therefore a visual target outside the box cannot pull the end effector out of the box.

    Args:
        box: Drawn box.
        position: Position of the end effector [m].
        config: Settings; `wall` is the depth inside the walls at which the scale reaches 1.
    """
    middle, half = position.new_tensor(box.centre), position.new_tensor(box.half_size)
    behind = half[:2] - (position - middle)[:2].abs()
    return float((behind / _margin(half, config)).clamp(0, 1).min())


def _margin(half_size: Float[Tensor, "3"], config: DrawnGoalsConfig) -> Float[Tensor, "2"]:
    """Margin between the vertical walls of a drawn box and of the controller's region [m]."""
    # In a narrow box, the margin is half of the half edge.
    return (half_size[:2] / 2).clamp(max=config.wall)


@dataclass(frozen=True, kw_only=True, eq=False)
class DrawnGoalsState:
    """State of a person's drawing and turn."""

    turn: Float[Tensor, "4"]
    """Rotation that the person has added to the planned orientation (w, x, y, z)."""
    drawing: Drawing = _NOTHING
    """Newest drawing."""
    active: Drawing = _NOTHING
    """Drawing that replaces the planned region; empty: the planned region is used."""
    away: bool = False
    """True if the active drawing is away from the planned region, so that the task waits."""
    changed: float = -math.inf
    """Time of the last change of the drawing [s]."""
    checked: bool = True
    """True once the newest drawing has been checked."""


class DrawnGoals:
    """Applies the turn and the drawing of a person; a drawing only if the arm can go there."""

    def __init__(
        self, config: DrawnGoalsConfig, refusal: Callable[[Pose], str] = lambda pose: ""
    ):
        """Set the effect of drawings, and the function that checks them.

        Args:
            config: Effect of drawings.
            refusal: Function that returns the reason why the arm cannot go to a pose, or an
                empty text if it can.
        """
        self._config, self._refusal = config, refusal

    def initial_state(self) -> DrawnGoalsState:
        """State without a drawing or a turn."""
        return DrawnGoalsState(turn=torch.tensor([1.0, 0, 0, 0], dtype=torch.float64))

    def restarted(self, state: DrawnGoalsState) -> DrawnGoalsState:
        """State for another target: the turn is kept, and the drawing is checked again."""
        return DrawnGoalsState(turn=state.turn)

    def read(
        self, state: DrawnGoalsState, human: HumanInput, planned: Goals, time: float
    ) -> tuple[DrawnGoalsState, str]:
        """Process the drawing of a person.

        Args:
            state: State after the last step.
            human: Input of the person.
            planned: Goals without the drawing.
            time: Present time [s].

        Returns:
            The next state, and a message to the person; empty: no message.
        """
        drawing = Drawing(human.region, human.target)
        waited = time - state.changed >= self._config.settling
        if drawing != state.drawing:
            # The first of several changes, and the removal of a drawing, are applied
            # immediately.
            state = replace(state, drawing=drawing, changed=time, checked=False)
            if waited or not drawing:
                return self._checked(state, planned)
        elif not state.checked and waited:
            return self._checked(state, planned)
        return state, ""

    def applied(
        self, state: DrawnGoalsState, planned: Goals, position: Float[Tensor, "3"]
    ) -> tuple[Goals, DrawnGoalsState]:
        """The goals with the active drawing in place of the planned region.

        Vision feedback acts within a drawn region (`vision_scale`), but not if a target was
        drawn. If the drawing is away from the planned region, there is no joint-space approach,
        since it would end in the planned region.

        Args:
            state: State after `read`.
            planned: Goals without the person.
            position: Position of the end effector [m].
        """
        if not state.active:
            return planned, replace(state, away=False)
        box, target = state.active
        region = drawn_position(state.active, planned.position, self._config)
        goals = replace(planned, position=region)
        outside = (planned.position.centre - region.centre).abs() > region.half_size
        away = target is not None or bool(outside.any())
        if away:
            goals = goals.approached_by(None)
        if target is not None or box is None:
            goals = goals.with_vision(False)
        else:
            scale = vision_scale(box, position, self._config)
            vision = replace(planned.vision, stiffness=scale * planned.vision.stiffness)
            goals = replace(goals, vision=vision)
        return goals, replace(state, away=away)

    def turned(
        self, state: DrawnGoalsState, requested: tuple[float, float, float] | None, most: float
    ) -> DrawnGoalsState:
        """State with the turn moved towards a requested rotation, within the largest turn.

        Args:
            state: State after the last step.
            requested: Rotation vector [rad]; None: no rotation.
            most: Largest angle of this step [rad].
        """
        vector = state.turn.new_tensor(requested or (0.0, 0.0, 0.0))
        length = float(vector.norm())
        fraction = min(1.0, self._config.largest_turn / max(length, _TINY_TURN))
        wanted = quaternion.exp(fraction * vector)
        missing = float(quaternion.angle(state.turn, wanted))
        if missing == 0:
            return state
        turn = quaternion.slerp(state.turn, wanted, min(1.0, most / missing))
        return replace(state, turn=turn)

    def _checked(self, state: DrawnGoalsState, planned: Goals) -> tuple[DrawnGoalsState, str]:
        """State with the newest drawing active if the arm can go there, and a message."""
        drawing, before = state.drawing, state.active
        state = replace(state, checked=True, active=drawing)
        if not drawing:
            return state, "The plan guides the end effector again." if before else ""
        middle = drawn_position(drawing, planned.position, self._config).centre
        assert planned.orientation is not None  # servoing to an object controls the whole pose
        reason = self._refusal(Pose(middle, planned.orientation.goal))
        words = drawing.words
        if reason:
            return replace(state, active=_NOTHING), f"Refused {words}: {reason}."
        _, state = self.applied(state, planned, middle)
        waits = "; the task waits" if state.away else ""
        return state, f"{words[0].upper()}{words[1:]} guides the end effector{waits}."
