"""Scalings of the forcing term with start and goal, selected by name.

With the start y_0 and the goal g:

- `"none"`: no scaling. Weights are accelerations; a new goal shifts the motion smoothly.
  This is the default, because it is defined for every start and goal.
- `"paper"`: factor g - y_0, as printed in the paper (Yan et al.). The motion grows with the
  distance to the goal, and is mirrored if the goal lies on the other side. The scaling is
  undefined for demonstrations with g = y_0.
- `"amplitude"`: factor equal to the range of each coordinate in the demonstration. Weights are
  dimensionless, so a scaled demonstration has the same weights. The scaling is also defined for
  g = y_0.
- `"rotation"`: rotation and dilation with the displacement from start to goal, for positions in
  space; see `_rotated`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from hrc_learn.dmp.samples import demo_label

MINIMUM_DISPLACEMENT = 1e-3
"""Smallest |g - y_0|, relative to the range, by which weights may be divided. A smaller
divisor would give weights more than a thousand times as large as division by the range."""
HALF_TURN = 1e-3
"""Difference [rad] from half a turn below which a rotation counts as half a turn."""
NO_DIRECTION = 1e-24
"""Squared ratio of a displacement to the demonstrated displacement. Below it, start and goal
agree to rounding (ratio 1e-12), so the displacement has no direction."""


@dataclass(frozen=True, eq=False)
class Demonstrated:
    """Start, goal and range of a demonstration, (*batch, D) each, as tensors or arrays."""

    start: Any
    goal: Any
    amplitude: Any
    """Range of each coordinate."""

    def leading(self, columns: int | None) -> "Demonstrated":
        """Start, goal and range of the first `columns` coordinates; None selects all."""
        return Demonstrated(**{k: values[..., :columns] for k, values in vars(self).items()})


@dataclass(frozen=True, kw_only=True)
class Scaling:
    """Linear map of the forcing term, determined by start and goal.

    `scale` accepts tensors, or arrays with `xp=numpy`, so that fits, rollouts, steps and the
    `Stepper` use one definition.
    """

    name: str = "none"
    """Key of `SCALINGS`."""
    columns: int | None = None
    """Number of leading coordinates that are scaled; None: all."""

    def __post_init__(self):
        if self.name not in SCALINGS:
            raise ValueError(
                f"unknown scaling {self.name!r}; choose from {', '.join(SCALINGS)}"
            )

    @property
    def depends_on_boundary(self) -> bool:
        """True if a new start or goal changes the map.

        The motion is then not linear in weights, start and goal together.
        """
        return self.name in ("paper", "rotation")

    @property
    def turns(self) -> bool:
        """True if the map rotates. Weights are then in the frame of the demonstration, and the
        start velocity is scaled too.
        """
        return self.name == "rotation"

    def scale(
        self,
        values: Any,
        start: Any,
        goal: Any,
        reference: Demonstrated,
        xp: ModuleType = torch,
    ) -> Any:
        """Scale weights, forces or the states that they cause.

        Args:
            values: K values of each of the D coordinates, (*batch, K, D).
            start: y_0 of the motion, (*batch, D).
            goal: g of the motion, (*batch, D).
            reference: The demonstration.
            xp: `torch` for tensors, `numpy` for arrays.
        """
        k, scale = self.columns, SCALINGS[self.name]
        if k is None:
            return scale(values, goal - start, reference, xp)
        displacement = goal[..., :k] - start[..., :k]
        scaled = scale(values[..., :k], displacement, reference.leading(k), xp)
        others = values[..., k:]
        others = xp.broadcast_to(others, (*scaled.shape[:-1], others.shape[-1]))
        return xp.concatenate([scaled, others], -1)

    def unscale(self, values: Tensor, reference: Demonstrated) -> Tensor:
        """Inverse of `scale` for the start and goal of the demonstration."""
        if self.name == "none":
            return values
        # For the demonstrated start and goal, every scaling is a factor per coordinate.
        ones = torch.ones_like(values[..., :1, :])
        return values / self.scale(ones, reference.start, reference.goal, reference)

    def check(
        self, reference: Demonstrated, batch: tuple[int, ...], names: Sequence[str] | None
    ) -> None:
        """Check that demonstrations can be scaled.

        Args:
            reference: Start, goal and range of B demonstrations on a flat batch, (B, D) each.
            batch: Batch shape that was flattened to B.
            names: Names of the coordinates, for error messages.

        Raises:
            ValueError: A demonstration ends too close to its start for this scaling.
        """
        if not self.depends_on_boundary:
            return
        shown = reference.leading(self.columns)
        offset, size = (shown.goal - shown.start).abs(), shown.amplitude
        divisor = "goal - start"
        if self.turns:
            if offset.shape[-1] < 2:
                raise ValueError("scaling 'rotation' needs 2 coordinates or more, got 1")
            offset, size = offset.norm(dim=-1, keepdim=True), size.amax(-1, keepdim=True)
            divisor = "the distance from start to goal"
        singular = offset < MINIMUM_DISPLACEMENT * size
        if singular.any():
            i, j = singular.nonzero()[0].tolist()
            name = f"column {j}" if names is None else names[j]
            raise ValueError(
                f"{demo_label(i, batch)}scaling {self.name!r} divides by {divisor}, which is "
                f"{offset[i, j].item():.2g}{'' if self.turns else f' for {name}'}. Use "
                "scaling='none' or 'amplitude'."
            )


def _rotated(values: Any, displacement: Any, reference: Demonstrated, xp: ModuleType) -> Any:
    """Rotation and dilation with the displacement from start to goal, in 2 dimensions or more.

    Values are multiplied by c R. The dilation c is the ratio of the lengths of the new and the
    demonstrated displacement from start to goal. The rotation R turns the direction a of the
    demonstrated displacement to the direction b of the new displacement, in their common plane
    (Hoffmann et al. 2009, in space). R consists of two reflections, R = H(a + b) H(a), where
    H(x) v = v - 2 x (x'v) / x'x. The start velocity is scaled too, so that the whole motion
    turns and grows with its ends.

    For half a turn, the common plane is not unique. Within `HALF_TURN` of half a turn, R turns
    in the plane of a and the coordinate axis most orthogonal to a. R is discontinuous there,
    and its derivative grows as 1 / |a + b| towards half a turn, but both stay finite.
    """
    shown = reference.goal - reference.start
    length = _squared(shown) ** 0.5
    a, displacement = shown / length, displacement / length
    growth = _squared(displacement).clip(min=NO_DIRECTION) ** 0.5
    # Two reflections make a rotation by twice the angle between their normals.
    turned = _reflected(_reflected(values, a), _bisector(a, displacement / growth, xp))
    return turned * growth[..., None, :]


def _bisector(a: Any, b: Any, xp: ModuleType) -> Any:
    """Unit vector along a + b, or orthogonal to a where this sum nearly vanishes."""
    axis = xp.arange(a.shape[-1], device=a.device) == abs(a).argmin(-1)[..., None]
    orthogonal = -a * (a * axis).sum(-1)[..., None] + axis
    middle = a + b
    opposite = _squared(middle) < HALF_TURN**2
    middle = xp.where(opposite, orthogonal, middle)
    return middle / _squared(middle) ** 0.5


def _reflected(values: Any, normal: Any) -> Any:
    """Row vectors (*batch, K, D), reflected in the plane orthogonal to a unit normal."""
    return values - 2 * (values @ normal[..., None]) * normal[..., None, :]


def _squared(vectors: Any) -> Any:
    return (vectors * vectors).sum(-1)[..., None]


SCALINGS: dict[str, Callable[[Any, Any, Demonstrated, ModuleType], Any]] = {
    "none": lambda values, displacement, reference, xp: values,
    "paper": lambda values, displacement, reference, xp: values * displacement[..., None, :],
    "amplitude": lambda values, displacement, reference, xp: (
        values * reference.amplitude[..., None, :]
    ),
    "rotation": _rotated,
}
"""Functions by name that scale values (*batch, K, D) for a displacement from start to goal."""


def find_scaling(scaling: str | Scaling, columns: int | None = None) -> Scaling:
    """Scaling named `scaling`, for the first `columns` coordinates; a `Scaling` stays as it is.

    Raises:
        ValueError: Unknown scaling.
    """
    return scaling if isinstance(scaling, Scaling) else Scaling(name=scaling, columns=columns)
