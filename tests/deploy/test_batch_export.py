"""The step of many arms, compiled as one loop over them."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import sampling
import torch
from step_equality import assert_equal_steps, controller_and_observation
from torch.fx.experimental.proxy_tensor import make_fx
from unchecked import shapes_unchecked

from hrc_learn.deploy import EagerRunner, PackageRunner, export_step
from hrc_learn.deploy.export import cat_batch_last
from hrc_learn.deploy.package import load
from hrc_learn.kinematics import panda

ARMS = 40


@pytest.fixture(autouse=True, scope="module")
def _no_shape_checks() -> Iterator[None]:
    """Tracers cannot follow them."""
    with shapes_unchecked():
        yield


@pytest.fixture(scope="module")
def package(tmp_path_factory, _no_shape_checks) -> Path:
    controller, observation = controller_and_observation(panda.ready.expand(ARMS, 7))
    return export_step(controller, observation, tmp_path_factory.mktemp("packages"))


def test_what_is_joined_has_the_batch_last():
    def join(a, b):
        return torch.cat([torch.cat([a, b], 1), torch.cat([b, a], -2)], -1), torch.cat([a, a])

    rng = sampling.generator()
    a, b = torch.randn(5, 4, 3, generator=rng), torch.randn(5, 2, 3, generator=rng)
    module = make_fx(join, tracing_mode="fake")(a, b)
    cat_batch_last([5])(module.graph)
    module.recompile()
    for ours, theirs in zip(module(a, b), join(a, b), strict=True):
        assert torch.equal(ours, theirs)
    joins = module.graph.find_nodes(op="call_function", target=torch.ops.aten.cat.default)
    shapes = [tuple(node.meta["val"].shape) for node in joins]
    assert sorted(shapes) == [(6, 3, 5), (6, 3, 5), (6, 6, 5), (10, 4, 3)]


@pytest.mark.slow
class TestBatch:
    """Built once, in a minute or two."""

    def test_it_equals_the_eager_step(self, package):
        controller, observation = controller_and_observation(panda.ready.expand(ARMS, 7))
        assert_equal_steps(controller, observation, load(package).run, 250)

    def test_it_equals_the_eager_step_in_closed_loop(self, package):
        """Each step may add 1e-12 rad/s to the difference."""
        noise = torch.randn(ARMS, 7, generator=sampling.generator(), dtype=torch.float64)
        controller, observation = controller_and_observation(panda.ready + 0.3 * noise)
        runners = [EagerRunner(controller, observation), PackageRunner(package)]
        q = observation.joint_position.numpy()
        for runner in runners:
            runner.observe(observation)
            runner.start(q)
            runner.observation["feature"][:] += 100 * q[:, :2]
            runner.observation["feature_visible"][:] = np.arange(ARMS) % 4 != 0
            runner.observation["nullspace_input"][:] = 0.1 * q
        steps = 200
        for _ in range(steps):
            eager, exported = (runner.step() for runner in runners)
            np.testing.assert_allclose(exported, eager, rtol=0, atol=steps * 1e-12)
            for runner in runners:
                for field in ("joint_position", "image_joint_position"):
                    runner.observation[field][:] += 0.002 * runner.joint_velocity
                runner.observation["feature"][:] += runner.joint_velocity[:, :2]
        assert np.abs(runners[0].joint_velocity).max() > 0.1
