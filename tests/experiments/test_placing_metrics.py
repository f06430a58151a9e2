"""What counts as a good placing, and how trials are summed up."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from hrc_learn.experiments.monte_carlo import Trial
from hrc_learn.experiments.placing.experiment import demonstrated_shelf, perturbed_start
from hrc_learn.experiments.placing.metrics import evaluate_lessons, evaluate_random_starts
from hrc_learn.experiments.placing.trial import PlacingFigures
from hrc_learn.kinematics import panda
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.work_cell import TaskFailedError

WORKPLACE = Workplace()
SHELVES = WORKPLACE.shelf_names()
GOOD = PlacingFigures(
    bend=2e-3,
    goal_distance=1e-4,
    goal_angle=1e-4,
    violations=0,
    touches=[],
    peak_speed=0.5,
    jerk=1e-5,
    placed=True,
)


def trial(seed, **changes):
    """A trial in which the upper shelf differs."""
    values = {}
    for shelf in SHELVES:
        figures = replace(GOOD, **changes) if shelf == "upper" else GOOD
        values |= {f"{shelf}_{name}": value for name, value in figures.row().items()}
        values[f"{shelf}_joint_space_blocked"] = shelf == "lower"
    return Trial(seed=seed, values=values)


def missed(table):
    return {m.name.removeprefix("random starts, ") for m in table if m.ok is False}


def test_a_good_placing_has_no_faults():
    assert GOOD.faults == []


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"bend": 0.0121}, "bent by 12.1 mm"),
        ({"goal_distance": 0.0025}, "missed by 2.5 mm"),
        ({"goal_angle": 0.01}, "missed by 0.57 deg"),
        ({"violations": 3}, "3 steps"),
        ({"touches": ["box met board_middle at 6.10 s, 12.1 mm deep"]}, "box met board_middle"),
        ({"placed": False}, "does not stand"),
    ],
)
def test_each_fault_is_named(changes, words):
    (fault,) = replace(GOOD, **changes).faults
    assert words in fault


def test_good_trials_miss_nothing():
    table = evaluate_random_starts([trial(k) for k in range(10)], SHELVES)
    assert missed(table) == set()
    values = {m.name: m.value for m in table}
    assert values["random starts, placings"] == 30
    blocked = values["random starts, share of joint space plans that are not free"]
    assert blocked == pytest.approx(1 / 3)


def test_one_contact_in_fifty_placings_is_allowed_and_two_are_not():
    good = [trial(k) for k in range(20)]
    touched = [trial(20 + k, touches=["a met b"]) for k in range(2)]
    assert missed(evaluate_random_starts([*good, touched[0]], SHELVES)) == set()
    assert missed(evaluate_random_starts([*good, *touched], SHELVES)) == {
        "share without contact"
    }


def test_a_trial_that_was_given_up_keeps_no_target():
    trials = [trial(0), Trial(seed=1, values={}, failure="no free start")]
    assert "largest goal error" in missed(evaluate_random_starts(trials, SHELVES))


def test_lessons_may_hit_without_the_body_but_not_with_it():
    def lesson(seed, untaught, taught):
        return Trial(seed=seed, values={"untaught_hit": untaught, "taught_hit": taught})

    assert missed(evaluate_lessons([lesson(0, 1, 0), lesson(1, 1, 0)])) == set()
    assert len(missed(evaluate_lessons([lesson(0, 1, 0), lesson(1, 0, 1)]))) == 1


def test_the_demonstrated_shelf_is_where_the_hand_ended():
    for shelf in SHELVES:
        goal = WORKPLACE.shelf(shelf).position.numpy()
        assert demonstrated_shelf(goal + 0.01, WORKPLACE) == shelf
    with pytest.raises(ValueError, match="12 cm from the nearest shelf"):
        demonstrated_shelf(goal + np.array([0.0, 0.12, 0.0]), WORKPLACE)


def test_random_starts_are_free_and_each_another():
    world, rng = World(WORKPLACE.scene), np.random.default_rng(0)
    starts = [perturbed_start(world, WORKPLACE, 0.1, rng) for _ in range(2)]
    assert world.holds(WORKPLACE.scene.objects[0].name)
    assert not torch.equal(*starts)
    for start in starts:
        assert panda.limits.contain(start)
        assert float((start - WORKPLACE.home_joints()).abs().max()) < 0.5


def test_starts_that_cannot_be_free_are_given_up():
    world, rng = World(WORKPLACE.scene), np.random.default_rng(0)
    with pytest.raises(TaskFailedError, match="no free start"):
        perturbed_start(world, WORKPLACE, 1e3, rng)
