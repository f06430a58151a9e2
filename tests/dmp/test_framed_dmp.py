"""Motions between frames that are elsewhere in each demonstration."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from demo_motions import minimum_jerk
from torch.autograd import gradcheck
from unchecked import shapes_unchecked

from hrc_learn.dmp import (
    FramedDMP,
    Frames,
    JointDMP,
    PeriodicBasis,
    mean_primitive,
)
from hrc_learn.dmp.learned_motion import choose
from hrc_learn.geometry import Pose


def turned(angle):
    c, s = angle.cos(), angle.sin()
    return torch.stack([torch.stack([c, -s], -1), torch.stack([s, c], -1)], -2)


def situations(n, seed=0):
    """Two frames in the plane, a metre apart give or take 0.3 m, turned by up to 1 rad."""
    rng = torch.Generator().manual_seed(seed)
    angle = 2 * torch.rand(n, 2, generator=rng, dtype=torch.float64) - 1
    off = 0.3 * torch.randn(n, 2, 2, generator=rng, dtype=torch.float64)
    return Frames(turned(angle), off + torch.tensor([[0.0, 0.0], [1.0, 0.0]]))


def motions(frames, vary=0.1, seed=0):
    """Out of the first frame along its x axis, and into the second along its own."""
    rng = torch.Generator().manual_seed(seed)
    n = len(frames.b)
    reach = 1 + vary * torch.randn(n, 2, 1, generator=rng, dtype=torch.float64)
    (first, last), (out, into) = (
        x.unbind(1) for x in (frames.b, 0.4 * reach * frames.A[..., 0])
    )
    s = torch.linspace(0, 1, 100, dtype=torch.float64)
    m = minimum_jerk(s)
    handles = first, first + out, last - into, last
    shares = (1 - m) ** 3, 3 * m * (1 - m) ** 2, 3 * m**2 * (1 - m), m**3
    ways = [p[:, None] * w[:, None] for p, w in zip(handles, shares, strict=True)]
    return 2 * s, torch.stack(ways).sum(0)


@pytest.fixture(scope="module")
def model():
    frames = situations(5)
    return FramedDMP.fit(*motions(frames), frames, 20)


def test_the_product_is_generalised_least_squares(model):
    """One x, told by every frame with an error of its own; solved by QR in NumPy."""
    frames = situations(3, seed=5)
    M = model.mean.shape[-1]
    placed = np.zeros(M)
    placed[-2:] = 1.0  # start and goal are places; velocities and weights are none
    for i in range(3):
        rows, values = [], []
        for j in range(2):
            A, b = frames.A[i, j].numpy(), frames.b[i, j].numpy()
            out = np.kron(A, np.eye(M))
            covariance = out @ np.linalg.inv(model.precision[j].numpy()) @ out.T
            unit = np.sqrt(np.diag(covariance))
            L = np.linalg.cholesky(covariance / unit / unit[:, None])
            told = out @ model.mean[j].numpy().ravel() + np.kron(b, placed)
            rows.append(np.linalg.solve(L, np.diag(1 / unit)))
            values.append(np.linalg.solve(L, told / unit))
        whole = np.concatenate(rows)
        scale = np.linalg.norm(whole, axis=0)
        Q, R = np.linalg.qr(whole / scale)
        expected = np.linalg.solve(R, Q.T @ np.concatenate(values)) / scale
        spread = np.linalg.inv(R) / scale[:, None]
        made = model.at(Frames(frames.A[i], frames.b[i])).coordinates()
        unit = np.sqrt(np.diag(spread @ spread.T))
        # Covariances with eigenvalues 1e-6 apart and more, inverted on either side.
        assert np.abs((made.detach().numpy().ravel() - expected) / unit).max() < 1e-3
        batch = model.at(frames)[i]
        torch.testing.assert_close(batch.coordinates(), made, rtol=1e-6, atol=1e-8)


def test_a_frame_knows_what_was_shown_in_it():
    """Over all directions, motions vary as demonstrations do, and by the tolerance."""
    frames, tolerance = situations(5), 0.02
    time, position = motions(frames)
    model = FramedDMP.fit(time, position, frames, 20, tolerance=tolerance)
    seen = torch.linalg.solve(frames.A, (position[:, None] - frames.b[:, :, None]).mT).mT
    H = model.primitive.response.evaluate(time / 2)[:, 0]
    for j in range(2):
        torch.testing.assert_close(
            (H @ model.mean[j].mT), seen[:, j].mean(0), rtol=0, atol=1e-3
        )
        covariance = torch.linalg.inv(model.precision[j]).view(2, H.shape[1], 2, H.shape[1])
        variance = torch.einsum("tm,dmdn,tn->t", H, covariance, H) / 2
        expected = seen[:, j].var(0).mean(-1) + tolerance**2
        torch.testing.assert_close(variance, expected, rtol=0.01, atol=0)
    # Certain where each begins or ends, uncertain where the other does.
    assert expected[0] > 10 * expected[-1]


def test_the_default_tolerance_is_a_thousandth_of_the_largest_range():
    """A column that never moves, such as a height over a table, has no range."""
    frames = situations(5)
    time, position = motions(frames)
    flat = torch.cat([position, torch.ones_like(position[..., :1])], -1)
    A = torch.eye(3).double().repeat(5, 2, 1, 1)
    A[..., :2, :2] = frames.A
    level = Frames(A, torch.nn.functional.pad(frames.b, (0, 1)))
    least = (position.amax(1) - position.amin(1)).max().item() / 1000
    found, wanted = (
        FramedDMP.fit(time, flat, level, 20, tolerance=tolerance).precision
        for tolerance in (None, least)
    )
    torch.testing.assert_close(found, wanted, rtol=1e-3, atol=1e-3 * wanted.abs().max().item())


def test_motions_move_with_their_frames(model):
    frames = situations(2, seed=3)
    R, p = turned(torch.tensor(2.0).double()), torch.tensor([3.0, -1.0]).double()
    moved = Frames(R @ frames.A, frames.b @ R.mT + p)
    before, after = (model.at(f).rollout().position for f in (frames, moved))
    torch.testing.assert_close(after, before @ R.mT + p, rtol=0, atol=1e-6)


def test_few_demonstrations_lead_elsewhere():
    """Where the mean, adapted, and a function of the places do not."""
    frames, others = situations(4), situations(40, seed=9)
    time, position = motions(frames)
    _, wanted = motions(others, vary=0.0)
    place = torch.cat([frames.b, frames.A[..., 0]], -1).flatten(1)
    there = torch.cat([others.b, others.A[..., 0]], -1).flatten(1)
    start, goal = others.b.unbind(1)
    each = JointDMP.fit(time, position, 30, approach=1.0)
    mean, function = mean_primitive(each), choose([each], place, regression_only=True)
    made = {
        "frames": FramedDMP.fit(time, position, frames, 30).at(others).rollout(time),
        "mean": mean.rollout(time, start, goal),
        "function": function.at_contexts(there).rollout(time, start, goal),
    }
    error = {
        name: (m.position.detach() - wanted).square().sum(-1).mean(-1).sqrt().median()
        for name, m in made.items()
    }
    assert error["frames"] < 0.025
    assert error["frames"] < error["mean"] / 3
    assert error["frames"] < error["function"] / 3
    # It is left and entered the right way, within 10 deg.
    way = made["frames"].position.detach().diff(dim=1)
    for k, j in ((15, 0), (-15, 1)):
        aligned = (torch.nn.functional.normalize(way[:, k], dim=-1) * others.A[:, j, :, 0]).sum(
            -1
        )
        assert aligned.median() > np.cos(np.deg2rad(10))


def test_poses_in_space_and_a_column_of_no_place():
    rng = torch.Generator().manual_seed(1)
    n = 6
    poses = [
        Pose(
            torch.randn(n, 3, generator=rng) + torch.tensor([2.0 * j, 0.0, 0.0]),
            torch.nn.functional.normalize(torch.randn(n, 4, generator=rng), dim=-1),
        )
        for j in range(2)
    ]
    frames = Frames.of(*poses)
    point = torch.tensor([0.3, -0.2, 0.5])
    torch.testing.assert_close(
        (frames.A @ point[:, None])[..., 0] + frames.b,
        torch.stack([pose.apply(point.expand(n, 3)) for pose in poses], 1),
    )
    # An opening of a gripper goes along and belongs to no place.
    A = torch.zeros(n, 2, 4, 4)
    A[..., :3, :3], A[..., 3, 3] = frames.A, 1.0
    frames = Frames(A, torch.nn.functional.pad(frames.b, (0, 1)))
    s = torch.linspace(0, 1, 80)
    m = minimum_jerk(s)[:, None]
    way = poses[0].position[:, None] * (1 - m) + poses[1].position[:, None] * m
    opening = 0.08 * (1 - m).expand(n, 80, 1)
    model = FramedDMP.fit(3 * s, torch.cat([way, opening], -1), frames, 20)
    made = model.at(Frames(frames.A[:2], frames.b[:2] + 0.1 * frames.A[:2, :, :, 3]))
    assert made.weights.dtype == torch.float32
    position = made.rollout().position
    torch.testing.assert_close(position[..., 3], opening[:2, :, 0] + 0.1, rtol=0, atol=2e-3)
    torch.testing.assert_close(position[..., :3], way[:2], rtol=0, atol=0.06)


def test_gradients_reach_frames(model):
    frames = situations(1, seed=4)
    with shapes_unchecked():
        assert gradcheck(
            lambda A, b: model.at(Frames(A, b)).rollout([0.3, 1.2]).position,
            (frames.A.requires_grad_(), frames.b.requires_grad_()),
            atol=1e-5,
            rtol=1e-4,
        )


def test_what_cannot_be_is_refused(model):
    frames = situations(5)
    time, position = motions(frames)
    with pytest.raises(ValueError, match="batch of 2 demonstrations"):
        FramedDMP.fit(time, position[0], frames, 20)
    with pytest.raises(ValueError, match=r"5 demonstrations of 2 coordinates need frames"):
        FramedDMP.fit(time, position, situations(4), 20)
    with pytest.raises(ValueError, match="a rhythm"):
        FramedDMP.fit(time, position, frames, basis=PeriodicBasis(count=9))
    with pytest.raises(ValueError, match="has 2 frames of 2 coordinates, got 1 of 2"):
        model.at(Frames(frames.A[:, :1], frames.b[:, :1]))
    with shapes_unchecked(), pytest.raises(ValueError, match="must have A"):
        replace(frames, A=frames.A[..., :1])
