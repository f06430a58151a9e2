"""Meaning of a dataset's columns by the names and widths of its features."""

import numpy as np
import pytest

from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.read.columns import ColumnSelection, map_columns
from hrc_learn.demos.read.metadata import Feature, read_features
from hrc_learn.demos.read.naming import without_unit

STATE = "observation.state"


def feature(key, names, dtype="float32"):
    width = names if isinstance(names, int) else len(names)
    given = None if isinstance(names, int) else tuple(names)
    return Feature(key=key, dtype=dtype, shape=(width,), names=given)


def mapped(features, **options):
    """Meaning of features by their components, which are given as names or their number."""
    given = {
        key: feature(key, names.split() if isinstance(names, str) else names)
        for key, names in features.items()
    }
    return map_columns(given, **options)


def places(found, *keys):
    """Components of each role: indices, where there is one feature, or pairs."""
    return {
        role: [index if len(keys) == 1 else (key, index) for key, index in s.columns]
        for role, s in found.selections.items()
    }


def tool(kind, count):
    return " ".join(f"ee_{kind}_{k}" for k in range(count))


@pytest.mark.parametrize(
    ("names", "expected", "kept", "note"),
    [
        ("a b c", {"joint_position": [0, 1, 2]}, False, ""),
        (3, {"joint_position": [0, 1, 2]}, False, "names no components: taken for 3 joints"),
        # Where one name tells its quantity, bare ones are no joints.
        ("a.pos b", {"joint_position": [0]}, True, "b left out"),
        ("a.vel b.vel", {"joint_velocity": [0, 1]}, False, ""),
        (
            "waist object_x",
            {"joint_position": [0]},
            True,
            "(object_x): no joint of the arm, its",
        ),
        ("ee.z ee.x ee.y", {"position": [1, 2, 0]}, False, ""),
        ("ee.x ee.y", {}, True, "2 components look like position, which needs 3; left among"),
        ("ee.qx ee.qy ee.qz ee.qw", {"quaternion_wxyz": [3, 0, 1, 2]}, False, ""),
        (
            "ee.qz ee.qy ee.qx",
            {},
            True,
            "3 components look like quaternion_wxyz, which needs 4",
        ),
        ("ee.wy ee.wx ee.wz", {"rotation_vector": [1, 0, 2]}, False, ""),
        ("yaw pitch roll", {"euler_xyz": [2, 1, 0]}, False, ""),
        (tool("quat", 4), {"quaternion_xyzw": [0, 1, 2, 3]}, False, "in the order x, y, z, w"),
        (
            tool("rot", 3),
            {"rotation_vector": [0, 1, 2]},
            False,
            "assumed to be a rotation vector",
        ),
        (
            tool("rot", 4),
            {"quaternion_xyzw": [0, 1, 2, 3]},
            False,
            "assumed to be a quaternion",
        ),
        (
            tool("rot", 6),
            {"rotation_6d": [*range(6)]},
            False,
            "columns of a rotation matrix; if it holds two rows",
        ),
        (tool("rot", 9), {"rotation_matrix": [*range(9)]}, False, ""),
        (
            "ee_rot_w ee_rot_x ee_rot_y ee_rot_z",
            {"quaternion_wxyz": [0, 1, 2, 3]},
            False,
            "",
        ),
        (
            tool("pose", 6),
            {"position": [0, 1, 2], "euler_xyz": [3, 4, 5]},
            False,
            "assumed to be x, y, z, roll, pitch, yaw",
        ),
        (
            tool("pose", 7),
            {"position": [0, 1, 2], "quaternion_xyzw": [3, 4, 5, 6]},
            False,
            "assumed to be x, y, z, qx, qy, qz, qw",
        ),
        (
            tool("pose", 9),
            {"position": [0, 1, 2], "rotation_6d": [*range(3, 9)]},
            False,
            "assumed to be x, y, z and two columns of a matrix",
        ),
        (tool("pose", 8), {}, True, "8 components look like pose_matrix, which needs 16"),
        (tool("pose", 16), {"pose_matrix": [*range(16)]}, False, ""),
        (
            "left_ee.x left_ee.y left_ee.z right_ee.x right_ee.y right_ee.z",
            {"position": [0, 1, 2]},
            True,
            "one pose is read, that of the left arm; the right one stays",
        ),
        (
            "right_ee.x left_ee.x right_ee.y right_ee.z",
            {"position": [0, 2, 3]},
            True,
            "that of the right arm; the left one",
        ),
        # Of two fingers of one name, the first counts.
        (
            "finger.pos finger.pos a.pos",
            {"joint_position": [0, 2]},
            True,
            "the second finger is left out",
        ),
        (
            "r33 r11 r12 r13 r21 r22 r23 r31 r32",
            {"rotation_matrix": [1, 2, 3, 4, 5, 6, 7, 8, 0]},
            False,
            "",
        ),
        (
            " ".join(f"rot_{row}{column}" for row in range(3) for column in range(3)),
            {"rotation_matrix": [*range(9)]},
            False,
            "",
        ),
        (
            " ".join(f"O_T_EE_{k}" for k in range(16)),
            {"pose_matrix": [*range(16)]},
            False,
            "",
        ),
        (
            "l_gripper.pos r_gripper.pos a.pos",
            {"joint_position": [2]},
            True,
            "2 components look like gripper, which needs 1",
        ),
        ("gripper.pos a.pos", {"gripper": [0], "joint_position": [1]}, False, ""),
    ],
)
def test_components_of_a_state(names, expected, kept, note):
    found = mapped({STATE: names})
    assert places(found, STATE) == expected
    assert found.extra == ((STATE,) if kept else ())
    assert note in " ".join(found.notes)
    assert bool(found.notes) == bool(note)


@pytest.mark.parametrize(
    ("key", "names", "expected", "note"),
    [
        ("observation.joint_positions", 3, {"joint_position": [0, 1, 2]}, ""),
        ("obs/qvel", 3, {"joint_velocity": [0, 1, 2]}, ""),
        ("observation.ee_pos", 3, {"position": [0, 1, 2]}, ""),
        ("observation.ee_pos", 4, {}, ""),
        ("observation.ee_quat", 4, {"quaternion_xyzw": [0, 1, 2, 3]}, ""),
        ("observation.ee_quat", 3, {}, ""),
        ("observation.ee_quat", "qw qx qy qz", {"quaternion_wxyz": [0, 1, 2, 3]}, ""),
        ("observation.cartesian_position", 3, {"position": [0, 1, 2]}, ""),
        ("observation.cartesian_position", 4, {}, ""),
        ("observation.cartesian_position", 16, {"pose_matrix": [*range(16)]}, ""),
        (
            "observation.ee_pose",
            7,
            {"position": [0, 1, 2], "quaternion_xyzw": [3, 4, 5, 6]},
            "",
        ),
        ("observation.gripper", 1, {"gripper": [0]}, ""),
        ("observation.gripper", 2, {"gripper": [0]}, "its first finger is taken"),
        ("observation.gripper", 3, {}, ""),
        ("observation.image_feature", 1, {}, ""),
        ("observation.image_feature", 2, {"feature": [0, 1]}, ""),
        ("observation.image_feature", 3, {"feature": [0, 1], "feature_visible": [2]}, ""),
        ("observation.image_feature", 4, {"feature": [0, 1]}, ""),
        ("observation.human_effort", "a b", {"human_effort": [0, 1]}, ""),
        ("observation.other", 3, {}, ""),
        # In other features, x, y, z may belong to an object, and bare names to anything.
        ("observation.other", "x y z", {}, ""),
        ("observation.other", "a b", {}, ""),
        ("observation.other", "ee.x ee.y ee.z", {"position": [0, 1, 2]}, ""),
        ("observation.other", "EE.x EE.y EE.z", {"position": [0, 1, 2]}, ""),
        ("observation.other", "a.pos b.pos", {"joint_position": [0, 1]}, ""),
        ("state", 2, {"joint_position": [0, 1]}, "state names no components"),
        ("actions", 2, {"command_position": [0, 1]}, "actions names no components"),
        ("action.joint_velocity", 2, {"command_velocity": [0, 1]}, ""),
        ("action/joint_position", 2, {"command_position": [0, 1]}, ""),
        ("action.cartesian_position", 6, {}, ""),
        ("action.gripper", 1, {}, ""),
        ("action", "a.pos a.torque ee.x ee.y ee.z", {"command_position": [0]}, ""),
        ("action", "a.vel b.vel", {"command_velocity": [0, 1]}, ""),
    ],
)
def test_features_by_their_keys(key, names, expected, note):
    found = mapped({key: names})
    assert places(found, key) == expected
    taken = {index for indices in expected.values() for index in indices}
    width = names if isinstance(names, int) else len(names.split())
    assert found.extra == ((key,) if len(taken) < width else ())
    assert note in " ".join(found.notes)


@pytest.mark.parametrize(
    ("names", "assumed"),
    [
        (tool("quat", 4), "quaternion_xyzw, by its width"),
        (tool("rot", 3), "rotation_vector, by its width"),
        (tool("rot6d", 6), "rotation_6d, by its width"),
        ("ee.qw ee.qx ee.qy ee.qz", ""),
        ("ee_rot_w ee_rot_x ee_rot_y ee_rot_z", ""),
        ("ee.wx ee.wy ee.wz", ""),
        ("ee.x ee.y ee.z", ""),
    ],
)
def test_an_encoding_that_no_name_states_is_marked(names, assumed):
    (one,) = mapped({STATE: names}).selections.values()
    assert one.assumed == assumed


def test_a_feature_of_its_own_comes_before_components_and_the_first_of_two():
    found = mapped({STATE: "a.pos b.pos ee.x ee.y ee.z", "observation.joint_positions": "a b"})
    assert found.selections["joint_position"].columns[0][0] == "observation.joint_positions"
    assert found.extra == (STATE,)
    two = mapped({"observation.eef_pos": 3, "obs.ee_pos": 3})
    assert two.selections["position"].columns[0][0] == "observation.eef_pos"
    assert two.extra == ("obs.ee_pos",)


@pytest.mark.parametrize(
    ("state", "action", "names", "joints", "commands"),
    [
        ("a b", "a b", "a b", [0, 1], [0, 1]),
        ("a b", "b a", "a b", [0, 1], [1, 0]),
        ("a b", 2, "a b", [0, 1], [0, 1]),
        # Names of the action say more than numbers of the state.
        (2, "a b", "a b", [0, 1], [0, 1]),
        (2, 2, "joint_1 joint_2", [0, 1], [0, 1]),
        (2, "a b c", "joint_1 joint_2", [0, 1], None),
        (3, "a b", "joint_1 joint_2 joint_3", [0, 1, 2], None),
        ("a", "a b", "a", [0], [0]),
        ("a b", "b", "b", [1], [0]),
        ("a b", "c d", "a b", [0, 1], None),
        ("a b c", "c d", "c", [2], [0]),
        ("a b", 3, "a b", [0, 1], None),
    ],
)
def test_joints_of_state_and_action(state, action, names, joints, commands):
    found = mapped({STATE: state, "action": action})
    assert found.joint_names == tuple(names.split())
    chosen = {role: [i for _, i in s.columns] for role, s in found.selections.items()}
    assert chosen.pop("joint_position") == joints
    assert chosen == ({} if commands is None else {"command_position": commands})
    for selection in found.selections.values():
        assert selection.labels == found.joint_names
    assert bool(found.unmatched) == (commands is None)


@pytest.mark.parametrize(
    ("action", "advice"),
    [
        (
            "c d",
            "has the joints c, d, the rest has a, b: left among the extra columns. Leader",
        ),
        ("c d e", "Name them alike, or map one of them (--mapping command_position KEY[0:7])"),
    ],
)
def test_commands_of_other_joints_are_explained(action, advice):
    found = mapped({STATE: "a b", "action": action})
    assert advice in found.unmatched["command_position"]
    assert found.extra == ("action",)
    few = mapped({"observation.qpos": "a b", "observation.qvel": "a"})
    assert few.unmatched["joint_velocity"].endswith("left among the extra columns")


@pytest.mark.parametrize(
    ("features", "units"),
    [
        ({STATE: "a b"}, ()),
        ({STATE: "a_deg b_deg"}, ("deg", "deg")),
        ({STATE: "a_deg b"}, ("deg", "")),
        ({"observation.qpos_deg": 2}, ("deg", "deg")),
        ({"observation/qpos_deg": "a b_rad"}, ("deg", "rad")),
    ],
)
def test_units_in_names_of_components_come_before_those_of_features(features, units):
    (one,) = mapped(features).selections.values()
    assert one.units == units


def test_a_mapping_replaces_what_names_say():
    features = {STATE: "a.pos b.pos", "bare": 4, "ee_quat": 4, "index": 1}
    given = {"joint_position": "bare[1:3]", "quaternion_wxyz": "bare", "joint_effort": None}
    found = mapped(features, mapping=given)
    assert places(found, *features) == {
        "joint_position": [("bare", 1), ("bare", 2)],
        "quaternion_wxyz": [("bare", k) for k in range(4)],
    }
    one = found.selections["joint_position"]
    assert (one.labels, one.numbered, one.assumed) == (("joint_1", "joint_2"), True, "")
    assert one.column_name(1) == "bare (joint_2)"
    assert found.extra == (STATE, "ee_quat")
    named = mapped(features, mapping={"joint_position": ["b.pos", f"{STATE}/a.pos"]})
    assert named.joint_names == ("b", "a")
    assert not named.selections["joint_position"].numbered
    part = mapped(features, mapping={"gripper": "bare[3]", "joint_position": None})
    assert places(part, *features)["gripper"] == [("bare", 3)]
    assert part.joint_names == ()
    # One encoding of an orientation replaces any other.
    assert "quaternion_xyzw" in part.selections
    assert "quaternion_xyzw" not in found.selections


def test_what_a_dataset_declares_replaces_all_guesses():
    one = ColumnSelection(role="gripper", columns=(("bare", 0),), labels=("g",))
    found = mapped({STATE: "a b", "bare": 1}, declared={"gripper": one})
    assert found.selections == {"gripper": one}
    assert (found.extra, found.joint_names) == ((STATE,), ())


@pytest.mark.parametrize(
    ("mapping", "fault"),
    [
        ({"joints": "bare"}, "unknown quantity 'joints'; known are time, joint_position"),
        ({"position": "bare"}, "mapping gives position 4 columns, but it needs 3"),
        ({"position": []}, "mapping gives position no columns; None leaves it out"),
        ({"position": ["bare[0:2]", "bare[3]", "a.pos"]}, "gives position 4 columns"),
    ],
)
def test_a_mapping_that_cannot_be_followed(mapping, fault):
    with pytest.raises(DatasetError, match=fault):
        mapped({STATE: "a.pos", "bare": 4}, mapping=mapping)


def test_texts_images_and_index_columns_have_no_meaning():
    features = {
        "joint_position": feature("joint_position", 3, "string"),
        "timestamp": feature("timestamp", 1),
        "frame_index": feature("frame_index", 1, "int64"),
        "observation.qpos": feature("observation.qpos", 2, "float64"),
    }
    found = map_columns(features)
    assert [*found.selections] == ["joint_position"]
    assert found.selections["joint_position"].columns[0] == ("observation.qpos", 0)
    assert found.extra == ()
    assert np.shape(found.selections["joint_position"].columns) == (2, 2)


def test_blanks_around_a_name_hide_no_unit():
    assert without_unit(" q_deg ") == ("q", "deg")
    assert without_unit("q") == ("q", "")


def test_joints_with_a_feature_each_are_read_together():
    keys = ("observation.elbow.pos", "observation.elbow.vel", "observation.cube.pos")
    keys += ("action.elbow.pos", "observation.state.wrist.pos", "action.wrist.pos", "reward")
    declared = {key: {"dtype": "float32", "shape": [1], "names": None} for key in keys}
    declared["observation.hip.pos"] = declared["reward"] | {"names": ["value"]}  # says no joint
    found = map_columns(read_features({"features": declared}))
    assert found.joint_names == ("elbow", "wrist")
    assert {role: [key for key, _ in s.columns] for role, s in found.selections.items()} == {
        "joint_position": ["observation.elbow.pos", "observation.state.wrist.pos"],
        "command_position": ["action.elbow.pos", "action.wrist.pos"],
    }
    assert not found.selections["joint_position"].numbered
    assert "joint_velocity" in found.unmatched  # the wrist has none
    assert {"observation.cube.pos", "observation.hip.pos", "reward"} <= {*found.extra}


@pytest.mark.parametrize("key", ["joint.state", "observation.joint_states"])
def test_a_state_of_joints_comes_before_any_state(key):
    found = mapped({"observation.state": 7, key: 6})
    assert {k for k, _ in found.selections["joint_position"].columns} == {key}
    assert mapped({key: "a.pos a.vel"}).selections.keys() == {
        "joint_position",
        "joint_velocity",
    }


@pytest.mark.parametrize("key", [STATE, "action"])
def test_components_whose_names_are_unknown_next_to_named_joints_are_noted(key):
    """A gripper and five joints in two alphabets, of which one ends in .pos."""
    found = mapped({key: "схват.pos 关节1 关节2 关节3"})
    (note,) = found.notes
    assert note.startswith(f"{key}: 关节1, 关节2, 关节3 left out")
    assert "--mapping joint_position" in note
    assert not mapped({key: "joint_1.pos joint_2.pos gripper.pos"}).notes
