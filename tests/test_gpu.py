"""What runs in batches does on a GPU what it does on the CPU."""

from collections.abc import Callable

import constraint_states
import pytest
import sampling
import step_equality
import torch
from demo_motions import arm_motion
from pinhole import Pinhole, image_demonstrations, wander
from torch import Tensor
from torch.utils import _pytree

from hrc_learn.controller.constraint_layer import constrained_velocity
from hrc_learn.dmp import JointDMP, MotionHead, ProbabilisticDMP
from hrc_learn.dmp.learned_motion import choose
from hrc_learn.jacobian import RBFCenters, RBFImageJacobian, paper_grid
from hrc_learn.kinematics import ArmChoice, panda, separation, solve_inverse

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
DOUBLE = torch.float64


def to(device: str, tree):
    return _pytree.tree_map(lambda x: x.to(device) if isinstance(x, Tensor) else x, tree)


def postures(count: int) -> Tensor:
    limits = panda.limits
    return sampling.within(
        limits.lower, limits.upper, count, rng=sampling.generator(0), margin=0.1
    )


def kinematics(device: str):
    q = postures(50).to(device)
    return panda.forward(q), panda.transform_and_jacobian(q)


def inverse(device: str):
    q = postures(20).to(device)
    found = solve_inverse(panda, panda.forward(q), near=q + 0.05)
    return panda.forward(found.position), found.found


def analytic_inverse(device: str):
    q = postures(20).to(device)
    return ArmChoice("panda").work_arm().inverse(panda.forward(q), near=q)


def self_distance(device: str):
    return panda.whole.self_distance(postures(50).to(device))


def distance_to_a_person(device: str):
    rng = sampling.generator(1)
    ends = 0.5 * torch.randn(50, 5, 2, 3, generator=rng, dtype=DOUBLE)
    radius = torch.full((50, 5), 0.1, dtype=DOUBLE)
    found = separation(panda.whole, postures(50).to(device), ends.to(device), radius.to(device))
    return found.distance, found.gradient


def image_jacobian(device: str):
    camera = Pinhole.overhead(roll=0.7)
    poses = wander(100, 3, rng=sampling.generator(0))
    features = camera.project(poses)
    network = RBFImageJacobian.fit(
        image_demonstrations([to(device, poses[i]) for i in range(3)], features.to(device)),
        RBFCenters(centers=paper_grid().to(device), width=0.1),
    )
    return network(to(device, poses)), network.uncertainty(to(device, poses[0]))


def controller(device: str):
    step, observation = step_equality.controller_and_observation(postures(8))
    step, observation = step.to(device), to(device, observation)
    state = step.initial_state(observation.joint_position)
    for _ in range(20):
        command, state = step.step(state, observation)
    return command, state


def constraint_layer(device: str):
    state = constraint_states.of_panda(200)
    velocity, report = constrained_velocity(*to(device, state.arguments))
    return velocity, report.slowed


def motion_head(device: str):
    head = MotionHead(2, 6, duration=(1.0, 3.0), delay=0.5).double().to(device)
    x = torch.randn(4, head.n_parameters, generator=sampling.generator(3), dtype=DOUBLE)
    time = torch.linspace(0, 2.5, 41, dtype=DOUBLE, device=device)
    start = torch.zeros(4, 2, dtype=DOUBLE, device=device)
    motion = head(x.to(device), time, start)
    return motion.position, motion.velocity


def demonstrations(device: str) -> tuple[Tensor, Tensor]:
    time, position = zip(*(arm_motion(n_joints=2, seed=seed) for seed in range(8)), strict=True)
    return time[0].to(device), torch.stack(position).to(device)


def distribution(device: str):
    time, position = demonstrations(device)
    dmps = JointDMP.fit(time, position, 8, scaling="none")
    known = ProbabilisticDMP.fit(dmps, slack=0.1)
    middle = known.condition([1.0], position[:1, 50], noise=1e-2)
    drawn = known.sample(3, sampling.generator(0)).rollout().position
    log_prob = known.log_prob([0.5, 1.0], position[0, 25:27], noise=0.01)
    # In which order its directions are is up to the decomposition.
    return middle.position(time), drawn.shape, log_prob


def contexts(device: str):
    time, position = demonstrations(device)
    context = position[:, -1]
    model = choose([JointDMP.fit(time, position, 8)], context, regression_only=True)
    return model.at_contexts(context[:3] + 0.01).rollout().position


@pytest.mark.parametrize(
    "compute",
    [
        kinematics,
        inverse,
        analytic_inverse,
        self_distance,
        distance_to_a_person,
        image_jacobian,
        controller,
        constraint_layer,
        motion_head,
        distribution,
        contexts,
    ],
)
def test_a_gpu_does_what_the_cpu_does(compute: Callable[[str], object]):
    cpu, gpu = (_pytree.tree_leaves(compute(device)) for device in ("cpu", "cuda"))
    for expected, value in zip(cpu, gpu, strict=True):
        if isinstance(value, Tensor):
            assert value.is_cuda
            torch.testing.assert_close(value.cpu(), expected, rtol=1e-6, atol=1e-6)
        else:
            assert value == expected
