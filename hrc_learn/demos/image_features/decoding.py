"""Images of one episode, decoded from its video."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import UInt8

from ..finding import DatasetError
from ..video_segment import VideoSegment


def decode(
    segment: VideoSegment, fps: float
) -> Iterator[tuple[int, UInt8[np.ndarray, "height width 3"]]]:
    """Images (RGB) with the frames of the episode they belong to, in order.

    Args:
        segment: Where they lie.
        fps: Frame rate of the dataset [1/s].

    Raises:
        DatasetError: The file is no video that can be decoded.
    """
    import av

    half_period = 0.5 / fps
    try:
        with av.open(str(segment.file)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            if segment.start > 0 and stream.time_base is not None:
                # To the key frame before; what lies between is decoded and left out.
                container.seek(int(segment.start / stream.time_base), stream=stream)
            for image in container.decode(stream):
                time = float(image.time or 0.0)
                if time > segment.stop - half_period:
                    return
                if time > segment.start - half_period:
                    yield round((time - segment.start) * fps), image.to_ndarray(format="rgb24")
    except (av.FFmpegError, IndexError) as error:
        raise DatasetError(
            f"cannot be decoded ({error}): the recording was broken off, or the copy is "
            f"incomplete",
            file=segment.file,
        ) from error
