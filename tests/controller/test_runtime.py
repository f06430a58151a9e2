"""The exported step against the eager one, and the arrays around it."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import sampling
import torch
from torch import Tensor
from unchecked import shapes_unchecked

from hrc_learn.controller import (
    GRIPPER_DOWN,
    INITIAL_IMAGE_JACOBIAN,
    AdaptiveController,
    Goals,
    Observation,
)
from hrc_learn.controller.runtime import NoCompilerError, StepRunner, export_step, open_step
from hrc_learn.controller.runtime import export as export_module
from hrc_learn.controller.runtime.export import read_example, trace
from hrc_learn.controller.runtime.flat import FlatStep
from hrc_learn.controller.runtime.runner import open_package
from hrc_learn.geometry import quaternion
from hrc_learn.jacobian import KalmanEstimator, RBFImageJacobian, paper_grid
from hrc_learn.kinematics import panda

ROOT = Path(__file__).parents[2]
DOUBLE = torch.float64


@pytest.fixture(autouse=True)
def _no_shape_checks() -> Iterator[None]:
    """Tracers cannot follow them."""
    with shapes_unchecked():
        yield


def controller_and_observation(
    q: Tensor = panda.ready,
) -> tuple[AdaptiveController, Observation]:
    J = torch.tensor(INITIAL_IMAGE_JACOBIAN, dtype=DOUBLE)
    network = RBFImageJacobian.from_jacobian(J, paper_grid(), 0.1)
    down = quaternion.normalize(q.new_tensor(GRIPPER_DOWN))
    goals = Goals.at(q.new_tensor((0.4, 0.1, 0.4)), down, q.new_tensor((700.0, 500.0)))
    controller = AdaptiveController(panda, KalmanEstimator(network), goals)
    observation = Observation(
        joint_position=q,
        feature=q.new_tensor((600.0, 600.0)),
        feature_visible=torch.tensor(True),
        feature_new=torch.tensor(True),
        feature_age=torch.tensor(0.0, dtype=DOUBLE),
        image_joint_position=q,
        human_effort=torch.zeros_like(q),
        goals=goals,
        dt=0.002,
    )
    return controller, observation


def observe_at_random(arrays: dict[str, np.ndarray], rng: np.random.Generator) -> None:
    """Anything a robot may report: lost and NaN features, people, NaN and fast joints."""
    lower, upper = panda.limits.lower.numpy(), panda.limits.upper.numpy()
    near = arrays["joint_position"] + 0.003 * rng.standard_normal(7)
    anywhere = rng.uniform(lower, upper)
    arrays["image_joint_position"][:] = near
    arrays["joint_position"][:] = near if rng.random() < 0.9 else anywhere
    arrays["feature"][:] += 3 * rng.standard_normal(2)
    if rng.random() < 0.1 or not np.isfinite(arrays["feature"]).all():
        arrays["feature"][:] = rng.uniform(-100, 1500, 2)
    arrays["feature_visible"][...] = rng.random() < 0.8
    arrays["feature_new"][...] = rng.random() < 0.5
    arrays["feature_age"][...] = rng.uniform(0, 0.3)
    arrays["human_effort"][:] = 2 * rng.standard_normal(7) * (rng.random() < 0.5)
    arrays["goals.vision.target"][:] = rng.uniform(200, 900, 2)
    arrays["goals.vision_enabled"][...] = rng.random() < 0.9


def spoil_at_random(arrays: dict[str, np.ndarray], rng: np.random.Generator) -> None:
    for name, share in (("feature", 0.1), ("joint_position", 0.02), ("human_effort", 0.01)):
        if rng.random() < share:
            arrays[name].flat[0] = np.nan


def assert_equal_steps(run, steps: int) -> None:
    """Compares single steps from states that the eager step has reached."""
    step = FlatStep(*controller_and_observation())
    names = [name.split(".", 1)[1] for name in step.example.observation]
    observation = [x.clone() for x in step.example.observation.values()]
    arrays = {name: x.numpy() for name, x in zip(names, observation, strict=True)}
    state = list(step.example.state.values())
    rng, following, differing = np.random.default_rng(0), 0, 0
    for k in range(steps):
        if not np.isfinite(arrays["joint_position"]).all():
            arrays["joint_position"][:] = panda.ready.numpy()
        observe_at_random(arrays, rng)
        spoil_at_random(arrays, rng)
        if k % 100 == 0:
            state = list(step.example.state.values())
        with torch.no_grad():
            expected = step(*state, *observation)
            actual = run([*state, *observation])
        assert len(actual) == len(expected)
        for e, a in zip(expected, actual, strict=True):
            if not e.is_floating_point():
                differing += int(not torch.equal(e, a))
                continue
            # Of a covariance small entries are differences of large ones.
            scale = max(1.0, float(e.abs().max()))
            torch.testing.assert_close(a, e, rtol=0, atol=1e-12 * scale, equal_nan=True)
        state = expected[len(step.example.command) :]
        following += int(state[list(step.example.state).index("state.activation.active")])
    assert 0.1 * steps < following < 0.9 * steps
    # A flag and its count may differ where a limit is met to the last digit.
    assert differing <= 2e-3 * steps


def test_the_traced_step_equals_the_eager_one():
    program = trace(FlatStep(*controller_and_observation())).module()
    assert_equal_steps(lambda inputs: program(*inputs), 200)


class TestArrays:
    """Of a runner, on the eager step."""

    def setup_method(self):
        self.controller, self.observation = controller_and_observation()
        self.runner = StepRunner.eager(self.controller, self.observation)

    def test_they_are_what_the_step_reads_and_writes(self):
        state = self.controller.initial_state(self.observation.joint_position)
        out = self.runner.joint_velocity
        q = self.observation.joint_position
        for k in range(5):
            seen = q + 0.001 * k
            self.runner.observation["joint_position"][:] = seen.numpy()
            command, state = self.controller.step(
                state, self._with(joint_position=seen, image_joint_position=q)
            )
            assert self.runner.step() is out
            np.testing.assert_array_equal(out, command.joint_velocity.numpy())
            np.testing.assert_array_equal(self.runner.command("s"), command.s.numpy())
            np.testing.assert_array_equal(
                self.runner.command("safety.flags"), command.safety.flags.numpy()
            )

    def _with(self, **fields) -> Observation:
        return replace(self.observation, **fields)

    def test_the_example_is_left_alone(self):
        self.runner.observation["joint_position"][:] = 0.0
        assert torch.equal(self.observation.joint_position, panda.ready)

    def test_the_state_keeps_nothing_of_an_observation(self):
        """Written over in place, it must not change what is remembered."""
        first = [x.clone() for x in self._state_after_writing(0.0)]
        for before, after in zip(first, self._state_after_writing(1.0), strict=True):
            torch.testing.assert_close(before, after, equal_nan=True)

    def _state_after_writing(self, value: float) -> list[Tensor]:
        runner = StepRunner.eager(self.controller, self.observation)
        runner.step()
        for name, array in runner.observation.items():
            if array.dtype == np.float64 and name != "joint_position":
                array[...] = value
        return runner._state

    def test_start_forgets_and_takes_another_place(self):
        q = panda.ready + 0.1
        first = self.runner.step().copy()
        self.runner.start(q.numpy())
        self.runner.observation["joint_position"][:] = q.numpy()
        expected, _ = self.controller.step(
            self.controller.initial_state(q), self._with(joint_position=q)
        )
        velocity = self.runner.step()
        np.testing.assert_array_equal(velocity, expected.joint_velocity.numpy())
        assert not np.array_equal(velocity, first)

    def test_an_unknown_field_is_refused_with_those_there_are(self):
        with pytest.raises(ValueError, match="no field 'speed'; there are joint_velocity, tw"):
            self.runner.command("speed")


def test_batches_have_their_own_arrays():
    q = panda.ready + 0.1 * torch.randn(3, 7, generator=sampling.generator(), dtype=DOUBLE)
    controller, one = controller_and_observation()
    observation = Observation(
        joint_position=q,
        feature=one.feature.expand(3, 2),
        feature_visible=torch.ones(3, dtype=torch.bool),
        dt=0.002,
    )
    runner = StepRunner.eager(controller, observation)
    expected, _ = controller.step(controller.initial_state(q), observation)
    np.testing.assert_array_equal(runner.step(), expected.joint_velocity.numpy())


def test_without_a_compiler_the_step_runs_eagerly_and_says_so(monkeypatch, tmp_path):
    def missing():
        raise NoCompilerError("no C++ compiler found")

    monkeypatch.setattr(export_module, "_require_compiler", missing)
    controller, observation = controller_and_observation()
    with pytest.warns(UserWarning, match="run uncompiled and slower: no C\\+\\+ compiler"):
        runner = open_step(controller, observation, tmp_path)
    state = controller.initial_state(observation.joint_position)
    expected, _ = controller.step(state, observation)
    np.testing.assert_array_equal(runner.step(), expected.joint_velocity.numpy())
    assert not list(tmp_path.iterdir())


def test_a_missing_compiler_is_noticed(monkeypatch):
    from torch._inductor import config, cpp_builder

    cpp_builder.cpp_compiler_search.cache_clear()
    monkeypatch.setattr(config.cpp, "cxx", ("no-such-compiler",))
    with pytest.raises(NoCompilerError, match=r"no C\+\+ compiler found: install g\+\+"):
        export_module._require_compiler()
    cpp_builder.cpp_compiler_search.cache_clear()


@pytest.mark.parametrize("content", [b"", b"no archive"])
def test_a_foreign_file_is_refused(tmp_path, content):
    path = tmp_path / "step.pt2"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"step.pt2 was not written by export_step"):
        StepRunner.load(path)


@pytest.fixture(scope="module")
def package(tmp_path_factory) -> Path:
    with shapes_unchecked():
        controller, observation = controller_and_observation()
        return export_step(controller, observation, tmp_path_factory.mktemp("packages"))


@pytest.mark.slow
class TestPackage:
    """Built once, in half a minute to two."""

    def test_it_equals_the_eager_step(self, package):
        assert_equal_steps(open_package(package), 10_000)

    def test_it_is_built_once(self, package):
        built = package.stat().st_mtime_ns
        controller, observation = controller_and_observation(panda.ready + 0.1)
        assert export_step(controller, observation, package.parent) == package
        assert package.stat().st_mtime_ns == built
        assert list(package.parent.iterdir()) == [package]

    def test_it_needs_no_compiler_once_it_is_there(self, package, monkeypatch):
        def missing():
            raise NoCompilerError("no C++ compiler found")

        monkeypatch.setattr(export_module, "_require_compiler", missing)
        runner = open_step(*controller_and_observation(), package.parent)
        eager = StepRunner.eager(*controller_and_observation())
        for _ in range(20):
            np.testing.assert_allclose(runner.step(), eager.step(), rtol=0, atol=1e-12)

    def test_it_loads_within_a_tenth_of_a_second(self, package):
        seconds = []
        for _ in range(5):
            began = time.perf_counter()
            StepRunner.load(package).step()
            seconds.append(time.perf_counter() - began)
        assert min(seconds) < 0.1

    def test_it_remembers_its_tensors(self, package):
        example = FlatStep(*controller_and_observation()).example
        kept = read_example(package)
        assert list(kept.state) == list(example.state)
        assert list(kept.observation) == list(example.observation)
        assert list(kept.command) == list(example.command)
        for a, b in zip(kept.inputs, example.inputs, strict=True):
            assert torch.equal(a, b)

    def test_a_program_without_this_library_runs_it(self, package, tmp_path):
        blocked = (
            "import sys, runpy; sys.modules['hrc_learn'] = None; "
            "del sys.argv[0]; "
            "runpy.run_path(sys.argv[0], run_name='__main__')"
        )
        program = ROOT / "docs" / "run_exported_step.py"
        done = subprocess.run(
            [sys.executable, "-c", blocked, program, package],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
        assert done.returncode == 0, done.stderr
        runner = StepRunner.load(package)
        for _ in range(1000):
            runner.observation["joint_position"] += 0.002 * runner.step()
        ends = np.array([float(x) for x in done.stdout.splitlines()[0].split()[2:]])
        expected = runner.observation["joint_position"]
        np.testing.assert_allclose(ends, expected, rtol=0, atol=1e-6)
