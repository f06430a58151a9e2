"""The exported step against the eager one, and the arrays around it."""

import os
import runpy
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
from step_equality import assert_equal_steps, controller_and_observation
from torch import Tensor
from unchecked import shapes_unchecked

from hrc_learn.controller import (
    AdaptiveController,
    Observation,
    VelocityStep,
    WantedVelocity,
)
from hrc_learn.deploy import (
    EagerRunner,
    PackageRunner,
    export_step,
    open_step,
)
from hrc_learn.deploy import package as package_module
from hrc_learn.deploy.package import LANES, WORKSPACE, PackedStep, Vectors, load
from hrc_learn.kinematics import panda
from hrc_learn.store import EXPORT, replacing, write_json

DOCS = Path(__file__).parents[2] / "docs"
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
def compiled(observed, tmp_path_factory) -> Path:
    with shapes_unchecked():
        return export_step(*observed, tmp_path_factory.mktemp("compiled"))


class TestCompiled:
    """Machine code of everything a controller does."""

    def test_it_equals_the_eager_step(self, observed, compiled):
        assert_equal_steps(*observed, load(compiled)[0], 40)

    def test_it_takes_poison_as_the_eager_one_does(self, observed, compiled):
        """In any number of the observation, the step among them."""
        program, step = load(compiled)[0], PackedStep(*observed)
        vectors = step.example(observed[1])
        velocity = step.layouts.command.rows["joint_velocity"]
        for _ in range(20):
            program(list(vectors))
        usual = vectors.command[velocity].norm()
        assert usual > 0.05
        healthy = vectors.observation.clone()
        for field in step.layouts.observation.fields:
            if not field.dtype.is_floating_point:
                continue
            for value in (torch.nan, torch.inf, -torch.inf):
                vectors.observation[step.layouts.observation.rows[field.name]] = value
                expected = Vectors(*(x.clone() for x in vectors))
                program(list(vectors))
                step(*expected)
                for got, wanted in zip(vectors, expected, strict=True):
                    torch.testing.assert_close(
                        got, wanted, rtol=1e-9, atol=1e-9, equal_nan=True
                    )
                assert vectors.command[velocity].isfinite().all(), field.name
                assert vectors.state.isfinite().all(), field.name
                vectors.observation.copy_(healthy)
        for _ in range(20):
            program(list(vectors))
        assert 0.5 * usual < vectors.command[velocity].norm() < 2 * usual

    def test_it_is_built_once(self, observed, compiled):
        built = compiled.stat().st_mtime_ns
        controller, observation = observed
        elsewhere = replace(observation, joint_position=panda.ready + 0.1)
        assert export_step(controller, elsewhere, compiled.parents[1]) == compiled
        assert compiled.stat().st_mtime_ns == built
        assert list(compiled.parents[1].iterdir()) == [compiled.parent]

    def test_it_is_kept_in_the_cache_of_the_user(
        self, observed, compiled, tmp_path, monkeypatch
    ):
        (tmp_path / "hrc_learn").symlink_to(compiled.parents[1])
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        name = compiled.relative_to(compiled.parents[1])
        assert export_step(*observed) == tmp_path / "hrc_learn" / name

    def test_it_opens_within_a_tenth_of_a_second(self, observed, compiled):
        seconds = []
        for _ in range(5):
            began = time.process_time()
            open_step(*observed, compiled.parents[1]).step()
            seconds.append(time.process_time() - began)
        assert min(seconds) < 0.1

    def test_it_allocates_nothing(self, observed, compiled):
        runner = open_step(*observed, compiled.parents[1])
        velocity = runner.step()
        address = velocity.ctypes.data
        with torch.profiler.profile(profile_memory=True) as profile:
            assert runner.step() is velocity
        assert velocity.ctypes.data == address
        assert not [event for event in profile.events() or () if event.cpu_memory_usage > 0]

    def test_it_starts_again_anywhere(self, observed, compiled):
        runners = [EagerRunner(*observed), open_step(*observed, compiled.parents[1])]
        q = panda.ready.numpy() + 0.2
        for runner in runners:
            runner.step()
            runner.start(q)
            runner.observation["joint_position"][:] = np.nan  # so it needs what it remembers
            for _ in range(3):
                runner.step()
        np.testing.assert_allclose(
            runners[0].command["twist"], runners[1].command["twist"], rtol=0, atol=1e-12
        )

    def test_it_remembers_its_layout_and_first_state(self, observed, compiled):
        step, (_, layouts, first_state) = PackedStep(*observed), load(compiled)
        for ours, theirs in zip(step.layouts, layouts, strict=True):
            assert (theirs.fields, theirs.batch) == (ours.fields, ours.batch)
        assert torch.equal(first_state, step.first_state)

    def test_one_of_another_machine_is_refused(self, compiled, monkeypatch):
        monkeypatch.setattr(torch, "__version__", "1.0")
        with pytest.raises(ValueError, match=r"built for torch 2.*, but this is torch 1\.0"):
            load(compiled)

    def test_a_program_in_c_runs_it(self, observed, compiled, tmp_path):
        if shutil.which("cc") is None:
            pytest.skip("needs a C compiler")
        program = tmp_path / "run_exported_step"
        source = DOCS / "run_exported_step.c"
        command = ["cc", "-Wall", "-Werror", "-O1", source, compiled, f"-I{compiled.parent}"]
        subprocess.run([*command, "-lm", "-o", program], check=True)
        done = subprocess.run([program], capture_output=True, text=True, check=True)
        assert_same_run(done.stdout, compiled, observed[1])


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
            np.testing.assert_array_equal(self.runner.command["s"], command.s.numpy())
            np.testing.assert_array_equal(
                self.runner.command["safety.flags"], command.safety.flags.numpy()
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
        return [torch.from_numpy(runner.state[field].copy()) for field in fields]

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

    def test_nothing_was_commanded_before_the_first_step(self):
        assert np.isnan(self.runner.command["s"]).all()
        assert not self.runner.command["safety.flags"].any()


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


class Sorted(VelocityStep):
    """A law with an operation that cannot be compiled."""

    def step(self, state, observation):
        wanted = observation.joint_velocity.sort()[0]
        return super().step(state, replace(observation, joint_velocity=wanted))


@pytest.mark.long
def test_a_step_that_cannot_be_compiled_runs_eagerly_and_says_so(tmp_path):
    law = Sorted(panda)
    example = WantedVelocity(
        joint_position=panda.ready,
        joint_velocity=torch.linspace(0.3, -0.3, 7, dtype=DOUBLE),
        stop=torch.tensor(False),
        dt=0.002,
    )
    with pytest.warns(UserWarning, match=r"uncompiled and slower: operation aten.sort.default"):
        runner = open_step(law, example, tmp_path)
    expected, _ = law.step(law.initial_state(panda.ready), example)
    np.testing.assert_array_equal(runner.step(), expected.joint_velocity.numpy())
    assert not list(tmp_path.glob("step-*"))


@pytest.mark.parametrize("missing", ["batch", "built_for", "lanes", "layout", "state"])
def test_a_package_without_a_layout_is_none_of_ours(tmp_path, missing):
    (tmp_path / "step.o").write_bytes(b"compiled")
    keys = ("batch", "built_for", "dtype", "lanes", "layout", "state", "workspace")
    write_json(tmp_path / "step.json", {f"hrc_learn.{k}": "" for k in keys if k != missing})
    message = f"step.o was not written by export_step: no hrc_learn.{missing}"
    with pytest.raises(ValueError, match=message):
        load(tmp_path / "step.o")


def test_an_observation_of_other_fields_is_refused():
    controller, one = controller_and_observation()
    number = one.feature[0]
    runner = EagerRunner(controller, replace(one, feature_age=number, human_distance=None))
    with pytest.raises(ValueError, match="the field feature_age, human_distance"):
        runner.observe(replace(one, feature_age=None, human_distance=number))


def test_a_damaged_package_is_refused(tmp_path):
    with replacing(tmp_path / "step", EXPORT) as new:
        new.mkdir()
        (new / "step.o").write_bytes(b"compiled")
    (tmp_path / "step" / "step.o").write_bytes(b"compileD")
    with pytest.raises(ValueError, match=r"step.o has changed since it was written"):
        PackageRunner(tmp_path / "step" / "step.o")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no compiled step .*step.o"):
        PackageRunner(tmp_path / "step.o")


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
    (path := tmp_path / "step.o").touch()
    says = package_module.describe(step, observation)
    write_json(path.with_name("step.json"), says | {LANES: "1", WORKSPACE: "1"})
    monkeypatch.setattr(package_module, "NativeStep", lambda *_: step)
    _, layouts, first_state = load(path)
    for ours, theirs in zip(step.layouts, layouts, strict=True):
        assert (theirs.fields, theirs.batch) == (ours.fields, batch)
        assert theirs.empty().dtype == dtype
    torch.testing.assert_close(first_state, step.first_state, rtol=0, atol=0)


@pytest.mark.slow
def test_ten_thousand_steps_equal_the_eager_ones(observed, compiled):
    assert_equal_steps(*observed, load(compiled)[0], 10_000)


@pytest.mark.slow
def test_a_torch_package_runs_without_this_library(observed, compiled, tmp_path):
    """Built in a minute or two."""
    package = tmp_path / "step.pt2"
    runpy.run_path(str(DOCS / "export_torch_package.py"))["export_torch_package"](
        *observed, package
    )
    run = torch._inductor.aoti_load_package(str(package))
    assert_equal_steps(*observed, lambda vectors: run(*vectors), 100)
    blocked = (
        "import sys, runpy; sys.modules['hrc_learn'] = None; "
        "del sys.argv[0]; "
        "runpy.run_path(sys.argv[0], run_name='__main__')"
    )
    program = DOCS / "run_exported_step.py"
    done = subprocess.run(
        [sys.executable, "-c", blocked, program, package],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    assert_same_run(done.stdout, compiled, observed[1])


def assert_same_run(printed: str, package: Path, observation: Observation) -> None:
    """An example of the documentation printed where our runner moves the joints to."""
    runner = PackageRunner(package)
    runner.observe(observation)
    q = runner.observation["joint_position"]
    start = q.copy()
    for _ in range(1000):
        q += 0.002 * runner.step()
    ends = np.array([float(x) for x in printed.splitlines()[0].split()[2:]])
    assert np.abs(ends - start).max() > 0.01
    np.testing.assert_allclose(ends, q, rtol=0, atol=1e-6)
