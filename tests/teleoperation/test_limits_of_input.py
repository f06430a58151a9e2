"""Thresholds of touch, recordings and devices, with cases at both sides of each."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import torch

from hrc_learn.geometry import quaternion
from hrc_learn.kinematics import panda
from hrc_learn.protocols import ArmState, Feedback
from hrc_learn.teleoperation import Touch
from hrc_learn.teleoperation.demonstration_recorder import RecordingQuality, pressed
from hrc_learn.teleoperation.devices import KeyboardState, deflection, rumble_strength
from hrc_learn.teleoperation.page_scene import box_edges
from hrc_learn.teleoperation.region_editor import meet_box, meet_plane, region_over, view_ray
from hrc_learn.teleoperation.touch import (
    Explanation,
    TorqueBias,
    TouchConfig,
    touched_place,
)

pytestmark = pytest.mark.simulation

READY = panda.ready
JACOBIAN = panda.jacobian(READY).numpy()


def filtered(bias, rows):
    """States and covariances of the textbook's filter, in its own words."""
    x, P = bias.state.copy(), np.diag(np.repeat([5.0, 1.0, 0.5], (1, 7, 7)) ** 2)
    drift = np.diag(np.repeat([0.3, 0.1, 0.03], (1, 7, 7)) ** 2)
    for jacobian, velocity, torque, dt in rows:
        H = np.hstack([-jacobian[2][:, None], np.eye(7), -np.diag(np.tanh(velocity / 0.02))])
        P = P + drift * dt
        friction = x[8:] / np.cosh(velocity / 0.02)
        R = np.diag(0.3**2 + (0.7 * friction) ** 2) * max(0.1 / dt, 1.0)
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x = x + K @ (torque - H @ x)
        P = (np.eye(15) - K @ H) @ P
    return x, P


@pytest.mark.parametrize("dt", [0.01, 0.1, 0.5])
def test_the_bias_is_that_of_a_kalman_filter(dt):
    rng = np.random.default_rng(0)
    bias, rows = TorqueBias(7, 0.3), []
    for _ in range(6):
        q = READY + 0.3 * torch.from_numpy(rng.normal(size=7))
        row = panda.jacobian(q).numpy(), 0.03 * rng.normal(size=7), rng.normal(size=7), dt
        rows.append(row)
    state, covariance = filtered(bias, rows)
    for row in rows:
        bias.follow(*row)
    np.testing.assert_allclose(bias.state, state, atol=1e-8)
    jacobian, velocity = JACOBIAN, 0.01 * np.arange(7)
    H = np.hstack([-jacobian[2][:, None], np.eye(7), -np.diag(np.tanh(velocity / 0.02))])
    expected, unknown = bias.expected(jacobian, velocity)
    np.testing.assert_allclose(expected, H @ state, atol=1e-8)
    friction = state[8:] / np.cosh(velocity / 0.02)
    noise = np.diag(0.09 + (0.7 * friction) ** 2)
    np.testing.assert_allclose(unknown, H @ covariance @ H.T + noise, atol=1e-7)


def force(size, evidence):
    return Explanation(force=np.array([0.0, size, 0.0]), evidence=evidence)


@pytest.mark.parametrize(
    ("before", "above", "hand", "none", "place"),
    [
        # From nothing: evidence of more than 16, and 7 N at the elbow or 10 N at the hand.
        ("nothing", (7.1, 20), (9, 10), 0, "elbow"),
        ("nothing", (6.9, 20), (9, 10), 0, "nothing"),
        ("nothing", (7.1, 15.9), (9, 10), 0, "nothing"),
        ("nothing", (7.1, 16.1), (9, 10), 0, "elbow"),
        ("nothing", (9, 17.9), (10.1, 20), 0, "hand"),
        ("nothing", (9, 18.1), (10.1, 20), 0, "nothing"),  # not sure enough which
        ("nothing", (9, 10), (9.9, 20), 0, "nothing"),
        ("nothing", (9, 10), (10.1, 15.9), 0, "nothing"),
        ("nothing", (9, 25), (10.1, 30), 15, "nothing"),
        # Half of the force is enough once it is touched, at least as likely as nothing.
        ("elbow", (3.6, 5), (1, 1), 4.9, "elbow"),
        ("elbow", (3.4, 5), (1, 1), 4.9, "nothing"),
        ("elbow", (3.6, 5), (1, 1), 5.1, "nothing"),
        ("elbow", (9, 30), (20, 37.9), 0, "elbow"),
        ("elbow", (9, 30), (20, 38.1), 0, "hand"),
        ("hand", (1, 1), (5.1, 5), 4.9, "hand"),
        ("hand", (1, 1), (4.9, 5), 4.9, "nothing"),
        ("hand", (9, 37.9), (5.1, 30), 0, "hand"),
        ("hand", (9, 38.1), (5.1, 30), 0, "elbow"),
    ],
)
def test_where_the_arm_is_touched(before, above, hand, none, place):
    assert touched_place(before, force(*above), force(*hand), none, TouchConfig()) == place


def reading(time, torque=None, width=0.08):
    return ArmState(
        time=time,
        joint_position=READY.numpy(),
        joint_velocity=np.zeros(7),
        gripper_width=width,
        external_torque=np.zeros(7) if torque is None else torque,
    )


def held_for(seconds, size, touch=None, dt=0.01):
    """Inputs of an arm that is pushed at the hand, after a second at rest."""
    touch = touch or Touch(panda)
    asked = {}
    torque = JACOBIAN[:3].T @ np.array([0.0, 0.0, -size])
    for k in range(round((1 + seconds + 1) / dt)):
        t = round(k * dt, 6)
        asked[t] = touch.read(reading(t, torque if 1 <= t < 1 + seconds else None))
    return asked


def test_a_task_resumes_a_while_after_the_hand_is_released():
    asked = held_for(1.0, 20.0)
    paused = [t for t, one in asked.items() if one.pause]
    assert 1.0 <= paused[0] < 1.15
    # Smoothed torques fall to half of the threshold, then 0.4 s pass.
    assert 2.4 <= paused[-1] < 2.55
    assert not any(one.pause for one in held_for(1.0, 5.0).values())


ELBOW = panda.joint_jacobian(READY, 4).numpy()[:3]
HAND = JACOBIAN[:3]


def felt(torques, touch=None, **state):
    """Touch and its inputs, for torques that follow each other by 10 ms after a second."""
    touch = touch or Touch(panda)
    for k in range(100):
        touch.read(reading(0.01 * k))
    return touch, [
        touch.read(replace(reading(1 + 0.01 * k, torque), **state))
        for k, torque in enumerate(torques)
    ]


@pytest.mark.parametrize(("rows", "place"), [(ELBOW, "elbow"), (HAND, "hand")])
def test_a_push_is_found_at_its_place_with_its_force(rows, place):
    push = np.array([15.0, -10.0, 5.0])
    touch, _ = felt([rows.T @ push] * 40)
    assert touch.place == place
    np.testing.assert_allclose(touch.force, push, atol=3)  # the prior pulls
    touch, _ = felt([rows.T @ push] * 40 + [np.zeros(7)] * 40)
    assert touch.place == "nothing"
    assert not touch.force.any()


@pytest.mark.parametrize(("size", "whole"), [(10.5, False), (13.0, False), (25.0, True)])
def test_the_null_space_follows_from_the_dead_band_to_twice_of_it(size, whole):
    # A strong push first: then half of the dead band is felt.
    way = ELBOW.T @ np.array([0.8, -0.53, 0.27])
    pushes = [s * way for s in [25.0] * 40 + [size] * 60]
    touch, asked = felt(pushes)
    assert touch.place == "elbow"
    gain = 2 * min(np.linalg.norm(touch.force) / 7 - 1, 1)
    assert 0.5 < gain < 1.8 or whole
    null = scipy.linalg.null_space(JACOBIAN)
    expected = gain * null @ (null.T @ pushes[-1])
    # The bias has taken a few per cent of the torques before the touch was sure.
    np.testing.assert_allclose(asked[-1].nullspace_input, expected, rtol=0.06, atol=1e-9)


@pytest.mark.parametrize(
    ("moved", "meets"), [(0.9e-4, False), (1.1e-4, True), (-1.1e-4, True), (0.01, True)]
)
def test_fingers_that_move_may_touch_their_object_for_half_a_second(moved, meets):
    """A push at the hand, which then counts for nothing; the task resumes after 0.4 s."""
    push = HAND.T @ np.array([0.0, 0.0, -20.0])
    touch, _ = felt([push] * 50)
    paused = [
        touch.read(reading(1.5 + 0.01 * k, push, width=0.08 + moved)).pause for k in range(100)
    ]
    if meets:
        assert paused.index(False) in (39, 40)
        assert paused[45:].index(True) + 45 in (50, 51)
    else:
        assert all(paused)
    touch.tell(Feedback(contact_expected=True))
    asked = [
        touch.read(reading(2.5 + 0.01 * k, push, width=0.08 + moved)).pause for k in range(50)
    ]
    assert asked.index(False) in (39, 40)
    assert not any(asked[40:])


@pytest.mark.parametrize(
    ("sizes", "met"),
    [((0, 29), False), ((0, 34), True), ((20, 49), False), ((20, 56), True), ((60, 20), True)],
)
def test_a_change_that_no_hand_makes_stops_the_arm(sizes, met):
    """The change comes from one reading to the next; what came before rises slowly."""
    slow = np.arange(sizes[0] + 1).repeat(2)
    pushes = [size * HAND[1] for size in (*slow, *[sizes[0]] * 20, sizes[1])]
    _, asked = felt(pushes)
    assert not any(one.stop for one in asked[:-1])
    assert asked[-1].stop.startswith("something has hit the arm, with ") == met
    if met:
        number = float(asked[-1].stop.split("with ")[1].split()[0])
        assert number == pytest.approx(abs(sizes[1] - sizes[0]), abs=3)
    # Where the gripper meets its object there may be any change.
    touch = Touch(panda)
    touch.tell(Feedback(contact_expected=True))
    assert not any(one.stop for one in felt(pushes, touch)[1])


def test_a_rise_that_takes_longer_is_no_collision_and_one_ends_after_a_while():
    # Of 40 ms: 7 N in 10 ms make less than 30 N, 12 N make more.
    _, asked = felt([7.0 * min(k, 12) * HAND[1] for k in range(30)])
    assert not any(one.stop for one in asked)
    pushes = [12.0 * min(k, 7) * HAND[1] for k in range(20)] + [np.zeros(7)] * 60
    stops = [k for k, one in enumerate(felt(pushes)[1]) if one.stop]
    assert 3 <= stops[0] <= 4
    assert stops == [*range(stops[0], stops[-1] + 1)]
    # The fall at 20 is as sudden for 40 ms, then 0.4 s pass without a touch.
    assert 20 + 40 <= stops[-1] <= 20 + 4 + 40


def test_a_force_above_110_newtons_stops_the_arm_however_slowly_it_came():
    touch, sizes, stops = Touch(panda), [], []
    felt([], touch)
    for k in range(130):
        stops.append(touch.read(reading(1 + 0.01 * k, float(k) * HAND[1])).stop)
        sizes.append(np.linalg.norm(touch.force))
    first = next(k for k, stop in enumerate(stops) if stop)
    assert sizes[first - 1] <= 110 < sizes[first]
    assert stops[first] == f"something holds the arm with {sizes[first]:.0f} N"


def quality(stamps, states=None, arrivals=None, chain=None, fps=20, gripper=0.0, touching=()):
    made = RecordingQuality(fps, chain)
    stamps = np.asarray(stamps, float)
    states = np.zeros((len(stamps), 7)) if states is None else states
    arrivals = stamps if arrivals is None else arrivals
    for now, stamp, state in zip(arrivals, stamps, states, strict=True):
        made.add(now, stamp, state, gripper, touching)
    return made


STAMPS = np.arange(101) / 20


def ramp(first, last, size=1.0):
    """Joints that move from one frame to another."""
    s = np.clip((np.arange(101) - first) / (last - first), 0, 1)
    return size * s[:, None] * np.ones(7)


def test_a_demonstration_is_kept_from_before_its_motion_until_after_it():
    part = quality(STAMPS, ramp(40, 60)).moving()
    # 0.3 s before the first frame that has moved, 0.7 s after the last that has not arrived.
    assert (part.start, part.stop) == (41 - 6, 59 + 14 + 1)
    assert quality(STAMPS, ramp(40, 60, 0.0049)).moving() is None
    assert quality(STAMPS, ramp(40, 60, 0.0051)).moving() is not None
    early = quality(STAMPS, ramp(1, 95)).moving()
    assert (early.start, early.stop) == (0, 101)
    grips = RecordingQuality(20)
    for k, stamp in enumerate(STAMPS):
        grips.add(stamp, stamp, np.zeros(7), 0.08 * (k >= 50))
    assert (grips.moving().start, grips.moving().stop) == (44, 49 + 15)


@pytest.mark.parametrize(
    ("stamps", "states", "text"),
    [
        ([], None, "the demonstration has no frames"),
        (STAMPS, None, "the arm has not moved"),
        (STAMPS[:9], np.eye(9)[:, :7], "the arm has moved for 0.4 s only"),
        (STAMPS[:11], np.eye(11)[:, :7], ""),
    ],
)
def test_demonstrations_that_show_nothing(stamps, states, text):
    assert quality(stamps, states).worthless() == text


@pytest.mark.parametrize(
    ("missing", "text"),
    [
        ([], ""),
        ([10, 30, 50, 70, 90], ""),
        ([10, 30, 50, 70, 90, 95], "6 % of its frames are lost, up to 0.10 s in a row"),
        ([50, 51, 52], ""),
        ([50, 51, 52, 53], ""),
        ([50, 51, 52, 53, 54], "5 % of its frames are lost, up to 0.30 s in a row"),
    ],
)
def test_frames_that_are_missing(missing, text):
    """Of 101 frames five may be lost, and four at once."""
    stamps = np.delete(STAMPS, missing)
    assert quality(stamps).lost() == text
    assert quality(STAMPS[:1]).lost() == ""


def test_seconds_pace_and_late_frames():
    slow = quality(STAMPS, arrivals=STAMPS * 1.25)
    assert slow.seconds == pytest.approx(5)
    assert slow.pace == pytest.approx(0.8)
    assert quality([]).seconds == 0
    assert quality([3.0]).pace == 1
    arrivals = STAMPS.copy()
    arrivals[40:] += 0.06
    arrivals[70:] += 0.04
    found = quality(STAMPS, arrivals=arrivals).late(2.0)
    np.testing.assert_allclose(found, [0.11])
    assert len(quality(STAMPS, arrivals=arrivals).late(1.5)) == 2
    made = quality(STAMPS)
    made.clear()
    assert (made.seconds, made.states) == (0, [])


@pytest.mark.parametrize(
    ("distance", "frames", "told"),
    [(0.029, 11, True), (0.031, 11, False), (0.029, 10, False)],
)
@pytest.mark.parametrize("end", ["lower", "upper"])
def test_joints_at_their_limits_for_half_a_second(distance, frames, told, end):
    states = np.tile(READY.numpy(), (101, 1))
    sign = 1 if end == "lower" else -1
    states[20 : 20 + frames, 3] = getattr(panda.limits, end)[3].item() + sign * distance
    said = quality(STAMPS, states, chain=panda).met()
    seconds = frames / 20
    name = panda.joint_names[3]
    assert said == ([f"{name} was at its limit for {seconds:.1f} s"] if told else [])
    assert quality(STAMPS, states).met() == []


def test_the_longest_contacts_are_named():
    made = RecordingQuality(20)
    for k in range(10):
        names = [n for n, count in (("a", 2), ("b", 9), ("c", 5), ("d", 4)) if k < count]
        made.add(k / 20, k / 20, np.zeros(7), touching=names)
    assert made.met() == ["b for 0.45 s", "c for 0.25 s", "d for 0.20 s"]


@pytest.mark.parametrize(("size", "told"), [(59.0, False), (61.0, True)])
def test_the_arm_presses_with_more_than_60_newtons(size, told):
    torque = JACOBIAN[:3].T @ np.array([0.0, 0.0, size])
    state = reading(0.0, torque)
    assert bool(pressed(panda, state)) == told
    assert pressed(panda, replace(state, external_torque=None)) == ()


@pytest.mark.parametrize(
    ("contact", "pace", "followed", "slow", "quick"),
    [
        (None, 1.0, 1.0, 0, 0),
        (20.0, 1.0, 1.0, 0, 0),
        (30.0, 1.0, 1.0, 0.25, 0),
        (60.0, 1.0, 1.0, 1, 0),
        (90.0, 1.0, 1.0, 1, 0),
        (None, 0.4, 1.0, 0.6, 0),
        (30.0, 0.4, 0.3, 0.6, 0.7),
        (50.0, 0.4, 0.0, 0.75, 1),
    ],
)
def test_rumble_tells_contact_pace_and_what_is_not_followed(
    contact, pace, followed, slow, quick
):
    push = None if contact is None else contact * np.array([0.6, 0.0, -0.8])
    found = rumble_strength(Feedback(contact_force=push, pace=pace, followed=followed))
    assert found == pytest.approx((slow, quick))


@pytest.mark.parametrize("direction", [(1.0, 0, 0), (0.6, -0.8, 0), (-0.48, 0.6, 0.64)])
@pytest.mark.parametrize("size", [0.0, 0.12, 0.1201, 0.3, 0.56, 1.0, 1.4])
def test_a_stick_acts_beyond_its_dead_zone_by_a_square(direction, size):
    found = deflection(size * np.array(direction))
    beyond = min(max(size - 0.12, 0) / 0.88, 1)
    np.testing.assert_allclose(found, beyond**2 * np.array(direction), atol=1e-12)


def test_a_key_counts_for_a_while_after_its_press():
    now = [5.0]
    keys = KeyboardState(lambda: now[0])
    assert keys.direction().tolist() == [0, 0, 0]
    for key in "iuxi":  # i is held, u was tapped
        keys.press(key)
    np.testing.assert_allclose(keys.direction(), np.array([1, 0, 0.4]) / math.hypot(1, 0.4))
    now[0] = 5.29
    assert keys.direction()[0] > 0
    now[0] = 5.31
    assert keys.direction().tolist() == [0, 0, 0.4]
    now[0] = 5.71
    assert keys.direction().tolist() == [0, 0, 0]
    for key in "kloklo":
        keys.press(key)
    np.testing.assert_allclose(keys.direction(), -np.ones(3) / math.sqrt(3))


def test_a_box_has_twelve_edges_along_its_axes():
    edges = box_edges((0.1, 0.2, 0.3))
    assert edges.shape == (12, 2, 3)
    assert len({tuple(map(tuple, edge)) for edge in edges.tolist()}) == 12
    np.testing.assert_allclose(np.abs(edges), np.broadcast_to([0.1, 0.2, 0.3], (12, 2, 3)))
    lengths = np.abs(edges[:, 1] - edges[:, 0])
    assert (np.count_nonzero(lengths, axis=1) == 1).all()
    np.testing.assert_allclose(np.sort(lengths.max(1)), np.repeat([0.2, 0.4, 0.6], 4))


def test_rays_meet_planes_and_boxes_or_not():
    eye = np.array([0.0, 0.0, 2.0])
    down = np.array([0.6, 0.0, -0.8])
    np.testing.assert_allclose(meet_plane(eye, down, 2, 0.0), [1.5, 0, 0])
    np.testing.assert_allclose(meet_plane(eye, down, 0, 0.6), [0.6, 0, 1.2])
    assert meet_plane(eye, down, 2, 2.0) is None
    assert meet_plane(eye, down, 1, 1.0) is None
    for half, distance in ((0.49, math.inf), (0.51, 2.5 - 0.51 / 0.6)):
        found = meet_box(eye, down, np.array([1.5, 0, -0.4]), np.array([half, 1.0, 0.4]))
        assert found == pytest.approx(2.5 if half > 0.5 else distance, abs=1e-6) or half < 0.5
    up = np.array([0.0, 0.0, 1.0])
    assert meet_box(eye, up, np.array([0.0, 0, 0]), np.full(3, 0.5)) == math.inf
    # Along an axis, within or outside of the other slabs.
    assert meet_box(eye, -up, np.array([0.4, 0, 0]), np.full(3, 0.5)) == pytest.approx(1.5)
    assert meet_box(eye, -up, np.array([0.6, 0, 0]), np.full(3, 0.5)) == math.inf


@pytest.mark.parametrize("screen", [(0.5, 0.5), (0.0, 0.0), (1.0, 0.25), (0.2, 0.9)])
def test_a_camera_sees_a_place_on_its_screen_in_its_direction(screen):
    turn = quaternion.exp(torch.tensor([0.3, -0.2, 0.7], dtype=torch.float64))
    ray = view_ray(screen, turn.numpy(), 1.2, 1.5)
    own = quaternion.rotate(quaternion.conjugate(turn), torch.from_numpy(ray)).numpy()
    half = math.tan(0.6)
    assert own[0] / own[2] == pytest.approx((2 * screen[0] - 1) * half * 1.5)
    assert own[1] / own[2] == pytest.approx((2 * screen[1] - 1) * half)
    assert np.linalg.norm(ray) == pytest.approx(1)


def test_a_region_stands_over_the_points_that_were_drawn():
    points = np.array([[0.1, 0.5, 9.0], [0.3, 0.1, -9], [0.2, 0.2, 0]])
    region = region_over(points, 0.05, 0.2)
    np.testing.assert_allclose(region.centre, [0.2, 0.3, 0.15])
    np.testing.assert_allclose(region.half_size, [0.1, 0.2, 0.1])
    flat = region_over(points[:1], 0.05, 0.01)
    np.testing.assert_allclose(flat.half_size, [0.02] * 3)
    np.testing.assert_allclose(flat.centre, [0.1, 0.5, 0.07])
