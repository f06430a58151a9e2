import math

import pytest
import torch
from pinhole import Pinhole, image_demonstrations, wander
from sampling import generator
from torch.testing import assert_close

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import (
    EvidenceConfig,
    ImageJacobianFitConfig,
    KalmanConfig,
    RBFCenters,
    RBFImageJacobian,
    grid,
    paper_grid,
)
from hrc_learn.jacobian.fitting import (
    KeyFrameConfig,
    MotionSamples,
    key_frames,
    prior_precision,
    statistics_by_fold,
)

CAMERA = Pinhole.overhead(roll=0.7)


def record(demos, *, frames=300, noise=0.0, seed=0, camera=CAMERA):
    rng = generator(seed)
    poses = wander(frames, demos, rng=rng)
    x = camera.project(poses)
    x = x + noise * torch.randn(x.shape, generator=rng, dtype=x.dtype)
    return [poses[i] for i in range(demos)], list(x)


def fit(poses, features, visible=None, **config):
    return RBFImageJacobian.fit(
        image_demonstrations(poses, features, visible),
        RBFCenters.paper(),
        ImageJacobianFitConfig(**config),
    )


def relative_error(network, camera=CAMERA, seed=99):
    test = wander(200, rng=generator(seed))
    truth = camera.jacobian(test)
    return float((network(test) - truth).norm() / truth.norm())


@pytest.mark.parametrize("noise", [0.0, 0.5, 2.0])
def test_recovers_a_pinhole_cameras_jacobian(noise):
    """A quarter of the norm: neurons of x and y alone cannot follow height and tilt."""
    network = fit(*record(6, noise=noise), pixel_noise=max(noise, 0.1))
    assert relative_error(network) < 0.25
    assert network.report.held_out_error < 0.9 * network.report.motion


def test_recovers_a_constant_jacobian_exactly():
    """A camera far away with a long lens: nothing is left for the neurons to miss."""
    poses, _ = record(4)
    J = 1000 * torch.randn(2, 6, generator=generator(3), dtype=torch.float64)
    features = []
    for pose in poses:
        steps = pose[:-1].twist_to(pose[1:]) @ J.mT
        features.append(torch.cat([torch.zeros(1, 2).double(), steps]).cumsum(0))
    network = fit(poses, features, min_step=0.0, pixel_noise=1e-3)
    r = poses[0].vector()
    assert_close(network(r), J.expand(300, 2, 6), rtol=1e-3, atol=0.5)
    assert network.report.held_out_error < 1e-2


def test_more_neurons_see_more():
    """With height and the two tilts as inputs the model error falls."""
    poses, features = record(12, frames=600)
    flat = fit(poses, features, pixel_noise=0.1)
    deep = RBFImageJacobian.fit(
        image_demonstrations(poses, features),
        RBFCenters(
            centers=grid((0.05, 0.35, 3), (0.35, 0.65, 3), (0.2, 0.4, 3)),
            width=0.12,
            input_indices=(0, 1, 2),
        ),
        ImageJacobianFitConfig(pixel_noise=0.1),
    )
    assert deep.report.held_out_error < flat.report.held_out_error


def test_posterior_covers_the_truth():
    """Errors measured in posterior standard deviations are of order one."""
    network = fit(*record(6, noise=0.5))
    test = wander(200, rng=generator(5))
    error = network(test) - CAMERA.jacobian(test)
    z = error / network.uncertainty(test).unsqueeze(-2)
    assert 0.3 < float(z.square().mean().sqrt()) < 2.0


@pytest.mark.parametrize("lever", [0.15, 0.4])
def test_uncertainty_is_the_spread_of_the_posterior(lever):
    network = fit(*record(2, noise=0.5), rotation_scale=lever)
    root = torch.linalg.cholesky(network.covariance)
    draws = torch.randn(20_000, root.shape[0], generator=generator(6), dtype=torch.float64)
    rows = (draws @ root.mT).unflatten(-1, (6, 9))
    rows = rows * torch.tensor([1, 1, 1, lever, lever, lever], dtype=torch.float64)[:, None]
    r = wander(3, rng=generator(7)).vector()
    spread = torch.einsum("njk,tk->ntj", rows, network.basis(r)).std(0)
    # A standard deviation from 20,000 draws is known to half a percent.
    assert_close(network.uncertainty(r), spread.detach(), rtol=0.03, atol=0)


def test_fit_is_ridge_regression():
    """Against a plain least-squares solve of the stacked rows, prior rows included."""
    poses, features = record(2, frames=80, noise=0.5)
    config = ImageJacobianFitConfig()
    network = fit(poses, features)
    rows, targets = [], []
    for pose, x in zip(poses, features, strict=True):
        motion = MotionSamples.of(pose, x, torch.ones(80).bool(), config)
        rows.append(motion.regressors(network.basis).detach())
        targets.append(motion.dx)
    covariance = 1500.0**2 * torch.ones(9, 9) + 500.0**2 * torch.eye(9)
    prior = torch.linalg.inv(torch.block_diag(*[covariance.double()] * 6))
    A = torch.cat([*rows, network.report.noise * torch.linalg.cholesky(prior).mT])
    b = torch.cat([*targets, torch.zeros(54, 2, dtype=torch.float64)])
    solution = torch.linalg.lstsq(A, b).solution.mT.unflatten(-1, (6, 9))
    scale = torch.tensor([1, 1, 1, 0.15, 0.15, 0.15], dtype=torch.float64)[:, None]
    assert_close(
        network.weight.detach(), (solution * scale).flatten(0, 1), rtol=1e-6, atol=1e-6
    )


def test_the_report_states_root_mean_squares_over_all_pairs():
    """Each demonstration predicted by ridge regression on the others, pair by pair."""
    poses, features = record(3, frames=60, noise=0.5)
    config = ImageJacobianFitConfig()
    network = fit(poses, features)
    precision = prior_precision(network.centers, config)
    motions = [demo.motion(config) for demo in image_demonstrations(poses, features)]
    phi = [motion.regressors(network.basis).detach() for motion in motions]

    def ridge(chosen, noise):
        rows = torch.cat([phi[i] for i in chosen])
        dx = torch.cat([motions[i].dx for i in chosen])
        return torch.linalg.solve(rows.mT @ rows / noise + precision, rows.mT @ dx / noise)

    def rms(squares):
        return torch.cat(squares).mean().item() ** 0.5

    noise = 2 * config.pixel_noise**2
    unseen = []
    for i, motion in enumerate(motions):
        w = ridge([k for k in range(3) if k != i], noise)
        unseen.append((motion.dx - phi[i] @ w).square().sum(-1))
    report = network.report
    assert report.pairs == sum(len(motion.dx) for motion in motions)
    assert report.motion == pytest.approx(rms([m.dx.square().sum(-1) for m in motions]))
    assert report.held_out_error == pytest.approx(rms(unseen), rel=1e-6)
    # What the network misses counts as noise in both coordinates, where it is more.
    assert report.noise == pytest.approx(max(noise**0.5, rms(unseen) / 2**0.5), rel=1e-6)
    w = ridge(range(3), report.noise**2)
    seen = [(m.dx - phi[i] @ w).square().sum(-1) for i, m in enumerate(motions)]
    assert report.error == pytest.approx(rms(seen), rel=1e-6)


def test_statistics_add_up_in_any_order():
    poses, features = record(7)
    config = KeyFrameConfig()
    network = RBFImageJacobian(paper_grid(), 0.1)

    def total(order):
        demonstrations = image_demonstrations(
            [poses[i] for i in order], [features[i] for i in order]
        )
        parts = statistics_by_fold(network.basis, 9, demonstrations, config)
        return sum(parts[1:], parts[0])

    one, other = total(range(7)), total([3, 6, 0, 2, 5, 1, 4])
    assert one.count == other.count
    assert_close(one.gram, other.gram)
    assert_close(one.cross, other.cross)


def test_key_frames_are_apart_and_visible():
    pose = wander(400, rng=generator(8))
    still = Pose(
        pose.position.repeat_interleave(3, 0), pose.orientation.repeat_interleave(3, 0)
    )
    visible = torch.ones(1200, dtype=torch.bool)
    visible[300:600] = False
    config = KeyFrameConfig(min_step=0.004)
    keys = key_frames(still, visible, config)
    assert bool(visible[keys].all())
    step = still[keys][:-1].twist_to(still[keys][1:])
    step = step * torch.tensor([1, 1, 1, 0.15, 0.15, 0.15], dtype=torch.float64)
    # The distance in R^4 stands for the angle: at most 1e-4 too short here.
    assert float(step.norm(dim=-1).min()) > 0.004 * (1 - 1e-4)
    assert len(keys) > 100


def test_quaternion_signs_do_not_matter():
    poses, features = record(3)
    sign = torch.randint(2, (300, 1), generator=generator(9)) * 2.0 - 1
    flipped = [Pose(pose.position, pose.orientation * sign) for pose in poses]
    assert_close(fit(flipped, features).weight, fit(poses, features).weight)


def test_invisible_stretches_are_left_out():
    """NaN, or garbage marked invisible, in the middle of demonstrations changes nothing
    but the number of pairs; motion across the gap is not used."""
    poses, features = record(4, noise=0.5)
    with_gap = [x.clone() for x in features]
    visible = [torch.ones(300, dtype=torch.bool) for _ in features]
    for x, seen in zip(with_gap, visible, strict=True):
        x[100:180], seen[100:180] = torch.nan, False
    unmarked = fit(poses, with_gap)
    garbage = fit(poses, [x.nan_to_num(1e9) for x in with_gap], visible)
    assert_close(unmarked.weight, garbage.weight)
    assert unmarked.report.pairs < fit(poses, features).report.pairs
    assert relative_error(unmarked) < 0.3


def test_single_demonstration_is_held_out_by_fifths():
    network = fit(*record(1, frames=600, noise=0.5))
    assert network.report.error <= network.report.held_out_error < network.report.motion


def test_fit_survives_saving_with_its_uncertainty(tmp_path):
    network = fit(*record(2, noise=0.5), rotation_scale=0.4)
    network.save(tmp_path / "model")
    loaded = RBFImageJacobian.load(tmp_path / "model")
    r = wander(3, rng=generator(10)).vector()
    assert_close(loaded(r), network(r))
    assert_close(loaded.uncertainty(r), network.uncertainty(r))


def test_float32_centers_give_a_float32_network():
    poses, features = record(2, noise=0.5)
    neurons = RBFCenters(centers=paper_grid().float(), width=0.1)
    network = RBFImageJacobian.fit(image_demonstrations(poses, features), neurons)
    assert network.weight.dtype == torch.float32
    assert network(poses[0].vector().float()).dtype == torch.float32


def test_unseen_demonstrations_are_refused():
    poses, features = record(2)
    with pytest.raises(ValueError, match="no two visible key frames"):
        fit(poses, [x * torch.nan for x in features])


def test_jacobian_times_arm_jacobian_moves_the_feature():
    """J_s maps the geometric twist: J_s J q_dot is the feature's velocity."""
    from hrc_learn.kinematics import panda

    q = panda.ready
    q_dot = torch.randn(7, generator=generator(11), dtype=torch.float64)
    pose, J = panda.forward_and_jacobian(q)
    predicted = CAMERA.jacobian(pose) @ J @ q_dot
    _, velocity = torch.func.jvp(lambda q: CAMERA.project(panda.forward(q)), (q,), (q_dot,))
    assert_close(predicted, velocity)


def test_twist_counts_rotation_in_the_base_frame():
    """Turning about base z with the marker off-axis: the sign tells base from tool frame."""
    poses, features = record(6)
    network = fit(poses, features, pixel_noise=0.1)
    test = wander(50, rng=generator(12))
    turn = quaternion.exp(torch.tensor([0, 0, 0.01], dtype=torch.float64))
    turned = Pose(test.position, quaternion.multiply(turn, test.orientation))
    dx = CAMERA.project(turned) - CAMERA.project(test)
    predicted = network(test)[..., 5] * 0.01
    cosine = (dx * predicted).sum() / (dx.norm() * predicted.norm())
    assert float(cosine) > 0.5


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        (ImageJacobianFitConfig, {"pixel_noise": 0.0}, "pixel_noise must be positive"),
        (ImageJacobianFitConfig, {"weight_std": math.nan}, "weight_std must be finite"),
        (ImageJacobianFitConfig, {"min_step": -1.0}, "min_step must not be negative"),
        (KalmanConfig, {"pixel_noise": 0.0}, "pixel_noise must be positive"),
        (KalmanConfig, {"max_step": 0.0}, "max_step must be positive"),
        (EvidenceConfig, {"hold_out": 0}, "hold_out must be positive"),
    ],
)
def test_settings_out_of_range_are_named(kind, settings, message):
    with pytest.raises(ValueError, match=message):
        kind(**settings)


@pytest.mark.parametrize(
    ("most", "kept"), [(1, [0]), (2, [0, 6]), (3, [0, 3, 6]), (7, range(7)), (9, range(7))]
)
def test_thinned_pairs_are_spread_from_the_first_to_the_last(most, kept):
    number = torch.arange(7.0).double()[:, None]
    quaternions = torch.tensor([1.0, 0, 0, 0]).double().expand(7, 4)
    samples = MotionSamples(
        before=Pose(number.expand(7, 3), quaternions),
        after=Pose(number.expand(7, 3) + 0.5, quaternions),
        dr=number.expand(7, 6),
        dx=number.expand(7, 2),
    ).thinned(most)
    expected = torch.tensor([float(k) for k in kept]).double()
    for values in (
        samples.dx,
        samples.dr,
        samples.before.position,
        samples.after.position - 0.5,
    ):
        assert torch.equal(values[:, 0], expected)
