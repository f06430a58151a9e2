"""Measures of a run's log, on logs whose answer is known."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hrc_learn.experiments.grasping_experiment import descent, jacobian_errors, lift
from hrc_learn.experiments.run_measures import (
    Deviation,
    grasp_offset,
    lasting,
    limit_violations,
    place_pitch_and_yaw,
    span,
    spans,
    true_tool,
    unwanted_contacts,
)
from hrc_learn.experiments.surroundings import (
    OBJECT_REACH,
    OBJECTS_REACH,
    THREE_OBJECTS,
    draw_object_poses,
    points_to_see,
    waiting_pose,
    with_objects,
    workplace_for,
)
from hrc_learn.kinematics import panda
from hrc_learn.log import StepLog
from hrc_learn.sim import World
from hrc_learn.sim.scene import overhead_camera
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.grasping import INTERACT

# Stand-ins are not of the annotated types.
pytestmark = pytest.mark.simulation

WORKPLACE = Workplace()


def phases(*entries):
    log = StepLog()
    for time, text in entries:
        log.event(time, text)
    return log


def test_a_phase_lasts_until_the_next_one():
    log = phases((0.0, "home"), (1.5, "grasp"), (4.0, "home"), (6.0, "grasp"))
    assert spans(log, "home") == [(0.0, 1.5), (4.0, 6.0)]
    assert spans(log, "grasp") == [(1.5, 4.0), (6.0, math.inf)]
    assert span(log, "grasp") == (1.5, 4.0)
    assert spans(log, "place") == []
    assert span(log, "place") == (0.0, 0.0)
    assert [end for _, end in lasting(log.events, 9.0)] == [1.5, 4.0, 6.0, 9.0]
    assert lasting([]) == []


def measured(*rows):
    log = StepLog()
    for k, (q, v) in enumerate(rows):
        log.append(time=0.1 * k, joint_position=q, joint_velocity=v)
    return SimpleNamespace(log=log, chain=panda)


def test_joints_at_their_limits_are_within_them():
    limits = panda.limits
    lower, upper, fastest = (x.numpy() for x in (limits.lower, limits.upper, limits.velocity))
    ready, still = panda.ready.numpy(), np.zeros(7)
    at = [(lower, still), (upper, still), (ready, fastest), (ready, -fastest)]
    assert limit_violations(measured(*at)) == 0
    one, a_bit = np.eye(7)[2], 1e-6
    beyond = [
        (lower - a_bit * one, still),
        (upper + a_bit * one, still),
        (ready, fastest + a_bit * one),
        (ready, -fastest - a_bit * one),
        (upper + 1, 2 * fastest),
    ]
    assert limit_violations(measured(*at, *beyond)) == len(beyond)
    assert limit_violations(SimpleNamespace(log=StepLog(), chain=panda)) == 0


def touches(*entries):
    return SimpleNamespace(
        touches=[SimpleNamespace(first=first, start=start) for first, start in entries]
    )


def test_contacts_are_unwanted_but_for_the_feeling_fingers_and_what_was_released():
    log = phases((0.0, "home"), (2.0, "grasp"), (3.0, "home"))
    world: Any = SimpleNamespace(
        object_contacts=touches(("box", 1.0), ("tin", 5.0), ("tin", 6.0), ("tin", 5.9)),
        table_contacts=touches(
            ("finger_left", 2.0), ("finger_right", 3.0), ("finger_left", 2.9), ("hand", 2.5)
        ),
        cabinet_contacts=touches(("link5", 0.5)),
        self_contacts=touches(("link7", 0.7)),
    )
    found = unwanted_contacts(world, log, {"tin": 6.0})
    listed = {name: [(t.first, t.start) for t in hits] for name, hits in found.items()}
    assert listed == {
        "cabinet": [("link5", 0.5), ("box", 1.0), ("tin", 5.0), ("tin", 5.9)],
        "table": [("finger_right", 3.0), ("hand", 2.5)],
        "arm itself": [("link7", 0.7)],
    }
    assert len(unwanted_contacts(world, log)["cabinet"]) == 5


@pytest.mark.parametrize("pitch", [0.0, 0.15, -0.2])
@pytest.mark.parametrize("yaw", [0.0, 0.1, 3.0])
def test_pitch_and_yaw_of_a_placed_box_have_no_sign(pitch, yaw):
    """The hand points along y, level; a box looks the same after half a turn."""
    along = Rotation.from_matrix(np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]).T)
    goal = torch.from_numpy(along.as_quat(scalar_first=True))
    in_hand = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    direction = along.apply([0, 0, 1])
    across = np.cross([0, 0, 1], direction)
    vector = pitch * across + np.array([0, 0, 0.0])
    turned = Rotation.from_rotvec(vector) * along * in_hand
    spun = turned * Rotation.from_euler("z", np.pi if yaw > 1 else 0)
    pose = np.eye(4)
    pose[:3, :3] = spun.as_matrix()
    if 0 < yaw < 1:
        pose[:3, :3] = (Rotation.from_euler("z", yaw) * along * in_hand).as_matrix()
    expected = (0.0, yaw) if 0 < yaw < 1 else (abs(pitch), 0.0)
    np.testing.assert_allclose(place_pitch_and_yaw(pose, goal), expected, atol=1e-9)


STEPS = 8


class Motion:
    """Poses of bodies in the steps of a run."""

    def __init__(self, **bodies):
        self._bodies = bodies

    def bodies(self, steps):
        return [
            SimpleNamespace(name=name, position=position[:steps], orientation=turn[:steps])
            for name, (position, turn) in self._bodies.items()
        ]


def tilted(angles):
    """Hands that point down, tilted about x."""
    down = Rotation.from_euler("x", np.pi)
    return (Rotation.from_euler("x", angles[:, None]) * down).as_quat(scalar_first=True)


@pytest.fixture
def grasp():
    """A hand that approaches an object in steps of 1 cm, each tilted by a degree more."""
    k = np.arange(STEPS)
    hand = np.stack([0.3 + 0.01 * k, 0.4 + 0 * k, 0.3 - 0.01 * k], axis=-1)
    item = np.tile([0.38, 0.4, 0.02], (STEPS, 1))
    still = np.tile([1.0, 0, 0, 0], (STEPS, 1))
    motion = Motion(hand=(hand, tilted(np.deg2rad(k))), box=(item, still))
    camera, rng = overhead_camera(), np.random.default_rng(0)
    log = StepLog()
    log.event(0.0, "approach")
    log.event(0.3, "grasp")
    log.event(0.5, "approach")
    log.event(0.65, "grasp")
    for i in range(STEPS):
        log.append(
            time=0.1 * i,
            vision_activation=float(2 <= i < 6),
            image_jacobian=1e3 * rng.standard_normal((2, 6)),
        )
    world = SimpleNamespace(
        arm=SimpleNamespace(tool_offset=np.array([0.0, 0.0, 0.1])),
        hand_marker_offset=lambda: np.array([0.0, 0.1, -0.05]),
        config=SimpleNamespace(camera=camera),
        holds=lambda name: True,
        object_pose=lambda name: np.diag([1.0, 1, 1, 1]) + 0.25 * np.eye(4, k=1),
    )
    return SimpleNamespace(
        cell=SimpleNamespace(log=log),
        motion=motion,
        world=world,
        item=SimpleNamespace(name="box"),
        scene=SimpleNamespace(workplace=WORKPLACE, object_pose=np.eye(4)),
    )


def tool_at(grasp, step):
    """Tool centre point of a step, by SciPy."""
    (hand,) = (b for b in grasp.motion.bodies(STEPS) if b.name == "hand")
    turn = Rotation.from_quat(hand.orientation[step], scalar_first=True)
    return hand.position[step] + turn.apply([0, 0, 0.1]), turn


def test_the_tool_centre_point_lies_on_the_axis_of_the_true_hand(grasp):
    tool = true_tool(grasp.motion, grasp.world, 5)
    assert len(tool.position) == 5
    for k in range(5):
        np.testing.assert_allclose(tool.position[k], tool_at(grasp, k)[0])


def test_the_last_descent_counts_and_begins_a_step_before_it(grasp):
    offset, angle = descent(grasp)
    # The descent at 0.65 s is first seen at step 7; the tilt is that of step 6.
    place, _ = tool_at(grasp, 7)
    expected = np.hypot(*(place[:2] - [0.38, 0.4]))
    assert offset == pytest.approx(1e3 * expected)
    assert angle == pytest.approx(6.0, abs=1e-6)
    at = grasp_offset(grasp.cell.log, grasp.motion, grasp.world, "box", 0.3)
    place, _ = tool_at(grasp, 3)
    assert at == pytest.approx(np.hypot(*(place[:2] - [0.38, 0.4])))
    grasp.cell.log.events.clear()
    assert all(math.isnan(x) for x in descent(grasp))


def test_errors_of_the_image_jacobian_are_of_the_first_and_last_guided_step(grasp):
    log, found = grasp.cell.log, []
    for step in (2, 5):
        place, turn = tool_at(grasp, step)
        marker = place + turn.apply([0.0, 0.1, -0.05])
        h = 1e-6
        sides = [
            grasp.world.config.camera.project(marker + sign * h * np.eye(3)) for sign in (1, -1)
        ]
        true = ((sides[0] - sides[1]) / (2 * h)).T
        error = np.linalg.norm(log["image_jacobian"][step][:, :3] - true)
        found.append(error / np.linalg.norm(true))
    np.testing.assert_allclose(jacobian_errors(grasp), found, rtol=1e-5)
    grasp.cell.log = {"vision_activation": np.zeros(STEPS)}
    assert all(math.isnan(x) for x in jacobian_errors(grasp))


def test_an_object_is_lifted_while_both_fingers_hold_it(grasp):
    grasp.world.object_pose = lambda name: np.vstack([np.eye(4)[:2], [0, 0, 1, 0.25], [0] * 4])
    assert lift(grasp) == pytest.approx(0.25)
    grasp.world.holds = lambda name: False
    assert lift(grasp) == 0.0


def test_a_push_is_measured_from_its_first_step_to_the_end_of_the_interaction():
    k = np.arange(STEPS)
    hand = np.stack([0.001 * k**2, 0 * k, 0.3 + 0 * k], axis=-1)
    elbow = np.stack([0 * k, 0.002 * k**2, 0.5 + 0 * k], axis=-1)
    still = np.tile([1.0, 0, 0, 0], (STEPS, 1))
    motion: Any = Motion(hand=(hand, tilted(0.01 * k)), link4=(elbow, still))
    world: Any = SimpleNamespace(arm=SimpleNamespace(tool_offset=np.zeros(3)))

    def run(pushed):
        log = StepLog()
        log.event(0.1, INTERACT)
        log.event(0.7, "home")
        for i in range(STEPS):
            push = 0.5 * np.eye(7)[2] * pushed[i]
            log.append(time=0.1 * i, nullspace_input=push)
        return Deviation.of(log, motion, world)

    # Pushes before the phase do not count; afterwards the arm moves back.
    found = run([1, 0, -1, -1, 0, 0, 0, 1])
    within = (k >= 2) & (k < 7)
    np.testing.assert_allclose(
        found.position, np.where(within, 0.001 * np.abs(k**2 - 4), np.nan)
    )
    np.testing.assert_allclose(found.elbow, np.where(within, 0.002 * np.abs(k**2 - 4), np.nan))
    turned = np.where(within, 0.01 * np.abs(k - 2), np.nan)
    np.testing.assert_allclose(found.rotation, turned, atol=1e-9)
    none = run([1, 0, 0, 0, 0, 0, 0, 1])
    for values in (none.position, none.rotation, none.elbow):
        assert np.isnan(values).all()


@pytest.mark.parametrize(("count", "reach"), [(1, OBJECT_REACH[:2]), (3, OBJECTS_REACH)])
def test_objects_fill_their_part_of_the_table_and_keep_clear_of_each_other(count, reach):
    items = THREE_OBJECTS[:count]
    workplace = with_objects(WORKPLACE, items)
    config = SimpleNamespace(objects=items)
    world: Any = SimpleNamespace(config=config, table_top=0.013)
    rng, off, gaps, yaws = np.random.default_rng(0), [], [], []
    for _ in range(400 // count):
        poses = draw_object_poses(workplace, world, 0.3, rng)
        assert list(poses) == [item.name for item in items]
        places = np.array([pose[:2, 3] for pose in poses.values()])
        off.append(np.abs(places - workplace.table_centre).max(axis=0))
        pairs = np.linalg.norm(places[:, None] - places, axis=-1)
        gaps += pairs[np.triu_indices(count, 1)].tolist()
        yaws += [np.arctan2(pose[1, 0], pose[0, 0]) for pose in poses.values()]
        for item, pose in zip(items, poses.values(), strict=True):
            assert pose[2, 3] == pytest.approx(0.013 + item.half_size[2])
    largest = np.max(off, axis=0)
    assert (largest <= reach).all()
    assert (largest > 0.97 * np.array(reach)).all()
    assert 0.29 < max(yaws) <= 0.3
    assert -0.3 <= min(yaws) < -0.29
    if count > 1:
        assert 0.118 <= min(gaps) < 0.12


def test_a_camera_has_to_see_the_corners_about_objects_and_markers():
    world = World(WORKPLACE.scene)
    world.reset(WORKPLACE.hover_joints().numpy())
    points, hover = points_to_see(WORKPLACE, world), WORKPLACE.hover()
    usual = Rotation.from_quat(hover.orientation.numpy(), scalar_first=True)
    middles = [[*WORKPLACE.table_centre, WORKPLACE.scene.objects[0].half_size[2]]]
    for turn in np.linspace(*WORKPLACE.hover_turns, 7):
        offset = (Rotation.from_euler("z", turn) * usual).apply(world.hand_marker_offset())
        middles.append(hover.position.numpy() + offset)
    x, y = np.add(OBJECTS_REACH, 0.05)
    corners = [[-x, -y, 0], [-x, y, 0], [x, -y, 0], [x, y, 0]]
    expected = np.add(np.array(middles)[:, None], corners).reshape(-1, 3)
    np.testing.assert_allclose(points, expected, atol=1e-12)


def test_a_workplace_has_an_object_for_each_shelf():
    for count in (1, 2, 3):
        made = workplace_for(["lower", "middle", "upper"][:count], panda)
        assert made.scene.objects == THREE_OBJECTS[:count]
    waiting, hover = waiting_pose(WORKPLACE), WORKPLACE.hover()
    np.testing.assert_allclose(waiting.position - hover.position, (0.05, -0.16, 0.25))
    np.testing.assert_allclose(waiting.orientation, WORKPLACE.home().orientation)
