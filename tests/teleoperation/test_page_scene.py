"""The page's 3D scene, read back from the file that viser writes of what browsers are sent."""

import asyncio
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
import torch
from unchecked import shapes_unchecked

from hrc_learn.geometry import Body, Box, Capsule, Pose
from hrc_learn.kinematics import panda
from hrc_learn.protocols import DrawnRegion
from hrc_learn.teleoperation.headset import PEDESTAL
from hrc_learn.teleoperation.page_operator import HeldGizmo, HeldGizmos
from hrc_learn.teleoperation.page_scene import PageScene, _step_back, box_edges
from hrc_learn.viz.palette import PERSON, SKY, TARGET, rgba

viser = pytest.importorskip("viser", reason="the extra `ui` is not installed")
zstandard = pytest.importorskip("zstandard")

PARENTS = ("", "/twin")
LINK = Capsule(start=(0, 0, 0), end=(0, 0, 0.2), radius=0.05, colour=(1.0, 0.5, 0.2, 1.0))
GLASS = Box(centre=(0, 0, 0), half_size=(0.1, 0.2, 0.3), colour=(0.2, 0.4, 0.6, 0.5))
BOARD = Box(
    centre=(0.4, 0.5, 0.6), half_size=(0.1, 0.2, 0.3), colour=(0.8, 0.6, 0.4, 1.0), name="board"
)
WINDOW = Box(
    centre=(0.0, 0.5, 0.6),
    half_size=(0.1, 0.2, 0.3),
    colour=(0.0, 0.0, 1.0, 0.3),
    name="window",
)


def body(name, **shapes):
    still = {"position": np.array([[0.1, 0.2, 0.3]]), "orientation": np.eye(1, 4)}
    return Body(name=name, **still, **shapes)


def nodes(server):
    """Properties of each node of the scene, by its name."""
    packed = server.get_scene_serializer().serialize()
    raw = zstandard.ZstdDecompressor().decompressobj().decompress(packed[8:])
    end = 8 + int.from_bytes(raw[:8], "little")
    found: dict[str, dict] = {}
    for _, message in msgspec.msgpack.decode(raw[8:end])["messages"]:
        node = found.setdefault(message.get("name", ""), {})
        kind = message["type"]
        node |= message.get("props", {}) | message.get("updates", {})
        node |= {k: message[k] for k in ("position", "wxyz", "visible") if k in message}
        node.setdefault("kinds", []).append(kind)
    return found


@pytest.fixture(scope="module")
def server():
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()


@pytest.fixture
def made(server):
    """A scene, the record of what is held in it, and its nodes."""
    server.scene.reset()
    held = HeldGizmos()
    bodies = [body("link3", capsules=(LINK,)), body("glass", boxes=(GLASS,))]
    scene = PageScene(server, bodies, [BOARD, WINDOW], held, panda, guides=True, turns=False)
    return scene, held, lambda: nodes(server)


def colour(name):
    return list(rgba(name)[:3])


def test_bodies_are_drawn_and_what_can_be_held_has_a_twin(made):
    found = made[2]()
    for parent in PARENTS:
        frame = found[f"{parent}/arm/link3"]
        assert frame["position"] == [0.1, 0.2, 0.3]
        assert not frame["show_axes"]
    assert "/twin/arm/glass" not in found
    assert found["/twin"]["position"] == [-0.1, 1.3, 0.0]
    looks = {
        "/arm/link3/0": ([255, 128, 51], None, True),
        "/arm/glass/0": ([51, 102, 153], 0.5, True),
        "/twin/arm/link3/0": (colour(SKY), 0.45, False),
    }
    for name, look in looks.items():
        node = found[name]
        assert (node["color"], node["opacity"], node["cast_shadow"]) == look
        assert not node["flat_shading"]
    knobs = {name for name in found if "/knobs/" in name}
    assert knobs == {f"{parent}/knobs/joint{k}" for parent in PARENTS for k in (2, 4, 6)}
    for name in knobs:
        node = found[name]
        assert (node["radius"], node["opacity"]) == (0.078, 0.9)
        assert (node["color"], node["cast_shadow"]) == (colour(PERSON), False)


def test_furniture_has_its_size_place_and_colour(made):
    found = made[2]()
    for box, rgb, opacity in (
        (BOARD, [204, 153, 102], None),
        (WINDOW, [0, 0, 255], 0.3),
        (PEDESTAL, [round(255 * c) for c in PEDESTAL.colour[:3]], None),
    ):
        node = found[f"/furniture/{box.name}"]
        assert node["dimensions"] == pytest.approx([2 * half for half in box.half_size])
        assert node["position"] == pytest.approx(box.centre)
        assert (node["color"], node["opacity"]) == (rgb, opacity)
    assert not found["/WorldAxes"]["visible"]
    floor = found["/floor"]
    assert (floor["width"], floor["height"], floor["cell_size"]) == (6.0, 6.0, 0.25)
    assert floor["position"] == [0.0, 0.5, -0.72]


@pytest.mark.parametrize("guides", [True, False])
@pytest.mark.parametrize("turns", [True, False])
def test_the_gizmo_moves_or_turns_what_the_page_offers(server, guides, turns):
    server.scene.reset()
    PageScene(server, [], [], HeldGizmos(), panda, guides=guides, turns=turns)
    gizmo = nodes(server)["/end_effector"]
    assert gizmo["disable_axes"] == gizmo["disable_sliders"] == (not guides)
    assert gizmo["disable_rotations"] == guides
    assert gizmo["visible"] == (guides or turns)
    assert (gizmo["scale"], gizmo["depth_test"]) == (0.2, False)


def test_the_camera_looks_at_cabinet_and_twin(server, made):
    camera = server.initial_camera
    np.testing.assert_allclose(camera.position, (2.65, 1.05, 1.15))
    np.testing.assert_allclose(camera.look_at, (0.1, 0.47, 0.12))
    assert camera.fov == 0.9


@shapes_unchecked()  # the arm is a stand-in
def test_a_small_arm_without_null_space_is_drawn_near_and_has_no_knobs(server):
    """An SO-101: five joints, and 0.4 times the size of a Panda."""
    server.scene.reset()
    robot = SimpleNamespace(joints=5, hand_size=0.4, null_space="none")
    bodies = [body("link4", capsules=(LINK,)), body("link5", capsules=(LINK,))]
    held = HeldGizmos(links=lambda: LINKS)
    PageScene(server, bodies, [], held, robot, guides=True, turns=False)
    found, dragged = nodes(server), dragged_nodes(server)
    assert not [name for name in dragged if "/knobs/" in name]
    np.testing.assert_allclose(found["/twin"]["position"], [-0.04, 0.52, 0.0])
    assert found["/end_effector"]["scale"] == pytest.approx(0.08)
    assert found["/pull"]["shaft_radius"] == pytest.approx(0.0032)
    np.testing.assert_allclose(server.initial_camera.position, (1.06, 0.42, 0.46))
    np.testing.assert_allclose(server.initial_camera.look_at, (0.04, 0.188, 0.048))
    point, grips = np.array([0.5, 0.6, 0.7]), []
    for name in ("/arm/link4/0", "/twin/arm/link5/0"):
        drag(dragged[name], "start", point, point)
        ((_, gizmo),) = held.held().items()
        grips.append(gizmo.joint)
        held.release()
    assert grips == [4, None]  # the last link moves the end effector


@pytest.mark.parametrize(("joints", "marked"), [(7, [2, 4, 6]), (8, [2, 4, 6])])
@shapes_unchecked()
def test_knobs_are_at_joints_that_the_arm_has(server, joints, marked):
    server.scene.reset()
    robot = SimpleNamespace(joints=joints, hand_size=1.0, null_space="free")
    PageScene(server, [], [], HeldGizmos(), robot, guides=True, turns=False)
    assert [n for n in dragged_nodes(server) if n.startswith("/knobs/j")] == [
        f"/knobs/joint{joint}" for joint in marked
    ]


def test_everything_moves_but_a_gizmo_that_is_held(made):
    scene, held, found = made
    rng = np.random.default_rng(0)
    turns = rng.normal(size=(2, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)

    def moved(shift):
        places = rng.normal(size=(2, 3))
        links = Pose(
            torch.arange(24.0).reshape(8, 3).double() + shift, torch.eye(1, 4).repeat(8, 1)
        )
        scene.move(places, turns, links)
        return places, found()

    places, now = moved(0)
    for parent in PARENTS:
        np.testing.assert_allclose(now[f"{parent}/arm/link3"]["position"], places[0])
        np.testing.assert_allclose(now[f"{parent}/arm/link3"]["wxyz"], turns[0])
        for joint in (2, 4, 6):
            first = 3 * (joint - 1)
            at = now[f"{parent}/knobs/joint{joint}"]["position"]
            assert at == [first, first + 1, first + 2]
    np.testing.assert_allclose(now["/arm/glass"]["position"], places[1])
    assert now["/end_effector"]["position"] == [21, 22, 23]
    grip = HeldGizmo(joint=None, held_at=np.zeros(3), pointer=np.zeros(3))
    held.take(("me", "/arm/link3"), grip)
    assert moved(1)[1]["/end_effector"]["position"] == [22, 23, 24]
    held.take(("me", "/end_effector"), grip)
    assert moved(2)[1]["/end_effector"]["position"] == [22, 23, 24]
    held.release("me")
    held.take(("me", "/end_effector"), None, np.array([1.0, 0, 0, 0]))  # its rings turn
    assert moved(3)[1]["/end_effector"]["position"] == [22, 23, 24]
    held.release("me")
    assert moved(4)[1]["/end_effector"]["position"] == [25, 26, 27]


def test_twin_region_rings_and_arrows_are_shown_when_they_mean_something(made):
    scene, _, found = made
    now = found()
    # Somebody new to the page sees one arm.
    assert not any(now[name]["visible"] for name in ("/pull", "/active_region", "/twin"))
    size = (
        now["/pull"]["shaft_radius"],
        now["/pull"]["head_radius"],
        now["/pull"]["head_length"],
    )
    assert size == (0.008, 0.022, 0.05)
    assert now["/active_region"]["thickness"] == 0.003
    scene.show_twin(True)
    scene.let_turn(True)
    scene.show_region(DrawnRegion(centre=(0.4, 0.5, 0.6), half_size=(0.1, 0.2, 0.3)))
    scene.point(np.ones((2, 2, 3)), TARGET, held=(4, None))
    now = found()
    assert now["/twin"]["visible"]
    assert not now["/end_effector"]["disable_rotations"]
    assert now["/active_region"]["visible"]
    assert now["/pull"]["visible"]
    for parent in PARENTS:
        assert now[f"{parent}/knobs/joint4"]["color"] == colour(TARGET)
        assert now[f"{parent}/knobs/joint2"]["color"] == colour(PERSON)
    scene.show_twin(False)
    scene.let_turn(False)
    scene.show_region(None)
    scene.point(np.zeros((0, 2, 3)))
    now = found()
    assert not now["/twin"]["visible"]
    assert now["/end_effector"]["disable_rotations"]
    assert not now["/active_region"]["visible"]
    assert not now["/pull"]["visible"]
    assert now["/twin/knobs/joint4"]["color"] == colour(PERSON)


def drag(node, phase, start, end):
    """What viser calls when a browser drags a node."""
    event = SimpleNamespace(client_id=1, phase=phase, start_position=start, end_position=end)
    for entry in node._impl.drag_cb:
        asyncio.run(entry.callback(event))


def dragged_nodes(server):
    """Nodes of the scene that can be dragged, by their names."""
    known = server.scene._handle_from_node_name
    return {name: node for name, node in known.items() if getattr(node._impl, "drag_cb", [])}


LINKS = Pose(torch.arange(24.0).reshape(8, 3).double(), torch.eye(1, 4).double().repeat(8, 1))


@pytest.mark.parametrize(
    ("parent", "offset"), [("", (0.0, 0.0, 0.0)), ("/twin", (-0.1, 1.3, 0))]
)
@pytest.mark.parametrize(("node", "joint"), [("arm/link3/0", 3), ("knobs/joint6", 6)])
def test_arm_and_twin_are_dragged_at_the_point_that_is_held(
    server, made, parent, offset, node, joint
):
    _, held, _ = made
    held.links = lambda: LINKS
    name, start, end = f"{parent}/{node}", np.array([0.5, 0.6, 0.7]), np.array([1.0, 2.0, 3.0])
    handle = dragged_nodes(server)[name]
    drag(handle, "start", offset + start, offset + end)
    ((key, gizmo),) = held.held().items()
    assert key == (1, name)
    assert gizmo.joint == joint
    np.testing.assert_allclose(gizmo.held_at, start - LINKS.position[joint - 1].numpy())
    np.testing.assert_allclose(gizmo.pointer, end)
    drag(handle, "update", offset + start, offset + 2 * end)
    np.testing.assert_allclose(held.held()[key].pointer, 2 * end)
    np.testing.assert_allclose(held.held()[key].held_at, gizmo.held_at)
    drag(handle, "end", offset + start, offset + end)
    assert held.held() == {}


@pytest.mark.parametrize("guides", [True, False])
def test_the_gripper_is_dragged_where_the_end_effector_is_guided(server, guides):
    server.scene.reset()
    bodies = [body("hand", capsules=(LINK,)), body("glass", boxes=(GLASS,))]
    PageScene(server, bodies, [], HeldGizmos(), panda, guides=guides, turns=False)
    found = {name for name in dragged_nodes(server) if "/arm/" in name}
    assert found == ({"/arm/hand/0", "/twin/arm/hand/0"} if guides else set())


@pytest.mark.parametrize("guides", [True, False])
def test_the_gizmo_holds_where_it_guides_and_turns_in_any_case(server, guides):
    server.scene.reset()
    held = HeldGizmos(links=lambda: LINKS)
    scene = PageScene(server, [], [], held, panda, guides=guides, turns=True)
    half = np.sqrt(0.5)

    def dragged(phase, place, turn, client=1):
        target = SimpleNamespace(
            name="/end_effector", position=np.array(place), wxyz=np.array(turn)
        )
        event = SimpleNamespace(client_id=client, phase=phase, target=target)
        asyncio.run(scene._gizmo_dragged(event))

    dragged("start", (1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0), client=None)  # by this program
    assert held.held() == {}
    assert not held.turning
    dragged("start", (1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))
    assert held.turning
    if guides:
        ((key, gizmo),) = held.held().items()
        assert key == (1, "/end_effector")
        assert gizmo.joint is None
        np.testing.assert_array_equal(gizmo.held_at, np.zeros(3))
        np.testing.assert_array_equal(gizmo.pointer, (1.0, 2.0, 3.0))
    else:
        assert held.held() == {}
    dragged("update", (1.5, 2.5, 3.5), (half, 0.0, 0.0, half))
    np.testing.assert_allclose(held.turn_vector, (0.0, 0.0, np.pi / 2))
    assert [tuple(g.pointer) for g in held.held().values()] == [(1.5, 2.5, 3.5)] * guides
    dragged("end", (1.5, 2.5, 3.5), (half, 0.0, 0.0, half))
    assert held.held() == {}
    assert not held.turning
    # The rotation stays, and what a browser says afterwards changes nothing.
    dragged("update", (9.0, 9.0, 9.0), (0.0, 1.0, 0.0, 0.0))
    np.testing.assert_allclose(held.turn_vector, (0.0, 0.0, np.pi / 2))


@pytest.mark.parametrize("aspect", [0.4, 0.6, 1.19, 1.2, 2.0])
def test_a_camera_whose_view_is_narrow_stands_back_until_as_much_is_seen(aspect):
    usual, look_at = np.array((2.65, 1.05, 1.15)), np.array((0.1, 0.47, 0.12))
    camera = SimpleNamespace(aspect=aspect, position=usual, look_at="unchanged")
    asyncio.run(_step_back(SimpleNamespace(camera=camera), np.stack([usual, look_at])))
    # The width in view at the place looked at is that of a view 1.2 times as wide as high.
    width = aspect * np.linalg.norm(camera.position - look_at)
    assert width >= 1.2 * np.linalg.norm(usual - look_at) - 1e-9
    if aspect < 1.2:
        assert width == pytest.approx(1.2 * np.linalg.norm(usual - look_at))
        np.testing.assert_allclose(
            np.cross(camera.position - look_at, usual - look_at), 0, atol=1e-12
        )
        np.testing.assert_array_equal(camera.look_at, look_at)
    else:
        np.testing.assert_array_equal(camera.position, usual)
        assert camera.look_at == "unchanged"


def test_the_edges_of_a_box_join_corners_that_differ_along_one_axis():
    edges = box_edges((1.0, 2.0, 3.0))
    assert edges.shape == (12, 2, 3)
    np.testing.assert_allclose(np.abs(edges), np.broadcast_to((1.0, 2.0, 3.0), (12, 2, 3)))
    lengths = edges[:, 1] - edges[:, 0]
    assert ((lengths != 0).sum(axis=1) == 1).all()
    assert (lengths >= 0).all()
    assert len({edge.tobytes() for edge in edges}) == 12


def test_the_arrow_and_the_knobs_held_have_the_colour_of_what_follows(made):
    scene, _, found = made
    arrows = np.arange(12.0).reshape(2, 2, 3)
    scene.point(arrows, SKY, held=(2,))
    now = found()
    assert scene._arrows.points.tolist() == arrows.tolist()
    assert set(map(tuple, np.reshape(scene._arrows.colors, (-1, 3)).tolist())) == {
        tuple(colour(SKY))
    }
    assert now["/knobs/joint2"]["color"] == colour(SKY)
    scene.show_region(DrawnRegion(centre=(0.4, 0.5, 0.6), half_size=(0.1, 0.2, 0.3)))
    corners = scene._region.points.reshape(-1, 3)
    np.testing.assert_allclose(corners.min(axis=0), (0.3, 0.3, 0.3), atol=1e-6)
    np.testing.assert_allclose(corners.max(axis=0), (0.5, 0.7, 0.9), atol=1e-6)
