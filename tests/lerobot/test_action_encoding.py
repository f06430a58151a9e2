import pytest
import torch

from hrc_learn.geometry import quaternion
from hrc_learn.lerobot.policy.action_encoding import (
    ActionEncoding,
    matched_columns,
    rotation_triples,
)


def poses(tilt: float) -> torch.Tensor:
    """Positions, and orientations about a hand that points down, (30, 6), float64."""
    rng = torch.Generator().manual_seed(0)
    noise = torch.randn(30, 6, generator=rng, dtype=torch.float64).cumsum(0) / 5
    noise = noise - noise.mean(0)
    down = quaternion.exp(torch.tensor([torch.pi, 0, 0], dtype=torch.float64))
    q = quaternion.multiply(quaternion.exp(tilt * noise[:, 3:]), down)
    return torch.cat([noise[:, :3], quaternion.log(q)], dim=-1)


def test_there_and_back_is_the_same_pose():
    shown = poses(0.3)
    encoding = ActionEncoding(6, [[3, 4, 5]]).double()
    encoding.learn([shown])
    back = encoding.to_actions(encoding.to_coordinates(shown))
    torch.testing.assert_close(back[:, :3], shown[:, :3], rtol=0, atol=1e-9)
    p, q = (quaternion.exp(x[:, 3:]) for x in (back, shown))
    assert quaternion.angle(p, q).max() < 1e-7


def test_coordinates_are_white_and_turn_smoothly_where_vectors_jump():
    shown = poses(0.3)
    # The shortest vectors jump from one side to the other.
    assert shown[:, 3:].diff(dim=0).norm(dim=-1).max() > 5
    encoding = ActionEncoding(6, [[3, 4, 5]]).double()
    encoding.learn([shown[:10], shown[10:]])
    coordinates = encoding.to_coordinates(shown)
    torch.testing.assert_close(coordinates.std(0), torch.ones(6).double())
    assert coordinates.mean(0).abs().max() < 1e-9
    assert coordinates.diff(dim=0).abs().max() < 2
    assert encoding.to_actions(coordinates)[:, 3:].diff(dim=0).norm(dim=-1).max() < 0.5


def test_what_never_moves_is_not_blown_up():
    encoding = ActionEncoding(2, []).double()
    shown = torch.tensor([[1.0, 5.0], [2.0, 5.0]], dtype=torch.float64)
    encoding.learn([shown])
    assert encoding.to_coordinates(shown + 1e-3)[:, 1].abs().max() <= 1 + 1e-9


def test_more_than_half_a_turn_is_refused():
    angle = torch.linspace(-4, 4, 50, dtype=torch.float64)[:, None]
    turning = angle * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    with pytest.raises(
        ValueError, match="demonstration 0 turns the end effector by more than half"
    ):
        ActionEncoding(3, [[0, 1, 2]]).double().learn([turning])


HAND = ["ee.x", "ee.y", "ee.z", "ee.wx", "ee.wy", "ee.wz", "ee.gripper_pos"]


@pytest.mark.parametrize(
    ("names", "triples"),
    [
        (HAND, [[3, 4, 5]]),
        ([f"{name}.pos" for name in HAND], [[3, 4, 5]]),
        (["left.wz", "left.wy", "left.wx", "wx", "wy", "wz"], [[2, 1, 0], [3, 4, 5]]),
        (["ee.wx", "ee.wy", "ee.wz.pos"], []),
        (None, []),
    ],
)
def test_rotation_vectors_are_told_by_their_names(names, triples):
    assert rotation_triples(names) == triples


@pytest.mark.parametrize(
    ("actions", "states", "columns"),
    [
        (["a.pos", "b.pos"], ["b.pos", "b.vel", "a.pos"], [2, 0]),
        (["a.pos", "grip"], ["a.pos", "b.pos"], [0, -1]),
        (["a.pos", "b.pos"], None, [-1, -1]),
        # Without any names, only what is as wide as the action can be what it commands.
        (None, None, [0, 1]),
        # A rotation vector that is measured in part is none.
        (["wx", "wy", "wz", "x"], ["x", "wx", "wy"], [-1, -1, -1, 0]),
        (["wx", "wy", "wz"], ["wy", "wx", "wz"], [1, 0, 2]),
    ],
)
def test_actions_are_measured_where_the_state_has_their_names(actions, states, columns):
    widths = len(actions or "ab"), len(states or "ab")
    assert matched_columns(actions, states, widths) == columns


def test_unnamed_states_of_another_width_are_something_else():
    assert matched_columns(None, None, (2, 3)) == [-1, -1]


def test_before_it_has_learned_the_reference_is_the_base_frame():
    encoding = ActionEncoding(4, [[1, 2, 3]]).double()
    vector = torch.tensor([[0.5, 0.3, -0.2, 0.1]], dtype=torch.float64)
    coordinates = encoding.to_coordinates(vector)
    torch.testing.assert_close(coordinates.abs(), vector.abs())
    torch.testing.assert_close(encoding.to_actions(coordinates), vector)
