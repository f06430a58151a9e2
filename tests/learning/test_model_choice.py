"""Held-out errors against models that are fitted anew, and the model that they choose."""

import json

import numpy as np
import pytest
import torch

from hrc_learn.demos import Demonstration, DemonstrationSet
from hrc_learn.dmp import ContextualDMP, JointDMP, mean_primitive
from hrc_learn.learning import fit_primitives, held_out_errors, predict
from hrc_learn.learning.model_choice import CHOICE, best_models, contexts, keep_best


def motions(bend, count=10, seed=0):
    """Two joints from a start to a goal on a way that is bent by `bend(start, goal)`."""
    rng = np.random.default_rng(seed)
    spread = 0.5 if bend is by_goal else 0.02
    demos = []
    for episode in range(count):
        start, goal = rng.uniform(-spread, spread, 2), 1.5 + rng.uniform(-spread, spread, 2)
        if bend is by_corner:
            start, goal = start + rng.choice([-0.5, 0.5], 2), np.full(2, 1.5)
        s = np.linspace(0, 1, 90)[:, None]
        reach = 10 * s**3 - 15 * s**4 + 6 * s**5
        way = start + (goal - start) * reach + bend(start, goal) * np.sin(np.pi * s) ** 2
        time = (1.5 + 0.2 * rng.uniform()) * s[:, 0]
        demos.append(
            Demonstration(
                time=time, joint_position=way, joint_names=("a", "b"), fps=60, episode=episode
            )
        )
    return DemonstrationSet(demos)


def by_goal(start, goal):
    return 2.0 * (goal - 1.5)


def by_corner(start, goal):
    """No linear function of the start, and the same for those near each other."""
    return np.full(2, np.sign(start[0] * start[1]))


def unrelated(start, goal):
    """What start and goal say nothing of."""
    return np.sin(1e6 * start)


def errors_of(demos):
    fitted = fit_primitives(demos, 20)
    context = contexts(demos, (), fitted.motions, "joint")
    return fitted, context, held_out_errors(fitted, "joint", context)


def without(demos, index):
    return DemonstrationSet([d for d in demos if d.episode != index])


def test_held_out_errors_are_those_of_models_fitted_without_each():
    demos = motions(by_goal, count=9)
    _, context, errors = errors_of(demos)
    for i in range(len(demos)):
        rest = fit_primitives(without(demos, i), 20)
        alone = fit_primitives(DemonstrationSet([demos[i]]), 20).motions
        others = torch.arange(len(demos)) != i
        mean = alone.adapted("joint", mean_primitive(rest.each["joint"]))
        truth = alone.error("joint", mean).nrmse[0]
        # The mean start velocity is taken per second in one, per duration in the other.
        assert errors.nrmse["mean"][i] == pytest.approx(float(truth), rel=0.05)
        model = ContextualDMP.fit(
            rest.motions.demos.time,
            rest.motions.position("joint"),
            context[others],
            20,
            regularization=errors.regularization,
            **rest.options,
        )
        made = alone.adapted("joint", model.at(context[i]))
        truth = alone.error("joint", made).nrmse[0]
        assert errors.nrmse["contextual"][i] == pytest.approx(float(truth), abs=2e-3)


@pytest.mark.parametrize(
    ("bend", "best"), [(by_goal, "contextual"), (by_corner, "nearest"), (unrelated, "mean")]
)
def test_the_model_that_predicts_is_chosen_kept_and_used(tmp_path, bend, best):
    demos = motions(bend, count=24)
    fitted, _, errors = errors_of(demos)
    assert errors.best == best
    fitted.save(tmp_path)
    metrics = keep_best(fitted, demos, (), tmp_path)
    assert metrics[f"held_out_joint_{best}_nrmse_median"] < 1.12 * min(errors.median.values())
    assert best_models(tmp_path) == ({} if best == "mean" else {"joint": best})
    new = motions(bend, count=12, seed=1)
    unseen = fit_primitives(new, 20).motions
    predicted = predict(tmp_path, "joint", unseen, new)
    mean = unseen.adapted("joint", JointDMP.load(tmp_path / "joint"))
    error, of_mean = (
        float(unseen.error("joint", made).nrmse.median()) for made in (predicted, mean)
    )
    assert error < {"contextual": 0.3, "nearest": 0.5, "mean": 1.0001}[best] * of_mean


def test_too_few_demonstrations_choose_nothing(tmp_path):
    demos = motions(by_goal, count=3)
    fitted = fit_primitives(demos, 20)
    assert keep_best(fitted, demos, (), tmp_path) == {}
    assert not (tmp_path / CHOICE).exists()


@pytest.mark.parametrize("content", ["{", "[]", '{"models": {"joint": "best"}, "context": []}'])
def test_a_damaged_choice_is_named(tmp_path, content):
    (tmp_path / CHOICE).write_text(content)
    with pytest.raises(ValueError, match=CHOICE):
        best_models(tmp_path)
    (tmp_path / CHOICE).write_text(json.dumps({"models": {}, "context": []}))
    assert best_models(tmp_path) == {}
