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
    speed, 0.25 m/s, in the time that images are late."""
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

    A region has the walls of the box that was drawn, but for its height: the image tells little
    about that, so the box stays as flat as planned, at the planned height or the nearest to it
    within the region. A target has a small box of its own, within the region.

    Args:
        drawing: Of a region, a target or both.
        planned: Region without the person.
        config: Rate and size.
    """
    low, high = (
        planned.centre.new_full((3,), -torch.inf),
        planned.centre.new_full((3,), torch.inf),
    )
    half_size, centre = planned.half_size, planned.centre
    if (box := drawing.region) is not None:
        middle, half = centre.new_tensor(box.centre), centre.new_tensor(box.half_size)
        low, high = middle - half, middle + half
        flat = torch.minimum(half_size[2], half[2])
        height = centre[2].clamp(low[2] + flat, high[2] - flat)
        centre = torch.cat([middle[:2], height[None]])
        half_size = torch.cat([half[:2], flat[None]])
    if drawing.target is not None:
        centre = centre.new_tensor(drawing.target)
        half_size = torch.minimum(
            torch.full_like(centre, config.target_half_size), (high - low) / 2
        )
        centre = centre.clamp(low + half_size, high - half_size)
    x, y, z = (config.rate / 4 * half_size.square()).tolist()
    return PositionRegion(
        centre=centre, half_size=half_size, stiffness=(x, y, z), formulation="saturated"
    )


def depth_behind_walls(
    region: PositionRegion, position: Float[Tensor, "3"], wall: float
) -> float:
    """How deep a position lies within the upright walls of a region, 0 at a wall or outside.

    Args:
        region: Along the base axes.
        position: Of the end effector [m].
        wall: Depth that counts as 1 [m].
    """
    behind = region.half_size[:2] - (position - region.centre)[:2].abs()
    # In a box that is narrower than two walls the middle counts as deep.
    return float((behind / torch.clamp(region.half_size[:2], max=wall)).clamp(0, 1).min())


class DrawnGoals:
    """Takes over what a person draws, where the arm can go there, and keeps what they turned.

    Attributes:
        leads: What leads the end effector now; empty where the plan does.
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
        self._seen = self.leads = _NOTHING
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

        Within a region the camera takes part the more, the deeper the end effector is in it;
        to a target the person leads without it.

        Args:
            planned: Goals without the person.
            position: Of the end effector [m].
        """
        if not self.leads:
            return planned
        region = drawn_position(self.leads, planned.position, self._config)
        goals = replace(planned, position=region, posture=None)
        if self.leads.target is not None:
            return goals.with_vision(False)
        depth = depth_behind_walls(region, position, self._config.wall)
        vision = replace(planned.vision, stiffness=depth * planned.vision.stiffness)
        return replace(goals, vision=vision)

    def _take(self, planned: Goals) -> None:
        self._checked, before = True, self.leads
        self.leads = self._seen
        if not self._seen:
            if before:
                self._tell("The plan leads again.")
            return
        where = drawn_position(self._seen, planned.position, self._config).centre
        why = self._refusal(Pose(where, planned.orientation.goal))
        if why:
            self.leads = _NOTHING
            self._tell(f"Refused {self._seen.words}: {why}.")
        else:
            words = self._seen.words
            self._tell(f"{words[0].upper()}{words[1:]} leads the end effector.")

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
