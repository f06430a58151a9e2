"""How the forcing term scales with start and goal, as a part by name.

- `"none"`: not at all. Weights are accelerations; a moved goal shifts the motion smoothly.
  Defined for every start and goal, hence the default.
- `"paper"`: by g - y_0, as the paper prints it. The motion grows with the distance to the
  goal; undefined for g = y_0 and mirrored when the goal lies on the other side.
- `"amplitude"`: by the range each coordinate covers in the demonstration. Weights are
  dimensionless, so a scaled demonstration has the same ones; survives g = y_0.
- `"rotation"`: turned and dilated with the way from start to goal, for positions in space; see
  `RotationScaling`.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, ClassVar

import torch
from torch import Tensor

from hrc_learn.dmp._arguments import demo_label

MINIMUM_WAY = 1e-3
"""Smallest |g - y_0|, as a share of the range covered, that can be divided by: weights would be
a thousand times the forces they stand for."""
HALF_TURN = 1e-3
"""How close to half a turn [rad] the way may turn before it is taken for one."""
NO_WAY = 1e-24
"""Square of the share of the demonstrated way below which a way has no direction: 1e-12 of it,
where start and goal agree to rounding."""


@dataclass(frozen=True, eq=False)
class Demonstrated:
    """What a demonstration gives a scaling to go by: (*batch, D) each, tensors or arrays."""

    start: Any
    goal: Any
    amplitude: Any
    """Range covered by each coordinate."""

    def leading(self, columns: int | None) -> "Demonstrated":
        """The same of the first coordinates; None: of all."""
        return Demonstrated(**{k: values[..., :columns] for k, values in vars(self).items()})


@dataclass(frozen=True, kw_only=True)
class Scaling(ABC):
    """A linear map of the forcing term, made from start and goal.

    It takes tensors, or arrays with `xp=numpy`, so that all of fitting, rollouts, steps and
    the `Stepper` share one definition.
    """

    columns: int | None = None
    """How many of the coordinates it is for, the first ones; None: all."""
    name: ClassVar[str]
    follows_ends: ClassVar[bool] = False
    """Whether a new start or goal changes it; a motion is not linear in them then."""
    turns: ClassVar[bool] = False
    """Whether the motion turns with its way: weights are in the demonstration's own frame, and
    its start velocity is scaled along."""

    def scale(
        self,
        values: Any,
        start: Any,
        goal: Any,
        reference: Demonstrated,
        xp: ModuleType = torch,
    ) -> Any:
        """Scale weights, forces or what they cause.

        Args:
            values: (*batch, K, D).
            start: y_0 of the motion, (*batch, D).
            goal: g of the motion, (*batch, D).
            reference: The demonstration.
            xp: `torch` for tensors, `numpy` for arrays.
        """
        k = self.columns
        if k is None:
            return self._scale(values, start, goal, reference, xp)
        ends = start[..., :k], goal[..., :k]
        scaled = self._scale(values[..., :k], *ends, reference.leading(k), xp)
        others = values[..., k:]
        others = xp.broadcast_to(others, (*scaled.shape[:-1], others.shape[-1]))
        return xp.concatenate([scaled, others], -1)

    def unscale(self, values: Tensor, reference: Demonstrated) -> Tensor:
        """What `scale` makes `values` of, between the demonstration's own ends."""
        # There every scaling is a factor on each coordinate.
        ones = torch.ones_like(values[..., :1, :])
        return values / self.scale(ones, reference.start, reference.goal, reference)

    def check(  # noqa: B027  any motion will do unless a scaling says otherwise
        self, reference: Demonstrated, batch: tuple[int, ...], names: Sequence[str] | None
    ) -> None:
        """See whether demonstrations, on a flat batch, can be scaled so.

        Args:
            reference: (B, D) each.
            batch: The shape that was flattened to B.
            names: Of the coordinates, for the complaint.

        Raises:
            ValueError: A demonstration ends too close to its start for this scaling.
        """

    @abstractmethod
    def _scale(
        self, values: Any, start: Any, goal: Any, reference: Demonstrated, xp: ModuleType
    ) -> Any:
        """`scale`, for all coordinates there are."""


@dataclass(frozen=True, kw_only=True)
class NoScaling(Scaling):
    """Weights are accelerations."""

    name: ClassVar[str] = "none"

    def unscale(self, values: Tensor, reference: Demonstrated) -> Tensor:
        """The values."""
        return values

    def _scale(
        self, values: Any, start: Any, goal: Any, reference: Demonstrated, xp: ModuleType
    ) -> Any:
        return values


@dataclass(frozen=True, kw_only=True)
class AmplitudeScaling(Scaling):
    """By the range that each coordinate covers."""

    name: ClassVar[str] = "amplitude"

    def _scale(
        self, values: Any, start: Any, goal: Any, reference: Demonstrated, xp: ModuleType
    ) -> Any:
        return values * reference.amplitude[..., None, :]


@dataclass(frozen=True, kw_only=True)
class PaperScaling(Scaling):
    """By g - y_0, coordinate by coordinate (paper eq. (eq_tf))."""

    name: ClassVar[str] = "paper"
    follows_ends: ClassVar[bool] = True

    def check(
        self, reference: Demonstrated, batch: tuple[int, ...], names: Sequence[str] | None
    ) -> None:
        """Refuse a coordinate that ends where it started."""
        shown = reference.leading(self.columns)
        way = shown.goal - shown.start
        singular = way.abs() < MINIMUM_WAY * shown.amplitude
        if singular.any():
            i, j = singular.nonzero()[0].tolist()
            name = f"column {j}" if names is None else names[j]
            raise ValueError(
                f"{demo_label(i, batch)}scaling 'paper' divides by goal - start, which is "
                f"{way[i, j].item():.2g} for {name}. Use scaling='none' or 'amplitude'."
            )

    def _scale(
        self, values: Any, start: Any, goal: Any, reference: Demonstrated, xp: ModuleType
    ) -> Any:
        return values * (goal - start)[..., None, :]


@dataclass(frozen=True, kw_only=True)
class RotationScaling(Scaling):
    """By the turn and the growth of the way from start to goal, in two dimensions or more.

    c R, with c = |g - y_0| / |g_0 - y_0| and R the rotation that takes a, the direction of
    the demonstrated way g_0 - y_0, to that of the new one, b, and turns nothing else (as
    Hoffmann et al. 2009 have it in space): R = H(a + b) H(a), H(x) v = v - 2 x (x'v) / x'x.
    The start velocity goes along, so that the whole motion turns and grows as its ends do.

    Half a turn has no such rotation: nearer to it than `HALF_TURN`, R turns in the plane of a
    and the axis of the coordinates most square to it. R jumps there, depending on the side it
    is approached from, and its derivative grows as 1 / |a + b| on the way; both stay finite.
    """

    name: ClassVar[str] = "rotation"
    follows_ends: ClassVar[bool] = True
    turns: ClassVar[bool] = True

    def check(
        self, reference: Demonstrated, batch: tuple[int, ...], names: Sequence[str] | None
    ) -> None:
        """Refuse a motion that ends where it started, and one along a line."""
        shown = reference.leading(self.columns)
        way = shown.goal - shown.start
        if way.shape[-1] < 2:
            raise ValueError("scaling 'rotation' needs 2 coordinates or more: one cannot turn")
        singular = way.norm(dim=-1) < MINIMUM_WAY * shown.amplitude.amax(-1)
        if singular.any():
            i = int(singular.nonzero()[0])
            raise ValueError(
                f"{demo_label(i, batch)}scaling 'rotation' divides by the distance from start "
                f"to goal, which is {way[i].norm().item():.2g}. Use scaling='none' or "
                "'amplitude'."
            )

    def _scale(
        self, values: Any, start: Any, goal: Any, reference: Demonstrated, xp: ModuleType
    ) -> Any:
        shown = reference.goal - reference.start
        length = _squared(shown) ** 0.5
        a, way = shown / length, (goal - start) / length
        growth = _squared(way).clip(min=NO_WAY) ** 0.5
        # Two reflections are the rotation by twice the angle between their normals.
        turned = _reflected(_reflected(values, a), _half_way(a, way / growth, xp))
        return turned * growth[..., None, :]


def _half_way(a: Any, b: Any, xp: ModuleType) -> Any:
    """Unit vector along a + b, or square to a where that vanishes."""
    axis = xp.arange(a.shape[-1], device=a.device) == abs(a).argmin(-1)[..., None]
    other = -a * (a * axis).sum(-1)[..., None] + axis
    middle = a + b
    opposite = _squared(middle) < HALF_TURN**2
    middle = xp.where(opposite, other, middle)
    return middle / _squared(middle) ** 0.5


def _reflected(values: Any, normal: Any) -> Any:
    """Row vectors (*batch, K, D), mirrored in the plane square to a unit normal."""
    return values - 2 * (values @ normal[..., None]) * normal[..., None, :]


def _squared(vectors: Any) -> Any:
    return (vectors * vectors).sum(-1)[..., None]


SCALINGS: dict[str, type[Scaling]] = {
    scaling.name: scaling
    for scaling in (NoScaling, PaperScaling, AmplitudeScaling, RotationScaling)
}


def find_scaling(scaling: str | Scaling, columns: int | None = None) -> Scaling:
    """The scaling of that name, for the first `columns` coordinates; a part is kept as it is.

    Raises:
        ValueError: No such scaling.
    """
    if isinstance(scaling, Scaling):
        return scaling
    if scaling not in SCALINGS:
        raise ValueError(f"unknown scaling {scaling!r}; there are {', '.join(SCALINGS)}")
    return SCALINGS[scaling](columns=columns)
