"""Thresholds of touch, recordings and devices, with cases at both sides of each."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from hrc_learn.geometry import quaternion
from hrc_learn.kinematics import panda
from hrc_learn.protocols import ArmState, Feedback
from hrc_learn.teleoperation import Touch
from hrc_learn.teleoperation.demonstration_recorder import RecordingQuality, pressed
from hrc_learn.teleoperation.devices import KeyboardState, deflection, rumble_strength
from hrc_learn.teleoperation.page_scene import box_edges
from hrc_learn.teleoperation.region_editor import meet_box, meet_plane, region_over, view_ray
from hrc_learn.teleoperation.touch import Explanation, TorqueBias, _Posture

pytestmark = pytest.mark.simulation

READY = panda.ready
JACOBIAN = panda.jacobian(READY).numpy()


def test_a_posture_has_the_jacobian_of_the_elbow_and_the_null_space():
    origins, jacobian = panda.joint_origins_and_jacobian(READY)
    arm = _Posture.of(origins.numpy(), jacobian.numpy())
    np.testing.assert_allclose(
        arm.elbow, panda.joint_jacobian(READY, 4).numpy()[:3], atol=1e-12
    )
    np.testing.assert_allclose(arm.jacobian @ arm.null, 0, atol=1e-12)
    np.testing.assert_allclose(arm.null.T @ arm.null, np.eye(1), atol=1e-12)
    # Torques of a force at either place are explained best by it.
    force = np.array([15.0, -10.0, 5.0])
    for rows, larger in ((arm.elbow, 0), (arm.jacobian[:3], 1)):
        found = arm.explained(rows.T @ force, 0.09 * np.eye(7))
        assert found[larger].evidence > found[1 - larger].evidence + 8
        np.testing.assert_allclose(found[larger].force, force, atol=3)  # the prior pulls
    assert max(found) is found[1]


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
    touch = Touch(panda)
    touch.place = before
    touch._look(force(*above), force(*hand), none)
    assert touch.place == place
    expected = {"nothing": 0.0, "elbow": above[0], "hand": hand[0]}[place]
    assert touch.force.tolist() == [0, expected, 0]


@pytest.mark.parametrize(
    ("size", "gain"), [(6.0, 0), (7.0, 0), (10.5, 1), (14.0, 2), (50.0, 2)]
)
def test_the_null_space_follows_from_the_dead_band_to_twice_of_it(size, gain):
    touch = Touch(panda)
    origins, jacobian = panda.joint_origins_and_jacobian(READY)
    arm = _Posture.of(origins.numpy(), jacobian.numpy())
    touch.force, touch._felt = np.array([0.0, 0, -size]), np.arange(7.0)
    expected = gain * arm.null @ (arm.null.T @ np.arange(7.0))
    np.testing.assert_allclose(touch._nullspace_input(arm), expected, atol=1e-12)


def reading(time, torque=None, width=0.08):
    return ArmState(
        time=time,
        joint_position=READY.numpy(),
        joint_velocity=np.zeros(7),
        gripper_width=width,
        external_torque=np.zeros(7) if torque is None else torque,
    )


@pytest.mark.parametrize(
    ("moved", "after", "meets"),
    [(0.9e-4, 0.0, False), (1.1e-4, 0.0, True), (-1.1e-4, 0.49, True), (0.01, 0.51, False)],
)
def test_fingers_that_move_may_touch_their_object_for_half_a_second(moved, after, meets):
    touch = Touch(panda)
    assert not touch._meets_objects(reading(0.0))
    touch._meets_objects(reading(1.0, width=0.08 + moved))
    assert touch._meets_objects(reading(1.0 + after, width=0.08 + moved)) == meets
    touch.tell(Feedback(contact_expected=True))
    assert touch._meets_objects(reading(9.0, width=0.08 + moved))


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


@pytest.mark.parametrize(
    ("sizes", "met"),
    [((0, 29), False), ((0, 33), True), ((20, 49), False), ((20, 55), True), ((60, 20), True)],
)
def test_a_change_that_no_hand_makes_stops_the_arm(sizes, met):
    """The change comes from one reading to the next."""
    touch = Touch(panda)
    origins, jacobian = panda.joint_origins_and_jacobian(READY)
    arm = _Posture.of(origins.numpy(), jacobian.numpy())
    unknown = 0.01 * np.eye(7)
    way = JACOBIAN[:3].T @ np.array([0.0, 1.0, 0.0])
    none = force(0.0, 0.0)
    for time, size in ((1.0, sizes[0]), (1.01, sizes[1])):
        touch._time = time
        touch._watch_for_collision(arm, size * way, unknown, none, False)
    assert bool(touch._why) == met
    if met:
        change = abs(sizes[1] - sizes[0])
        number = float(touch._why.split("with ")[1].split()[0])
        assert number == pytest.approx(change, abs=2)
    # Where the gripper meets its object there may be any change, but not any force.
    other = Touch(panda)
    for time, size in ((1.0, sizes[0]), (1.01, sizes[1])):
        other._time = time
        other._watch_for_collision(arm, size * way, unknown, none, True)
    assert other._why == ""
    for size, stops in ((109.0, False), (111.0, True)):
        other._watch_for_collision(arm, 0 * way, unknown, force(size, 0.0), True)
        assert bool(other._why) == stops


def test_a_rise_that_takes_longer_is_no_collision():
    touch = Touch(panda)
    origins, jacobian = panda.joint_origins_and_jacobian(READY)
    arm = _Posture.of(origins.numpy(), jacobian.numpy())
    way = JACOBIAN[:3].T @ np.array([0.0, 1.0, 0.0])
    for k in range(30):
        touch._time = 1 + 0.01 * k
        touch._watch_for_collision(arm, 7.0 * k * way, 0.01 * np.eye(7), force(0, 0), False)
        # Four steps of 10 ms in 40 ms: 28 N.
        assert touch._why == ""
    touch = Touch(panda)
    for k in range(30):
        touch._time = 1 + 0.01 * k
        touch._watch_for_collision(arm, 12.0 * k * way, 0.01 * np.eye(7), force(0, 0), False)
    assert touch._why != ""
    # It is over once nothing has touched the arm for a while.
    for later, over in ((0.39, False), (0.41, True)):
        touch._time = 1.29 + later
        touch._lately = []
        touch._watch_for_collision(arm, 0 * way, 0.01 * np.eye(7), force(0, 0), False)
        assert (touch._why == "") == over


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
    for key in "iuxi":
        keys.press(key)
    np.testing.assert_allclose(keys.direction(), np.array([1, 0, 1]) / math.sqrt(2))
    now[0] = 5.29
    assert keys.direction()[0] > 0
    now[0] = 5.31
    assert keys.direction().tolist() == [0, 0, 0]
    keys.press("k")
    keys.press("l")
    keys.press("o")
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
