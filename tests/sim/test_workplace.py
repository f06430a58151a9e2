import pytest
import torch

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import UnreachableError, panda
from hrc_learn.sim.workplace import Workplace

WORKPLACE = Workplace()


def test_shelves_go_from_bottom_to_top():
    assert WORKPLACE.shelf_names() == ("lower", "middle", "upper")
    heights = [float(WORKPLACE.shelf(name).position[2]) for name in WORKPLACE.shelf_names()]
    assert heights == sorted(heights)


@pytest.mark.parametrize("shelf", WORKPLACE.shelf_names())
def test_every_shelf_can_be_reached_with_room_to_the_limits(shelf):
    goal = WORKPLACE.shelf(shelf)
    q = panda.inverse(goal, near=WORKPLACE.home_joints())
    reached = panda.forward(q)
    torch.testing.assert_close(reached.position, goal.position, atol=1e-6, rtol=0)
    assert float(quaternion.angle(reached.orientation, goal.orientation)) < 1e-6
    assert bool(((q > panda.limits.lower) & (q < panda.limits.upper)).all())


def test_the_nearest_of_all_configurations_is_taken():
    q = WORKPLACE.home_joints()
    found = panda.inverse(WORKPLACE.home(), near=q, samples=200)
    assert float((found - q).norm()) < 1e-9


def test_the_hand_points_into_the_cabinet_and_at_the_table():
    approach = quaternion.to_matrix(WORKPLACE.shelf("middle").orientation)[:, 2]
    torch.testing.assert_close(approach, torch.tensor([0.0, -1.0, 0.0]).double())
    approach = quaternion.to_matrix(WORKPLACE.hover().orientation)[:, 2]
    torch.testing.assert_close(approach, torch.tensor([0.0, 0.0, -1.0]).double())


def test_an_unknown_shelf_is_named_together_with_those_that_exist():
    with pytest.raises(ValueError, match=r"'attic'.*lower, middle, upper"):
        WORKPLACE.shelf("attic")


@pytest.mark.parametrize("place", [{"shelf_x": 1.2}, {"shelf_depth": 0.5}, {"shelf_x": 0.0}])
def test_a_place_beside_the_board_is_refused(place):
    with pytest.raises(ValueError, match="not on the boards"):
        Workplace(**place).shelf("middle")


def test_an_unreachable_pose_is_told_with_its_numbers():
    far = Pose(torch.tensor([0.4, -1.6, 0.4]).double(), WORKPLACE.shelf("middle").orientation)
    with pytest.raises(UnreachableError, match=r"-1\.600"):
        panda.inverse(far, near=WORKPLACE.home_joints())


def test_an_object_is_let_down_no_further_than_the_hand_is_clear_of_the_board():
    workplace, hand = Workplace(), 0.030  # half as thick as the model's hand
    for half in (0.034, 0.036, 0.040):
        size = (0.022, half, 0.030)
        release = (
            workplace.shelf("middle", size).position[2]
            - workplace.scene.cabinet.shelves["middle"]
        )
        left = float(release) - workplace.lowering(size) - hand
        assert 0.005 < left < 0.0061
    assert workplace.lowering((0.022, 0.020, 0.030)) == 0.0
