"""Online estimators: each law against a naive loop, and all against a true camera."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
import torch
from paper_law import PrintedEstimator
from pinhole import Pinhole, image_demonstrations, wander
from sampling import generator
from torch.testing import assert_close
from unchecked import shapes_unchecked

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import (
    BroydenConfig,
    BroydenEstimator,
    CompositeConfig,
    CompositeEstimator,
    FixedEstimator,
    ImageJacobianFitConfig,
    KalmanConfig,
    KalmanEstimator,
    Measurement,
    PaperEstimator,
    RBFCenters,
    RBFImageJacobian,
    paper_grid,
)

ALL = [
    FixedEstimator,
    PaperEstimator,
    BroydenEstimator,
    CompositeEstimator,
    KalmanEstimator,
]
LEARNING = ALL[2:]
RECURSIVE = ALL[4:]
# Turned by a right angle from what the first guess believes.
CAMERA = Pinhole.overhead(roll=1.6)
J0 = torch.tensor(
    [[-1500, 0, 0, 0, -200, 60], [0, 2400, 170, -200, 0, 180]], dtype=torch.float64
)
SCALE = np.array([1, 1, 1, 0.15, 0.15, 0.15])


def guess():
    return RBFImageJacobian.from_jacobian(J0, paper_grid(), 0.1)


def measurement(pose, feature, *, seed=None, valid=True, dt=1 / 30):
    """With feedback drawn at random, or none."""
    batch = feature.shape[:-1]
    rng = generator(0 if seed is None else seed)
    size = 0.0 if seed is None else 1.0
    return Measurement(
        pose=pose,
        feature=feature,
        valid=torch.full(batch, valid),
        dt=dt,
        xi_x=size * torch.randn(*batch, 2, generator=rng, dtype=torch.float64),
        xi_r=size * torch.randn(*batch, 6, generator=rng, dtype=torch.float64),
    )


def run(estimator, poses, x, state=None, valid=None):
    """States along paths (B, frames); shapes are checked in the first step alone, for speed."""
    state = estimator.initial_state(len(x)) if state is None else state
    states = []
    for t in range(x.shape[1]):
        with shapes_unchecked() if t else nullcontext():
            m = measurement(poses[:, t], x[:, t])
            if valid is not None:
                m = replace(m, valid=valid[:, t])
            state = estimator.update(state, m)
        states.append(state)
    return states


def prediction_error(estimator, state, poses, x):
    """RMS over the next steps with the weights frozen [px]."""
    dr = poses[:, :-1].twist_to(poses[:, 1:])
    middle = poses[:, :-1].position + dr[..., :3] / 2
    J = torch.stack(
        [
            estimator.jacobian(state, Pose(middle[:, t], poses[:, t].orientation))
            for t in range(dr.shape[1])
        ],
        dim=1,
    )
    error = x.diff(dim=1) - (J @ dr.unsqueeze(-1)).squeeze(-1)
    return error.square().sum(-1).mean().sqrt()


@pytest.mark.parametrize("noise", [0.0, 0.5])
@pytest.mark.parametrize("Estimator", LEARNING)
def test_prediction_error_falls(Estimator, noise):
    """The first guess is turned by 90 degrees: it predicts worse than no motion at all.

    Gradient steps learn along the path only; a covariance knows what else that tells.
    """
    rng = generator(1)
    poses = wander(500, 8, rng=rng)
    x = CAMERA.project(poses)
    noisy = x + noise * torch.randn(x.shape, generator=rng, dtype=x.dtype)
    estimator = Estimator(guess())
    before = estimator.initial_state(8)
    after = run(estimator, poses[:, :400], noisy[:, :400])[-1]
    rest, x_rest = poses[:, 400:], x[:, 400:]
    error = prediction_error(estimator, after, rest, x_rest)
    share = 0.15 if Estimator in RECURSIVE else 0.5
    assert float(error) < share * float(prediction_error(estimator, before, rest, x_rest))


@pytest.mark.parametrize("Estimator", [FixedEstimator, PaperEstimator])
def test_without_image_motion_in_the_law_nothing_is_learned(Estimator):
    poses = wander(300, 4, rng=generator(2))
    x = CAMERA.project(poses)
    estimator = Estimator(guess())
    state = run(estimator, poses, x)[-1]
    before = prediction_error(estimator, estimator.initial_state(4), poses, x)
    assert_close(prediction_error(estimator, state, poses, x), before)


@pytest.mark.parametrize("Estimator", RECURSIVE)
def test_recovers_the_true_jacobian(Estimator):
    poses = wander(900, 4, rng=generator(3))
    x = CAMERA.project(poses)
    estimator = Estimator(guess())
    state = run(estimator, poses, x)[-1]
    last = poses[:, -1]
    truth = CAMERA.jacobian(last)
    error = estimator.jacobian(state, last) - truth
    assert float(error.norm()) < 0.25 * float(truth.norm())


@pytest.mark.parametrize("Estimator", ALL)
def test_a_batch_is_its_elements(Estimator):
    poses = wander(40, 3, rng=generator(4))
    x = CAMERA.project(poses)
    estimator = Estimator(guess())
    together = run(estimator, poses, x)[-1]
    for i in range(3):
        alone = run(estimator, poses[i : i + 1], x[i : i + 1])[-1]
        assert_close(together.weight[i], alone.weight[0])


@pytest.mark.parametrize("Estimator", ALL)
def test_works_without_a_batch_and_over_several_dimensions(Estimator):
    estimator = Estimator(guess())
    for batch in [(), (2, 3)]:
        pose = wander(2, *batch, rng=generator(5))
        x = CAMERA.project(pose)
        state = estimator.initial_state(*batch)
        for t in range(2):
            state = estimator.update(state, measurement(pose[..., t], x[..., t, :], seed=1))
        assert state.weight.shape == (*batch, 12, 9)
        assert estimator.jacobian(state, pose[..., 1]).shape == (*batch, 2, 6)
        r = pose[..., 1].vector()
        assert_close(estimator.jacobian(state, r), estimator.jacobian(state, pose[..., 1]))


@pytest.mark.parametrize("Estimator", ALL)
def test_starts_as_the_network_and_leaves_it_alone(Estimator):
    network = guess()
    estimator = Estimator(network)
    before = network.weight.detach().clone()
    pose = wander(20, 2, rng=generator(6))
    assert_close(estimator.jacobian(estimator.initial_state(2, 20), pose), network(pose))
    run(estimator, pose, CAMERA.project(pose))
    assert_close(network.weight.detach(), before, rtol=0, atol=0)


@pytest.mark.parametrize("Estimator", LEARNING)
def test_what_is_not_seen_teaches_nothing(Estimator):
    """Invisible frames, NaN or not, and the jump across a gap leave the weights alone."""
    poses = wander(200, 2, rng=generator(7), spread=0.3)
    x = CAMERA.project(poses)
    estimator = Estimator(guess())
    seen = torch.zeros(2, 200, dtype=torch.bool)
    seen[:, 5], seen[:, 150] = True, True
    gap = poses[:, 5].twist_to(poses[:, 150])[..., :3].norm(dim=-1)
    assert bool((gap > 0.05).all())
    state = run(estimator, poses, torch.where(seen[..., None], x, torch.nan), valid=seen)[-1]
    assert_close(state.weight, estimator.initial_weight(2), rtol=0, atol=0)
    assert_close(state.key.feature, x[:, 150])


@pytest.mark.parametrize("Estimator", LEARNING)
def test_motion_below_the_step_teaches_nothing(Estimator):
    still = wander(1, 2, rng=generator(8))
    poses = Pose(still.position.expand(2, 50, 3), still.orientation.expand(2, 50, 4))
    x = CAMERA.project(poses)
    x = x + 2 * torch.randn(x.shape, generator=generator(9), dtype=x.dtype)
    estimator = Estimator(guess())
    state = run(estimator, poses, x)[-1]
    assert_close(state.weight, estimator.initial_weight(2), rtol=0, atol=0)


def test_paper_law_entry_by_entry():
    """(update): W_dot = -[L theta s^T xi_x']^T with all matrices written out."""
    network = guess()
    estimator = PaperEstimator(network, gain=0.25)
    pose = wander(1, rng=generator(10))[0]
    m = measurement(pose, torch.zeros(2).double(), seed=11, dt=0.01)
    state = estimator.update(estimator.initial_state(), m)

    theta = network.basis(pose).detach().numpy()[:, None]
    xi_x, xi_r = m.xi_x.numpy()[:, None], m.xi_r.numpy()[:, None]
    s = network(pose).detach().numpy().T @ xi_x + xi_r
    xi_prime = np.hstack([xi_x[0] * np.eye(6), xi_x[1] * np.eye(6)])
    W_dot = -((0.25 * np.eye(9)) @ theta @ s.T @ xi_prime).T
    W = network.weight.detach().numpy() + 0.01 * W_dot
    np.testing.assert_allclose(state.weight.numpy(), W, rtol=1e-14, atol=0)


def test_printed_weights_are_set_where_the_feature_is_first_seen():
    """(eq_w0) as printed, vec(J_s0) over the sum of unnormalised neurons, then (update)."""
    pose = wander(2, rng=generator(16))
    printed = PrintedEstimator(guess())
    state = printed.initial_state()
    first = measurement(pose[0], torch.zeros(2).double(), dt=0.01)
    state = printed.update(state, replace(first, valid=torch.tensor(False)))
    assert not state.weight.any()
    state = printed.update(state, replace(first, xi_x=0 * first.xi_x))
    mixed = J0.mT.flatten().view(2, 6)
    assert_close(printed.jacobian(state, pose[0]), mixed, rtol=1e-12, atol=1e-9)
    second = measurement(pose[1], torch.zeros(2).double(), seed=1, dt=0.01)
    law = PaperEstimator(printed.network)
    assert_close(printed.update(state, second).weight, law.update(state, second).weight)


def test_rows_that_are_not_mixed_are_the_guess_where_it_began():
    pose = wander(1, rng=generator(17))[0]
    printed = PrintedEstimator(guess(), gain=0.0, mixed=False)
    state = printed.update(printed.initial_state(), measurement(pose, torch.zeros(2).double()))
    assert_close(printed.jacobian(state, pose), J0, rtol=1e-12, atol=1e-9)
    away = Pose(pose.position + torch.tensor([0.5, 0.0, 0.0]).double(), pose.orientation)
    assert float(printed.jacobian(state, away).norm()) < 0.5 * float(J0.norm())


def test_paper_law_is_a_gradient_step_on_the_task_energy():
    """W_dot = -gain d(|s|^2 / 2)/dW."""
    network = guess()
    pose = wander(1, rng=generator(12))[0]
    m = measurement(pose, torch.zeros(2).double(), seed=13, dt=1.0)
    state = PaperEstimator(network, gain=1e-3).update(
        PaperEstimator(network).initial_state(), m
    )

    def energy(weight):
        J = torch.func.functional_call(network, {"weight": weight}, (pose,))
        return (J.mT @ m.xi_x + m.xi_r).square().sum() / 2

    gradient = torch.func.grad(energy)(network.weight.detach())
    assert_close(state.weight - network.weight.detach(), -1e-3 * gradient, rtol=1e-6, atol=0)


def naive_pairs(poses, x, network, min_step, max_step):
    """(phi, dx, dr, theta) of one path, by a plain loop in numpy and scipy-free algebra."""
    pairs, key = [], None
    for t in range(len(x)):
        if key is None:
            key = t
            continue
        a, b = poses[key], poses[t]
        R = quaternion.to_matrix(b.orientation) @ quaternion.to_matrix(a.orientation).T
        turn = quaternion.log(quaternion.from_matrix(R))
        dr = np.concatenate([(b.position - a.position).numpy(), turn.numpy()]) * SCALE
        if np.linalg.norm(dr) < min_step:
            continue
        theta = (network.basis(a) + network.basis(b)).detach().numpy() / 2
        if np.linalg.norm(dr) <= max_step:
            pairs.append((np.kron(dr, theta), (x[t] - x[key]).numpy(), dr, theta))
        key = t
    return pairs


def scaled_rows(weight):
    """Weights in px/m throughout, one row of 54 for each image row."""
    return (weight.detach().numpy().reshape(2, 6, -1) / SCALE[:, None]).reshape(2, -1)


def test_composite_law_pair_by_pair():
    network = guess()
    config = CompositeConfig(min_step=0.004, task_gain=0.0, prediction_gain=0.7)
    estimator = CompositeEstimator(network, config)
    path = wander(60, rng=generator(14))
    x = CAMERA.project(path)
    state = run(estimator, path[None], x[None])[-1]

    w = scaled_rows(network.weight)
    for phi, dx, dr, theta in naive_pairs(path, x, network, 0.004, config.max_step):
        error = dx - w @ phi
        w = w + 0.7 * np.outer(error, phi) / ((dr @ dr + 2e-3**2) * (theta @ theta))
    np.testing.assert_allclose(scaled_rows(state.weight[0]), w, rtol=1e-9)


def test_composite_law_removes_its_share_of_each_error():
    """At gain 1 and no floor the last pair is predicted exactly."""
    network = guess()
    config = CompositeConfig(prediction_gain=1.0, noise_floor=0.0, task_gain=0.0)
    estimator = CompositeEstimator(network, config)
    path = wander(2, 5, rng=generator(15))
    x = CAMERA.project(path)
    state = run(estimator, path, x)[-1]
    theta = (network.basis(path[:, 0]) + network.basis(path[:, 1])) / 2
    J = (state.weight @ theta[..., None]).squeeze(-1).unflatten(-1, (2, 6))
    dr = path[:, 0].twist_to(path[:, 1])
    assert_close((J @ dr[..., None]).squeeze(-1), x[:, 1] - x[:, 0])


def test_composite_law_contains_the_papers():
    network = guess()
    config = CompositeConfig(task_gain=0.1)
    composite, paper = CompositeEstimator(network, config), PaperEstimator(network, gain=0.1)
    pose = wander(1, rng=generator(16))[0]
    m = measurement(pose, torch.zeros(2).double(), seed=17)
    assert_close(
        composite.update(composite.initial_state(), m).weight,
        paper.update(paper.initial_state(), m).weight,
    )


@pytest.mark.parametrize(
    "estimator",
    [
        BroydenEstimator(guess(), BroydenConfig(weight_bound=3000.0)),
        CompositeEstimator(guess(), CompositeConfig(weight_bound=3000.0, noise_floor=0.0)),
        KalmanEstimator(guess(), KalmanConfig(weight_bound=3000.0)),
    ],
    ids=lambda estimator: type(estimator).__name__,
)
def test_weights_stay_bounded(estimator):
    """Whatever is measured: here features jump about the whole image."""
    poses = wander(100, 4, rng=generator(18))
    x = 1440 * torch.rand(4, 100, 2, generator=generator(19), dtype=torch.float64)
    largest = []
    for state in run(estimator, poses, x):
        scaled = state.weight.unflatten(-2, (2, 6)) / torch.from_numpy(SCALE)[:, None]
        largest.append(float(scaled.abs().max()))
    assert 2999 < max(largest) <= 3000 * (1 + 1e-12)


@pytest.mark.parametrize("kind", LEARNING)
def test_an_arm_at_rest_teaches_nothing_even_if_every_frame_is_compared(kind):
    config = replace(kind(guess()).config, min_step=0.0)
    poses = wander(1, 1, rng=generator(18))[:, [0] * 5]
    x = 1440 * torch.rand(1, 5, 2, generator=generator(19), dtype=torch.float64)
    *_, last = run(kind(guess(), config), poses, x)
    assert_close(last.weight[0], guess().weight.detach())


@pytest.mark.parametrize(
    ("config", "wrong", "words"),
    [
        (BroydenConfig, {"gain": 1.01}, r"gain must be in \(0, 1\]"),
        (BroydenConfig, {"weight_bound": 0.0}, "weight_bound must be positive"),
        (CompositeConfig, {"prediction_gain": 2.0}, "prediction_gain must be below 2"),
        (CompositeConfig, {"noise_floor": -1e-3}, "noise_floor must not be negative"),
        (KalmanConfig, {"bias_std": np.nan}, "bias_std must be finite"),
        (KalmanConfig, {"pixel_noise": 0.0}, "pixel_noise must be positive"),
        (KalmanConfig, {"max_step": 0.0}, "max_step must be positive"),
    ],
)
def test_gains_that_cannot_converge_are_refused(config, wrong, words):
    with pytest.raises(ValueError, match=words):
        config(**wrong)


def test_kalman_filter_against_the_textbook():
    network = guess()
    path = wander(60, rng=generator(20))
    x = CAMERA.project(path)
    # The loop below drifts before each pair: one pair a frame.
    dense = KalmanConfig(min_step=0.0)
    state = run(KalmanEstimator(network, dense), path[None], x[None])[-1]

    def textbook(pairs, drift_first):
        w = scaled_rows(network.weight)
        P = np.kron(np.eye(6), 1500.0**2 * np.ones((9, 9)) + 500.0**2 * np.eye(9))
        Q = np.kron(np.eye(6), 100.0**2 / 30 * np.ones((9, 9)))
        P = P + drift_first * Q
        for phi, dx, _, _ in pairs:
            P = P + Q
            S = phi @ P @ phi + 2 * 0.5**2
            K = P @ phi / S
            w = w + np.outer(dx - w @ phi, K)
            P = (np.eye(54) - np.outer(K, phi)) @ P
        return w, P

    w, P = textbook(naive_pairs(path, x, network, 0.0, dense.max_step), drift_first=1)
    np.testing.assert_allclose(scaled_rows(state.weight[0]), w, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(state.covariance[0].numpy(), P, rtol=1e-6, atol=1e-2)


def test_a_filter_without_drift_is_least_squares():
    """The last state solves the ridge problem of all pairs at once."""
    network = guess()
    estimator = KalmanEstimator(network, KalmanConfig(drift=0.0))
    path = wander(80, rng=generator(21))
    x = CAMERA.project(path)
    state = run(estimator, path[None], x[None])[-1]
    pairs = naive_pairs(path, x, network, 2e-4, 0.05)
    Phi, dX = np.stack([p[0] for p in pairs]), np.stack([p[1] for p in pairs])
    prior = np.kron(np.eye(6), 1500.0**2 * np.ones((9, 9)) + 500.0**2 * np.eye(9))
    precision = np.linalg.inv(prior) + Phi.T @ Phi / 0.5
    w0 = scaled_rows(network.weight)
    w = w0 + np.linalg.solve(precision, Phi.T @ (dX - Phi @ w0.T) / 0.5).T
    np.testing.assert_allclose(scaled_rows(state.weight[0]), w, rtol=1e-6, atol=1e-3)


@pytest.mark.parametrize("Estimator", RECURSIVE)
def test_covariance_stays_symmetric_to_the_last_bit(Estimator):
    """Forgetting amplifies any asymmetry: float32 failed after 14,000 frames with it."""
    estimator = Estimator(guess().float())
    path = wander(200, 2, rng=generator(30))
    x = CAMERA.project(path).float()
    single = Pose(path.position.float(), path.orientation.float())
    state = estimator.initial_state(2)
    still = torch.zeros(2, 6)
    for t in range(200):
        m = Measurement(
            pose=single[:, t],
            feature=x[:, t],
            valid=torch.ones(2, dtype=torch.bool),
            dt=1 / 30,
            xi_x=still[:, :2],
            xi_r=still,
        )
        state = estimator.update(state, m)
    assert state.covariance.dtype == torch.float32
    assert_close(state.covariance, state.covariance.mT, rtol=0, atol=0)


def test_broyden_changes_the_jacobian_by_rank_one_everywhere():
    network = guess()
    estimator = BroydenEstimator(network)
    path = wander(2, 3, rng=generator(24))
    x = CAMERA.project(path)
    # One step of the path is some millimetres, two are enough.
    state = run(estimator, path, x)[-1]
    change = estimator.jacobian(state, path[:, 0]) - J0
    dr = path[:, 0].twist_to(path[:, 1]) * torch.from_numpy(SCALE)
    assert bool((dr.norm(dim=-1) > 2e-3).all())
    error = x[:, 1] - x[:, 0] - (J0 / torch.from_numpy(SCALE) @ dr[..., None]).squeeze(-1)
    expected = 0.5 * error[..., None] * (dr / dr.square().sum(-1, keepdim=True))[:, None]
    assert_close(change, expected * torch.from_numpy(SCALE))
    assert_close(estimator.jacobian(state, path[:, 1]) - J0, change)


@pytest.mark.parametrize("Estimator", [KalmanEstimator, BroydenEstimator])
def test_constant_corrections_need_normalised_neurons(Estimator):
    with pytest.raises(ValueError, match="normalized=True"):
        Estimator(RBFImageJacobian(paper_grid(), 0.1, normalized=False))


def test_composite_law_leaves_weights_alone_where_their_neurons_are_silent():
    """Not normalised and far from all centres: what is seen there is not theirs to explain."""
    network = RBFImageJacobian(paper_grid(), 0.1, weight=guess().weight / 2.5, normalized=False)
    near = wander(100, 4, rng=generator(25), spread=0.05)
    far = Pose(near.position + torch.tensor([0.6, 0, 0]).double(), near.orientation)
    assert 0 < float(network.basis(far).sum(-1).max()) < 1e-2
    estimator = CompositeEstimator(network)
    there = run(estimator, far, CAMERA.project(far))[-1].weight - network.weight
    here = run(estimator, near, CAMERA.project(near))[-1].weight - network.weight
    assert float(there.abs().max()) < 0.05 * float(here.abs().max())


def test_kalman_filter_starts_from_the_fit():
    poses = wander(300, 4, rng=generator(26))
    x = CAMERA.project(poses)
    network = RBFImageJacobian.fit(image_demonstrations(poses, x), RBFCenters.paper())
    state = KalmanEstimator(network).initial_state(2)
    assert_close(state.covariance[1], network.covariance)


def test_a_filter_converts_rotations_of_the_fit_by_its_own_lever_arm():
    """The covariance in px/rad is that of the fit, whatever length each counts with."""
    poses = wander(300, 4, rng=generator(26))
    recorded = image_demonstrations(poses, CAMERA.project(poses))
    config = ImageJacobianFitConfig(rotation_scale=0.3)
    network = RBFImageJacobian.fit(recorded, RBFCenters.paper(), config)
    own = KalmanEstimator(network, KalmanConfig(rotation_scale=0.1)).initial_state().covariance
    fitted, own = (
        np.outer(size, size) * covariance.numpy()
        for covariance, size in (
            (network.covariance, np.repeat([1, 1, 1, 0.3, 0.3, 0.3], 9)),
            (own, np.repeat([1, 1, 1, 0.1, 0.1, 0.1], 9)),
        )
    )
    np.testing.assert_allclose(own, fitted, rtol=1e-12)


@pytest.mark.parametrize("Estimator", ALL)
def test_vmaps(Estimator):
    poses = wander(3, 4, rng=generator(27))
    x = CAMERA.project(poses)
    estimator = Estimator(guess())
    state = run(estimator, poses[:, :2], x[:, :2])[-1]
    m = measurement(poses[:, 2], x[:, 2], seed=28)
    with shapes_unchecked():
        mapped = torch.vmap(
            lambda s, p, f, v, a, b: estimator.update(
                s, Measurement(pose=p, feature=f, valid=v, dt=1 / 30, xi_x=a, xi_r=b)
            )
        )(state, m.pose, m.feature, m.valid, m.xi_x, m.xi_r)
    assert_close(mapped.weight, estimator.update(state, m).weight)


@pytest.mark.parametrize("Estimator", ALL)
def test_learning_can_be_differentiated(Estimator):
    """Through several updates, with respect to the first weights."""
    poses = wander(4, 1, rng=generator(29))
    x = CAMERA.project(poses)
    estimator = Estimator(guess())
    state = estimator.initial_state(1)

    def last_jacobian(weight):
        end = run(estimator, poses, x, state=replace(state, weight=weight))[-1]
        return estimator.jacobian(end, poses[:, -1])

    weight = state.weight.clone().requires_grad_()
    with shapes_unchecked():
        assert torch.autograd.gradcheck(last_jacobian, weight, eps=1e-2, fast_mode=True)


@pytest.mark.parametrize("Estimator", LEARNING)
def test_what_was_seen_before_a_pause_is_not_compared_with_what_is_seen_after(Estimator):
    poses = wander(21, 2, rng=generator(11))
    x = CAMERA.project(poses)
    estimator = Estimator(guess())
    state = run(estimator, poses[:, :20], x[:, :20])[-1]
    # The camera jumps in the pause: paired with the image before it would teach nonsense.
    after, jumped = poses[:, 20:], x[:, 20:] + 400.0
    wary = run(estimator, after, jumped, estimator.resumed(state, 2.0))[-1]
    unwary = run(estimator, after, jumped, state)[-1]
    assert_close(wary.weight, state.weight)
    assert not torch.equal(unwary.weight, state.weight)


def test_a_kalman_filter_drifts_through_a_pause_as_through_steps():
    poses = wander(1, 1, rng=generator(12))
    estimator = KalmanEstimator(guess())
    state = stepped = estimator.initial_state(1)
    unseen = measurement(poses[:, 0], CAMERA.project(poses)[:, 0], valid=False, dt=0.1)
    for _ in range(10):
        stepped = estimator.update(stepped, unseen)
    assert_close(estimator.resumed(state, 1.0).covariance, stepped.covariance)
