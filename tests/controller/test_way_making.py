"""Making way by the null space."""

from dataclasses import replace

import pytest
import sampling
import servoing
import torch
from torch import Tensor
from unchecked import shapes_unchecked

from hrc_learn.controller import (
    AdaptiveController,
    ConstraintConfig,
    ControllerConfig,
    Distances,
    Goals,
    Observation,
    SafetyConfig,
    WayMakingConfig,
)
from hrc_learn.controller.task_pace import way_making_velocity
from hrc_learn.jacobian import FixedEstimator, RBFImageJacobian, paper_grid
from hrc_learn.kinematics import panda

DOUBLE = torch.float64


def pairs(distance: Tensor, gradient: Tensor) -> Distances:
    return Distances(
        distance=distance, gradient=gradient, approach_speed=torch.zeros_like(distance)
    )


def potential(distance: Tensor, config: WayMakingConfig) -> Tensor:
    """Minus the integral of the speed over the smoothed least distance, by Simpson's rule."""
    least = -config.smoothing * torch.logsumexp(-distance / config.smoothing, -1)
    level = ((config.far - least) / (config.far - config.near)).clamp(0, 1)
    # Of 3 x^2 - 2 x^3, from zero at `far` on.
    return config.speed * (config.far - config.near) * (level**3 - level**4 / 2)


def test_it_goes_down_a_potential_of_the_distances():
    """Along its gradient by autograd, and as fast as it is steep by the smoothed distance."""
    rng, config = sampling.generator(), WayMakingConfig()
    gradient = torch.randn(40, 3, 7, generator=rng, dtype=DOUBLE)
    offset = 0.1 + 0.18 * torch.rand(40, 3, generator=rng, dtype=DOUBLE)
    q = torch.zeros(40, 7, dtype=DOUBLE, requires_grad=True)
    distance = offset + (gradient @ q.unsqueeze(-1)).squeeze(-1)
    least = -config.smoothing * torch.logsumexp(-distance / config.smoothing, -1)
    (down,) = torch.autograd.grad(-potential(distance, config).sum(), q, retain_graph=True)
    (steep,) = torch.autograd.grad(least.sum(), q)
    velocity = way_making_velocity(pairs(offset, gradient), config)
    expected = down / steep.norm(dim=-1, keepdim=True)
    assert velocity.norm(dim=-1).min() > 0
    torch.testing.assert_close(velocity, expected)


def test_it_begins_far_and_is_fastest_near():
    config = WayMakingConfig()
    distance = torch.tensor([[0.31], [0.3], [0.29], [0.19], [0.08], [-0.1]], dtype=DOUBLE)
    gradient = torch.eye(7, dtype=DOUBLE)[2].expand(6, 1, 7)
    speed = way_making_velocity(pairs(distance, gradient), config)[:, 2]
    assert (speed[:2] == 0).all()
    assert 0 < speed[2] < 0.01 * config.speed
    torch.testing.assert_close(speed[3:], config.speed * speed.new_tensor([0.5, 1.0, 1.0]))


def test_what_is_unknown_or_moves_with_no_joint_asks_for_nothing():
    gradient = torch.zeros(3, 2, 7, dtype=DOUBLE)
    gradient[1:] = 0.3
    distance = torch.full((3, 2), 0.1, dtype=DOUBLE)
    distance[1, 0] = torch.nan
    velocity = way_making_velocity(pairs(distance, gradient))
    assert not velocity[:2].any()
    assert velocity[2].all()


def controller(mode: str, constraints: ConstraintConfig | None = None) -> AdaptiveController:
    J = torch.ones(2, 6, dtype=DOUBLE)
    network = RBFImageJacobian.from_jacobian(J, paper_grid(), 0.1)
    config = ControllerConfig(
        way_making=WayMakingConfig(mode=mode),  # pyright: ignore[reportArgumentType]
        safety=SafetyConfig(constraints=constraints),
    )
    goals = Goals.at(servoing.CENTRE, servoing.DOWN)
    return AdaptiveController(panda, FixedEstimator(network), goals, config=config)


def elbow_near(q: Tensor, obstacle: Tensor) -> Distances:
    """Of the elbow from a point; its gradient by central differences."""
    step = 1e-6 * torch.eye(7, dtype=DOUBLE)

    def distance(q: Tensor) -> Tensor:
        return (panda.joint_origins(q)[..., 3, :] - obstacle).norm(dim=-1, keepdim=True)

    gradient = (distance(q + step) - distance(q - step)).mT / 2e-6
    return pairs(distance(q), gradient)


def run(mode: str, constraints: ConstraintConfig | None = None) -> tuple[float, float]:
    """Distance of the elbow [m] and motion of the tool [m] after a person, who pushes it
    towards an obstacle, has had their way for 2 s.
    """
    law = controller(mode, constraints)
    q = servoing.POSTURE
    tool = panda.forward(q).position
    obstacle = panda.joint_origins(q)[3] + torch.tensor([0.0, 0.0, 0.2], dtype=DOUBLE)
    state, near = law.initial_state(q), elbow_near(q, obstacle)
    for _ in range(50):
        near = elbow_near(q, obstacle)
        observation = Observation(
            joint_position=q,
            feature=torch.zeros(2, dtype=DOUBLE),
            feature_visible=torch.tensor(False),
            nullspace_input=-3 * near.gradient[0] / near.gradient.norm(),
            distances=near,
            dt=0.04,
        )
        command, state = law.step(state, observation)
        q = q + 0.04 * command.joint_velocity
    moved = (panda.forward(q).position - tool).norm()
    return float(near.distance), float(moved)


@pytest.mark.long
def test_the_four_modes():
    """A person who pushes the elbow towards an obstacle, 0.2 m away at first."""
    with shapes_unchecked():
        distance, moved = map(list, zip(*(run(mode) for mode in MODES), strict=True))
    none, expert, automatic, both = distance
    assert none == pytest.approx(0.2, abs=0.02)
    assert automatic > none + 0.02
    assert expert < none - 0.05
    assert expert < both < automatic
    assert max(moved) < 1e-3


MODES = ("none", "expert", "automatic", "both")


def test_constraints_hold_against_a_person_who_pushes():
    with shapes_unchecked():
        distance, moved = run("expert", ConstraintConfig(clearance=0.12))
    assert distance == pytest.approx(0.12, abs=5e-3)
    assert moved < 2e-3


def test_nothing_changes_without_it():
    """Distances far away and `mode` "expert" are as if nobody had told them."""
    J = torch.ones(2, 6, dtype=DOUBLE)
    network = RBFImageJacobian.from_jacobian(J, paper_grid(), 0.1)
    goals = Goals.at(servoing.CENTRE, servoing.DOWN)
    plain = AdaptiveController(panda, FixedEstimator(network), goals)
    q = servoing.POSTURE + 0.1
    observation = Observation(
        joint_position=q,
        feature=torch.zeros(2, dtype=DOUBLE),
        feature_visible=torch.tensor(False),
        nullspace_input=torch.ones(7, dtype=DOUBLE),
        dt=0.004,
    )
    expected, _ = plain.step(plain.initial_state(q), observation)
    for mode, distance in (("expert", 0.01), ("both", 9.0)):
        law = controller(mode)
        near = pairs(torch.full((1,), distance, dtype=DOUBLE), torch.ones(1, 7, dtype=DOUBLE))
        command, _ = law.step(law.initial_state(q), replace(observation, distances=near))
        assert torch.equal(command.joint_velocity, expected.joint_velocity)


@pytest.mark.parametrize(
    ("name", "value"), [("mode", "people"), ("far", 0.05), ("speed", 0.0), ("smoothing", -1.0)]
)
def test_settings_out_of_range_are_refused(name: str, value: float | str):
    with shapes_unchecked(), pytest.raises(ValueError, match=name):
        WayMakingConfig(**{name: value})  # pyright: ignore[reportArgumentType]
