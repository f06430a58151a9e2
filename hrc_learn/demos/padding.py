"""Demonstrations of different lengths as tensors of one length."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .demonstration import Demonstration


@dataclass(frozen=True, kw_only=True, eq=False)
class PaddedDemonstrations:
    """Demonstrations stacked along a leading axis; a field is None unless all recorded it.

    Behind the end of a demonstration its last row is held and time goes on in steps of the
    last interval, so that time increases everywhere; `mask` is false there.
    """

    mask: Bool[Tensor, "demos frames"]
    """True where a frame was recorded."""
    length: Int[Tensor, " demos"]
    """Recorded frames of each demonstration."""
    time: Float[Tensor, "demos frames"]
    joint_position: Float[Tensor, "demos frames joints"] | None = None
    joint_velocity: Float[Tensor, "demos frames joints"] | None = None
    joint_effort: Float[Tensor, "demos frames joints"] | None = None
    position: Float[Tensor, "demos frames 3"] | None = None
    orientation: Float[Tensor, "demos frames 4"] | None = None
    gripper: Float[Tensor, "demos frames"] | None = None
    feature: Float[Tensor, "demos frames 2"] | None = None
    feature_visible: Bool[Tensor, "demos frames"] | None = None
    human_effort: Float[Tensor, "demos frames joints"] | None = None
    command_position: Float[Tensor, "demos frames joints"] | None = None
    command_velocity: Float[Tensor, "demos frames joints"] | None = None

    def to(
        self, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> "PaddedDemonstrations":
        """Move every field; a dtype changes those that hold real numbers."""
        moved = {
            f.name: tensor.to(device, dtype if tensor.is_floating_point() else None)
            for f in fields(self)
            if (tensor := getattr(self, f.name)) is not None
        }
        return PaddedDemonstrations(**moved)


def pad(demonstrations: Sequence[Demonstration]) -> PaddedDemonstrations:
    """Stack demonstrations, holding the last row of the shorter ones (float64)."""
    lengths = np.array([len(demo) for demo in demonstrations])
    longest = int(lengths.max())
    shared = set.intersection(*(set(demo.recorded) for demo in demonstrations)) - {"time"}
    stacked = {
        name: np.stack([_hold(getattr(demo, name), longest) for demo in demonstrations])
        for name in shared
    }
    time = np.stack([_go_on(demo.time, longest, demo.fps) for demo in demonstrations])
    return PaddedDemonstrations(
        mask=torch.from_numpy(np.arange(longest) < lengths[:, None]),
        length=torch.from_numpy(lengths),
        time=torch.from_numpy(time),
        **{name: torch.from_numpy(array) for name, array in stacked.items()},
    )


def _hold(array: np.ndarray, length: int) -> np.ndarray:
    return np.concatenate([array, np.repeat(array[-1:], length - len(array), axis=0)])


def _go_on(time: np.ndarray, length: int, fps: float | int) -> np.ndarray:
    step = time[-1] - time[-2] if len(time) > 1 else 1 / fps
    return np.concatenate([time, time[-1] + step * np.arange(1, length - len(time) + 1)])
