"""The control law, step by step and in closed loop against a camera it cannot see."""

from dataclasses import replace

import pytest
import sampling
import torch
from torch import Tensor
from torch.utils import _pytree
from unchecked import shapes_unchecked

from hrc_learn.controller import (
    INITIAL_IMAGE_JACOBIAN,
    AdaptiveController,
    ControllerConfig,
    ControllerState,
    Goals,
    Observation,
    table1_config,
    table1_goals,
    table1_joint_region,
)
from hrc_learn.controller.rehearsal import (
    Imperfections,
    PinholeCamera,
    VirtualCamera,
    rehearse,
)
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import (
    CompositeEstimator,
    FixedEstimator,
    KalmanEstimator,
    PaperEstimator,
    RBFImageJacobian,
    paper_grid,
)
from hrc_learn.kinematics import null_space_projector, panda, pseudo_inverse

DOUBLE = torch.float64
LIMITS = panda.limits
DOWN = quaternion.normalize(torch.tensor([-0.28, 0.63, 0.66, 0.28], dtype=DOUBLE))
CENTRE = torch.tensor([0.3, 0.4, 0.3], dtype=DOUBLE)
MARKER = torch.tensor([0.05, 0.0, -0.08], dtype=DOUBLE)
POSTURE = torch.tensor(
    [-0.9590, 1.2335, 1.6717, -2.5717, -1.3091, 2.6191, 0.7714], dtype=DOUBLE
)
"""The tool is at CENTRE, pointing DOWN, far from limits and singularities."""


def overhead_camera(*batch: int, roll: float = 0.0, tilt: float = 0.2) -> PinholeCamera:
    one = torch.ones(batch, dtype=DOUBLE)
    return PinholeCamera.above(
        CENTRE.expand(*batch, 3),
        height=1.0 * one,
        roll=roll * one,
        tilt=tilt * one,
        bearing=0.5 * one,
        marker=MARKER,
    )


def target_in(camera: PinholeCamera, *batch: int, rng: torch.Generator) -> tuple[Tensor, Pose]:
    """Where the marker appears for a random tool pose in the box."""
    offset = 0.04 * (2 * torch.rand(*batch, 3, generator=rng, dtype=DOUBLE) - 1)
    tool = Pose(CENTRE + offset, DOWN.expand(*batch, 4))
    return camera.project(tool)[0], tool


def near_starts(*batch: int, rng: torch.Generator, spread: float = 0.4) -> Tensor:
    q = panda.ready + spread * torch.randn(*batch, 7, generator=rng, dtype=DOUBLE)
    return q.clamp(LIMITS.lower + 0.03, LIMITS.upper - 0.03)


def network(J: Tensor) -> RBFImageJacobian:
    return RBFImageJacobian.from_jacobian(J, paper_grid(), 0.1)


def grasping(
    *batch: int, rng: torch.Generator, config: ControllerConfig | None = None
) -> tuple[AdaptiveController, PinholeCamera]:
    """A controller whose Jacobian is right at one pose of the box."""
    camera = overhead_camera(*batch)
    target, _ = target_in(camera, *batch, rng=rng)
    J = overhead_camera().image_jacobian(Pose(CENTRE, DOWN))
    goals = Goals.at(CENTRE, DOWN, target)
    controller = AdaptiveController(panda, FixedEstimator(network(J)), goals, config=config)
    return controller, camera


def observe(q: Tensor, **fields) -> Observation:
    batch = q.shape[:-1]
    defaults = {
        "joint_position": q,
        "feature": torch.full((*batch, 2), 700.0, dtype=DOUBLE),
        "feature_visible": torch.ones(batch, dtype=torch.bool),
        "dt": 0.002,
    }
    return Observation(**(defaults | fields))


class TestTheLaw:
    """u against (globalControl) put together from its parts, with no limit in the way."""

    def setup_method(self):
        rng = sampling.generator(1)
        config = ControllerConfig.paper()
        self.controller, _ = grasping(rng=rng, config=config)
        self.q = POSTURE + 0.05 * torch.randn(7, generator=rng, dtype=DOUBLE)
        self.d = 0.3 * torch.randn(7, generator=rng, dtype=DOUBLE)
        self.state = self.controller.initial_state(self.q)

    def test_printed_law(self):
        feature = torch.tensor([640.0, 500.0], dtype=DOUBLE)
        observation = observe(self.q, feature=feature, human_effort=self.d)
        command, _ = self.controller.step(self.state, observation)

        goals, pose = self.controller.goals, panda.forward(self.q)
        J_s = self.controller.estimator.network(pose)
        xi_x = goals.vision.gradient(feature)
        xi_r = torch.cat(
            [
                goals.position.gradient(pose.position),
                goals.orientation.gradient(pose.orientation),
            ]
        )
        J = panda.jacobian(self.q)
        xi_q = self.controller.joint_region.gradient(self.q)
        s = J_s.mT @ xi_x + xi_r
        null = null_space_projector(J) @ (self.d - xi_q) / 3
        u = -pseudo_inverse(J) @ s + null

        torch.testing.assert_close(command.s, s)
        torch.testing.assert_close(command.twist, -s)
        torch.testing.assert_close(command.null_velocity, null)
        torch.testing.assert_close(command.image_jacobian, J_s)
        # The first step is short of u only by the acceleration limit, in its direction.
        v = command.joint_velocity
        torch.testing.assert_close(v / v.norm(), u / u.norm())
        assert command.safety.acted("acceleration")

    def test_the_twist_is_capped_and_the_activation_blends(self):
        controller, _ = grasping(rng=sampling.generator(2))
        state = controller.initial_state(panda.ready)
        command, state = controller.step(state, observe(panda.ready, dt=0.03))
        assert command.vision_activation.item() == pytest.approx(0.1)
        speed = torch.maximum(command.twist[:3].norm() / 0.25, command.twist[3:].norm())
        assert speed.item() == pytest.approx(1.0)

    def test_the_pixel_rate_is_capped_whatever_the_jacobian(self):
        """Ten times the true Jacobian would multiply the gain of the loop by a hundred."""
        feature = torch.tensor([690.0, 530.0], dtype=DOUBLE)
        for scale in (1.0, 10.0):
            J = scale * overhead_camera().image_jacobian(Pose(CENTRE, DOWN))
            controller = AdaptiveController(
                panda,
                FixedEstimator(network(J)),
                Goals.at(CENTRE, DOWN, torch.tensor([700.0, 500.0], dtype=DOUBLE)),
                config=ControllerConfig(linear_speed=10.0, angular_speed=10.0),
            )
            q = POSTURE
            state = controller.initial_state(q)
            active = replace(state.activation, level=torch.ones_like(state.activation.level))
            command, _ = controller.step(
                replace(state, activation=active), observe(q, feature=feature)
            )
            rate = (J @ J.mT @ command.xi_x).norm() / (10**2 + 30**2) ** 0.5
            assert rate <= 4.1

    def test_goals_and_target_come_with_the_observation(self):
        elsewhere = self.controller.goals.moved_to(CENTRE + 0.3).with_vision(False)
        command, _ = self.controller.step(self.state, observe(self.q, goals=elsewhere))
        expected = elsewhere.position.gradient(panda.forward(self.q).position)
        torch.testing.assert_close(command.xi_r[:3], expected)
        assert (command.xi_x == 0).all()
        assert command.vision_activation == 0
        target = torch.tensor([900.0, 300.0], dtype=DOUBLE)
        command, _ = self.controller.step(self.state, observe(self.q, target=target))
        assert (command.xi_x * (700 - target) > 0).all()

    def test_the_module_is_not_changed_by_a_step(self):
        before = [p.clone() for p in self.controller.state_dict().values()]
        leaves = [leaf.clone() for leaf in _pytree.tree_leaves(self.state)]
        self.controller.step(self.state, observe(self.q, human_effort=self.d))
        for old, new in zip(before, self.controller.state_dict().values(), strict=True):
            assert (old == new).all()
        for old, new in zip(leaves, _pytree.tree_leaves(self.state), strict=True):
            assert (old == new).all()


def estimators(J: Tensor):
    return [cls(network(J)) for cls in (PaperEstimator, CompositeEstimator, KalmanEstimator)]


@pytest.mark.parametrize("kind", range(3), ids=["paper", "composite", "kalman"])
def test_a_batch_is_a_loop(kind: int):
    """Over many steps, with every optional field, for estimators with and without memory."""
    rng = sampling.generator(3)
    camera = overhead_camera(4)
    target, _ = target_in(camera, 4, rng=rng)
    estimator = estimators(camera.image_jacobian(Pose(CENTRE, DOWN))[0])[kind]
    goals = Goals.at(CENTRE, DOWN, target).approached_by(POSTURE)
    controller = AdaptiveController(panda, estimator, goals)
    q = POSTURE + 0.3 * torch.randn(4, 7, generator=rng, dtype=DOUBLE)
    effort = torch.randn(4, 7, generator=rng, dtype=DOUBLE)

    def inputs(k: int, q: Tensor, camera: PinholeCamera, effort: Tensor, goals: Goals):
        feature, visible = camera.project(panda.forward(q))
        age = torch.full(visible.shape, 0.3 if k % 7 == 6 else 0.02, dtype=DOUBLE)
        return observe(
            q,
            feature=feature,
            feature_visible=visible,
            feature_age=age,
            feature_new=torch.full(visible.shape, k % 2 == 0),
            image_joint_position=q,
            joint_state_stale=torch.full(visible.shape, k % 11 == 10),
            human_effort=effort,
            goals=goals,
            dt=0.01,
        )

    def run(q: Tensor, camera: PinholeCamera, effort: Tensor, goals: Goals) -> Tensor:
        state = controller.initial_state(q)
        for k in range(60):
            command, state = controller.step(state, inputs(k, q, camera, effort, goals))
            q = q + 0.01 * command.joint_velocity
        return q

    whole = run(q, camera, effort, goals)
    assert (whole - q).norm(dim=-1).min() > 0.05
    for i in range(4):
        one_camera = _pytree.tree_map(lambda t, i=i: t[i] if t.dim() > 1 else t, camera)
        one_goals = goals.aimed_at(target[i])
        vision = replace(one_goals.vision, half_size=goals.vision.half_size[i])
        one_goals = replace(one_goals, vision=vision)
        torch.testing.assert_close(
            run(q[i], one_camera, effort[i], one_goals), whole[i], rtol=0, atol=1e-9
        )


def test_both_signs_of_every_quaternion_give_the_same_command():
    rng = sampling.generator(4)
    controller, _ = grasping(rng=rng)
    q = near_starts(20, rng=rng)
    state = controller.initial_state(q)
    goals = controller.goals
    flipped = goals.turned_to(-goals.orientation.goal)
    one, _ = controller.step(state, observe(q, goals=goals))
    other, _ = controller.step(state, observe(q, goals=flipped))
    torch.testing.assert_close(one.joint_velocity, other.joint_velocity, rtol=0, atol=1e-14)


def test_converges_from_near_starts_with_a_good_jacobian():
    rng = sampling.generator(5)
    controller, camera = grasping(100, rng=rng)
    goals = controller.goals.approached_by(POSTURE)
    q = rehearse(
        controller,
        VirtualCamera(camera=camera, imperfections=Imperfections(), generator=rng),
        near_starts(100, rng=rng),
        steps=600,
        dt=0.01,
        goals=lambda k: goals,
    )
    tool = panda.forward(q)
    error = (camera.project(tool)[0] - goals.vision.target).norm(dim=-1)
    assert (error < 5).double().mean() >= 0.98
    outside = ((tool.position - CENTRE).abs() / goals.position.half_size).amax(-1)
    assert (outside < 1.1).double().mean() >= 0.98


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
        q = rehearse(
            controller,
            VirtualCamera(
                camera=camera,
                imperfections=Imperfections(frame_steps=2, latency_frames=1, noise=0.5),
                generator=sampling.generator(7),
            ),
            near_starts(30, rng=sampling.generator(8)),
            steps=350,
            dt=0.02,
        )
        error = (camera.project(panda.forward(q))[0] - target).norm(dim=-1)
        success[kind] = (error < 5).double().mean().item()
    assert success[FixedEstimator] <= 0.1
    assert success[KalmanEstimator] >= 0.9


@pytest.mark.parametrize("dt", [0.008, 0.002])
def test_a_person_moves_the_elbow_and_not_the_tool(dt: float):
    """Pull of joint 4 the way it can go and back, while the arm servoes on its target."""
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

    with torch.inference_mode():
        rehearse(
            controller,
            VirtualCamera(camera=camera, imperfections=Imperfections(), generator=rng),
            q,
            steps=2 * half,
            dt=dt,
            effort=pull,
            watch=watch,
        )
    assert torch.stack(moved).amax(0).median() >= 0.1
    worst = torch.stack(deviation).amax(0)
    assert worst.median() <= 0.2e-3
    assert worst.quantile(0.95) <= 1.5e-3
    assert torch.rad2deg(torch.stack(turned).amax(0)).median() <= 0.05


def violations(q: Tensor, v: Tensor, before: Tensor, dt: float) -> Tensor:
    """Whether position, velocity or acceleration limits are broken, or anything is NaN."""
    outside = (q > LIMITS.upper) | (q < LIMITS.lower)
    fast = v.abs() > LIMITS.velocity
    jerky = (v - before).abs() > LIMITS.acceleration * dt * (1 + 1e-9)
    return (outside | fast | jerky | ~v.isfinite() | ~q.isfinite()).any(-1)


@pytest.mark.parametrize("field", ["target", "image_joint_position", "joint_position"])
def test_what_is_nan_for_a_while_spoils_no_state(field: str):
    """Estimators keep what they learned, the arm comes back to its target."""
    rng = sampling.generator(17)
    camera = overhead_camera()
    target, _ = target_in(camera, rng=rng)
    estimator = CompositeEstimator(network(camera.image_jacobian(Pose(CENTRE, DOWN))))
    controller = AdaptiveController(panda, estimator, Goals.at(CENTRE, DOWN, target))
    q, state = POSTURE, controller.initial_state(POSTURE)
    for k in range(300):
        feature, visible = camera.project(panda.forward(q))
        fields = {"target": target, "image_joint_position": q, "joint_position": q}
        if 100 <= k < 140:
            fields[field] = torch.full_like(fields[field], torch.nan)
        observation = observe(**fields, q=q, feature=feature, feature_visible=visible, dt=0.01)
        command, state = controller.step(state, observation)
        q = q + 0.01 * command.joint_velocity
        leaves = [*_pytree.tree_leaves(command), *_pytree.tree_leaves(state)]
        assert all(leaf.isfinite().all() for leaf in leaves)
    assert (camera.project(panda.forward(q))[0] - target).norm() < 5


def test_phases_share_one_module_and_one_state():
    """Approach, servo, then move the box down with the camera off: three goals, one state."""
    rng = sampling.generator(11)
    controller, camera = grasping(rng=rng)
    q, state = POSTURE, controller.initial_state(POSTURE)
    goals = controller.goals
    lower = goals.moved_to(
        CENTRE - torch.tensor([0, 0, 0.1], dtype=DOUBLE),
        torch.tensor([0.01, 0.01, 0.005], dtype=DOUBLE),
    ).with_vision(False)
    phases = [goals.approached_by(POSTURE), goals, lower]
    for phase in phases:
        for _ in range(300):
            feature, visible = camera.project(panda.forward(q))
            observation = observe(
                q, feature=feature, feature_visible=visible, goals=phase, dt=0.01
            )
            command, state = controller.step(state, observation)
            q = q + 0.01 * command.joint_velocity
    assert isinstance(state, ControllerState)
    assert command.vision_activation == 0
    offset = (panda.forward(q).position - lower.position.centre).abs()
    assert (offset <= 1.2 * lower.position.half_size).all()


def test_a_lost_marker_does_not_send_the_arm_back_to_its_approach():
    rng = sampling.generator(15)
    controller, camera = grasping(rng=rng)
    goals = controller.goals.approached_by(POSTURE)
    q, state = POSTURE + 0.2, controller.initial_state(POSTURE + 0.2)
    path = []
    for k in range(500):
        feature, visible = camera.project(panda.forward(q))
        observation = observe(
            q, feature=feature, feature_visible=visible & (k < 300), goals=goals, dt=0.01
        )
        command, state = controller.step(state, observation)
        q = q + 0.01 * command.joint_velocity
        path.append(panda.forward(q).position)
    assert command.vision_activation == 0
    assert (path[-1] - path[300]).norm() < 2e-3


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
    assert state.arrival == 1
    elsewhere = controller.goals.approached_by(panda.ready)
    led_by_posture = False
    for _ in range(600):
        command, state = controller.step(
            state, observe(q, goals=elsewhere, feature_visible=hidden, dt=0.01)
        )
        q = q + 0.01 * command.joint_velocity
        led_by_posture |= bool(state.arrival == 0)
        if led_by_posture and state.arrival > 0:
            break
    assert 0.3 < (q - panda.ready).norm() <= 0.52


def test_goes_through_vmap():
    rng = sampling.generator(12)
    controller, _ = grasping(rng=rng)
    q = near_starts(6, rng=rng)
    state = controller.initial_state(q)
    mapped, _ = torch.vmap(lambda state, q: controller.step(state, observe(q, dt=0.01)))(
        state, q
    )
    whole, _ = controller.step(state, observe(q, dt=0.01))
    torch.testing.assert_close(mapped.joint_velocity, whole.joint_velocity)


def test_follows_its_dtype():
    controller, _ = grasping(rng=sampling.generator(13))
    controller = controller.float()
    q = panda.ready.float()
    command, state = controller.step(
        controller.initial_state(q), observe(q, feature=torch.tensor([700.0, 500.0]))
    )
    leaves = [*_pytree.tree_leaves(command), *_pytree.tree_leaves(state)]
    assert {leaf.dtype for leaf in leaves} == {torch.float32, torch.bool, torch.int64}


def test_bad_settings_are_refused():
    with pytest.raises(ValueError, match="null_damping must be positive"):
        ControllerConfig(null_damping=0.0)
    with pytest.raises(ValueError, match="hold_rate must not be negative"):
        ControllerConfig(hold_rate=-1.0)


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
        table1_goals(CENTRE, half_size, target),
        config=table1_config(),
        joint_region=table1_joint_region(LIMITS),
    )
    state = controller.initial_state(q)
    hidden = torch.zeros(50, dtype=torch.bool)
    wanted = torch.zeros(50, dtype=DOUBLE)
    for _ in range(50):
        before = state.safety.velocity
        command, state = controller.step(state, observe(q, feature_visible=hidden, dt=0.008))
        speed = pseudo_inverse(panda.jacobian(q)) @ command.twist[..., None]
        wanted = torch.maximum(wanted, (speed[..., 0].abs() / LIMITS.velocity).amax(-1))
        q = q + 0.008 * command.joint_velocity
        assert not violations(q, command.joint_velocity, before, 0.008).any()
    assert wanted.median() > 5
    assert (state.safety.count("velocity") > 0).all()


def test_the_analytic_law_is_that_of_the_analytic_jacobian():
    """J_A as the derivative of (position, rotation vector) over the joints, by autograd."""
    rng = sampling.generator(19)
    config = replace(ControllerConfig.paper(), jacobian="analytic")
    controller, _ = grasping(rng=rng, config=config)
    q = POSTURE + 0.2 * torch.randn(7, generator=rng, dtype=DOUBLE)
    feature = torch.tensor([640.0, 500.0], dtype=DOUBLE)
    command, _ = controller.step(controller.initial_state(q), observe(q, feature=feature))

    goals, pose = controller.goals, panda.forward(q)
    J_A = torch.autograd.functional.jacobian(lambda q: panda.forward(q).vector(), q)
    J = panda.jacobian(q)
    # The same motion of the tool in both coordinates: J = B J_A.
    B = J @ torch.linalg.pinv(J_A)
    J_s = controller.estimator.network(pose) @ B
    orientation = replace(goals.orientation, coordinates="rotation_vector")
    xi_r = torch.cat(
        [
            goals.position.gradient(pose.position),
            orientation.gradient(pose.orientation),
        ]
    )
    u = -torch.linalg.pinv(J_A) @ (J_s.mT @ goals.vision.gradient(feature) + xi_r)
    torch.testing.assert_close(command.twist, J @ u)
    with shapes_unchecked(), pytest.raises(ValueError, match="'geometric' or 'analytic'"):
        ControllerConfig(jacobian="other")


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


@pytest.mark.parametrize("reason", ["stale image", "stale joints", "person", "person unknown"])
def test_every_reason_to_stop_brings_the_arm_to_rest(reason: str):
    """Within its acceleration and jerk limits, flagged and counted; then it goes on."""
    controller, _ = grasping(rng=sampling.generator(21))
    q, state, dt = POSTURE, controller.initial_state(POSTURE), 0.004
    faults = {
        "stale image": {"feature_age": torch.tensor(0.5, dtype=DOUBLE)},
        "stale joints": {"joint_state_stale": torch.tensor(True)},
        "person": {"human_distance": torch.tensor(0.1, dtype=DOUBLE)},
        "person unknown": {"human_distance": torch.tensor(torch.nan, dtype=DOUBLE)},
    }
    well = {
        "feature_age": torch.tensor(0.01, dtype=DOUBLE),
        "joint_state_stale": torch.tensor(False),
        "human_distance": torch.tensor(5.0, dtype=DOUBLE),
    }
    feature = torch.tensor([500.0, 350.0], dtype=DOUBLE)
    speeds = []
    for k in range(300):
        fields = well | (faults[reason] if 100 <= k < 200 else {})
        before = state.safety
        command, state = controller.step(state, observe(q, feature=feature, dt=dt, **fields))
        q = q + dt * command.joint_velocity
        speeds.append(command.joint_velocity.norm().item())
        jerk = (state.safety.acceleration - before.acceleration).abs() / dt
        assert (jerk <= LIMITS.jerk * (1 + 1e-9)).all()
    assert speeds[99] > 1e-3
    assert speeds[199] < 1e-9
    assert speeds[-1] > 1e-3
    kind = {"stale image": "stopped", "stale joints": "invalid"}.get(reason, "separation")
    assert state.safety.count(kind) == 100
