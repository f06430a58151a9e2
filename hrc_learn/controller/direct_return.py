"""Direct return of joints to their path, where no motion of the null space leads there."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hrc_learn.controller.joint_path import JointPaths
from hrc_learn.controller.null_space_motion import Clearance, YieldingConfig
from hrc_learn.pytree import pytree

# Samples of a path that a direct return may lead to, and postures checked on the way.
_RETURN_GOALS, _CHECKED = 20, 50


@pytree
@dataclass(frozen=True, kw_only=True)
class DirectReturn:
    """A straight motion of the joints back to a path, where no null-space motion leads there.

    Another posture for the same pose may lie in between, so the end effector leaves its path.
    """

    start: Float[Tensor, "*batch n"]
    """Joint positions at the start [rad]."""
    goal: Float[Tensor, "*batch n"]
    """Joint positions on the path [rad]."""
    progress: Float[Tensor, "*batch"]
    """Sample of the path at which the return ends."""
    duration: Float[Tensor, "*batch"]
    """Duration [s]."""
    time: Float[Tensor, "*batch"]
    """Time since the start [s]."""
    active: Bool[Tensor, "*batch"]
    """True while the joints return directly."""
    blocked: Bool[Tensor, "*batch"]
    """True where the arm would meet something on the way to each sample."""

    @classmethod
    def none(cls, joint_position: Float[Tensor, "*batch n"]) -> DirectReturn:
        """No return under way."""
        zero = torch.zeros_like(joint_position[..., 0])
        never = torch.zeros_like(zero, dtype=torch.bool)
        return cls(
            start=joint_position,
            goal=joint_position,
            progress=zero,
            duration=zero,
            time=zero,
            active=never,
            blocked=never,
        )

    @classmethod
    def planned(
        cls,
        paths: JointPaths,
        path: Int[Tensor, "*batch"],
        progress: Float[Tensor, "*batch"],
        joint_position: Float[Tensor, "*batch n"],
        config: YieldingConfig,
        clearance: Clearance | None,
    ) -> DirectReturn:
        """Plan a return to the sample where a path waits, or the nearest that is clear.

        Args:
            paths: Table of paths.
            path: Index of the path.
            progress: Sample at which it waits.
            joint_position: Joint positions now [rad].
            config: Highest speed, and the clearance that need not be exceeded.
            clearance: Distance of the arm from obstacles; None: every way is clear.
        """
        goals, order = _return_goals(paths, path, progress, joint_position)
        start = joint_position.unsqueeze(0).expand_as(goals)
        if clearance is None:
            clear = torch.ones_like(order, dtype=torch.bool)
        else:
            fraction = torch.linspace(0, 1, _CHECKED + 1, dtype=goals.dtype)
            fraction = fraction.reshape(-1, *(1 for _ in goals.shape))
            distance = clearance(torch.lerp(start, goals, fraction))
            ends = distance[[0, -1]].amin(0)
            clear = (distance >= ends.clamp(max=config.clearance)).all(0)
        # The first candidate that is clear.
        chosen = clear.to(torch.int64).argmax(0, keepdim=True)
        goal = goals.gather(0, chosen.unsqueeze(-1).expand_as(goals[:1])).squeeze(0)
        # A minimum-jerk motion peaks at 1.875 times its mean speed.
        far = (goal - joint_position).abs().amax(-1)
        return cls(
            start=joint_position,
            goal=goal,
            progress=order.gather(0, chosen).squeeze(0),
            duration=1.875 * far / config.return_speed,
            time=torch.zeros_like(far),
            active=clear.any(0),
            blocked=~clear.any(0),
        )

    def later(self, duration: Float[Tensor, "*batch"]) -> DirectReturn:
        """The return some time later [s], where it is under way."""
        return replace(self, time=torch.where(self.active, self.time + duration, self.time))

    def joint_position(self) -> Float[Tensor, "*batch n"]:
        """Joint positions to track now [rad]."""
        s = (self.time / self.duration.clamp(min=1e-9)).clamp(0, 1)
        s = s**3 * (10 - 15 * s + 6 * s**2)
        return torch.lerp(self.start, self.goal, s.unsqueeze(-1))


def _return_goals(
    paths: JointPaths,
    path: Int[Tensor, "*batch"],
    progress: Float[Tensor, "*batch"],
    joint_position: Float[Tensor, "*batch n"],
) -> tuple[Float[Tensor, "goals *batch n"], Float[Tensor, "goals *batch"]]:
    """Goals of a direct return and their samples: the one that waits, others by distance."""
    last = paths.last[path]
    stride = ((last + 1) // _RETURN_GOALS).clamp(min=1)
    k = torch.arange(2 * _RETURN_GOALS).reshape(-1, *(1 for _ in last.shape)) * stride
    # Short lists are padded by the first sample.
    k = torch.where(k <= last, k, 0)
    others = paths.position[path.expand_as(k), k]
    far = (others - joint_position).norm(dim=-1)
    order = far.argsort(dim=0, stable=True)
    others = others.gather(0, order.unsqueeze(-1).expand_as(others))
    samples = k.gather(0, order).to(progress.dtype)
    here = paths.interpolated(paths.position, path, progress)
    return torch.cat([here[None], others]), torch.cat([progress[None], samples])
