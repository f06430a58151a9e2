"""A camera found from motion, against OpenCV's."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from pinhole import wander
from sampling import generator
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from unchecked import shapes_unchecked

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import (
    ImageDemonstration,
    ImageJacobianFitConfig,
    KalmanEstimator,
    Measurement,
    RBFCenters,
    RBFImageJacobian,
    fit_camera,
)
from hrc_learn.jacobian.perspective import (
    FOCAL,
    RADIAL,
    CameraFit,
    _cube_rotations,
    _from_prior,
    _inflation,
    _prior,
    _sampled,
    _searched,
    _shifts,
    _starts,
    adjust_bundle,
    camera_jacobian,
    eye_by_step,
    eye_of,
    marker_pixels,
    marker_points,
    on_plane,
    pixels_and_depth,
    rays,
    stepped,
    unexplained,
)
from hrc_learn.kinematics import panda

IMAGE = (1440, 1080)
CENTER = np.array(IMAGE) / 2


def camera(rng):
    """Rotation vector and translation of a camera that looks at the origin from about 1 m."""
    rotation = np.array([np.pi, 0.0, 0.0]) + rng.normal(0, 0.3, 3)
    return rotation, np.array([*rng.normal(0, 0.05, 2), rng.uniform(0.8, 1.3)])


def seen(points, rotation, shift, focal):
    """Pixels of points by OpenCV, and their derivatives by the place."""
    matrix = np.array([[focal, 0, CENTER[0]], [0, focal, CENTER[1]], [0, 0, 1.0]])
    pixels, jacobian = cv2.projectPoints(points, rotation, shift, matrix, None)
    # A point that moves by d moves the camera's frame by R d.
    by_shift = jacobian[:, 3:6].reshape(-1, 2, 3)
    return pixels[:, 0], by_shift @ cv2.Rodrigues(rotation)[0]


def demonstration(rng, rotation, shift, focal, marker, frames=200, noise=0.1):
    """A tool that moves and turns before a camera, its marker unseen now and then."""
    along = np.linspace(0, 1, frames)[:, None]
    ends = rng.uniform(-0.1, 0.1, (2, 3)) * [1, 1, 0.6]
    place = ends[0] + along * (ends[1] - ends[0])
    turn = quaternion.exp(torch.from_numpy(along * rng.normal(0, 0.5, 3)))
    pose = Pose(torch.from_numpy(place), turn)
    pixels, _ = seen(pose.apply(torch.from_numpy(marker)).numpy(), rotation, shift, focal)
    visible = torch.from_numpy(rng.random(frames) > 0.1)
    pixels[~visible.numpy()] = np.nan
    feature = torch.from_numpy(pixels + rng.normal(0, noise, pixels.shape))
    return ImageDemonstration(pose=pose, feature=feature, visible=visible)


@pytest.mark.parametrize("focal", [900.0, pytest.param(2000.0, marks=pytest.mark.long)])
def test_the_focal_length_is_found_from_motion(focal):
    rng = np.random.default_rng(1)
    rotation, shift = camera(rng)
    marker = np.array([0.0, 0.12, 0.03])
    demos = [demonstration(rng, rotation, shift, focal, marker) for _ in range(6)]
    found = fit_camera(demos, IMAGE)
    assert float(found.camera[0].exp()) == pytest.approx(focal, rel=0.005)
    # Some frames of another marker do not lead it astray.
    wrong = demos[0].feature.clone()
    wrong[50:60] += 300.0
    demos[0] = replace(demos[0], feature=wrong)
    found = fit_camera(demos, IMAGE)
    assert float(found.camera[0].exp()) == pytest.approx(focal, rel=0.01)


def test_motion_that_tells_nothing_leaves_the_width_of_the_image():
    rng = np.random.default_rng(2)
    rotation, shift = np.array([np.pi, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    place = torch.zeros(50, 3, dtype=torch.float64)
    place[:, 0] = torch.linspace(-0.01, 0.01, 50)
    still = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(50, 4)
    pixels, _ = seen(place.numpy(), rotation, shift, 3000.0)
    feature = torch.from_numpy(pixels + rng.normal(0, 0.1, pixels.shape))
    demo = ImageDemonstration(
        pose=Pose(place, still), feature=feature, visible=torch.ones(50, dtype=torch.bool)
    )
    found = fit_camera([demo], IMAGE)
    assert float(found.camera[0].exp()) == pytest.approx(IMAGE[0], rel=0.5)
    assert found.deviation(FOCAL) > 0.1


def bundle(rng, points=12, noise=0.0):
    """Points of a link that moves before a camera: true cameras, poses and pixels by OpenCV."""
    rotation, shift = camera(rng)
    pose = demonstration(rng, rotation, shift, 1500.0, np.zeros(3), frames=30).pose
    places = rng.uniform(-0.08, 0.08, (points, 3))
    pixels = np.stack(
        [
            seen(pose.apply(torch.from_numpy(m)).numpy(), rotation, shift, 1500.0)[0]
            for m in places
        ]
    )
    pixels += rng.normal(0, noise, pixels.shape)
    pixels[rng.random(pixels.shape[:2]) < 0.3] = np.nan
    optics = [np.log(1500.0), *CENTER, 0.0, *rotation, *shift]
    true = np.concatenate([np.tile(optics, (points, 1)), places], axis=1)
    return torch.from_numpy(true), pose, torch.from_numpy(pixels)


# From a camera that one track alone found: some degrees, centimetres and per cent off.
_OFF = torch.tensor(
    [0.05, 8, -5, 0.02, 0.03, -0.02, 0.02, 0.02, -0.01, 0.04, 0, 0, 0], dtype=torch.float64
)


def test_many_points_give_the_camera_in_spite_of_wrong_matches():
    rng = np.random.default_rng(3)
    true, pose, pixels = bundle(rng, noise=0.3)
    wrong = torch.from_numpy(rng.random(pixels.shape[:2]) < 0.15)
    pixels[wrong] += 40.0
    start = stepped(true, _OFF) + torch.from_numpy(rng.normal(0, 0.01, true.shape)) * (
        torch.arange(13) >= 10
    )
    found = start
    for reach in (16.0, 4.0):
        found = adjust_bundle(found, pose, pixels, IMAGE, reach)
    assert (found[:, :10] == found[0, :10]).all()
    error = (marker_pixels(found, pose)[0] - marker_pixels(true, pose)[0]).norm(dim=-1)
    before = (marker_pixels(start, pose)[0] - marker_pixels(true, pose)[0]).norm(dim=-1)
    assert before.median() > 10
    assert error.quantile(0.95) < 0.5


def test_no_small_step_improves_an_adjusted_bundle():
    """The gradient of the robust cost by autograd vanishes, by the camera and by each point."""
    rng = np.random.default_rng(4)
    true, pose, pixels = bundle(rng, points=6, noise=0.3)
    known, reach = pixels.isfinite().all(-1), 3.0

    def gradient(cameras):
        shared = torch.zeros(10, dtype=torch.float64, requires_grad=True)
        own = torch.zeros(6, 3, dtype=torch.float64, requires_grad=True)
        near = stepped(cameras, torch.cat([shared.expand(6, 10), own], dim=-1))
        square = (marker_pixels(near, pose)[0] - pixels)[known].square().sum(-1)
        cost = (reach**2 * square / (reach**2 + square)).sum()
        cost = cost + ((near[0, 0] - np.log(1440)) / 0.5) ** 2
        cost = cost + ((near[0, 1:3] - torch.from_numpy(CENTER)) / 28.8).square().sum()
        cost = cost + (near[0, 3] / 0.2) ** 2 + (near[0, 7:10] / 10).square().sum()
        cost = cost + (near[:, 10:] / 0.2).square().sum()
        return torch.autograd.grad(cost, [shared, own])

    start = stepped(true, 0.3 * _OFF)
    found = adjust_bundle(start, pose, pixels, IMAGE, reach)
    for before, after in zip(gradient(start), gradient(found), strict=True):
        assert after.norm() < 1e-3 * before.norm()


# A lens with tangential distortion, and a principal point off the middle: more than the model
# has parameters for.
INTRINSICS = np.array([[1900.0, 0, 731.0], [0, 1900.0, 528.0], [0, 0, 1.0]])
LENS = np.array([-0.06, 0.02, 5e-4, -3e-4])
LEVER = np.array([-0.008, 0.145, -0.083])
TURN = np.array([np.pi - 0.2, 0.1, 0.05])
# From 1.2 m above the arm's ready posture.
VIEW = TURN, -cv2.Rodrigues(TURN)[0] @ np.array([0.35, 0.15, 1.75])
EYE = np.array([0.35, 0.15, 1.75])


def true_pixels(position, matrix):
    """Pixels of the marker by OpenCV."""
    points = position + matrix @ LEVER
    return cv2.projectPoints(points, *VIEW, INTRINSICS, LENS)[0][:, 0]


def guided(rng, frames=160, offset: float | torch.Tensor = 0.0):
    """A hand-guided demonstration, as encoders with constant errors [rad] report it."""
    time, joints = np.linspace(0, 1, frames)[:, None], panda.ready.numpy()
    blend = time**3 * (10 - 15 * time + 6 * time**2)
    start, goal = rng.normal(0, 0.12, (2, 7))
    sway = 0.03 * np.sin(2 * np.pi * time * rng.uniform(0.5, 2, 7))
    path = torch.from_numpy(joints + start + blend * (goal - start) + sway)
    true = panda.forward(path)
    position, matrix = true.position.numpy(), quaternion.to_matrix(true.orientation).numpy()
    pixels = true_pixels(position, matrix) + rng.normal(0, 0.1, (frames, 2))
    demo = ImageDemonstration(
        pose=panda.forward(
            path + offset + 1e-4 * torch.from_numpy(rng.normal(0, 1, (frames, 7)))
        ),
        feature=torch.from_numpy(pixels),
        visible=torch.ones(frames, dtype=torch.bool),
    )
    return demo, position, matrix


def true_jacobian(position, matrix):
    """Image Jacobian of the marker by central differences of OpenCV's projection."""
    columns, step = [], 1e-5
    for axis in range(6):
        ends = []
        for sign in (1, -1):
            twist = np.zeros(6)
            twist[axis] = sign * step
            turn = cv2.Rodrigues(twist[3:])[0]
            ends.append(true_pixels(position + twist[:3], turn @ matrix))
        columns.append((ends[0] - ends[1]) / (2 * step))
    return torch.from_numpy(np.stack(columns, axis=-1))


def error_against(network, demonstrations):
    """Median relative error of the image Jacobian, a radian counted as 0.15 m."""
    scale, errors = torch.tensor([1, 1, 1, 1 / 0.15, 1 / 0.15, 1 / 0.15]).double(), []
    for demo, position, matrix in demonstrations:
        truth = true_jacobian(position, matrix)[::10] * scale
        with torch.no_grad():
            off = network(demo.pose[::10]) * scale - truth
        errors.append(off.flatten(1).norm(dim=1) / truth.flatten(1).norm(dim=1))
    return float(torch.cat(errors).median())


LONGER = [pytest.param(*case, marks=pytest.mark.long) for case in [(4, 0.01), (8, 0.005)]]


@pytest.mark.parametrize(("number", "bound"), [(1, 0.015), (2, 0.01), *LONGER])
def test_a_camera_comes_first_and_the_network_learns_the_rest(number, bound):
    """A single path hardly shows perspective: over 15 seeds its median error is 1.3 %."""
    rng = np.random.default_rng(3)
    # Zeros of the encoders, as of an ordinary laboratory.
    offset = torch.from_numpy(rng.uniform(-2e-3, 2e-3, 7))
    demos = [guided(rng, offset=offset)[0] for _ in range(number)]
    fresh = [guided(rng, offset=offset) for _ in range(4)]
    found, neurons = fit_camera(demos, IMAGE), RBFCenters.around(demos)
    config = ImageJacobianFitConfig.of_residual()
    network = RBFImageJacobian.fit(demos, neurons, config, found).double()
    assert error_against(network, fresh) < bound
    alone = RBFImageJacobian.fit(demos, neurons).double()
    assert error_against(alone, fresh) > 5 * error_against(network, fresh)
    np.testing.assert_allclose(eye_of(found.camera), EYE, atol=0.05)


@pytest.mark.long
@pytest.mark.simulation
def test_the_covariance_is_honest():
    """Errors of the camera's position in standard deviations of their covariance."""
    scores, eye = [], -cv2.Rodrigues(VIEW[0])[0].T @ VIEW[1]
    for seed in range(6):
        rng = np.random.default_rng(seed)
        found = fit_camera([guided(rng)[0] for _ in range(3)], IMAGE)
        by_step = eye_by_step(found.camera)
        covariance = (by_step @ found.covariance[4:10, 4:10] @ by_step.mT).numpy()
        error = np.asarray(eye_of(found.camera)) - eye
        scores.append(error @ np.linalg.solve(covariance, error) / 3)
        largest = np.sqrt(np.diag(covariance).max())
        assert found.place_deviation == pytest.approx(largest, rel=1e-12)
    # The mean over 18 coordinates; the lens is not quite that of the model.
    assert 0.3 < np.mean(scores) < 2.5


def random_camera(rng):
    rotation, shift = camera(np.random.default_rng(int(torch.randint(99, (), generator=rng))))
    values = [7.4, 700.0, 520.0, -0.06, *rotation, *shift, 0.01, 0.12, -0.05]
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize("seed", range(3))
def test_derivatives_are_those_of_autograd(seed):
    rng = generator(seed)
    view, pose = random_camera(rng), wander(5, rng=rng)
    pose = Pose(pose.position - torch.tensor([0.2, 0.5, 0.3]).double(), pose.orientation)
    _, by_step = marker_pixels(view, pose)
    zero = torch.zeros(13, dtype=torch.float64)
    with shapes_unchecked():
        expected = torch.func.jacfwd(lambda d: marker_pixels(stepped(view, d), pose)[0])(zero)
        torch.testing.assert_close(by_step, expected, rtol=1e-7, atol=1e-6)
        expected = torch.func.jacfwd(lambda d: eye_of(stepped(view, d)))(zero)[:, 4:10]
        torch.testing.assert_close(eye_by_step(view), expected, rtol=1e-9, atol=1e-12)

        def moved(twist):
            turned = quaternion.multiply(quaternion.exp(twist[3:]), pose.orientation)
            return marker_pixels(view, Pose(pose.position + twist[:3], turned))[0]

        expected = torch.func.jacfwd(moved)(zero[:6])
        torch.testing.assert_close(camera_jacobian(view, pose), expected, rtol=1e-7, atol=1e-6)


def test_the_uncertainty_of_a_network_includes_its_camera():
    """To first order in the camera's errors, which are independent of the weights'."""
    rng = generator(1)
    view, pose = random_camera(rng), wander(5, rng=rng)
    mixed = 1e-5 * torch.randn(13, 13, generator=rng, dtype=torch.float64)
    spread = mixed @ mixed.mT
    centers = torch.rand(4, 2, generator=rng, dtype=torch.float64)
    alone, network = (
        RBFImageJacobian(centers, 0.2, camera=fit)
        for fit in (None, CameraFit(camera=view, covariance=spread, noise=1.0))
    )
    alone.covariance = network.covariance = 0.02 * torch.eye(24, dtype=torch.float64)
    zero = torch.zeros(13, dtype=torch.float64)
    with shapes_unchecked():
        by_camera = torch.func.jacfwd(lambda d: camera_jacobian(stepped(view, d), pose))(zero)
    variance = (by_camera @ spread * by_camera).sum(-1)
    expected = alone.uncertainty(pose) ** 2 + variance.amax(-2)
    assert (variance.amax(-2) > 0.1 * expected).any()
    assert (variance.amax(-2) < 0.9 * expected).any()
    torch.testing.assert_close(network.uncertainty(pose) ** 2, expected, rtol=1e-3, atol=0)


def test_a_network_with_a_camera_survives_the_disk(tmp_path):
    rng = np.random.default_rng(4)
    demos = [guided(rng)[0] for _ in range(2)]
    found = fit_camera(demos, IMAGE)
    network = RBFImageJacobian.fit(demos, RBFCenters.around(demos), camera=found)
    network.save(tmp_path / "model")
    loaded, pose = RBFImageJacobian.load(tmp_path / "model"), demos[0].pose
    torch.testing.assert_close(loaded(pose), network(pose), rtol=0, atol=0)
    torch.testing.assert_close(loaded.uncertainty(pose), network.uncertainty(pose))
    assert loaded.camera_fit is not None
    assert "focal length" in str(loaded.camera_fit)


def test_demonstrations_without_the_marker_are_refused():
    demo = guided(np.random.default_rng(0))[0]
    unseen, enough = (replace(demo, visible=torch.arange(160) < seen) for seen in (9, 10))
    with pytest.raises(ValueError, match="visible in 9 frames"):
        fit_camera([unseen], IMAGE)
    fit_camera([enough], IMAGE)
    with pytest.raises(ValueError, match="no demonstrations to fit a camera to"):
        fit_camera([], IMAGE)


@pytest.mark.long
def test_estimators_learn_what_the_camera_leaves():
    """Of a camera that fits, nothing is left; of one that rolled, most is learned."""
    rng = np.random.default_rng(6)
    demos = [guided(rng)[0] for _ in range(3)]
    found = fit_camera(demos, IMAGE)
    network = RBFImageJacobian.fit(
        demos, RBFCenters.around(demos), ImageJacobianFitConfig.of_residual(), found
    ).double()
    (demo, *pose), steps = guided(rng), torch.eye(13, dtype=torch.float64)
    truth = true_jacobian(*pose)[-1]
    rolled = stepped(found.camera, 0.3 * steps[6])
    seen, _ = marker_pixels(rolled, demo.pose)
    turned = camera_jacobian(rolled, demo.pose)[-1]
    for feature, expected, prior, bound in (
        (demo.feature, truth, network.covariance, 0.02),
        (seen, turned, None, 0.15),
    ):
        network.covariance = prior
        estimator = KalmanEstimator(network)
        state = estimator.initial_state()
        with shapes_unchecked():
            for k in range(len(feature)):
                now = Measurement(
                    pose=demo.pose[k],
                    feature=feature[k],
                    valid=torch.tensor(True),
                    dt=0.04,
                    xi_x=torch.zeros_like(feature[k]),
                    xi_r=feature.new_zeros(6),
                )
                state = estimator.update(state, now)
        off = estimator.jacobian(state, demo.pose[-1]) - expected
        assert float(off.norm() / expected.norm()) < bound


def test_a_fit_says_where_the_camera_is():
    turn, place = Rotation.from_euler("xyz", [np.pi - 0.2, 0.1, 0.4]), np.array([0.3, 0.2, 1.4])
    marker, deviation = (0.012, -0.034, 0.056), np.arange(1, 14) * 1e-3
    c = [np.log(1234.0), 720, 540, 0, *turn.as_rotvec(), *-turn.apply(place), *marker]
    covariance = np.diag(deviation**2)
    covariance[4, 4] = -1e-20  # rounding
    fit = CameraFit(camera=torch.tensor(c), covariance=torch.from_numpy(covariance), noise=1.0)
    tilt = np.degrees(np.arccos(-turn.as_matrix()[2, 2]))

    def eye(step):
        turned = Rotation.from_rotvec(step[:3]) * turn
        return turned.inv().apply(turn.apply(place) - step[3:])

    steps = 1e-6 * np.eye(6)
    by_step = np.stack([(eye(step) - eye(-step)) / 2e-6 for step in steps], axis=-1)
    within = 1e3 * np.sqrt((by_step**2 @ np.diag(covariance)[4:10]).max())
    numbers = [float(x) for x in re.findall(r"-?\d+\.?\d*", str(fit))]
    expected = [*place, within, np.degrees(7e-3), tilt, 1234, 1.234, 12, -34, 56, 13.0]
    np.testing.assert_allclose(numbers, expected, atol=0.5)
    np.testing.assert_allclose(numbers[:3], place, atol=5e-4)
    np.testing.assert_allclose(numbers[3], within, atol=0.06)
    np.testing.assert_allclose(numbers[4], np.degrees(7e-3), atol=5e-3)
    down = CameraFit(
        camera=torch.tensor([7.0, 0, 0, 0, np.pi, 0, 0, 0, 0, 1, 0, 0, 0]).double(),
        covariance=torch.eye(13).double(),
        noise=1.0,
    )
    assert "its view 0 degrees from straight down" in str(down)


def test_a_fit_is_the_most_probable_camera_and_its_noise_that_of_the_images():
    """Errors that neighbours share and outliers: gradient and curvature of the robust cost."""
    rng = np.random.default_rng(8)
    rotation, shift = camera(rng)
    demos = [
        demonstration(rng, rotation, shift, 1300.0, np.array([0, 0.1, 0.03])) for _ in range(4)
    ]
    for k, demo in enumerate(demos):
        drift = rng.normal(0, 0.5, (8, 2)).repeat(25, axis=0)
        demo.feature[:] += torch.from_numpy(drift)
        demo.feature[20 * k : 20 * k + 5] += 30.0
    found = fit_camera(demos, IMAGE)
    seen = [demo.seen() for demo in demos]
    pose = Pose(*(torch.cat([getattr(p, n) for p, _ in seen]) for n in Pose.__annotations__))
    pixel = torch.cat([f for _, f in seen])
    assert 600 < len(pixel) < 800  # all frames count
    error = (pixel - marker_pixels(found.camera, pose)[0]).numpy()
    size = np.linalg.norm(error, axis=-1)
    # The median of a Rayleigh distribution is its scale times sqrt(2 ln 2).
    assert found.noise == pytest.approx(np.median(size) / np.sqrt(2 * np.log(2)), rel=5e-3)
    weight = np.minimum(1, 2.5 * found.noise / size)
    blocks = (weight[:, None] * error)[: len(error) // 25 * 25].reshape(-1, 25, 2)
    shared = (blocks.sum(1) ** 2).mean() / (25 * found.noise**2)
    assert 2 < shared < 25
    weight = torch.from_numpy(weight / (found.noise**2 * shared))
    spread = torch.tensor([0.5, 28.8, 28.8, 0.2, *[10.0] * 6, *[0.2] * 3]).double()
    mean = torch.tensor([np.log(1440), 720, 540, *[0.0] * 10]).double()

    def residuals(step):
        near = stepped(found.camera, step)
        off = (marker_pixels(near, pose)[0] - pixel) * weight.sqrt()[:, None]
        away = torch.cat([(near - mean)[:4], 0 * step[4:7], (near - mean)[7:]]) / spread
        return torch.cat([off.flatten(), away])

    zero = torch.zeros(13, dtype=torch.float64)
    with shapes_unchecked():
        slope = torch.func.jacfwd(residuals)(zero)
    # The prior of the rotation is flat about any place, yet counts in the curvature.
    gram = slope.mT @ slope + torch.diag(torch.tensor([*[0.0] * 4, *[0.01] * 3, *[0.0] * 6]))
    left = torch.linalg.solve(gram, slope.mT @ residuals(zero))
    deviation = found.covariance.diagonal().sqrt()
    assert float((left / deviation).abs().max()) < 0.02
    scale = deviation[:, None] * deviation
    torch.testing.assert_close(
        torch.linalg.inv(gram) / scale, found.covariance / scale, rtol=0, atol=0.02
    )


def test_exact_images_count_as_two_hundredths_of_a_pixel():
    rng = np.random.default_rng(9)
    rotation, shift = camera(rng)
    exact = [demonstration(rng, rotation, shift, 1300.0, np.zeros(3), 60, 0.0) for _ in "ab"]
    found = fit_camera(exact, IMAGE)
    assert found.noise == 0.02
    assert float(found.camera[0].exp()) == pytest.approx(1300.0, rel=2e-3)


def test_errors_that_neighbours_share_count_by_blocks_of_25():
    noise = torch.tensor([0.5, 1.0]).double()
    for frames, factor in ((24, 1.0), (25, 5.0), (49, 5.0), (50, 5.0)):
        alike = torch.full((2, frames, 2), 0.2**0.5).double() * noise[:, None, None]
        alike[:, frames // 25 * 25 :] = 100.0
        torch.testing.assert_close(_inflation(alike, noise), factor * torch.ones(2).double())
    alternating = torch.ones(2, 50, 2).double()
    alternating[:, ::2] = -1.0
    torch.testing.assert_close(_inflation(alternating, noise), torch.ones(2).double())
    wild = torch.full((2, 50, 2), 30.0).double()
    torch.testing.assert_close(_inflation(wild, noise), 25 * torch.ones(2).double())
    # A mean over blocks and both coordinates.
    some = torch.zeros(2, 100, 2).double()
    some[:, :25, 0] = 1.0
    torch.testing.assert_close(_inflation(some, noise), 25 / 8 / noise.square())


def test_the_search_starts_from_all_rotations_of_a_cube():
    found = Rotation.from_matrix(_cube_rotations().numpy())
    group = Rotation.create_group("O")
    nearest = [(group.inv() * rotation).magnitude().min() for rotation in found]
    assert len(found) == 24
    assert max(nearest) < 1e-6
    assert len({tuple(m.round().ravel()) for m in found.as_matrix()}) == 24


@pytest.mark.parametrize("factor", [0.6, 1.0, 1.7])
def test_a_start_is_the_camera_itself_if_its_axes_are_along_those_of_the_base(factor):
    rng = generator(1)
    place = torch.rand(40, 3, generator=rng).double() - 0.5
    still = torch.tensor([1.0, 0, 0, 0]).double().expand(40, 4)
    pose = Pose(place, still)
    prior, _ = _prior(IMAGE)
    own = prior.clone()
    own[0] = np.log(factor * IMAGE[0])
    own[4:7] = torch.tensor([0.0, np.pi / 2, 0.0])
    own[7:10] = torch.tensor([0.1, -0.2, 1.3])
    starts = _starts(pose, marker_pixels(own, pose)[0], prior, IMAGE[0])
    assert starts.shape == (72, 13)
    off = (marker_pixels(starts, pose)[0] - marker_pixels(own, pose)[0]).abs().amax((-2, -1))
    best = starts[off.argmin()]
    torch.testing.assert_close(best, own, rtol=0, atol=2e-5)
    # All of them have every frame in front.
    assert float(marker_points(starts, pose)[..., 2].min()) > 0.2 - 1e-9
    assert bool((starts[:, 10:] == 0).all())


def test_shifts_are_those_of_least_squares_in_front_of_all_frames():
    rng = np.random.default_rng(2)
    point, xi = rng.normal(0, 0.1, (3, 30, 3)), rng.normal(0, 0.2, (30, 2))
    point[2, :, 2] += 3.0  # far along the axis, where least squares ends behind the camera
    found = _shifts(torch.from_numpy(point), torch.from_numpy(xi)).numpy()
    rows = np.concatenate([np.tile(np.eye(2), (30, 1, 1)), -xi[..., None]], -1).reshape(-1, 3)
    weak = 1e-3 * np.sqrt(30)
    for x, t in zip(point, found, strict=True):
        right = (xi * x[:, 2:] - x[:, :2]).ravel()
        best = np.linalg.lstsq(
            np.vstack([rows, [0, 0, weak]]), np.append(right, weak * (1 - x[:, 2].mean()))
        )[0]
        np.testing.assert_allclose(t[:2], best[:2], atol=1e-9)
        assert t[2] == pytest.approx(max(best[2], 0.2 - x[:, 2].min()))
    # Points on one ray tell no depth: they are a metre away.
    same = torch.zeros(1, 30, 3).double()
    assert float(_shifts(same, torch.zeros(30, 2).double())[0, 2]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("demonstrations", "frames", "expected"),
    [
        (1, 1999, 1999),
        (1, 5000, 2500),
        (3, 700, 2100),
        (3, 1400, 2100),
        (2000, 1, 2000),
        (2001, 1, 1001),
        (4001, 1, 1334),
        (999, 10, 3996),
    ],
)
def test_frames_are_drawn_evenly_until_two_thousand_are_together(
    demonstrations, frames, expected
):
    place = torch.arange(frames).double()[:, None].expand(-1, 3)
    turn = torch.tensor([1.0, 0, 0, 0]).double().expand(frames, 4)
    demo = ImageDemonstration(
        pose=Pose(place, turn), feature=place[:, :2], visible=torch.ones(frames).bool()
    )
    with shapes_unchecked():
        pose, pixel = _sampled([demo] * demonstrations)
    assert len(pixel) == len(pose.position) == len(pose.orientation) == expected
    assert torch.equal(pose.position[:, :2], pixel)
    steps = pixel[:, 0].diff()
    assert len(steps[steps > 0].unique()) <= 1


def test_a_pixel_of_a_plane_leads_back_to_its_point():
    rng = np.random.default_rng(7)
    rotation, shift = camera(rng)
    lens, height = -0.15, 0.1
    points = np.column_stack([rng.uniform(-0.3, 0.3, (20, 2)), np.full(20, height)])
    matrix = np.array([[1400.0, 0, 731], [0, 1400, 528], [0, 0, 1]])
    pixels = cv2.projectPoints(points, rotation, shift, matrix, np.array([lens, 0, 0, 0]))[0]
    values = [np.log(1400.0), 731, 528, lens, *rotation, *shift, 0, 0, 0]
    view, pixel = torch.tensor(values).double().expand(20, 13), torch.from_numpy(pixels[:, 0])
    np.testing.assert_allclose(on_plane(view, pixel, height), points, atol=1e-9)
    np.testing.assert_allclose(on_plane(view[0], pixel[0], height), points[0], atol=1e-9)
    turn = cv2.Rodrigues(rotation)[0]
    np.testing.assert_allclose(eye_of(view[0]), -turn.T @ shift, atol=1e-12)
    ray = rays(view, pixel).numpy() @ turn.T
    there = points @ turn.T + shift
    np.testing.assert_allclose(ray, there / there[:, 2:], atol=1e-9)


def test_points_behind_a_camera_have_finite_pixels_far_off():
    view = torch.tensor([7.0, 700, 500, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]).double()
    points = torch.tensor([[0.1, 0.2, -1.0], [0.1, 0.2, 0.0], [0.1, 0.2, 1e-3]]).double()
    pixel, slope = pixels_and_depth(view, points)
    far = np.exp(7.0) * np.array([100.0, 200.0]) + [700, 500]
    np.testing.assert_allclose(pixel, np.tile(far, (3, 1)))
    assert bool(slope.isfinite().all())
    # Derivatives by the camera are those of these pixels, which are linear in the lens.
    upright = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(3, 4)
    _, by_step = marker_pixels(view, Pose(points, upright))
    lens = torch.zeros_like(view)
    lens[RADIAL] = 1e-4
    through, _ = pixels_and_depth(view + lens, points)
    np.testing.assert_allclose(by_step[..., 3], (through - pixel) / 1e-4, rtol=1e-9)
    np.testing.assert_allclose(by_step[..., 0], np.tile(far - [700, 500], (3, 1)))


def test_a_camera_is_left_out_of_a_feature():
    demo = guided(np.random.default_rng(1), frames=5)[0]
    view = random_camera(generator(4))
    (left,) = unexplained([demo], view)
    torch.testing.assert_close(left.feature + marker_pixels(view, demo.pose)[0], demo.feature)
    assert left.feature.dtype == torch.float64


def test_a_search_ends_at_the_weighted_least_squares_of_scipy():
    """One start near the camera, one at the prior's mean of optics, one without any frames."""
    rng = np.random.default_rng(5)
    rotation, shift = camera(rng)
    demo = demonstration(rng, rotation, shift, 1300.0, np.array([0, 0.1, 0.03]), 40)
    pose, pixel = demo.seen()
    prior, spread = _prior(IMAGE)
    true = torch.tensor([np.log(1300.0), *CENTER, 0, *rotation, *shift, 0, 0.1, 0.03]).double()
    starts = torch.stack([stepped(true, _OFF), stepped(true, -_OFF), stepped(true, 4 * _OFF)])
    weight = torch.from_numpy(rng.uniform(0, 4, (3, len(pixel))))
    weight[2] = 0.0

    def residuals(step, start, weight):
        near = stepped(start, torch.from_numpy(step))
        off = (marker_pixels(near, pose)[0] - pixel) * weight.sqrt()[:, None]
        away = torch.cat([near[:4] - prior[:4], near[7:] - prior[7:]])
        away = away / torch.cat([spread[:4], spread[7:]])
        return torch.cat([off.flatten(), away]).numpy()

    def cost(cameras):
        zero = np.zeros(13)
        pairs = zip(cameras, weight, strict=True)
        return np.array([np.square(residuals(zero, c, w)).sum() for c, w in pairs])

    found, damping, before = starts, torch.full((3,), 1e-2).double(), cost(starts)
    for _ in range(13):
        found, damping, gram = _searched(found, damping, pose, pixel, weight, prior, spread)
        now = cost(found)
        assert (now <= before * (1 + 1e-12)).all()
        before = now
    for k in range(3):
        best = least_squares(residuals, np.zeros(13), args=(found[k], weight[k]), x_scale="jac")
        assert before[k] == pytest.approx(2 * best.cost, rel=1e-6, abs=1e-9)
        slope = _columns_by_steps(lambda d, k=k: residuals(d, found[k], weight[k]))
        # The prior of the rotation is flat about any place, yet counts in the information.
        expected = slope.T @ slope + np.diag([0.0] * 4 + [0.01] * 3 + [0.0] * 6)
        scale = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(
            gram[k].numpy() / scale / scale[:, None],
            expected / scale / scale[:, None],
            atol=1e-4,
        )
    parts = [*range(4), *range(7, 13)]
    torch.testing.assert_close(found[2][parts], prior[parts], rtol=0, atol=1e-6)
    assert bool((damping <= 1e6).all())
    away = _from_prior(found, prior)
    torch.testing.assert_close(away[:, parts], (found - prior)[:, parts])
    assert bool((away[:, 4:7] == 0).all())


def _columns_by_steps(function):
    """Central differences along all 13 steps."""
    steps = 1e-6 * np.eye(13)
    return np.stack([(function(d) - function(-d)) / 2e-6 for d in steps], axis=-1)
