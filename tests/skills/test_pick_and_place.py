"""Phases of pick-and-place: what follows when a path is blocked or an object lost."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from hrc_learn.geometry import Pose
from hrc_learn.skills import WorkCellConfig, pick_and_place
from hrc_learn.skills.grasping import GraspingConfig
from hrc_learn.skills.pick_and_place import (
    BlockedPathError,
    MissedGraspError,
    PickAndPlace,
    PickAndPlaceConfig,
    TaskFailedError,
    UndetectedObjectError,
)
from hrc_learn.skills.receiving import ReceivingConfig
from hrc_learn.skills.visual_servoing import VisualServoConfig

pytestmark = pytest.mark.simulation

DOWN = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64)
SHELF = Pose(torch.tensor([0.5, 0.0, 0.6], dtype=torch.float64), DOWN)
TABLE = Pose(torch.tensor([0.3, 0.4, 0.1], dtype=torch.float64), DOWN)
ITEM = SimpleNamespace(name="box", half_size=(0.02, 0.02, 0.04))
PATHS = [np.arange(5.0), np.arange(5.0, 11.0)]
CONFIG = PickAndPlaceConfig(
    grasping=GraspingConfig(attempts=3), interaction=7.0, waits=3, wait=1.5
)
STRAIGHT = ["transfer", "release", "retreat", "done"]


class Scene:
    """Cell, grasping and workplace in one, with a list of what happens.

    Attributes:
        held: Answers to whether the object is in the hand; then True.
        blocked: Numbers of candidate plans that are not free, for each look; then none.
        home: Number of times that the way home is blocked.
        grasps: Errors of the next grasps.
    """

    def __init__(self):
        self.did, self.phases, self.held, self.blocked = [], [], [], []
        self.home, self.grasps, self.number, self.time = 0, [], 0, 0.0
        self.pose, self.joints, self.config = TABLE, None, SimpleNamespace(dt=0.01)
        self.gripper = SimpleNamespace(move=lambda width: self.did.append(("open", width)))
        self.robot = SimpleNamespace(inverse=self._inverse, hand_size=1.0)
        self.joint = SimpleNamespace(goal=None)
        self.load = ITEM

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return lambda *values, **_: self.did.append((name, *values))

    def _inverse(self, goal, near):
        return "posture"

    def begin_phase(self, name):
        self.phases.append(name)

    def follow_path(self, path, until=lambda: False):
        self.did.append(("follow", *path))
        return next((k for k in range(len(path)) if until()), len(path))

    def hold_pose(self, duration):
        self.time += duration
        self.did.append(("wait", duration))

    def holds(self, *_):
        return self.held.pop(0) if self.held else True

    def candidates(self, *_, **__):
        self.looked = self.blocked.pop(0) if self.blocked else ()
        for k, path in enumerate(PATHS):
            yield SimpleNamespace(path=path, goal=SHELF, number=k)

    def check(self, plan):
        if plan.number in self.looked:
            raise BlockedPathError(f"way {plan.number} is blocked")

    def grasp(self, job):
        if self.grasps and (error := self.grasps.pop(0)) is not None:
            raise error
        job.picked_up = TABLE

    def go_home(self):
        if self.home:
            self.home -= 1
            raise BlockedPathError("a person")

    def shelf(self, *_):
        return SHELF

    def lowering(self, *_):
        return 0.03

    def hover_joints(self):
        return "hover"

    def names(self):
        return [name for name, *_ in self.did]

    def notes(self):
        return [tuple(values[1:]) for name, *values in self.did if name == "note"]


@pytest.fixture
def scene(monkeypatch):
    scene = Scene()
    monkeypatch.setattr(pick_and_place, "Grasping", lambda *_, **__: scene)
    monkeypatch.setattr(pick_and_place, "holds", scene.holds)
    monkeypatch.setattr(pick_and_place, "plan_candidates", scene.candidates)
    monkeypatch.setattr(
        pick_and_place,
        "move_fingers",
        lambda cell, *values: scene.did.append(("hand", *values)),
    )
    return scene


def run(scene, orders=1, receiving=None):
    work = PickAndPlace(scene, scene, scene, scene, scene.check, CONFIG, receiving)
    return work.run([(ITEM, "upper")] * orders)


def test_an_object_is_carried_put_down_and_left_along_the_same_path(scene):
    (job,) = run(scene)
    assert scene.phases == STRAIGHT
    assert (job.failure, job.attempts, scene.notes()) == ("", 1, [])
    ways = [values for name, *values in scene.did if name == "follow"]
    assert ways == [PATHS[0].tolist(), PATHS[0][::-1].tolist()]
    straight, below = (
        next(values[0] for name, *values in scene.did if name == kind)
        for kind in ("move_straight", "move_until_contact")
    )
    assert straight is SHELF
    np.testing.assert_allclose(below.position, SHELF.position - torch.tensor([0, 0, 0.03]))
    assert scene.load is None
    assert "hand" in scene.names()
    assert job.release is scene.pose


@pytest.mark.parametrize("size", [0.5, 1.0])
def test_an_object_is_put_down_and_the_hand_goes_back_by_its_size(scene, size):
    scene.time, goal = 4.0, Pose(SHELF.position + 0.01, DOWN)
    plan = SimpleNamespace(path=PATHS[0])
    assert pick_and_place.place_along(scene, plan, goal, 0.03, size) == 4.0
    assert scene.phases == ["transfer", "release", "retreat"]
    steps = "follow move_straight move_until_contact hand move_straight"
    assert scene.names() == steps.split()
    reached, below, _, back = (values[0] for name, *values in scene.did[1:])
    assert reached is goal
    heights = [float(pose.position[2] - goal.position[2]) for pose in (below, back)]
    assert heights == pytest.approx([-0.03, 0.08 * size])
    torch.testing.assert_close(back.position[:2], goal.position[:2])
    assert scene.load is None


def test_a_person_has_time_at_the_first_objects_only(scene):
    jobs = run(scene, orders=3)
    assert [job.time_for_person for job in jobs] == [7.0, 0.0, 0.0]
    assert scene.phases == 3 * STRAIGHT[:-1] + ["done"]


@pytest.mark.parametrize(
    ("held", "phases", "what"),
    [
        ([False], [], "lost on the way up"),
        ([True, False], [], "lost on the way home"),
        ([True, True, True, True, False], ["transfer"], "lost on the way to the shelf"),
    ],
)
def test_an_object_that_is_lost_is_grasped_again(scene, held, phases, what):
    scene.held = held
    (job,) = run(scene)
    assert (job.failure, job.attempts) == ("", 2)
    assert scene.notes() == [("dropped object", what)]
    assert scene.names().count("start_over") == 1
    assert scene.phases == phases + STRAIGHT
    if phases:  # back along what it had gone of its path
        assert ("follow", 1.0, 0.0) in scene.did


def test_attempts_are_bounded(scene):
    scene.held = [False] * 10
    (job,) = run(scene)
    assert (job.failure, job.attempts) == ("lost on the way up", 3)
    assert scene.phases == ["done"]


@pytest.mark.parametrize(
    ("error", "starts_over"), [(MissedGraspError, 1), (UndetectedObjectError, 0)]
)
def test_an_object_that_cannot_be_had_stays_and_the_next_is_begun(scene, error, starts_over):
    scene.grasps = [error("not there")]
    first, second = run(scene, orders=2)
    assert (first.failure, second.failure) == ("not there", "")
    assert scene.names().count("start_over") == starts_over
    assert scene.phases == STRAIGHT


@pytest.mark.parametrize("times", [1, 3, 4])
def test_a_blocked_way_home_is_waited_for_and_then_the_object_put_back(scene, times):
    scene.home = times
    (job,) = run(scene)
    assert scene.notes() == [("blocked path", "waited: a person")] * times
    assert scene.time == 1.5 * times
    if times < 4:
        assert (job.failure, scene.phases) == ("", STRAIGHT)
        return
    assert job.failure == "home: the path stayed blocked"
    assert scene.phases == ["put back", "done"]
    above, there = (values[0] for name, *values in scene.did if name == "move_straight")
    np.testing.assert_allclose(
        above.position - TABLE.position, [0, 0, CONFIG.grasping.lift], atol=1e-12
    )
    assert there is TABLE
    assert ("move_joints", "hover") in scene.did
    assert scene.names().count("start_over") == 1


def test_another_path_is_taken_where_the_learned_one_is_blocked(scene):
    scene.blocked = [(0,)]
    (job,) = run(scene)
    np.testing.assert_array_equal(job.plan.path, PATHS[1])
    assert scene.notes() == [("blocked path", "way 0 is blocked")]
    assert scene.time == 0.0


@pytest.mark.parametrize("times", [1, 3, 4])
def test_paths_to_a_shelf_are_waited_for_and_then_the_object_put_back(scene, times):
    scene.blocked = [(0, 1)] * times
    (job,) = run(scene)
    assert scene.time == 1.5 * min(times, 3)
    assert len(scene.notes()) == times
    if times < 4:
        assert job.failure == ""
        return
    assert job.failure == "transfer: all paths to the upper shelf stayed blocked"
    assert job.plan is None
    assert scene.phases == ["transfer", "put back", "done"]


def receiving(scene, error=None):
    """A skill by which a person hands the object over."""

    def receive(item):
        scene.did.append(("receive", item.name))
        if error is not None:
            raise error

    return {
        "box": SimpleNamespace(
            receipt="receipt",
            wait=TABLE,
            receive=receive,
            wait_until_away=lambda: scene.did.append(("away",)),
        )
    }


def test_an_object_is_received_instead_of_grasped_and_kept_if_it_cannot_be_placed(scene):
    (job,) = run(scene, receiving=receiving(scene))
    assert scene.phases == ["receive", *STRAIGHT]
    assert job.receipt == "receipt"
    order = [
        name for name in scene.names() if name in ("open", "move_joints", "receive", "away")
    ]
    assert order == ["open", "move_joints", "receive", "away"]
    scene.phases.clear()
    scene.home = 9
    (job,) = run(scene, receiving=receiving(scene))
    assert job.failure == "home: the path stayed blocked"
    assert scene.phases == ["receive", "done"]  # it has no place on the table
    scene.home, scene.held = 0, [False]
    (job,) = run(scene, receiving=receiving(scene))
    assert (job.failure, job.attempts) == ("lost on the way up", 1)


def test_a_hand_over_that_fails_starts_over(scene):
    (job,) = run(scene, receiving=receiving(scene, MissedGraspError("the hand was empty")))
    assert job.failure == "the hand was empty"
    assert scene.phases == ["receive", "done"]
    assert scene.names().count("start_over") == 1


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"home": 4}, "home: the path stayed blocked"),
        ({"grasps": [MissedGraspError("missed")]}, "missed"),
        ({"held": [False] * 3}, "lost on the way up"),
    ],
)
def test_the_first_reason_is_kept_if_going_back_fails_too(scene, settings, reason):
    vars(scene).update(settings)
    last = 3 if reason == "lost on the way up" else 1

    def start_over():
        if scene.names().count("start_over") == last - 1:
            raise BlockedPathError("a person is at home")
        scene.did.append(("start_over",))

    scene.start_over = start_over
    (job, *rest) = run(scene, orders=2)
    assert (job.failure, rest) == (f"{reason}; then a person is at home", [])


def test_an_arm_that_cannot_go_on_ends_the_run(scene):
    scene.grasps = [None, TaskFailedError("the arm cannot go home")]
    jobs = run(scene, orders=3)
    assert [job.failure for job in jobs] == ["", "the arm cannot go home"]
    assert scene.phases == STRAIGHT


@pytest.mark.parametrize(
    ("config", "name"),
    [
        (WorkCellConfig, "detect_every"),
        (VisualServoConfig, "max_probes"),
        (GraspingConfig, "attempts"),
        (ReceivingConfig, "attempts"),
        (PickAndPlaceConfig, "speed"),
    ],
)
def test_settings_with_which_no_job_would_end_are_refused(config, name):
    with pytest.raises(ValueError, match=f"{name} must be positive, but is 0"):
        config(**{name: 0})
