"""A run as one Rerun recording: the robot in 3D, what its camera saw, and every curve."""

import os

from .recording import RunRecording
from .rerun_file import rrd_file
from .run_stream import RunStream


def record_run(
    path: str | os.PathLike[str], run: RunRecording, *, image_quality: int = 75
) -> None:
    """Write a run as an .rrd file with its layout; `rerun FILE` shows it.

    Args:
        path: File to write; it appears only when complete.
        run: What happened. Panels without data are left out.
        image_quality: Of the JPEG images, 1 to 95.
    """
    with rrd_file(path, run.title) as stream:
        RunStream(stream, image_quality=image_quality).send(run)
