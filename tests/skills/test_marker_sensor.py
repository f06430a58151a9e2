from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from hrc_learn.geometry import Pose
from hrc_learn.kinematics import panda
from hrc_learn.log import StepLog
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.marker_sensor import (
    DelayedDetection,
    LatencyConfig,
    MarkerConsistency,
    feature_sensor,
    longest_occlusion,
)
from hrc_learn.vision.imaging import carton
from hrc_learn.vision.landmarks import Features, Landmarks, Object, Tool

PERIOD = 0.04
WORKPLACE = Workplace()


def arrivals(config, images=400, step=0.01, seed=0):
    """Times at which images were taken and at which they arrived [s]."""
    detection = DelayedDetection(None, config, step, np.random.default_rng(seed))
    times, every = [], round(PERIOD / step)
    for k in range(images * every):
        if k % every == 0:
            detection.detect(k * step, panda.ready)
        arrived = detection.newest(k * step)
        if arrived is not None:
            times.append((arrived.time, k * step))
    return np.array(times)


def test_images_arrive_at_once_unless_told():
    taken, arrived = arrivals(LatencyConfig()).T
    np.testing.assert_array_equal(taken, arrived)
    np.testing.assert_allclose(np.diff(taken), PERIOD)


class Clocked:
    """A camera whose images have an age."""

    age = 0.0

    def read(self):
        return np.zeros((8, 8, 3), np.uint8)


@pytest.mark.parametrize("state", [0.001, 0.004, 0.008])
def test_an_image_that_is_read_again_counts_once_by_any_clock_of_the_arm(state):
    """The arm's time is that of its newest state; the age is measured after the image."""
    rng = np.random.default_rng(0)
    camera = Clocked()
    sensor = feature_sensor(camera, None, 0, [])
    detection = DelayedDetection(sensor, LatencyConfig(), 0.01, rng)
    exposed, taken = PERIOD * np.arange(200), set()
    for now in np.arange(1.0, 7.0, 0.01):
        newest = exposed[exposed <= now].max()
        camera.age = now - newest
        time = now - rng.uniform(0.0, state)
        detection.detect(time, panda.ready)
        taken |= {one.time for one in iter(lambda t=time: detection.newest(t), None)}
    shown = exposed[(exposed >= 1.0 - 1e-9) & (exposed < 7.0 - 1e-9)]
    assert len(taken) == len(shown)
    # The first reading of an image decides.
    np.testing.assert_allclose(sorted(taken), shown, atol=state)


def test_all_images_of_a_fast_camera_count():
    camera = Clocked()
    sensor = feature_sensor(camera, None, 0, [])
    detection = DelayedDetection(sensor, LatencyConfig(), 0.004, np.random.default_rng(0))
    exposed, taken = np.arange(120) / 120, set()
    for now in np.arange(0.0, 1.0, 0.004):
        camera.age = now - exposed[exposed <= now].max()
        detection.detect(now, panda.ready)
        taken |= {one.time for one in iter(lambda t=now: detection.newest(t), None)}
    np.testing.assert_allclose(sorted(taken), exposed, atol=1e-9)


@pytest.mark.parametrize("delay", [0.05, 0.1])
def test_late_images_keep_the_time_at_which_they_were_taken(delay):
    taken, arrived = arrivals(LatencyConfig(delay=delay)).T
    np.testing.assert_allclose(arrived - taken, delay, atol=1e-9)
    np.testing.assert_allclose(np.diff(taken), PERIOD)


def test_the_fraction_asked_for_is_lost():
    taken, _ = arrivals(LatencyConfig(frame_loss=0.3)).T
    assert len(taken) == pytest.approx(0.7 * 400, abs=3 * np.sqrt(400 * 0.21))
    assert np.diff(taken).min() > PERIOD / 2


@pytest.mark.parametrize("wrong", [{"delay": -0.1}, {"frame_loss": 1.0}, {"frame_loss": -0.1}])
def test_what_no_camera_does_is_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        LatencyConfig(**wrong)


@pytest.mark.parametrize("since", [0.0, 0.3])
def test_the_longest_occlusion_over_the_table_is_found(since):
    over, away = WORKPLACE.hover_joints().numpy(), WORKPLACE.home_joints().numpy()
    rng = np.random.default_rng(3)
    log, step = StepLog(), 0.02
    # Spells of random lengths, over the table or not, with the marker seen or not.
    spells = [(int(n), *(rng.random(2) < 0.5)) for n in rng.integers(1, 9, size=30)]
    rows = [(there, seen) for n, there, seen in spells for _ in range(n)]
    longest = running = 0
    for k, (there, seen) in enumerate(rows):
        feature = np.array([100.0, 50.0]) if seen else np.full(2, np.nan)
        log.append(time=k * step, joint_position=over if there else away, feature=feature)
        running = running + 1 if there and not seen and k * step >= since else 0
        longest = max(longest, running)
    assert longest > 1
    found = longest_occlusion(log, WORKPLACE.hover(), since, panda)
    assert found == pytest.approx(longest * step)


def test_a_log_of_one_step_tells_of_no_occlusion():
    log = StepLog()
    log.append(time=0.0, joint_position=WORKPLACE.hover_joints().numpy(), feature=np.ones(2))
    assert longest_occlusion(log, WORKPLACE.hover(), 0.0, panda) == 0.0


def seen_held(pixels, poses, jacobian, tolerance=1.5):
    held, fits = MarkerConsistency(tolerance=tolerance), []
    for k, (pixel, pose) in enumerate(zip(pixels, poses, strict=True)):
        held = held.updated(0.04 * k, pixel, pose, jacobian)
        fits.append(held.consistent)
    return fits


def test_a_marker_that_moves_with_the_end_effector_is_believed_a_half_hidden_one_not():
    """Pulled by millimetres, the end effector takes its marker along; what creeps over a marker
    moves its corners alone."""
    rng = np.random.default_rng(0)
    jacobian = np.concatenate([1500 * np.eye(2), np.zeros((2, 4))], axis=1)
    shift = 4e-3 * np.sin(np.linspace(0, 6, 100))
    positions = [(0.4 + s, 0.1, 0.3) for s in shift]
    level = panda.forward(panda.ready).orientation
    poses = [Pose(torch.tensor(p, dtype=torch.float64), level) for p in positions]
    pixels = 500 + 1500 * np.stack([shift, 0 * shift], axis=-1)
    pixels = pixels + 0.2 * rng.standard_normal(pixels.shape)
    assert all(seen_held(pixels, poses, jacobian))
    creeping = np.zeros_like(pixels)
    creeping[30:60, 1] = np.linspace(0, 6, 30)
    fits = np.array(seen_held(pixels + creeping, poses, jacobian))
    bias = creeping[:, 1]
    assert fits[bias < 0.7].all()
    assert not fits[bias > 2.3].any()
    assert not any(seen_held(np.full_like(pixels, np.nan), poses, jacobian))


def test_an_image_is_judged_once():
    held = MarkerConsistency(tolerance=1.5)
    pose, jacobian = panda.forward(panda.ready), np.zeros((2, 6))
    held = held.updated(0.0, np.array([5.0, 5.0]), pose, jacobian)
    assert held.consistent
    held = held.updated(0.0, np.array([50.0, 50.0]), pose, jacobian)
    assert held.consistent
    assert not held.updated(0.1, np.array([50.0, 50.0]), pose, jacobian).consistent


class Photo:
    """A camera that always shows the same image."""

    def __init__(self, image):
        self.image = image

    def read(self):
        return self.image


def test_landmarks_give_pixel_and_angle_or_nothing(tmp_path):
    print_ = carton("thing", (0.3, 0.5, 0.6, 1.0))
    view = Features.of(print_)
    middle = np.array([print_.shape[1], print_.shape[0]]) / 2
    item = Object(views=(replace(view, pixels=view.pixels - middle),))
    none = np.zeros((0, 3))
    tool = Tool(
        points=none,
        descriptors=np.zeros((0, 128), np.uint8),
        place=np.zeros(3),
        optics=(500.0, 320.0, 240.0, 0.0),
    )
    landmarks = Landmarks(tool=tool, objects={"object": item}, image_size=(640, 480))
    turned = cv2.getRotationMatrix2D((0, 0), -40, 0.6)
    turned[:, 2] += (300, 250) - turned[:, :2] @ middle
    image = cv2.warpAffine(print_, turned, (640, 480), borderValue=(90, 90, 90))
    # A board hides a third of it.
    image[:215] = 120
    sensor = feature_sensor(Photo(image), landmarks, tool=7, objects=[11])
    found = sensor.features()
    assert set(found) == {11}  # a tool without points is not found
    np.testing.assert_allclose(found[11].pixel, (300, 250), atol=1.0)
    assert found[11].angle == pytest.approx(np.deg2rad(40), abs=0.02)
    assert sensor.features([7]) == {}
    # What was found is drawn over the next image that is shown; the camera's own stays bare.
    shown = sensor.read()
    changed = (shown != image).any(axis=-1)
    assert changed[250, 300]
    assert not changed[:200].any()
    np.testing.assert_array_equal(sensor.read(), image)  # nothing was looked for since
