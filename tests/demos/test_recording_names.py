"""Fields of recordings as features of a dataset, by their names and shapes alone."""

from pathlib import Path

import numpy as np
import pytest

from hrc_learn.demos.read.columns import ColumnSelection
from hrc_learn.demos.recording_files import Recording, array_field
from hrc_learn.demos.recording_names import FieldSearch, ImportOptions, column_names

pytestmark = pytest.mark.simulation

SIDES = ("left", "right")
ARM = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")


def recording(names=None, **shapes):
    """Fields of five frames; `__` stands for a slash."""
    fields = {}
    for name, shape in shapes.items():
        name = name.replace("__", "/")
        values = np.zeros((5, *np.atleast_1d(shape)) if shape else 5)
        fields[name] = array_field(name, values, names=(names or {}).get(name))
    return Recording(file=Path("run.npz"), fields=fields)


def searched(hinted=False, names=None, **shapes):
    first = recording(names, **shapes)
    search = FieldSearch(first, hinted)
    search.add_fields(first.fields)
    return search


def taken(search):
    """Fields and columns of each feature, a whole field by its name alone."""
    found = {}
    for key, feature in search.features.items():
        columns = tuple((key, i) for i in range(feature.width))
        labels = tuple(map(str, range(feature.width)))
        places = search.located(ColumnSelection(role="x", columns=columns, labels=labels))
        fields = [*dict.fromkeys(name for name, _ in places.columns)]
        whole = [(name, i) for name in fields for i in range(feature.width // len(fields))]
        found[key] = fields if [*places.columns] == whole else [*places.columns]
    return found


@pytest.mark.parametrize(
    ("shapes", "features"),
    [
        ({"q": 3, "dq": 3, "tau": 3},
         {"observation.qpos": ["q"], "observation.qvel": ["dq"],
          "observation.effort": ["tau"]}),
        ({"cmd_q": 3}, {"action.qpos": ["cmd_q"]}),
        ({"a__qpos": 3, "b__qpos": 3},
         {"observation.a.qpos": ["a/qpos"], "observation.b.qpos": ["b/qpos"]}),
        ({"robot0_joint_pos": 7, "arm1_qpos": 3},
         {"observation.joint_pos": ["robot0_joint_pos"], "observation.qpos": ["arm1_qpos"]}),
        ({"ee": 16, "tool_pose": 16, "T": (4, 4)},
         {"observation.tcp_pose": ["ee"], "observation.other.tcp_pose": ["tool_pose"],
          "observation.other.other.tcp_pose": ["T"]}),
        ({"R": (3, 3), "rot": (3, 3), "image_mat": (3, 3)},
         {"observation.eef_rotation_matrix": ["R"],
          "observation.other.eef_rotation_matrix": ["rot"],
          "observation.other.other.eef_rotation_matrix": ["image_mat"]}),
        # Positions of three joints next to their efforts, and of more than space has.
        ({"position": 3, "effort": 3},
         {"observation.qpos": ["position"], "observation.effort": ["effort"]}),
        ({"eef_pos": 6}, {"observation.qpos": ["eef_pos"]}),
        ({"eef_pos": 3}, {"observation.eef_pos": ["eef_pos"]}),
        ({"obs__robot0_eef_quat": 4}, {"observation.obs.eef_quat": ["obs/robot0_eef_quat"]}),
        # Tables of single columns.
        ({"q_0": (), "q_1": (), "dq_0": ()},
         {"observation.qpos": ["q_0", "q_1"], "observation.qvel": ["dq_0"]}),
        ({"target_q_0": (), "target_q_1": ()}, {"action.qpos": ["target_q_0", "target_q_1"]}),
        ({"pos_0": (), "position_1": ()}, {"observation.qpos": ["pos_0", "position_1"]}),
        ({"joint_1": (), "gripper": ()}, {"observation.state": ["joint_1", "gripper"]}),
        ({"actuator_1": (), "Actuator2": ()},
         {"observation.state": ["actuator_1", "Actuator2"]}),
        # Topics of ROS as `rostopic echo -p` prints them.
        ({"field.pose.position.x": (), "field.pose.orientation.w": ()},
         {"observation.state": ["field.pose.position.x", "field.pose.orientation.w"]}),
    ],
)  # fmt: skip
def test_names_become_features(shapes, features):
    search = searched(**shapes)
    assert taken(search) == features
    assert all(one.dtype == "float32" for one in search.features.values())
    assert (search.states, search.actions, search.fingers) == ([], [], [])


def test_poses_of_ur_are_rotation_vectors():
    columns = [f"actual_TCP_pose_{i}" for i in range(6)]
    search = searched(**dict.fromkeys(columns, ()))
    assert taken(search) == {"observation.ee": columns}
    names = tuple(f"ee.{axis}" for axis in ("x", "y", "z", "wx", "wy", "wz"))
    assert search.features["observation.ee"].names == names


@pytest.mark.parametrize(
    ("shapes", "left_out"),
    [
        ({"ee_quat": 4, "tcp_quat": 4, "tool_orientation": 4},
         ["ee_quat", "tcp_quat", "tool_orientation"]),
        ({"reward": 1, "next_obs__q": 3, "obs__next_q": 3},
         ["reward", "next_obs/q", "obs/next_q"]),
        ({"camera_pose": 16, "T_camera": (4, 4)}, ["camera_pose", "T_camera"]),
        ({"eef_quat": 4}, ["eef_quat"]),
        ({"cartesian_position": 6}, ["cartesian_position[3:6]"]),
        ({"foo": (), "bar_7": ()}, ["foo", "bar_7"]),
    ],
)  # fmt: skip
def test_names_that_do_not_say_enough_are_left_out(shapes, left_out):
    search = searched(**shapes)
    assert [*search.left_out] == left_out
    if "cartesian_position" in shapes:
        assert taken(search) == {"observation.eef_pos": ["cartesian_position"]}
        assert search.features["observation.eef_pos"].width == 3
    else:
        assert taken(search) == {}


def test_columns_of_unknown_names_are_joints_where_the_caller_names_columns():
    search = searched(True, foo=(), bar=())
    assert taken(search) == {"observation.state": ["foo", "bar"]}
    assert search.features["observation.state"].names == ("foo", "bar")
    assert search.left_out == {}


@pytest.mark.parametrize(
    ("shapes", "states", "actions"),
    [
        ({"state": 4, "action": 3}, ["state"], ["action"]),
        ({"obs__state": 4, "position": 2}, ["obs/state", "position"], []),
        ({"gripper__command": 2}, [], ["gripper/command"]),
        ({"qpos": 7, "action": 14}, [], ["action"]),
    ],
)
def test_vectors_whose_names_tell_no_content(shapes, states, actions):
    search = searched(**shapes)
    assert (search.states, search.actions) == (states, actions)


def test_the_arms_of_aloha_have_their_names_where_state_and_action_are_as_wide():
    search = searched(qpos=14, qvel=14, action=14)
    names = tuple(f"{side}_{joint}" for side in SIDES for joint in ARM)
    columns = [i for i in range(14) if i not in (6, 13)]
    for key, field in (("observation.qpos", "qpos"), ("action", "action")):
        assert search.features[key].names == names
        assert taken(search)[key] == [(field, i) for i in columns]
    assert search.fingers == [
        (command, f"{side}_gripper", (field, place))
        for command, field in ((False, "qpos"), (True, "action"))
        for side, place in zip(SIDES, (6, 13), strict=True)
    ]


@pytest.mark.parametrize(
    ("shapes", "two", "fingers"),
    [
        ({"obs__robot0_gripper_qpos": 2}, "obs/robot0_gripper_qpos", []),
        ({"gripper_cmd": ()}, "", [(True, "gripper", ("gripper_cmd", 0))]),
        ({"a__gripper_cmd": 1}, "", [(True, "gripper", ("a/gripper_cmd", 0))]),
        ({"a__gripper": 3}, "", []),
    ],
)
def test_fingers_are_kept_apart(shapes, two, fingers):
    search = searched(**shapes)
    assert (search.two_fingers, search.fingers) == (two, fingers)


def test_names_of_columns_tell_joints_from_hands():
    names = {"state": ("j1", "gripper", "j2"), "action": ("j1", "j2")}
    search = searched(names=names, state=3, action=2)
    assert taken(search) == {
        "observation.state": [("state", 0), ("state", 2)], "action": ["action"],
    }  # fmt: skip
    assert search.features["observation.state"].names == ("j1", "j2")
    assert search.fingers == [(False, "gripper", ("state", 1))]
    assert search.explained("observation.state: odd") == "state: odd"
    assert search.explained("elsewhere: odd") == "elsewhere: odd"


def test_columns_are_named_by_their_field_or_their_own_names():
    first = recording({"b": ("x", "y")}, a__q=3, b=2, c=())
    places = [("a/q", 2), ("b", 1), ("c", 0)]
    assert column_names(first, places) == ("q_2", "y", "c")


@pytest.mark.parametrize("name", ["joint_position", "action", "observation.cup"])
def test_the_caller_names_known_quantities(name):
    assert ImportOptions(columns={name: "q"}).columns == {name: "q"}
    with pytest.raises(ValueError, match="unknown quantity 'cup'"):
        ImportOptions(columns={name: "q", "cup": "c"})
