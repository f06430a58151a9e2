import pytest
import torch

from hrc_learn.dmp import GaussianBasis, JointDMP, SpringDamper, continue_motion, response_of

RESPONSE = response_of(SpringDamper(), GaussianBasis(count=12))


def primitive(batch: tuple[int, ...], seed: int = 0) -> JointDMP:
    """Three coordinates with weights, ends and durations drawn at random."""
    rng = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn((*batch, *shape), generator=rng, dtype=torch.float64)

    return JointDMP(
        weights=100 * draw(3, 12),
        start=draw(3),
        goal=draw(3),
        start_velocity=draw(3),
        duration=1 + draw().abs(),
        amplitude=torch.ones(*batch, 3, dtype=torch.float64),
        timestamps=torch.linspace(0, 1, 5, dtype=torch.float64),
        basis=RESPONSE.basis,
        spring=RESPONSE.spring,
    )


@pytest.mark.parametrize("batch", [(), (1,), (2, 3)])
def test_from_the_start_it_is_the_rollout(batch):
    dmp = primitive(batch)
    time = torch.linspace(0, 3, 7, dtype=torch.float64)
    y, v = continue_motion(
        RESPONSE,
        dmp.weights,
        dmp.goal,
        dmp.start,
        dmp.start_velocity,
        duration=dmp.duration,
        elapsed=torch.zeros_like(dmp.duration),
        time=time.expand(*batch, -1),
    )
    rollout = dmp.rollout(time)
    torch.testing.assert_close(y, rollout.position, rtol=0, atol=1e-9)
    torch.testing.assert_close(v, rollout.velocity, rtol=0, atol=1e-9)


@pytest.mark.parametrize("elapsed", [0.3, 1.7, 4.0])
def test_of_a_motion_left_alone_it_is_what_follows(elapsed):
    """Cut anywhere, also after its end, a motion goes on as if it had not been."""
    dmp = primitive((2,), seed=1)
    ahead = torch.linspace(0, 1, 5, dtype=torch.float64)
    cut = dmp.rollout(torch.tensor([elapsed]))
    y, v = continue_motion(
        RESPONSE,
        dmp.weights,
        dmp.goal,
        cut.position[:, 0],
        cut.velocity[:, 0],
        duration=dmp.duration,
        elapsed=torch.full((2,), elapsed),
        time=ahead.expand(2, -1),
    )
    # The cut is at a float32 time, and all that follows with it.
    whole = dmp.rollout(torch.tensor(elapsed).double() + ahead)
    torch.testing.assert_close(y, whole.position, rtol=0, atol=1e-9)
    torch.testing.assert_close(v, whole.velocity, rtol=0, atol=1e-9)


def test_after_a_push_it_is_what_steps_come_to():
    """The exact steps of the primitive, from the same disturbed state."""
    dmp = primitive((), seed=2)
    state = dmp.initial_state()
    for _ in range(10):
        state = dmp.step(state, 0.02, coupling=torch.full((3,), 40.0, dtype=torch.float64))
    time = 0.03 * torch.arange(1, 6, dtype=torch.float64)
    y, v = continue_motion(
        RESPONSE,
        dmp.weights,
        dmp.goal,
        state.position,
        state.velocity,
        duration=dmp.duration,
        elapsed=state.s * dmp.duration,
        time=time,
    )
    for k in range(5):
        state = dmp.step(state, 0.03)
        torch.testing.assert_close(y[k], state.position, rtol=0, atol=1e-9)
        torch.testing.assert_close(v[k], state.velocity, rtol=0, atol=1e-9)


def test_gradients_reach_everything():
    dmp, time = primitive((2,), seed=3), torch.tensor([[0.0, 0.4], [0.1, 2.5]]).double()
    arguments = (
        dmp.weights.detach(),
        dmp.goal,
        dmp.start,
        dmp.start_velocity,
        dmp.duration,
        torch.tensor([0.2, 0.5], dtype=torch.float64),
    )

    def motion(w, g, y, v, duration, elapsed):
        return continue_motion(
            RESPONSE, w, g, y, v, duration=duration, elapsed=elapsed, time=time
        )

    assert torch.autograd.gradcheck(motion, [x.requires_grad_() for x in arguments])


def test_an_approach_cannot_be_continued():
    dmp = primitive(())
    with pytest.raises(ValueError, match="approach 0"):
        continue_motion(
            response_of(SpringDamper(), GaussianBasis(count=12), 1.0),
            dmp.weights,
            dmp.goal,
            dmp.start,
            dmp.start_velocity,
            duration=dmp.duration,
            elapsed=dmp.duration,
            time=dmp.timestamps,
        )
