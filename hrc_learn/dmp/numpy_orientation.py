"""Errors of orientations in NumPy, one at a time, for loops that count microseconds."""

import numpy as np
from jaxtyping import Float64

Vector = Float64[np.ndarray, "3"]
Quaternion = Float64[np.ndarray, "4"]

SMALL = 1e-3
"""Angles [rad] below which the next term of a series is lost in rounding."""
SINGULAR = 1e-3
"""Share of an angular velocity that still counts as rate of the error: below it, one whole turn
away, the inverse would blow the rest up a thousand times."""
NO_AXIS = 1e-9
"""Rotation vectors shorter than this [rad] have no direction of their own."""


def multiply(p: Quaternion, q: Quaternion) -> Quaternion:
    """Hamilton product."""
    a, b, c, d = p
    w, x, y, z = q
    return np.array(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ]
    )


def exp(v: Vector) -> Quaternion:
    """Unit quaternion of a rotation vector [rad]."""
    half = 0.5 * float(np.sqrt(v @ v))
    sinc = np.sin(half) / half if half > SMALL else 1 - half**2 / 6 + half**4 / 120
    return np.array([np.cos(half), *(0.5 * sinc * v)])


def log(q: Quaternion) -> Vector:
    """Rotation vector of the shortest rotation [rad]; at half a turn as `quaternion.log`."""
    sign = np.sign(q) @ [8.0, 4.0, 2.0, 1.0]
    w, v = np.sign(sign) * q[0], np.sign(sign) * q[1:]
    sine = float(np.sqrt(v @ v))
    if sine < SMALL:
        # 2 atan(x) / sine with x = sine / w, of a unit quaternion.
        x = sine / w
        return 2 / w * (1 - x**2 / 3 + x**4 / 5) * v
    return 2 * np.arctan2(sine, w) / sine * v


def to_orientation(error: Vector, goal: Quaternion) -> Quaternion:
    """Orientation that differs from the goal by this error."""
    return multiply(exp(-error), goal)


def to_error(q: Quaternion, goal: Quaternion) -> Vector:
    """Shortest error of an orientation to the goal [rad]."""
    return log(multiply(goal, q * [1.0, -1.0, -1.0, -1.0]))


def reference_of(error: Vector, orientation: Quaternion) -> Quaternion:
    """The reference to which an orientation, of any length, has this error."""
    return multiply(exp(error), orientation / np.sqrt(orientation @ orientation))


def velocity_map(error: Vector) -> Float64[np.ndarray, "3 3"]:
    """Maps the rate of an error to the angular velocity of the orientation.

    omega = -J(-e) e', J the left Jacobian of the rotation group, J(v) = I + (1 - cos t) / t^2
    [v] + (t - sin t) / t^3 [v]^2, t = |v| (Sola et al. 2018, "A micro Lie theory", eq. 145).
    """
    square = float(error @ error)
    angle = square**0.5
    # Two terms of each series: the next is below 1e-13 at this angle.
    if angle < 20 * SMALL:
        first = 0.5 - square / 24 + square**2 / 720
        second = 1 / 6 - square / 120 + square**2 / 5040
    else:
        # Half angles: 1 - cos cancels for small ones.
        first = 2 * (np.sin(angle / 2) / angle) ** 2
        second = (angle - np.sin(angle)) / (angle * square)
    cross = skew(error)
    return first * cross - second * (cross @ cross) - np.eye(3)


def angular_velocity(error: Vector, rate: Vector) -> Vector:
    """Angular velocity in the base frame, of an error and its rate."""
    return velocity_map(error) @ rate


def error_rate(error: Vector, velocity: Vector) -> Vector:
    """Rate of an error, of an angular velocity: the inverse of `angular_velocity`.

    Whole turns away the error has a rate about its own axis only.
    """
    square = float(error @ error)
    half = square**0.5 / 2
    sinc = np.sin(half) / half if half > SMALL else 1.0
    if abs(sinc) < SINGULAR:
        return -(error @ velocity) / square * error
    # The closed form cancels below: two terms of its series are exact to 1e-11 there.
    near = half < 10 * SMALL
    share = 1 / 12 + square / 720 if near else (1 - np.cos(half) / sinc) / square
    cross = skew(error)
    across = cross @ velocity
    return -velocity - 0.5 * across - share * (cross @ across)


def skew(v: Vector) -> Float64[np.ndarray, "3 3"]:
    """The matrix [v] with [v] u = v x u."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def retarget(
    error: Vector, rate: Vector, old_goal: Quaternion, goal: Quaternion
) -> tuple[Vector, Vector]:
    """Error to a new goal and its rate, for the same orientation and angular velocity."""
    new = nearest_turn(to_error(to_orientation(error, old_goal), goal), error)
    return new, error_rate(new, angular_velocity(error, rate))


def nearest_turn(error: Vector, reference: Vector) -> Vector:
    """The same rotation as `error`, with the whole turns that bring it closest to another."""
    axis = error if np.sqrt(error @ error) > NO_AXIS else reference
    axis = axis / max(np.sqrt(axis @ axis), NO_AXIS)
    turns = np.round((reference - error) @ axis / (2 * np.pi))
    return error + 2 * np.pi * turns * axis
