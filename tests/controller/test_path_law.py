"""The law of joint paths and tracked poses, against its equations in NumPy, arm by arm."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from projections import null_space_projector
from scipy.spatial.transform import Rotation

from hrc_learn.controller import Distances
from hrc_learn.controller.arm_loop import ArmLoop
from hrc_learn.controller.arm_loop_state import (
    ArmLoopConfig,
    ArmReading,
    FollowPath,
    WatchedPeople,
)
from hrc_learn.controller.joint_path import JointPaths
from hrc_learn.controller.path_law import PathLaw
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import panda

DT, DELAY, GAIN = 0.01, 0.03, 4.0
Q = torch.tensor([0.4, 0.2, -0.3, -2.2, 0.1, 2.4, 0.6], dtype=torch.float64)
SLOPE = np.array([0.3, -0.2, 0.1, 0.2, -0.1, 0.15, -0.3])
CURVE = np.array([-0.1, 0.1, 0.2, -0.1, 0.1, 0.0, 0.2])
SAMPLES = 200


def law(clearance=None, **settings):
    config = ArmLoopConfig(dt=DT, command_delay=DELAY, pose_gain=GAIN, **settings)
    return PathLaw(panda, config, clearance)


def path_point(sample):
    """Joint positions and velocities of a parabola, of which differences are exact."""
    t = DT * np.asarray(sample)[..., None]
    return Q.numpy() + SLOPE * t + CURVE * t**2, SLOPE + 2 * CURVE * t


PATHS = JointPaths.of(
    panda, [Q.numpy()[None].copy(), path_point(np.arange(SAMPLES))[0]], DT
)  # the first rests


def state_of(rows, **path):
    """Arms that follow the second path; every value may differ from arm to arm."""
    q = Q.expand(rows, 7).clone()
    state = ArmLoop(panda).initial_state(q)
    values = {
        name: torch.as_tensor(value, dtype=getattr(state.path, name).dtype).expand(rows)
        for name, value in ({"followed": True, "last": SAMPLES - 1} | path).items()
    }
    return replace(state, path=replace(state.path, **values))


def people():
    """A person far from one arm."""
    one = torch.ones(1, dtype=torch.float64)
    far = Distances(
        distance=5.0 * one[:, None],
        gradient=torch.zeros(1, 1, 7, dtype=torch.float64),
        approach_speed=0.0 * one[:, None],
        person=torch.ones(1, 1, dtype=torch.bool),
    )
    return WatchedPeople(
        distances=far, nearest=5.0 * one, age=0.0 * one, speed_scale=one, speed_cap=9.0 * one
    )


def reading_at(q, **values):
    pose, jacobian = panda.forward_and_jacobian(q)
    still = torch.zeros_like(q)
    reading = ArmReading(
        joint_position=q,
        pose=pose,
        jacobian=jacobian,
        nullspace_input=still,
        pause=still[..., 0] > 0,
        explain=True,
    )
    return replace(reading, **values)


def null_unit(q):
    """Unit vector of the null space, of one sign along the path."""
    unit = np.linalg.svd(panda.jacobian(q).numpy())[2][..., 6, :]
    return torch.from_numpy(unit * np.sign(unit[..., :1]))


def test_a_pose_is_tracked_by_the_pseudo_inverse_where_the_arm_is_after_its_delay():
    rng = np.random.default_rng(0)
    q = Q + 0.1 * torch.from_numpy(rng.normal(size=(3, 7)))
    moving = torch.from_numpy(rng.normal(0, 0.3, (3, 7)))
    twist = torch.from_numpy(rng.normal(0, 0.02, (3, 6)))
    null = torch.from_numpy(rng.normal(0, 0.02, (3, 7)))
    here = panda.forward(q)
    turns = Rotation.from_rotvec(rng.normal(0, 0.01, (3, 3)))
    shift = torch.from_numpy(rng.normal(0, 0.005, (3, 3)))
    turned = quaternion.multiply(
        torch.from_numpy(np.roll(turns.as_quat(), 1, axis=-1)), here.orientation
    )
    state = state_of(3)
    state = replace(state, safety=replace(state.safety, velocity=moving))
    which = torch.tensor([True, False, True])
    found = law(lambda q: 1.0 + 0 * q[..., 0]).track(
        state,
        reading_at(q),
        Pose(here.position + shift, turned),
        twist,
        null,
        which,
        slows=False,
    )
    J = panda.jacobian(q + DELAY * moving).numpy()
    correction = np.concatenate([shift.numpy(), turns.as_rotvec()], axis=-1)
    task = np.einsum("bij,bj->bi", np.linalg.pinv(J), twist.numpy() + GAIN * correction)
    rest = np.einsum("bij,bj->bi", null_space_projector(torch.from_numpy(J)).numpy(), null)
    expected = torch.where(which[:, None], torch.from_numpy(task + rest), 0.0)
    torch.testing.assert_close(found.joint_velocity, expected, rtol=0, atol=1e-9)
    ones = torch.ones(3, dtype=torch.float64)
    for kept in (found.slowdown, found.clear, found.within):
        torch.testing.assert_close(kept, ones)
    torch.testing.assert_close(found.distance, ones.masked_fill(~which, math.inf))
    assert not found.blocked.any()


@pytest.mark.parametrize("outward", [True, False])
def test_the_null_space_leaves_the_task_its_margin_before_a_joint_limit(outward):
    """The last 0.1 rad before the filter's margin belong to the task."""
    config = law().config
    joint = int(null_unit(Q).abs().argmax())
    q = Q.clone()
    q[joint] = panda.limits.upper[joint] - config.safety.margin - 0.5 * config.limit_margin
    unit = null_unit(q)
    unit = unit * unit[joint].sign() * (1 if outward else -1)
    state, still = state_of(1), torch.zeros(1, 6, dtype=torch.float64)
    here, every = panda.forward(q[None]), torch.tensor([True])
    argument = (state, reading_at(q[None]), here, still, 0.1 * unit[None], every)
    tracked = law().track(*argument, slows=False)
    speed = float(tracked.joint_velocity @ unit)
    assert speed == pytest.approx(0.0 if outward else 0.1, abs=1e-9)
    assert float(tracked.within) == pytest.approx(0.0 if outward else 1.0, abs=1e-9)
    if outward:
        assert int(tracked.joint) == joint
    # Without the margin it goes on.
    free = law(limit_margin=0.0).track(*argument, slows=False)
    assert float(free.joint_velocity @ unit) == pytest.approx(0.1)


def test_a_task_alone_counts_as_blocked_by_obstacles_only_where_the_null_space_moves():
    """A push may not be followed; a task without one is the planner's business."""
    q, still = Q.expand(2, 7), torch.zeros(2, 6, dtype=torch.float64)
    twist = still + torch.tensor([0.1, 0, 0, 0, 0, 0], dtype=torch.float64)
    null = torch.stack([torch.zeros(7, dtype=torch.float64), 0.1 * null_unit(Q)])
    start = panda.forward(Q).position[0]

    def nearer(joints):
        return 0.02 - (panda.forward(joints).position[..., 0] - start)

    every = torch.tensor([True, True])
    argument = (state_of(2), reading_at(q), panda.forward(q), twist, null, every)
    tracked = law(nearer).track(*argument, slows=False)
    assert tracked.blocked.tolist() == [False, True]
    torch.testing.assert_close(tracked.distance, torch.full((2,), 0.02, dtype=torch.float64))


def test_a_push_towards_an_obstacle_is_followed_until_the_clearance_is_reached():
    """Within the 0.15 s that are looked ahead, but for sliding at 2 mm/s; away it is free."""
    unit, q = null_unit(Q), Q.expand(3, 7)
    null = 0.1 * unit * torch.tensor([[1.0], [-1.0], [0.0]])

    def clearance(joints):
        return 0.031 - 0.3 * (joints - Q) @ unit

    still, every = torch.zeros(3, 6, dtype=torch.float64), torch.ones(3, dtype=torch.bool)
    argument = (state_of(3), reading_at(q), panda.forward(q), still, null, every)
    tracked = law(clearance).track(*argument, slows=False)
    kept = torch.tensor([(0.001 + 0.15 * 0.002) / (0.3 * 0.1 * 0.15), 1.0, 1.0]).double()
    torch.testing.assert_close(tracked.clear, kept)
    torch.testing.assert_close(tracked.joint_velocity, kept[:, None] * null)
    torch.testing.assert_close(tracked.distance, torch.full((3,), 0.031).double())
    assert not tracked.blocked.any()


@pytest.mark.simulation
def test_a_lasting_push_does_not_hold_joints_on_a_path_past_an_obstacle():
    """The path was planned past the obstacle, with less clearance than a push may use."""
    nearer = torch.from_numpy(SLOPE / np.linalg.norm(SLOPE)) + null_unit(Q)

    def clearance(q):
        return 0.02 - 0.01 * (q - Q) @ nearer

    arm = ArmLoop(panda, ArmLoopConfig(dt=DT, command_delay=DELAY, pose_gain=GAIN), clearance)
    request = FollowPath(paths=PATHS, path=torch.tensor([1]))

    def largest_deviation(effort):
        q, worst = Q[None].clone(), 0.0
        state = arm.path_law.begin(arm.initial_state(q), q, request)
        for _ in range(2 * SAMPLES):
            push = effort * null_unit(q)
            command, state, _ = arm.step(state, reading_at(q, nullspace_input=push), request)
            q = q + DT * command
            off = panda.forward(q).position - panda.forward(state.path.goal).position
            worst = max(worst, float(off.norm()))
            if bool(state.path.finished):
                return worst
        raise AssertionError("the path was not finished")

    # The arm of this test follows without the delay for which the law compensates.
    assert largest_deviation(3.0) < largest_deviation(0.0) + 1e-3


@pytest.mark.parametrize("pushed", [True, False])
def test_what_blocks_a_push_counts_until_the_push_ends(pushed):
    """Joints on the path go on, and may be pushed off it again after a new push."""
    state = state_of(1, blocked=True, rate=1.0)
    state = replace(state, null_velocity=0.1 * float(pushed) * null_unit(Q)[None])
    request = FollowPath(paths=PATHS, path=torch.tensor([1]))
    _, later = law().follow(state, reading_at(Q[None].clone()), request)
    assert later.path.blocked.tolist() == [pushed]
    assert not later.aside.any()


def elbow_speed(q, velocity, h=1e-6):
    """Speed of the fastest joint origin, by differences [m/s]."""
    moved = panda.joint_origins(q + h * velocity) - panda.joint_origins(q)
    return float(moved.norm(dim=-1).max() / h)


def test_a_null_space_that_gives_way_at_a_joint_limit_keeps_the_speed_of_the_elbow():
    """Only the correction is slowed down here: a push has been eased before."""
    followed = law(elbow_speed=0.008)
    config, joint = followed.config, 2
    q = torch.stack([Q, Q])
    q[0, joint] = panda.limits.upper[joint] - config.safety.margin - 0.5 * config.limit_margin
    null = torch.stack([torch.zeros(7, dtype=torch.float64), 0.3 * null_unit(Q)])
    # The least velocity of the tool with which the joint would move towards its limit.
    pseudo = torch.linalg.pinv(panda.jacobian(q[0]))
    twist = torch.zeros(2, 6, dtype=torch.float64)
    twist[0] = 0.2 * pseudo[joint] / pseudo[joint].square().sum()
    task = torch.zeros_like(q)
    task[0] = pseudo @ twist[0]
    every = torch.ones(2, dtype=torch.bool)
    tracked = followed.track(
        state_of(2), reading_at(q), panda.forward(q), twist, null, every, slows=False
    )
    rest = tracked.joint_velocity - task
    unit = null_unit(q[0])
    along = rest[0] @ unit
    torch.testing.assert_close(rest[0], along * unit)
    assert float(along * unit[joint]) < -0.05
    assert elbow_speed(q[0], rest[0]) == pytest.approx(0.008, rel=1e-3)
    torch.testing.assert_close(rest[1], null[1])
    assert elbow_speed(q[1], rest[1]) > 0.01


def test_a_push_off_a_path_moves_the_elbow_no_faster_than_allowed():
    push = 0.9 * null_unit(Q)
    state = replace(state_of(1), null_velocity=push[None])
    request = FollowPath(paths=PATHS, path=torch.tensor([0]))
    wanted, later = law(elbow_speed=0.01).follow(state, reading_at(Q[None]), request)
    assert elbow_speed(Q, wanted.joint_velocity[0]) == pytest.approx(0.01, rel=1e-3)
    kept = {limitation.cause: limitation.kept for limitation in wanted.limitations}
    assert float(kept["speed"]) == pytest.approx(0.01 / elbow_speed(Q, push), rel=1e-3)
    assert not later.path.blocked


@pytest.mark.parametrize(
    ("aligned", "towards", "fraction"),
    [(0.725, -1, 0.5), (0.725, 1, 1.0), (0.6, -1, 0.0), (0.9, -1, 1.0)],
)
def test_a_push_fades_as_the_way_back_becomes_doubtful(aligned, towards, fraction):
    """The error has a part of this cosine in the null space; 0.65 to 0.8 fade."""
    unit = null_unit(Q)
    across = torch.from_numpy(np.linalg.svd(panda.jacobian(Q).numpy())[2][0])
    error = aligned * unit + math.sqrt(1 - aligned**2) * across
    paths = JointPaths.of(panda, [(Q + error)[None].numpy()], DT)
    state = replace(state_of(1), aside=torch.tensor([True]))
    state = replace(state, null_velocity=towards * 0.1 * unit[None])
    request = FollowPath(paths=paths, path=torch.tensor([0]))
    wanted, later = law().follow(state, reading_at(Q[None]), request)
    far = fraction < 1
    kept = [(limitation.cause, float(limitation.kept)) for limitation in wanted.limitations]
    assert kept[2:4] == [
        ("too_far", pytest.approx(fraction if far else 1.0)),
        ("task_waits", pytest.approx(1.0)),
    ]
    assert bool(later.lost) == (aligned < 0.65)


def test_joints_off_a_path_follow_the_twist_that_it_has_after_the_delay():
    state = replace(state_of(2, progress=40.0), aside=torch.tensor([True, False]))
    state = replace(state, null_velocity=torch.stack([0.1 * null_unit(Q), 0 * Q]))
    goal, velocity = (torch.from_numpy(x) for x in path_point([40, 40]))
    request = FollowPath(paths=PATHS, path=torch.tensor([1, 1]))
    _, later = law().follow(state, reading_at(goal), request)
    _, velocity = path_point(40 + DELAY / DT)
    velocity = torch.from_numpy(velocity)
    twist = panda.jacobian(goal[0] + DELAY * velocity) @ velocity
    expected = torch.stack([twist, torch.zeros(6, dtype=torch.float64)])
    torch.testing.assert_close(later.path.twist, expected)


@pytest.mark.parametrize(
    ("progress", "narrow"),
    [(19.9, False), (20.0, True), (20.9, True), (21.0, False), (SAMPLES + 0.5, True)],
)
def test_a_push_is_refused_on_the_samples_where_the_path_is_narrow(progress, narrow):
    table = torch.zeros_like(PATHS.narrow)
    table[1, [20, SAMPLES - 1]] = True
    paths = replace(PATHS, narrow=table, narrow_ahead=table.roll(0))
    goal, _ = path_point(min(progress, SAMPLES - 1))
    q = torch.from_numpy(goal)[None]
    state = state_of(1, progress=progress, rate=0.0)
    state = replace(state, null_velocity=0.1 * null_unit(q[0])[None])
    _, later = law().follow(
        state, reading_at(q), FollowPath(paths=paths, path=torch.tensor([1]))
    )
    assert bool(later.path.narrow_ahead) == narrow
    assert bool(later.aside) != narrow


def test_joints_that_begin_a_path_off_it_are_aside():
    q = Q + torch.tensor([[0.0], [0.0999], [0.1001]], dtype=torch.float64) * torch.eye(7)[2]
    request = FollowPath(paths=PATHS, path=torch.tensor([1, 0, 1]))
    before = state_of(3, progress=7.0, rate=-1.0, waited=3.0)
    begun = law().begin(replace(before, lost=torch.tensor([True] * 3)), q, request)
    assert begun.lost.tolist() == [False] * 3
    assert begun.aside.tolist() == [False, False, True]
    assert begun.path.last.tolist() == [SAMPLES - 1, 0, SAMPLES - 1]
    assert begun.path.progress.tolist() == begun.path.waited.tolist() == [0, 0, 0]
    assert begun.path.rate.tolist() == [1, 1, 1]
    torch.testing.assert_close(begun.path.goal, Q.expand(3, 7))


# Progress of a path, one step later: the state of an arm, and what becomes of its path. A path
# changes its rate by 0.05 a step of 10 ms, 0.2 s from full speed to rest.
GOES_ON = {
    "at full speed": ({}, {"progress": 51.0, "rate": 1.0}),
    "from a slower rate": ({"rate": 0.5}, {"progress": 50.55, "rate": 0.55}),
    "slowed by people": ({"people": 0.5}, {"progress": 50.5, "rate": 1.0}),
    "by the operator": ({"override": 0.25}, {"progress": 50.25, "rate": 1.0}),
    "not followed": ({"followed": False}, {"progress": 50.0, "rate": 1.0}),
    "at its last sample": ({"progress": SAMPLES - 1.0}, {"progress": float(SAMPLES)}),
    "finished": ({"progress": SAMPLES - 0.5, "rate": 0.5}, {"progress": 199.5, "rate": 0.5}),
    "something in the way": (
        {"aside": True, "blocked": True},
        {"rate": 0.95, "progress": 50.95},
    ),
    "something beside the path": ({"blocked": True, "pushed": True}, {"progress": 51.0}),
    "lost": ({"aside": True, "lost": True}, {"rate": 0.95}),
    "lost, but back": ({"lost": True}, {"rate": 1.0}),
    "narrow ahead": ({"aside": True, "narrow_ahead": True}, {"rate": 0.95}),
    "narrow on the path": ({"narrow_ahead": True}, {"rate": 1.0}),
    "singular": ({"aside": True, "stretched": True}, {"rate": 0.95}),
    "singular on the path": ({"stretched": True}, {"rate": 1.0}),
    # The hand 1 mm off may go on, at 2 mm the path waits, in between in proportion.
    "hand 1 mm off": ({"aside": True, "off_hand": 0.001}, {"rate": 1.0}),
    "hand 1.4 mm off": ({"aside": True, "off_hand": 0.0014, "rate": 0.62}, {"rate": 0.6}),
    "hand 3 mm off": ({"aside": True, "off_hand": 0.003, "rate": 0.02}, {"rate": 0.0}),
    "hand off its path": ({"off_hand": 0.003}, {"rate": 1.0}),
    # Joints that found no way back for 2 s, neither pushed nor slowed down, retrace the path.
    "waits": ({"aside": True, "rate": 0.0, "lost": True}, {"waited": 0.01, "rate": 0.0}),
    "waits long": (
        {"aside": True, "rate": 0.0, "lost": True, "waited": 1.995},
        {"waited": 2.005, "rate": -0.05, "progress": 49.95},
    ),
    "waits just so long": (
        {"aside": True, "rate": 0.5, "waited": 2.0},
        {"waited": 2.0, "rate": 0.55, "progress": 50.55},
    ),
    "waits less": (
        {"aside": True, "rate": 0.0, "lost": True, "waited": 1.985},
        {"waited": 1.995, "rate": 0.0, "progress": 50.0},
    ),
    "goes back": (
        {"aside": True, "rate": -0.98, "waited": 3.0},
        {"waited": 3.01, "rate": -1.0, "progress": 49.0},
    ),
    "back at its start": (
        {"aside": True, "rate": 0.0, "waited": 3.0, "progress": 0.0, "lost": True},
        {"rate": 0.0, "progress": 0.0},
    ),
    "back before its start": (
        {"aside": True, "rate": -1.0, "waited": 3.0, "progress": 0.4},
        {"rate": -1.0, "progress": 0.0},
    ),
    "on the path again": ({"rate": 0.0, "waited": 1.0}, {"waited": 0.0, "rate": 0.05}),
    "pushed while it waits": (
        {"aside": True, "rate": 0.0, "lost": True, "pushed": True, "waited": 1.0, "held": 1.0},
        {"waited": 1.0, "held": 1.01, "nearest": 0.2 * math.sqrt(7)},
    ),
    "paused while it waits": (
        {"aside": True, "rate": 0.0, "lost": True, "override": 0.5, "waited": 1.0},
        {"waited": 1.0},
    ),
    "pushed while it goes on": ({"pushed": True, "held": 1.0}, {"held": 0.99}),
    "pushed while it chatters": (
        {"pushed": True, "rate": 0.05, "held": 1.0},
        {"held": 1.009},
    ),
    "let go": ({"rate": 0.0, "held": 1.0}, {"held": 0.0}),
}


def test_a_path_goes_on_waits_or_goes_back_as_the_arm_can_follow():
    cases = [case for case, _ in GOES_ON.values()]
    rows = len(cases)

    def column(name, default):
        values = [case.get(name, default) for case in cases]
        return torch.tensor(values, dtype=torch.float64 if type(default) is float else None)

    names = {"progress": 50.0, "rate": 1.0, "waited": 0.0, "held": 0.0, "followed": True}
    names |= {"blocked": False, "narrow_ahead": False, "nearest": 0.0}
    state = state_of(rows, **{name: column(name, value) for name, value in names.items()})
    q = Q.repeat(rows, 1)
    q[column("stretched", False), 3] = -0.1  # the elbow
    target = panda.forward(q)
    shift = column("off_hand", 0.0)[:, None] * target.position.new_tensor([0, 1, 0])
    state = replace(
        state,
        aside=column("aside", False),
        lost=column("lost", False),
        null_velocity=column("pushed", False)[:, None] * 0.1 * null_unit(Q),
        pace=replace(
            state.pace,
            people_scale=column("people", 1.0),
            speed_override=column("override", 1.0),
        ),
        path=replace(
            state.path, goal=q + 0.2, pose=Pose(target.position + shift, target.orientation)
        ),
    )
    later = law().go_on(state, reading_at(q))
    for k, (name, (_, expected)) in enumerate(GOES_ON.items()):
        for field, value in expected.items():
            assert float(getattr(later, field)[k]) == pytest.approx(value, abs=1e-9), name
    # Nothing changes for arms that follow no path.
    idle = replace(state, path=replace(state.path, followed=torch.zeros(rows).bool()))
    assert law().go_on(idle, reading_at(q)) is idle.path


@pytest.mark.parametrize(
    ("progress", "rate", "override"),
    [
        (20.0, 1.0, 1.0),
        (20.3, 0.5, 0.6),
        (60.7, -1.0, 1.0),
        (1.0, -1.0, 1.0),
        (199.5, 1.0, 1.0),
    ],
)
def test_joints_on_their_path_move_with_it(progress, rate, override):
    """The velocity is that of the sample which the arm follows after its delay."""
    state = state_of(1, progress=progress, rate=rate)
    pace = replace(state.pace, speed_override=torch.full((1,), override, dtype=torch.float64))
    state = replace(state, pace=pace)
    goal = [np.interp(progress, np.arange(SAMPLES), c) for c in PATHS.position[1].numpy().T]
    goal = torch.tensor(goal)[None]
    q = goal + 0.002
    wanted, later = law().follow(
        state, reading_at(q), FollowPath(paths=PATHS, path=torch.tensor([1]))
    )
    ahead = max(progress + rate * override * DELAY / DT, 0.0)
    velocity = rate * override * path_point(ahead)[1] * (progress <= SAMPLES - 1)
    expected = torch.from_numpy(velocity) + GAIN * (goal - q)
    # Differences at the ends of a table are of first order.
    torch.testing.assert_close(
        wanted.joint_velocity, expected, rtol=0, atol=1e-9 if 3 < ahead < 198 else 2.1e-3
    )
    torch.testing.assert_close(later.path.goal, goal)
    torch.testing.assert_close(wanted.path_joints, goal)
    position = panda.forward(goal).position
    torch.testing.assert_close(later.path.pose.position, position)
    assert bool(later.path.followed)
    assert not later.aside.any()
    kept = {limitation.cause: float(limitation.kept) for limitation in wanted.limitations}
    assert set(kept.values()) == {1.0}


# Joints `off` [rad] from a path along their null space: aside before; pushed [rad/s], positive
# towards the path; rate of the path; narrow there. Expected: aside after; velocity back;
# velocity of the push.
STAYS = {"after_push": "stay"}
OFF_PATH = {
    "on the path": ({"off": 0.09}, {}, (False, None, None)),
    "in contact": ({"off": 0.2}, {}, (False, None, None)),
    "near people": ({"off": 0.18, "people": True}, {}, (False, None, None)),
    "moved by the constraint layer": ({"off": 0.31, "people": True}, {}, (True, 0.4, 0.0)),
    "moved where it is narrow": (
        {"off": 0.31, "people": True, "narrow": True},
        {},
        (False, None, None),
    ),
    "near the path again": ({"off": 0.029, "aside": True}, {}, (False, None, None)),
    "let go": ({"off": 0.05, "aside": True}, {}, (True, 0.2, 0.0)),
    "far": ({"off": 0.2, "aside": True}, {}, (True, 0.4, 0.0)),
    "pushed while it advances": (
        {"off": 0.2, "aside": True, "push": 0.1},
        {},
        (True, 0.0, 0.1),
    ),
    "pushed while it waits": (
        {"off": 0.2, "aside": True, "push": -0.1, "rate": 0.0},
        {},
        (True, 0.4, -0.1),
    ),
    "first push": ({"off": 0.0, "push": 0.1}, {}, (True, 0.0, 0.1)),
    "push where it is narrow": ({"off": 0.0, "push": 0.1, "narrow": True}, {}, (False, 0, 0)),
    "aside where it is narrow": (
        {"off": 0.2, "aside": True, "push": 0.1, "narrow": True},
        {},
        (True, 0.0, 0.1),
    ),
    "stays": ({"off": 0.2, "aside": True}, STAYS, (True, 0.0, 0.0)),
    "stays but waits": ({"off": 0.2, "aside": True, "rate": 0.0}, STAYS, (True, 0.4, 0.0)),
    "at once": ({"off": 0.05, "aside": True}, {"nullspace_rise": 0.005}, (True, 0.2, 0.0)),
}


@pytest.mark.parametrize("name", OFF_PATH)
def test_joints_off_their_path_are_pushed_and_return(name):
    case, settings, (aside, back, push) = OFF_PATH[name]
    unit = null_unit(Q)
    paths = replace(PATHS, narrow=torch.full_like(PATHS.narrow, case.get("narrow", False)))
    state = state_of(1, rate=case.get("rate", 1.0))
    state = replace(
        state,
        aside=torch.tensor([case.get("aside", False)]),
        null_velocity=case.get("push", 0.0) * unit[None],
        return_velocity=0.1 * unit[None],
    )
    q = (Q - case["off"] * unit)[None]
    request = FollowPath(paths=paths, path=torch.tensor([0]))  # which rests
    reading = reading_at(q, people=people() if case.get("people") else None)
    wanted, later = law(**settings).follow(state, reading, request)
    assert bool(later.aside) == aside
    kept = [float(limitation.kept) for limitation in wanted.limitations]
    bound = case.get("narrow", False) and not aside
    assert kept[0] == (0.0 if bound else 1.0)  # narrow_path
    assert kept[1:3] == [1.0, 1.0]  # nothing is too far
    # A return against the push leaves nothing of it.
    assert kept[3] == pytest.approx(0.0 if name == "pushed while it waits" else 1.0)
    assert bool(wanted.limitations[3].mentioned) == (case.get("rate", 1.0) <= 0)
    if not aside:
        torch.testing.assert_close(wanted.joint_velocity, GAIN * (Q - q))
        assert not later.return_velocity.any()
        return
    # A first-order lag of 0.15 s towards a decay of 4 1/s, 0.4 rad/s at most.
    smoothed = 0.1 + min(DT / settings.get("nullspace_rise", 0.15), 1.0) * (back - 0.1)
    N = null_space_projector(panda.jacobian(q[0]))
    along = (N @ unit) / (N @ unit).norm()
    assert float(later.return_velocity[0] @ along) == pytest.approx(smoothed, rel=0.02)
    assert (later.return_velocity[0] - smoothed * along).norm() < 0.012
    motion = N @ (later.return_velocity[0] + push * unit)
    moved = wanted.joint_velocity[0]
    hand = (panda.jacobian(q[0]) @ moved).norm()
    assert float(N @ moved @ along) == pytest.approx(float(motion @ along), abs=2e-3)
    # The hand is where it was but for the curvature of the null space.
    assert hand < 0.03


@pytest.mark.parametrize("elapsed", [0.0, 0.4, 1.0 + DT, 1.02])
def test_a_direct_return_is_a_minimum_jerk_motion_after_which_the_path_goes_on(elapsed):
    """It takes its time and one step of the clock, at the pace of the operator."""
    start, goal = Q + 0.3, Q.clone()
    state = state_of(1, progress=70.0, waited=21.0, held=2.0, rate=0.0, nearest=0.5)
    direct = replace(
        state.path.direct_return,
        start=start[None],
        goal=goal[None],
        progress=torch.tensor([40.0]).double(),
        duration=torch.tensor([1.0]).double(),
        time=torch.tensor([elapsed], dtype=torch.float64),
        active=torch.tensor([True]),
    )
    pace = replace(state.pace, speed_override=torch.tensor([0.5]).double())
    state = replace(
        state,
        pace=pace,
        path=replace(state.path, direct_return=direct),
        aside=torch.tensor([True]),
        null_velocity=0.1 * null_unit(Q)[None],
    )
    s = min(elapsed, 1.0)
    on_the_way = start + (10 * s**3 - 15 * s**4 + 6 * s**5) * (goal - start)
    q = (on_the_way + 0.01)[None]
    request = FollowPath(paths=PATHS, path=torch.tensor([1]))
    wanted, later = law().follow(state, reading_at(q), request)
    path, arrived = later.path, elapsed > 1.0 + DT
    assert bool(path.direct_return.active) == bool(~path.followed) == (not arrived)
    too_far = float(wanted.limitations[1].kept)
    assert too_far == float(arrived)
    if not arrived:
        expected = torch.full((1, 7), -0.04, dtype=torch.float64)
        torch.testing.assert_close(wanted.joint_velocity, expected)
        assert float(path.direct_return.time) == pytest.approx(elapsed + 0.005)
        assert not later.aside.any()
        assert float(path.progress) == 70.0
    else:
        assert float(path.direct_return.time) == elapsed
        assert [float(x) for x in (path.progress, path.waited, path.held)] == [40.0, 0.0, 0.0]
        assert float(path.nearest) == math.inf


def test_each_arm_of_a_batch_ends_its_own_direct_return():
    state = state_of(2, progress=70.0, waited=21.0, rate=0.0)
    direct = replace(
        state.path.direct_return,
        progress=torch.tensor([40.0, 40.0]).double(),
        duration=torch.tensor([1.0, 1.0]).double(),
        time=torch.tensor([1.02, 0.4]).double(),
        active=torch.tensor([True, True]),
    )
    state = replace(state, path=replace(state.path, direct_return=direct))
    request = FollowPath(paths=PATHS, path=torch.tensor([1, 1]))
    _, later = law().follow(state, reading_at(Q.expand(2, 7)), request)
    assert later.path.direct_return.active.tolist() == [False, True]
    assert later.path.progress.tolist() == [40.0, 70.0]


@pytest.mark.parametrize(
    ("waited", "blocked", "begins"),
    [(20.0, False, False), (20.1, False, True), (30, True, False)],
)
def test_a_direct_return_begins_after_twenty_seconds_unless_something_is_in_the_way(
    waited, blocked, begins
):
    state = state_of(2, waited=torch.tensor([waited, 0.0]), rate=0.0, progress=10.0)
    direct = replace(state.path.direct_return, blocked=torch.tensor([blocked, False]))
    state = replace(
        state, path=replace(state.path, direct_return=direct), aside=torch.ones(2).bool()
    )
    q = torch.stack([Q + 0.2, Q + 0.2])
    request = FollowPath(paths=PATHS, path=torch.tensor([1, 1]))
    _, later = law().follow(state, reading_at(q), request)
    assert later.path.direct_return.active.tolist() == [begins, False]


@pytest.mark.parametrize(
    ("off", "pushed", "lost", "after"),
    [
        (1.6, False, False, False),  # 1.8 rad are too far
        (1.9, False, False, True),
        (1.6, True, True, False),
        (1.6, False, True, True),  # once lost and let go, it is lost until 1.4 rad
        (1.3, False, True, False),
    ],
)
def test_joints_that_were_lost_have_to_come_nearer_before_they_count_as_found(
    off, pushed, lost, after
):
    unit = null_unit(Q)
    state = state_of(1)
    state = replace(
        state,
        aside=torch.tensor([True]),
        lost=torch.tensor([lost]),
        null_velocity=pushed * 0.1 * unit[None],
    )
    reading = reading_at((Q - off * unit)[None])
    reading = replace(reading, jacobian=panda.jacobian(Q)[None])  # aligned all the way
    _, later = law().follow(state, reading, FollowPath(paths=PATHS, path=torch.tensor([0])))
    assert bool(later.lost) == after
