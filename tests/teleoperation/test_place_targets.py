"""What a person is told of where things go."""

import numpy as np
import pytest

from hrc_learn.kinematics import panda
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.teleoperation.page_session import place_target_hint, place_targets

WORKPLACE = Workplace()


@pytest.mark.parametrize("shelf", WORKPLACE.shelf_names())
def test_a_thing_let_go_at_a_shelf_stands_on_the_field_drawn_there(shelf):
    world, item = World(WORKPLACE.scene), WORKPLACE.scene.objects[0]
    goal = WORKPLACE.shelf(shelf)
    world.hold(item.name, _joints(goal))
    at = world.object_pose(item.name)[:3, 3]
    (field,) = [box for box in place_targets(WORKPLACE) if box.name == f"place_{shelf}"]
    np.testing.assert_allclose(field.centre[:2], at[:2], atol=2e-3)
    # Just on the board, and under the thing.
    assert field.centre[2] - field.half_size[2] == WORKPLACE.scene.cabinet.shelves[shelf]
    assert field.centre[2] < at[2]


def _joints(goal):

    return panda.inverse(goal, near=WORKPLACE.home_joints()).numpy()


def test_the_way_is_told_in_the_words_of_the_keys():
    goal = WORKPLACE.shelf("middle").position.numpy()
    assert place_target_hint(WORKPLACE, goal) == "middle shelf: there"
    hand = goal - np.array([0.10, -0.20, 0.034])
    assert (
        place_target_hint(WORKPLACE, hand) == "middle shelf: 10 cm away, 20 cm right, 3 cm up"
    )
    hand = goal - np.array([-0.10, 0.20, -0.05])
    assert (
        place_target_hint(WORKPLACE, hand) == "middle shelf: 10 cm back, 20 cm left, 5 cm down"
    )
    assert place_target_hint(WORKPLACE, goal + np.array([0.0, 0.0, 0.2])).startswith(
        "upper shelf"
    )
