"""Joint paths that a pushed arm may leave: rules for slowing down, waiting and retracing.

While a person pushes the joints off their path, the end effector keeps to the poses of the
path. The rules here decide whether the joints are off the path, how far a push may take them,
when the path waits for them, and how they return. All functions are batched and stateless.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from hrc_learn.controller.null_space_motion import (
    Clearance,
    YieldingConfig,
    smallest_singular_value,
)
from hrc_learn.geometry import minimum_jerk
from hrc_learn.kinematics import SerialChain
from hrc_learn.pytree import pytree

CHANGE_OF_RATE = 0.2
"""Time in which the motion along a path stops, or reaches its full speed [s]."""
FAR_ASIDE = 1.8
"""Largest distance of the joints from their path at which the path still advances [rad]. In
simulation, arms always returned to their path from 1.4 rad, where the elbow is about 0.2 m off
the path; from 2 rad some arms did not."""
WELL_ALIGNED, POORLY_ALIGNED = 0.8, 0.65
"""Alignments (`return_alignment`): above `WELL_ALIGNED`, pushes are followed in full; below
`POORLY_ALIGNED`, the null space may lead to a posture other than the path's. The null space
moves the elbow on a circle: the alignment is 0.7 after a quarter of this circle, and 0 after
half of it."""
NARROW = 0.07
"""Lower bound on the smallest singular value of the Jacobian: below it, the joints may not
leave their path. The damping of the inverse Jacobian begins at 0.05."""

# A path that has waited for the joints continues if their distance from it is below this [rad].
_NEAR_AGAIN = 1.4
# Distances from the path [rad]. Below the first distance, joints return whatever their
# alignment is. Above the second, the alignment counts in full.
_NEARBY = 0.3, 0.5
# `_ON_PATH`: tolerated distance of the end effector from its path [m], half the deviation that
# a push may cause.
# `_SERVO_LAG`: tolerated lag behind the path [s], twice the servo lag of an arm with a delay of
# 20 ms.
_ON_PATH, _SERVO_LAG = 0.001, 0.06
# Length that converts rotations of the end effector to distances: the size of gripper and
# object [m/rad].
_METRES_PER_RADIAN = 0.1


@pytree
class JointPaths:
    """Joint paths, sampled at the control step and padded with their last sample."""

    position: Float[Tensor, "paths samples n"]
    """Joint positions [rad]."""
    velocity: Float[Tensor, "paths samples n"]
    """Joint velocities [rad/s]."""
    narrow: Bool[Tensor, "paths samples"]
    """True near a singularity, where the joints cannot leave the path."""
    narrow_ahead: Bool[Tensor, "paths samples"]
    """True where the path becomes narrow within its stopping distance."""
    last: Int[Tensor, " paths"]
    """Index of the last sample of each path."""

    @classmethod
    def of(
        cls, chain: SerialChain, paths: Sequence[Float[np.ndarray, "_samples n"]], dt: float
    ) -> JointPaths:
        """Tabulate paths.

        Args:
            chain: Kinematics of the arm.
            paths: Joint positions of each path [rad].
            dt: Time between samples [s].
        """
        longest, rows = max(len(path) for path in paths), []
        for path in paths:
            velocity = np.gradient(path, dt, axis=0) if len(path) > 1 else np.zeros_like(path)
            position = torch.from_numpy(path.copy())
            narrow = smallest_singular_value(chain, position) < NARROW
            ahead = narrow.clone()
            for k in range(1, int(CHANGE_OF_RATE / dt) + 1):
                ahead[:-k] |= narrow[k:]
            index = torch.arange(longest).clamp(max=len(path) - 1)
            columns = position, torch.from_numpy(velocity), narrow, ahead
            rows.append([column[index] for column in columns])
        position, velocity, narrow, ahead = (torch.stack(x) for x in zip(*rows, strict=True))
        last = torch.tensor([len(path) - 1 for path in paths])
        return cls(
            position=position, velocity=velocity, narrow=narrow, narrow_ahead=ahead, last=last
        )

    def interpolated(
        self, samples: Tensor, path: Int[Tensor, "*batch"], progress: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch n"]:
        """Samples of some paths, interpolated linearly.

        Args:
            samples: `position` or `velocity`.
            path: Index of each path.
            progress: Sample number, not negative; clamped to the last sample.
        """
        last = self.last[path]
        k = torch.minimum(progress.long(), last)
        first, following = samples[path, k], samples[path, torch.minimum(k + 1, last)]
        return first + (progress - k).clamp(max=1.0).unsqueeze(-1) * (following - first)


def return_alignment(
    null_error: Float[Tensor, "*batch n"], error: Float[Tensor, "*batch n"]
) -> Float[Tensor, "*batch"]:
    """Cosine between the path error and its null-space part; 1 for small errors.

    Args:
        null_error: Null-space part of the error [rad].
        error: Path minus joint positions [rad].
    """
    size, (near, far) = error.norm(dim=-1), _NEARBY
    cosine = null_error.norm(dim=-1) / size.clamp(min=near)
    return torch.lerp(torch.ones_like(size), cosine, ((size - near) / (far - near)).clamp(0, 1))


def may_not_return(
    error: Float[Tensor, "*batch n"],
    alignment: Float[Tensor, "*batch"],
    waited: Bool[Tensor, "*batch"] | bool = False,
) -> Bool[Tensor, "*batch"]:
    """True where null-space motion might miss the posture of the path if the path advances.

    Args:
        error: Path minus joint positions [rad].
        alignment: `return_alignment` of that error.
        waited: True if the path has waited for the joints and they are no longer pushed. The
            thresholds are then stricter: if the path continued too early, its motion would move
            the joints away again.
    """
    waited = torch.as_tensor(waited)
    farthest = torch.where(waited, _NEAR_AGAIN, FAR_ASIDE)
    least = torch.where(waited, WELL_ALIGNED, POORLY_ALIGNED)
    return (error.norm(dim=-1) > farthest) | (alignment < least)


def push_fraction(
    push: Float[Tensor, "*batch n"],
    null_error: Float[Tensor, "*batch n"],
    alignment: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch"]:
    """Fraction of a push that is followed, 0 to 1; it fades where joints might not return.

    Args:
        push: Requested null-space velocity [rad/s]; a push towards the path is followed in
            full.
        null_error: Null-space part of the path error [rad].
        alignment: `return_alignment` of the error.
    """
    fade = (alignment - POORLY_ALIGNED) / (WELL_ALIGNED - POORLY_ALIGNED)
    return torch.where(torch.linalg.vecdot(push, null_error) > 0, 1.0, fade.clamp(0.0, 1.0))


def nears_singularity(
    chain: SerialChain,
    joint_position: Float[Tensor, "*batch n"],
    joint_velocity: Float[Tensor, "*batch n"],
) -> Bool[Tensor, "*batch"]:
    """True if joints off their path are near a singularity, or will be before they stop.

    Near a singularity, joints off their path cannot keep the end effector on the path.

    Args:
        chain: Kinematics of the arm.
        joint_position: Joint positions [rad].
        joint_velocity: Joint velocities [rad/s].
    """
    ahead = joint_position + CHANGE_OF_RATE * joint_velocity
    postures = torch.stack([joint_position, ahead])
    return (smallest_singular_value(chain, postures) < NARROW).any(0)


def changed_rate(
    rate: float | Float[Tensor, "*batch"],
    wanted: float | Float[Tensor, "*batch"],
    dt: float,
    direction: int | Int[Tensor, "*batch"] = 1,
) -> Float[Tensor, "*batch"]:
    """Rate of a path in the next step, which approaches the wanted rate smoothly.

    Args:
        rate: Fraction of the path's own speed, -1 to 1.
        wanted: Magnitude of the rate to approach, clipped to 0 to 1.
        dt: Control step [s].
        direction: 1 for forward, -1 for back.
    """
    change, goal = dt / CHANGE_OF_RATE, direction * torch.as_tensor(wanted).clamp(0.0, 1.0)
    return rate + (goal - rate).clamp(-change, change)


def deviation_ratio(
    error: Float[Tensor, "*batch 6"], twist: Float[Tensor, "*batch 6"]
) -> Float[Tensor, "*batch"]:
    """Distance of the end effector from its path, relative to the tolerated distance.

    Args:
        error: Motion of the end effector to its pose on the path (linear [m], angular [rad]).
        twist: Velocity of this pose along the path (linear [m/s], angular [rad/s]).
    """
    return _length(error) / (_ON_PATH + _SERVO_LAG * _length(twist))


def _length(twist: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch"]:
    """Length of a motion [m]: length of its translation, plus its rotation angle in metres."""
    return twist[..., :3].norm(dim=-1) + _METRES_PER_RADIAN * twist[..., 3:].norm(dim=-1)


# `_RETURN_GOALS`: a direct return to a long path chooses among at least this many samples.
# `_CHECKED`: number of postures checked on the way to each of these samples.
_RETURN_GOALS, _CHECKED = 20, 51


@pytree
class DirectReturn:
    """A straight joint motion back to a path that null-space motion cannot reach. During this
    motion, the end effector leaves its path.
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
    """True where the arm would collide during the return, whichever sample it returns to."""

    @classmethod
    def none(cls, joint_position: Float[Tensor, "*batch n"]) -> DirectReturn:
        """State in which no return is under way."""
        q, zero = joint_position, joint_position.new_zeros(joint_position.shape[:-1])
        clocks = {"progress": zero, "duration": zero, "time": zero}
        never = torch.zeros_like(zero, dtype=torch.bool)
        return cls(start=q, goal=q, **clocks, active=never, blocked=never)

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
        """Plan a return to the sample at which the path waits. If the arm would collide during
        this return, plan a return to the nearest sample that it reaches without contact.

        Args:
            paths: Table of paths.
            path: Index of the path.
            progress: Sample at which the path waits.
            joint_position: Joint positions now [rad].
            config: Highest speed of the return, and the clearance to keep. A return may start
                and end with less clearance.
            clearance: Distance of the arm from obstacles; None: there are no obstacles.
        """
        goals, order = _return_goals(paths, path, progress, joint_position)
        start = joint_position.unsqueeze(0).expand_as(goals)
        if clearance is None:
            clear = torch.ones_like(order, dtype=torch.bool)
        else:
            fraction = torch.linspace(0, 1, _CHECKED, dtype=goals.dtype)
            fraction = fraction.reshape(-1, *(1 for _ in goals.shape))
            distance = clearance(torch.lerp(start, goals, fraction))
            ends = distance[[0, -1]].amin(0)
            clear = (distance >= ends.clamp(max=config.clearance)).all(0)
        # The first candidate that the arm reaches without a collision.
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

    def joint_position(self) -> Float[Tensor, "*batch n"]:
        """Joint positions to track now [rad]."""
        s, _ = minimum_jerk(self.time / self.duration.clamp(min=1e-9))
        return torch.lerp(self.start, self.goal, s.unsqueeze(-1))


def _return_goals(
    paths: JointPaths,
    path: Int[Tensor, "*batch"],
    progress: Float[Tensor, "*batch"],
    joint_position: Float[Tensor, "*batch n"],
) -> tuple[Float[Tensor, "goals *batch n"], Float[Tensor, "goals *batch"]]:
    """Possible goals of a direct return [rad], and their sample numbers on the path: first the
    sample at which the path waits, then other samples by increasing distance.
    """
    last = paths.last[path]
    stride = ((last + 1) // _RETURN_GOALS).clamp(min=1)
    k = torch.arange(2 * _RETURN_GOALS).reshape(-1, *(1 for _ in last.shape)) * stride
    # Short lists are padded with the first sample.
    k = torch.where(k <= last, k, 0)
    others = paths.position[path.expand_as(k), k]
    order = (others - joint_position).norm(dim=-1).argsort(dim=0, stable=True)
    others = others.gather(0, order.unsqueeze(-1).expand_as(others))
    samples = k.gather(0, order).to(progress.dtype)
    here = paths.interpolated(paths.position, path, progress)
    return torch.cat([here[None], others]), torch.cat([progress[None], samples])
