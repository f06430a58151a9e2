"""Curves of a demonstration in the units of its dataset, as dashboard and curation page show
them.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from hrc_learn.demos.demonstration import Demonstration
from hrc_learn.demos.read.units import UnitDecision, unit_factor

_MOTIONS = {"measured": "joint_position", "commanded": "command_position"}


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
    """Unit of a column in the dataset, and the factor from it to the reader's unit."""
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
        units: Units in the dataset by quantity.
    """
    for k, joint in enumerate(demo.joint_names):
        lines = {
            name: values[:, k] / own_unit(units, role, k)[1]
            for name, role in _MOTIONS.items()
            if (values := getattr(demo, role)) is not None
        }
        if lines:
            yield Chart(f"joint_{k}", joint, own_unit(units, "joint_position", k)[0], lines)
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
