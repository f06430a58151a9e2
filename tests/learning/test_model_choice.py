"""The model chosen for a dataset, kept in its folder and used for new starts and goals."""

import json

import numpy as np
import pytest
import torch

from hrc_learn.demos import Demonstration, DemonstrationSet
from hrc_learn.dmp import JointDMP
from hrc_learn.learning import fit_primitives, predict
from hrc_learn.learning.model_choice import (
    CHOICE,
    best_models,
    keep_best,
    predicted_primitive,
)


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


@pytest.mark.parametrize(
    ("bend", "best"),
    [(by_goal, {"contextual"}), (by_corner, {"nearest", "kernel"}), (unrelated, {"mean"})],
)
def test_the_model_that_predicts_is_chosen_kept_and_used(tmp_path, bend, best):
    demos = motions(bend, count=24)
    fitted = fit_primitives(demos, 20)
    fitted.save(tmp_path)
    metrics = keep_best(fitted, demos, (), tmp_path)
    (kind,) = best_models(tmp_path).values() or ["mean"]
    assert kind in best
    assert metrics[f"held_out_joint_{kind}_nrmse_median"] < 1.12 * min(metrics.values())
    new = motions(bend, count=12, seed=1)
    unseen = fit_primitives(new, 20).motions
    predicted = predict(tmp_path, "joint", unseen, new)
    mean = unseen.adapted("joint", JointDMP.load(tmp_path / "joint"))
    error, of_mean = (
        float(unseen.error("joint", made).nrmse.median()) for made in (predicted, mean)
    )
    assert error < {by_goal: 0.3, by_corner: 0.5, unrelated: 1.05}[bend] * of_mean
    shown, time = (torch.from_numpy(x) for x in (new[0].joint_position, new[0].time))
    one = predicted_primitive(tmp_path, "joint", shown[0], shown[-1])
    made = one.rollout(time, shown[0], shown[-1], time[-1]).position
    torch.testing.assert_close(made, predicted.position[0, : len(shown)], rtol=0, atol=2e-3)


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
