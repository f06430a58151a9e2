"""Commands, joints, grippers and cameras among arrays made in memory."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recording_samples import WAVES as Q
from recording_samples import understood

from hrc_learn.demos import DatasetError
from hrc_learn.demos.recording_files import Recording, array_field
from hrc_learn.demos.recording_meaning import understand
from hrc_learn.demos.recording_names import ImportOptions, find_cameras

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
    assert found.notes == ["state is kept as recorded: its name states no content"]
    found = understood(state=Q, qpos=Q)
    text = "a state of unknown content; to keep it: observation.NAME"
    assert found.left_out == {"state": text}
    found = understood(array=Q)
    assert found.notes == ["the columns have no names: taken for joints (--columns names them)"]
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
    with pytest.raises(DatasetError, match="position needs 3 columns, not 2"):
        understood({"columns": {"position": "p[0:2]"}}, p=Q)
    two = understood(
        {"columns": {"gripper": "g", "joint_position": "q"}}, q=Q, g=Q[:, :2] * 0.03
    )
    assert len(two.selections["gripper"].columns) == 2
    with pytest.raises(DatasetError, match="gripper needs 1 columns, not 3"):
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
        (gripper_like(2)[:, 1:], 2),
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


def pose(translation):
    turns = np.tile(np.eye(4), (200, 1, 1))
    turns[:, :3, 3] = translation
    return turns


@pytest.mark.parametrize("flat", [False, True])
def test_transforms_beyond_the_reach_of_an_arm_may_be_in_millimetres(flat):
    def ask(size, options=None, units=None):
        values = pose(size * Q / np.abs(Q).max())
        values = values.reshape(200, 16) if flat else values
        return understood(options, units=units, ee_pose=values)

    assert ask(4.9).decisions["pose_matrix"].unit == "m"
    with pytest.raises(DatasetError, match=r"in m or mm\? It reaches 5\.1: give --units") as c:
        ask(5.1)
    assert c.value.key == "ee_pose"
    assert ask(5.1, {"units": {"pose_matrix": "mm"}}).decisions["pose_matrix"].unit == "mm"
    assert ask(5.1, units={"ee_pose": "m"}).decisions["pose_matrix"].unit == "m"
    # Rotations and the last row are no lengths.
    turned = pose(np.zeros((200, 3)))
    turned[:, :3, :3] *= 1.0
    assert understood(ee_pose=turned).decisions["pose_matrix"].unit == "m"


def test_radians_beyond_two_turns_are_doubted():
    for size, doubted in ((3.9, False), (4.1, True)):
        q = size * np.pi * Q / np.abs(Q).max()
        found = understood({"units": {"joint_position": "rad"}}, qpos=q)
        asked = [text for text in found.warnings if "rad are given, but values reach" in text]
        assert len(asked) == doubted
    assert "12.88: degrees?" in asked[0]


def episodes(*arrays, **options):
    """What is understood of several recordings."""
    made = [
        Recording(
            file=Path(f"run_{number}.npz"),
            fields={name: array_field(name, np.asarray(a)) for name, a in one.items()},
        )
        for number, one in enumerate(arrays)
    ]
    return understand(made, ImportOptions(**options))


@pytest.mark.parametrize(("against", "follows"), [(1, True), (2, True), (3, False), (5, False)])
def test_most_episodes_decide_whether_joints_follow(against, follows):
    one, other = {"qpos": Q, "action": Q}, {"qpos": Q, "action": -Q - 3}
    found = episodes(*[one] * (5 - against), *[other] * against)
    assert ("command_position" in found.selections) == follows


def test_of_many_episodes_five_or_more_are_asked_evenly():
    one, other = {"qpos": Q, "action": Q}, {"qpos": Q, "action": -Q - 3}
    for step, count in ((2, 10), (2, 11), (3, 15)):
        group = [one, *[other] * (step - 1)]
        found = episodes(*(group * count)[:count])
        assert "command_position" in found.selections


def test_recordings_of_other_joints_or_arrays_do_not_fit_together():
    with pytest.raises(ValueError, match=r"run_1.npz and run_0.npz do not fit into one") as c:
        episodes({"qpos": Q}, {"qpos": Q[:, :2]})
    assert str(c.value).endswith("joints joint1, joint2 and joint1, joint2, joint3")
    one = {"qpos": Q, "note": np.array(["x"] * 200)}
    for name, more in (("action", Q), ("gripper", 0.01 * Q[:, 0])):
        other = {"qpos": Q, name: more}
        for pair, text in (
            ((one, other), f"arrays {name}, joint_position and joint_position$"),
            ((other, one), f"arrays joint_position and {name}, joint_position$"),
        ):
            with pytest.raises(ValueError, match=text):
                episodes(*pair)
        # In any order of the arrays.
        episodes({name: more, **one}, other)
    # Other text or stamps make no other dataset.
    found = episodes({"qpos": Q}, {"qpos": Q, "note": np.array(["x"] * 200), "time": Q[:, 0]})
    assert [*found.selections] == ["joint_position"]


def test_fields_that_are_not_taken_are_listed_with_the_reason():
    found = understood(
        qpos=Q,
        stamp=np.arange(200.0),
        time=np.arange(200.0),
        depth=np.zeros((200, 16, 16), np.uint16),
        note=np.array(["x"] * 200),
        waves=np.zeros((200, 2, 5)),
        reward=np.zeros(200),
        next_obs__qpos=Q,
        camera_pose=pose(Q),
        other=Q,
    )
    assert found.time == "time"
    assert found.left_out == {
        "stamp": "stamps",
        "depth": "depth images are not written",
        "note": "text",
        "waves": "no frames",
        "reward": "a counter, a reward, or the next frame",
        "next_obs/qpos": "a counter, a reward, or the next frame",
        "camera_pose": "transforms of a frame other than the hand",
        "other": "not understood; to keep it: observation.NAME",
    }
    assert found.main == "qpos"
    assert found.fields == ["qpos"]


def test_stamps_are_those_that_the_caller_names_or_none_with_a_duration():
    arrays = {"qpos": Q, "time": np.arange(200.0), "clock": np.arange(200.0) / 7}
    assert understood({"time": "clock"}, **arrays).time == "clock"
    assert understood({"duration": 3.0}, **arrays).time == ""
    assert understood({"fps": 3.0}, **arrays).time == "time"


def test_grippers_among_the_joints_and_of_two_fingers():
    names = {"qpos": ("a.pos", "b.pos", "gripper.pos")}
    found = understood(qpos=Q, names=names)
    assert found.joint_names == ("a", "b")
    assert found.selections["gripper"].columns == (("qpos", 2),)
    assert found.selections["gripper"].labels == ("gripper",)
    both = {"qpos": ("left_gripper.pos", "a.pos", "right_gripper.pos")}
    found = understood(qpos=Q, names=both)
    assert "gripper" not in found.selections
    expected = (("qpos", 0), ("qpos", 2)), ("left_gripper.pos", "right_gripper.pos")
    assert found.kept["observation.state"] == expected
    # The field of two fingers comes before a finger among the joints.
    found = understood(qpos=Q, gripper_qpos=0.01 * Q[:, :2], names=names)
    assert found.selections["gripper"].columns == (("gripper_qpos", 0), ("gripper_qpos", 1))
    assert found.selections["gripper"].labels == ("left", "right")
    command = understood(qpos=Q, action__gripper=0.01 * Q[:, 0], names=names)
    assert command.kept["action"] == ((("action/gripper", 0),), ("gripper.pos",))


def streams(delay, rate):
    """Joints at 100 Hz and commands at another rate, each with its own stamps."""
    time, ticks = 3 + np.arange(1000) / 100, 2.5 + np.arange(round(11 * rate)) / rate
    wave = lambda t: np.sin(t[:, None] * [1.0, 1.7, 2.3])  # noqa: E731
    fields = {
        "joints/q": array_field("joints/q", wave(time - delay), clock="joints/t"),
        "joints/t": array_field("joints/t", time),
        "command/q": array_field("command/q", wave(ticks), clock="command/t"),
        "command/t": array_field("command/t", ticks),
    }
    return Recording(file=Path("a.mcap"), fields=fields, streams=True)


@pytest.mark.parametrize("rate", [15.0, 100.0, 250.0])
def test_topics_are_compared_at_the_same_times(rate):
    options = ImportOptions(columns={"joint_position": "joints/q"})
    for delay, follows in ((0.1, True), (0.6, True), (1.2, False)):
        one = streams(delay, rate)
        found = understand([one], options)
        assert ("command_position" in found.selections) == follows, (rate, delay)


def test_columns_of_one_quantity_have_as_many_frames():
    columns = {"joint_position": ["a", "b"]}
    with pytest.raises(DatasetError, match=r"numbers of frames: \{'a': 200, 'b': 199\}"):
        understood({"columns": columns}, a=Q[:, 0], b=Q[1:, 0])
    found = understood({"columns": {"joint_position": ["b", "a"]}}, a=Q[:, 0], b=Q[:, 1])
    assert found.selections["joint_position"].columns == (("b", 0), ("a", 0))
    assert found.joint_names == ("b", "a")


def test_angles_of_a_tool_are_asked_about_by_the_name_of_the_first_column():
    table = {name: Q[:, k % 3] for k, name in enumerate(("x", "y", "z", "rx", "ry", "rz"))}
    found = understood(**table)
    assert {*found.selections} == {"position", "rotation_vector"}
    assert "if they are angles about x, y, z, name them euler_xyz" in " ".join(found.notes)
    given = {"columns": {"rotation_vector": ["rx", "ry", "rz"]}}
    assert not any("angles" in note for note in understood(given, **table).notes)
