"""What every movement primitive promises, whatever it moves.

A variant says in a subclass how it is made and read, and inherits all the checks.
"""

from copy import deepcopy

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck
from unchecked import shapes_unchecked


class DMPContract:
    """Subclass as `TestSomething`, fill in the five methods, add what is peculiar to it."""

    reproduction = 1e-5
    """Bound on the error of the default rollout, in the unit of `distance`."""

    def demonstrate(self, seed, n_samples=300):
        """Arguments of `fit` for one demonstration, samples along dim 0; time first."""
        raise NotImplementedError

    def fit(self, *demonstration, **kwargs):
        """A primitive in float64."""
        raise NotImplementedError

    def outputs(self, trajectory):
        """Its outputs by name; "rate of x" is the derivative by time of "x"."""
        raise NotImplementedError

    def state_outputs(self, state):
        """Outputs of a state, with the names they have for a trajectory."""
        raise NotImplementedError

    def ends(self, seed):
        """Tensors that `arguments` makes a new start and a new goal of."""
        raise NotImplementedError

    def arguments(self, start, goal):
        """Arguments of `rollout` for them."""
        return {"start": start, "goal": goal}

    def distance(self, outputs, demonstration):
        """Largest distance between a rollout and a demonstration."""
        raise NotImplementedError

    @pytest.fixture(scope="class")
    @classmethod
    def fitted(cls):
        contract = cls()
        return contract.fit(*contract.demonstrate(0))

    @pytest.fixture
    def dmp(self, fitted):
        return deepcopy(fitted)

    def batch(self, n):
        time, *columns = zip(*(self.demonstrate(seed) for seed in range(n)), strict=True)
        return time[0], *(torch.stack(column) for column in columns)

    def assert_same(self, a, b, atol=1e-9, index=...):
        assert a.keys() == b.keys()
        for name in a:
            torch.testing.assert_close(a[name][index], b[name], rtol=1e-9, atol=atol, msg=name)

    def test_defaults_repeat_the_demonstration(self, dmp):
        outputs = self.outputs(dmp.rollout())
        assert self.distance(outputs, self.demonstrate(0)) < self.reproduction

    def test_reversed_goes_the_same_way_back(self, dmp):
        back = dmp.reversed()
        time, *columns = self.demonstrate(0)
        flipped = time, *(column.flip(0) for column in columns)
        assert self.distance(self.outputs(back.rollout()), flipped) < 3 * self.reproduction
        again = self.outputs(back.reversed().rollout())
        assert self.distance(again, self.demonstrate(0)) < 5 * self.reproduction
        batch = self.fit(*self.batch(2)).reversed()
        alone = self.fit(*self.demonstrate(1)).reversed()
        together = self.outputs(batch.rollout(**self.arguments(*self.ends(7))))
        alone = self.outputs(alone.rollout(**self.arguments(*self.ends(7))))
        self.assert_same(together, alone, atol=1e-6, index=1)

    def test_a_batch_is_a_loop(self):
        dmp = self.fit(*self.batch(3))
        arguments = self.arguments(*self.ends(7))
        together = self.outputs(dmp.rollout(**arguments, speed=2.0))
        for i in range(3):
            alone = self.fit(*self.demonstrate(i)).rollout(**arguments, speed=2.0)
            self.assert_same(together, self.outputs(alone), atol=1e-6, index=i)

    def test_masked_samples_do_not_matter(self):
        demonstration = self.demonstrate(0)
        mask = torch.ones(2, 310, dtype=torch.bool)
        mask[1, 300:] = False
        padded = [torch.cat([c, torch.full_like(c[:10], torch.nan)]) for c in demonstration]
        other = [*self.demonstrate(1, n_samples=310)]
        both = [torch.stack([a, b]) for a, b in zip(other, padded, strict=True)]
        dmp = self.fit(*both, mask=mask)
        alone = self.outputs(self.fit(*demonstration).rollout())
        together = self.outputs(dmp.rollout())
        self.assert_same(together, alone, atol=1e-6, index=(1, slice(300)))

    def test_the_path_does_not_depend_on_the_duration(self, dmp):
        arguments = self.arguments(*self.ends(1))
        slow = self.outputs(dmp.rollout(**arguments))
        fast = self.outputs(dmp.rollout(**arguments, duration=dmp.duration / 4))
        for name in slow:
            factor = 4 if name.startswith("rate of") else 1
            torch.testing.assert_close(fast[name], factor * slow[name], msg=name)

    def test_rates_are_derivatives(self, dmp):
        t = torch.linspace(0, 1.3, 2601, dtype=torch.float64) * dmp.duration
        outputs = self.outputs(dmp.rollout(time=t, **self.arguments(*self.ends(2))))
        for name in outputs:
            if f"rate of {name}" in outputs:
                central = (outputs[name][2:] - outputs[name][:-2]) / (t[2:] - t[:-2])[:, None]
                expected = self.rate(name, outputs)[1:-1]
                torch.testing.assert_close(central, expected, rtol=0, atol=2e-3, msg=name)

    def rate(self, name, outputs):
        """Derivative by time of an output, from what the trajectory claims."""
        return outputs[f"rate of {name}"]

    def test_motion_settles_at_the_goal_from_anywhere(self, dmp):
        arguments = self.arguments(*self.ends(3))
        late = dmp.duration * torch.tensor([4.0])
        one = self.outputs(dmp.rollout(time=late, **arguments))
        # The way round to a goal depends on the start, the goal does not.
        start, goal = self.ends(3)
        other = self.outputs(dmp.rollout(time=late, **self.arguments(0.9 * start, goal)))
        self.assert_same(one, other, atol=1e-6)
        for name, value in one.items():
            if name.startswith("rate of"):
                assert value.abs().max() < 1e-9, name

    @pytest.mark.parametrize("n_steps", [1, 20, 200])
    def test_steps_end_where_the_rollout_does(self, dmp, n_steps):
        arguments = self.arguments(*self.ends(4))
        state = dmp.initial_state(**arguments, duration=2.0)
        with torch.no_grad(), shapes_unchecked():
            for _ in range(n_steps):
                state = dmp.step(state, 1.7 / n_steps)
            there = self.outputs(dmp.rollout(time=[1.7], **arguments, duration=2.0))
        for name, value in self.state_outputs(state).items():
            torch.testing.assert_close(value, there[name][0], rtol=0, atol=1e-9, msg=name)

    def test_steps_can_be_exported(self, dmp):
        class Step(torch.nn.Module):
            def __init__(self):
                super().__init__()
                self.dmp = dmp

            def forward(self, state, dt):
                return self.dmp.step(state, dt)

        dmp.requires_grad_(False)
        state = dmp.initial_state()
        dt = torch.tensor(0.02, dtype=torch.float64)
        with shapes_unchecked():
            program = torch.export.export(Step(), (state, dt)).module()
        exported = state
        for _ in range(5):
            state, exported = dmp.step(state, dt), program(exported, dt)
        self.assert_same(self.state_outputs(exported), self.state_outputs(state))

    def test_slowing_down_stays_on_the_path(self, dmp):
        state = dmp.initial_state()
        for k in range(20):
            waiting = 3.0 if k % 2 else None
            state = dmp.step(state, 0.03 * dmp.duration, phase_stopping=waiting)
        s = torch.tensor([10 * 0.03 * (1 + 1 / 4)], dtype=torch.float64)
        there = self.outputs(dmp.rollout(time=s * dmp.duration))
        for name, value in self.state_outputs(state).items():
            factor = 4 if name.startswith("rate of") else 1
            torch.testing.assert_close(factor * value, there[name][0], rtol=0, atol=1e-9)

    def test_gradients_are_exact(self):
        dmp = self.fit(*(column[::15] for column in self.demonstrate(0)), n_basis=3)
        weights = [name for name, _ in dmp.named_parameters()]
        assert weights
        dmp.forward = dmp.rollout

        def outputs(parameter, start, goal, duration, time):
            kwargs = self.arguments(start, goal) | {"duration": duration, "time": time}
            moved = torch.func.functional_call(dmp, {weights[0]: parameter}, (), kwargs)
            return tuple(self.outputs(moved).values())

        time = dmp.duration * torch.tensor([0.1, 0.7, 1.2], dtype=torch.float64)
        inputs = (dmp.get_parameter(weights[0]), *self.ends(5), dmp.duration, time)
        inputs = tuple(x.detach().clone().requires_grad_() for x in inputs)
        with shapes_unchecked():
            # Along one random direction.
            assert gradcheck(outputs, inputs, atol=1e-6, rtol=1e-6, fast_mode=True)

    def test_times_and_durations_of_their_own_are_a_loop(self):
        dmp = self.fit(*self.batch(3), n_basis=8)
        rng = torch.Generator().manual_seed(2)
        time = (2 * torch.rand(3, 9, generator=rng, dtype=torch.float64)).sort(-1).values
        duration = 1 + torch.rand(3, generator=rng, dtype=torch.float64)
        arguments = self.arguments(*self.ends(7))
        together = self.outputs(dmp.rollout(time, duration=duration, **arguments))
        for i in range(3):
            one = dmp[i].rollout(time[i], duration=duration[i], **arguments)
            self.assert_same(together, self.outputs(one), atol=1e-8, index=i)
            # Nor does it matter which other times are asked for.
            few = dmp[i].rollout(time[i, ::3], duration=duration[i], **arguments)
            self.assert_same(
                self.outputs(one), self.outputs(few), atol=1e-8, index=slice(0, None, 3)
            )

    def test_maps_and_derives_in_any_way(self):
        dmp = self.fit(*(column[::15] for column in self.demonstrate(0)), n_basis=3)
        time = torch.tensor([0.1, 0.7, 1.2], dtype=torch.float64)
        durations = torch.tensor([0.8, 1.3], dtype=torch.float64)
        start, goal = self.ends(5)

        def path(duration, goal):
            arguments = self.arguments(start, goal)
            outputs = self.outputs(dmp.rollout(time, duration=duration, **arguments))
            return torch.cat([x.flatten() for x in outputs.values()])

        with shapes_unchecked():
            looped = torch.stack([path(duration, goal) for duration in durations])
            mapped = torch.func.vmap(path, in_dims=(0, None))(durations, goal)
            torch.testing.assert_close(mapped, looped)
            ends = durations[0].clone().requires_grad_(), goal.detach().clone().requires_grad_()
            directions = torch.ones_like(ends[0]), 0.1 * torch.ones_like(goal)
            _, forward = torch.func.jvp(path, ends, directions)
            by_duration, by_goal = torch.autograd.functional.jacobian(path, ends)
            backward = by_duration + by_goal.flatten(1) @ directions[1].flatten()
            torch.testing.assert_close(forward, backward, rtol=1e-8, atol=1e-8)
            assert gradgradcheck(path, ends, atol=1e-4, rtol=1e-3, fast_mode=True)

    @pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
    def test_a_gpu_does_what_the_cpu_does(self):
        results = []
        for device in ("cpu", "cuda"):
            dmp = self.fit(*(column.to(device) for column in self.batch(2)))
            arguments = self.arguments(*(end.to(device) for end in self.ends(7)))
            durations = torch.tensor([0.8, 1.3], dtype=torch.float64, device=device)
            state = dmp.initial_state(**arguments)
            for _ in range(5):
                state = dmp.step(state, 0.1)
            motions = (
                dmp.rollout(**arguments),
                dmp.rollout([0.3, 0.9], **arguments, duration=2.0),
                dmp.rollout(**arguments, duration=durations),
            )
            results.append([*map(self.outputs, motions), self.state_outputs(state)])
        for cpu, gpu in zip(*results, strict=True):
            for name, value in gpu.items():
                assert value.is_cuda, name
                same = value.cpu()
                if name.endswith("orientation") and not name.startswith("rate of"):
                    # Of either sign.
                    same = same * (same * cpu[name]).sum(-1, keepdim=True).sign()
                torch.testing.assert_close(same, cpu[name], rtol=1e-7, atol=1e-7)

    def test_a_saved_primitive_is_the_same(self, dmp, tmp_path):
        dmp.save(tmp_path / "saved")
        loaded = type(dmp).load(tmp_path / "saved")
        arguments = self.arguments(*self.ends(6))
        self.assert_same(
            self.outputs(loaded.rollout(**arguments)), self.outputs(dmp.rollout(**arguments)), 0
        )
        assert sorted(p.name for p in (tmp_path / "saved").iterdir()) == [
            ".manifest.json",
            "config.json",
            "model.safetensors",
        ]

    def test_files_of_another_kind_are_refused(self, dmp, tmp_path):
        dmp.save(tmp_path)
        config = tmp_path / "config.json"
        config.write_text(config.read_text().replace(type(dmp).__name__, "ToasterDMP"))
        with pytest.raises(ValueError, match=r"config\.json: kind is 'ToasterDMP'"):
            type(dmp).load(tmp_path)

    def test_float32_in_float32_out(self):
        demonstration = [column.float() for column in self.demonstrate(0)]
        outputs = self.outputs(self.fit(*demonstration).rollout())
        assert {value.dtype for value in outputs.values()} == {torch.float32}
        double = {name: value.double() for name, value in outputs.items()}
        assert self.distance(double, self.demonstrate(0)) < self.reproduction + 1e-5

    def test_numpy_demonstrations_are_taken(self, dmp):
        arrays = [np.asarray(column) for column in self.demonstrate(0)]
        self.assert_same(
            self.outputs(self.fit(*arrays).rollout()), self.outputs(dmp.rollout()), 0
        )
