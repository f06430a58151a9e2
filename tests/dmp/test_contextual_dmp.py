import numpy as np
import pytest
import torch
from demo_motions import minimum_jerk
from torch.autograd import gradcheck
from unchecked import shapes_unchecked

from hrc_learn.dmp import ContextualDMP, JointDMP, fit_ridge

S = torch.linspace(0, 1, 200, dtype=torch.float64)
CONTEXTS = torch.tensor([[0.0, 0.2], [0.5, 1.0], [1.0, 0.1], [0.3, 0.7], [0.8, 0.6]]).double()


def motion(context):
    """Goal and bump affine in the context, the logarithm of the duration too."""
    c = torch.as_tensor(context, dtype=torch.float64)
    goal = torch.stack([1 + c[..., 0], c[..., 1] - 2 * c[..., 0]], dim=-1)
    bump = torch.stack([c[..., 1], 1 - c[..., 0]], dim=-1)
    s = S[:, None]
    position = minimum_jerk(s) * goal[..., None, :]
    position = position + 0.3 * torch.sin(torch.pi * s) ** 2 * bump[..., None, :]
    return S * torch.exp(0.5 + 0.4 * c[..., :1]), position


def noisy(seed=0, scale=0.05):
    rng = torch.Generator().manual_seed(seed)
    time, position = motion(CONTEXTS)
    wave = torch.randn(len(CONTEXTS), 1, 2, generator=rng, dtype=torch.float64)
    return time, position + scale * wave * torch.sin(3 * S)[:, None]


def fitted(**arguments):
    return ContextualDMP.fit(*motion(CONTEXTS), CONTEXTS, n_basis=25, **arguments)


def test_what_is_affine_in_the_context_is_met_where_nothing_was_shown():
    dmp = fitted(regularization=1e-12, joint_names=("a", "b"))
    new = torch.tensor([[0.2, 0.9], [1.5, -0.5]], dtype=torch.float64)
    time, position = motion(new)
    predicted = dmp.at(new)
    torch.testing.assert_close(predicted.duration, time[:, -1], rtol=1e-9, atol=0)
    got = predicted.rollout(time=time).position
    own = JointDMP.fit(time, position, n_basis=25).rollout(time=time).position
    torch.testing.assert_close(got, own, rtol=0, atol=1e-8)
    # As near the truth as primitives of 25 functions come.
    torch.testing.assert_close(got, position, rtol=0, atol=1e-4)
    assert predicted.joint_names == ("a", "b")
    assert dmp.held_out.peak.max() < 1e-4


@pytest.mark.parametrize("standardize", [True, False])
def test_the_ridge_solves_the_penalised_equations(standardize):
    """Against normal equations on features as they are, each slope with its own penalty."""
    rng = np.random.default_rng(0)
    x, y = rng.normal(2.0, [1.0, 5.0, 0.1], (9, 3)), rng.normal(size=(9, 4))
    fit = fit_ridge(torch.tensor(x), torch.tensor(y), 0.3, standardize=standardize)
    A = np.column_stack([np.ones(9), x])
    P = np.diag([0.0, *(9 * 0.3 * (x.var(0) if standardize else np.ones(3)))])
    expected = np.linalg.solve(A.T @ A + P, A.T @ y)
    slopes = fit.coefficients[1:] / fit.scale[:, None]
    np.testing.assert_allclose(slopes, expected[1:], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(fit.coefficients[0], y.mean(0), rtol=1e-9)
    for i in range(9):
        rest = np.arange(9) != i
        B = np.linalg.solve(A[rest].T @ A[rest] + P, A[rest].T @ y[rest])
        np.testing.assert_allclose(fit.held_out[i], y[i] - A[i] @ B, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("regularization", [1e-4, 0.1])
def test_held_out_errors_are_those_of_leaving_each_out(regularization):
    """By brute force: coordinates of each primitive regressed without it, and rolled out."""
    time, position = noisy()
    dmp = ContextualDMP.fit(time, position, CONTEXTS, n_basis=12, regularization=regularization)
    each = JointDMP.fit(time, position, n_basis=12)
    c = CONTEXTS.numpy()
    A = np.column_stack([np.ones(5), c])
    P = np.diag([0.0, *(5 * regularization * c.var(0))])
    parts = {
        "start": each.start,
        "goal": each.goal,
        "rate": each.start_velocity * each.duration[:, None],
        "weights": each.weights.detach(),
    }
    for i in range(5):
        rest = np.arange(5) != i
        mix = A[i] @ np.linalg.solve(A[rest].T @ A[rest] + P, A[rest].T)
        x = {k: np.tensordot(mix, v.numpy()[rest], 1) for k, v in parts.items()}
        rows = each.response.evaluate(S).numpy()[:, 0]
        X = np.column_stack([x["weights"], x["rate"], x["start"], x["goal"]])
        error = rows @ X.T - position[i].numpy()
        rmse = np.sqrt((error**2).mean(0))
        np.testing.assert_allclose(dmp.held_out.rmse[i], rmse, rtol=1e-6)
        np.testing.assert_allclose(dmp.held_out.peak[i], abs(error).max(0), rtol=1e-6)


def test_a_strong_penalty_leads_to_the_mean():
    dmp = fitted(regularization=1e9)
    torch.testing.assert_close(dmp.at(CONTEXTS[1]).goal, dmp.mean.goal, rtol=0, atol=1e-8)


def test_single_precision_is_kept_and_follows():
    time, position = motion(CONTEXTS)
    single = ContextualDMP.fit(time, position.float(), CONTEXTS, n_basis=25)
    got = single.at(CONTEXTS[1]).rollout().position
    assert got.dtype == torch.float32
    expected = fitted().at(CONTEXTS[1]).rollout().position
    # Six digits of motions of size 2.
    torch.testing.assert_close(got.double(), expected, rtol=0, atol=1e-5)


def test_a_context_that_never_changes_tells_nothing():
    context = torch.cat([CONTEXTS, torch.full((5, 1), 0.1).double()], dim=1)
    dmp = ContextualDMP.fit(*motion(CONTEXTS), context, n_basis=25)
    expected = fitted().at(CONTEXTS[0]).goal
    torch.testing.assert_close(dmp.at(context[0]).goal, expected, rtol=0, atol=1e-9)
    assert dmp.at([0.0, 0.2, 0.5]).goal.allclose(expected)


@pytest.mark.parametrize("batch", [(), (1,), (3, 2)])
def test_a_batch_is_a_loop(batch):
    dmp = fitted()
    context = torch.rand(*batch, 2, generator=torch.Generator().manual_seed(1)).double()
    time = torch.linspace(0, 1.5, 20, dtype=torch.float64)
    together = dmp.at(context).rollout(time=time).position
    assert together.shape == (*batch, 20, 2)
    for index in np.ndindex(batch):
        alone = dmp.at(context[index]).rollout(time=time).position
        torch.testing.assert_close(together[index], alone, rtol=0, atol=1e-10)


def test_gradients_reach_contexts_and_coefficients():
    dmp = fitted()
    time = torch.tensor([0.3, 1.1], dtype=torch.float64)

    def moved(context):
        return dmp.at(context).rollout(time=time).position

    def stepped(context):
        one = dmp.at(context)
        return one.step(one.initial_state(), 0.4).position

    context = CONTEXTS[:2].clone().requires_grad_()
    with shapes_unchecked():
        assert gradcheck(moved, (context,), atol=1e-6)
        assert gradcheck(stepped, (context,), atol=1e-6)
    moved(context).sum().backward()
    assert dmp.coefficients.grad is not None
    assert [name for name, p in dmp.named_parameters() if p.requires_grad] == ["coefficients"]


def test_padded_demonstrations_of_unlike_lengths():
    time, position = motion(CONTEXTS)
    mask = torch.ones(5, 210, dtype=torch.bool)
    mask[:, 200:] = False
    filling = torch.full((5, 10, 2), torch.nan, dtype=torch.float64)
    padded = ContextualDMP.fit(
        torch.cat([time, filling[..., 0]], dim=1),
        torch.cat([position, filling], dim=1),
        CONTEXTS,
        n_basis=25,
        mask=mask,
    )
    plain = fitted()
    torch.testing.assert_close(padded.coefficients, plain.coefficients, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(padded.held_out.rmse, plain.held_out.rmse, rtol=0, atol=1e-8)


def test_a_saved_one_is_the_same(tmp_path):
    dmp = fitted(approach=0.5)
    dmp.save(tmp_path / "placing")
    loaded = ContextualDMP.load(tmp_path / "placing")
    new = [0.2, 0.9]
    # Not to the last bit: where tensors lie in memory decides how a product is summed.
    torch.testing.assert_close(
        loaded.at(new).rollout().position, dmp.at(new).rollout().position, rtol=0, atol=1e-14
    )
    torch.testing.assert_close(loaded.held_out.rmse, dmp.held_out.rmse, rtol=0, atol=0)
    # What it gives can be kept alone.
    dmp.at(new).save(tmp_path / "one")
    one = JointDMP.load(tmp_path / "one").rollout().position
    torch.testing.assert_close(one, dmp.at(new).rollout().position, rtol=0, atol=0)


def test_what_cannot_be_is_refused():
    time, position = motion(CONTEXTS)
    for context, complaint in (
        (CONTEXTS[:4], "one row for each of 5"),
        (CONTEXTS.log(), "context of demonstration 0 is not finite"),
    ):
        with pytest.raises(ValueError, match=complaint):
            ContextualDMP.fit(time, position, context)
    with pytest.raises(ValueError, match=r"position must be \(n, T, D\)"):
        ContextualDMP.fit(time[0], position[0], CONTEXTS)
    with pytest.raises(ValueError, match="at least 2 samples"):
        ContextualDMP.fit(time[:1], position[:1], CONTEXTS[:1])
    with pytest.raises(ValueError, match="regularization must be positive"):
        fitted(regularization=0.0)
    with pytest.raises(ValueError, match=r"context must have shape \(..., 2\), got \(3,\)"):
        fitted().at([0.1, 0.2, 0.3])
