"""How far the gripper has to turn for its marker to stand to an object's as demonstrated.

The direction of a marker in the image changes with the tool's motion like its pixel does: by an
image Jacobian of one row, learned from demonstrations and adapted online. Two flat markers that
are turned alike look turned alike from any camera, but for perspective, so their difference in
the image tells when the gripper is turned as demonstrated, without calibration.
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import KalmanConfig, KalmanEstimator, Measurement, RBFImageJacobian
from hrc_learn.jacobian.learning_estimators import RecursiveState
from hrc_learn.kinematics.tool_orientation import turn_about_vertical
from hrc_learn.store import write_text

HALF_TURN = math.pi
"""Turns of the gripper that a parallel grasp cannot tell apart [rad]."""

# How far out of the range a turn once chosen is kept [rad]: the error of its estimate before
# the tool has turned, some 5 %, of up to half a turn.
_KEPT = 0.15

# A marker's direction is measured to some 0.1 px over 50 px of its edge [rad].
_ANGLE_NOISE = 5e-3
# Before any demonstration: a camera that looks down sees the opposite of each turn [rad/rad].
_FROM_ABOVE = -1.0
# By how much that may be wrong, over the metres that a radian counts for [1/m].
_PRIOR = 1.0 / 0.15
# Pairs closer than 0.1 rad tell nothing beside the noise [m], by the same measure.
_STEP = 0.015


@dataclass(frozen=True, kw_only=True, eq=False)
class AngleDemonstration:
    """Motion of the tool, and the directions of both markers in the image."""

    pose: Pose
    """Of the tool, (time,)."""
    tool: Float[Tensor, " time"]
    """Direction of the tool's marker [rad]; NaN where it was not seen."""
    item: float
    """Direction of the object's [rad]."""
    final: float
    """Direction of the tool's marker at the end, above the object [rad]."""


@dataclass(frozen=True, kw_only=True)
class MarkerAngle:
    """Image Jacobian of the marker's direction, and its demonstrated difference."""

    jacobian: RBFImageJacobian
    """One row [rad/m, rad/rad], the same everywhere."""
    offset: float
    """Direction of the tool's marker less that of the object's, up to half turns [rad]."""
    spread: float
    """Of that among the demonstrations, root mean square [rad]."""

    @classmethod
    def fit(cls, demonstrations: Sequence[AngleDemonstration]) -> MarkerAngle:
        """Learn both.

        Raises:
            ValueError: If there is no demonstration.
        """
        if not demonstrations:
            raise ValueError("a marker's angle is learned from one demonstration or more.")
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
        # The mean of angles that are known up to half turns: that of their doubles.
        mean = np.exp(2j * differences).mean()
        offset = float(np.angle(mean)) / 2
        off = np.array([_wrapped(d - offset) for d in differences])
        return cls(jacobian=learned, offset=offset, spread=float(np.sqrt((off**2).mean())))

    def save(self, folder: Path) -> None:
        """Write `folder/angle` and `folder/angle.json`."""
        self.jacobian.save(folder / "angle")
        content = {"version": 1, "offset_rad": self.offset, "spread_rad": self.spread}
        write_text(folder / "angle.json", json.dumps(content, indent=2))

    @classmethod
    def load(cls, folder: Path) -> MarkerAngle:
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: If there is no such folder or file.
            ValueError: If a file is not one of ours.
        """
        path = folder / "angle.json"
        content = json.loads(path.read_text(encoding="utf-8"))
        if content.get("version") != 1 or "offset_rad" not in content:
            raise ValueError(f"{path} is not an angle of a known version: fit it again.")
        return cls(
            jacobian=RBFImageJacobian.load(folder / "angle"),
            offset=content["offset_rad"],
            spread=content["spread_rad"],
        )


class AngleServo:
    """Turns the tool about the vertical until its marker stands to the object's as learned."""

    def __init__(self, learned: MarkerAngle):
        self._offset = learned.offset
        self._estimator = _estimator(learned.jacobian)
        self._state = self._estimator.initial_state()
        self.restart()

    def restart(self) -> None:
        """Begin another motion: the camera may have been moved since the last."""
        self._state = self._estimator.resumed(self._state, 0.0)
        self._chosen: float | None = None

    def update(self, pose: Pose, angle: float, dt: float) -> None:
        """Learn from an image.

        Args:
            pose: Of the tool when it was taken.
            angle: Direction of the tool's marker in it [rad].
            dt: Time since the image before [s].
        """
        seen = torch.tensor(angle, dtype=torch.float64)
        self._state = _updated(self._estimator, self._state, pose, seen, dt)

    def turned(
        self,
        pose: Pose,
        angle: float,
        item: float,
        reference: Float[Tensor, "4"],
        allowed: tuple[float, float],
    ) -> Float[Tensor, "4"]:
        """Orientation of the tool that will stand to the object as demonstrated.

        Args:
            pose: Of the tool when the image was taken.
            angle: Direction of the tool's marker in it [rad].
            item: Direction of the object's marker [rad].
            reference: Orientation of a tool that is not turned.
            allowed: Least and greatest turn of the tool from there about the vertical [rad].
                Of those that differ by half turns the nearest within is taken, and kept to
                for as long as it is not far out of the range: near either end of it noise
                would turn the tool to and fro.
        """
        row = self._estimator.jacobian(self._state, pose)[0]
        rate = float(row[5])
        # Sign and size of a camera above; one that looks from below is not what this is for.
        rate = math.copysign(min(max(abs(rate), 0.5), 2.0), rate)
        now = turn_about_vertical(pose.orientation, reference)
        missing = _wrapped(item + self._offset - angle) / rate
        self._chosen = _within(now + missing, now, allowed, self._chosen)
        return _turned(reference, self._chosen)


def _within(
    turn: float, now: float, allowed: tuple[float, float], chosen: float | None
) -> float:
    """The turn, by half turns into the range, as near to the present one as can be; the one
    chosen before if it is nearly in the range.
    """
    low, high = allowed
    candidates = [turn + k * HALF_TURN for k in range(-3, 4)]
    if chosen is not None:
        same = min(candidates, key=lambda c: abs(c - chosen))
        if low - _KEPT <= same <= high + _KEPT:
            return same
    inside = [c for c in candidates if low <= c <= high]
    return min(inside or [min(max(turn, low), high)], key=lambda c: abs(c - now))


def _turned(orientation: Float[Tensor, "4"], turn: float) -> Float[Tensor, "4"]:
    about = torch.tensor([0.0, 0.0, turn], dtype=torch.float64)
    return quaternion.multiply(quaternion.exp(about), orientation)


def _wrapped(angle: float) -> float:
    """An angle known up to half turns, within a quarter turn of zero [rad]."""
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
    estimator: KalmanEstimator, state: RecursiveState, pose: Pose, angle: Tensor, dt: float
) -> RecursiveState:
    """State of the estimator after an image."""
    if bool(state.key.present):
        # Differences to the key frame are what is learned from: less than half a turn each.
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
