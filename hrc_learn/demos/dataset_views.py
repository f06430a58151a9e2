"""Arm of a dataset, and curves in the dataset's own units, for dashboards and web pages."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float64

from hrc_learn.demos.demonstration import Demonstration
from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.read.kinematic_evidence import arm_columns
from hrc_learn.demos.read.quantities import DIMENSIONS
from hrc_learn.demos.read.source import DemonstrationSource
from hrc_learn.demos.read.units import UnitDecision, unit_factor
from hrc_learn.kinematics import Arm, ArmChoice
from hrc_learn.kinematics.registry import arm_of_robot

# Opening of the Franka hand [m].
_FRANKA_WIDTH = 0.08


@dataclass(frozen=True)
class DatasetArm:
    """The arm of a dataset. It converts the dataset's joint and gripper values."""

    arm: Arm
    columns: tuple[int, ...]
    """For each joint of the arm, its column among the dataset's joints."""
    joints: UnitDecision
    """Unit of the dataset's joints."""
    gripper: UnitDecision | None = None
    """Unit of the dataset's gripper."""

    def positions(
        self, values: Float64[np.ndarray, "frames _columns"]
    ) -> Float64[np.ndarray, "frames joints"]:
        """Joint positions of the arm [rad], from the joint values of a demonstration.

        Fractions of a joint's range, such as LeRobot's -100 to 100, are mapped to the arm's
        joint limits. For encoder ticks, the middle of a turn becomes angle zero.
        """
        lower, upper = self.arm.limits.lower.numpy(), self.arm.limits.upper.numpy()
        chosen = values[:, self.columns].copy()
        for joint, column in enumerate(self.columns):
            unit = self.joints.unit_of(column)
            if unit in ("%", "1"):
                middle, half = (lower + upper) / 2, (upper - lower) / 2
                chosen[:, joint] = middle[joint] + half[joint] * chosen[:, joint]
            elif unit == "tick":
                chosen[:, joint] -= math.pi
        return chosen

    def opening(self, demo: Demonstration) -> Float64[np.ndarray, " frames"] | None:
        """Opening of the gripper, 0 (closed) to 1; None if it was not recorded."""
        if demo.gripper is None or self.gripper is None:
            return None
        if self.gripper.unit in ("%", "1"):
            return np.clip(demo.gripper, 0.0, 1.0)
        fingers = [f for f in self.arm.shape.gripper if f.kind == "prismatic"]
        travel = sum(abs(f.opened - f.closed) for f in fingers)
        width = _FRANKA_WIDTH if self.arm.is_franka else travel
        width *= self.gripper.si_unit == "m"  # the largest angle counts as open
        return np.clip(demo.gripper / (width or max(demo.gripper.max(), 1e-9)), 0.0, 1.0)


def arm_of_dataset(source: DemonstrationSource, robot: str = "") -> DatasetArm:
    """The arm of a dataset's demonstrations.

    Joints are found by their names. If this fails, they are taken in order, provided that the
    dataset has as many joints as the arm.

    Args:
        source: The opened dataset.
        robot: Arm as in `ArmChoice.name`; if empty, the dataset's `robot_type` names it.

    Raises:
        DatasetError: The robot type is no registered arm, the dataset has no joint positions,
            or its joints are not the arm's.
        ValueError: `robot` names no arm.
    """
    kind = source.folder.robot_type
    arm = ArmChoice(robot).arm() if robot else arm_of_robot(kind)
    if "joint_position" not in source.units:
        raise DatasetError(f"{source.folder.root}: no column of joint positions (JOINT.pos)")
    if arm is None:
        text = f"robot type {kind!r} is no registered and installed arm"
        raise DatasetError(f"{text}; --robot NAME|FILE names one")
    return DatasetArm(
        arm=arm,
        columns=arm_columns(source.joint_names, arm),
        joints=source.units["joint_position"],
        gripper=source.units.get("gripper"),
    )


_MEASURED = "joint_position"
_MOTIONS = {"measured": _MEASURED, "commanded": "command_position"}


class Chart(NamedTuple):
    """Curves over time of one quantity."""

    key: str
    """Short name, such as joint_0."""
    title: str
    unit: str
    """Unit of the values; empty if they have none."""
    lines: Mapping[str, Float[np.ndarray, " frames"]]
    """Values by the name of the curve."""


def own_unit(units: Mapping[str, UnitDecision], role: str, column: int) -> tuple[str, float]:
    """Unit of a column in the dataset, and the factor that converts its values to SI units."""
    decision = units.get(role)
    if decision is None:
        return ("m" if role == "gripper" else "rad"), 1.0
    unit = decision.unit_of(column)
    return unit, unit_factor(role, unit)


def demonstration_charts(
    demo: Demonstration, units: Mapping[str, UnitDecision]
) -> Iterator[Chart]:
    """Charts of the joints, the gripper, the tool, the image feature and the person's effort.

    Args:
        demo: The demonstration.
        units: Quantity -> its unit in the dataset.
    """
    for k, joint in enumerate(demo.joint_names):
        charts: dict[tuple[bool, bool], tuple[str, float, dict[str, Any]]] = {}
        for name, role in _MOTIONS.items():
            if (values := getattr(demo, role)) is not None:
                unit, factor = own_unit(units, role if role in units else _MEASURED, k)
                # Commands of the same quantity are shown in the unit of the measured joint.
                kind = unit in DIMENSIONS["ratio"], unit.endswith("/step")
                unit, factor, lines = charts.setdefault(kind, (unit, factor, {}))
                lines[name] = values[:, k] / factor
        keys = f"joint_{k}", f"command_{k}"
        for key, (unit, _, lines) in zip(keys, charts.values(), strict=False):
            yield Chart(key, joint, unit, lines)
    if demo.gripper is not None:
        unit, factor = own_unit(units, "gripper", 0)
        lines = {"opening": demo.gripper.reshape(len(demo)) / factor}
        yield Chart("gripper", "Gripper", unit.replace("1", ""), lines)
    feature = demo.feature
    if feature is not None and demo.feature_visible is not None:
        feature = np.where(demo.feature_visible[:, None], feature, np.nan)
    for key, title, unit, names, values in (
        ("position", "Tool centre point", "m", "xyz", demo.position),
        ("feature", "Feature in the image", "px", ("u (right)", "v (down)"), feature),
        ("effort", "Effort of the person", "N m", demo.joint_names, demo.human_effort),
    ):
        if values is not None:
            yield Chart(key, title, unit, dict(zip(names, values.T, strict=True)))
