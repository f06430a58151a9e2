"""The approach to a shelf, cut off and compared, on paths whose deviation is known."""

import numpy as np
import pytest

from hrc_learn.experiments.placing_metrics import approach_deviation

GOAL = np.array([0.4, -0.6, 0.3])


def straight(samples=200, start=0.2):
    """Along y from in front of the edge to the goal."""
    y = np.linspace(start, GOAL[1], samples)
    return np.stack([np.full(samples, GOAL[0]), y, np.full(samples, GOAL[2])], axis=1)


def deviation(path, demonstrated=None, goal=GOAL, edge=-0.47):
    return approach_deviation(
        path, goal, straight() if demonstrated is None else demonstrated, edge
    )


def test_a_path_moved_with_its_goal_does_not_deviate():
    shift = np.array([0.1, 0.0, 0.24])
    path = straight()
    path[:, 2] += 0.03 * np.sin(8 * path[:, 1])  # any shape, the same for both
    assert deviation(path + shift, path, path[-1] + shift) == pytest.approx(0.0, abs=1e-12)


def test_the_deviation_is_the_largest_distance_at_equal_depth():
    deviating = straight(samples=301, start=0.1)
    fraction = np.clip((deviating[:, 1] + 0.47) / -0.13, 0, 1)
    deviating[:, 0] += 0.03 * np.sin(np.pi * fraction)
    deviating[:, 2] -= 0.04 * np.sin(np.pi * fraction)
    assert deviation(deviating) == pytest.approx(0.05, rel=1e-3)


def test_only_what_lies_behind_the_edge_counts():
    away = straight()
    away[away[:, 1] > -0.46, 0] += 1.0
    assert deviation(away) < 1e-12
    assert deviation(away, edge=-0.40) > 0.9


def test_it_begins_where_the_edge_is_crossed_for_the_last_time():
    before = straight()[:150] + np.array([0.5, 0.0, 0.0])
    there_and_back = np.concatenate([before, before[::-1], straight()])
    assert deviation(there_and_back, edge=-0.3) < 1e-12


def test_a_tremor_along_the_way_does_not_confuse_depths():
    path = straight()
    path[:, 1] += 1e-3 * np.sin(np.arange(len(path)))
    path[-1] = GOAL
    assert deviation(straight(), path) < 1e-12


def test_a_path_that_stays_outside_deviates_infinitely():
    assert deviation(straight()[:50]) == np.inf
