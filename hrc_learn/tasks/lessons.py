"""Demonstrations of the Panda as a LeRobot dataset."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from ..demos import DatasetWriter
from ..kinematics import panda
from ..output import replacing
from .teaching import Frame


def write_lessons(
    path: Path,
    lessons: Iterable[Sequence[Frame]],
    task: str,
    fps: float,
    *,
    features: Mapping[str, Sequence[str]] | None = None,
    details: Mapping[str, object] | None = None,
    overwrite: bool = False,
) -> None:
    """Write demonstrations, one episode each, as they come.

    Args:
        path: Folder of the dataset.
        lessons: Frames of each demonstration.
        task: What is shown, in words.
        fps: Frames a second.
        features: Columns beyond the usual ones: key, and names of the components.
        details: Anything else worth keeping with the dataset.
        overwrite: Replace an older dataset in that folder.

    Raises:
        FileExistsError: If there is something at `path` that may not be replaced.
    """
    with (
        replacing(path, "meta/info.json", overwrite) as folder,
        DatasetWriter(
            folder,
            fps=fps,
            robot_type="panda",
            joint_names=panda.joint_names,
            features=features,
            frames={"base": "panda_link0", "ee": "panda_hand_tcp"},
            details=details,
        ) as writer,
    ):
        for frames in lessons:
            writer.start_episode(task)
            for frame in frames:
                writer.add_frame(images=None, **frame)
            writer.save_episode()
