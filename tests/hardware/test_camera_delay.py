"""The delay of a camera that nobody has calibrated, by the motion of a simulated arm."""

from collections import deque

import numpy as np
import pytest

from hrc_learn.hardware import CameraError, measure_delay
from hrc_learn.hardware.opencv_cameras import fit_delay, turning_velocity
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


class KnowingCamera(LateCamera):
    """One whose backend leaves out 30 ms."""

    @property
    def age(self):
        return self._world.time - self.shown - 0.030


def at_the_table(imperfections):
    world = World(WORKPLACE.scene, imperfections.draw(np.random.default_rng(1)))
    world.reset(WORKPLACE.hover_joints().numpy())
    return world


def test_the_delay_of_a_camera_is_found():
    world = at_the_table(Imperfections.nominal())
    camera, before = LateCamera(world, 0.083, 0.021), world.data.qpos[:7].copy()
    found = measure_delay(world.arm, camera, HAND_MARKER, advance=camera.advance, duration=4.0)
    # Read each 10 ms, an image has waited for 5 ms on average.
    assert found.delay == pytest.approx(0.083 + 0.005, abs=2.5e-3)
    assert 0 < found.deviation < 2e-3
    assert 80 < found.images <= 4.0 / 0.021
    np.testing.assert_allclose(world.data.qpos[:7], before, atol=3e-3)


def test_of_a_camera_that_tells_its_images_age_what_that_leaves_out_is_found():
    world = at_the_table(Imperfections.nominal())
    camera = KnowingCamera(world, 0.083, 0.021)
    found = measure_delay(
        world.arm,
        camera,
        HAND_MARKER,
        advance=camera.advance,
        joint=2,
        duration=4.0,
    )
    assert found.delay == pytest.approx(0.030, abs=2.5e-3)


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


def test_a_marker_that_is_not_seen_is_told():
    world = at_the_table(Imperfections.ideal())
    camera = LateCamera(world, 0.0, 0.05)
    with pytest.raises(CameraError, match="marker 49 in 0 different images"):
        measure_delay(world.arm, camera, 49, advance=camera.advance, duration=0.2)


@pytest.mark.parametrize(
    ("setting", "complaint"),
    [({"duration": 0.0}, "duration"), ({"joint": 0}, "1 to 7"), ({"joint": 8}, "1 to 7")],
)
def test_a_motion_that_makes_no_sense_is_refused(setting, complaint):
    world = World(WORKPLACE.scene)
    camera = LateCamera(world, 0.0, 0.05)
    with pytest.raises(ValueError, match=complaint):
        measure_delay(world.arm, camera, 49, advance=camera.advance, **setting)
