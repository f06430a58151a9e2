"""Commands, joints, grippers and cameras among arrays made in memory."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recording_samples import WAVES as Q
from recording_samples import understood

from hrc_learn.demos import DatasetError
from hrc_learn.demos.recording_files import Recording, array_field
from hrc_learn.demos.recording_names import find_cameras

pytestmark = pytest.mark.simulation


def test_actions_that_joints_follow_are_commands():
    late = np.roll(Q, 1, axis=0)
    late[0] = Q[0]
    found = understood(qpos=late, action=Q)
    assert found.selections["command_position"].columns == tuple(
        ("action", k) for k in range(3)
    )
    assert found.decisions["command_position"].evidence == "the joints follow it"
    assert found.joint_names == ("joint1", "joint2", "joint3")
    cases = ((1.9, True), (0.55, True), (0.45, False), (-1, False), (2.1, False))
    for factor, follows in cases:
        found = understood(qpos=late, action=Q / factor)
        assert ("command_position" in found.selections) == follows
        assert ("action" in found.kept) != follows
    assert found.notes == ["the joints do not follow action: it is kept as recorded"]


def test_an_action_of_other_columns_is_kept():
    found = understood(qpos=Q, action=Q[:, :2])
    assert found.kept["action"][0] == (("action", 0), ("action", 1))
    grip = np.hstack([Q, (Q[:, :1] > 0) * 1.0])
    assert "command_position" not in understood(qpos=Q, action=grip).selections
    both = understood(qpos=Q, action=grip, gripper=np.abs(Q[:, 0]))
    assert "command_position" in both.selections
    assert both.kept["action"] == ((("action", 3),), ("gripper.pos",))


def test_commands_without_names_take_the_order_of_the_joints():
    found = understood(qpos=Q, action=Q[:, [2, 0, 1]])
    assert [k for _, k in found.selections["command_position"].columns] == [1, 2, 0]
    # Where two joints move alike the order is not clear.
    alike = Q.copy()
    alike[:, 1] = Q[:, 0] + 0.01 * Q[:, 2]
    found = understood(qpos=alike, action=alike[:, [1, 0, 2]] + 0.02 * Q[:, [2, 2, 0]])
    assert [k for _, k in found.selections["command_position"].columns] == [0, 1, 2]


def test_joints_at_rest_are_compared_by_their_distance():
    rest = np.tile([0.1, 0.2, 0.3], (50, 1))
    assert "command_position" in understood(qpos=rest, action=rest + 0.09).selections
    assert "command_position" not in understood(qpos=rest, action=rest + 0.11).selections


def test_a_state_of_unknown_content_is_kept_and_left_out_next_to_joints():
    found = understood(state=Q)
    assert found.kept["observation.state"][1] == ("state_0", "state_1", "state_2")
    assert found.notes == ["state is kept as recorded: its name tells no quantity"]
    found = understood(state=Q, qpos=Q)
    text = "a state of unknown content; to keep it: observation.NAME"
    assert found.left_out == {"state": text}
    found = understood(array=Q)
    assert found.notes == ["nothing names the columns: taken for joints (--columns names them)"]
    assert found.joint_names == ("joint1", "joint2", "joint3")


def test_joints_take_the_names_that_are_given():
    assert understood({"joint_names": ("a", "b", "c")}, qpos=Q).joint_names == ("a", "b", "c")
    with pytest.raises(DatasetError, match="2 joint names for 3 columns of joints"):
        understood({"joint_names": ("a", "b")}, qpos=Q)
    found = understood(qpos=Q, names={"qpos": ("x.pos", "y.pos", "z.pos")})
    assert found.joint_names == ("x", "y", "z")
    found = understood(qpos=Q, qvel=Q[:, :2])
    assert "joint_velocity" not in found.selections
    assert "qvel" in found.left_out


def test_columns_that_the_caller_names_have_a_width():
    for count, role in ((3, "rotation_vector"), (6, "rotation_6d"), (16, "pose_matrix")):
        turn = np.tile(np.eye(4).ravel(), (200, 1)) if count == 16 else np.ones((200, count))
        turn[:, 1] = 0 if count == 6 else turn[:, 1]
        columns = {"joint_position": "q", "quaternion_wxyz": "r"}
        given = understood({"columns": columns}, q=Q, r=turn)
        assert role in given.selections
    with pytest.raises(DatasetError, match="position takes 3 columns, not 2"):
        understood({"columns": {"position": "p[0:2]"}}, p=Q)
    two = understood(
        {"columns": {"gripper": "g", "joint_position": "q"}}, q=Q, g=Q[:, :2] * 0.03
    )
    assert len(two.selections["gripper"].columns) == 2
    with pytest.raises(DatasetError, match="gripper takes 1 columns, not 3"):
        understood({"columns": {"gripper": "g", "joint_position": "q"}}, q=Q, g=Q)


def gripper_like(count=1, rest=0.6, size=1.0):
    """Joints, and last columns that rest for a fraction of the frames."""
    steps = np.zeros(200)
    steps[: int(200 * (1 - rest))] = np.linspace(0, size, int(200 * (1 - rest)))
    steps[int(200 * (1 - rest)) :] = size
    return np.hstack([Q, Q, Q[:, :1], *[steps[:, None]] * count])


@pytest.mark.parametrize(
    ("array", "count"),
    [
        (gripper_like(), 1),
        (gripper_like(2), 2),
        (gripper_like(2)[:, 2:], 0),
        (gripper_like(rest=0.45), 0),
        (gripper_like(size=1.04), 1),
        (gripper_like(size=1.06), 0),
        (gripper_like(size=-0.02), 0),
        (Q, 0),
    ],
)
def test_last_columns_that_behave_as_a_gripper_are_asked_about(array, count):
    found = understood(qpos=array)
    asked = [text for text in found.warnings if "behave as a gripper" in text]
    assert len(asked) == bool(count)
    width = array.shape[1]
    for text in asked:
        assert f"the last {count} of {width} columns of qpos" in text
        assert (
            f"--joints qpos[0:{width - count}] --gripper qpos[{width - count}:{width}]" in text
        )
    assert not understood(
        qpos=array, names={"qpos": tuple(f"j{k}" for k in range(width))}
    ).warnings


def test_cameras_are_named_by_the_end_of_their_path():
    names = ("obs/front_image", "next_obs/front_image", "wrist/rgb", "cam/color/image_raw")
    images = {n: array_field(n, np.zeros((2, 16, 16, 3), np.uint8)) for n in names}
    one = Recording(file=Path("x"), fields=images | {"q": array_field("q", Q)})
    assert find_cameras(one, None) == {
        "front": "obs/front_image", "rgb": "wrist/rgb", "image_raw": "cam/color/image_raw",
    }  # fmt: skip
    topics = find_cameras(replace(one, streams=True), None)
    assert topics["wrist"] == "wrist/rgb"
    assert topics["cam"] == "cam/color/image_raw"
    with pytest.raises(DatasetError, match="q holds no images"):
        find_cameras(one, {"top": "q"})
    same = dict.fromkeys(("a/top", "b/top"), images["wrist/rgb"])
    assert find_cameras(replace(one, fields=same), None) == {"top": "a/top", "b_top": "b/top"}


def test_half_of_the_joints_are_too_few_to_follow_a_command():
    other = np.cos(np.arange(200) / 7)[:, None] + 3
    two = np.hstack([Q[:, :1], other])
    assert "command_position" not in understood(qpos=Q[:, :2], action=two).selections
    three = np.hstack([Q[:, :2], other])
    assert "command_position" in understood(qpos=Q, action=three).selections
