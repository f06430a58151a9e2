"""What a person draws beside an arm that servoes, as goals of its controller.

The paper's expert draws the Cartesian region by the AR interface and adjusts the coarse
orientation (section VII). The region is a box there (CaFun), and so it is here: the box drawn
is the region, wall by wall.
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
from hrc_learn.protocols import DrawnRegion, HumanInput
from hrc_learn.regions import PositionRegion


@dataclass(frozen=True, kw_only=True)
class DrawnGoalsConfig:
    """How a person's drawing acts on the goals."""

    rate: float = 4.0
    """How fast the end effector returns over the walls of a region [1/s]; that of the planned
    box. Arms that are 30 ms late follow it without overshoot."""
    target_half_size: float = 0.003
    """Half edges of the box round a marked target [m]: the flatness of the planned box."""
    wall: float = 0.02
    """Depth behind the walls of a region over which the camera takes over [m]: the way at full
    speed, 0.25 m/s, within 80 ms, by which images and servos are late."""
    largest_turn: float = 0.5
    """Turn on top of the planned orientation, at most [rad]. The marker on the end effector
    is found in images up to about twice that tilt."""
    settling: float = 0.15
    """How long a drawing that keeps changing must be still before it leads [s]: a pointer that
    is dragged brings another one 25 times a second, each of which would have to be checked."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"{name} must be positive, but is {value}.")


class Drawing(NamedTuple):
    """Where a person wants the end effector."""

    region: DrawnRegion | None
    target: tuple[float, float, float] | None

    def __bool__(self) -> bool:
        return self.region is not None or self.target is not None

    @property
    def words(self) -> str:
        """What leads the end effector."""
        if self.target is None:
            return "the region drawn"
        return "the target" if self.region is None else "the target in the region drawn"


_NOTHING = Drawing(None, None)
# Only keeps a division by zero out [rad].
_TINY_TURN = 1e-9


def drawn_position(
    drawing: Drawing, planned: PositionRegion, config: DrawnGoalsConfig
) -> PositionRegion:
    """The region of the controller's position that a drawing asks for.

    A region has the upright walls of the box that was drawn, less a margin over which the
    camera loses its share. The image tells little about height: so the box stays as flat as
    planned, at the planned height or the nearest to it within the region. A target has a small
    box of its own, within the region.

    Args:
        drawing: Of a region, a target or both.
        planned: Region without the person.
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


def camera_share(
    box: DrawnRegion, position: Float[Tensor, "3"], config: DrawnGoalsConfig
) -> float:
    """How much the camera takes part: not at all from the upright walls of a box on outwards.

    So what it sees beyond them does not draw the end effector out of the box.

    Args:
        box: As it was drawn.
        position: Of the end effector [m].
        config: Depth behind the walls from which on the camera has its full share.
    """
    middle, half = position.new_tensor(box.centre), position.new_tensor(box.half_size)
    behind = half[:2] - (position - middle)[:2].abs()
    return float((behind / _margin(half, config)).clamp(0, 1).min())


def _margin(half_size: Float[Tensor, "3"], config: DrawnGoalsConfig) -> Float[Tensor, "2"]:
    """Between the upright walls of a box and of the controller's region in it [m]."""
    # Half of a narrow box is left.
    return (half_size[:2] / 2).clamp(max=config.wall)


def _within(planned: PositionRegion, region: PositionRegion) -> bool:
    """Whether the middle of the planned region is in another one."""
    away = (planned.centre - region.centre).abs()
    return bool((away <= region.half_size).all())


class DrawnGoals:
    """Takes over what a person draws, where the arm can go there, and keeps what they turned.

    Attributes:
        leads: What leads the end effector now; empty where the plan does.
        away: Whether that leads away from the planned region, so that the task waits.
        turn: Rotation that the person has added to the planned orientation (wxyz).
    """

    def __init__(
        self,
        config: DrawnGoalsConfig,
        refusal: Callable[[Pose], str] = lambda pose: "",
        tell: Callable[[str], None] = lambda words: None,
    ):
        """Begin with nothing drawn.

        Args:
            config: How drawings act.
            refusal: Why the arm cannot go to a pose; empty if it can.
            tell: Told what happens, in words for the person.
        """
        self._config, self._refusal, self._tell = config, refusal, tell
        self.leads: Drawing
        self.restart()
        self.turn: Float[Tensor, "4"] = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)

    def restart(self) -> None:
        """Look anew at what is drawn: the arm begins to servo, maybe elsewhere."""
        self._seen, self.leads, self.away = _NOTHING, _NOTHING, False
        self._changed, self._checked = -math.inf, True

    def read(self, asked: HumanInput, planned: Goals, time: float) -> None:
        """Take in what a person has drawn.

        Args:
            asked: By the person.
            planned: Goals without the drawing.
            time: Now [s].
        """
        drawing = Drawing(asked.region, asked.target)
        if drawing != self._seen:
            # The first of several changes leads at once, as does switching off.
            still = time - self._changed >= self._config.settling
            self._seen, self._changed, self._checked = drawing, time, False
            if still or not drawing:
                self._take(planned)
        elif not self._checked and time - self._changed >= self._config.settling:
            self._take(planned)

    def applied(self, planned: Goals, position: Float[Tensor, "3"]) -> Goals:
        """The goals with what leads in the place of the planned region.

        Within a region the camera takes part (`camera_share`); to a target the person leads
        without it. A joint-space approach that ends elsewhere is left out.

        Args:
            planned: Goals without the person.
            position: Of the end effector [m].
        """
        self.away = False
        if not self.leads:
            return planned
        box, target = self.leads
        region = drawn_position(self.leads, planned.position, self._config)
        goals = replace(planned, position=region)
        self.away = target is not None or not _within(planned.position, region)
        if self.away:
            goals = goals.approached_by(None)
        if target is not None or box is None:
            return goals.with_vision(False)
        share = camera_share(box, position, self._config)
        vision = replace(planned.vision, stiffness=share * planned.vision.stiffness)
        return replace(goals, vision=vision)

    def _take(self, planned: Goals) -> None:
        self._checked, before = True, self.leads
        self.leads = self._seen
        if not self._seen:
            if before:
                self._tell("The plan leads again.")
            return
        where = drawn_position(self._seen, planned.position, self._config).centre
        assert planned.orientation is not None  # servoing to an object leads all of a pose
        why = self._refusal(Pose(where, planned.orientation.goal))
        if why:
            self.leads = _NOTHING
            self._tell(f"Refused {self._seen.words}: {why}.")
        else:
            self.applied(planned, where)
            words, waits = self._seen.words, "; the task waits" if self.away else ""
            self._tell(f"{words[0].upper()}{words[1:]} leads the end effector{waits}.")

    def turn_on(self, asked: tuple[float, float, float] | None, most: float) -> None:
        """Turn a little further towards what a person asks for, within the largest turn.

        Args:
            asked: Rotation vector [rad]; None: none.
            most: By how much [rad].
        """
        vector = self.turn.new_tensor(asked or (0.0, 0.0, 0.0))
        length = float(vector.norm())
        share = min(1.0, self._config.largest_turn / max(length, _TINY_TURN))
        wanted = quaternion.exp(share * vector)
        missing = float(quaternion.angle(self.turn, wanted))
        if missing > 0:
            self.turn = quaternion.slerp(self.turn, wanted, min(1.0, most / missing))
