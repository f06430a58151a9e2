"""The delay of a camera that nobody has calibrated, by the motion of a simulated arm."""

import math
from collections import deque
from types import SimpleNamespace

import numpy as np
import pytest
from unchecked import shapes_unchecked

from hrc_learn.hardware import CameraError, measure_delay, opencv_cameras
from hrc_learn.hardware.opencv_cameras import fit_delay, turning_velocity
from hrc_learn.protocols import ArmState
from hrc_learn.sim import Imperfections, World, open_camera
from hrc_learn.sim.scene import HAND_MARKER
from hrc_learn.sim.workplace import Workplace

WORKPLACE = Workplace()


class LateCamera:
    """The simulated camera at a rate of its own, its images late, with a clock that we know."""

    def __init__(self, world, delay, period):
        self._world, self._delay, self._period = world, delay, period
        self._camera = open_camera(world, "synthetic", rng=np.random.default_rng(0))
        self._taken = deque([(0.0, self._camera.read())])
        self._next = period
        self.shown = 0.0

    def advance(self, duration):
        end = self._world.time + duration
        while self._world.time < end - 1e-9:
            self._world.advance(self._world.model.opt.timestep)
            if self._world.time >= self._next:
                self._taken.append((self._world.time, self._camera.read()))
                self._next += self._period

    def read(self):
        while len(self._taken) > 1 and self._taken[1][0] <= self._world.time - self._delay:
            self._taken.popleft()
        self.shown, image = self._taken[0]
        return image


def at_the_table(imperfections):
    world = World(WORKPLACE.scene, imperfections.draw(np.random.default_rng(1)))
    world.reset(WORKPLACE.hover_joints().numpy())
    return world


@pytest.mark.long
def test_the_delay_of_a_camera_is_found():
    world = at_the_table(Imperfections.nominal())
    camera, before = LateCamera(world, 0.083, 0.021), world.data.qpos[:7].copy()
    found = measure_delay(world.arm, camera, HAND_MARKER, advance=camera.advance, duration=2.5)
    # Read each 10 ms, an image has waited for 5 ms on average.
    assert found.delay == pytest.approx(0.083 + 0.005, abs=2.5e-3)
    assert 0 < found.deviation < 2e-3
    assert 80 < found.images <= 2.5 / 0.021
    np.testing.assert_allclose(world.data.qpos[:7], before, atol=3e-3)


TIME = np.arange(0.0, 6.0, 0.01)


def test_the_joint_turns_ever_faster_within_its_speed_and_rests_at_both_ends():
    time = np.linspace(0.0, 8.0, 8001)
    velocity = np.array([turning_velocity(t, 8.0) for t in time])
    assert np.abs(velocity).max() == pytest.approx(0.15, rel=0.01)
    # The rate rises from 0.4 to 1.0 Hz: 5.6 turns, the k-th half of which ends at 0.5 k.
    turns = time * (0.4 + 0.3 * time / 8.0)
    crossings = turns[1:][np.diff(np.sign(velocity)) != 0]
    halves = crossings[(crossings > 0.1) & (crossings < 5.55)]
    np.testing.assert_allclose(halves, 0.5 * np.arange(1, 12), atol=2e-3)
    for ends in (velocity, velocity[::-1]):
        assert (np.abs(ends[:1000]) <= 0.15 * time[:1000] + 1e-9).all()
    assert np.abs(velocity[1000:7000]).max() > 0.149


def follows(delay, noise=0.2, seed=0):
    """A joint, and pixels that follow it by a bent line."""
    rng = np.random.default_rng(seed)
    velocity = np.array([turning_velocity(t, 6.0) for t in TIME])
    joint = 0.3 + np.cumsum(velocity) * 0.01
    taken = np.arange(0.3, 5.9, 0.033)
    q = np.interp(taken - delay, TIME, joint) - 0.3
    pixel = np.stack([300 + 400 * q + 900 * q**2, 200 - 150 * q], axis=-1)
    return joint, taken, pixel + noise * rng.standard_normal(pixel.shape)


@pytest.mark.parametrize("delay", [0.0, 0.0173, 0.1])
def test_the_fit_knows_how_far_off_it_may_be(delay):
    joint, taken, pixel = follows(delay)
    found = fit_delay(TIME, joint, taken, pixel, 0.25)
    assert abs(found.delay - delay) < 4 * found.deviation
    assert found.deviation < 1.5e-3
    # Twice the noise, twice the deviation.
    more = fit_delay(TIME, joint, taken, follows(delay, noise=0.4)[2], 0.25)
    assert more.deviation == pytest.approx(2 * found.deviation, rel=0.3)


def test_the_deviation_told_is_that_of_repeated_measurements():
    joint, taken, _ = follows(0.0173)
    found = [
        fit_delay(TIME, joint, taken, follows(0.0173, seed=seed)[2], 0.05) for seed in range(40)
    ]
    spread = np.std([one.delay for one in found])
    # Of 40 the standard deviation is known to 11 %.
    assert np.mean([one.deviation for one in found]) == pytest.approx(spread, rel=0.35)
    assert np.mean([one.delay for one in found]) == pytest.approx(0.0173, abs=0.5 * spread)
    assert {one.images for one in found} == {len(taken)}


def test_a_delay_that_is_none_is_not_told():
    joint, taken, pixel = follows(0.1)
    with pytest.raises(CameraError, match=r"not between 0 and 0\.05 s"):
        fit_delay(TIME, joint, taken, pixel, 0.05)
    noise = np.random.default_rng(1).standard_normal(pixel.shape)
    with pytest.raises(CameraError, match="does not follow the joint"):
        fit_delay(TIME, joint, taken, noise, 0.25)


@pytest.mark.parametrize("duration", [4.0, 8.0])
def test_the_turning_velocity_is_a_chirp_under_a_trapezium(duration):
    for passed in duration * np.array([0.0, 0.013, 0.06, 0.125, 0.3, 0.71, 0.93, 0.995, 1.0]):
        # The phase is the integral of a rate that rises from 0.4 to 1.0 Hz.
        phase = 2 * np.pi * np.trapezoid([0.4, 0.4 + 0.6 * passed / duration], [0.0, passed])
        hull = np.interp(passed / duration, [0, 1 / 8, 7 / 8, 1], [0, 0.15, 0.15, 0])
        found = turning_velocity(passed, duration)
        assert found == pytest.approx(hull * np.sin(phase), abs=1e-12)


def cubic_rest(joint, taken, pixel, delay):
    """Residual of the best cubic polynomial in the joint's position, by NumPy's fit."""
    q = np.interp(taken - delay, TIME, joint)
    fits = (np.polyfit(q - q.mean(), column, 3, full=True)[1] for column in pixel.T)
    return sum(float(fit[0]) for fit in fits)


@pytest.mark.parametrize("delay", [0.0, 0.0173, 0.031])
def test_delay_and_deviation_are_those_of_a_parabola_through_the_smallest_rests(delay):
    joint, taken, pixel = follows(delay)
    known = taken >= 0.05 + TIME[0]
    rests = {k: cubic_rest(joint, taken[known], pixel[known], 2e-3 * k) for k in range(-1, 27)}
    k = min(rests, key=rests.__getitem__)
    a, b, _ = np.polyfit([-1, 0, 1], [rests[k - 1], rests[k], rests[k + 1]], 2)
    found = fit_delay(TIME, joint, taken, pixel, 0.05)
    assert found.delay == pytest.approx(2e-3 * (k - b / (2 * a)), abs=1e-9)
    # Two pixels an image, two cubics and the delay itself.
    noise = rests[k] / (2 * len(taken) - 2 * 4 - 1)
    assert found.deviation == pytest.approx(2e-3 * np.sqrt(noise / a), rel=1e-6)


def test_images_from_before_the_longest_delay_are_left_out():
    joint, taken, pixel = follows(0.0173)
    assert fit_delay(TIME, joint, taken, pixel, taken[0]).images == len(taken)
    found = fit_delay(TIME, joint, taken, pixel, taken[5] - 1e-6)
    assert found.images == len(taken) - 5
    again = fit_delay(TIME + 7, joint, taken + 7, pixel, taken[5] - 1e-6)
    assert again == pytest.approx(found)


@pytest.mark.parametrize(("longest", "delay"), [(0.05, 0.05), (0.0509, 0.0512), (0.05, 0.0)])
def test_a_delay_at_either_end_of_what_is_looked_for_is_found(longest, delay):
    joint, taken, pixel = follows(delay, noise=0.0)
    assert fit_delay(TIME, joint, taken, pixel, longest).delay == pytest.approx(delay, abs=1e-4)


@pytest.mark.parametrize(("longest", "delay"), [(0.05, 0.0535), (0.05, -0.0031)])
def test_a_delay_beyond_either_end_is_refused(longest, delay):
    joint, taken, pixel = follows(delay, noise=0.0)
    with pytest.raises(CameraError, match=r"not between 0 and 0\.05 s"):
        fit_delay(TIME, joint, taken, pixel, longest)


@pytest.mark.parametrize(("noise", "follows_it"), [(2.0, True), (3.5, False)])
def test_nine_tenths_of_the_motion_in_the_image_have_to_be_explained(noise, follows_it):
    joint, taken, pixel = follows(0.02, noise=noise)
    rest = min(cubic_rest(joint, taken, pixel, 2e-3 * k) for k in range(27))
    explained = 1 - rest / ((pixel - pixel.mean(axis=0)) ** 2).sum()
    assert (explained > 0.9) == follows_it, "the noise of the test is not what it should be"
    if follows_it:
        assert fit_delay(TIME, joint, taken, pixel, 0.05).delay == pytest.approx(0.02, abs=0.01)
        return
    with pytest.raises(CameraError, match=f"{100 * explained:.0f} % of its motion"):
        fit_delay(TIME, joint, taken, pixel, 0.05)


def test_a_joint_that_does_not_move_explains_nothing():
    _, taken, pixel = follows(0.02)
    with pytest.raises(CameraError, match=r"does not follow the joint: -?0 % of its motion"):
        fit_delay(TIME, np.full_like(TIME, 0.3), taken, pixel, 0.05)


class TurningArm:
    """An arm that turns as it is commanded, and its camera: both exact, with one clock.

    An image, 33 in a second, holds the marker's pixel, which is linear in the joint's position.
    """

    def __init__(self, delay=0.04, number=7, seen=lambda time: True, stuck=math.inf):
        self.q, self.home = np.linspace(-1, 1, 7), np.linspace(-1, 1, 7)
        self.delay, self.number, self.seen, self.stuck = delay, number, seen, stuck
        self.time, self.steps = 20.0, 0
        self.commands, self.course, self.velocity = [], [(20.0, 0.0)], np.zeros(7)

    def read(self):
        return ArmState(
            time=self.time,
            joint_position=self.q.copy(),
            joint_velocity=self.velocity,
            gripper_width=0.0,
        )

    def command(self, velocity):
        self.velocity = np.array(velocity)
        self.commands.append(self.velocity)

    def advance(self, duration):
        moves = self.steps < self.stuck
        self.q, self.time = self.q + moves * duration * self.velocity, self.time + duration
        self.steps += 1
        self.course.append((self.time, float((self.q - self.home).sum())))

    def image(self):
        at = 20.0 + 0.03 * (self.steps // 3)
        time, moved = np.array(self.course).T
        pixel = 300 + 400 * np.interp(at - self.delay, time, moved)
        return np.array([pixel, 200.0, at])


class TimedTurningArm(TurningArm):
    age = 0.015


def measured(arm, monkeypatch, **settings):
    class Detector:
        def __init__(self, markers):
            (self.number,) = markers

        def detect(self, image):
            x, y, at = image
            corners = np.array([[x, y]]) + np.array([[-9, -9], [9, -9], [9, 9], [-9, 9]])
            return {arm.number: corners} if arm.seen(at) else {}

    monkeypatch.setattr(opencv_cameras, "MarkerDetector", Detector)
    camera = SimpleNamespace(read=arm.image)
    if isinstance(arm, TimedTurningArm):
        camera.age = arm.age
    with shapes_unchecked():
        return measure_delay(arm, camera, 7, advance=arm.advance, **settings)


@pytest.mark.parametrize("kind", [TurningArm, TimedTurningArm])
def test_the_arm_turns_one_joint_for_the_duration_and_comes_back(monkeypatch, kind):
    arm = kind()
    found = measured(arm, monkeypatch, duration=3.0, joint=3)
    # Images are renewed each 30 ms and read each 10 ms; the first of each counts.
    age = arm.age if kind is TimedTurningArm else 0.0
    assert found.delay == pytest.approx(arm.delay - age, abs=1e-3)
    assert found.images == pytest.approx((3.0 - 0.5 + age) / 0.03, abs=1)
    commands = np.array(arm.commands)
    np.testing.assert_array_equal(np.delete(commands, 2, axis=1), 0.0)
    np.testing.assert_allclose(
        commands[:300, 2], [turning_velocity(0.01 * k, 3.0) for k in range(300)]
    )
    # It goes back by 2 /s of what is left, until that is below 1 mrad, and then rests.
    assert abs((arm.q - arm.home)[2]) < 1e-3
    left = arm.course[300][1] * 0.98 ** np.arange(len(commands) - 301)
    np.testing.assert_allclose(commands[300:-1, 2], -2 * left, atol=1e-12)
    assert (np.abs(left) >= 1e-3).all()
    np.testing.assert_array_equal(commands[-1], 0.0)


def test_the_way_back_ends_after_three_seconds(monkeypatch):
    arm = TurningArm(stuck=300)
    measured(arm, monkeypatch, duration=3.0)
    assert len(arm.commands) == 300 + 300 + 1
    np.testing.assert_array_equal(arm.commands[-1], 0.0)


@pytest.mark.parametrize("images", [30, 29])
def test_thirty_images_are_enough(monkeypatch, images):
    begin = 20.6
    arm = TurningArm(seen=lambda at: begin - 1e-9 <= at < begin + 0.03 * images - 1e-9)
    if images == 30:
        assert measured(arm, monkeypatch, duration=3.0).images == 30
        return
    with pytest.raises(CameraError, match="marker 7 in 29 different images, and at least 30"):
        measured(arm, monkeypatch, duration=3.0)
    np.testing.assert_array_equal(arm.commands[-1], 0.0)


@pytest.mark.parametrize(
    ("setting", "complaint"),
    [
        ({"duration": 0.0}, "duration must be positive"),
        ({"joint": 0}, "one of 1 to 7, but is 0"),
        ({"joint": 8}, "one of 1 to 7, but is 8"),
    ],
)
def test_a_motion_that_makes_no_sense_is_refused(monkeypatch, setting, complaint):
    arm = TurningArm()
    with pytest.raises(ValueError, match=complaint):
        measured(arm, monkeypatch, **setting)
    assert arm.commands == []


@pytest.mark.parametrize("joint", [1, 7])
def test_the_first_and_the_last_joint_may_turn(monkeypatch, joint):
    arm = TurningArm()
    measured(arm, monkeypatch, duration=2.0, joint=joint)
    (turned,) = np.nonzero(np.abs(arm.commands).max(axis=0))
    assert turned == joint - 1


def test_an_error_leaves_the_arm_at_rest(monkeypatch):
    def breaks(at):
        if at > 20.5:
            raise OSError("a pulled cable")
        return True

    arm = TurningArm(seen=breaks)
    with pytest.raises(OSError, match="a pulled cable"):
        measured(arm, monkeypatch)
    np.testing.assert_array_equal(arm.commands[-1], 0.0)
    # By default the first joint turns, for eight seconds.
    turning = [turning_velocity(0.01 * k, 8.0) for k in range(len(arm.commands) - 1)]
    np.testing.assert_allclose(arm.commands[:-1], np.outer(turning, np.eye(7)[0]))
    assert len(turning) > 50
