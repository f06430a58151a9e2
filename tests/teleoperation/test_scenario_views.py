"""Cameras, inputs and choices of scenarios."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from unchecked import shapes_unchecked

from hrc_learn.kinematics.registry import arm
from hrc_learn.protocols import ArmState, Feedback, Human, HumanInput
from hrc_learn.sim import CameraChange, Imperfections
from hrc_learn.sim.workplace import Workplace
from hrc_learn.teleoperation.scenarios import (
    Grasping,
    Placing,
    ScenarioRun,
    ScenarioView,
    SequencedInput,
    _scaled,
    check_scenario,
    make_scenario,
    overview,
)

pytestmark = pytest.mark.simulation

WORKPLACE = Workplace()


@pytest.mark.parametrize(
    ("size", "focal"), [((240, 180), 162.0), ((400, 180), 162.0), ((120, 200), 81.0)]
)
def test_an_overview_looks_at_the_work_from_in_front_at_any_size(size, focal):
    camera = overview(*size)
    assert (camera.width, camera.height) == size
    assert camera.focal == pytest.approx((focal, focal))
    middle = (np.array(size) - 1) / 2
    np.testing.assert_allclose(camera.principal, middle)
    np.testing.assert_allclose(camera.pose[:3, 3], (1.9, 0.35, 1.15))
    np.testing.assert_allclose(camera.project(np.array([0.25, -0.02, 0.25])), middle, atol=1e-9)


@pytest.mark.parametrize("size", [(72, 54), (100, 30), (1440, 1080)])
def test_coarser_pixels_show_the_same_view(size):
    camera = WORKPLACE.scene.camera
    small = _scaled(camera, *size)
    assert (small.width, small.height) == size
    rng = np.random.default_rng(0)
    points = WORKPLACE.hover().position.numpy() + rng.uniform(-0.1, 0.1, (20, 3))
    # Fractions of the image's width and height, from edge to edge.
    seen = (camera.project(points) + 0.5) / (camera.width, camera.height)
    np.testing.assert_allclose((small.project(points) + 0.5) / size, seen, atol=1e-9)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (("grasp", "middle", False), "no scenario 'grasp': there are placing, grasping"),
        (("placing", "top", False), "no shelf 'top': there are lower, middle, upper"),
        (("placing", "lower", True), "has no pixels"),
        (("placing", "lower", False), ""),
        (("grasping", "upper", True), ""),
    ],
)
def test_scenarios_shelves_and_pixels_that_do_not_exist_are_named(given, message):
    if message:
        with pytest.raises(ValueError, match=message):
            check_scenario(*given)
    else:
        check_scenario(*given)


def test_a_scenario_is_made_for_the_arm_and_the_shelf():
    placing = make_scenario("placing", "upper", arm("panda"))
    assert isinstance(placing, Placing)
    assert placing.task == "place the box on the upper shelf"
    # The object is let go 15 s after the start, and 1.5 s pass.
    assert placing.duration == pytest.approx(16.5)
    assert isinstance(make_scenario("grasping", "upper", arm("panda")), Grasping)


class Person(Human):
    """Asks for its number, and keeps what it is notified of."""

    def __init__(self, number):
        self.number, self.heard = number, []

    def read(self, state):
        return HumanInput(twist=np.full(6, self.number), gripper=9.0)

    def tell(self, feedback):
        self.heard.append(feedback)


def at(time):
    return ArmState(
        time=time, joint_position=np.zeros(7), joint_velocity=np.zeros(7), gripper_width=0.0
    )


def test_feedback_goes_to_the_one_whose_turn_it_is():
    first, second = Person(1.0), Person(2.0)
    turns = SequencedInput([(1.0, first, 0.08), (2.0, second, 0.0)])
    feedback = Feedback()
    turns.tell(feedback)
    assert (len(first.heard), len(second.heard)) == (1, 0)
    for time, number, width in ((0.0, 1.0, 0.08), (1.999, 1.0, 0.08), (2.0, 2.0, 0.0)):
        asked = turns.read(at(time))
        assert (asked.twist[0], asked.gripper) == (number, width)
    turns.tell(feedback)
    assert (len(first.heard), len(second.heard)) == (1, 1)
    turns.read(at(1.5))  # a clock that is set back
    turns.tell(feedback)
    assert len(first.heard) == 2


@pytest.fixture(scope="module")
def run():
    with shapes_unchecked():
        return ScenarioRun(Grasping(), 20.0, seed=3)


def test_a_run_counts_commands_and_moves_the_gripper_only_if_asked(run):
    run.begin(3)
    assert (run.seed, run.commands, run.dt) == (3, 0, pytest.approx(0.05))
    q = run.world.arm.read().joint_position
    moved: list[float] = []
    run.world.arm.move, move = moved.append, run.world.arm.move
    try:
        began = run.world.time
        for width in (0.03, math.nan, 0.0):
            run.command(q, width)
    finally:
        run.world.arm.move = move
    assert moved == [0.03, 0.0]
    assert run.commands == 3
    assert run.world.time - began == pytest.approx(0.15)


def test_pixels_of_tool_and_object_are_where_the_camera_projects_them(run):
    run.begin(4)
    plate = run.world.config.arm.marker.marker.id
    places = run.world.marker_poses()
    for found, marker in (
        (run.tool_pixel(), plate),
        (run.object_pixel(), run.scenario.workplace.scene.objects[0].marker.id),
    ):
        expected = run.camera.project(places[marker][:3, 3])
        np.testing.assert_allclose(found, expected, atol=1.0)
    # The object's pixel is that of the beginning, and the noise belongs to the seed.
    first = run.object_pixel()
    run.begin(5)
    run.begin(4)
    np.testing.assert_array_equal(run.object_pixel(), first)


def test_an_object_out_of_view_has_no_pixel(run):
    run.begin(3)
    was = run.__dict__.get("_sensor")
    run.__dict__["_sensor"] = SimpleNamespace(detect=dict)
    try:
        with pytest.raises(ValueError, match="does not see marker 11"):
            run.object_pixel()
    finally:
        run.__dict__.pop("_sensor")
        if was is not None:
            run.__dict__["_sensor"] = was


def test_a_moved_camera_still_sees_table_and_tool():
    run = ScenarioRun(Grasping(), 20.0)
    middle, half = (x.numpy() for x in WORKPLACE.object_region())
    points = run._watched()
    assert points.shape == (12, 3)
    table, low_or_high, other = points.reshape(3, 4, 3)
    np.testing.assert_allclose(table.mean(axis=0), middle)
    np.testing.assert_allclose(np.abs(table - middle)[:, :2], np.tile(half[:2], (4, 1)))
    # The tool's marker over the table: where the tool points down at hovering and at objects.
    offset = run.world.hand_marker_offset() * (1.0, -1.0, -1.0)
    heights = (WORKPLACE.hover_height, 2 * middle[2])
    for corners, height in zip((low_or_high, other), heights, strict=True):
        np.testing.assert_allclose(corners.mean(axis=0), np.append(middle[:2], height) + offset)
        np.testing.assert_allclose(corners - corners.mean(axis=0), table - middle, atol=1e-12)
    before = run.object_pixel()
    run.move_camera(CameraChange(), np.random.default_rng(0))
    assert run.camera.in_view(points).all()
    assert np.linalg.norm(run.object_pixel() - before) > 5.0


def test_imperfections_are_drawn_anew_from_each_seed():
    run = ScenarioRun(Grasping(), 20.0, imperfections=Imperfections.nominal())
    found = []
    for seed in (1, 2, 1):
        run.begin(seed)
        found.append((run.world.table_top, tuple(run.world.arm.encoder_offset)))
    assert found[0] == found[2] != found[1]
    ideal = ScenarioRun(Grasping(), 20.0)
    world = ideal.world
    ideal.begin(1)
    assert ideal.world is world


@pytest.mark.parametrize("size", [(96, 72), (64, 64)])
def test_a_view_has_the_size_that_is_asked_for_and_follows_the_run(run, size):
    view = ScenarioView(run, *size, kind="synthetic")
    assert view.read().shape == (size[1], size[0], 3)
    other: Any = ScenarioRun(Grasping(), 20.0, imperfections=Imperfections.nominal())
    moving = ScenarioView(other, *size, kind="synthetic")
    before = other.world
    other.begin(7)
    assert other.world is not before
    assert moving.read().shape == (size[1], size[0], 3)
    assert moving._world is other.world
