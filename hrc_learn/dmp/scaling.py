"""How the forcing term scales with start and goal, by name.

- `"none"`: not at all. Weights are accelerations; a moved goal shifts the motion smoothly.
  Defined for every start and goal, hence the default.
- `"paper"`: by g - y_0, as the paper prints it. The motion grows with the distance to the
  goal; undefined for g = y_0 and mirrored when the goal lies on the other side.
- `"amplitude"`: by the range each coordinate covers in the demonstration. Weights are
  dimensionless, so a scaled demonstration has the same ones; survives g = y_0.
"""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp.fitting.samples import demo_label

SCALINGS = ("none", "paper", "amplitude")
PAPER_MINIMUM = 1e-3
"""Smallest |g - y_0|, as a share of the range covered, that `"paper"` can be fitted to."""


def check_scaling(name: str) -> None:
    """Raise ValueError unless `name` is a known scaling."""
    if name not in SCALINGS:
        raise ValueError(f"unknown scaling {name!r}; there are {', '.join(SCALINGS)}")


def forcing_scale(
    name: str,
    start: Float[Tensor, "*#batch D"],
    goal: Float[Tensor, "*#batch D"],
    amplitude: Float[Tensor, "*#batch D"],
) -> Float[Tensor, "*#batch D"] | None:
    """Factor on the forcing term; None stands for one."""
    if name == "paper":
        return goal - start
    return amplitude if name == "amplitude" else None


def check_paper_scale(
    scale: Float[Tensor, "B D"],
    amplitude: Float[Tensor, "B D"],
    batch: tuple[int, ...],
    joint_names: Sequence[str] | None,
) -> None:
    """Raise ValueError where one of the flat batch of motions ends too close to its start."""
    singular = scale.abs() < PAPER_MINIMUM * amplitude
    if singular.any():
        i, j = singular.nonzero()[0].tolist()
        name = f"column {j}" if joint_names is None else joint_names[j]
        raise ValueError(
            f"{demo_label(i, batch)}scaling 'paper' divides by goal - start, which is "
            f"{scale[i, j].item():.2g} for {name}. Use scaling='none' or 'amplitude'."
        )
