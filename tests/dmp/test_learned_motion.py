"""Models chosen by held-out errors, against models that are fitted without each."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from demo_motions import minimum_jerk
from scipy.optimize import minimize_scalar
from scipy.spatial.distance import cdist

from hrc_learn.dmp import Frames, JointDMP, LearnedMotion, PoseDMP, learn
from hrc_learn.dmp.learned_motion import (
    Candidate,
    _basis_count,
    _candidates,
    _samples,
    _scale,
    _weights,
    choose,
)
from hrc_learn.geometry import Pose, quaternion

S = torch.linspace(0, 1, 90, dtype=torch.float64)
M = minimum_jerk(S)[:, None]
BUMP = torch.sin(torch.pi * S)[:, None] ** 2


def by_goal(start, goal, _):
    return 2.0 * (goal - 1.5)


def by_corner(start, goal, _):
    return (torch.sign(start[0] * start[1]) * torch.ones(2)).double()


def unrelated(start, goal, rng):
    return torch.randn(2, generator=rng).double()


def always(start, goal, _):
    return torch.tensor([1.0, -0.5]).double()


def demonstrations(bend, count=12, seed=0):
    rng = torch.Generator().manual_seed(seed)
    found = []
    for _ in range(count):
        start, goal, more = (torch.rand(3, 2, generator=rng) - 0.5).double()
        if bend is by_corner:
            start = 2 * torch.sign(start) + 0.1 * start
        goal = goal + 1.5
        time = (1.5 + more[0].abs()) * S
        way = start + (goal - start) * M + bend(start, goal, rng) * BUMP
        found.append((time, way))
    return found


def mean_error(model, unseen):
    errors = []
    for time, way in unseen:
        with torch.no_grad():
            made = model.rollout(time, way[0], way[-1], time[-1]).position
        errors.append((made - way).square().mean().sqrt() / (way.amax(0) - way.amin(0)).max())
    return float(torch.stack(errors).mean())


@pytest.mark.parametrize("bend", [by_goal, by_corner, unrelated, always])
def test_the_model_never_loses_to_mean_nearest_or_straight_line(bend):
    model = learn(demonstrations(bend), n_basis=20)
    unseen = demonstrations(bend, count=12, seed=1)
    errors = {c.name: c for c in model.candidates}
    names = ("mean, approach 1", "nearest demonstration, approach 1", "straight line")
    each = choose([fit_each(bend)]).each
    fixed = [
        mean_error(
            LearnedMotion(
                each=each,
                context=model.context,
                by_ends=True,
                frames=None,
                chosen=errors[name],
            ),
            unseen,
        )
        for name in names
    ]
    own = mean_error(model, unseen)
    # Few neighbours in each corner leave a third to chance.
    assert own < (1.4 if bend is by_corner else 1.1) * min(fixed)
    if bend is by_goal:
        assert own < 0.5 * min(fixed)


def fit_each(bend):
    times, ways = zip(*demonstrations(bend), strict=True)
    return JointDMP.fit(list(times), list(ways), 20, approach=1.0, smooth=True)


def test_held_out_errors_are_those_of_models_learned_without_each():
    model = learn(demonstrations(unrelated, count=7), n_basis=15, approach=1.0)
    x = model.each.coordinates().detach()
    c = torch.cat([x[..., -2], x[..., -1]], -1)
    z = (c - c.mean(0)) / c.std(0)
    rows = model.each.response.evaluate(torch.linspace(0, 1, 101).double())[:, 0]
    shown = x @ rows.mT
    span = (shown.amax(-1) - shown.amin(-1)).amax(-1)
    for i in range(7):
        rest = torch.arange(7) != i
        weight = torch.exp(-(z[rest] - z[i]).square().sum(-1) / (2 * 0.5**2 * 4))
        A = torch.cat([torch.ones(6, 1).double(), z[rest]], 1)
        ridge = 7 * 0.1 * torch.diag(torch.tensor([0.0, 1, 1, 1, 1]).double())
        fitted = torch.linalg.solve(A.mT @ A + ridge, A.mT @ x[rest].flatten(1))
        for name, made in (
            ("mean", x[rest].mean(0)),
            ("kernel of width 0.5", torch.einsum("n,ndm->dm", weight / weight.sum(), x[rest])),
            ("regression with ridge 0.1", (fitted[0] + z[i] @ fitted[1:]).view(2, -1)),
        ):
            ends = torch.cat([made[:, :-2], x[i, :, -2:]], -1)
            error = (ends @ rows.mT - shown[i]).square().mean().sqrt() / span[i]
            held = next(k for k in model.candidates if k.name == f"{name}, approach 1")
            assert held.error[i].item() == pytest.approx(error.item(), rel=1e-6)


def test_a_context_decides_where_start_and_goal_do_not():
    rng = torch.Generator().manual_seed(3)
    size = torch.rand(9, 1, generator=rng).double()
    shown = [(2 * S, M * torch.ones(1, 2) + c * BUMP) for c in size]
    model = learn(shown, n_basis=15, context=size)
    assert model.chosen.family == "ridge"
    made = model.rollout(2 * S, context=[0.5]).position
    assert (made - (M + 0.5 * BUMP)).abs().max() < 1e-3
    with pytest.raises(ValueError, match="give the context of the motion, 1 numbers"):
        model.at([0.0, 0.0], [1.0, 1.0])
    with pytest.raises(ValueError, match="context must have 1 numbers, got 2"):
        model.at(context=[0.5, 0.1])


def test_frames_are_chosen_where_they_determine_the_motion(tmp_path):
    rng = torch.Generator().manual_seed(5)
    places = 2 * torch.rand(6, 2, generator=rng).double()
    turns = 2 * torch.rand(6, generator=rng).double()
    A, b, shown = [], [], []
    for place, turn in zip(places, turns, strict=True):
        R = torch.tensor([[turn.cos(), -turn.sin()], [turn.sin(), turn.cos()]]).double()
        local = torch.stack([M[:, 0] - 1, BUMP[:, 0]], -1)
        shown.append((2 * S, local @ R.mT + place))
        A.append(torch.stack([torch.eye(2).double(), R]))
        b.append(torch.stack([torch.zeros(2).double(), place]))
    frames = Frames(torch.stack(A), torch.stack(b))
    model = learn(shown[:5], n_basis=15, frames=Frames(frames.A[:5], frames.b[:5]))
    assert model.chosen.family == "frames"
    made = model.rollout(2 * S, frames=Frames(frames.A[5], frames.b[5])).position
    assert (made - shown[5][1]).abs().max() < 0.1
    with pytest.raises(ValueError, match="give the 2 frames"):
        model.at()
    with pytest.raises(ValueError, match="predicts from frames: leave out the context"):
        model.at(frames=Frames(frames.A[5], frames.b[5]), context=[0.5])
    with pytest.raises(ValueError, match="a model of frames has no contexts"):
        model.at_contexts(torch.zeros(1, 2).double())
    solid = [
        (
            t,
            Pose(
                torch.nn.functional.pad(y, (0, 1)),
                torch.tensor([1.0, 0, 0, 0]).double().repeat(len(t), 1),
            ),
        )
        for t, y in shown[:5]
    ]
    with pytest.raises(ValueError, match="leave out orientations or frames"):
        learn(solid, n_basis=15, frames=Frames(frames.A[:5], frames.b[:5]))
    model.save(tmp_path / "model")
    again = LearnedMotion.load(tmp_path / "model")
    other = again.rollout(2 * S, frames=Frames(frames.A[5], frames.b[5])).position
    torch.testing.assert_close(other, made)


def test_demonstrations_of_a_dataset_are_read_by_their_fields():
    """Joints before poses; a position with its orientation is a pose."""
    time, way = demonstrations(by_goal)[0]
    point = torch.cat([way, torch.zeros_like(way[:, :1])], -1)
    turn = quaternion.exp(0.3 * M * torch.tensor([0.0, 0.6, 0.8]).double())
    shown = {"joint_position": way, "position": point, "orientation": turn}
    for names, expected in (
        (("joint_position", "position", "orientation"), way),
        (("position",), point),
        (("position", "orientation"), Pose(point, turn)),
    ):
        fields = {name: shown[name] if name in names else None for name in shown}
        read = learn([SimpleNamespace(time=time, **fields)], n_basis=10).rollout(time)
        same = learn([(time, expected)], n_basis=10).rollout(time)
        torch.testing.assert_close(read.position, same.position)
        assert hasattr(read, "orientation") == isinstance(expected, Pose)
    with pytest.raises(ValueError, match="neither joint positions nor positions"):
        learn([SimpleNamespace(time=time)])
    for no_pairs in (way, [(time, way, way)], "way"):
        with pytest.raises(ValueError, match=r"nor a pair \(times, values\)"):
            learn(no_pairs)


def test_few_samples_have_few_functions():
    time, way = demonstrations(by_goal)[0]
    model = learn([(time[::5], way[::5])] * 2)
    assert model.each.motion.basis.count == 10


@pytest.mark.parametrize("kind", ["joint", "pose"])
def test_a_demonstrated_start_and_goal_repeat_the_demonstration_also_from_a_file(
    kind, tmp_path
):
    shown = demonstrations(by_goal, count=8)
    if kind == "pose":
        space = [(t, torch.cat([y, y[:, :1]], -1)) for t, y in shown]
        shown = [(t, Pose(y, quaternion.exp(0.3 * y))) for t, y in space]
    model = learn(shown)
    model.save(tmp_path / "model")
    for each in (model, LearnedMotion.load(tmp_path / "model")):
        time, values = shown[3]
        made = each.rollout(time, values[0], values[-1], time[-1])
        wanted = values.position if kind == "pose" else values
        assert (made.position - wanted).abs().max() < 2e-3
        if kind == "pose":
            assert quaternion.angle(made.orientation, values.orientation).max() < 2e-3
    assert "held-out error" in model.reasons
    assert "straight line" in model.reasons


def test_one_demonstration_is_the_model():
    time, way = demonstrations(by_goal)[0]
    model = learn([(time, way)])
    assert (model.rollout(time).position - way).abs().max() < 1e-3


def test_demonstrations_that_cannot_be_learned_from_are_refused():
    with pytest.raises(ValueError, match="no demonstrations"):
        learn([])
    time, way = demonstrations(by_goal)[0]
    bad = way.clone()
    bad[3, 0] = math.nan
    with pytest.raises(ValueError, match="demonstration 1: position is nan at sample 3"):
        learn([(time, way), (time, bad)], n_basis=10)
    with pytest.raises(ValueError, match="context must be finite"):
        learn([(time, way)] * 2, n_basis=10, context=[[math.nan], [0.0]])


def numpy_weights(family, strength, known, asked):
    """Weights of demonstrations by the definitions, contexts in units of their deviation."""
    deviation = known.std(0, ddof=1)
    varies = deviation > 1e-9 * (1 + np.abs(known).max(0))
    a, b = ((x - known.mean(0))[:, varies] / deviation[varies] for x in (asked, known))
    n = len(known)
    if family == "ridge":
        A = np.c_[np.ones(n), b]
        penalty = np.diag([0.0, *[n * strength] * b.shape[1]])
        return np.c_[np.ones(len(a)), a] @ np.linalg.solve(A.T @ A + penalty, A.T)
    distance = cdist(a, b) / varies.sum() ** 0.5
    if strength == 0:
        return np.eye(n)[distance.argmin(1)]
    w = np.exp(-((distance / strength) ** 2) / 2)
    return w / w.sum(1, keepdims=True)


MODELS = [
    *(("kernel", width) for width in (math.inf, 2.0, 0.5, 0.0)),
    *(("ridge", penalty) for penalty in (1.0, 0.1, 1e-6)),
]


@pytest.mark.parametrize(("family", "strength"), MODELS)
def test_weights_are_those_of_each_model(family, strength):
    rng = np.random.default_rng(0)
    known = rng.normal(size=(7, 4)) * (1.0, 100.0, 1e-3, 0.0) + (0.0, 50.0, 1.0, 3.0)
    known[:, 3] += 1e-9 * rng.uniform(-1, 1, 7)  # all but constant
    asked = known[:3] + np.array([0.5, -20.0, 1e-3, 0.0])
    found = _weights(family, strength, *map(torch.from_numpy, (known, asked)))
    np.testing.assert_allclose(found, numpy_weights(family, strength, known, asked), rtol=1e-6)
    np.testing.assert_allclose(found.sum(1), 1)


@pytest.mark.parametrize(("family", "strength"), MODELS)
def test_held_out_weights_leave_out_each_demonstration(family, strength):
    """Units of the contexts, and the penalty, are those of all demonstrations."""
    rng = np.random.default_rng(1)
    known = rng.normal(size=(6, 2))
    found = _weights(family, strength, torch.from_numpy(known)).numpy()
    np.testing.assert_allclose(np.diag(found), 0, atol=1e-12)
    np.testing.assert_allclose(found.sum(1), 1)
    z = (known - known.mean(0)) / known.std(0, ddof=1)
    for i in range(6):
        rest = np.arange(6) != i
        if family == "ridge":
            A = np.c_[np.ones(5), z[rest]]
            gram = A.T @ A + np.diag([0.0, 6 * strength, 6 * strength])
            expected = np.r_[1.0, z[i]] @ np.linalg.solve(gram, A.T)
        else:
            apart = ((z[rest] - z[i]) ** 2).sum(1) / 2
            width = max(strength, 1e-2)
            expected = np.exp(-(apart - apart.min()) / (2 * width**2))
            expected /= expected.sum()
        np.testing.assert_allclose(found[i, rest], expected, atol=1e-9)


def test_contexts_that_never_vary_weigh_all_alike():
    for n in (3, 1):
        known = torch.full((n, 2), 4.0).double()
        for asked in (known, known + 1):
            found = _weights("kernel", 0.5, known, asked)
            torch.testing.assert_close(found, torch.full((n, n), 1 / n).double())


def test_every_model_is_shrunk_by_the_factor_of_least_error():
    each = fit_each(unrelated)
    x = each.coordinates().detach().numpy()
    c = np.concatenate([x[..., -2], x[..., -1]], -1)
    rows = each.response.evaluate(torch.linspace(0, 1, 101).double())[:, 0].numpy()
    span = np.ptp(x @ rows.T, axis=-1).max(1)[:, None, None]
    found = _candidates(each, torch.from_numpy(c), None)
    widths, penalties = (2.0, 1.0, 0.5, 0.25), (1.0, 0.1, 1e-2, 1e-3, 1e-6)
    models = [("kernel", width) for width in (math.inf, *widths, 0.0)]
    models += [("ridge", penalty) for penalty in penalties]
    assert [(c.family, c.strength) for c in found[::3]] == models
    for k, (family, strength) in enumerate(models):
        whole, shrunk, line = found[3 * k : 3 * k + 3]
        assert (whole.shrinkage, line.shrinkage) == (1.0, 0.0)
        assert {c.family for c in (whole, shrunk, line)} == {family}
        assert {c.approach for c in (whole, shrunk, line)} == {1.0}
        w = _weights(family, strength, torch.from_numpy(c)).numpy()
        bent = np.einsum("in,ndm->idm", w, x)[..., :-2] @ rows.T[:-2] / span
        wanted = x[..., :-2] @ rows.T[:-2] / span

        def squares(factor, bent=bent, wanted=wanted):
            return ((factor * bent - wanted) ** 2).mean((-2, -1))

        best = minimize_scalar(lambda f: squares(f).sum(), bounds=(0, 1), method="bounded").x
        assert shrunk.shrinkage == pytest.approx(best, abs=1e-4)
        for candidate in (whole, shrunk, line):
            expected = squares(candidate.shrinkage) ** 0.5
            np.testing.assert_allclose(candidate.error, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("count", "families"), [(2, {"kernel"}), (3, {"kernel"}), (4, {"kernel", "ridge"})]
)
def test_regressions_need_four_demonstrations(count, families):
    model = learn(demonstrations(by_goal, count), n_basis=10)
    assert {c.family for c in model.candidates} == families
    assert len(model.candidates) == 2 * 3 * (6 if count < 4 else 11)
    fits = [model.each]
    if "ridge" in families:
        chosen = choose(fits, regression_only=True).chosen
        assert (chosen.family, chosen.shrinkage) == ("ridge", 1.0)
    else:
        with pytest.raises(ValueError, match=f"needs 4 demonstrations or more, got {count}"):
            choose(fits, regression_only=True)


@pytest.mark.parametrize(
    ("errors", "chosen"),
    [
        ([[1, 1, 1, 1], [0.981] * 4], 0),
        ([[1, 1, 1, 1], [0.979] * 4], 1),
        # Relative to the errors: of twice the size twice the decrease counts.
        ([[2, 2, 2, 2], [1.961] * 4], 0),
        ([[2, 2, 2, 2], [1.959] * 4], 1),
        # The decrease 0.1 has a deviation of 0.24 or 0.26, of which 0.4 count for 4.
        ([[1, 1, 1, 1], [0.9 + 0.866 * 0.24, 0.9 - 0.866 * 0.24] * 2], 1),
        ([[1, 1, 1, 1], [0.9 + 0.866 * 0.26, 0.9 - 0.866 * 0.26] * 2], 0),
        # Against the best so far, not the first.
        ([[1, 1, 1, 1], [0.9] * 4, [0.89] * 4], 1),
        ([[1, 1, 1, 1], [0.99] * 4, [0.97] * 4], 2),
        ([[1], [0.5]], 0),
    ],
)
def test_a_less_simple_model_is_clearly_better(monkeypatch, errors, chosen):
    """By 2 % of the mean error, and by 0.8 standard errors of the decrease."""
    each = fit_each(always)[: len(errors[0])]
    listed = [
        Candidate(
            family="kernel",
            strength=float(k),
            approach=1.0,
            shrinkage=1.0,
            error=torch.tensor(error).double(),
        )
        for k, error in enumerate(errors)
    ]
    monkeypatch.setattr("hrc_learn.dmp.learned_motion._candidates", lambda *_: listed)
    model = choose([each])
    assert model.chosen.strength == chosen
    assert model.candidates == tuple(listed)


@pytest.mark.parametrize(
    ("family", "strength", "shrinkage", "kind", "name"),
    [
        ("kernel", math.inf, 1.0, "mean", "mean, approach 0.6"),
        ("kernel", 0.0, 1.0, "nearest", "nearest demonstration, approach 0.6"),
        ("kernel", 0.25, 1.0, "kernel", "kernel of width 0.25, approach 0.6"),
        ("kernel", 0.25, 0.5, "kernel", "kernel of width 0.25, shrunk to 0.50, approach 0.6"),
        ("ridge", 1e-6, 1.0, "contextual", "regression with ridge 1e-06, approach 0.6"),
        ("frames", 1.0, 1.0, "frames", "frames, approach 0.6"),
        ("ridge", 1.0, 0.0, "line", "straight line"),
    ],
)
def test_models_are_named(family, strength, shrinkage, kind, name):
    model = Candidate(
        family=family,
        strength=strength,
        approach=0.6,
        shrinkage=shrinkage,
        error=torch.zeros(2).double(),
    )
    assert (model.kind, model.name) == (kind, name)


def test_each_kind_of_columns_has_its_largest_range_as_unit():
    """Positions, orientation errors and bodies; those that do not move have the unit one."""
    turn = torch.zeros(2, 90, 3).double()
    turn[1] = 0.2 * M * torch.tensor([1.0, 0.0, 0.0])
    position = torch.stack([M * torch.tensor([0.1, 0.4, 0.2]), M * torch.tensor([3.0, 0, 0])])
    for body in (None, torch.stack([0.7 * M, 0 * M])):
        each = PoseDMP.fit(S, position, quaternion.exp(turn), 10, body=body)
        rows = each.motion.response.evaluate(torch.linspace(0, 1, 101).double())[:, 0]
        shown = each.motion.coordinates().detach() @ rows.mT
        expected = torch.tensor([[0.4] * 3 + [1.0] * 3 + [0.7], [3.0] * 3 + [0.2] * 3 + [1.0]])
        found = _scale(each, shown)
        assert found.shape == (2, 6 if body is None else 7, 1)
        torch.testing.assert_close(
            found[..., 0], expected[:, : found.shape[1]].double(), rtol=0.02, atol=0
        )
    joints = JointDMP.fit(S, position, 10)
    shown = joints.coordinates().detach() @ rows.mT
    torch.testing.assert_close(
        _scale(joints, shown)[:, :, 0],
        torch.tensor([[0.4] * 3, [3.0] * 3]).double(),
        rtol=0.02,
        atol=0,
    )


def test_a_basis_has_a_function_for_two_samples_at_most():
    """A detail that ten functions do not show takes more, if there are samples for them."""
    for frames, expected in ((39, 10), (40, 20)):
        s = torch.linspace(0, 1, frames, dtype=torch.float64)
        way = torch.sin(2 * torch.pi * 4 * s)[:, None] * s[:, None]
        assert _basis_count([s, torch.linspace(0, 1, 90)], [way, 0 * S[:, None]]) == expected


def test_columns_and_poses_are_samples():
    time, values = _samples(([0.0, 1.0, 2.0], [1.0, 2.0, 4.0]))
    assert time.tolist() == [0, 1, 2]
    assert values.tolist() == [[1], [2], [4]]
    time, values = _samples(([0.0, 1.0], [[1.0, 2.0], [3.0, 4.0]]))
    assert values.tolist() == [[1, 2], [3, 4]]


def test_options_and_approaches_are_those_of_the_fit():
    """Two approaches by default, and smooth fits."""
    rng = torch.Generator().manual_seed(0)
    shown = [
        (time, way + 1e-3 * torch.randn(way.shape, generator=rng).double())
        for time, way in demonstrations(always, 3)
    ]
    times, ways = (list(x) for x in zip(*shown, strict=True))
    model = learn(shown, n_basis=30)
    assert {c.approach for c in model.candidates} == {1.0, 0.6}
    one = learn(shown, n_basis=30, approach=0.8)
    assert {c.approach for c in one.candidates} == {0.8}
    assert one.each.motion.response.approach == 0.8
    for smooth in (True, False):
        options = {} if smooth else {"smooth": False}
        found = learn(shown, n_basis=30, approach=0.8, **options).each.coordinates()
        fitted = JointDMP.fit(times, ways, 30, approach=0.8, smooth=smooth)
        torch.testing.assert_close(found, fitted.coordinates())


@pytest.mark.parametrize(("family", "strength"), [("kernel", 0.5), ("ridge", 0.1)])
@pytest.mark.parametrize("shrinkage", [1.0, 0.25])
def test_coordinates_and_durations_are_weighted_means(family, strength, shrinkage):
    """Durations in their logarithm; the deviation from the straight motion is shrunk."""
    each = fit_each(by_goal)
    x = each.coordinates().detach()
    context = torch.cat([x[..., -2], x[..., -1]], -1)
    chosen = Candidate(
        family=family,
        strength=strength,
        approach=1.0,
        shrinkage=shrinkage,
        error=torch.zeros(12).double(),
    )
    parts = {"each": each, "context": context, "frames": None, "chosen": chosen}
    model = LearnedMotion(by_ends=True, **parts)
    asked = context[:2] + 0.1
    w = torch.from_numpy(numpy_weights(family, strength, context.numpy(), asked.numpy()))
    found = model.at_contexts(asked)
    middle = torch.einsum("qn,ndm->qdm", w, x)
    middle[..., :-2] *= shrinkage
    torch.testing.assert_close(found.coordinates(), middle, rtol=1e-6, atol=1e-8)
    lasting = (w @ each.duration.log()).exp()
    torch.testing.assert_close(found.duration, lasting, rtol=1e-6, atol=0)
    # By start and goal, as they are in the context.
    start, goal = asked[1, :2], asked[1, 2:]
    single = model.at(start, goal)
    torch.testing.assert_close(single.weights, found[1].weights)
    torch.testing.assert_close(single.duration, found[1].duration)
    torch.testing.assert_close(torch.cat([single.start, single.goal]), asked[1])
    assert model.at(start, goal, 3.5).duration.item() == 3.5
    with pytest.raises(ValueError, match="predicts from start and goal: leave out"):
        model.at(start, goal, context=asked[1])
    # By default those that the model predicts for the mean ones.
    usual = model.at_contexts(context.mean(0, keepdim=True))[0]
    torch.testing.assert_close(model.at().coordinates(), usual.coordinates())
    by_context = LearnedMotion(by_ends=False, **parts).at(context=asked[1])
    torch.testing.assert_close(by_context.coordinates(), middle[1], rtol=1e-6, atol=1e-8)


def test_reasons_are_medians_and_percentiles_of_the_errors_in_percent():
    model = learn(demonstrations(by_goal), n_basis=20)
    first, *lines = model.reasons.splitlines()
    assert first == (
        f"{model.chosen.name}, 20 basis functions; held-out error relative to the range:"
    )
    names = ["chosen", "mean", "straight line", "nearest demonstration"]
    assert [line.split(":")[0] for line in lines] == names
    errors = {c.name: c.error for c in reversed(model.candidates)}
    for line, error in zip(
        lines,
        (
            model.chosen.error,
            errors["mean, approach 1"],
            errors["straight line"],
            errors["nearest demonstration, approach 1"],
        ),
        strict=True,
    ):
        low, high = np.percentile(error, [50, 90])
        # PyTorch's median of an even number is the lower of the two in the middle.
        assert line.endswith(
            f": {100 * error.median():.2f} % median, {100 * high:.2f} % at the 90th percentile"
        )
        assert error.median() <= low


@pytest.mark.parametrize("strength", [math.inf, 0.0, 0.5])
def test_files_keep_the_model(strength, tmp_path):
    chosen = Candidate(
        family="kernel",
        strength=strength,
        approach=1.0,
        shrinkage=0.5,
        error=torch.arange(12).double(),
    )
    each = fit_each(by_goal)
    context = torch.rand(12, 3, generator=torch.Generator().manual_seed(0)).double()
    for by_ends in (False, True):
        LearnedMotion(
            each=each, context=context, by_ends=by_ends, frames=None, chosen=chosen
        ).save(tmp_path / "model")
        again = LearnedMotion.load(tmp_path / "model")
        assert again.by_ends is by_ends
        assert again.candidates == ()
        assert {**vars(again.chosen), "error": 0} == {**vars(chosen), "error": 0}
        assert torch.equal(again.chosen.error, chosen.error)
        assert torch.equal(again.context, context)


@pytest.mark.parametrize("context", [5.0, torch.zeros(2, 3)])
def test_another_number_of_contexts_is_refused(context):
    with pytest.raises(ValueError, match="one row for each of 3 demonstrations, got"):
        learn(demonstrations(always, 3), n_basis=10, context=context)
