"""A camera that was moved is found again online; truth and images are OpenCV's."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
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
from hrc_learn.jacobian.camera_estimator import _shortened
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


@pytest.fixture(scope="module")
@torch.inference_mode(False)
def searching(network):
    """An estimator before a search: 11 frames in a window of 16, one of them far off."""
    config = CameraConfig(frames=16, hypotheses=2, residual=200.0)
    estimator, rng = CameraEstimator(network, config), np.random.default_rng(7)
    position, orientation = path(rng, 0.2, 12)
    position[6:] += [0.0, 0.12, 0.0]  # too far from the frame before to follow the residual
    view = moved(rng, 3, 0.03, 0.1)
    feature = seen(view, position, orientation, rng)
    feature[4] += 8.0
    frames = measurements(position, orientation, feature)
    before = estimator.initial_state()
    with shapes_unchecked():
        for frame in frames[:11]:
            before, _ = estimator._with_key_frame(before, frame, torch.tensor(True))
    return estimator, frames[:11], before, estimator._searched(before)


def whitened(estimator, frames, state, camera):
    """Errors of frames, camera and residual in deviations, by step and weights, both zero.

    The weights of the residual stay unknowns, so there is nothing to integrate out.
    """
    network, config = estimator.network, estimator.config
    scale = np.array([1, 1, 1, 0.15, 0.15, 0.15])
    regressors, place = [], np.zeros(6 * len(network.centers))
    for old, new in zip([None, *frames], frames, strict=False):
        if old is not None:
            turn = Rotation.from_quat(new.pose.orientation, scalar_first=True)
            turn = turn * Rotation.from_quat(old.pose.orientation, scalar_first=True).inv()
            twist = np.append(new.pose.position - old.pose.position, turn.as_rotvec())
            theta = (network.basis(old.pose) + network.basis(new.pose)).detach().numpy() / 2
            if np.linalg.norm(twist * scale) <= config.max_step:
                place = place + np.outer(twist * scale, theta).ravel()
        regressors.append(place)
    phi = torch.from_numpy(np.array(regressors))
    first = network.weight.detach().unflatten(0, (2, 6)) / torch.from_numpy(scale)[:, None]
    target = torch.stack([frame.feature for frame in frames]) - phi @ first.flatten(1).mT
    poses = Pose(
        *(
            torch.stack([getattr(f.pose, n) for f in frames])
            for n in ("position", "orientation")
        )
    )
    off = (target - marker_pixels(state.best, poses)[0]).norm(dim=-1)
    most = 3 * max(float(off.sort().values[(len(off) - 1) // 2]), config.pixel_noise)
    noise = config.pixel_noise * (off / most).clamp_min(1.0)
    prior = torch.linalg.cholesky(
        estimator.precision[estimator.precision.diagonal() > 0][
            :, estimator.precision.diagonal() > 0
        ]
    ).mT
    known = [0, 1, 2, 3, 10, 11, 12]
    home = Rotation.from_rotvec(estimator.reference[4:7]).as_matrix()
    eye = -home.T @ estimator.reference[7:10].numpy()
    root = torch.linalg.cholesky(estimator.residual).mT

    def errors(step, change):
        near = stepped(camera, step)
        images = (target - marker_pixels(near, poses)[0] - phi @ change) / noise[:, None]
        R = quaternion.to_matrix(quaternion.exp(near[ROTATION]))
        # The axis of view among the camera's axes in the demonstrations.
        tilt = (torch.from_numpy(home) @ R[2])[:2] / config.tilt
        shift = (-R.mT @ near[7:10] - torch.from_numpy(eye)) / config.place
        optics = prior @ (near - estimator.reference)[known]
        weights = torch.linalg.solve_triangular(root.mT, change, upper=False)
        return torch.cat([images.flatten(), tilt, shift, optics, 0.1 * step, weights.flatten()])

    return errors, 2 * len(frames), phi.shape[1]


def test_a_search_step_is_that_of_camera_and_residual_together(searching):
    estimator, frames, before, after = searching
    best = int(after.cost.argmin())
    for k, camera in enumerate(before.cameras):
        errors, images, size = whitened(estimator, frames, before, camera)
        zero = torch.zeros(13).double(), torch.zeros(size, 2).double()
        with shapes_unchecked():
            slopes = torch.func.jacfwd(errors, argnums=(0, 1))(*zero)
        slope = torch.cat([slopes[0], slopes[1].flatten(1)], dim=-1)
        start = errors(*zero)
        solution = -torch.linalg.lstsq(slope, start[:, None]).solution[:, 0]
        step = solution[:13]
        long = max(float(step[4:7].norm()) / 0.4, float(step[7:10].norm()) / 0.15, 1.0)
        expected = stepped(camera, step / long)
        torch.testing.assert_close(after.cameras[k], expected, rtol=1e-5, atol=1e-6)
        # Of all weights of the residual, the best ones for this camera.
        by_weight = slope[:, 13:]
        fitted = -torch.linalg.lstsq(by_weight, start[:, None]).solution[:, 0]
        least = (start + by_weight @ fitted).square().sum() / 2
        turn = Rotation.from_rotvec(camera[4:7])
        roll = turn * Rotation.from_rotvec(estimator.reference[4:7]).inv()
        assert float(after.cost[k]) == pytest.approx(float(least) + 0.05 * roll.magnitude())
        if k != best:
            continue
        hessian = slope.mT @ slope
        errors, *_ = whitened(estimator, frames, before, after.cameras[k])
        left = errors(*zero)
        # Rows of errors by the weights do not depend on the camera.
        fitted = -torch.linalg.lstsq(by_weight, left[:, None]).solution[:, 0]
        own = fitted.reshape(size, 2).mT.unflatten(-1, (6, -1))
        own = own * torch.tensor([1, 1, 1, 0.15, 0.15, 0.15]).double()[:, None]
        change = after.weight - estimator.initial_weight()
        assert change.abs().max() > 1
        torch.testing.assert_close(change, own.flatten(0, 1), rtol=1e-5, atol=1e-4)
        rest = left + by_weight @ fitted
        # Images explain; the prior of the weights is part of what is left of them.
        misfit = rest[:images].square().sum() + rest[images + 25 :].square().sum()
        factor = max(float(misfit) / (images - 13 + 7), 1.0)
        assert factor > 1
        expected = torch.linalg.inv(hessian)[:13, :13] * factor
        size_ = expected.diagonal().sqrt()
        torch.testing.assert_close(
            after.covariance / size_ / size_[:, None],
            expected / size_ / size_[:, None],
            rtol=1e-4,
            atol=1e-4,
        )


def test_key_frames_are_apart_and_none_is_taken_while_images_surprise(network):
    config = CameraConfig(frames=4, hypotheses=1)
    estimator = CameraEstimator(network, config)
    still = torch.tensor([0.0, 1.0, 0.0, 0.0]).double()
    start, along = torch.tensor([[0.25, 0.5, 0.25], [1, 0, 0]]).double()

    def frame(shift=0.0, turn=0.0):
        spin = quaternion.exp(torch.tensor([0.0, 0.0, turn]).double())
        return Measurement(
            pose=Pose(start + shift * along, quaternion.multiply(spin, still)),
            feature=700 + shift * along[:2],
            valid=torch.tensor(True),
            dt=0.04,
            xi_x=torch.zeros(2).double(),
            xi_r=torch.zeros(6).double(),
        )

    def add(state, *new):
        return estimator._with_key_frame(state, frame(*new), torch.tensor(True))

    state, calm = add(estimator.initial_state())
    assert calm
    assert state.known.tolist() == [False, False, False, True]
    # 6 mm, or a turn of 40 mrad.
    for new, count in (((0.0059,), 1), ((0.0061,), 2), ((0.0, 0.039), 1), ((0.0, 0.041), 2)):
        assert int(add(state, *new)[0].known.sum()) == count
    surprised = replace(state, surprises=torch.tensor(1.0).double())
    after, calm = add(surprised, 0.05)
    assert not calm
    assert int(after.known.sum()) == 1
    for k in range(1, 6):
        state, _ = add(state, 0.01 * k)
    assert bool(state.known.all())
    shifts = 0.01 * torch.arange(2, 6).double()
    assert_close(state.pixel[:, 0], 700 + shifts)
    assert_close(state.position[:, 0], 0.25 + shifts)


def test_turns_about_the_optical_axis_turn_the_image_about_its_middle(network):
    estimator = CameraEstimator(network, CameraConfig(hypotheses=4, frames=4))
    state = estimator.initial_state()
    position, orientation = path(np.random.default_rng(0), 0.1, 6)
    pose = Pose(torch.from_numpy(position), orientation)
    middle = network.camera[1:3]
    off = marker_pixels(state.cameras, pose)[0] - middle
    for k in range(4):
        turn = Rotation.from_euler("z", np.pi / 2 * k).as_matrix()[:2, :2]
        assert_close(off[k], off[0] @ torch.from_numpy(turn).mT, rtol=0, atol=1e-4)
    angles = torch.tensor([0, np.pi / 2, np.pi, np.pi / 2]).double()
    assert_close(state.cost, 0.05 * angles, rtol=1e-6, atol=1e-6)
    assert_close(state.best, network.camera)
    batch = estimator.initial_state(2)
    assert_close(batch.cameras, state.cameras.expand(2, 4, 13))


def test_before_any_image_the_camera_is_as_uncertain_as_its_prior(network):
    config = CameraConfig(hypotheses=2, frames=4, tilt=0.2, place=0.05, marker=2e-3)
    estimator = CameraEstimator(network, config)
    covariance = estimator.initial_state().covariance
    camera, optics = estimator.reference, network.camera_covariance
    known = [0, 1, 2, 3, 10, 11, 12]
    wider = optics[known][:, known] + torch.diag(torch.tensor([0.0] * 4 + [4e-6] * 3)).double()
    assert_close(estimator.precision[known][:, known] @ wider, torch.eye(7).double())
    assert int((estimator.precision != 0).sum()) == 49

    def prior(step):
        near = stepped(camera, step)
        R, home = (quaternion.to_matrix(quaternion.exp(c[ROTATION])) for c in (near, camera))
        tilt = (home @ R[2])[:2] / 0.2
        eyes = [-r.mT @ c[7:10] for r, c in ((R, near), (home, camera))]
        return torch.cat([tilt, (eyes[0] - eyes[1]) / 0.05, 0.1 * step])

    with shapes_unchecked():
        slope = torch.func.jacfwd(prior)(torch.zeros(13).double())
    precision = slope.mT @ slope + estimator.precision
    assert_close(covariance @ precision, torch.eye(13).double(), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("turn", "move", "factor"), [(0.3, 0.1, 1), (0.8, 0.1, 2), (0.2, 0.45, 3), (0.8, 0.6, 4)]
)
def test_a_long_step_is_shortened_as_a_whole(turn, move, factor):
    step = torch.full((13,), 0.01).double()
    step[4:7] = turn * torch.tensor([2.0, -1.0, 2.0]) / 3
    step[7:10] = move * torch.tensor([-2.0, 1.0, 2.0]) / 3
    assert_close(_shortened(step), step / factor)
    assert_close(_shortened(torch.stack([step, 0 * step]))[1], 0 * step)


def test_of_a_batch_only_those_that_see_the_marker_and_are_not_surprised_learn(network):
    estimator, rng = CameraEstimator(network, CameraConfig(frames=8)), np.random.default_rng(6)
    position, orientation = path(rng, 0.08, 8)
    feature = seen(VIEW, position, orientation, rng)
    many = [torch.stack([x] * 3) for x in (torch.from_numpy(position), orientation, feature)]
    frames = measurements(many[0].numpy(), *many[1:])
    state = run(estimator, estimator.initial_state(3), frames[:-1])
    far = torch.tensor([[0.0, 0.0], [0.0, 0.0], [200.0, 0.0]]).double()
    last = replace(
        frames[-1],
        valid=torch.tensor([True, False, True]),
        feature=frames[-1].feature + far,
    )
    after = run(estimator, state, [last])
    changed = (after.cameras != state.cameras).flatten(1).any(-1)
    assert changed.tolist() == [True, False, False]
    assert after.surprises.tolist() == [0, 0, 1]
    assert_close(after.position[1:], state.position[1:], rtol=0, atol=0)


@pytest.mark.simulation
def test_a_frame_beyond_three_times_the_median_error_counts_by_its_excess_squared(network):
    """Errors of 1, 2, 2, 3 and 12 px, on either side: the last is twice beyond 6 px."""
    estimator = CameraEstimator(network, CameraConfig(frames=6, pixel_noise=0.5))
    there = Pose(
        torch.tensor([0.25, 0.5, 0.2]).double().expand(6, 3),
        torch.tensor([0.0, 1.0, 0.0, 0.0]).double().expand(6, 4),
    )
    state = SimpleNamespace(
        best=network.camera,
        position=there.position,
        orientation=there.orientation,
        known=torch.tensor([False, True, True, True, True, True]),
    )
    off = torch.tensor([50.0, 1.0, -2.0, 2.0, -3.0, 12.0]).double()[:, None]
    aside = off * torch.tensor([0.6, 0.8]).double()
    pixel = marker_pixels(network.camera, there)[0] + aside
    with shapes_unchecked():
        found = estimator._information(state, pixel, torch.zeros(6, 6).double())
    # The inverse of 0.5 px squared; unknown frames count nothing.
    assert_close(found, torch.diag(torch.tensor([1e-6, 4, 4, 4, 4, 1]).double()))
