"""Compiled primitives: each kind without a break, with the gradient by its duration.

In processes of their own: a compiler cannot follow the shape checks of these tests.
"""

import subprocess
import sys

import pytest

COMPILED = """
import sys
import torch
from hrc_learn.dmp import (
    JointDMP, MovingGoalDMP, OrientationDMP, PoseDMP, SplineBasis, fit_rhythmic,
    fit_rhythmic_orientation,
)
from hrc_learn.geometry import quaternion

t = torch.linspace(0, 2, 40, dtype=torch.float64)
y = torch.stack([torch.sin(t), t**2, torch.cos(t)], -1)
round = torch.stack([torch.sin(torch.pi * t), torch.cos(torch.pi * t), 0 * t], -1)
q, turning = quaternion.exp(y), quaternion.exp(0.3 * round)
joints = lambda **options: JointDMP.fit(t, y, **{"n_basis": 6} | options)
kinds = {
    "joint": (joints, "position"),
    "acceleration": (joints, "acceleration"),
    "spline": (lambda: joints(n_basis=None, basis=SplineBasis(count=6)), "velocity"),
    "part": (lambda: joints(approach=0.7, scaling="amplitude"), "position"),
    "paper": (lambda: joints(scaling="paper"), "velocity"),
    "rotation": (lambda: joints(scaling="rotation"), "position"),
    "moving": (lambda: MovingGoalDMP(joints()), "position"),
    "orientation": (lambda: OrientationDMP.fit(t, q, 6), "angular_velocity"),
    "ude": (lambda: OrientationDMP.fit(t, q, 6, formulation="ude"), "angular_velocity"),
    "pose": (lambda: PoseDMP.fit(t, y, q, 6), "orientation"),
    "rhythm": (lambda: fit_rhythmic(t, round, 6, 1.0), "position"),
    "turning": (lambda: fit_rhythmic_orientation(t, turning, 6, 1.0), "orientation"),
}
backend, *names = sys.argv[1:]
durations = torch.tensor([1.7, 2.1], dtype=torch.float64, requires_grad=True)
for fit, output in (kinds[name] for name in names or kinds):
    dmp = fit()
    goal = {"goal": dmp.goal[None]} if isinstance(dmp.goal, torch.Tensor) else {}
    def path(tau, times=t[::8]):
        return getattr(dmp.rollout(times, duration=tau, **goal), output)
    def shown(tau):
        return path(tau, None)
    def stepped(tau):
        state = dmp.step(dmp.initial_state(duration=tau, **goal), 0.3)
        return state.angular_velocity if hasattr(state, "angular_velocity") else state.velocity
    for motion in (path, shown, stepped) if not names else (path,):
        torch._dynamo.reset()
        compiled = torch.compile(motion, fullgraph=True, backend=backend)
        found, expected = compiled(durations), motion(durations)
        torch.testing.assert_close(found, expected)
        # Zero where positions are those at the fractions of the duration that were recorded.
        found, expected = (
            torch.autograd.grad(x.cos().sum(), durations, materialize_grads=True)[0]
            for x in torch.broadcast_tensors(found, expected)
        )
        torch.testing.assert_close(found, expected)
"""
TABLES = """
import torch
from hrc_learn.dmp import JointDMP

t = torch.linspace(0, 2, 60, dtype=torch.float64)
durations = torch.tensor([0.8, 1.0, 1.7], dtype=torch.float64)
dmp, sizes = JointDMP.fit(t, torch.stack([torch.sin(t), t**2], -1), 13), []
def counted(graph, inputs):
    sizes.append(len(graph.graph.nodes))
    return graph
for _ in range(2):
    torch._dynamo.reset()
    compiled = torch.compile(lambda tau: dmp.rollout(t, duration=tau).position, backend=counted)
    torch.testing.assert_close(compiled(durations), dmp.rollout(t, duration=durations).position)
assert sizes[1] < 0.7 * sizes[0], sizes
"""


def run(program, *arguments):
    subprocess.run([sys.executable, "-c", program, *arguments], check=True)


@pytest.mark.parametrize("kind", ["joint", pytest.param("ude", marks=pytest.mark.long)])
def test_compiles_with_the_gradient_by_its_duration(kind):
    run(COMPILED, "aot_eager", kind)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["aot_eager", "inductor"])
def test_every_kind_compiles_without_a_break(backend):
    run(COMPILED, backend)


@pytest.mark.slow
def test_a_table_that_was_made_before_is_looked_up():
    run(TABLES)
