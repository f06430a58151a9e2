"""A camera that was moved is found again online; truth and images are OpenCV's."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from torch.testing import assert_close
from torch.utils import _pytree
from unchecked import shapes_unchecked

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import (
    CameraConfig,
    CameraEstimator,
    ImageDemonstration,
    ImageJacobianFitConfig,
    Measurement,
    RBFCenters,
    RBFImageJacobian,
    fit_camera,
    paper_grid,
)
from hrc_learn.jacobian.perspective import ROTATION, marker_pixels, stepped

IMAGE, LEVER = (1440, 1080), np.array([-0.008, 0.145, -0.083])
INTRINSICS = np.array([[1900.0, 0, 731.0], [0, 1900.0, 528.0], [0, 0, 1.0]])
LENS = np.array([-0.06, 0.02, 0.0, 0.0])
TURN, EYE = np.array([np.pi - 0.05, 0.05, 0.1]), np.array([0.25, 0.5, 1.5])
VIEW = cv2.Rodrigues(TURN)[0], EYE
SCALE = torch.tensor([1, 1, 1, 1 / 0.15, 1 / 0.15, 1 / 0.15]).double()


def pixels(view, position, matrix):
    """Pixels of the marker for a camera (rotation, eye)."""
    rotation, eye = view
    points = (position + matrix @ LEVER).reshape(-1, 3)
    vector, shift = cv2.Rodrigues(rotation)[0], -rotation @ eye
    return cv2.projectPoints(points, vector, shift, INTRINSICS, LENS)[0][:, 0]


def jacobian(view, position, matrix):
    """True image Jacobian at one pose, by central differences."""
    columns = []
    for axis in range(6):
        twist = np.zeros(6)
        twist[axis] = 1e-5
        ahead, behind = (
            pixels(view, position + s * twist[:3], cv2.Rodrigues(s * twist[3:])[0] @ matrix)
            for s in (1, -1)
        )
        columns.append((ahead - behind)[0] / 2e-5)
    return torch.from_numpy(np.stack(columns, axis=-1))


def moved(rng, degrees, distance, roll):
    """The camera after a tilt about any axis, a shift, and a turn about its optical axis."""
    axis, shift = rng.normal(size=(2, 3))
    tilt = cv2.Rodrigues(np.deg2rad(degrees) * axis / np.linalg.norm(axis))[0]
    turn = cv2.Rodrigues(np.array([0.0, 0.0, roll]))[0]
    return turn @ tilt @ VIEW[0], EYE + distance * shift / np.linalg.norm(shift)


def path(rng, length=0.1, frames=40, turn=0.2):
    """Two straight pieces of the tool's path, of this length together."""
    ways = rng.normal(size=(2, 3)) * [1, 1, 0.7]
    ways *= length / frames / np.linalg.norm(ways, axis=1, keepdims=True)
    steps = np.repeat(ways, frames // 2, axis=0)
    start = np.array([0.25, 0.5, 0.25]) + rng.uniform(-0.06, 0.06, 3) * [1, 1, 0.5]
    position = start + np.cumsum(steps, axis=0)
    spin = torch.zeros(frames, 3, dtype=torch.float64)
    spin[:, 2] = torch.linspace(0, turn, frames)
    # A little tilt shows how high the marker is on the tool.
    spin[:, :2] = 0.3 * turn * torch.sin(torch.linspace(0, 3, frames))[:, None]
    down = torch.tensor([0.0, 1.0, 0.0, 0.0]).double()
    orientation = quaternion.multiply(quaternion.exp(spin), down)
    return position, orientation


def seen(view, position, orientation, rng):
    matrix = quaternion.to_matrix(orientation).numpy()
    noise = rng.normal(0, 0.1, (len(position), 2))
    return torch.from_numpy(pixels(view, position, matrix) + noise)


@pytest.fixture(scope="module")
@torch.inference_mode(False)  # the first test is a simulation, a later one exports it
def network():
    rng, demos = np.random.default_rng(0), []
    for _ in range(3):
        position, orientation = path(rng, 0.5, 100, turn=rng.normal())
        demos.append(
            ImageDemonstration(
                pose=Pose(torch.from_numpy(position), orientation),
                feature=seen(VIEW, position, orientation, rng),
                visible=torch.ones(len(position), dtype=torch.bool),
            )
        )
    config, found = ImageJacobianFitConfig.of_residual(), fit_camera(demos, IMAGE)
    return RBFImageJacobian.fit(demos, RBFCenters.around(demos), config, found).double()


def measurements(position, orientation, feature):
    """Measurements in time, of poses that encoders report with an error of calibration."""
    rigid = cv2.Rodrigues(np.array([2e-3, -1e-3, 2e-3]))[0]
    reported = torch.from_numpy(position @ rigid.T + [1e-3, -1e-3, 0])
    batch = feature.shape[:-2]
    return [
        Measurement(
            pose=Pose(reported[..., k, :], orientation[..., k, :]),
            feature=feature[..., k, :],
            valid=torch.ones(batch, dtype=torch.bool),
            dt=0.04,
            xi_x=torch.zeros(*batch, 2, dtype=torch.float64),
            xi_r=torch.zeros(*batch, 6, dtype=torch.float64),
        )
        for k in range(feature.shape[-2])
    ]


def run(estimator, state, frames):
    with shapes_unchecked():
        for frame in frames:
            state = estimator.update(state, frame)
    return state


def error(estimator, state, view, position, orientation):
    truth = jacobian(view, position[-1], quaternion.to_matrix(orientation[-1]).numpy()) * SCALE
    pose = Pose(torch.from_numpy(position[-1]), orientation[-1])
    return float((estimator.jacobian(state, pose) * SCALE - truth).norm() / truth.norm())


def search(estimator, rng, degrees, distance, roll, length=0.1):
    """Eight cameras that were moved, searched for in one batch: views, paths and the state."""
    views = [moved(rng, degrees, distance, rng.uniform(-roll, roll)) for _ in range(8)]
    paths = [path(rng, length) for _ in views]
    feature = [seen(view, *way, rng) for view, way in zip(views, paths, strict=True)]
    position, orientation = (np.stack(x) for x in zip(*paths, strict=True))
    frames = measurements(position, torch.from_numpy(orientation), torch.stack(feature))
    return views, paths, run(estimator, estimator.initial_state(8), frames)


@pytest.mark.parametrize(("roll", "bound"), [(0.0, 0.05), (np.pi, 0.1)])
@pytest.mark.simulation
def test_a_moved_camera_is_found_within_ten_centimetres(network, roll, bound):
    estimator, rng = CameraEstimator(network), np.random.default_rng(1)
    views, paths, state = search(estimator, rng, 10 if roll == 0 else 5, 0.1, roll)

    def errors(state):
        states = (_pytree.tree_map(lambda x, k=k: x[k], state) for k in range(8))
        return [
            error(estimator, one, view, *way)
            for one, view, way in zip(states, views, paths, strict=True)
        ]

    found, before = errors(state), errors(estimator.initial_state(8))
    assert np.sort(found)[-2] < bound  # in seven of eight
    assert np.median(before) > 5 * np.median(found)


@pytest.mark.simulation
def test_a_bump_is_noticed_and_the_camera_is_found_again(network):
    estimator, rng = CameraEstimator(network), np.random.default_rng(2)
    position, orientation = path(rng, 0.2, 80)
    view = moved(rng, 5, 0.05, 0.1)
    feature = torch.cat(
        [
            seen(v, position[part], orientation[part], rng)
            for v, part in ((VIEW, slice(40)), (view, slice(40, None)))
        ]
    )
    frames = measurements(position, orientation, feature)
    still = run(estimator, estimator.initial_state(), frames[:40])
    assert int(still.moves) == 0
    state = run(estimator, still, frames[40:])
    assert int(state.moves) == 1
    assert error(estimator, state, view, position, orientation) < 0.05
    # A marker half hidden in one image is no moved camera.
    wrong = replace(frames[39], feature=frames[39].feature + 9.0)
    assert int(run(estimator, still, [wrong, *frames[38:40]]).moves) == 0


def test_a_batch_is_its_elements_and_what_is_not_seen_teaches_nothing(network):
    estimator, rng = CameraEstimator(network, CameraConfig(frames=12)), np.random.default_rng(3)
    paths = [path(rng, 0.05, 12) for _ in range(3)]
    position, orientation = np.stack([p for p, _ in paths]), torch.stack([q for _, q in paths])
    feature = torch.stack([seen(VIEW, *p, rng) for p in paths])
    frames = measurements(position, orientation, feature)
    together = run(estimator, estimator.initial_state(3), frames)
    for i in range(3):
        frames = measurements(position[i], orientation[i], feature[i])
        alone = run(estimator, estimator.initial_state(), frames)
        assert_close(together.best[i], alone.best, rtol=1e-6, atol=1e-6)
        assert_close(together.weight[i], alone.weight, rtol=1e-5, atol=1e-5)
        blind = replace(
            frames[0], valid=torch.tensor(False), feature=torch.full((2,), torch.nan)
        )
        assert_close(estimator.update(alone, blind).cameras, alone.cameras)


@pytest.mark.simulation
def test_an_image_is_a_surprise_beyond_five_deviations_and_the_least_error(network):
    config = CameraConfig(frames=12)
    estimator, rng = CameraEstimator(network, config), np.random.default_rng(2)
    position, orientation = path(rng, 0.06, 20)
    frames = measurements(position, orientation, seen(VIEW, position, orientation, rng))
    state = run(estimator, estimator.initial_state(), frames[:-1])
    last = frames[-1]
    at = Pose(last.pose.position[None], last.pose.orientation[None])

    def pixel(step):
        return marker_pixels(stepped(state.best, step), at)[0][0]

    zero = torch.zeros(13, dtype=torch.float64)
    steps = 1e-6 * torch.eye(13, dtype=torch.float64)
    slope = torch.stack([(pixel(d) - pixel(-d)) / 2e-6 for d in steps], dim=-1)
    deviation = (slope @ state.covariance @ slope.mT).diagonal().max().sqrt()
    limit = 4.0 + 5 * (float(deviation) + 0.25)
    towards = torch.tensor([0.6, -0.8]).double()
    for far, surprises in ((0.98, 0), (1.02, 1)):
        off = replace(last, feature=pixel(zero) + far * limit * towards)
        assert int(run(estimator, state, [off]).surprises) == surprises
    # An image without the marker says nothing.
    surprised = replace(state, surprises=torch.tensor(2.0).double())
    unseen = replace(last, valid=torch.tensor(False))
    assert int(run(estimator, surprised, [unseen]).surprises) == 2
    assert int(run(estimator, surprised, [last]).surprises) == 0


@pytest.mark.simulation
def test_the_covariance_of_the_camera_covers_its_error(network):
    """The pixel of a point 25 cm below the marker, in predicted deviations."""
    estimator, scores = CameraEstimator(network), []
    found = search(estimator, np.random.default_rng(4), 5, 0.05, 3, length=0.15)
    for k, (view, (position, orientation)) in enumerate(zip(*found[:2], strict=True)):
        best, covariance = found[2].best[k], found[2].covariance[k]
        points = best[10:] - torch.tensor([0.0, 0.0, -0.25]).double()
        lowered = torch.cat([best[:10], points])
        pose = Pose(torch.from_numpy(position[-1:]), orientation[-1:])
        pixel, slope = marker_pixels(lowered, pose)
        matrix = quaternion.to_matrix(orientation[-1]).numpy()
        offset = matrix @ (points.numpy() - LEVER)
        truth = pixels(view, position[-1] + offset, matrix)[0]
        spread = (slope[0] @ covariance @ slope[0].mT).trace().sqrt()
        scores.append(float(np.linalg.norm(pixel[0].numpy() - truth)) / float(spread))
    assert np.median(scores) < 2.5
    assert np.max(scores) < 8


def test_the_spread_is_the_covariance_and_the_other_hypotheses(network):
    """Linear functions vary by the covariance; a hypothesis counts by its probability."""
    estimator = CameraEstimator(network, CameraConfig(hypotheses=2))
    state = estimator.initial_state()
    rng = torch.Generator().manual_seed(0)
    root = 1e-4 * torch.randn(13, 13, generator=rng).double()
    other = state.best + 0.01
    state = replace(
        state,
        covariance=root @ root.mT,
        cameras=torch.stack([state.best, other]),
        cost=torch.tensor([1.0, 2.5]).double(),
    )
    spread = state.spread()
    assert_close(spread.samples[0], state.best)
    away, weights = spread.samples[1:14] - state.best, spread.weights[:13]
    parts = [k for k in range(13) if k not in range(*ROTATION.indices(13))]  # which add
    found = (weights * away.mT) @ away
    assert_close(found[parts][:, parts], state.covariance[parts][:, parts], rtol=1e-6, atol=0)
    assert_close(spread.samples[14:], state.cameras)
    odds = np.exp([-1.0, -2.5])
    assert_close(spread.weights[13:], torch.from_numpy(odds / odds.sum()))


def test_a_network_without_a_camera_is_refused():
    plain = RBFImageJacobian.from_jacobian(torch.zeros(2, 6), paper_grid(), 0.1)
    with pytest.raises(ValueError, match="has no camera: fit it again"):
        CameraEstimator(plain)
    with pytest.raises(ValueError, match="frames must be positive"):
        CameraConfig(frames=0)


def test_it_is_exported(network):
    estimator = CameraEstimator(network, CameraConfig(frames=4, hypotheses=2))
    rng = np.random.default_rng(5)
    position, orientation = path(rng, 0.04, 6)
    frames = measurements(position, orientation, seen(VIEW, position, orientation, rng))

    class Step(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.estimator = estimator

        def forward(self, state, frame):
            return self.estimator.update(state, frame)

    with shapes_unchecked(), torch.no_grad():
        state = estimator.initial_state()
        ready = [replace(f, dt=torch.tensor(0.04).double()) for f in frames]
        exported = torch.export.export(Step(), (state, ready[0])).module()
        for frame in ready:
            expected = estimator.update(state, frame)
            state = exported(state, frame)
            assert_close(state.best, expected.best, rtol=1e-7, atol=1e-7)
