"""What a repair may change."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class RepairOptions:
    """What a repair may change. All of it happens in a copy."""

    trim: bool = True
    """Cut off standing still before and after the motion."""
    keep_rest: float | int = 0.1
    """Standing still that is left at either end [s]."""
    drop_repeats: bool = True
    """Drop frames that repeat the one before for up to 0.1 s, and those stamped no later."""
    unwrap: bool = True
    """Take whole turns out of joints and angles that jump by one."""
    fix_signs: bool = True
    """Choose the signs of quaternions so that they do not jump."""
    drop_bad_frames: bool = False
    """Drop frames with values that are not finite."""
    drop_bad_episodes: bool = False
    """Leave out episodes that cannot be read or repaired."""
    fps: float | int | None = None
    """Resample to a regular grid of this rate [1/s]; None leaves the frames as they are."""
    videos: bool = True
    """Keep the videos. Frames dropped in the middle and resampling would need new ones."""

    def __post_init__(self) -> None:
        if self.fps is not None and not self.fps > 0:
            raise ValueError(f"fps must be positive, got {self.fps}")
        if self.keep_rest < 0:
            raise ValueError(f"keep_rest must not be negative, got {self.keep_rest}")
