"""From quantities in the units on disk to a `Demonstration`."""

from collections.abc import Mapping

import numpy as np

from .demonstration import JOINT_FIELDS, Demonstration
from .episode_reader import RawEpisode
from .finding import DatasetError
from .frames import RawFrames
from .layout import DatasetFolder, EpisodeEntry
from .matching import Matching
from .poses import matrix_position, to_quaternion
from .quantities import Quantities
from .roles import ORIENTATION_ROLES
from .stamps import stamps
from .units import UnitDecision


def to_demonstration(
    folder: DatasetFolder,
    episode: RawEpisode,
    matching: Matching,
    decisions: Mapping[str, UnitDecision],
) -> Demonstration:
    """Convert one episode.

    Raises:
        DatasetError: Its stamps do not increase, or its orientations are none.
    """
    entry, frames, quantities = episode.entry, episode.frames, episode.quantities
    scaled = {
        role: values if decisions[role].factor == 1 else values * decisions[role].factor
        for role, values in quantities.items()
    }
    time = stamps(folder, entry, frames, scaled.get("time"))
    fields = {role: scaled[role] for role in JOINT_FIELDS if role in scaled}
    fields |= {role: scaled[role] for role in ("position", "feature") if role in scaled}
    if "gripper" in scaled:
        fields["gripper"] = scaled["gripper"][:, 0]
    if "feature_visible" in scaled:
        fields["feature_visible"] = scaled["feature_visible"][:, 0] > 0
    return Demonstration(
        time=time - time[0],
        start_time=float(time[0]),
        fps=folder.fps,
        episode=entry.index,
        task=_task(folder, entry, frames),
        joint_names=matching.joint_names,
        extra={key: frames[key].astype(float) for key in matching.extra},
        **fields | _pose(entry, quantities, scaled, decisions),
    )


def _pose(
    entry: EpisodeEntry,
    quantities: Quantities,
    scaled: Quantities,
    decisions: Mapping[str, UnitDecision],
) -> dict[str, np.ndarray]:
    """Orientation and, from a transform, position."""
    role = next((role for role in ORIENTATION_ROLES if role in quantities), None)
    if role is None:
        return {}
    try:
        if role != "pose_matrix":
            return {"orientation": to_quaternion(role, scaled[role])}
        # Of a transform only the translation has a unit.
        orientation = to_quaternion(role, quantities[role])
        if "position" in scaled:
            return {"orientation": orientation}
        position = matrix_position(quantities[role]) * decisions[role].factor
        return {"orientation": orientation, "position": position}
    except ValueError as error:
        raise DatasetError(
            str(error), file=entry.file, episode=entry.index, key=role
        ) from error


def _task(folder: DatasetFolder, entry: EpisodeEntry, frames: RawFrames) -> str:
    if entry.tasks:
        return entry.tasks[0]
    if "task_index" in frames:
        return folder.tasks.get(int(frames["task_index"][0, 0]), "")
    return ""
