"""An episode at the frames of a regular grid."""

from dataclasses import replace
from typing import Any

import numpy as np

from ..demonstration import Demonstration
from ..frames import RawFrames
from ..poses import to_quaternion
from ..preparation import resample
from ..preparation.resampling import nearest_frames
from .draft import Draft, Meaning

_SMOOTH = ("joint_position", "joint_velocity", "position")


def regrid(draft: Draft, meaning: Meaning, fps: float | int) -> Draft:
    """Resample every column, as `preparation.resample` does.

    Rotation vectors and Euler angles are interpolated as they are: unwrap them first.

    Raises:
        DatasetError: The stamps do not increase, or the episode is shorter than a period, or
            holds transforms, which cannot be interpolated by their entries.
    """
    quantities = draft.quantities(meaning)
    if "pose_matrix" in quantities:
        raise draft.bad(
            "holds poses as matrices, which are not resampled; map them away "
            "(mapping={'pose_matrix': None}) or leave the frames as they are (no fps)",
            key="pose_matrix",
        )
    fields: dict[str, Any] = {role: quantities[role] for role in _SMOOTH if role in quantities}
    role = next((role for role in quantities if role.startswith("quaternion")), "")
    try:
        if role:
            fields["orientation"] = to_quaternion(role, quantities[role])
        demo = Demonstration(
            time=draft.time - draft.time[0],
            joint_names=meaning.matching.joint_names,
            fps=fps,
            extra={key: values.astype(float) for key, values in draft.frames.items()},
            **fields,
        )
        moved = resample(demo, fps)
    except ValueError as error:
        raise draft.bad(str(error)) from error
    columns: RawFrames = dict(moved.extra)
    for name in fields:
        values = getattr(moved, name)
        if name == "orientation" and role == "quaternion_xyzw":
            values = np.roll(values, -1, axis=1)
        taken = meaning.matching.selections[role if name == "orientation" else name].columns
        for number, (key, index) in enumerate(taken):
            columns[key][:, index] = values[:, number]
    nearest = nearest_frames(demo.time, np.minimum(moved.time, demo.time[-1]))
    for key, values in draft.frames.items():
        if values.dtype.kind not in "f":
            columns[key] = values[nearest]
    return replace(
        draft,
        frames=columns,
        time=moved.time + draft.time[0],
        kept=None,
        changes=(
            *draft.changes,
            f"resampled {len(draft)} frames to {len(moved)} at {fps:g} Hz",
        ),
    )
