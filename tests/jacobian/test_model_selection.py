import math
from dataclasses import replace

import pytest
import torch
from pinhole import Pinhole, image_demonstrations, wander
from sampling import generator
from torch.testing import assert_close

from hrc_learn.jacobian import (
    EvidenceConfig,
    ImageJacobianFitConfig,
    RBFCenters,
    RBFImageJacobian,
    cross_validate,
    maximize_evidence,
    paper_grid,
)
from hrc_learn.jacobian.fitting import KeyFrameConfig, MotionSamples, weight_covariance
from hrc_learn.jacobian.model_selection import HeldOutSamples, NegativeLogEvidence

CAMERA = Pinhole.overhead(roll=0.7)


WORKSPACE = {"spread": 0.06, "turn": 0.08}


def record(demos=4, *, frames=200, noise=0.1, seed=0):
    rng = generator(seed)
    poses = wander(frames, demos, rng=rng, **WORKSPACE)
    x = CAMERA.project(poses)
    x = x + noise * torch.randn(x.shape, generator=rng, dtype=x.dtype)
    return image_demonstrations([poses[i] for i in range(demos)], list(x))


def unseen(demonstration):
    return replace(demonstration, visible=torch.zeros_like(demonstration.visible))


def relative_error(network):
    test = wander(200, rng=generator(99), **WORKSPACE)
    truth = CAMERA.jacobian(test)
    return float((network(test).detach() - truth).norm() / truth.norm())


def test_evidence_is_the_density_of_the_image_motion():
    """Against the Gaussian density of all pairs at once, from its covariance."""
    demonstrations = record(1, frames=40)
    config = ImageJacobianFitConfig(pixel_noise=0.3, bias_std=900.0, weight_std=300.0)
    motion = demonstrations[0].motion(config)
    neurons = RBFCenters.paper()
    model = NegativeLogEvidence(neurons, config, learn_centers=False)
    phi = motion.regressors(neurons.basis())
    prior = torch.block_diag(*[weight_covariance(paper_grid(), 900.0, 300.0)] * 6)
    noise = 2 * 0.3**2 * torch.eye(len(phi), dtype=torch.float64)
    density = torch.distributions.MultivariateNormal(
        torch.zeros(len(phi), dtype=torch.float64), phi @ prior @ phi.mT + noise
    )
    expected = -density.log_prob(motion.dx.mT).sum() / len(phi)
    assert_close(model(motion), expected.detach(), rtol=1e-9, atol=0)


def test_gradients_of_the_evidence():
    demonstrations = record(2, frames=40)
    motion = MotionSamples.joined([one.motion(KeyFrameConfig()) for one in demonstrations])
    model = NegativeLogEvidence(
        RBFCenters.around(demonstrations), ImageJacobianFitConfig(), True
    )
    value = model(motion)
    value.backward()
    step = 1e-5
    for name in ("log_width", "log_noise", "log_bias", "log_weight"):
        parameter = getattr(model, name)
        with torch.no_grad():
            parameter += step
            above = float(model(motion))
            parameter -= 2 * step
            below = float(model(motion))
            parameter += step
        numeric = (above - below) / (2 * step)
        assert float(parameter.grad) == pytest.approx(numeric, rel=1e-4, abs=1e-6)
    assert float(model.centers.grad.norm()) > 0


def test_learning_improves_on_ridge_and_finds_the_noise():
    demonstrations = record()
    neurons = RBFCenters.around(demonstrations)
    config = ImageJacobianFitConfig()
    learned = maximize_evidence(
        demonstrations, neurons, config, EvidenceConfig(rounds=3, learn_centers=False)
    )
    # Noise alone, four coordinates of it in each pair, leaves an error of 0.2 px.
    excess = [state.held_out_error - 0.2 for state in learned.rounds]
    assert excess[learned.best] < 0.9 * excess[0]
    assert learned.kept.config.pixel_noise == pytest.approx(0.1, rel=0.1)
    ridge = RBFImageJacobian.fit(demonstrations, neurons, config)
    better = RBFImageJacobian.fit(demonstrations, learned.kept.neurons, learned.kept.config)
    assert relative_error(better) < relative_error(ridge)


def test_learning_keeps_what_was_best_on_demonstrations_held_out():
    learned = maximize_evidence(
        record(), RBFCenters.paper(), learning=EvidenceConfig(rounds=3, patience=2)
    )
    errors = [state.held_out_error for state in learned.rounds]
    assert errors[learned.best] <= 1.001 * min(errors)
    if learned.best == 0:
        assert len(errors) == 3  # patience of two rounds
        assert_close(learned.kept.neurons.centers, paper_grid())


def test_too_few_demonstrations_are_refused():
    with pytest.raises(ValueError, match="every 4th demonstration is held out"):
        maximize_evidence(record(3), RBFCenters.paper())
    demonstrations = record(4)
    *others, last = map(unseen, demonstrations)
    for given, message in (
        ([*demonstrations[:3], last], "in the held-out .*: there is nothing to judge"),
        ([*others, demonstrations[3]], "in the training .*: there is nothing to learn"),
    ):
        with pytest.raises(ValueError, match=message):
            maximize_evidence(given, RBFCenters.paper())


def test_neurons_around_stand_where_the_tool_was():
    demonstrations = record()
    neurons = RBFCenters.around(demonstrations)
    assert neurons.centers.shape == (13, 6)
    position = torch.cat([one.pose.position for one in demonstrations])
    low, high = neurons.centers[:, :3].amin(dim=0), neurons.centers[:, :3].amax(dim=0)
    assert_close((low + high) / 2, (position.amin(dim=0) + position.amax(dim=0)) / 2)
    # In z hardly anything was shown: neurons keep their least distance there.
    assert_close((high - low)[:2], (position.amax(dim=0) - position.amin(dim=0))[:2])
    reference = neurons.reference
    assert reference is not None
    down = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64)
    assert float((reference @ down).abs()) > math.cos(0.5 * 0.1)


def test_a_reference_survives_saving_and_half_turns(tmp_path):
    """Poses and their vectors agree though the hand points down, at a half turn."""
    demonstrations = record(2)
    network = RBFImageJacobian.fit(demonstrations, RBFCenters.around(demonstrations))
    network.save(tmp_path / "model")
    loaded = RBFImageJacobian.load(tmp_path / "model")
    pose = demonstrations[0].pose[:5]
    assert_close(loaded(pose), network(pose))
    assert_close(network(pose.vector()), network(pose), rtol=1e-9, atol=1e-6)
    flipped = type(pose)(pose.position, -pose.orientation)
    assert_close(network(flipped), network(pose))


def test_held_out_errors_by_place_add_up():
    demonstrations = record()
    config = ImageJacobianFitConfig(pixel_noise=0.1)
    network = RBFImageJacobian.fit(demonstrations, RBFCenters.around(demonstrations), config)
    report = network.report
    assert report is not None
    pairs = cross_validate(demonstrations, network, config)
    assert len(pairs.error) == report.pairs
    rms = float(pairs.error.square().sum(-1).mean().sqrt())
    # The report's came before the noise was raised to the error it found.
    assert rms == pytest.approx(report.held_out_error, rel=0.02)
    cells = pairs.by_cell(3)
    assert int(cells.pairs.sum()) == report.pairs
    assert bool((cells.relative.isfinite() == (cells.pairs > 0)).all())
    loaded = RBFImageJacobian(paper_grid(), 0.1)
    with pytest.raises(ValueError, match="just fitted"):
        cross_validate(demonstrations, loaded, config)
    one_seen = demonstrations[:1] + [unseen(demo) for demo in demonstrations[1:]]
    with pytest.raises(ValueError, match="held-out errors need pairs in at least two folds"):
        cross_validate(one_seen, network, config)


def test_every_pair_is_predicted_by_a_network_that_stays_as_it_is():
    """Also pairs of a fold whose first demonstration does not show the marker."""
    first, *others = record(7, frames=60)
    demonstrations = [unseen(first), *others]
    neurons, config = RBFCenters(centers=paper_grid().float(), width=0.1), KeyFrameConfig()
    network = RBFImageJacobian.fit(demonstrations, neurons)
    pairs = cross_validate(demonstrations, network, ImageJacobianFitConfig())
    motions = [demonstrations[i].motion(config).dx for i in (0, 5, 1, 6, 2, 3, 4)]
    assert_close(pairs.motion, torch.cat(motions))
    assert network.weight.dtype == torch.float32


def test_cells_lie_where_their_edges_say():
    """Each pair counted by a plain loop over the edges; x is the first axis, y the second."""
    rng = torch.Generator().manual_seed(5)
    pairs = 60
    place = torch.rand(pairs, 3, generator=rng, dtype=torch.float64) * torch.tensor(
        [0.9, 0.3, 1]
    )
    place[:, 1] = place[:, 1].square()  # not symmetric in x and y
    motion, error = torch.randn(2, pairs, 2, generator=rng, dtype=torch.float64)
    cells = HeldOutSamples(position=place, motion=motion, error=error).by_cell(2)
    (x0, y0), (x1, y1), (x2, y2) = cells.edges.tolist()
    for i, (x_low, x_high) in enumerate([(x0, x1), (x1, x2)]):
        for k, (y_low, y_high) in enumerate([(y0, y1), (y1, y2)]):
            x, y = place[:, 0], place[:, 1]
            inside = (x >= x_low) & (y >= y_low)
            inside &= (x < x_high) if i == 0 else (x <= x_high)
            inside &= (y < y_high) if k == 0 else (y <= y_high)
            assert cells.pairs[i, k] == inside.sum()
            relative = (error[inside].norm() / motion[inside].norm()).item()
            assert cells.relative[i, k].item() == pytest.approx(relative)
    assert cells.pairs[0, 1] != cells.pairs[1, 0]
