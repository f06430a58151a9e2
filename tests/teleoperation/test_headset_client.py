"""What clients for headsets are given, read back by other code than wrote it."""

import json
import struct

import numpy as np
import pytest

from hrc_learn.geometry import Body, Box, Capsule
from hrc_learn.kinematics import panda
from hrc_learn.protocols import ArmState, HumanInput
from hrc_learn.teleoperation import headset
from hrc_learn.teleoperation.gate.messages import Hands, MessageError, session_message
from hrc_learn.teleoperation.hand_guiding import GuidedStep
from hrc_learn.teleoperation.headset import headset_contents, headset_data, scene_glb
from hrc_learn.teleoperation.page import PageConfig
from hrc_learn.teleoperation.page_session import recorded_frame

AT_REST = {"position": np.zeros((1, 3)), "orientation": np.array([[1.0, 0.0, 0.0, 0.0]])}
LINK = Body(
    name="link4",
    capsules=(Capsule(start=(0.0, 0.0, 0.0), end=(0.0, 0.1, 0.3), radius=0.05),),
    **AT_REST,
)
FINGER = Body(
    name="finger_left",
    boxes=(Box(centre=(0.0, 0.0, 0.1), half_size=(0.03, 0.04, 0.12)),),
    **AT_REST,
)
TABLE = Box(centre=(0.5, 0.0, -0.1), half_size=(0.4, 0.6, 0.1), colour=(0.2, 0.4, 0.6, 0.5))


def read_glb(data: bytes):
    """Triangles and colour of each node, by the words of glTF 2.0 alone."""
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    content = json.loads(data[20 : 20 + size])
    binary = data[28 + size :]
    types = {5125: "<u4", 5126: "<f4", 5123: "<u2"}
    widths = {"SCALAR": 1, "VEC3": 3}

    def values(index):
        accessor = content["accessors"][index]
        view = content["bufferViews"][accessor["bufferView"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        width = widths[accessor["type"]]
        count = accessor["count"] * width
        kind = types[accessor["componentType"]]
        return np.frombuffer(binary, kind, count, start).reshape(-1, width)

    nodes = {}
    for node in content["nodes"]:
        if "mesh" not in node:
            continue
        assert "matrix" not in node or node["matrix"] == np.eye(4).ravel().tolist()
        (part,) = content["meshes"][node["mesh"]]["primitives"]
        assert "NORMAL" in part["attributes"]
        corners = values(part["attributes"]["POSITION"])[values(part["indices"]).ravel()]
        material = content["materials"][part["material"]]
        colour = material["pbrMetallicRoughness"].get("baseColorFactor", [1, 1, 1, 1])
        nodes[node["name"]] = corners.reshape(-1, 3, 3), colour, material.get("alphaMode")
    return nodes


def volume(triangles):
    a, b, c = triangles.transpose(1, 0, 2).astype(float)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def test_the_file_holds_each_shape_in_the_frame_of_its_body():
    nodes = read_glb(scene_glb([LINK, FINGER], [TABLE]))
    assert nodes.keys() == {"body0_0", "body1_0", "stands_2"}
    length = np.hypot(0.1, 0.3)
    round_ended = np.pi * 0.05**2 * (length + 4 / 3 * 0.05)
    # Twenty sides to the circle take a few per cent off.
    assert volume(nodes["body0_0"][0]) == pytest.approx(round_ended, rel=0.05)
    box, _, solid = nodes["body1_0"]
    assert volume(box) == pytest.approx(8 * 0.03 * 0.04 * 0.12, rel=1e-6)
    np.testing.assert_allclose(box.reshape(-1, 3).min(axis=0), [-0.03, -0.04, -0.02], atol=1e-6)
    assert solid in (None, "OPAQUE")
    table, colour, glass = nodes["stands_2"]
    np.testing.assert_allclose(table.reshape(-1, 3).mean(axis=0), TABLE.centre, atol=1e-6)
    np.testing.assert_allclose(colour, TABLE.colour, atol=2 / 255)
    assert glass == "BLEND"


def test_the_client_is_told_what_can_be_held(tmp_path, monkeypatch):
    monkeypatch.setattr(headset, "CLIENT", tmp_path)
    assert headset_contents() == {}  # it has not been built
    (tmp_path / "built").mkdir()
    for name in ("index.html", "style.css", "built/client.js", "built/licences.txt"):
        (tmp_path / name).write_text(name, "utf-8")
    contents = headset_contents() | headset_data([LINK, FINGER], [TABLE], 7, task="show it")
    told = json.loads(contents["/xr/scene.json"].body)
    assert told["task"] == "show it"
    link, finger = told["bodies"]
    assert (link["name"], link["joint"]) == ("link4", 4)
    assert link["capsules"] == [[0.0, 0.0, 0.0, 0.0, 0.1, 0.3, 0.05]]
    assert finger["joint"] is None  # it leads the end effector
    assert finger["capsules"][0][:3] == [0.0, 0.0, 0.1]
    last = headset_data([LINK, FINGER], [TABLE], 4)["/xr/scene.json"].body
    assert [held["joint"] for held in json.loads(last)["bodies"]] == [None, None]
    assert contents["/xr"].kind == "text/html"
    assert contents["/xr/client.js"].kind == "text/javascript"
    assert contents["/xr/scene.glb"].kind == "model/gltf-binary"
    assert contents["/xr/licences.txt"].body == b"built/licences.txt"


def hands(**seen) -> str:
    tracked = {"hand": "left", "position": [0, 0, 1], "orientation": [1, 0, 0, 0]} | seen
    return json.dumps({"type": "hands", "grips": [], "tracked": [tracked]})


def test_hands_become_columns():
    message = session_message(hands(position=[0.1, 0.2, 0.3], orientation=[0.6, 0.0, 0.8, 0.0]))
    assert isinstance(message, Hands)
    q = panda.ready
    state = ArmState(
        time=0.0, joint_position=q.numpy(), joint_velocity=np.zeros(7), gripper_width=0.08
    )
    step = GuidedStep(
        state=state, human_input=HumanInput(), pose=panda.forward(q), command=np.zeros(7)
    )
    columns = recorded_frame(step, {hand.hand: hand for hand in message.tracked})
    left, right = (columns[f"observation.{name}_hand"] for name in ("left", "right"))
    np.testing.assert_array_equal(left, [0.1, 0.2, 0.3, 0.6, 0.0, 0.8, 0.0])
    assert not np.any(right)


@pytest.mark.parametrize(
    "wrong",
    [
        {"hand": "third"},
        {"position": [0, 0, 11.0]},
        {"orientation": [1, 1, 0, 0]},
        {"position": None},
    ],
)
def test_hands_that_are_none_are_refused(wrong):
    with pytest.raises(MessageError):
        session_message(hands(**wrong))


def test_a_hand_is_in_one_place():
    message = json.loads(hands())
    message["tracked"] *= 2
    with pytest.raises(MessageError, match="listed only once"):
        session_message(json.dumps(message))


@pytest.mark.parametrize(
    "points",
    [
        ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0)),
        ((0.0, 0.0, 0.0),) * 3,
        ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.5, 0.0, 0.3)),
        ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.5, np.nan, 0.0)),
    ],
)
def test_points_that_place_nothing_are_refused(points):
    with pytest.raises(ValueError, match="touch_points must be three at least"):
        PageConfig(touch_points=points)
