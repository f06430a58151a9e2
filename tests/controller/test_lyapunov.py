"""V falls at the rate |s|^2 under the assumptions of docs/concepts/controller.md, and only
then."""

import sampling
import torch
from torch import Tensor
from unchecked import shapes_unchecked

from hrc_learn.controller import (
    AdaptiveController,
    ControllerConfig,
    Goals,
    Observation,
)
from hrc_learn.geometry import quaternion
from hrc_learn.jacobian import FixedEstimator, PaperEstimator, RBFImageJacobian, paper_grid
from hrc_learn.kinematics import panda

DOUBLE = torch.float64
GAIN = 3e6
J0 = torch.tensor([[-1500.0, 0, 0, 0, -200, 60], [0, 2400, 170, -200, 0, 180]], dtype=DOUBLE)


def lyapunov_function(potential: Tensor, weight_error: Tensor) -> Tensor:
    """V = P + 1/2 tr(W~ L^-1 W~^T) of (vt), with L = GAIN I and the 1/2 missing in print."""
    return potential + weight_error.square().sum((-2, -1)) / (2 * GAIN)


def lyapunov_rate(s: Tensor) -> Tensor:
    """V_dot = -|s|^2 where the assumptions hold."""
    return -torch.linalg.vecdot(s, s)


def run(estimator_of, *, steps: int = 60, dt: float = 2e-3) -> dict[str, Tensor]:
    """V, s and P along a motion that keeps every assumption: the image moves by J_s = W theta
    exactly, nothing is capped or filtered, the feature is followed all along."""
    rng = sampling.generator(2)
    true = RBFImageJacobian.from_jacobian(J0, paper_grid(), 0.1)
    guess = RBFImageJacobian.from_jacobian(J0, paper_grid(), 0.1)
    noise = torch.randn(12, 9, generator=rng, dtype=DOUBLE)
    guess.weight.data = guess.weight * (1 + 0.4 * noise)
    q = panda.ready + 0.1 * torch.randn(8, 7, generator=rng, dtype=DOUBLE)
    tool = panda.forward(q)
    away = quaternion.exp(0.3 * sampling.directions(8, rng=rng))
    target = torch.tensor([700.0, 520.0], dtype=DOUBLE)
    goals = Goals.at(
        tool.position + 0.2 * sampling.directions(8, rng=rng),
        quaternion.multiply(away, tool.orientation),
        target,
    )
    x = target + 200 * torch.randn(8, 2, generator=rng, dtype=DOUBLE).clamp(-1, 1)
    controller = AdaptiveController(
        panda, estimator_of(guess), goals, config=ControllerConfig.paper()
    )
    state = controller.initial_state(q)
    history: dict[str, list[Tensor]] = {"V": [], "s": [], "P": [], "rate": []}
    with shapes_unchecked(), torch.no_grad():
        for _ in range(steps):
            error = true.weight - state.estimator.weight
            observation = Observation(
                joint_position=q,
                feature=x,
                feature_visible=torch.ones(8, dtype=torch.bool),
                dt=dt,
            )
            command, state = controller.step(state, observation)
            history["V"].append(lyapunov_function(command.potential, error))
            history["s"].append(command.s)
            history["P"].append(command.potential)
            history["rate"].append(command.potential_rate)
            J = panda.jacobian(q)
            velocity = (torch.linalg.pinv(J) @ command.twist[..., None])[..., 0]
            x = x + dt * (true(panda.forward(q)) @ command.twist[..., None])[..., 0]
            q = q + dt * velocity
    return {name: torch.stack(values) for name, values in history.items()}


def test_v_falls_at_the_rate_that_the_theory_gives():
    dt = 2e-3
    past = run(lambda network: PaperEstimator(network, gain=GAIN), dt=dt)
    measured = past["V"].diff(dim=0) / dt
    expected = lyapunov_rate(past["s"])
    assert (measured <= 0).all()
    assert (expected < -1e-5).any()
    # The Euler step is right to first order in dt: the mean of both ends to second.
    middle = (expected[1:] + expected[:-1]) / 2
    error = (measured - middle).abs().amax()
    assert error < 0.02 * middle.abs().amax()
    half = run(lambda network: PaperEstimator(network, gain=GAIN), steps=120, dt=dt / 2)
    finer = half["V"].diff(dim=0) / (dt / 2)
    middle = (lyapunov_rate(half["s"])[1:] + lyapunov_rate(half["s"])[:-1]) / 2
    assert (finer - middle).abs().amax() < 0.7 * error


def test_the_update_has_its_share_in_the_balance():
    """Without it the trace rests and V need not fall at the rate of the theory."""
    shares = {}
    for kind in (FixedEstimator, lambda network: PaperEstimator(network, gain=GAIN)):
        past = run(kind, steps=20)
        trace = past["V"] - past["P"]
        shares[kind is FixedEstimator] = (trace[-1] - trace[0]).abs().amax()
    assert shares[True] < 1e-12
    assert shares[False] > 1e-6


def test_the_rate_of_the_command_is_that_of_the_potential():
    """Against the measured change, with the right Jacobian and the filter in the loop."""
    goals_rng = sampling.generator(3)
    network = RBFImageJacobian.from_jacobian(J0, paper_grid(), 0.1)
    q = panda.ready
    tool = panda.forward(q)
    goals = Goals.at(
        tool.position + 0.25 * sampling.directions(rng=goals_rng),
        tool.orientation,
        torch.tensor([700.0, 520.0], dtype=DOUBLE),
    )
    controller = AdaptiveController(panda, FixedEstimator(network), goals)
    state = controller.initial_state(q)
    dt, potentials, rates = 1e-3, [], []
    hidden = torch.tensor(False)
    feature = torch.zeros(2, dtype=DOUBLE)
    for _ in range(40):
        command, state = controller.step(
            state,
            Observation(joint_position=q, feature=feature, feature_visible=hidden, dt=dt),
        )
        potentials.append(command.potential)
        rates.append(command.potential_rate)
        q = q + dt * command.joint_velocity
    P, rate = torch.stack(potentials), torch.stack(rates)
    assert (rate <= 0).all()
    torch.testing.assert_close(P.diff() / dt, rate[:-1], rtol=2e-2, atol=1e-7)
