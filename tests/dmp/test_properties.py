"""Properties that hold for every motion, start, goal and duration."""

import dataclasses
from itertools import pairwise

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hrc_learn.dmp import JointDMP, SpringDamper

number = st.floats(-3, 3, allow_subnormal=False)
vectors = arrays("float64", 2, elements=number).map(torch.from_numpy)
motions = arrays("float64", (40, 2), elements=number).map(
    lambda steps: torch.from_numpy(steps).cumsum(0) / 10
)
durations = st.floats(0.05, 60)
springs = st.builds(SpringDamper, alpha=st.floats(10, 60), beta=st.floats(2, 30))
scalings = st.sampled_from(["none", "amplitude"])
quick = settings(max_examples=30)
TIME = torch.linspace(0, 1, 40, dtype=torch.float64)


def close(a, b, scale=1.0):
    torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-6 * scale)


def size_of(motion):
    return 1 + motion.abs().max().item()


@quick
@given(motion=motions, shift=vectors, spring=springs, scaling=scalings)
def test_translation(motion, shift, spring, scaling):
    plain = JointDMP.fit(TIME, motion, 12, spring=spring, scaling=scaling)
    moved = JointDMP.fit(TIME, motion + shift, 12, spring=spring, scaling=scaling)
    close(moved.rollout().position, plain.rollout().position + shift, size_of(motion))


@quick
@given(motion=motions, duration=durations, spring=springs)
def test_time_rescaling(motion, duration, spring):
    plain = JointDMP.fit(TIME, motion, 12, spring=spring)
    slow = JointDMP.fit(duration * TIME, motion, 12, spring=spring)
    # A motion that rests has weights of rounding only.
    largest = plain.weights.abs().max().item() + size_of(motion)
    close(slow.weights, plain.weights, largest)
    close(duration * slow.rollout().velocity, plain.rollout().velocity, 1e3 * size_of(motion))


@quick
@given(motion=motions, factor=st.floats(0.1, 30), goal=vectors)
def test_scale(motion, factor, goal):
    plain = JointDMP.fit(TIME, motion, 12)
    scaled = JointDMP.fit(TIME, factor * motion, 12)
    close(
        scaled.rollout(goal=factor * goal).position,
        factor * plain.rollout(goal=goal).position,
        factor * size_of(motion),
    )


@quick
@given(motion=motions, goal=vectors, push=vectors, spring=springs)
def test_convergence_from_any_perturbation(motion, goal, push, spring):
    dmp = JointDMP.fit(TIME, motion, 12, spring=spring)
    state = dmp.step(dmp.initial_state(goal=goal), 0.4)
    state = dataclasses.replace(state, position=state.position + push, rate=50 * push)
    close(dmp.step(state, 1e3).position, goal)


@quick
@given(
    motion=motions,
    goal=vectors,
    approach=st.sampled_from([0.0, 0.5, 1.0]),
    cuts=st.lists(st.floats(0, 1), max_size=5),
)
def test_how_time_is_cut_into_steps_does_not_matter(motion, goal, approach, cuts):
    dmp = JointDMP.fit(TIME, motion, 12, approach=approach)
    stops = [0.0, *sorted(cuts), 1.0]
    state = dmp.initial_state(goal=goal)
    for before, after in pairwise(stops):
        state = dmp.step(state, after - before)
    end = dmp.rollout(time=[1.0], goal=goal)
    close(state.position, end.position[0], size_of(motion))
    close(state.velocity, end.velocity[0], 1e2 * size_of(motion))
