"""No number that is none outlives its step: not in the law, the filter, or a runner."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
import sampling
import torch
from servoing import CENTRE, DOUBLE, DOWN, LIMITS, POSTURE, network, overhead_camera, target_in
from step_equality import controller_and_observation
from torch import Tensor
from torch.utils import _pytree
from unchecked import shapes_unchecked

from hrc_learn.controller import (
    AdaptiveController,
    Goals,
    Observation,
    SafetyFilter,
)
from hrc_learn.deploy import EagerRunner
from hrc_learn.geometry import Pose
from hrc_learn.jacobian import (
    CompositeEstimator,
    KalmanEstimator,
)
from hrc_learn.kinematics import panda

pytestmark = pytest.mark.simulation

POISONS = {"nan": torch.nan, "inf": torch.inf, "-inf": -torch.inf}
DT = 0.02
ESTIMATORS = [CompositeEstimator, pytest.param(KalmanEstimator, marks=pytest.mark.long)]


@pytest.fixture(autouse=True)
def _fast() -> Iterator[None]:
    with shapes_unchecked(), torch.inference_mode():
        yield


class Scene:
    """Arms that servo on a marker while a person pulls, told all there is to tell."""

    def __init__(self, estimator: type, batch: int):
        rng = sampling.generator(3)
        self.camera = overhead_camera()
        self.target, _ = target_in(self.camera, rng=rng)
        J = self.camera.image_jacobian(Pose(CENTRE, DOWN))
        goals = Goals.at(CENTRE, DOWN, self.target).approached_by(POSTURE)
        self.goals = _pytree.tree_map(lambda x: x.expand(batch, *x.shape).clone(), goals)
        self.controller = AdaptiveController(panda, estimator(network(J)), goals)
        self.start = (POSTURE + 0.1).expand(batch, 7).clone()
        self.pull = 1.0 + torch.zeros(batch, 7, dtype=DOUBLE)

    def observe(self, q: Tensor) -> Observation:
        feature, visible = self.camera.project(panda.forward(q))
        return Observation(
            joint_position=q,
            feature=feature,
            feature_visible=visible,
            feature_new=torch.ones_like(visible),
            feature_age=torch.full_like(q[:, 0], 0.02),
            image_joint_position=q,
            joint_state_stale=torch.zeros_like(visible),
            nullspace_input=self.pull,
            human_distance=torch.full_like(q[:, 0], 3.0),
            stop=torch.zeros_like(visible),
            goals=self.goals,
            dt=torch.tensor(DT, dtype=DOUBLE),
        )


def numbers(tree: Any) -> list[tuple[str, Tensor]]:
    """Floating-point tensors of a pytree by name."""
    return [
        (_pytree.keystr(path).removeprefix("."), x)
        for path, x in _pytree.tree_flatten_with_path(tree)[0]
        if isinstance(x, Tensor) and x.is_floating_point()
    ]


def finite(tree: Any) -> Tensor:
    """Per arm, whether all numbers are."""
    parts = [x.isfinite().reshape(len(x), -1).all(-1) for _, x in numbers(tree) if x.dim() > 0]
    return torch.stack(parts).all(0)


def poisoned(tree: Any, name: str, arm: int, value: float) -> Any:
    """A copy with one number of one arm replaced; one that all arms share, for all."""
    leaves, structure = _pytree.tree_flatten_with_path(tree)
    changed = []
    for path, x in leaves:
        if _pytree.keystr(path).removeprefix(".") == name:
            x = x.clone()
            where = x[arm : arm + 1] if x.dim() > 0 else x
            where.view(-1)[:1] = value
        changed.append(x)
    return _pytree.tree_unflatten(changed, structure)


class Case(NamedTuple):
    where: str
    name: str
    value: float
    tick: int


def cases(scene: Scene, ticks: tuple[int, ...]) -> list[Case]:
    """Every number of state and observation but the step, which arms share, at each tick."""
    state = scene.controller.initial_state(scene.start)
    trees = {"state": state, "observation": scene.observe(scene.start)}
    return [
        Case(where, name, value, tick)
        for tick in ticks
        for where, tree in trees.items()
        for name, x in numbers(tree)
        if x.dim() > 0
        for value in POISONS.values()
    ]


def run(
    scene: Scene,
    steps: int,
    injected: list[Case] | None = None,
    dt: dict[int, float] | None = None,
) -> tuple[Tensor, Tensor, list[Tensor]]:
    """A tick of poison for each arm: arm k has case k, the arms after them none.

    Args:
        scene: With an arm for each case at least.
        steps: How many.
        injected: What, and when.
        dt: Other steps, by tick.

    Returns:
        Velocities and invalid flags at every step, and where the state was finite after it.
    """
    q, state = scene.start, scene.controller.initial_state(scene.start)
    velocities, invalid, healthy = [], [], []
    for k in range(steps):
        observation = scene.observe(q)
        for arm, case in enumerate(injected or ()):
            if case.tick != k:
                continue
            if case.where == "state":
                state = poisoned(state, case.name, arm, case.value)
            else:
                observation = poisoned(observation, case.name, arm, case.value)
        if dt is not None and k in dt:
            observation = replace(observation, dt=torch.tensor(dt[k], dtype=DOUBLE))
        command, state = scene.controller.step(state, observation)
        q = q + DT * command.joint_velocity
        velocities.append(command.joint_velocity)
        invalid.append(command.safety.acted("invalid"))
        healthy.append(finite(state))
    return torch.stack(velocities), torch.stack(invalid), healthy


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_one_tick_of_poison_leaves_the_next_healthy(estimator):
    """At the start and under way."""
    injected = cases(Scene(estimator, 1), (0, 15))
    assert {"goals.orientation.goal", "goals.vision.target", "feature_age"} <= {
        c.name for c in injected
    }
    scene = Scene(estimator, len(injected) + 1)
    velocities, invalid, healthy = run(scene, 160, injected)
    clean = velocities[:, -1]
    for k, known in enumerate(healthy):
        assert known.all(), (k, [c for c, ok in zip(injected, known, strict=False) if not ok])
    assert velocities.isfinite().all()
    for tick in (0, 15):
        assert invalid[tick].any()
    for arm, case in enumerate(injected):
        assert not invalid[case.tick + 1 :, arm].any(), case
        if case.name in ("safety.velocity", "safety.acceleration"):
            assert invalid[case.tick, arm], case
        # Half a second later it moves as ever, and ends where the others do.
        later = case.tick + 25
        speed = velocities[later, arm].norm() / clean[later].norm()
        assert 0.5 < speed < 2, (case, speed)
    ends = panda.forward(scene.start + DT * velocities.sum(0))
    apart = ends[:-1].twist_to(ends[-1:]).norm(dim=-1)
    # The box is 0.24 m wide: an arm that approaches anew may end elsewhere in it.
    assert (apart < 0.03).all(), [
        c for c, far in zip(injected, apart >= 0.03, strict=True) if far
    ]


@pytest.mark.long
def test_steps_of_no_length_brake_for_one_tick_each():
    """By the last length that was valid: within the limits of acceleration."""
    scene = Scene(KalmanEstimator, 1)
    bad = dict(zip(range(0, 72, 12), [*POISONS.values(), 0.0, -0.01, 0.3], strict=True))
    velocities, invalid, healthy = run(scene, 100, dt=bad)
    usual, _, _ = run(scene, 100)
    assert invalid[:, 0].nonzero().flatten().tolist() == list(bad)
    assert torch.stack(healthy).all()
    change = velocities[:, 0].diff(dim=0, prepend=torch.zeros(1, 7, dtype=DOUBLE)) / DT
    assert (change.abs() <= LIMITS.acceleration * (1 + 1e-9)).all()
    speed = velocities[:, 0].norm(dim=-1)
    for tick in list(bad)[1:]:
        assert speed[tick] < speed[tick - 1]
        assert speed[tick + 11] > 0.5 * usual[tick + 11].norm()
    ends = [panda.forward(scene.start[0] + DT * v[:, 0].sum(0)) for v in (velocities, usual)]
    # It is up to six ticks behind.
    assert ends[0].twist_to(ends[1]).norm() < 0.03


FILTER_ARGUMENTS = {
    "joint_position": lambda q: q,
    "joint_velocity_command": lambda q: 0.3 * torch.ones_like(q),
    "jacobian": panda.jacobian,
    "human_distance": lambda q: torch.full_like(q[..., 0], 3.0),
    "dt": lambda q: torch.tensor(DT, dtype=DOUBLE),
    "load": lambda q: torch.tensor([0.0, 0.0, 0.1], dtype=DOUBLE).expand(*q.shape[:-1], 3),
}


FILTER_POISONS = [*POISONS.values(), 1e300]


@pytest.mark.parametrize(
    ("name", "values"),
    [
        *((name, FILTER_POISONS) for name in FILTER_ARGUMENTS if name != "dt"),
        *(("dt", [value]) for value in FILTER_POISONS),  # one for all arms
        *(
            (f"state.{name}", FILTER_POISONS)
            for name in ("velocity", "acceleration", "position")
        ),
    ],
)
def test_the_filter_alone_brakes_for_one_tick_and_forgets(name, values):
    values = torch.tensor(values, dtype=DOUBLE)
    safety, q = SafetyFilter(panda), panda.ready.expand(len(values), -1)
    state = safety.initial_state(q)
    # Far away people stop nobody, and a state that knows no position asks the encoders.
    harmless = (values > 0) if name == "human_distance" else torch.tensor(False)
    harmless = (harmless | (name == "state.position")).expand(len(values))
    speeds = []
    for k in range(60):
        inputs = {key: make(q) for key, make in FILTER_ARGUMENTS.items()}
        if k == 30 and name.startswith("state."):
            for row, value in enumerate(values.tolist()):
                state = poisoned(state, name.removeprefix("state."), row, value)
        elif k == 30:
            shape = inputs[name].shape
            inputs[name] = (
                values.view(-1, *(1 for _ in shape[1:])).expand(shape) if shape else values[0]
            )
        v, state, report = safety.step(state, **inputs)
        q = q + DT * v
        speeds.append(v.norm(dim=-1))
        assert v.isfinite().all()
        assert all(x.isfinite().all() for _, x in numbers(state))
        expected = (
            ~harmless if k == 30 and name != "human_distance" else torch.zeros_like(harmless)
        )
        assert torch.equal(report.acted("invalid").expand(len(values)), expected)
        if k == 30:
            assert (harmless | (speeds[30] < speeds[29])).all()
    assert LIMITS.contain(q).all()
    torch.testing.assert_close(v, inputs["joint_velocity_command"])


def test_a_runner_that_reads_nothing_but_nan_recovers():
    """As one does whose arrays have not been written yet."""
    runner = EagerRunner(*controller_and_observation())
    usual = {name: array.copy() for name, array in runner.observation.items()}
    healthy = [runner.step().copy() for _ in range(50)][-1]
    for name, array in runner.observation.items():
        array[...] = np.nan if array.dtype.kind == "f" else array
        assert np.isfinite(runner.step()).all(), name
        array[...] = usual[name]
    velocities = [runner.step().copy() for _ in range(50)]
    assert np.linalg.norm(velocities[-1]) > 0.5 * np.linalg.norm(healthy)
    runner.start(np.full(7, np.nan))
    velocities = [runner.step().copy() for _ in range(50)]
    assert np.isfinite(velocities).all()
    assert np.linalg.norm(velocities[-1]) > 0.5 * np.linalg.norm(healthy)
