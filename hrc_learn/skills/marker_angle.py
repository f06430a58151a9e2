"""Turn of the gripper that aligns its marker with an object's as demonstrated.

The direction of a marker in the image changes with the tool's motion as its pixel does: by an
image Jacobian of one row, learned from demonstrations and adapted online. Except for
perspective, two flat markers with equal directions appear with equal directions in any camera,
so the difference of their directions in the image shows whether the gripper is turned as
demonstrated, without calibration.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import KalmanConfig, KalmanEstimator, Measurement, RBFImageJacobian
from hrc_learn.jacobian.estimators import KalmanState
from hrc_learn.kinematics.tool_orientation import turn_about_vertical
from hrc_learn.store import Radians, read_json, write_json

HALF_TURN = math.pi
"""Period of the turn of a parallel grasp [rad]."""

# Distance from the range within which a chosen turn is kept [rad]: the error of its estimate
# before the tool has turned, about 5 % of up to half a turn.
_KEPT = 0.15

# Noise of a marker's direction [rad]: about 0.1 px over 50 px of its edge.
_ANGLE_NOISE = 5e-3
# Prior mean: a camera that looks down sees each turn with the opposite sign [rad/rad].
_FROM_ABOVE = -1.0
# Prior standard deviation, with rotation scaled to metres [1/m].
_PRIOR = 1.0 / 0.15
# Pairs closer than 0.1 rad show mostly noise [m], with rotation scaled to metres.
_STEP = 0.015


@dataclass(frozen=True, kw_only=True, eq=False)
class AngleDemonstration:
    """Motion of the tool, and the directions of both markers in the image."""

    pose: Pose
    """Poses of the tool, (time,)."""
    tool: Float[Tensor, " time"]
    """Direction of the tool's marker [rad]; NaN where it was not seen."""
    item: float
    """Direction of the object's marker [rad]."""
    final: float
    """Direction of the tool's marker at the end, above the object [rad]."""


@dataclass(frozen=True, kw_only=True)
class _AngleFile:
    version: Literal[1] = 1
    offset_rad: Radians
    spread_rad: Radians


@dataclass(frozen=True, kw_only=True)
class MarkerAngle:
    """Image Jacobian of the marker's direction, and its demonstrated difference."""

    jacobian: RBFImageJacobian
    """One row [rad/m, rad/rad], equal everywhere."""
    offset: float
    """Direction of the tool's marker less that of the object's, modulo half turns [rad]."""
    spread: float
    """Root mean square deviation of the offset among the demonstrations [rad]."""

    @classmethod
    def fit(cls, demonstrations: Sequence[AngleDemonstration]) -> MarkerAngle:
        """Learn image Jacobian and offset from demonstrations.

        Raises:
            ValueError: There is no demonstration.
        """
        if not demonstrations:
            raise ValueError("the direction of a marker needs one demonstration or more.")
        estimator = _estimator(_guess())
        state = estimator.initial_state()
        for demonstration in demonstrations:
            state = estimator.resumed(state, 0.0)
            for k in torch.isfinite(demonstration.tool).nonzero()[:, 0]:
                state = _updated(
                    estimator, state, demonstration.pose[k], demonstration.tool[k], 0.0
                )
        learned = _guess()
        learned.weight.data = state.weight
        differences = np.array([d.final - d.item for d in demonstrations])
        # The mean of angles modulo half turns is half the mean of their doubles.
        mean = np.exp(2j * differences).mean()
        offset = float(np.angle(mean)) / 2
        off = np.array([_wrapped(d - offset) for d in differences])
        return cls(jacobian=learned, offset=offset, spread=float(np.sqrt((off**2).mean())))

    def save(self, folder: Path) -> None:
        """Write `folder/angle` and `folder/angle.json`."""
        self.jacobian.save(folder / "angle")
        content = _AngleFile(offset_rad=self.offset, spread_rad=self.spread)
        write_json(folder / "angle.json", content)

    @classmethod
    def load(cls, folder: Path) -> MarkerAngle:
        """Read a saved direction.

        Raises:
            FileNotFoundError: There is no such folder or file.
            ValueError: A file is damaged, or has an unknown version or kind.
        """
        content = read_json(folder / "angle.json", _AngleFile, "fit it again")
        return cls(
            jacobian=RBFImageJacobian.load(folder / "angle"),
            offset=content.offset_rad,
            spread=content.spread_rad,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class AngleState:
    """State of an `AngleServo`."""

    estimator: KalmanState
    """State of the estimator of the image Jacobian."""
    chosen: float | None = None
    """Chosen turn of the present motion [rad]; None: none so far."""


class AngleServo:
    """Turns the tool about the vertical until its marker is aligned with the object's."""

    def __init__(self, learned: MarkerAngle):
        self._offset = learned.offset
        self._estimator = _estimator(learned.jacobian)

    def initial_state(self) -> AngleState:
        """State before the first image."""
        return AngleState(estimator=self._estimator.initial_state())

    def restarted(self, state: AngleState) -> AngleState:
        """State for another motion; the camera may have been moved since the last one."""
        return AngleState(estimator=self._estimator.resumed(state.estimator, 0.0))

    def updated(self, state: AngleState, pose: Pose, angle: float, dt: float) -> AngleState:
        """State that has learned from an image.

        Args:
            state: State after the last image.
            pose: Pose of the tool when the image was taken.
            angle: Direction of the tool's marker in the image [rad].
            dt: Time since the last image [s].
        """
        seen = torch.tensor(angle, dtype=torch.float64)
        learned = _updated(self._estimator, state.estimator, pose, seen, dt)
        return replace(state, estimator=learned)

    def turned(
        self,
        state: AngleState,
        pose: Pose,
        angle: float,
        item: float,
        reference: Float[Tensor, "4"],
        turn_range: tuple[float, float],
    ) -> tuple[Float[Tensor, "4"], AngleState]:
        """Orientation of the tool that is aligned with the object, and the next state.

        Args:
            state: State after `updated`.
            pose: Pose of the tool when the image was taken.
            angle: Direction of the tool's marker in the image [rad].
            item: Direction of the object's marker [rad].
            reference: Orientation of a tool that is not turned.
            turn_range: Smallest and largest turn of the tool from there about the vertical
                [rad]. Of turns that differ by half turns, the nearest one in the range is
                chosen, and kept while it is not far out of the range: near an end of the range,
                noise would otherwise turn the tool back and forth.
        """
        rate = float(self._estimator.jacobian(state.estimator, pose)[0, 5])
        # Bounds for a camera that looks down; cameras that look up are not supported.
        rate = math.copysign(min(max(abs(rate), 0.5), 2.0), rate)
        now = turn_about_vertical(pose.orientation, reference)
        missing = _wrapped(item + self._offset - angle) / rate
        chosen = _within(now + missing, now, turn_range, state.chosen)
        return _turned(reference, chosen), replace(state, chosen=chosen)


def _within(
    turn: float, now: float, turn_range: tuple[float, float], chosen: float | None
) -> float:
    """Turn in the range that equals `turn` modulo half turns.

    The one nearest to the present turn; the one chosen before, if it is nearly in the range.
    """
    low, high = turn_range
    candidates = [turn + k * HALF_TURN for k in range(-3, 4)]
    if chosen is not None:
        same = min(candidates, key=lambda c: abs(c - chosen))
        if low - _KEPT <= same <= high + _KEPT:
            return same
    inside = [c for c in candidates if low <= c <= high]
    return min(inside or [min(max(turn, low), high)], key=lambda c: abs(c - now))


def _turned(orientation: Float[Tensor, "4"], turn: float) -> Float[Tensor, "4"]:
    """An orientation turned about the vertical [rad]."""
    about = torch.tensor([0.0, 0.0, turn], dtype=torch.float64)
    return quaternion.multiply(quaternion.exp(about), orientation)


def _wrapped(angle: float) -> float:
    """An angle modulo half turns, within a quarter turn of zero [rad]."""
    return float((angle + HALF_TURN / 2) % HALF_TURN - HALF_TURN / 2)


def _guess() -> RBFImageJacobian:
    row = torch.tensor([[0.0, 0, 0, 0, 0, _FROM_ABOVE]], dtype=torch.float64)
    centre = torch.zeros(1, 2, dtype=torch.float64)
    return RBFImageJacobian(centre, 1.0, weight=row.mT.contiguous())


def _estimator(network: RBFImageJacobian) -> KalmanEstimator:
    network = copy.deepcopy(network).double()
    network.covariance = None
    config = KalmanConfig(
        pixel_noise=_ANGLE_NOISE,
        bias_std=_PRIOR,
        weight_std=1e-3 * _PRIOR,
        drift=0.1 * _PRIOR,
        min_step=_STEP,
        max_step=0.3,
        weight_bound=10 * _PRIOR,
    )
    return KalmanEstimator(network, config)


def _updated(
    estimator: KalmanEstimator, state: KalmanState, pose: Pose, angle: Tensor, dt: float
) -> KalmanState:
    """State of the estimator after an image."""
    if bool(state.key.present):
        # The estimator learns from differences to the key frame, each less than half a turn.
        before = state.key.feature[0]
        angle = before + torch.remainder(angle - before + math.pi, 2 * math.pi) - math.pi
    measured = Measurement(
        pose=pose,
        feature=angle.reshape(1),
        valid=torch.tensor(True),
        dt=dt,
        xi_x=torch.zeros(1, dtype=torch.float64),
        xi_r=torch.zeros(6, dtype=torch.float64),
    )
    return estimator.update(state, measured)
