"""Single steps of a grasp on stand-ins of the cell: paths, heights, attempts, refusals."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from unchecked import shapes_unchecked

from hrc_learn.geometry import Pose
from hrc_learn.kinematics import UnreachableError, gripper_down, panda
from hrc_learn.skills import grasping
from hrc_learn.skills.grasping import (
    Grasping,
    GraspingConfig,
    GraspJob,
    UndetectedObjectError,
    _reachable_probe,
)
from hrc_learn.skills.placing import BlockedPathError, Plan, check_plan
from hrc_learn.skills.work_cell import MissedGraspError

pytestmark = pytest.mark.simulation

HERE, HOME = torch.zeros(7).double(), torch.ones(7).double()
POSTURES = [torch.full((7,), 2.0).double(), torch.full((7,), 3.0).double()]
NAMES = {0.0: "here", 1.0: "home", 2.0: "a", 3.0: "b"}


@pytest.fixture(autouse=True)
def _unchecked():
    """Stand-ins are not of the annotated types."""
    with shapes_unchecked():
        yield


def name(q):
    return NAMES[float(torch.as_tensor(q)[0])]


class Cell:
    """Keeps what it is asked to do."""

    def __init__(self):
        self.did: list[Any] = []
        self.joints, self.time = HERE, 0.0
        self.config = SimpleNamespace(dt=0.01, detect_every=3)
        self.tracked_markers: Any = (1,)
        self.load: Any = "load"
        self.pose = Pose(torch.tensor([0.4, 0.3, 0.5], dtype=torch.float64), gripper_down())
        self.contact: Any = None
        self.gripper = SimpleNamespace(move=lambda width: self.did.append(("fingers", width)))

    def begin_phase(self, phase):
        self.did.append(phase)

    def follow_path(self, path):
        self.did.append(path)

    def move_straight(self, goal, speed=None):
        self.did.append(("straight", float(goal.position[2])))

    def move_until_contact(self, goal):
        self.did.append(("feel", float(goal.position[2])))
        return self.contact


@pytest.fixture
def made(monkeypatch):
    """A grasp whose lines between postures are free or blocked, near objects or not."""
    task: Any = object.__new__(Grasping)
    task.blocked, task.near = set(), set()
    task._cell, task._size, task._config = Cell(), 0.5, GraspingConfig()
    task._workplace = SimpleNamespace(
        home_joints=lambda: HOME,
        hover_postures=lambda: POSTURES,
        hover=lambda: Pose(torch.zeros(3).double(), gripper_down()),
        hover_height=0.2,
        fingertip=0.01,
        palm=0.04,
    )
    task.servo = SimpleNamespace(orientation=lambda default: default)
    task._table = (0.0, 0.025)

    def plan(cell, start, goal):
        line = (name(start), name(goal))
        return SimpleNamespace(path=line)

    def check(plan):
        if plan.path in task.blocked:
            raise BlockedPathError("the table is in the way.")

    task._check = check
    monkeypatch.setattr(grasping, "joint_plan", plan)

    def free(start, goal, clearance=None):
        line = (name(start), name(goal))
        if clearance is not None:
            assert clearance == pytest.approx(0.5 * 0.06)
        return line not in task.blocked and (clearance is None or line not in task.near)

    task._free = free
    return task


DIRECT, TO_A, TO_B = ("here", "home"), ("here", "a"), ("here", "b")


@pytest.mark.parametrize(
    ("blocked", "near", "via"),
    [
        ((), (), None),
        ((), (DIRECT,), "a"),
        ((), (DIRECT, TO_A), "b"),
        ((), (DIRECT, TO_A, TO_B), None),  # near objects rather than not at all
        ((DIRECT,), (TO_A, TO_B), "a"),
        ((DIRECT, TO_A), (), "b"),
        ((DIRECT, ("a", "home")), (), "b"),
    ],
)
def test_the_way_home_keeps_away_from_objects_if_any_way_does(made, blocked, near, via):
    made.blocked, made.near = set(blocked), set(near)
    made.move_joints = lambda goal: made._cell.did.append(("on to", name(goal)))
    made.go_home()
    ways = [("here", via)] if via else []
    assert made._cell.did == ["home", *ways, ("on to", "home")]


def test_a_posture_above_the_table_is_free_both_ways_or_the_arm_goes_home_first(made):
    went = []
    made.go_home = lambda: went.append("home")
    assert name(made._posture()) == "a"
    made.blocked = {("a", "home")}
    assert name(made._posture()) == "b"
    made.blocked, made.near = set(), {TO_A, TO_B}
    assert went == []
    assert name(made._posture()) == "a"
    assert went == ["home"]


def test_a_blocked_line_is_not_followed(made):
    made.move_joints(HOME)
    assert made._cell.did == [DIRECT]
    made.blocked = {DIRECT}
    with pytest.raises(BlockedPathError):
        made.move_joints(HOME)
    assert made._cell.did == [DIRECT]


@pytest.mark.parametrize(
    ("distance", "blocked", "refused"),
    [
        (0.0301, False, ""),
        (0.0299, False, "too close to objects on the table"),
        (1.0, True, "on the path there, the table is in the way"),
        (None, False, "the arm does not reach there with this orientation"),
    ],
)
def test_a_pose_is_refused_with_its_reason(made, distance, blocked, refused):
    def inverse(pose, *, near, samples):
        if distance is None:
            raise UnreachableError("too far")
        return HOME

    made._workplace.robot = SimpleNamespace(inverse=inverse)
    made._to_objects = lambda q: torch.tensor(distance)
    made.blocked = {DIRECT} if blocked else set()
    assert made.refusal(made._cell.pose) == refused


@pytest.mark.parametrize("clearance", [None, 0.05])
@pytest.mark.parametrize(("distance", "free"), [(0.0501, True), (0.05, False)])
def test_a_line_is_free_if_each_fifth_sample_is_clear(
    made, monkeypatch, clearance, distance, free
):
    del made._free
    path = np.arange(12.0)[:, None] * np.ones(7)
    monkeypatch.setattr(grasping, "joint_plan", lambda *given: SimpleNamespace(path=path))
    made._check = lambda plan: None
    asked = []

    def to_objects(q):
        asked.append(q[:, 0].tolist())
        return torch.tensor([1.0, distance, 1.0], dtype=torch.float64)

    made._to_objects = to_objects
    assert made._free(HERE, HOME, clearance) == (clearance is None or free)
    assert asked == ([] if clearance is None else [[0.0, 5.0, 10.0]])

    def check(plan):
        raise BlockedPathError("blocked")

    made._check = check
    assert not made._free(HERE, HOME, clearance)


@pytest.mark.parametrize(("half", "reach"), [(0.02, 0.01), (0.03, 0.02)])
@pytest.mark.parametrize("touches", [True, False])
def test_the_table_is_felt_for_about_where_it_is_expected(made, half, reach, touches):
    """The fingers reach 1 cm below the tool; a tall object meets the palm before."""
    item: Any = SimpleNamespace(half_size=(0.02, 0.03, half))
    made._table = (0.1, 0.02)
    met = Pose(torch.tensor([0.4, 0.3, 0.137], dtype=torch.float64), gripper_down())
    made._cell.contact = met if touches else None
    made._touch_table(item)
    (_, above), (_, below) = made._cell.did
    assert above == pytest.approx(0.1 + reach + 0.02)
    assert below == pytest.approx(0.1 + reach - 0.02)
    if touches:
        assert made._table == pytest.approx((0.137 - reach, 0.5 * 0.015))
    else:
        assert made._table == (0.1, 0.02)


def test_the_tool_descends_along_its_own_axis(made):
    turn = torch.tensor([0.0, 0.98, 0.0, 0.199], dtype=torch.float64)
    made.servo.orientation = lambda default: turn / turn.norm()
    pose = made._at_height(0.1)
    assert float(pose.position[2]) == pytest.approx(0.1)
    axis = Rotation.from_quat((turn / turn.norm()).numpy(), scalar_first=True).apply([0, 0, 1])
    way = (pose.position - made._cell.pose.position).numpy()
    np.testing.assert_allclose(np.cross(way, axis), 0.0, atol=1e-12)
    assert way @ axis > 0


@pytest.mark.parametrize("held", [True, False])
def test_fingers_that_close_on_nothing_forget_the_table(made, monkeypatch, held):
    item: Any = SimpleNamespace(half_size=(0.02, 0.03, 0.025), name="box")
    made._touch_table = lambda item: setattr(made, "_table", (0.3, 0.001))
    monkeypatch.setattr(grasping, "move_fingers", lambda *given: made._cell.did.append("close"))
    monkeypatch.setattr(grasping, "holds", lambda cell, item: held)
    monkeypatch.setattr(grasping, "as_load", lambda item: f"load {item.name}")
    if held:
        made.close_on(item)
        assert made._cell.load == "load box"
        assert made._table == (0.3, 0.001)
    else:
        with pytest.raises(MissedGraspError, match=r"closed on nothing.*'box'"):
            made.close_on(item)
        assert made._table == pytest.approx((0.0, 0.5 * 0.05))
    assert made._cell.did[0] == "grasp"
    assert made._cell.did[1] == ("straight", pytest.approx(0.325))
    assert made._cell.tracked_markers == ()


@pytest.mark.parametrize(("height", "lifts"), [(0.19, True), (0.21, False)])
def test_a_low_tool_is_lifted_before_it_goes_home(made, monkeypatch, height, lifts):
    moved = []
    monkeypatch.setattr(grasping, "move_fingers", lambda cell, *given: moved.append(given))
    made._cell.pose.position[2] = height
    made.go_home = lambda: made._cell.did.append("went home")
    made.start_over()
    assert made._cell.load is None
    assert made._cell.tracked_markers == ()
    expected = ["lift", ("straight", pytest.approx(height + 0.5 * 0.20))] if lifts else []
    assert made._cell.did == [*expected, "went home"]
    assert moved == [(grasping.OPEN, 0.3)]


@pytest.mark.parametrize(("misses", "attempts"), [(0, 1), (1, 2), (2, 3), (3, None)])
@pytest.mark.parametrize("wait", [0.3, 0.31])
def test_a_grasp_is_tried_three_times_and_each_mishap_is_noted(made, misses, attempts, wait):
    notes, left = [], [misses]

    def locate(item):
        made._cell.time += wait
        return "target"

    def close_on(item):
        if left[0]:
            left[0] -= 1
            raise MissedGraspError("closed on nothing")

    made.locate, made.close_on = locate, close_on
    made._aim = lambda job, target: None
    made.note = lambda job, mishap, what: notes.append(mishap)
    made.start_over = lambda: made._cell.did.append("start over")
    made.lift = lambda: made._cell.did.append("lift")
    job: Any = GraspJob(item=SimpleNamespace(name="box"))
    if attempts is None:
        with pytest.raises(MissedGraspError):
            made.grasp(job)
        assert "lift" not in made._cell.did
    else:
        made.grasp(job)
        assert job.attempts == attempts
        assert job.picked_up is made._cell.pose
        assert made._cell.did[-1] == "lift"
    assert made._cell.did.count("start over") == min(misses, 2)
    assert notes.count("missed grasp") == misses
    tries = min(misses + 1, 3)
    assert notes.count("object not detected") == (tries if wait > 0.3 else 0)


@dataclass
class Target:
    posture: Any = "above"


@pytest.mark.parametrize(
    ("time", "off", "postures"),
    [(0.0, 9.0, ["above"]), (2.0, 1.99, ["above"]), (2.0, 2.01, ["above", None])],
)
def test_after_time_for_a_person_it_servos_again_if_it_was_pushed_away(
    made, time, off, postures
):
    """Errors are multiples of the tolerance."""
    servoed, held = [], []
    error = off * made._config.servo.tolerance
    made._servo = lambda job, target: servoed.append(target.posture)
    made.servo.hold = lambda target, duration: held.append(duration)
    made.servo.error = lambda target: error
    made.locate, made.close_on, made.lift = lambda item: Target(), lambda item: None, list
    job: Any = GraspJob(item=SimpleNamespace(name="box"), time_for_person=time)
    made.grasp(job)
    assert servoed == postures
    assert held == [time] * (time > 0)
    assert job.time_for_person == 0.0  # another attempt gives none
    assert job.pixel_error == error


@pytest.mark.parametrize(
    ("reached", "expected"), [(1.0, 1.0), (0.8, 0.75), (0.5, 0.5), (0.3, 0.25), (0.1, 0.25)]
)
def test_a_probe_is_as_high_as_the_arm_reaches_over_all_objects(reached, expected):
    """Up to a fraction of its height the arm reaches the four corners."""
    hover = Pose(torch.tensor([0.4, 0.3, 0.2], dtype=torch.float64), gripper_down())
    half = torch.tensor([0.1, 0.08, 0.0], dtype=torch.float64)
    asked = []

    def inverse(pose, near):
        asked.append(pose.position)
        if float(pose.position[0, 2]) > 0.2 + reached * 0.12 + 1e-9:
            raise UnreachableError("too high")
        return panda.ready.expand(4, 7)

    workplace: Any = SimpleNamespace(
        robot=SimpleNamespace(inverse=inverse, limits=panda.limits),
        hover=lambda: hover,
        hover_joints=lambda: panda.ready,
        object_region=lambda: (None, half),
    )
    assert _reachable_probe(workplace, 0.12) == pytest.approx(0.12 * expected)
    corners = asked[0][:, :2] - hover.position[:2]
    assert {tuple(c) for c in (corners / half[:2]).round().int().tolist()} == {
        (1, 1),
        (1, -1),
        (-1, 1),
        (-1, -1),
    }


@pytest.mark.parametrize(("margin", "fits"), [(0.11, True), (0.09, False)])
def test_a_probe_keeps_a_tenth_of_a_radian_from_joint_limits(margin, fits):
    hover = Pose(torch.tensor([0.4, 0.3, 0.2], dtype=torch.float64), gripper_down())
    for limit, side in ((panda.limits.upper, -1), (panda.limits.lower, 1)):
        q = panda.ready.clone()
        q[3] = limit[3] + side * margin
        workplace: Any = SimpleNamespace(
            robot=SimpleNamespace(
                inverse=lambda pose, near, q=q: q.expand(4, 7), limits=panda.limits
            ),
            hover=lambda: hover,
            hover_joints=lambda: panda.ready,
            object_region=lambda: (None, torch.tensor([0.1, 0.08, 0.0], dtype=torch.float64)),
        )
        assert _reachable_probe(workplace, 1.0) == (1.0 if fits else 0.25)


@pytest.mark.parametrize("beyond", [0.0, 1e-9])
def test_a_plan_may_end_at_a_joint_limit_but_not_beyond(beyond):
    world: Any = SimpleNamespace(collisions_along=lambda *given: [])
    for limit, side in ((panda.limits.lower, -1.0), (panda.limits.upper, 1.0)):
        path = np.tile(panda.ready.numpy(), (5, 1))
        path[3, 2] = float(limit[2]) + side * beyond
        plan = Plan(goal=Pose(HERE[:3], gripper_down()), dt=50.0, path=path, chain=panda)
        if beyond:
            with pytest.raises(BlockedPathError, match=r"panda_joint3 after 150\.0 s"):
                check_plan(plan, world, None)
        else:
            check_plan(plan, world, None)


class Look:
    """A clock, and a camera that sees an object from one time on, or never."""

    def __init__(self, cell, seen_from):
        self._cell, self.seen_from, self.looks = cell, seen_from, []
        cell.wait_for_detection, cell.hold_pose = self.detect, self.hold

    def detect(self):
        self.looks.append(self._cell.time)
        seen = {4: "another"}
        if self._cell.time >= self.seen_from - 1e-9:
            seen[11] = SimpleNamespace(pixel=np.array([640.0, 500.0]), angle=0.3)
        return SimpleNamespace(features=seen)

    def hold(self, duration):
        self._cell.time += duration


BOX: Any = SimpleNamespace(name="box", marker=SimpleNamespace(id=11))


@pytest.mark.parametrize(("seen_from", "looks"), [(0.0, 1), (0.06, 3), (9.0, 5)])
def test_an_object_is_looked_for_until_the_timeout_at_the_rate_of_images(
    made, seen_from, looks
):
    """An image every third step of 10 ms; the last one is taken at the timeout itself."""
    made._config = GraspingConfig(detection_timeout=0.12)
    look = Look(made._cell, seen_from)
    found = made._detect(BOX)
    assert (found is None) == (seen_from > 1.0)
    np.testing.assert_allclose(look.looks, 0.03 * np.arange(looks), atol=1e-9)
    assert made._cell.did == ["detect"]


@pytest.fixture
def looking(made):
    """A grasp that locates an object; the arm is 1 rad away from home."""
    made._config = GraspingConfig(detection_timeout=0.06)
    made._visual, made._cell.config.after_push = "visual target", "return"
    made._workplace.hover_turns = (-0.5, 0.5)
    made._posture = lambda: POSTURES[0]
    made.homeward = []
    made.go_home = lambda: made.homeward.append(made._cell.time)
    return made


@pytest.mark.parametrize(("after_push", "rests"), [("return", True), ("stay", False)])
def test_a_located_object_is_the_target_and_the_arm_stays_where_it_is(
    looking, after_push, rests
):
    looking._cell.config.after_push = after_push
    Look(looking._cell, 0.0)
    target = looking.locate(BOX)
    np.testing.assert_array_equal(target.item, [640.0, 500.0])
    assert (target.angle, target.visual, target.turn_range) == (
        0.3,
        "visual target",
        (-0.5, 0.5),
    )
    assert target.posture is POSTURES[0]
    assert target.rest is (POSTURES[0] if rests else None)
    assert looking.homeward == []


@pytest.mark.parametrize(("away", "goes"), [(0.04, False), (-0.06, True), (0.06, True)])
def test_an_arm_that_may_hide_the_object_goes_home_and_looks_again(looking, away, goes):
    """One joint, in either direction; an arm at home hides nothing."""
    joints = HOME.clone()
    joints[3] += away
    looking._cell.joints = joints
    look = Look(looking._cell, 99.0)
    looking.go_home = lambda: (
        looking.homeward.append(looking._cell.time),
        setattr(look, "seen_from", 0.0),
    )
    if goes:
        assert looking.locate(BOX).angle == 0.3
    else:
        with pytest.raises(UndetectedObjectError, match="does not see marker 11 of 'box'"):
            looking.locate(BOX)
    assert len(looking.homeward) == goes
    assert looking._cell.did == ["detect"] * (1 + goes)


def test_an_object_out_of_view_is_named_with_what_to_do(looking):
    Look(looking._cell, 99.0)
    with pytest.raises(UndetectedObjectError, match=r"Move the object into the camera's view"):
        looking.locate(BOX)
    assert len(looking.homeward) == 1


@pytest.mark.parametrize(("occluded", "noted"), [(0.25, []), (0.35, ["marker occluded"])])
def test_an_occlusion_of_more_than_a_few_images_is_noted(made, monkeypatch, occluded, noted):
    asked = []
    monkeypatch.setattr(
        grasping,
        "longest_occlusion",
        lambda log, pose, start, chain: asked.append(start) or occluded,
    )
    made._workplace.tool_marker = 7
    made._cell.log = made._cell.chain = None
    made._cell.time = 2.5
    made.servo.servo_to = lambda target: 1.75
    job = GraspJob(item=BOX)
    made._servo(job, "target")
    assert job.servo_time == 1.75
    assert [note.mishap for note in job.recoveries] == noted
    assert made._cell.tracked_markers == (7,)
    assert made._cell.did == ["servo"]
    assert asked == [2.5]
