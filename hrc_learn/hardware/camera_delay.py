"""Delay of a camera's images, measured by moving the robot.

A joint turns back and forth, and the position of its marker in the images lags behind the
joint. No calibration is needed: over such a small motion a pixel is a smooth function of one
joint position, which is fitted for each candidate delay. The delay with the smallest residual
is the camera's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from hrc_learn.hardware.opencv_cameras import CameraError
from hrc_learn.protocols import Arm, Camera, TimedCamera
from hrc_learn.vision import MarkerDetector, centre

# Rates at which the joint turns back and forth at the beginning and at the end [Hz]: of one
# rate alone delays that are a period apart would fit alike.
_SLOWEST, _FASTEST = 0.4, 1.0
# Fastest turn [rad/s]: of a hand at 0.5 m, 75 mm/s, by 3 cm to each side.
_SPEED = 0.15
# Time from one reading of arm and camera to the next, and the longest delay looked for [s].
_DT, _LONGEST = 0.01, 0.5
# Powers of the joint position in the fit of a pixel: perspective bends its line.
_POWERS = 3
# Between the delays that are tried [s]; the smallest rest is found between them.
_STEP = 2e-3
# Fewest images, and smallest explained fraction of the pixels' motion, for a valid delay.
_FEWEST, _EXPLAINED = 30, 0.9
# Decay rate of the way back to where the joint was, what is left of it, and the longest that it
# may take [1/s, rad, s].
_RETURN, _BACK, _LONGEST_WAY_BACK = 2.0, 1e-3, 3.0


def turning_velocity(passed: float, duration: float) -> float:
    """Joint velocity some time after the start [rad/s]: rising frequency, smooth at both ends.

    Args:
        passed: Time since the start [s].
        duration: Duration of the whole motion [s].
    """
    progress = passed / duration
    turns = passed * (_SLOWEST + 0.5 * (_FASTEST - _SLOWEST) * progress)
    gentle = min(1.0, 8 * progress, 8 * (1 - progress))
    return _SPEED * gentle * math.sin(2 * math.pi * turns)


@dataclass(frozen=True, kw_only=True)
class MeasuredDelay:
    """A measured camera delay."""

    delay: float
    """Time between exposure and reading of an image [s], without the age that the camera
    reports.
    """
    deviation: float
    """Standard deviation of the delay, by the rest of the fit [s]."""
    images: int
    """In which the marker was seen."""


def measure_delay(
    arm: Arm,
    camera: Camera,
    marker: int,
    *,
    advance: Callable[[float], None],
    joint: int = 1,
    duration: float = 8.0,
) -> MeasuredDelay:
    """Measure a camera's delay by moving the arm in front of it; it ends where it began.

    What is measured belongs into the camera's `delay`, and with it into
    `LatencyConfig(delay=...)` of the work cell.

    Args:
        arm: Moves a marker, alone: nothing else may move the camera or the marker.
        camera: Looks at it, from anywhere.
        marker: ArUco number on the arm.
        advance: Lets a given time pass [s].
        joint: Joint that turns, counted from 1; its motion must move the marker across the
            image. Obstacles in the way are not considered.
        duration: Duration of the motion [s].

    Raises:
        ValueError: The arm has no such joint, or the duration is not positive.
        CameraError: The marker is hardly seen, does not move with the joint, or the delay is
            longer than looked for.
    """
    home = arm.read().joint_position
    if not 1 <= joint <= len(home):
        raise ValueError(f"joint must be one of 1 to {len(home)}, but is {joint}.")
    if not duration > 0:
        raise ValueError(f"duration must be positive, but is {duration}.")
    detector, turned = MarkerDetector([marker]), np.eye(len(home))[joint - 1]
    times, positions, taken, pixels, last = [], [], [], [], None
    try:
        for k in range(round(duration / _DT)):
            arm.command(turning_velocity(k * _DT, duration) * turned)
            advance(_DT)
            state = arm.read()
            times.append(state.time)
            positions.append(float(turned @ state.joint_position))
            image = camera.read()
            # An image that is read again is no new one.
            if last is not None and np.array_equal(image, last):
                continue
            last, seen = image, detector.detect(image).get(marker)
            if seen is not None:
                age = camera.age if isinstance(camera, TimedCamera) else 0.0
                taken.append(state.time - age)
                pixels.append(centre(seen))
        for _ in range(round(_LONGEST_WAY_BACK / _DT)):
            velocity = _RETURN * turned * (home - arm.read().joint_position)
            if np.abs(velocity).max() < _RETURN * _BACK:
                break
            arm.command(velocity)
            advance(_DT)
    finally:
        arm.command(0 * home)
    if len(taken) < _FEWEST:
        raise CameraError(
            f"the camera saw marker {marker} in {len(taken)} different images, and at least "
            f"{_FEWEST} are needed: put the arm where it is seen, and light it."
        )
    return fit_delay(
        np.array(times), np.array(positions), np.array(taken), np.array(pixels), _LONGEST
    )


def fit_delay(
    time: Float[np.ndarray, " readings"],
    position: Float[np.ndarray, " readings"],
    taken: Float[np.ndarray, " images"],
    pixel: Float[np.ndarray, "images 2"],
    longest: float,
) -> MeasuredDelay:
    """The delay by which pixels follow a joint.

    Args:
        time: Of the readings of the joint [s].
        position: Of the joint [rad].
        taken: When each image is believed to have been taken [s].
        pixel: Of the marker in it [px].
        longest: Delay tried [s].

    Raises:
        CameraError: The pixels do not follow the joint, or later than that.
    """
    # Of images of before the first reading nothing is known.
    known = taken - longest >= time[0]
    taken, pixel = taken[known], pixel[known]
    delays = np.arange(-1, math.ceil(longest / _STEP) + 1) * _STEP
    rest = np.array(
        [_rest(np.interp(taken - delay, time, position), pixel) for delay in delays]
    )
    k = int(rest.argmin())
    whole = ((pixel - pixel.mean(axis=0)) ** 2).sum()
    if not rest[k] < (1 - _EXPLAINED) * whole:
        raise CameraError(
            f"the marker does not follow the joint: {100 * (1 - rest[k] / whole):.0f} % of its "
            "motion in the image is explained. Does the camera stand still, and is the marker "
            "on the arm?"
        )
    if not 0 < k < len(delays) - 1:
        raise CameraError(
            f"the delay is not between 0 and {longest:g} s: look for a longer one, or see "
            "whether the arm's clock is that of its readings."
        )
    # A parabola through the smallest rest and its neighbours.
    bend = rest[k - 1] - 2 * rest[k] + rest[k + 1]
    between = 0.5 * (rest[k - 1] - rest[k + 1]) / bend
    variance = rest[k] / (2 * len(pixel) - 2 * (_POWERS + 1) - 1)
    return MeasuredDelay(
        delay=float(delays[k] + _STEP * between),
        # Of least squares: the inverse of half the curvature, times the variance of a pixel.
        deviation=float(np.sqrt(2 * variance / bend) * _STEP),
        images=len(pixel),
    )


def _rest(
    position: Float[np.ndarray, " images"], pixel: Float[np.ndarray, "images 2"]
) -> float:
    """Squared distances of pixels from a polynomial of the joint's position [px^2]."""
    centred = position - position.mean()
    powers = np.vander(centred / max(float(np.abs(centred).max()), 1e-9), _POWERS + 1)
    fitted, *_ = np.linalg.lstsq(powers, pixel, rcond=None)
    return float(((pixel - powers @ fitted) ** 2).sum())
