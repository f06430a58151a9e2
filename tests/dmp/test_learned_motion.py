"""Models chosen by held-out errors, against models that are fitted without each."""

import math
from types import SimpleNamespace

import pytest
import torch
from demo_motions import minimum_jerk

from hrc_learn.dmp import Frames, JointDMP, LearnedMotion, learn
from hrc_learn.dmp.learned_motion import choose
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
    with pytest.raises(ValueError, match="a model of frames has no contexts"):
        model.at_contexts(torch.zeros(1, 2).double())
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
