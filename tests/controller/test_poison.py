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
from hrc_learn.deploy.export import trace
from hrc_learn.deploy.package import PackedStep, Vectors
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import (
    CompositeEstimator,
    FixedEstimator,
    KalmanEstimator,
    PaperEstimator,
    RecursiveLeastSquaresEstimator,
)
from hrc_learn.kinematics import panda
from hrc_learn.regions import PostureRegion

POISONS = {"nan": torch.nan, "inf": torch.inf, "-inf": -torch.inf}
DT = 0.01
ESTIMATORS = [
    FixedEstimator,
    PaperEstimator,
    CompositeEstimator,
    RecursiveLeastSquaresEstimator,
    KalmanEstimator,
]


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
        position = replace(
            goals.position, rotation=quaternion.normalize(torch.ones(4).double())
        )
        goals = replace(goals, position=position)
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
            target=self.target.expand(len(q), 2).clone(),
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


def cases(scene: Scene) -> list[Case]:
    """Every number of state and observation but the step, which all arms share."""
    state = scene.controller.initial_state(scene.start)
    trees = {"state": state, "observation": scene.observe(scene.start)}
    return [
        Case(where, name, value)
        for where, tree in trees.items()
        for name, x in numbers(tree)
        if x.dim() > 0
        for value in POISONS.values()
    ]


def run(
    scene: Scene, tick: int, injected: list[Case], dt: float | None = None, steps: int = 320
) -> tuple[Tensor, Tensor, list[Tensor]]:
    """One tick of poison: arm k has case k, the arms after them none.

    Returns:
        Velocities and invalid flags at every step, and where the state was finite after it.
    """
    q, state = scene.start, scene.controller.initial_state(scene.start)
    velocities, invalid, healthy = [], [], []
    for k in range(steps):
        observation = scene.observe(q)
        if k == tick:
            for arm, case in enumerate(injected):
                if case.where == "state":
                    state = poisoned(state, case.name, arm, case.value)
                else:
                    observation = poisoned(observation, case.name, arm, case.value)
            if dt is not None:
                observation = replace(observation, dt=torch.tensor(dt, dtype=DOUBLE))
        command, state = scene.controller.step(state, observation)
        q = q + DT * command.joint_velocity
        velocities.append(command.joint_velocity)
        invalid.append(command.safety.acted("invalid"))
        healthy.append(finite(state))
    return torch.stack(velocities), torch.stack(invalid), healthy


def assert_recovered(
    scene: Scene, tick: int, velocities: Tensor, invalid: Tensor, names
) -> None:
    clean = velocities[:, -1]
    assert velocities.isfinite().all()
    for arm, name in enumerate(names):
        assert not invalid[tick + 1 :, arm].any(), name
        # Half a second later it moves as ever, and ends where the others do.
        speed = velocities[tick + 50, arm].norm() / clean[tick + 50].norm()
        assert 0.5 < speed < 2, (name, speed)
        ends = scene.start[0] + DT * torch.stack([velocities[:, arm], clean]).sum(1)
        apart = panda.forward(ends[0]).twist_to(panda.forward(ends[1])).norm()
        # The box is 0.24 m wide: an arm that approaches anew may end elsewhere in it.
        assert apart < 0.03, (name, apart)


@pytest.mark.parametrize("tick", [0, 30])
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_one_tick_of_poison_leaves_the_next_healthy(estimator, tick):
    injected = cases(Scene(estimator, 1))
    assert {"goals.orientation.goal", "target", "feature_age"} <= {c.name for c in injected}
    scene = Scene(estimator, len(injected) + 1)
    velocities, invalid, healthy = run(scene, tick, injected)
    for k, known in enumerate(healthy):
        assert known.all(), (k, [c for c, ok in zip(injected, known, strict=False) if not ok])
    assert invalid[tick].any()
    assert_recovered(scene, tick, velocities, invalid, injected)


@pytest.mark.parametrize("value", [*POISONS.values(), 0.0, -0.01, 0.3])
@pytest.mark.parametrize("tick", [0, 30])
def test_a_step_of_no_length_brakes_for_one_tick(tick, value):
    """By the last length that was valid: within the limits of acceleration and jerk."""
    scene = Scene(KalmanEstimator, 1)
    velocities, invalid, healthy = run(scene, tick, [], dt=value, steps=120)
    usual, _, _ = run(scene, -1, [], steps=120)
    assert invalid[:, 0].nonzero().flatten().tolist() == [tick]
    assert torch.stack(healthy).all()
    change = velocities[:, 0].diff(dim=0, prepend=torch.zeros(1, 7, dtype=DOUBLE)) / DT
    assert (change.abs() <= LIMITS.acceleration * (1 + 1e-9)).all()
    if tick > 0:
        assert velocities[tick, 0].norm() < velocities[tick - 1, 0].norm()
    assert_recovered(scene, tick, torch.cat([velocities, usual], dim=1), invalid, [value])


FILTER_ARGUMENTS = {
    "joint_position": lambda q: q,
    "joint_velocity_command": lambda q: 0.3 * torch.ones_like(q),
    "jacobian": panda.jacobian,
    "human_distance": lambda q: torch.tensor(3.0, dtype=DOUBLE),
    "dt": lambda q: torch.tensor(DT, dtype=DOUBLE),
    "bounds": SafetyFilter(LIMITS).velocity_bounds,
}


@pytest.mark.parametrize("value", [*POISONS.values(), 1e300])
@pytest.mark.parametrize(
    "name", [*FILTER_ARGUMENTS, "state.velocity", "state.acceleration", "state.position"]
)
def test_the_filter_alone_brakes_for_one_tick_and_forgets(name, value):
    safety, q = SafetyFilter(LIMITS), panda.ready
    state = safety.initial_state(q)
    speeds = []
    for k in range(60):
        inputs = {key: make(q) for key, make in FILTER_ARGUMENTS.items()}
        if k == 30 and name.startswith("state."):
            state = poisoned(state, name.removeprefix("state."), 0, value)
        elif k == 30:
            broken = _pytree.tree_map(lambda x: torch.full_like(x, value), inputs[name])
            inputs |= {name: broken}
        v, state, report = safety.step(state, **inputs)
        q = q + DT * v
        speeds.append(v.norm())
        assert v.isfinite().all()
        assert all(x.isfinite().all() for _, x in numbers(state))
        # Far away people stop nobody, and a state that knows no position asks the encoders.
        harmless = name == "state.position" or (name == "human_distance" and value > 0)
        assert bool(report.acted("invalid")) == (
            k == 30 and not harmless and name != "human_distance"
        )
        if k == 30 and not harmless:
            assert speeds[30] < speeds[29]
    assert LIMITS.contain(q)
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


def test_a_traced_step_takes_poison_as_the_eager_one_does():
    """Any number of the observation, the step among them, in the graph that is exported."""
    controller, observation = controller_and_observation()
    observation = replace(observation, dt=torch.tensor(0.002, dtype=DOUBLE))
    step = PackedStep(controller, observation)
    program = trace(step, observation).module()
    vectors = step.example(observation)
    for _ in range(20):
        program(*vectors)
    usual = vectors.command[step.layouts.command.rows["joint_velocity"]].norm()
    assert usual > 0.05
    for field in step.layouts.observation.fields:
        for value in POISONS.values() if field.dtype.is_floating_point else ():
            example = step.example(observation)
            seen = vectors._replace(observation=example.observation.clone())
            seen.observation[step.layouts.observation.rows[field.name]] = value
            expected = Vectors(*(x.clone() for x in seen))
            program(*seen)
            step(*expected)
            for got, wanted in zip(seen, expected, strict=True):
                torch.testing.assert_close(got, wanted, rtol=1e-9, atol=1e-9, equal_nan=True)
            velocity = seen.command[step.layouts.command.rows["joint_velocity"]]
            assert velocity.isfinite().all(), field.name
            assert seen.state.isfinite().all(), field.name
            for _ in range(20):
                program(seen.state, example.observation, seen.command)
            assert 0.5 * usual < velocity.norm() < 2 * usual, field.name


@pytest.mark.parametrize(
    "ticks", [10_000, pytest.param(100_000, marks=pytest.mark.slow)], ids=str
)
def test_hostile_ticks_break_no_limit_and_leave_an_arm_that_moves(ticks):
    """A third of the ticks of each arm have a number that is none, or far off, somewhere in
    state or observation; a tenth a step of no length; goals jump, people come and go."""
    arms = 50
    scene, rng = Scene(CompositeEstimator, arms), sampling.generator(8)
    injected = cases(Scene(CompositeEstimator, 1))
    # Where an arm is told to be somewhere else it can keep no limits.
    memory = ("safety.velocity", "safety.acceleration")
    injected = [c for c in injected if c.name not in memory]
    values = [*POISONS.values(), 1e300, -1e30]

    def draw(below: int) -> int:
        return int(torch.randint(below, (1,), generator=rng))

    q, state = scene.start, scene.controller.initial_state(scene.start)
    scene.goals = scene.goals.approached_by(None)
    before = torch.zeros_like(q)
    for k in range(ticks // arms):
        if k % 50 == 0:
            jump = 0.3 * torch.randn(arms, 3, generator=rng, dtype=DOUBLE)
            scene.goals = scene.goals.moved_to(CENTRE + jump)
            scene.pull = 10 * torch.randn(arms, 7, generator=rng, dtype=DOUBLE)
        observation = scene.observe(q)
        near = torch.rand(arms, generator=rng, dtype=DOUBLE) < 0.05
        distance = 3.0 - 2.7 * near.double()
        observation = replace(observation, human_distance=distance)
        for arm in range(arms):
            if draw(3) == 0:
                case, value = injected[draw(len(injected))], values[draw(len(values))]
                if case.where == "state":
                    state = poisoned(state, case.name, arm, value)
                else:
                    observation = poisoned(observation, case.name, arm, value)
        if draw(10) == 0:
            dt = torch.tensor([*POISONS.values(), -0.01, 5.0][draw(5)], dtype=DOUBLE)
            observation = replace(observation, dt=dt)
        command, state = scene.controller.step(state, observation)
        v = command.joint_velocity
        q = q + DT * v
        assert finite(state).all()
        assert LIMITS.contain(q).all()
        assert (v.abs() <= LIMITS.velocity).all()
        assert ((v - before).abs() <= DT * LIMITS.acceleration * (1 + 1e-9)).all()
        before = v
    # Healthy again: each arm goes where it is told to.
    ready = PostureRegion(goal=panda.ready.expand_as(q), tolerance=0.05)
    scene.goals = replace(scene.goals, posture=ready)
    scene.pull = torch.zeros_like(q)
    away = (panda.ready - q).norm(dim=-1)
    assert away.median() > 0.5
    for _ in range(500):
        command, state = scene.controller.step(state, scene.observe(q))
        assert not command.safety.acted("invalid").any()
        q = q + DT * command.joint_velocity
    assert ((panda.ready - q).norm(dim=-1) < 0.3).all()
