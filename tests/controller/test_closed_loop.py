"""The law in closed loop against a camera it cannot see."""

import itertools
from collections.abc import Iterator
from dataclasses import replace

import pytest
import sampling
import torch
from closed_loop import Imperfections, VirtualCamera, simulate_closed_loop
from paper_law import paper_goals, paper_joint_region
from servoing import (
    CENTRE,
    DOUBLE,
    DOWN,
    LIMITS,
    POSTURE,
    grasping,
    near_starts,
    network,
    observe,
    overhead_camera,
    target_in,
)
from torch import Tensor
from torch.utils import _pytree
from unchecked import shapes_unchecked

from hrc_learn.controller import (
    INITIAL_IMAGE_JACOBIAN,
    AdaptiveController,
    ControllerConfig,
    ControllerState,
    Goals,
)
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import (
    CompositeEstimator,
    FixedEstimator,
    KalmanEstimator,
    PaperEstimator,
)
from hrc_learn.kinematics import panda

pytestmark = pytest.mark.simulation


@pytest.fixture(autouse=True)
def _no_shape_checks() -> Iterator[None]:
    """They take half the time of a step; the tests of single steps have them."""
    with shapes_unchecked(), torch.inference_mode():
        yield


@pytest.mark.long
def test_converges_from_near_starts_with_a_good_jacobian():
    rng = sampling.generator(5)
    controller, camera = grasping(100, rng=rng)
    goals = controller.goals.approached_by(POSTURE)
    q = simulate_closed_loop(
        controller,
        VirtualCamera(camera=camera, imperfections=Imperfections(), generator=rng),
        near_starts(100, rng=rng),
        steps=300,
        dt=0.02,
        goals=lambda k: goals,
    )
    tool = panda.forward(q)
    error = (camera.project(tool)[0] - goals.vision.target).norm(dim=-1)
    assert (error < 5).double().mean() >= 0.98
    outside = ((tool.position - CENTRE).abs() / goals.position.half_size).amax(-1)
    assert (outside < 1.1).double().mean() >= 0.98


@pytest.mark.long
def test_adaptation_finds_a_camera_turned_upside_down():
    """The initial Jacobian has the wrong sign everywhere: without adaptation nothing works."""
    rng = sampling.generator(6)
    camera = overhead_camera(30, roll=torch.pi)
    target, _ = target_in(camera, 30, rng=rng)
    J = overhead_camera().image_jacobian(Pose(CENTRE, DOWN))
    goals = Goals.at(CENTRE, DOWN, target).approached_by(POSTURE)
    success = {}
    for kind in (FixedEstimator, KalmanEstimator):
        controller = AdaptiveController(panda, kind(network(J)), goals)
        q = simulate_closed_loop(
            controller,
            VirtualCamera(
                camera=camera,
                imperfections=Imperfections(frame_steps=2, latency_frames=1, noise=0.5),
                generator=sampling.generator(7),
            ),
            near_starts(30, rng=sampling.generator(8)),
            steps=250,
            dt=0.02,
        )
        error = (camera.project(panda.forward(q))[0] - target).norm(dim=-1)
        success[kind] = (error < 5).double().mean().item()
    assert success[FixedEstimator] <= 0.1
    assert success[KalmanEstimator] >= 0.9


@pytest.mark.long
def test_a_person_moves_the_elbow_and_not_the_tool():
    """Pull of joint 4 the way it can go and back, while the arm servoes on its target."""
    dt = 0.008
    rng = sampling.generator(9)
    camera = overhead_camera(12)
    q = POSTURE + 0.1 * torch.randn(12, 7, generator=rng, dtype=DOUBLE)
    tool, elbow = panda.forward(q), panda.link_poses(q).position[:, 3]
    goals = Goals.at(tool.position, tool.orientation, camera.project(tool)[0])
    J = camera.image_jacobian(tool)[0]
    controller = AdaptiveController(panda, FixedEstimator(network(J)), goals)
    half = int(1.1 / dt)
    self_motion = torch.linalg.svd(panda.jacobian(q)).Vh[:, -1:].mT
    way = panda.joint_jacobian(q, 4)[:, :3] @ self_motion
    way = way / way.norm(dim=-2, keepdim=True)
    moved, deviation, turned = [], [], []

    def pull(k: int, q: Tensor) -> Tensor:
        force = (10.0 if k < half else -10.0) * way
        return (panda.joint_jacobian(q, 4)[:, :3].mT @ force)[..., 0]

    def watch(k: int, q: Tensor, *_) -> None:
        if k % (half // 20) == 0:
            links = panda.link_poses(q)
            moved.append((links.position[:, 3] - elbow).norm(dim=-1))
            deviation.append((links.position[:, -1] - tool.position).norm(dim=-1))
            turned.append(quaternion.angle(links.orientation[:, -1], tool.orientation))

    simulate_closed_loop(
        controller,
        VirtualCamera(camera=camera, imperfections=Imperfections(), generator=rng),
        q,
        steps=2 * half,
        dt=dt,
        nullspace_input=pull,
        on_step=watch,
    )
    assert torch.stack(moved).amax(0).median() >= 0.1
    worst = torch.stack(deviation).amax(0)
    assert worst.median() <= 0.2e-3
    assert worst.quantile(0.95) <= 1.5e-3
    assert torch.rad2deg(torch.stack(turned).amax(0)).median() <= 0.05


def test_what_is_nan_for_a_while_spoils_no_state():
    """Estimators keep what they learned, the arm comes back to its target; an arm for each
    field that may be NaN."""
    broken = ("image_joint_position", "joint_position")
    rng = sampling.generator(17)
    camera = overhead_camera()
    target = target_in(camera, rng=rng)[0]
    estimator = CompositeEstimator(network(camera.image_jacobian(Pose(CENTRE, DOWN))))
    controller = AdaptiveController(panda, estimator, Goals.at(CENTRE, DOWN, target))
    q = POSTURE.expand(2, 7)
    state = controller.initial_state(q)
    for k in range(300):
        feature, visible = camera.project(panda.forward(q))
        fields = {"image_joint_position": q, "joint_position": q}
        if 100 <= k < 140:
            for arm, name in enumerate(broken):
                fields[name] = fields[name].clone()
                fields[name][arm] = torch.nan
        observation = observe(**fields, q=q, feature=feature, feature_visible=visible, dt=0.01)
        command, state = controller.step(state, observation)
        q = q + 0.01 * command.joint_velocity
        leaves = [*_pytree.tree_leaves(command), *_pytree.tree_leaves(state)]
        assert all(leaf.isfinite().all() for leaf in leaves)
    assert ((camera.project(panda.forward(q))[0] - target).norm(dim=-1) < 5).all()


@pytest.mark.long
def test_phases_share_one_module_and_one_state():
    """Approach, servo, then move the box down with the camera off: three goals, one state."""
    rng = sampling.generator(11)
    controller, camera = grasping(rng=rng)
    q, state = POSTURE, controller.initial_state(POSTURE)
    goals = controller.goals
    lower = goals.moved_to(CENTRE - torch.tensor([0, 0, 0.1], dtype=DOUBLE)).with_vision(False)
    half_size = torch.tensor([0.01, 0.01, 0.005], dtype=DOUBLE)
    lower = replace(lower, position=replace(lower.position, half_size=half_size))
    phases = [goals.approached_by(POSTURE), goals, lower]
    for phase in phases:
        for _ in range(150):
            feature, visible = camera.project(panda.forward(q))
            observation = observe(
                q, feature=feature, feature_visible=visible, goals=phase, dt=0.02
            )
            command, state = controller.step(state, observation)
            q = q + 0.02 * command.joint_velocity
    assert isinstance(state, ControllerState)
    assert command.vision_level == 0
    offset = (panda.forward(q).position - lower.position.centre).abs()
    assert (offset <= 1.2 * lower.position.half_size).all()


def test_a_lost_marker_does_not_send_the_arm_back_to_its_approach():
    rng = sampling.generator(15)
    controller, camera = grasping(rng=rng)
    goals = controller.goals.approached_by(POSTURE)
    q, state = POSTURE + 0.2, controller.initial_state(POSTURE + 0.2)
    path = []
    for k in range(250):
        feature, visible = camera.project(panda.forward(q))
        observation = observe(
            q, feature=feature, feature_visible=visible & (k < 150), goals=goals, dt=0.02
        )
        command, state = controller.step(state, observation)
        q = q + 0.02 * command.joint_velocity
        path.append(panda.forward(q).position)
    assert command.vision_level == 0
    assert (path[-1] - path[150]).norm() < 2e-3


@pytest.mark.long
def test_a_posture_far_away_begins_a_new_approach():
    rng = sampling.generator(16)
    controller, _ = grasping(rng=rng)
    q, state = POSTURE, controller.initial_state(POSTURE)
    hidden = torch.tensor(False)
    there = controller.goals.approached_by(POSTURE)
    for _ in range(60):
        command, state = controller.step(
            state, observe(q, goals=there, feature_visible=hidden, dt=0.01)
        )
    assert state.task_level == 1
    elsewhere = controller.goals.approached_by(panda.ready)
    led_by_posture = False
    for _ in range(600):
        command, state = controller.step(
            state, observe(q, goals=elsewhere, feature_visible=hidden, dt=0.01)
        )
        q = q + 0.01 * command.joint_velocity
        led_by_posture |= bool(state.task_level == 0)
        if led_by_posture and state.task_level > 0:
            break
    assert 0.3 < (q - panda.ready).norm() <= 0.52


def off_its_way(rng: torch.Generator, **options) -> tuple[Tensor, Tensor]:
    """How far limits lead tools from the twist that is asked for [m], and the fastest turns.

    From postures with a third of the joints near a limit to poses 0.15 m and 1 rad away.
    """
    n, dt = 60, 0.01
    share = torch.rand(n, 7, generator=rng, dtype=DOUBLE)
    q = torch.lerp(LIMITS.lower, LIMITS.upper, share)
    edge = torch.where(share < 0.5, LIMITS.lower + 0.2, LIMITS.upper - 0.2)
    q = torch.where(torch.rand(n, 7, generator=rng) < 0.3, edge, q)
    start = panda.forward(q)
    way, turn = (torch.randn(n, 3, generator=rng, dtype=DOUBLE) for _ in range(2))
    goals = Goals.at(
        start.position + 0.15 * way / way.norm(dim=-1, keepdim=True),
        quaternion.multiply(
            quaternion.exp(turn / turn.norm(dim=-1, keepdim=True)), start.orientation
        ),
        torch.full((n, 2), 500.0, dtype=DOUBLE),
        half_size=(0.01, 0.01, 0.01),
    )
    J = torch.zeros(2, 6, dtype=DOUBLE)
    config = ControllerConfig(**options)
    controller = AdaptiveController(panda, FixedEstimator(network(J)), goals, config=config)
    state = controller.initial_state(q)
    off = fastest = torch.zeros(n, dtype=DOUBLE)
    for _ in range(250):
        unseen = torch.zeros(n, dtype=torch.bool)
        command, state = controller.step(state, observe(q, dt=dt, feature_visible=unseen))
        v, asked = command.joint_velocity, command.twist
        moved = (panda.jacobian(q) @ v[..., None])[..., 0]
        done = (moved * asked).sum(-1) / (asked * asked).sum(-1).clamp(min=1e-12)
        aside = moved - done.clamp(0, 1)[..., None] * asked
        off = off + dt * aside[:, :3].norm(dim=-1)
        fastest = torch.maximum(fastest, moved[:, 3:].norm(dim=-1))
        q = q + dt * v
    return off, fastest


@pytest.mark.long
def test_near_limits_the_tool_slows_down_rather_than_leaving_its_way():
    cut, cut_turns = off_its_way(sampling.generator(11), yields_to_limits=False)
    slowed, slowed_turns = off_its_way(sampling.generator(11))
    cap = ControllerConfig().angular_speed
    assert slowed_turns.quantile(0.9) <= cap
    assert cut_turns.quantile(0.9) > cap  # else the starts would test nothing
    assert slowed.quantile(0.9) < cut.quantile(0.9)
    assert slowed.amax() < 0.5 * cut.amax()


@pytest.mark.long
@pytest.mark.parametrize("yields", [True, False])
def test_an_arm_gets_away_from_a_limit_that_all_of_its_way_seems_to_need(yields):
    """Where a servoed arm stood still: on its way it would turn joint 1 alone, at its limit."""
    q = torch.tensor([2.876, -1.141, -1.587, -1.918, -1.176, 1.713, -0.213], dtype=DOUBLE)
    start, turn = panda.forward(q), quaternion.exp(torch.tensor([0, 0, 0.5], dtype=DOUBLE))
    goal = Pose(
        quaternion.rotate(turn, start.position),
        quaternion.multiply(turn, start.orientation),
    )
    away = goal.position - start.position
    assert (panda.jacobian(q)[:3, 0] * away).sum() / away.norm() > 0.5
    target = torch.tensor([500.0, 500.0], dtype=DOUBLE)
    goals = Goals.at(goal.position, goal.orientation, target, half_size=(0.01, 0.01, 0.01))
    config = ControllerConfig(yields_to_limits=yields)
    estimator = FixedEstimator(network(torch.zeros(2, 6, dtype=DOUBLE)))
    controller = AdaptiveController(panda, estimator, goals, config=config)
    state, unseen = controller.initial_state(q), torch.tensor(False)
    for _ in range(500):
        command, state = controller.step(state, observe(q, dt=0.01, feature_visible=unseen))
        q = q + 0.01 * command.joint_velocity
    end = panda.forward(q)
    off = (end.position - goal.position).abs().amax()
    assert (off < 0.01) == yields
    assert (quaternion.angle(end.orientation, goal.orientation) < 0.2) == yields


@pytest.mark.long
@pytest.mark.parametrize("rests", [True, False])
def test_the_null_space_goes_back_to_rest_and_the_tool_stays(rests):
    """From the elbow to the side, by the arm's own inverse for the same pose."""
    pose, rest = panda.forward(POSTURE), POSTURE
    q = panda.inverse(pose, float(rest[6]) - 0.6, near=rest)
    goals = Goals.at(pose.position, pose.orientation, torch.full((2,), 500.0, dtype=DOUBLE))
    goals = goals.resting_at(rest if rests else None, rate=2.0, speed=0.3)
    estimator = FixedEstimator(network(torch.zeros(2, 6, dtype=DOUBLE)))
    controller = AdaptiveController(panda, estimator, goals)
    state, unseen = controller.initial_state(q), torch.tensor(False)
    away, fastest = [(q - rest).norm()], torch.zeros((), dtype=DOUBLE)
    assert away[0] > 0.5
    for _ in range(250 if rests else 50):
        command, state = controller.step(state, observe(q, dt=0.02, feature_visible=unseen))
        fastest = torch.maximum(fastest, command.joint_velocity.norm())
        q = q + 0.02 * command.joint_velocity
        away.append((q - rest).norm())
    off = (panda.forward(q).position - pose.position).norm()
    assert off < 2e-3
    if rests:
        assert away[-1] < 0.1 * away[0]
        assert 0.2 < fastest <= 0.3
        assert all(after <= before + 1e-6 for before, after in itertools.pairwise(away))
    else:
        assert away[-1] > 0.99 * away[0]


def violations(q: Tensor, v: Tensor, before: Tensor, dt: float) -> Tensor:
    """Whether position, velocity or acceleration limits are broken, or anything is NaN."""
    outside = (q > LIMITS.upper) | (q < LIMITS.lower)
    fast = v.abs() > LIMITS.velocity
    jerky = (v - before).abs() > LIMITS.acceleration * dt * (1 + 1e-9)
    return (outside | fast | jerky | ~v.isfinite() | ~q.isfinite()).any(-1)


def test_table_one_runs_only_because_of_the_safety_filter():
    """k_o = 1 asks for many times the joint velocity limits, as its peak was measured."""
    rng = sampling.generator(14)
    q = near_starts(50, rng=rng)
    target = torch.tensor([700.0, 500.0], dtype=DOUBLE)
    half_size = torch.tensor([0.12, 0.12, 0.08], dtype=DOUBLE)
    J = torch.tensor(INITIAL_IMAGE_JACOBIAN, dtype=DOUBLE)
    controller = AdaptiveController(
        panda,
        PaperEstimator(network(J)),
        paper_goals(CENTRE, half_size, target),
        config=ControllerConfig.paper(),
        joint_region=paper_joint_region(LIMITS),
    )
    state = controller.initial_state(q)
    hidden = torch.zeros(50, dtype=torch.bool)
    wanted = torch.zeros(50, dtype=DOUBLE)
    for _ in range(50):
        before = state.safety.velocity
        command, state = controller.step(state, observe(q, feature_visible=hidden, dt=0.008))
        speed = torch.linalg.pinv(panda.jacobian(q)) @ command.twist[..., None]
        wanted = torch.maximum(wanted, (speed[..., 0].abs() / LIMITS.velocity).amax(-1))
        q = q + 0.008 * command.joint_velocity
        assert not violations(q, command.joint_velocity, before, 0.008).any()
    assert wanted.median() > 5
    assert (state.safety.count("velocity") > 0).all()


def test_a_stop_is_obeyed_and_counted():
    controller, _ = grasping(rng=sampling.generator(20))
    q, state = POSTURE, controller.initial_state(POSTURE)
    for k in range(60):
        command, state = controller.step(state, observe(q, dt=0.01, stop=torch.tensor(k >= 40)))
        q = q + 0.01 * command.joint_velocity
        if k == 39:
            assert command.joint_velocity.norm() > 1e-3
    assert command.joint_velocity.norm() < 1e-12
    assert state.safety.count("stopped") == 20


@pytest.mark.long
def test_every_reason_to_stop_brings_the_arm_to_rest():
    """Within its acceleration and jerk limits, flagged and counted; then it goes on. Of four
    arms each has one reason."""
    controller, _ = grasping(rng=sampling.generator(21))
    q, dt = POSTURE.expand(4, 7), 0.004
    state = controller.initial_state(q)
    well = {
        "feature_age": torch.full((4,), 0.01, dtype=DOUBLE),
        "joint_state_stale": torch.zeros(4, dtype=torch.bool),
        "human_distance": torch.full((4,), 5.0, dtype=DOUBLE),
    }
    faulty = {
        "feature_age": torch.tensor([0.5, 0.01, 0.01, 0.01], dtype=DOUBLE),
        "joint_state_stale": torch.tensor([False, True, False, False]),
        "human_distance": torch.tensor([5.0, 5.0, 0.1, torch.nan], dtype=DOUBLE),
    }
    feature = torch.tensor([500.0, 350.0], dtype=DOUBLE).expand(4, 2)
    speeds = []
    for k in range(300):
        fields = faulty if 100 <= k < 200 else well
        before = state.safety
        command, state = controller.step(state, observe(q, feature=feature, dt=dt, **fields))
        q = q + dt * command.joint_velocity
        speeds.append(command.joint_velocity.norm(dim=-1))
        jerk = (state.safety.acceleration - before.acceleration).abs() / dt
        assert (jerk <= LIMITS.jerk * (1 + 1e-9)).all()
    assert (speeds[99] > 1e-3).all()
    assert (speeds[199] < 1e-9).all()
    assert (speeds[-1] > 1e-3).all()
    kinds = ("stopped", "invalid", "separation", "separation")
    counts = [int(state.safety.count(kind)[arm]) for arm, kind in enumerate(kinds)]
    assert counts == [100] * 4
