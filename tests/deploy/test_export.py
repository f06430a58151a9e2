"""The exported step against the eager one, and the arrays around it."""

import os
import shutil
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
from graphs import library_calls
from step_equality import assert_equal_steps, controller_and_observation
from torch import Tensor
from unchecked import shapes_unchecked

from hrc_learn.controller import AdaptiveController, Observation
from hrc_learn.deploy import EagerRunner, NoCompilerError, PackageRunner, export_step, open_step
from hrc_learn.deploy import export as export_module
from hrc_learn.deploy import package as package_module
from hrc_learn.deploy.export import trace
from hrc_learn.deploy.package import PackedStep, Vectors, load
from hrc_learn.kinematics import panda
from hrc_learn.store import EXPORT, replacing

ROOT = Path(__file__).parents[2]
DOUBLE = torch.float64


@pytest.fixture(autouse=True)
def _no_shape_checks() -> Iterator[None]:
    """Tracers cannot follow them."""
    with shapes_unchecked():
        yield


@pytest.fixture(scope="module")
def observed() -> tuple[AdaptiveController, Observation]:
    controller, observation = controller_and_observation()
    return controller, replace(observation, dt=torch.tensor(0.002, dtype=DOUBLE))


@pytest.fixture(scope="module")
def traced(observed) -> torch.export.ExportedProgram:
    with shapes_unchecked():
        return trace(PackedStep(*observed), observed[1])


class TestTraced:
    """The graph that is exported."""

    def test_it_equals_the_eager_step_and_is_written_out(self, observed, traced):
        assert not library_calls(traced)
        program = traced.module()
        assert_equal_steps(*observed, lambda vectors: program(*vectors), 40)

    def test_it_takes_poison_as_the_eager_one_does(self, observed, traced):
        """In any number of the observation, the step among them."""
        program, step = traced.module(), PackedStep(*observed)
        vectors = step.example(observed[1])
        velocity = step.layouts.command.rows["joint_velocity"]
        for _ in range(20):
            program(*vectors)
        usual = vectors.command[velocity].norm()
        assert usual > 0.05
        healthy = vectors.observation.clone()
        for field in step.layouts.observation.fields:
            if not field.dtype.is_floating_point:
                continue
            for value in (torch.nan, torch.inf, -torch.inf):
                vectors.observation[step.layouts.observation.rows[field.name]] = value
                expected = Vectors(*(x.clone() for x in vectors))
                program(*vectors)
                step(*expected)
                for got, wanted in zip(vectors, expected, strict=True):
                    torch.testing.assert_close(
                        got, wanted, rtol=1e-9, atol=1e-9, equal_nan=True
                    )
                assert vectors.command[velocity].isfinite().all(), field.name
                assert vectors.state.isfinite().all(), field.name
                vectors.observation.copy_(healthy)
        for _ in range(20):
            program(*vectors)
        assert 0.5 * usual < vectors.command[velocity].norm() < 2 * usual


class TestArrays:
    """Of a runner, on the eager step."""

    def setup_method(self):
        self.controller, self.observation = controller_and_observation()
        self.runner = EagerRunner(self.controller, self.observation)

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
        fields = ("safety.position", "blending.feature", "pose_drift.joint_position")
        runner = EagerRunner(self.controller, self.observation)
        runner.step()
        for array in runner.observation.values():
            array[...] = value
        return [torch.from_numpy(runner.state(field).copy()) for field in fields]

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

    def test_nothing_was_commanded_before_the_first_step(self):
        assert np.isnan(self.runner.command("s")).all()
        assert not self.runner.command("safety.flags").any()


def test_batches_have_their_own_arrays():
    q = panda.ready + 0.1 * torch.randn(3, 7, generator=sampling.generator(), dtype=DOUBLE)
    controller, one = controller_and_observation()
    observation = Observation(
        joint_position=q,
        feature=one.feature.expand(3, 2),
        feature_visible=torch.ones(3, dtype=torch.bool),
        dt=0.002,
    )
    runner = EagerRunner(controller, observation)
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


def test_a_missing_compiler_is_noticed():
    from torch._inductor import config, cpp_builder

    cpp_builder.cpp_compiler_search.cache_clear()
    with (
        config.patch({"cpp.cxx": ("no-such-compiler",)}),
        pytest.raises(NoCompilerError, match=r"no C\+\+ compiler found: install g\+\+"),
    ):
        export_module._require_compiler()
    cpp_builder.cpp_compiler_search.cache_clear()


@pytest.mark.parametrize("content", [b"", b"no archive"])
def test_a_foreign_file_is_refused(tmp_path, content):
    path = tmp_path / "step.pt2"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"step.pt2 was not written by export_step"):
        PackageRunner(path)


def test_a_damaged_package_is_refused(tmp_path):
    with replacing(tmp_path / "step", EXPORT) as new:
        new.mkdir()
        (new / "step.pt2").write_bytes(b"compiled")
    (tmp_path / "step" / "step.pt2").write_bytes(b"compileD")
    with pytest.raises(ValueError, match=r"step.pt2 has changed since it was written"):
        PackageRunner(tmp_path / "step" / "step.pt2")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no package .*step.pt2"):
        PackageRunner(tmp_path / "step.pt2")


@pytest.mark.parametrize("dtype", [DOUBLE, torch.float32])
@pytest.mark.parametrize("batch", [(), (3, 2)])
def test_a_package_tells_all_it_takes_to_call_it(monkeypatch, tmp_path, dtype, batch):
    controller, one = controller_and_observation()
    observation = Observation(
        joint_position=panda.ready.to(dtype).expand(*batch, 7).contiguous(),
        feature=one.feature.to(dtype).expand(*batch, 2).contiguous(),
        feature_visible=torch.ones(batch, dtype=torch.bool),
        dt=0.002,
    )
    step = PackedStep(controller.to(dtype), observation)
    (path := tmp_path / "step.pt2").touch()
    says = package_module.describe(step, observation)
    monkeypatch.setattr(package_module, "_open", lambda path: (step, says))
    kept, example = load(path), step.example(observation)
    for ours, theirs in zip(step.layouts, kept.layouts, strict=True):
        assert (theirs.fields, theirs.batch) == (ours.fields, batch)
        assert theirs.empty().dtype == dtype
    torch.testing.assert_close(kept.first_state, example.state, rtol=0, atol=0)
    torch.testing.assert_close(kept.example, example.observation, rtol=0, atol=0)


@pytest.fixture(scope="module")
def package(tmp_path_factory) -> Path:
    with shapes_unchecked():
        controller, observation = controller_and_observation()
        return export_step(controller, observation, tmp_path_factory.mktemp("packages"))


@pytest.mark.slow
class TestPackage:
    """Built once, in a minute or two."""

    def test_it_equals_the_eager_step(self, package):
        assert_equal_steps(*controller_and_observation(), load(package).run, 10_000)

    def test_it_is_built_once(self, package):
        built = package.stat().st_mtime_ns
        controller, observation = controller_and_observation(panda.ready + 0.1)
        assert export_step(controller, observation, package.parents[1]) == package
        assert package.stat().st_mtime_ns == built
        assert list(package.parents[1].iterdir()) == [package.parent]

    def test_it_needs_no_compiler_once_it_is_there(self, package, monkeypatch):
        def missing():
            raise NoCompilerError("no C++ compiler found")

        monkeypatch.setattr(export_module, "_require_compiler", missing)
        runner = open_step(*controller_and_observation(), package.parents[1])
        assert isinstance(runner, PackageRunner)
        eager = EagerRunner(*controller_and_observation())
        for _ in range(20):
            np.testing.assert_allclose(runner.step(), eager.step(), rtol=0, atol=1e-12)
        np.testing.assert_allclose(runner.command("s"), eager.command("s"), atol=1e-12)

    def test_it_opens_within_a_tenth_of_a_second(self, package):
        controller, observation = controller_and_observation()
        seconds = []
        for _ in range(5):
            began = time.process_time()
            open_step(controller, observation, package.parents[1]).step()
            seconds.append(time.process_time() - began)
        assert min(seconds) < 0.1

    def test_it_allocates_nothing(self, package):
        runner = open_step(*controller_and_observation(), package.parents[1])
        velocity = runner.step()
        address = velocity.ctypes.data
        with torch.profiler.profile(profile_memory=True) as profile:
            assert runner.step() is velocity
        assert velocity.ctypes.data == address
        assert not [event for event in profile.events() or () if event.cpu_memory_usage > 0]

    def test_it_starts_again_anywhere(self, package):
        runners = [
            EagerRunner(*controller_and_observation()),
            open_step(*controller_and_observation(), package.parents[1]),
        ]
        q = panda.ready.numpy() + 0.2
        for runner in runners:
            runner.step()
            runner.start(q)
            runner.observation["joint_position"][:] = np.nan  # so it needs what it remembers
            for _ in range(3):
                runner.step()
        np.testing.assert_allclose(
            runners[0].command("twist"), runners[1].command("twist"), rtol=0, atol=1e-12
        )

    def test_it_remembers_its_layout_and_first_state(self, package):
        step = PackedStep(*controller_and_observation())
        kept = load(package)
        for ours, theirs in zip(step.layouts, kept.layouts, strict=True):
            assert (theirs.fields, theirs.batch) == (ours.fields, ours.batch)
        assert torch.equal(kept.first_state, step.first_state)

    def test_one_of_another_machine_is_refused(self, package, monkeypatch):
        monkeypatch.setattr(torch, "__version__", "1.0")
        with pytest.raises(ValueError, match=r"built for torch 2.*, but this is torch 1\.0"):
            load(package)

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
        assert_same_run(done.stdout, package)

    def test_a_program_in_cpp_runs_it(self, package, tmp_path):
        if shutil.which("cmake") is None:
            pytest.skip("needs cmake")
        source = ROOT / "docs" / "run_exported_step"
        prefix = f"-DCMAKE_PREFIX_PATH={torch.utils.cmake_prefix_path}"
        subprocess.run(["cmake", "-S", source, "-B", tmp_path, prefix], check=True)
        subprocess.run(["cmake", "--build", tmp_path], check=True)
        done = subprocess.run(
            [tmp_path / "run_exported_step", package], capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        assert_same_run(done.stdout, package)


def assert_same_run(printed: str, package: Path) -> None:
    """An example of the documentation printed where our runner moves the joints to."""
    runner = PackageRunner(package)
    runner.observe(controller_and_observation()[1])
    q = runner.observation["joint_position"]
    start = q.copy()
    for _ in range(1000):
        q += 0.002 * runner.step()
    ends = np.array([float(x) for x in printed.splitlines()[0].split()[2:]])
    assert np.abs(ends - start).max() > 0.01
    np.testing.assert_allclose(ends, q, rtol=0, atol=1e-6)
