"""The constraint layer against general solvers, and what it promises one thing at a time."""

import dataclasses
from dataclasses import replace
from typing import NamedTuple

import constraint_states
import numpy as np
import pytest
import sampling
import torch
from constraint_states import State
from torch import Tensor
from unchecked import shapes_unchecked

from hrc_learn.controller import (
    ConstraintConfig,
    Distances,
    SafetyConfig,
    SafetyFilter,
    SeparationConfig,
)
from hrc_learn.controller.constraint_layer import constrained_velocity
from hrc_learn.geometry.numerics import (
    null_projection,
    orthonormal_basis,
)
from hrc_learn.kinematics import panda

DOUBLE = torch.float64
# With steps enough for any state.
ENOUGH = ConstraintConfig(steps=40)
BOXES = {
    "6 of 6": (6, 6),
    "8, 6 rows": (8, 6),
    "7, 3 rows": (7, 3),
    "6, 3 rows": (6, 3),
    "5, 6 rows": (5, 6),
}


class Found(NamedTuple):
    joint_velocity: Tensor
    slowed: Tensor
    violation: Tensor
    solved: Tensor


def constrained(*arguments, **options) -> Found:
    velocity, report = constrained_velocity(*arguments, **options)
    return Found(velocity, report.slowed, report.violation, report.solved)


def moved(J: Tensor, u: Tensor) -> Tensor:
    return (J @ u.unsqueeze(-1)).squeeze(-1)


def off_path(state: State, found: Found) -> Tensor:
    """Motion of the tool besides that of the task [m/s, rad/s]."""
    task = (1 - found.slowed).unsqueeze(-1) * state.task
    return moved(state.jacobian, found.joint_velocity - task)


def assert_optimal(state: State, config: ConstraintConfig) -> None:
    found = constrained(*state.arguments, config, separation=state.separation)
    assert found.solved.all()
    off = off_path(state, found).norm(dim=-1).numpy()
    weights = config.task_weight * np.array(
        [1.0, config.path_weight, config.path_weight * config.distance_weight]
    )
    for k in range(len(off)):
        cost = weights * [float(found.slowed[k]), off[k], float(found.violation[k])]
        program = constraint_states.program(state, k, config)
        best = constraint_states.optimum(program, max(1.0, cost.max()))
        np.testing.assert_allclose(found.joint_velocity[k].numpy(), best, rtol=0, atol=1e-6)


def test_the_optimum_is_that_of_a_general_solver():
    assert_optimal(constraint_states.of_panda(120), ENOUGH)


@pytest.mark.parametrize("mode", ["pfl", "ssm+pfl"])
def test_the_optimum_where_people_may_be_touched(mode):
    state = constraint_states.of_panda(60, seed=8)
    assert_optimal(replace(state, separation=SeparationConfig(mode=mode)), ENOUGH)


@pytest.mark.slow
def test_the_optimum_is_that_of_a_general_solver_in_ten_thousand_states():
    assert_optimal(constraint_states.of_panda(10_000, seed=1), ENOUGH)


@pytest.mark.parametrize("arm", BOXES)
def test_the_optimum_of_other_arms_and_tasks(arm: str):
    assert_optimal(constraint_states.of_any_arm(60, *BOXES[arm]), ENOUGH)


def test_a_step_that_ends_early_equals_one_of_all_steps():
    """Steps in which limits bind, and others, in which no program is solved at all."""
    state = constraint_states.of_panda(20, seed=5)
    near = state.distances
    # In every other state there is room: nobody near, and no limit that the arm is close to.
    room = 10.0 * (torch.arange(20) % 2)
    near = replace(near, distance=near.distance + room[:, None])
    wide = state.lower - room[:, None], state.upper + room[:, None]
    arguments = (*state.arguments[:2], *wide, near)
    with shapes_unchecked():  # vmap takes all steps
        every = torch.vmap(lambda *x: constrained(*x, ENOUGH))(*arguments)
    free = 0
    for k in range(20):
        one = torch.utils._pytree.tree_map(lambda x: x[k], arguments)  # noqa: B023
        few = constrained(*one, ENOUGH)
        for theirs, ours in zip(every, few, strict=True):
            torch.testing.assert_close(ours, theirs[k], atol=1e-11, rtol=0)
        free += torch.equal(few.joint_velocity, one[0])
    assert free >= 10


@pytest.mark.long
def test_the_order_is_strict_to_the_weight_of_the_task():
    """Linear programming knows no weights: whether the path can be kept, and at which speed."""
    state = constraint_states.of_panda(150, seed=2, pairs=3)
    found = constrained(*state.arguments, ENOUGH)
    null = null_projection(state.jacobian, found.joint_velocity) - state.null
    kept = 0
    for k in range(150):
        program = constraint_states.program(state, k, ENOUGH)
        best = constraint_states.least_slowing(program)
        off = float(off_path(state, found)[k].norm())
        if best is None:
            assert off > 1e-6 or found.violation[k] > 1e-6
            continue
        kept += 1
        # W^2 |sigma t|^2 + z^2 is the least, and so not above that of the fastest task.
        most = 2 * (state.upper - state.lower)[k].norm() + state.null[k].norm()
        slack = float(most / state.task[k].norm()) / ENOUGH.task_weight
        assert float(found.slowed[k]) <= np.hypot(best, slack) + 1e-6
        # Off the path goes 1 / path_weight^2 of what else is given up: so much spares the task
        # a little more.
        assert off < 5e-5
        change = found.joint_velocity[k].numpy() - program.wanted
        change = change + float(found.slowed[k]) * state.task[k].numpy()
        astray = np.abs(program.directions[:, : program.paths].T @ change).max()
        relaxed = constraint_states.least_slowing(program, float(astray))
        assert relaxed is not None
        assert relaxed - 1e-6 <= float(found.slowed[k])
        assert found.violation[k] < 1e-6
    assert kept > 40
    assert null.norm(dim=-1).max() > 0.1  # it does make way


def test_where_nothing_binds_it_is_task_and_null_space():
    state = constraint_states.of_panda(200)
    far = replace(state.distances, distance=state.distances.distance + 100)
    wide = replace(state, lower=state.lower - 100, upper=state.upper + 100, distances=far)
    found = constrained(*wide.arguments)
    torch.testing.assert_close(
        found.joint_velocity, state.task + state.null, rtol=0, atol=1e-12
    )
    assert (found.slowed == 0).all()
    assert (found.violation == 0).all()


@pytest.mark.parametrize("steps", [2, 40])
def test_hard_limits_hold_whether_solved_or_not(steps: int):
    state = constraint_states.of_panda(500, seed=3)
    found = constrained(*state.arguments, ConstraintConfig(steps=steps))
    assert (found.joint_velocity >= state.lower).all()
    assert (found.joint_velocity <= state.upper).all()
    braking = torch.zeros_like(state.lower).clamp(state.lower, state.upper)
    failed = ~found.solved
    assert failed.any() == (steps == 2)
    assert torch.equal(found.joint_velocity[failed], braking[failed])
    assert (found.slowed[failed] == 1).all()


def test_distances_hold_to_the_violation_that_is_told():
    state = constraint_states.of_panda(500, seed=4)
    found = constrained(*state.arguments, ENOUGH)
    nearing = -moved(state.distances.gradient, found.joint_velocity)
    excess = (nearing - constraint_states.allowed(state, ENOUGH)).amax(-1)
    assert (excess <= found.violation + 1e-9).all()
    conflict = found.violation > 1e-4
    assert 50 < conflict.sum() < 450
    torch.testing.assert_close(excess[conflict], found.violation[conflict])


def test_a_person_who_comes_faster_than_the_arm_can_recede():
    """Nothing but the violation is left: the arm recedes with all its acceleration allows."""
    limit = torch.full((7,), 0.02, dtype=DOUBLE)
    gradient = torch.tensor([[0.3, -0.2, 0.1, 0.05, 0.0, 0.0, 0.0]], dtype=DOUBLE)
    found = constrained(
        torch.zeros(7, dtype=DOUBLE),
        panda.jacobian(panda.ready),
        -limit,
        limit,
        Distances(
            distance=torch.tensor([0.1], dtype=DOUBLE),
            gradient=gradient,
            approach_speed=torch.tensor([1.6], dtype=DOUBLE),
        ),
    )
    assert found.solved
    torch.testing.assert_close(found.joint_velocity[:4], (limit * gradient[0].sign())[:4])
    least = 1.6 - 5 * (0.1 - 0.03) - 0.02 * 0.65
    assert found.violation == pytest.approx(least, abs=1e-4)


def test_the_null_space_yields_first_and_then_the_task_on_its_path():
    """One joint of a task is slowed by its limit, whatever the others could do."""
    J = panda.jacobian(panda.ready)
    twist = torch.tensor([0.2, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=DOUBLE)
    task = torch.linalg.pinv(J) @ twist
    wide = torch.full((7,), 10.0, dtype=DOUBLE)
    null = null_projection(J, torch.tensor([1.0, 0, 0, 0, 0, 0, 0], dtype=DOUBLE))
    joint = int(null.abs().argmax())
    limit = wide.clone()
    limit[joint] = 0.2 * null[joint].abs() + task[joint].abs()
    found = constrained(task + null, J, -limit, limit)
    torch.testing.assert_close(J @ found.joint_velocity, twist, rtol=0, atol=1e-4)
    assert abs(float(found.joint_velocity[joint])) == pytest.approx(float(limit[joint]))
    # A task of which every joint may do a third: where the null space cannot help all of them.
    narrow = task.abs() / 3 + 1e-9
    found = constrained(task, J, -narrow, narrow)
    assert found.slowed == pytest.approx(2 / 3, abs=1e-3)
    done = J @ found.joint_velocity
    torch.testing.assert_close(done, (1 - found.slowed) * twist, rtol=0, atol=1e-6)


def test_a_task_is_given_up_completely_but_never_runs_backwards():
    J = panda.jacobian(panda.ready)
    task = 0.25 * torch.linalg.pinv(J)[:, 0] * 0.2
    stop = torch.zeros(7, dtype=DOUBLE)
    found = constrained(task, J, stop, stop)
    assert found.slowed == pytest.approx(1.0, abs=1e-6)
    assert not found.joint_velocity.any()
    # A person comes towards it.
    ahead = Distances(
        distance=torch.tensor([0.03], dtype=DOUBLE),
        gradient=-task.unsqueeze(0),
        approach_speed=torch.tensor([0.1], dtype=DOUBLE),
    )
    wide = torch.full((7,), 9.0, dtype=DOUBLE)
    found = constrained(task, J, -wide, wide, ahead)
    assert found.slowed == pytest.approx(1.0, abs=1e-9)
    assert found.violation < 1e-3
    assert (ahead.gradient @ found.joint_velocity).item() == pytest.approx(0.1, abs=1e-3)


@pytest.mark.parametrize("stray", [0.0, 1e-3, 0.02])
@pytest.mark.parametrize("lever", [1e-4, 1e-3, 1e-2, 0.1])
def test_the_null_space_does_not_become_fast_for_a_slow_tool(stray: float, lever: float):
    """Braking leaves a velocity that approaches a person, and the null space changes the
    distance by a small lever: with costs of absolute speeds, the least cost moves the null
    space by W_t / 2 times the speed of the tool's part at most, whatever the lever.
    """
    J = panda.jacobian(panda.ready)
    left = torch.linalg.pinv(J)[:, 1]
    left = left / left.norm()
    null = null_projection(J, torch.ones(7, dtype=DOUBLE))
    gradient = -0.3 * left + lever * null / null.norm()
    near = Distances(
        distance=torch.tensor([0.0], dtype=DOUBLE),
        gradient=gradient.unsqueeze(0),
        approach_speed=torch.tensor([1.0], dtype=DOUBLE),
        person=torch.tensor([True]),
    )
    wide = torch.full((7,), 9.0, dtype=DOUBLE)
    found = constrained(stray * left, J, -wide, wide, near)
    W = ConstraintConfig().task_weight
    assert null_projection(J, found.joint_velocity).norm() <= W / 2 * stray * (1 + 1e-4)
    # Minimum of z^2 + W^2 t^2 subject to  lever z + 0.3 t = 0.3 stray.
    saved = lever**2 / (lever**2 + (0.3 / W) ** 2)
    assert found.slowed == pytest.approx(1 - saved if stray else 0.0, abs=1e-3)


def test_single_precision_is_computed_in_double():
    state = constraint_states.of_panda(100, seed=6)
    single = [
        Distances(**{k: v.float() if v.is_floating_point() else v for k, v in vars(x).items()})
        if isinstance(x, Distances)
        else x.float()
        for x in state.arguments
    ]
    found, exact = (constrained(*x, ENOUGH) for x in (single, state.arguments))
    assert found.joint_velocity.dtype == torch.float32
    error = (found.joint_velocity - exact.joint_velocity).abs().amax(-1)
    assert error.median() < 1e-5


def test_the_exported_layer_is_the_eager_one():
    state = constraint_states.of_panda(1, seed=7)
    arguments = [x[0] for x in state.arguments[:4]]
    names = [f.name for f in dataclasses.fields(Distances)]
    near = [getattr(state.distances, name)[0] for name in names]
    config = ConstraintConfig(steps=2)

    class Layer(torch.nn.Module):
        def forward(self, wanted, J, lower, upper, *near):
            distances = Distances(**dict(zip(names, near, strict=True)))
            return tuple(constrained(wanted, J, lower, upper, distances, config))

    with shapes_unchecked():
        program = torch.export.export(Layer(), (*arguments, *near), strict=False)
        exported = program.module()(*arguments, *near)
        eager = Layer()(*arguments, *near)
    for one, other in zip(exported, eager, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-9)


@pytest.mark.parametrize("singular", [False, True])
@pytest.mark.parametrize("compiling", [False, True])
def test_last_directions_of_the_basis_leave_the_tool_at_rest(singular, compiling, monkeypatch):
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: compiling)
    rng = sampling.generator(8)
    J = torch.randn(20, 6, 7, generator=rng, dtype=DOUBLE)
    if singular:
        J[:, 3:] = J[:, :3]
    basis = orthonormal_basis(J)
    eye = torch.eye(7, dtype=DOUBLE).expand(20, 7, 7)
    torch.testing.assert_close(basis.mT @ basis, eye, rtol=0, atol=1e-13)
    assert (J @ basis[..., 6:]).abs().max() < 1e-13


@pytest.mark.parametrize("compiling", [False, True])
def test_the_basis_of_an_arm_of_five_joints_is_orthogonal(compiling, monkeypatch):
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: compiling)
    J = torch.randn(20, 6, 5, generator=sampling.generator(8), dtype=DOUBLE)
    basis = orthonormal_basis(J)
    eye = torch.eye(5, dtype=DOUBLE).expand(20, 5, 5)
    torch.testing.assert_close(basis.mT @ basis, eye, rtol=0, atol=1e-13)
    assert null_projection(J, basis[..., 0]).abs().max() < 1e-13


def test_an_arm_of_five_joints_reports_the_task_it_gives_up_and_settles_conflicts():
    """Its Jacobian has more rows than columns: all of its motion belongs to the task."""
    J = torch.randn(6, 5, generator=sampling.generator(9), dtype=DOUBLE)
    wanted, wide = torch.full((5,), 0.3, dtype=DOUBLE), torch.full((5,), 2.0, dtype=DOUBLE)
    ahead = torch.full((1, 5), -0.2, dtype=DOUBLE)
    person = Distances(
        distance=torch.zeros(1, dtype=DOUBLE),
        gradient=ahead,
        approach_speed=torch.zeros(1, dtype=DOUBLE),
        person=torch.tensor([True]),
    )
    found = constrained(wanted, J, -wide, wide, person)
    assert found.solved
    assert float(found.slowed) == pytest.approx(1.0, abs=1e-5)
    assert found.joint_velocity.abs().max() < 1e-5
    between = Distances(
        distance=torch.zeros(2, dtype=DOUBLE),
        gradient=torch.cat([ahead, -ahead]),
        approach_speed=torch.zeros(2, dtype=DOUBLE),
    )
    found = constrained(wanted, J, -wide, wide, between)
    assert found.solved
    assert float(found.violation) == pytest.approx(5.0 * 0.03, rel=1e-3)


@pytest.mark.parametrize(
    ("name", "value"),
    [("clearance", -0.1), ("rate", 0.0), ("task_weight", 0.0), ("path_weight", -1.0),
     ("distance_weight", 0.0), ("steps", 0)],
)  # fmt: skip
def test_settings_out_of_range_are_refused(name: str, value: float):
    with pytest.raises(ValueError, match=name):
        ConstraintConfig(**{name: value})


def test_one_step_of_the_solver_is_enough_for_one_limit():
    J, still = panda.jacobian(panda.ready), torch.zeros(7, dtype=DOUBLE)
    wide = torch.full((7,), 9.0, dtype=DOUBLE)
    upper = wide.clone()
    upper[2] = -0.1
    found = constrained(still, J, -wide, upper, None, ConstraintConfig(steps=1))
    assert found.solved
    assert float(found.joint_velocity[2]) == pytest.approx(-0.1)
    torch.testing.assert_close(
        J @ found.joint_velocity, torch.zeros(6, dtype=DOUBLE), rtol=0, atol=1e-6
    )


class TestInTheFilter:
    """`SafetyConfig.constraints`."""

    config = SafetyConfig(constraints=ConstraintConfig())

    def test_nothing_near_leaves_the_filter_as_it_is(self):
        """But for commands that a joint limit cuts, which are not drawn."""
        rng = sampling.generator(9)
        plain, layered = SafetyFilter(panda.limits), SafetyFilter(panda.limits, self.config)
        q = panda.ready + 0.2 * torch.randn(50, 7, generator=rng, dtype=DOUBLE)
        u = 0.3 * torch.randn(50, 7, generator=rng, dtype=DOUBLE)
        far = Distances(
            distance=torch.full((50, 2), 50.0, dtype=DOUBLE),
            gradient=torch.randn(50, 2, 7, generator=rng, dtype=DOUBLE),
            approach_speed=torch.zeros(50, 2, dtype=DOUBLE),
        )
        J, state = panda.jacobian(q), plain.initial_state(q)
        other = layered.initial_state(q)
        for dt in (0.001, 0.004, 0.02):
            v, state, report = plain.step(state, q, u, dt, jacobian=J)
            w, other, told = layered.step(other, q, u, dt, jacobian=J, distances=far)
            torch.testing.assert_close(w, v, rtol=0, atol=1e-12)
            assert torch.equal(told.flags, report.flags)
            assert report.constraints is None
            assert told.constraints is not None
            assert told.constraints.solved.all()

    @pytest.mark.parametrize("dt", [0.001, 0.01])
    def test_no_command_breaks_a_limit_or_meets_what_rests(self, dt: float):
        """Distances to planes in joint space: exact, so that errors are the layer's alone."""
        rng = sampling.generator(10)
        count, limits = 40, panda.limits
        safety = SafetyFilter(limits, self.config)
        q = sampling.within(limits.lower, limits.upper, count, rng=rng, margin=0.3)
        gradient = 0.3 * torch.randn(count, 3, 7, generator=rng, dtype=DOUBLE)
        offset = 0.1 + 0.1 * torch.rand(count, 3, generator=rng, dtype=DOUBLE)
        offset = offset - moved(gradient, q)
        state, before, unsolved = safety.initial_state(q), safety.initial_state(q), 0
        last = torch.zeros_like(q)
        with shapes_unchecked():
            for k in range(80):
                if k % 10 == 0:
                    u = 2 * torch.randn(count, 7, generator=rng, dtype=DOUBLE)
                near = Distances(
                    distance=moved(gradient, q) + offset,
                    gradient=gradient,
                    approach_speed=torch.zeros(count, 3, dtype=DOUBLE),
                )
                v, state, report = safety.step(
                    state, q, u, dt, jacobian=panda.jacobian(q), distances=near
                )
                unsolved += int((~report.constraints.solved).sum())
                q = q + v * dt
                reach = limits.acceleration * dt * (1 + 1e-9)
                assert ((v - before.velocity).abs() <= reach).all()
                assert (v.abs() <= limits.velocity).all()
                assert (q >= limits.lower).all()
                assert (q <= limits.upper).all()
                acceleration = (v - before.velocity) / dt
                change = (acceleration - last).abs()
                assert (change <= limits.jerk * dt * (1 + 1e-9)).all()
                before, last = state, acceleration
        assert unsolved <= 0.001 * count * 80
        assert (moved(gradient, q) + offset).min() > 0.02

    def test_the_null_space_makes_way_for_the_task_at_a_joint_limit(self):
        """A joint limit that the null space alone would run into costs the task nothing."""
        q = panda.ready.clone()
        J = panda.jacobian(q)
        null = null_projection(J, torch.tensor([0, 0, 1.0, 0, 0, 0, 0], dtype=DOUBLE))
        joint = int(null.abs().argmax())
        task = 0.3 * torch.linalg.pinv(J)[:, 1]
        limits = panda.limits
        at = limits.upper if null[joint] > 0 else limits.lower
        tight = q[joint] + 0.03 * null[joint].sign()
        at = at.clone()
        at[joint] = tight
        limits = replace(limits, **{"upper" if null[joint] > 0 else "lower": at})
        speeds = []
        for config in (SafetyConfig(), self.config):
            safety = SafetyFilter(limits, config)
            state = safety.initial_state(q)
            for _ in range(40):  # until the joints have got under way, nobody moves on
                v, state, _ = safety.step(state, q, task + null, 0.01, jacobian=J)
            speeds.append(J @ v)
        wanted = J @ task
        assert (speeds[0] - wanted).norm() > 0.02
        torch.testing.assert_close(speeds[1], wanted, rtol=0, atol=2e-3)

    def test_an_arm_that_picks_up_speed_gives_up_what_it_has(self):
        """In the first step, with a person who comes."""
        safety, q = SafetyFilter(panda.limits, self.config), panda.ready
        J = panda.jacobian(q)
        task = 0.3 * torch.linalg.pinv(J)[:, 0]
        ahead = Distances(
            distance=torch.tensor([0.03], dtype=DOUBLE),
            gradient=-task.unsqueeze(0),
            approach_speed=torch.tensor([0.5], dtype=DOUBLE),
        )
        start = safety.initial_state(q)
        v, _, _ = safety.step(start, q, task, 0.01, jacobian=J)
        w, after, report = safety.step(start, q, task, 0.01, jacobian=J, distances=ahead)
        assert (w - v).norm() > 1e-3
        torch.testing.assert_close(after.acceleration, w / 0.01)  # not that of the command
        assert 0 < float((v @ task) / (task @ task)) < 0.5
        assert float(report.constraints.slowed) == pytest.approx(1.0)

    def test_a_task_that_slows_down_leaves_the_null_space_as_it_is(self):
        """Somebody ahead of the tool whom the null space cannot avoid."""
        safety, q = SafetyFilter(panda.limits, self.config), panda.ready
        J = panda.jacobian(q)
        task = 0.2 * torch.linalg.pinv(J)[:, 0]
        null = 0.3 * null_projection(J, torch.eye(7, dtype=DOUBLE)[2])
        ahead = Distances(
            distance=torch.tensor([0.03], dtype=DOUBLE) + (task @ task) / 10,
            gradient=-task.unsqueeze(0),
            approach_speed=torch.zeros(1, dtype=DOUBLE),
        )
        v, _, report = safety.step(
            safety.initial_state(q, task + null),
            q,
            task + null,
            0.1,
            jacobian=J,
            distances=ahead,
        )
        # To leave the path costs W_p^2 / W_t^2 times as much: 1e-6 of the speed lost.
        assert float(report.constraints.slowed) == pytest.approx(0.5, abs=2e-6)
        torch.testing.assert_close(v, 0.5 * task + null, rtol=0, atol=2e-6)

    def test_a_task_slows_down_while_the_null_space_turns_back(self):
        """The tool stays on its path, whatever the null space still has to catch up."""
        safety, q = SafetyFilter(panda.limits, self.config), panda.ready
        J = panda.jacobian(q)
        task = 0.02 * torch.linalg.pinv(J)[:, 0]
        null = 1.0 * null_projection(J, torch.eye(7, dtype=DOUBLE)[2])
        ahead = Distances(
            distance=torch.tensor([0.03], dtype=DOUBLE) + (task @ task) / 10,
            gradient=-task.unsqueeze(0),
            approach_speed=torch.zeros(1, dtype=DOUBLE),
        )
        moving = safety.initial_state(q, task - null)
        v, _, report = safety.step(moving, q, task + null, 0.01, jacobian=J, distances=ahead)
        # The weights trade 1e-4 of the task for the null space.
        assert float(report.constraints.slowed) == pytest.approx(0.5, abs=2e-4)
        torch.testing.assert_close(J @ v, 0.5 * (J @ task), rtol=0, atol=4e-6)

    def test_a_stop_stays_a_stop_whoever_comes(self):
        safety, q = SafetyFilter(panda.limits, self.config), panda.ready
        near = Distances(
            distance=torch.tensor([0.05], dtype=DOUBLE),
            gradient=torch.full((1, 7), 0.3, dtype=DOUBLE),
            approach_speed=torch.tensor([1.0], dtype=DOUBLE),
        )
        arguments = (safety.initial_state(q), q, torch.ones(7, dtype=DOUBLE), 0.01)
        J = panda.jacobian(q)
        v, _, _ = safety.step(*arguments, jacobian=J, distances=near, stop=torch.tensor(True))
        assert not v.any()
        away, _, _ = safety.step(*arguments, jacobian=J, distances=near)
        assert (near.gradient @ away > 0).all()

    @pytest.mark.parametrize("value", [torch.nan, torch.inf, 1e300])
    @pytest.mark.parametrize("name", ["distance", "gradient", "approach_speed"])
    def test_unknown_distances_brake_one_arm_alone(self, name: str, value: float):
        safety, q = SafetyFilter(panda.limits, self.config), panda.ready.expand(3, 7)
        parts = {
            "distance": torch.full((3, 1), 0.1, dtype=DOUBLE),
            "gradient": torch.full((3, 1, 7), 0.2, dtype=DOUBLE),
            "approach_speed": torch.zeros(3, 1, dtype=DOUBLE),
        }
        bad = {key: x.clone() for key, x in parts.items()}
        bad[name][1].view(-1)[0] = value
        state = safety.initial_state(q, torch.full((3, 7), -0.5, dtype=DOUBLE))
        arguments = (state, q, state.velocity, 0.01)
        given = {"jacobian": panda.jacobian(q)}
        clean, _, _ = safety.step(*arguments, **given, distances=Distances(**parts))
        v, _, report = safety.step(*arguments, **given, distances=Distances(**bad))
        assert report.acted("invalid").tolist() == [False, True, False]
        assert torch.equal(v[[0, 2]], clean[[0, 2]])
        assert (v[1] > -0.5).all()
        assert v.isfinite().all()

    def test_it_says_what_is_missing(self):
        q = panda.ready
        near = Distances(
            distance=torch.ones(1).double(),
            gradient=torch.zeros(1, 7).double(),
            approach_speed=torch.zeros(1).double(),
        )
        plain = SafetyFilter(panda.limits)
        with pytest.raises(ValueError, match="ConstraintConfig"):
            plain.step(plain.initial_state(q), q, q, 0.01, distances=near)
        layered = SafetyFilter(panda.limits, self.config)
        with pytest.raises(ValueError, match="jacobian"):
            layered.step(layered.initial_state(q), q, q, 0.01, distances=near)


@pytest.mark.parametrize("scale", [0.0, 0.3, 2.0])
def test_a_constrained_velocity_has_the_slope_of_finite_differences(scale):
    """A policy can be trained through the filter, also of an arm that nobody moves."""
    safety = SafetyFilter(panda, SafetyConfig(constraints=ConstraintConfig()))
    rng = sampling.generator(3)
    q = panda.ready.double() + 0.1 * torch.randn(30, 7, generator=rng, dtype=DOUBLE)
    wanted = scale * torch.randn(30, 7, generator=rng, dtype=DOUBLE)
    near = Distances(
        distance=torch.full((30, 2), 0.05, dtype=DOUBLE),
        gradient=torch.randn(30, 2, 7, generator=rng, dtype=DOUBLE),
        approach_speed=torch.zeros(30, 2, dtype=DOUBLE),
    )
    state, J = safety.initial_state(q), panda.jacobian(q)

    def sent(u: Tensor) -> Tensor:
        return safety.step(state, q, u, 0.01, jacobian=J, distances=near)[0].sum()

    (slope,) = torch.autograd.grad(sent(u := wanted.clone().requires_grad_()), u)
    assert slope.isfinite().all()
    if scale:  # an arm at rest has a kink, where differences mean nothing
        for k in range(7):
            step = 1e-6 * torch.eye(7, dtype=DOUBLE)[k]
            difference = (sent(wanted + step) - sent(wanted - step)) / 2e-6
            torch.testing.assert_close(slope[:, k].sum(), difference, rtol=1e-4, atol=1e-6)
