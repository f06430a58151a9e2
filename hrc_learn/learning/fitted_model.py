"""Load a fitted model from its folder, convert its units, and find the arm that it fits."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp import JointDMP, PoseDMP
from hrc_learn.kinematics import Arm, ArmChoice
from hrc_learn.learning.primitive_fitting import Primitive, load_primitive

CHANNELS = ("joint", "pose", "position")
"""Channels that can be played; an orientation alone moves no arm."""
_RAD = {"rad": 1.0, "deg": math.pi / 180}
"""Radians per unit, for joint units of a fixed size."""
_SAME_TOOL = 0.02
"""Largest distance [m] between two positions of the tool: at the start of the model's pose
primitive, and by the arm's kinematics at the start of the model's joint primitive."""
KINDS = "joints", "position", "pose"
"""Kinds of goals."""


@dataclass(frozen=True, kw_only=True)
class Target:
    """Start or goal of a motion."""

    joints: Float[Tensor, " joints"] | None = None
    """Joint positions in the model's unit."""
    position: Float[Tensor, "3"] | None = None
    """Position of the tool [m]."""
    orientation: Float[Tensor, "4"] | None = None
    """Unit quaternion (w, x, y, z); None keeps the model's orientation."""


@dataclass(frozen=True, kw_only=True)
class FittedModel:
    """Primitives in a folder written by `hrc fit`."""

    folder: Path
    primitives: Mapping[str, Primitive]
    """Common primitive of all demonstrations, by channel."""

    @classmethod
    def load(cls, folder: Path) -> FittedModel:
        """Read the primitives that can be played.

        Raises:
            FileNotFoundError: The folder holds no such primitive.
        """
        found = [channel for channel in CHANNELS if (folder / channel).is_dir()]
        if not found:
            raise FileNotFoundError(
                f"{folder} holds no primitive of joints, poses or positions: give a folder "
                "written by hrc fit"
            )
        loaded = {c: cast(Any, load_primitive(folder / c, c)).double() for c in found}
        return cls(folder=folder, primitives=loaded)

    @property
    def joint(self) -> JointDMP | None:
        """Primitive of the joints."""
        return cast("JointDMP | None", self.primitives.get("joint"))

    @property
    def pose(self) -> PoseDMP | None:
        """Primitive of the end effector."""
        return cast("PoseDMP | None", self.primitives.get("pose"))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints; empty without a primitive of the joints."""
        if (joint := self.joint) is None:
            return ()
        names = joint.joint_names or [f"joint{i + 1}" for i in range(len(joint.start))]
        return tuple(name.removesuffix(".pos") for name in names)

    def target(self, words: Sequence[str], option: str) -> Target:
        """Parse a start or goal from the words of an option.

        Args:
            words: Numbers, optionally after one of the words "joints", "position" and "pose".
            option: Name of the option, for errors.

        Raises:
            ValueError: The words describe no target of this model, or more than one.
        """
        counts = {"position": 3, "pose": 7}
        if self.joint is not None:
            counts = {"joints": len(self.joint_names), **counts}
        given, numbers = ("", words) if words[0] not in KINDS else (words[0], words[1:])
        forms = ", ".join(f"{n} numbers ({kind})" for kind, n in counts.items())
        try:
            values = torch.tensor([float(word) for word in numbers], dtype=torch.float64)
        except ValueError:
            values = torch.empty(0)
        fits = [kind for kind, n in counts.items() if n == len(values) and given in ("", kind)]
        if not fits or not bool(values.isfinite().all()):
            raise ValueError(
                f"{option} {' '.join(words)}: {self.folder} accepts {forms}, all finite, or "
                "the word episode and the number of an episode."
            )
        if len(fits) > 1:
            raise ValueError(
                f"{option}: {len(values)} numbers may be {' or '.join(fits)}: write "
                f"{option} {fits[0]} or {option} {fits[1]} before them."
            )
        if fits[0] != "pose":
            return Target(**{fits[0]: values})
        norm = float(values[3:].norm())
        if abs(norm - 1) > 0.02:
            raise ValueError(
                f"{option} pose: the norm of w x y z is {norm:.3f}, but must be 1."
            )
        return Target(position=values[:3], orientation=values[3:] / norm)

    def in_rad(self, robot: Arm, values: Float[Tensor, "*batch joints"]) -> Tensor:
        """Convert the model's joint positions to those of an arm [rad], (*batch, joints).

        Raises:
            ValueError: The model's unit has no fixed size.
        """
        factor, columns = self._columns(robot)
        return factor * values[..., columns]

    def from_rad(self, robot: Arm, joints: Float[Tensor, "*batch joints"]) -> Tensor:
        """Inverse of `in_rad`."""
        factor, columns = self._columns(robot)
        return joints[..., np.argsort(columns).tolist()] / factor

    def _columns(self, robot: Arm) -> tuple[float, list[int]]:
        """Radians per unit of the model, and the model's column of each joint of the arm."""
        assert self.joint is not None
        unit = self.joint.units
        if unit not in _RAD:
            shown = "fractions of their ranges" if unit in ("1", "%") else repr(unit)
            raise ValueError(
                f"{self.folder} holds joints in {shown}, which have no known size in rad: fit "
                "with the unit of the dataset (--units joint_position deg) or convert it with "
                "the robot's calibration. Without --robot, the model is played in its own unit."
            )
        return _RAD[unit], [self.joint_names.index(name) for name in robot.chain.joint_names]


def arm_for(model: FittedModel, name: str) -> Arm:
    """Arm with the tool to which the model's poses belong.

    The tool is the one in the arm's description, or the Franka hand.

    Args:
        model: The model.
        name: Name of a registered arm, or file of an arm's description.

    Raises:
        ValueError: The model has other joints, or its poses belong to another tool or base.
    """
    robot = ArmChoice(name).arm()
    names = robot.chain.joint_names
    if model.joint is not None and {*model.joint_names} != {*names}:
        raise ValueError(
            f"{model.folder} moves the joints {', '.join(model.joint_names)}, but {name} has "
            f"{', '.join(names)}: choose the arm of its demonstrations, or use hrc fit "
            "--joint-names."
        )
    if model.joint is None or model.pose is None:
        return robot
    arms = [robot]
    if robot.joints >= 6 and not robot.is_franka:
        arms.append(robot.with_hand())
    q = model.in_rad(robot, model.joint.start)
    apart = [
        float((arm.forward(q).position - model.pose.start.position).norm()) for arm in arms
    ]
    best = int(np.argmin(apart))
    if apart[best] > _SAME_TOOL:
        raise ValueError(
            f"the poses of {model.folder} begin {1e3 * apart[best]:.0f} mm from the tool of "
            f"{name} at the model's first joints: they have another tool or base. Fit with "
            "--channels joint, or choose the arm's description with that tool."
        )
    return arms[best]
