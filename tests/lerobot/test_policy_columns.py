import pytest

from hrc_learn.lerobot.policy.action_encoding import matched_columns, rotation_triples

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
    ],
)
def test_actions_are_measured_where_the_state_has_their_names(actions, states, columns):
    widths = len(actions or "ab"), len(states or "ab")
    assert matched_columns(actions, states, widths) == columns


def test_unnamed_states_of_another_width_are_something_else():
    assert matched_columns(None, None, (2, 3)) == [-1, -1]
