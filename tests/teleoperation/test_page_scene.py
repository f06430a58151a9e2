"""The page's 3D scene, read back from the file that viser writes of what browsers are sent."""

import msgspec
import numpy as np
import pytest
import torch

from hrc_learn.geometry import Body, Box, Capsule, Pose
from hrc_learn.protocols import DrawnRegion
from hrc_learn.teleoperation.headset import PEDESTAL
from hrc_learn.teleoperation.page_operator import HeldGizmo, HeldGizmos
from hrc_learn.teleoperation.page_scene import PageScene
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
    scene = PageScene(server, bodies, [BOARD, WINDOW], held, guides=True, turns=False)
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
    PageScene(server, [], [], HeldGizmos(), guides=guides, turns=turns)
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
    assert (now["/pull"]["visible"], now["/active_region"]["visible"]) == (False, False)
    size = (
        now["/pull"]["shaft_radius"],
        now["/pull"]["head_radius"],
        now["/pull"]["head_length"],
    )
    assert size == (0.008, 0.022, 0.05)
    assert now["/active_region"]["thickness"] == 0.003
    scene.show_twin(False)
    scene.let_turn(True)
    scene.show_region(DrawnRegion(centre=(0.4, 0.5, 0.6), half_size=(0.1, 0.2, 0.3)))
    scene.point(np.ones((2, 2, 3)), TARGET, held=(4, None))
    now = found()
    assert not now["/twin"]["visible"]
    assert not now["/end_effector"]["disable_rotations"]
    assert now["/active_region"]["visible"]
    assert now["/pull"]["visible"]
    for parent in PARENTS:
        assert now[f"{parent}/knobs/joint4"]["color"] == colour(TARGET)
        assert now[f"{parent}/knobs/joint2"]["color"] == colour(PERSON)
    scene.show_twin(True)
    scene.let_turn(False)
    scene.show_region(None)
    scene.point(np.zeros((0, 2, 3)))
    now = found()
    assert now["/twin"]["visible"]
    assert now["/end_effector"]["disable_rotations"]
    assert not now["/active_region"]["visible"]
    assert not now["/pull"]["visible"]
    assert now["/twin/knobs/joint4"]["color"] == colour(PERSON)
