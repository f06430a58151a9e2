"""The side from which an object is approached, learned from tangents."""

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import gripper_down
from hrc_learn.kinematics.tool_orientation import (
    MAX_SPREAD,
    NEAR,
    Approach,
    coarse_orientation,
    tangent,
)

DOWN = gripper_down()


def path_along(direction, orientation=DOWN, bend=0.0, steps=200):
    """Comes from afar and ends along a direction, from rest to rest."""
    s = torch.linspace(0, 1, steps, dtype=torch.float64)[:, None]
    s = s**3 * (10 - 15 * s + 6 * s**2)
    left = 1 - s
    aside = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    far = (0.3 * left - 1.5 * NEAR).clamp(min=0.0)
    position = -0.3 * left * direction + bend * far * aside
    return Pose(position, orientation.expand(steps, 4))


def tilted(angle):
    """The vertical direction turned about the base's y axis by an angle."""
    return torch.tensor([-math.sin(angle), 0.0, -math.cos(angle)], dtype=torch.float64)


@pytest.mark.parametrize("bend", [0.0, 2.0])
def test_a_tangent_is_that_of_the_last_stretch(bend):
    direction = tilted(0.3)
    path = path_along(direction, bend=bend)
    torch.testing.assert_close(tangent(path.position), direction)


def test_a_hand_that_rests_has_no_tangent():
    assert tangent(torch.zeros(5, 3, dtype=torch.float64)).norm() == 0.0


def test_the_hand_points_where_it_went_and_turns_no_further():
    """The least turn is about an axis square to both directions."""
    angle = 0.2
    approach = Approach.fit([path_along(tilted(angle)), path_along(tilted(angle))])
    torch.testing.assert_close(approach.direction, tilted(angle))
    assert approach.turned_rad == pytest.approx(angle)
    assert approach.spread_rad == pytest.approx(0.0, abs=1e-9)
    turn = quaternion.multiply(approach.orientation, quaternion.conjugate(DOWN))
    vector = quaternion.log(quaternion.canonical(turn))
    assert vector.norm() == pytest.approx(angle)
    assert abs(float(vector[0])) + abs(float(vector[2])) < 1e-9


def test_it_is_the_mean_of_demonstrations_whatever_their_signs():
    paths = [path_along(tilted(0.1)), path_along(tilted(-0.1), orientation=-DOWN)]
    approach = Approach.fit(paths)
    torch.testing.assert_close(approach.direction, tilted(0.0), rtol=0, atol=1e-12)
    assert approach.spread_rad == pytest.approx(0.1)


@pytest.mark.parametrize("angles", [(MAX_SPREAD + 0.01,), (0.6, -0.6), (math.pi / 2,)])
def test_where_the_hand_came_from_the_side_it_keeps_its_orientation(angles):
    approach = Approach.fit([path_along(tilted(angle)) for angle in angles])
    assert float(quaternion.angle(approach.orientation, DOWN)) < 1e-7
    assert approach.turned_rad == 0.0


def test_poses_of_single_precision_give_the_same_approach():
    path = path_along(tilted(0.2))
    single = Pose(path.position.float(), path.orientation.float())
    found, expected = Approach.fit([single]), Approach.fit([path])
    torch.testing.assert_close(found.orientation, expected.orientation, rtol=0, atol=1e-6)


def test_a_path_that_already_points_the_right_way_turns_nothing():
    approach = Approach.fit([path_along(tilted(0.0))])
    assert torch.isfinite(approach.orientation).all()
    assert float(quaternion.angle(approach.orientation, DOWN)) < 1e-7


def test_it_is_written_and_read(tmp_path):
    approach = Approach.fit([path_along(tilted(0.2))])
    approach.save(tmp_path / "approach.json")
    again = Approach.load(tmp_path / "approach.json")
    assert again == approach
    assert [file.name for file in tmp_path.iterdir()] == ["approach.json"]


def test_what_is_no_approach_is_refused(tmp_path):
    (tmp_path / "approach.json").write_text("{}")
    with pytest.raises(ValueError, match=r"approach\.json"):
        Approach.load(tmp_path / "approach.json")
    with pytest.raises(ValueError, match="one demonstration or more"):
        Approach.fit([])


@pytest.mark.parametrize(("y", "angle"), [(0.0, 0.0), (0.3, 0.2), (-0.15, -0.1), (0.9, 0.4)])
def test_a_hand_to_the_side_points_to_that_side(y, angle):
    """By the angle in proportion, up to the reach: about the base's x axis, as of SciPy."""
    position = torch.tensor([[0.4, y, 0.2]], dtype=torch.float64)
    found = coarse_orientation(position, reach=0.6, tilt=0.4)
    axis = quaternion.rotate(found, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))[0]
    expected = Rotation.from_rotvec([angle, 0, 0]).apply([0.0, 0.0, -1.0])
    torch.testing.assert_close(axis, torch.from_numpy(expected))
    assert float(axis[1]) * y >= 0
    with pytest.raises(ValueError, match="orientation_wxyz is no unit quaternion"):
        Approach(orientation_wxyz=(1.0, 0.1, 0.0, 0.0), spread_rad=0.0, turned_rad=0.0)
