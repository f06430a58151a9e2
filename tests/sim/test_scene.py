"""The scene as MuJoCo compiles it: furniture that fits together, objects, looks and lights."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hrc_learn.geometry import Box
from hrc_learn.sim import HAND_MARKER, SceneConfig, Worker, WorkerConfig
from hrc_learn.sim.scene import (
    NOWHERE,
    OCCLUDER,
    WORKER_BODIES,
    WORKER_ITEM,
    CabinetConfig,
    ObjectConfig,
    UnmarkedLook,
    build_scene,
    marked_plate,
    overhead_camera,
    unmarked,
)
from hrc_learn.sim.worker import WORKER_ITEM_HALF_SIZE
from hrc_learn.vision import Marker

OTHER = CabinetConfig(
    left=-0.2,
    right=0.3,
    front=-0.4,
    depth=0.3,
    bottom=-0.5,
    top=0.9,
    shelves={"low": 0.1, "high": 0.7},
    thickness=0.04,
    door_reach=0.25,
)


def span(box: Box) -> np.ndarray:
    """Least and greatest coordinate along x, y and z, (3, 2)."""
    return np.add(box.centre, np.multiply.outer([-1, 1], box.half_size)).T


@pytest.mark.parametrize("cabinet", [CabinetConfig(), OTHER])
def test_walls_boards_and_door_of_a_cabinet_meet(cabinet):
    boxes = {box.name: box for box in cabinet.boxes()}
    spans = {name: span(box) for name, box in boxes.items()}
    t, back = cabinet.thickness, cabinet.front - cabinet.depth
    across, deep = (cabinet.left, cabinet.right), (back, cabinet.front)
    high = (cabinet.bottom, cabinet.top)
    levels = {f"board_{name}": z for name, z in cabinet.shelves.items()}
    for name, z in (levels | {"cabinet_top": cabinet.top}).items():
        np.testing.assert_allclose(spans.pop(name), [across, deep, (z - t, z)])
    expected = {
        "cabinet_left": [(cabinet.left - t, cabinet.left), deep, high],
        "cabinet_right": [(cabinet.right, cabinet.right + t), deep, high],
        "cabinet_back": [(cabinet.left - t, cabinet.right + t), (back - t, back), high],
        "cabinet_door": [
            (cabinet.left - t, cabinet.left),
            (cabinet.front, cabinet.front + cabinet.door_reach),
            high,
        ],
    }
    assert spans.keys() == expected.keys()
    for name, place in expected.items():
        np.testing.assert_allclose(spans[name], place, err_msg=name)
    # One sees through the door alone.
    assert [name for name, box in boxes.items() if box.colour[3] < 1] == ["cabinet_door"]


def test_a_cabinet_may_have_no_door_or_a_narrow_one():
    def names(reach):
        return {box.name for box in replace(OTHER, door_reach=reach).boxes()}

    assert names(1e-3) - names(0.0) == {"cabinet_door"}


def test_an_object_of_another_size_has_the_same_density():
    item = ObjectConfig(mass=0.2, marker=Marker(12, 0.03))
    half = item.scaled(0.5)
    assert half.half_size == pytest.approx(np.multiply(item.half_size, 0.5))
    assert half.mass / np.prod(half.half_size) == pytest.approx(0.2 / np.prod(item.half_size))
    assert (half.marker.id, half.marker.size) == (12, pytest.approx(0.015))


def test_the_plate_of_a_hand_grows_with_it_and_clears_the_links_above():
    plate, half = marked_plate(), marked_plate(0.5)
    assert plate.marker == Marker(HAND_MARKER, 0.048)
    # Beside the hand, off its middle, and facing back along the tool's axis.
    np.testing.assert_allclose(plate.position, (-0.008, 0.145, 0.02))
    turn = Rotation.from_quat(plate.orientation, scalar_first=True)
    np.testing.assert_allclose(turn.apply([0, 0, 1]), (0, 0, -1), atol=1e-12)
    assert np.linalg.norm(plate.orientation) == 1.0
    np.testing.assert_allclose(half.position, np.multiply(plate.position, 0.5))
    assert half.marker.size == pytest.approx(0.5 * plate.marker.size)
    np.testing.assert_allclose(marked_plate(0.5, 0.12).position, (-0.004, 0.16, 0.01))
    assert marked_plate(1.0, 0.105).position == plate.position


def test_the_camera_sees_the_table_from_above_with_its_right_along_minus_x():
    camera = overhead_camera()
    below = np.array([0.24, 0.52, 0.0])
    np.testing.assert_allclose(camera.project(below), camera.principal, atol=1e-9)
    for step, pixel in (((-0.01, 0, 0), (1, 0)), ((0, 0.01, 0), (0, 1))):
        moved = camera.project(below + step) - camera.principal
        # 2050 px of focal length, from 1.55 m.
        np.testing.assert_allclose(moved, np.multiply(pixel, 2050 * 0.01 / 1.55), atol=1e-3)
    # Lines near the edge of the image bend inwards, by pixels.
    edge = camera.to_pixels(np.array([0.33, 0.0]))[0] - camera.principal[0]
    assert edge == pytest.approx(2050 * 0.33 * (1 - 0.06 * 0.33**2 + 0.02 * 0.33**4))
    assert camera.in_view(below + np.array([0.4, 0.3, 0.0]))


@pytest.fixture(scope="module")
def config():
    return SceneConfig(
        cabinet=OTHER,
        objects=(ObjectConfig(), ObjectConfig(name="other", marker=Marker(12, 0.02))),
        obstacles=(Box(name="wall", centre=(0.5, 0.1, 0.4), half_size=(0.1, 0.02, 0.3)),),
        worker=WorkerConfig(stature=1.6),
        timestep=0.004,
    )


@pytest.fixture(scope="module")
def model(config):
    return build_scene(config).compile()


def test_bodies_stand_where_the_scene_has_them(model, config):
    for box in (*config.boxes(), *config.obstacles):
        geom = model.geom(box.name)
        np.testing.assert_allclose(model.body(box.name).pos, box.centre)
        np.testing.assert_allclose(geom.size, box.half_size)
        np.testing.assert_allclose(geom.rgba, box.colour, atol=1e-6)
        assert geom.contype
        assert geom.conaffinity
    # The robot's base is on its pedestal, which stands on the floor.
    pedestal = model.geom("pedestal")
    assert pedestal.pos[2] + pedestal.size[2] == pytest.approx(0.0)
    floor = model.geom("floor").pos
    np.testing.assert_allclose(floor, (0, 0, pedestal.pos[2] - pedestal.size[2]))
    assert floor[2] == WorkerConfig().floor == CabinetConfig().bottom
    assert abs(pedestal.pos[0]) < pedestal.size[0] < 0.15
    assert abs(pedestal.pos[1]) < 1e-12
    assert pedestal.size[1] < 0.15
    assert model.opt.timestep == 0.004
    assert (model.vis.global_.offwidth, model.vis.global_.offheight) == (1440, 1080)


def test_only_what_is_moved_by_hand_is_a_mocap_body(model):
    mocap = {model.body(b).name for b in range(model.nbody) if model.body_mocapid[b] >= 0}
    assert mocap == {"wall", OCCLUDER, WORKER_ITEM, *WORKER_BODIES}
    for name in mocap - {"wall"}:
        np.testing.assert_allclose(model.body(name).pos, NOWHERE)


def test_objects_begin_on_the_table_with_their_marker_on_top(model, config):
    table = span(config.table)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for item in config.objects:
        geom, pose = model.geom(item.name), data.body(item.name)
        np.testing.assert_allclose(geom.size, item.half_size)
        assert model.body(item.name).mass[0] == pytest.approx(item.mass)
        assert pose.xpos[2] - item.half_size[2] == pytest.approx(table[2, 1])
        reach = np.array(item.half_size[:2])
        assert (pose.xpos[:2] - reach > table[:2, 0]).all()
        assert (pose.xpos[:2] + reach < table[:2, 1]).all()
        top = data.site(f"{item.name}_marker").xpos - pose.xpos
        np.testing.assert_allclose(top, (0, 0, item.half_size[2] + 5e-4), atol=1e-9)
        plates = [
            g for g in range(model.ngeom) if model.geom_bodyid[g] == pose.id and g != geom.id
        ]
        assert plates
        assert not (model.geom_contype[plates] | model.geom_conaffinity[plates]).any()
    assert "other" in {model.body(b).name for b in range(model.nbody)}


def test_what_is_only_seen_touches_nothing(model):
    for name in (OCCLUDER, WORKER_ITEM):
        geom = model.geom(name)
        assert (geom.contype, geom.conaffinity) == (0, 0)
    np.testing.assert_allclose(model.geom(WORKER_ITEM).size, WORKER_ITEM_HALF_SIZE)


def test_a_worker_is_felt_by_arm_and_objects_and_by_no_furniture(model, config):
    worker, parts = Worker(config.worker), [model.geom(name) for name in WORKER_BODIES]
    for geom, radius, length in zip(parts, worker.radius, worker.lengths, strict=True):
        np.testing.assert_allclose(geom.size[:2], (radius, length / 2))
        assert geom.conaffinity == 0
        # Found from any overlap on, felt from one metre on.
        assert geom.margin + geom.gap == 0
        assert geom.gap == 1
    bit = int(parts[0].contype[0])
    assert {int(geom.contype[0]) for geom in parts} == {bit}
    feeling = {
        model.body(model.geom_bodyid[g]).name
        for g in range(model.ngeom)
        if model.geom_conaffinity[g] & bit
    }
    assert feeling >= {"link0", "link4", "hand", "box", "other"}
    furniture = {box.name for box in config.boxes()}
    assert not feeling & (furniture | {"wall", "world", OCCLUDER, *WORKER_BODIES})
    touching = model.geom_contype & ~bit
    assert ((touching > 0) == ((model.geom_conaffinity & ~bit) > 0)).all()


def test_colours_are_fractions_and_light_comes_from_above(model):
    assert model.geom_rgba.min() >= 0
    assert model.geom_rgba.max() <= 1
    assert 0 < model.light_diffuse.max() <= 1
    assert model.light_pos[0, 2] > 2
    assert model.light_dir[0, 2] < -0.9
    head = model.vis.headlight
    assert 0 < np.max(head.ambient) < 1
    assert np.max(head.ambient) + np.max(head.diffuse) + np.max(model.light_diffuse) < 1.2
    assert np.max(head.specular) == 0
    # Shadows and smooth edges are slow without a GPU.
    assert not model.light_castshadow.any()
    assert model.vis.quality.shadowsize == model.vis.quality.offsamples == 0
    sky = build_scene(SceneConfig()).texture("sky")
    for colour in (sky.rgb1, sky.rgb2):
        assert 0.7 < np.min(colour) <= np.max(colour) <= 1
    assert sky.height == 6 * sky.width  # six faces of a cube


def test_a_grasp_does_not_creep():
    """Options that MuJoCo's documentation names against slip: elliptic cones, noslip."""
    option = build_scene(SceneConfig()).compile().opt
    assert option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert option.impratio >= 10
    assert option.noslip_iterations > 0


def test_markers_of_a_scene():
    config = SceneConfig(objects=(ObjectConfig(), ObjectConfig(marker=Marker(12, 0.02))))
    assert config.marker_ids == (HAND_MARKER, 11, 12)


@pytest.fixture(scope="module")
def looks():
    """Many small things on the table, in scenes with and without shadows."""
    usual = SceneConfig()
    found = []
    for shadows in (True, False):
        look = UnmarkedLook(seed=5, clutter=30, distractors=3, shadows=shadows)
        found.append(build_scene(unmarked(usual, look)))
        usual = replace(usual, table=replace(usual.table, centre=(0.3, 0.5, 0.1)))
    return found


def test_clutter_lies_on_the_rim_of_the_table_and_cartons_are_as_large_as_the_object(looks):
    for spec, centre in zip(looks, ((0.26, 0.54, -0.02), (0.3, 0.5, 0.1)), strict=True):
        table = spec.geom("table")
        middle, reach = np.array(centre), table.size[:2] - 0.06
        things = [g for g in spec.worldbody.geoms if g.name.startswith(("clutter", "distr"))]
        assert len(things) == 33
        size, place = np.array([g.size for g in things]), np.array([g.pos for g in things])
        np.testing.assert_allclose(place[:, 2] - size[:, 2], middle[2] + table.size[2])
        parts = np.abs(place[:, :2] - middle[:2]) / reach
        outer, inner = parts.max(axis=1), parts.min(axis=1)
        assert (outer >= 0.62).all()
        assert (outer <= 0.95).all()
        assert inner.max() <= 0.9
        assert inner.min() < 0.4
        # All four sides have some.
        side = (place[:, :2] - middle[:2]) / reach
        assert (side.max(axis=0) > 0.7).all()
        assert (side.min(axis=0) < -0.7).all()
        small = size[:30]
        assert (small >= (0.01, 0.01, 0.003)).all()
        assert (small <= (0.05, 0.05, 0.015)).all()
        assert (small.max(axis=0) > (0.045, 0.045, 0.0135)).all()
        np.testing.assert_allclose(size[30:], np.tile(ObjectConfig().half_size, (3, 1)))
        for g in things:
            turn = Rotation.from_quat(g.quat, scalar_first=True).as_rotvec()
            np.testing.assert_allclose(turn[:2], 0, atol=1e-12)
            assert 0 <= turn[2] <= np.pi
            assert (g.contype, g.conaffinity) == (0, 0)
            assert g.material == g.name
            np.testing.assert_allclose(g.rgba, 1.0)
        turns = [Rotation.from_quat(g.quat, scalar_first=True).magnitude() for g in things]
        assert max(turns) > 2.5


def test_a_lamp_shines_at_the_middle_of_the_table_with_or_without_shadows(looks):
    for spec, shadows in zip(looks, (True, False), strict=True):
        lamp, config = spec.lights[0], spec.body("table").pos
        middle = np.array([*config[:2], 0.0])
        np.testing.assert_allclose(lamp.pos + lamp.dir, middle, atol=1e-9)
        assert (np.abs(lamp.pos[:2] - middle[:2]) <= 0.8).all()
        assert abs(lamp.pos[2] - 2.4) <= 0.16
        assert 0.35 <= lamp.diffuse[0] <= 0.65
        assert len(set(lamp.diffuse)) == 1
        assert lamp.castshadow == shadows
        assert (spec.visual.quality.shadowsize > 0) == shadows


def test_prints_replace_colours_and_the_first_carton_has_the_objects(looks):
    spec, item = looks[0], ObjectConfig()

    def mean(name):
        pixels = np.frombuffer(bytes(spec.texture(name).data), dtype=np.uint8)
        return pixels.reshape(-1, 3).mean(axis=0) / 255

    assert spec.geom("box").material == "box_print"
    assert spec.geom("table").material == "wood"
    np.testing.assert_allclose(spec.geom("box").rgba, 1.0)
    tint = spec.geom("table").rgba
    assert (tint[:3] >= 0.75).all()
    assert (tint <= 1).all()
    assert tint[3] == 1
    likeness = [np.abs(mean(f"distractor{k}") - mean("box_print")).max() for k in range(3)]
    assert likeness[0] < 0.06 < min(likeness[1:])
    assert item.colour[2] > item.colour[0]


def test_a_place_on_the_tool_replaces_the_plate():
    usual = SceneConfig()
    hidden = unmarked(usual, UnmarkedLook())
    plate, before = hidden.arm.marker, usual.arm.marker
    assert plate is not None
    assert before is not None
    assert plate == replace(before, printed=False)
    placed = unmarked(usual, UnmarkedLook(), np.array([0.01, 0.02, -0.03])).arm.marker
    assert placed is not None
    # The tool centre point is 103.4 mm before the flange of the hand.
    np.testing.assert_allclose(placed.position, (0.01, 0.02, 0.1034 - 0.03))
    bare = replace(usual, arm=replace(usual.arm, marker=None))
    assert unmarked(bare, UnmarkedLook()).arm.marker is None
