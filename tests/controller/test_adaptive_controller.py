"""The control law, one step against its parts."""

import math
from dataclasses import replace

import pytest
import sampling
import torch
from pinhole_camera import PinholeCamera
from projections import null_space_projector
from servoing import (
    CENTRE,
    DOUBLE,
    DOWN,
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

from hrc_learn.controller import AdaptiveController, ControllerConfig, Goals
from hrc_learn.geometry import Pose
from hrc_learn.jacobian import (
    CompositeEstimator,
    FixedEstimator,
    KalmanEstimator,
    Measurement,
    PaperEstimator,
)
from hrc_learn.kinematics import arm, panda


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
        observation = observe(self.q, feature=feature, nullspace_input=self.d)
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
        u = -torch.linalg.pinv(J) @ s + null

        torch.testing.assert_close(command.s, s)
        torch.testing.assert_close(command.twist, -s)
        torch.testing.assert_close(command.null_velocity, null)
        torch.testing.assert_close(command.image_jacobian, J_s)
        # The first step is short of u only by the acceleration limit, in its direction.
        v = command.joint_velocity
        torch.testing.assert_close(v / v.norm(), u / u.norm())
        assert command.safety.acted("acceleration")
        # How fast the potential falls, and how much the estimate has learned.
        torch.testing.assert_close(command.potential_rate, s @ (J @ v))
        weight = self.controller.estimator.network.weight
        torch.testing.assert_close(command.weight_norm, weight.square().sum().sqrt())

    def test_the_printed_law_has_no_extension(self):
        config = ControllerConfig.paper()
        speeds = config.linear_speed, config.angular_speed, config.vision_rate
        assert speeds == (math.inf, math.inf, math.inf)
        assert not config.yields_to_limits
        assert config.drift_compensation_rate == 0
        assert config.blending.hysteresis == config.blending.blend_time == 0

    def test_the_twist_is_capped_and_the_activation_blends(self):
        controller, _ = grasping(rng=sampling.generator(2))
        state = controller.initial_state(panda.ready)
        command, state = controller.step(state, observe(panda.ready, dt=0.03))
        assert command.vision_level.item() == pytest.approx(0.1)
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
            active = replace(state.blending, level=torch.ones_like(state.blending.level))
            command, _ = controller.step(
                replace(state, blending=active), observe(q, feature=feature)
            )
            rate = (J @ J.mT @ command.xi_x).norm() / (10**2 + 30**2) ** 0.5
            assert rate <= 4.1
            if scale > 1:  # 4 1/s, and 1 px/s in any case
                assert float(rate) == pytest.approx(4 + 1 / math.hypot(10, 30))

    def test_the_null_space_is_that_of_the_joints_after_the_delay(self):
        delay, velocity = 0.05, torch.linspace(-0.8, 0.8, 7, dtype=DOUBLE)
        config = replace(self.controller.config, command_delay=delay)
        controller, _ = grasping(rng=sampling.generator(1), config=config)
        state = controller.initial_state(self.q)
        state = replace(state, safety=replace(state.safety, velocity=velocity))
        command, _ = controller.step(state, observe(self.q, nullspace_input=self.d))
        moved = [
            float((panda.jacobian(q) @ command.null_velocity).norm())
            for q in (self.q, self.q + delay * velocity)
        ]
        assert command.null_velocity.norm() > 0.05
        assert moved[0] > 1e-4 > 1e-9 > moved[1]

    def test_goals_come_with_the_observation(self):
        elsewhere = self.controller.goals.moved_to(CENTRE + 0.3).with_vision(False)
        command, _ = self.controller.step(self.state, observe(self.q, goals=elsewhere))
        expected = elsewhere.position.gradient(panda.forward(self.q).position)
        torch.testing.assert_close(command.xi_r[:3], expected)
        assert (command.xi_x == 0).all()
        assert command.vision_level == 0
        target = torch.tensor([900.0, 300.0], dtype=DOUBLE)
        vision = replace(self.controller.goals.vision, target=target)
        aimed = replace(self.controller.goals, vision=vision)
        command, _ = self.controller.step(self.state, observe(self.q, goals=aimed))
        assert (command.xi_x * (700 - target) > 0).all()

    def test_the_null_space_is_drawn_to_a_posture_at_its_rate_besides_the_persons_input(self):
        """Near the posture, before saturation: the null-space part of rate times offset."""
        ahead = torch.linspace(-1, 1, 7, dtype=DOUBLE)
        drawn = self.controller.goals.resting_at(self.q - 1e-5 * ahead, rate=2.0, speed=9.0)
        project = null_space_projector(panda.jacobian(self.q))
        speeds = [
            self.controller.step(
                self.state, observe(self.q, nullspace_input=self.d, goals=goals)
            )
            for goals in (drawn, self.controller.goals)
        ]
        returning, free = (command.null_velocity for command, _ in speeds)
        expected = -2.0 * 1e-5 * project @ ahead
        torch.testing.assert_close(returning - free, expected, rtol=1e-4, atol=1e-12)

    def test_the_module_is_not_changed_by_a_step(self):
        before = [p.clone() for p in self.controller.state_dict().values()]
        leaves = [leaf.clone() for leaf in _pytree.tree_leaves(self.state)]
        self.controller.step(self.state, observe(self.q, nullspace_input=self.d))
        for old, new in zip(before, self.controller.state_dict().values(), strict=True):
            assert (old == new).all()
        for old, new in zip(leaves, _pytree.tree_leaves(self.state), strict=True):
            assert (old == new).all()


def estimators(J: Tensor):
    return [cls(network(J)) for cls in (PaperEstimator, CompositeEstimator, KalmanEstimator)]


@pytest.mark.parametrize("kind", [0, 2], ids=["paper", "kalman"])
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
            nullspace_input=effort,
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
    for i in (0, 3):
        one_camera = _pytree.tree_map(lambda t, i=i: t[i] if t.dim() > 1 else t, camera)
        one_goals = replace(goals, vision=replace(goals.vision, target=target[i]))
        vision = replace(one_goals.vision, half_size=goals.vision.half_size[i])
        one_goals = replace(one_goals, vision=vision)
        with shapes_unchecked():  # for speed
            one = run(q[i], one_camera, effort[i], one_goals)
        torch.testing.assert_close(one, whole[i], rtol=0, atol=1e-9)


def test_both_signs_of_every_quaternion_give_the_same_command():
    rng = sampling.generator(4)
    controller, _ = grasping(rng=rng)
    q = near_starts(20, rng=rng)
    state = controller.initial_state(q)
    goals = controller.goals
    flipped = replace(
        goals, orientation=replace(goals.orientation, goal=-goals.orientation.goal)
    )
    one, _ = controller.step(state, observe(q, goals=goals))
    other, _ = controller.step(state, observe(q, goals=flipped))
    torch.testing.assert_close(one.joint_velocity, other.joint_velocity, rtol=0, atol=1e-14)


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
    with pytest.raises(ValueError, match="drift_compensation_rate must not be negative"):
        ControllerConfig(drift_compensation_rate=-1.0)
    with pytest.raises(ValueError, match="command_delay must not be negative"):
        ControllerConfig(command_delay=-0.01)


# One joint is not known.
UNKNOWN = POSTURE.where(torch.arange(7) != 3, torch.nan)
# Fields of an observation, and whether the estimator learns from the image.
IMAGES = {
    "new": ({}, True),
    "taken elsewhere": ({"image_joint_position": POSTURE + 0.02}, True),
    "taken at unknown joints": ({"image_joint_position": UNKNOWN}, False),
    "used before": ({"feature_new": torch.tensor(False)}, False),
    "without the feature": ({"feature_visible": torch.tensor(False)}, False),
    "too old": ({"feature_age": torch.tensor(0.3, dtype=DOUBLE)}, False),
    "of joints that are not known": ({"joint_state_stale": torch.tensor(True)}, False),
    "with the feature at its border": (
        {"feature": torch.tensor([0.0, 500.0], dtype=DOUBLE)},
        True,
    ),
    "with the feature beyond its border": (
        {"feature": torch.tensor([-0.5, 500.0], dtype=DOUBLE)},
        False,
    ),
}


@pytest.mark.parametrize("approached", [False, True])
@pytest.mark.parametrize("dt", [0.01, math.nan])
def test_the_estimator_learns_from_new_images_where_they_were_taken(approached, dt):
    """Also during an approach in joint space, which vision does not guide."""
    camera = overhead_camera()
    J = camera.image_jacobian(Pose(CENTRE, DOWN))
    goals = Goals.at(CENTRE, DOWN, torch.tensor([700.0, 500.0], dtype=DOUBLE))
    if approached:
        goals = goals.approached_by(POSTURE + 1.0)
    estimator = CompositeEstimator(network(J))
    controller = AdaptiveController(panda, estimator, goals)
    usual = {
        "feature": torch.tensor([690.0, 520.0], dtype=DOUBLE),
        "feature_visible": torch.tensor(True),
        "feature_new": torch.tensor(True),
        "feature_age": torch.tensor(0.02, dtype=DOUBLE),
        "joint_state_stale": torch.tensor(False),
        "image_joint_position": POSTURE,
    }
    rows = [usual | fields for fields, _ in IMAGES.values()]
    valid = torch.tensor([learned for _, learned in IMAGES.values()])
    q = POSTURE.expand(len(rows), 7)
    first = observe(q - 0.01, dt=0.01)
    _, state = controller.step(controller.initial_state(q), first)
    fields = {name: torch.stack([row[name] for row in rows]) for name in usual}
    observation = observe(q, dt=torch.tensor(dt, dtype=DOUBLE), **fields)
    command, after = controller.step(state, observation)
    known = fields["image_joint_position"]
    known = torch.where(known.isnan().any(-1, keepdim=True), q, known)
    sound = not math.isnan(dt)
    expected = estimator.update(
        state.estimator,
        Measurement(
            pose=panda.forward(known),
            feature=fields["feature"],
            valid=valid & sound,
            dt=dt if sound else 0.0,
            xi_x=command.xi_x if sound else torch.zeros_like(command.xi_x),
            xi_r=command.xi_r if sound else torch.zeros_like(command.xi_r),
        ),
    )
    leaves = (_pytree.tree_leaves(x) for x in (after.estimator, expected))
    for one, other in zip(*leaves, strict=True):
        torch.testing.assert_close(one, other)
    changed = (after.estimator.key.feature != state.estimator.key.feature).any(-1)
    assert changed.tolist() == (valid & sound).tolist()
    assert bool((command.vision_level > 0).any()) == (not approached)


def test_the_drift_of_a_pushed_arm_is_measured_from_step_to_step():
    controller, _ = grasping(rng=sampling.generator(5))
    q = (POSTURE + 0.1).expand(3, 7)
    push = torch.zeros(3, 7, dtype=DOUBLE)
    push[1, 2], push[2] = 2.0, 1.0
    dt = torch.tensor(0.01, dtype=DOUBLE)
    command, state = controller.step(
        controller.initial_state(q), observe(q, nullspace_input=push, dt=dt)
    )
    assert state.pose_drift.active.tolist() == [False, True, True]
    # What the filter leaves of the twist is the plan for the step.
    J = panda.jacobian(q)
    done = (J @ command.joint_velocity[..., None])[..., 0]
    square = command.twist.square().sum(-1, keepdim=True)
    fraction = (done * command.twist).sum(-1, keepdim=True) / square
    assert (fraction < 1).all()
    torch.testing.assert_close(
        state.pose_drift.planned, dt * fraction * command.twist, rtol=1e-6, atol=1e-12
    )
    # An arm that brakes for a step of unknown length does not drift.
    lost = observe(q, nullspace_input=push, dt=dt * math.nan)
    command, braking = controller.step(state, lost)
    done = (J @ command.joint_velocity[..., None])[..., 0]
    assert done.norm() > 0
    torch.testing.assert_close(braking.pose_drift.planned, 0.01 * done)
    # Nor does one that is not pushed, or that approaches in joint space.
    _, rested = controller.step(state, observe(q, dt=dt))
    assert not rested.pose_drift.active.any()
    goals = controller.goals.approached_by(POSTURE + 0.1)
    for level, active in ((0.5, False), (1.0, True)):
        begun = replace(state, task_level=torch.full((3,), level, dtype=DOUBLE))
        approach = observe(q, nullspace_input=push, dt=dt, goals=goals)
        _, later = controller.step(begun, approach)
        assert later.pose_drift.active.tolist() == [False, active, active]


def test_six_joints_are_enough_for_a_pose_and_five_are_not():
    estimator = FixedEstimator(network(torch.zeros(2, 6, dtype=DOUBLE)))
    goals = Goals.at(CENTRE, DOWN, torch.tensor([700.0, 500.0], dtype=DOUBLE))
    controller = AdaptiveController(arm("ur5e"), estimator, goals)
    assert controller.null_space_dimension() == 0
    assert controller.null_space_dimension("position") == 3


def test_a_step_of_the_longest_duration_is_valid():
    controller, _ = grasping(rng=sampling.generator(6))
    state = controller.initial_state(POSTURE)
    longest = controller.config.safety.longest_step
    for length, valid in ((longest, True), (1.001 * longest, False)):
        dt = torch.tensor(length, dtype=DOUBLE)
        command, after = controller.step(state, observe(POSTURE, dt=dt))
        assert command.safety.acted("invalid") != valid
        assert bool(after.blending.level > 0) == valid


def test_by_default_the_null_space_returns_with_a_second_and_at_most_0_4_rad_per_s():
    q = panda.ready
    pose = panda.forward(q)
    goals = Goals.at(pose.position, pose.orientation, torch.full((2,), 100.0, dtype=DOUBLE))
    rest, ahead = goals.resting_at(q).rest, torch.ones(7, dtype=DOUBLE) / 7**0.5
    assert rest is not None
    near, far = rest.gradient(q + 1e-4 * ahead), rest.gradient(q + 1e4 * ahead)
    torch.testing.assert_close(near, 1e-4 * ahead, rtol=1e-3, atol=0)
    torch.testing.assert_close(far, 0.4 * ahead, rtol=1e-3, atol=0)
