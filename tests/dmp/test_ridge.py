"""Ridge regression, and motions as a regression on a context."""

import numpy as np
import pytest
import torch
from demo_motions import minimum_jerk
from torch.autograd import gradcheck
from unchecked import shapes_unchecked

from hrc_learn.dmp import GaussianBasis, JointDMP, SpringDamper, fit_ridge, response_of
from hrc_learn.dmp.learned_motion import choose
from hrc_learn.dmp.solvers import solve_normal

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


@pytest.fixture(scope="module")
def each():
    return JointDMP.fit(*motion(CONTEXTS), 25, joint_names=("a", "b"))


@pytest.fixture(scope="module")
def model(each):
    return choose([each], CONTEXTS, regression_only=True)


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


def test_what_is_affine_in_the_context_is_met_where_nothing_was_shown(model):
    new = torch.tensor([[0.2, 0.9], [1.5, -0.5]], dtype=torch.float64)
    time, position = motion(new)
    predicted = model.at_contexts(new)
    # The smallest ridge of those compared is 1e-6.
    torch.testing.assert_close(predicted.duration, time[:, -1], rtol=1e-4, atol=0)
    got = predicted.rollout(time=time).position
    torch.testing.assert_close(got, position, rtol=0, atol=1e-3)
    assert predicted.joint_names == ("a", "b")
    alone = model.at(context=new[0]).rollout(time=time[0]).position
    torch.testing.assert_close(alone, got[0], rtol=0, atol=1e-10)


def test_a_context_that_never_changes_has_no_effect(each, model):
    context = torch.cat([CONTEXTS, torch.full((5, 1), 0.1).double()], dim=1)
    more = choose([each], context, regression_only=True)
    expected = model.at(context=CONTEXTS[0]).goal
    torch.testing.assert_close(more.at(context=context[0]).goal, expected, rtol=0, atol=1e-6)
    assert more.at(context=[0.0, 0.2, 0.5]).goal.allclose(expected, atol=1e-6)


def test_gradients_reach_contexts(model):
    time = torch.tensor([0.3, 1.1], dtype=torch.float64)

    def moved(context):
        return model.at_contexts(context).rollout(time=time).position

    with shapes_unchecked():
        assert gradcheck(moved, (CONTEXTS[:2].clone().requires_grad_(),), atol=1e-6)


def test_contexts_that_do_not_fit_are_refused(each, model):
    with pytest.raises(ValueError, match="one row for each of 5 demonstrations, got"):
        choose([each], CONTEXTS[:4])
    with pytest.raises(ValueError, match="context must be finite"):
        choose([each], CONTEXTS.log())
    with pytest.raises(ValueError, match="needs 4 demonstrations or more, got 3"):
        choose([each[:3]], CONTEXTS[:3], regression_only=True)
    with pytest.raises(ValueError, match="context must have 2 numbers, got 3"):
        model.at(context=[0.1, 0.2, 0.3])
    with pytest.raises(ValueError, match="at least 2 samples"):
        fit_ridge(CONTEXTS[:1], CONTEXTS[:1], 0.1)
    with pytest.raises(ValueError, match="regularization must be positive"):
        fit_ridge(CONTEXTS, CONTEXTS, 0.0)


@pytest.mark.parametrize(("ratio", "undetermined"), [(2e-3, False), (5e-4, True)])
def test_a_function_that_samples_hardly_see_is_undetermined_before_cholesky_fails(
    ratio, undetermined
):
    response = response_of(SpringDamper(), GaussianBasis(count=8))
    # Singular values of the samples by function; two columns to reproduce.
    seen = torch.tensor([*7 * [1.0], ratio], dtype=torch.float64)
    gram = torch.diag(seen**2)
    products = torch.block_diag(gram, torch.eye(2, dtype=torch.float64))[None]
    assert not torch.linalg.cholesky_ex(gram).info
    assert solve_normal(response, 8, products, 1e-9)[2].item() is undetermined
