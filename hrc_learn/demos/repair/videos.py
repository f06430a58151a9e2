"""Images of repaired episodes: the parts of the old videos that show what is left."""

import numpy as np

from ..video_segment import Segments, VideoSegment
from .draft import Draft


def cut_segments(draft: Draft, segments: Segments, fps: float) -> Segments:
    """The images of those frames that are left.

    Raises:
        DatasetError: They are not in one piece.
    """
    if not segments:
        return {}
    if draft.kept is None or (np.diff(draft.kept) != 1).any():
        raise draft.bad(
            "its videos would have to be encoded anew, because frames were dropped in the "
            "middle or resampled: leave the videos out (videos=False), or the frames as they "
            "are (drop_repeats=False, drop_bad_frames=False, fps=None)"
        )
    first, count = int(draft.kept[0]), len(draft.kept)
    return {
        key: VideoSegment(
            file=segment.file,
            start=segment.start + first / fps,
            stop=segment.start + (first + count) / fps,
        )
        for key, segment in segments.items()
    }
