"""Heads of networks: what parameters mean, from which state, and how likely."""

import math
import subprocess
import sys

import pytest
import torch
from demo_motions import arm_motion, minimum_jerk
from safetensors.torch import load_file, save_file
from torch.distributions import MultivariateNormal, kl_divergence
from unchecked import shapes_unchecked

from hrc_learn.dmp import JointDMP, MotionHead
from hrc_learn.dmp.motion_head import _modes

HEADS = {
    "fixed": {"duration": 1.5},
    "timed": {"duration": (1.0, 3.0), "delay": 0.5},
    "late": {"delay": 0.5, "goal_centre": (0.3, -0.2)},
    "scaled": {"duration": (0.5, 2.0), "amplitude": (0.2, 3.0)},
}


def random(*shape, seed=0):
    rng = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=rng, dtype=torch.float64)


@pytest.fixture(params=HEADS)
def head(request):
    return MotionHead(2, 6, **HEADS[request.param]).double()


@pytest.fixture
def factor(head):
    L = head.n_linear
    square = random(3, L, L, seed=5) / L**0.5
    return torch.linalg.cholesky(square @ square.mT + 0.1 * torch.eye(L).to(square))


TIME = torch.linspace(0, 2.5, 41, dtype=torch.float64)


def test_zeros_are_the_minimum_jerk_motion_to_the_centre_of_the_goals():
    head = MotionHead(2, 6, duration=(1.0, 4.0), goal_centre=(0.3, -0.2)).double()
    start = torch.tensor([1.0, 2.0]).double()
    motion = head(torch.zeros(head.n_parameters).double(), TIME, start)
    m = minimum_jerk((TIME / 2).clamp(max=1))[:, None]
    expected = start + m * (head.goal_centre - start)
    torch.testing.assert_close(motion.position, expected, atol=1e-9, rtol=0)
    assert motion.duration.item() == pytest.approx(2.0)


def test_unit_parameters_deviate_by_the_amplitude():
    head = MotionHead(2, 8, amplitude=(0.3, 2.0)).double()
    time = torch.linspace(0, 1, 161).double()
    z = torch.eye(head.n_parameters).double().view(-1, 2, 9)[..., :8]
    weights = torch.cat([z, torch.zeros_like(z[..., :1])], -1).flatten(-2)
    square = head(weights, time, torch.zeros(2).double()).position.square().mean(1)
    # To single precision: a head is made in it.
    torch.testing.assert_close(square.sum(0).sqrt(), head.amplitude, rtol=1e-7, atol=0)
    # Modes of one column are orthogonal, and no smoother one follows a finer one.
    y = head(weights, time, torch.zeros(2).double()).position[:8, :, 0]
    gram = y @ y.mT
    size = gram.diagonal()
    torch.testing.assert_close(gram, torch.diag(size), atol=1e-6 * size[0].item(), rtol=0)
    assert (size.diff() <= 1e-7 * size[0]).all()


def primitive_of(head, z, start, velocity):
    """The motion after its delay, from the definition of the parameters."""
    linear = z[..., : head.n_linear].unflatten(-1, (2, -1))
    weights = head.amplitude[:, None] * linear[..., :-1] @ head.modes.mT
    centre = start if head.goal_centre is None else head.goal_centre
    goal = centre + head.amplitude * linear[..., -1]
    duration = head(z, TIME, start).duration.expand(len(z))
    ends = torch.stack([velocity * duration[:, None], start, goal], -1)
    grid = torch.linspace(0, 1, 11).double()
    x = torch.cat([weights, ends], -1)
    return JointDMP.from_coordinates(x, duration, torch.ones_like(start), grid, head.response)


def test_is_a_primitive_after_its_delay(head):
    z, start, velocity = (
        random(3, head.n_parameters),
        random(3, 2, seed=1),
        random(3, 2, seed=2),
    )
    motion = head(z, TIME, start, velocity)
    dmp = primitive_of(head, z, start, velocity)
    since_delay = (TIME - motion.delay[..., None]).clamp(min=0).expand(3, -1)
    alone = dmp.rollout(since_delay)
    torch.testing.assert_close(motion.position, alone.position)
    waits = (motion.delay[..., None] > TIME).expand(3, -1)
    for output in ("velocity", "acceleration", "jerk"):
        made, expected = getattr(motion, output), getattr(alone, output)
        torch.testing.assert_close(made[~waits], expected[~waits], msg=output)
        assert not made[waits].any()
    torch.testing.assert_close(motion.position[:, 0], start)


def test_goes_on_with_the_same_parameters_as_if_nothing_had_been(head):
    z, start = random(3, head.n_parameters), random(3, 2, seed=1)
    since = torch.tensor([0.7, 0.9, 1.1]).double()
    whole = head(z, TIME, start)
    there = head(z, since[:, None], start)
    state = there.position[:, 0], there.velocity[:, 0]
    later = since[:, None] + TIME
    again = head(z, later, *state, since=since, origin=start)
    expected = head(z, later, start)
    for output in ("position", "velocity", "acceleration"):
        torch.testing.assert_close(getattr(again, output), getattr(expected, output))
    assert whole.time.shape == (3, 41)


def test_goes_on_from_any_state_to_another_goal(head):
    z, state, rate = random(3, head.n_parameters), random(3, 2, seed=3), random(3, 2, seed=4)
    since = 0.8
    motion = head(z, since + TIME, state, rate, since=since)
    torch.testing.assert_close(motion.position[:, 0], state)
    torch.testing.assert_close(motion.velocity[:, 0], rate)
    h = 1e-5
    near = head(
        z, torch.tensor([1.2 - h, 1.2, 1.2 + h], dtype=torch.float64), state, rate, since=since
    )
    slope = (near.position[:, 2] - near.position[:, 0]) / (2 * h)
    torch.testing.assert_close(near.velocity[:, 1], slope, atol=1e-6, rtol=1e-6)
    bend = (near.velocity[:, 2] - near.velocity[:, 0]) / (2 * h)
    torch.testing.assert_close(near.acceleration[:, 1], bend, atol=1e-5, rtol=1e-5)
    end = head(z, torch.tensor([30.0]).double(), state, rate, since=since)
    goal = primitive_of(head, z, state, rate).goal
    torch.testing.assert_close(end.position[:, 0], goal, atol=1e-8, rtol=0)


def test_timing_parameters_are_found_again():
    head = MotionHead(2, 6, duration=(0.5, 4.0), delay=0.8).double()
    timing = head.timing([0.7, 3.9], 0.3)
    z = torch.cat([random(2, head.n_linear), timing.double()], -1)
    motion = head(z, TIME, torch.zeros(2))
    torch.testing.assert_close(
        motion.duration, torch.tensor([0.7, 3.9]).double(), rtol=1e-6, atol=0
    )
    torch.testing.assert_close(motion.delay, torch.full((2,), 0.3).double(), rtol=1e-6, atol=0)
    assert MotionHead(2, 6).timing().shape == (0,)


def test_encoded_motions_are_made_again(head):
    z, start, velocity = (
        random(3, head.n_parameters),
        random(3, 2, seed=1),
        random(3, 2, seed=2),
    )
    motion = head(z, TIME, start, velocity)
    timing = z[..., head.n_linear :]
    # Little noise: the fewer samples a motion has, the more its prior counts.
    found = head.encode(TIME, motion.position, velocity, timing=timing, noise=1e-7)
    again = head(found, TIME, start, velocity).position
    torch.testing.assert_close(again, motion.position, atol=1e-5, rtol=0)
    torch.testing.assert_close(found, z, atol=1e-2, rtol=0)


def test_encodes_recorded_motions():
    time, position = arm_motion(200, 7, 3.0)
    head = MotionHead(7, 30, duration=3.0).double()
    found = head.encode(time, position)
    assert (head(found, time, position[0]).position - position).abs().max() < 1e-3


def dense(head, z, factor, time, start, **state):
    """Mean and covariance of positions by differentiating the motion."""
    L = head.n_linear

    def path(linear, i):
        parameters = torch.cat([linear, z[i, L:]])
        return head(parameters, time, start[i], **state).position.flatten()

    for i in range(len(z)):
        J = torch.autograd.functional.jacobian(lambda x, i=i: path(x, i), z[i, :L])
        root = J @ factor[i]
        yield path(z[i, :L], i), root @ root.mT


@pytest.mark.parametrize("state", [{}, {"since": 0.6}], ids=["whole", "from a state"])
def test_density_of_motions(head, factor, state):
    z, start, time = random(3, head.n_parameters), random(3, 2, seed=1), 0.6 + TIME[::8]
    motions = head.distribution(z, factor, start, **state)
    mean, deviation = motions.position(time)
    y = mean + 0.3 * random(*mean.shape, seed=7)
    density = motions.log_prob(time, y, noise=0.1)
    for i, (middle, covariance) in enumerate(dense(head, z, factor, time, start, **state)):
        torch.testing.assert_close(mean[i].flatten(), middle)
        torch.testing.assert_close(deviation[i].flatten() ** 2, covariance.diagonal())
        noisy = covariance + 0.01 * torch.eye(len(middle)).to(covariance)
        expected = MultivariateNormal(middle, noisy).log_prob(y[i].flatten())
        torch.testing.assert_close(density[i], expected)


def linear_zero(head, z):
    """Parameters with the same timing."""
    return torch.cat([0 * z[..., : head.n_linear], z[..., head.n_linear :]], -1)


@pytest.mark.long
@pytest.mark.parametrize("state", [{}, {"since": 0.6}], ids=["whole", "from a state"])
def test_divergence_of_motions_is_that_of_noisy_positions(head, factor, state):
    start, time = torch.zeros(3, 2).double(), 0.6 + TIME[::8]
    z, others = random(3, head.n_parameters), random(3, head.n_parameters, seed=9)
    wider = 1.5 * factor
    p, q = (head.distribution(*x, start, **state) for x in ((z, factor), (others, wider)))
    found = p.kl(q, time, noise=0.1)
    pairs = (dense(head, *x, time, start, **state) for x in ((z, factor), (others, wider)))
    for i, normals in enumerate(zip(*pairs, strict=True)):
        noisy = (
            MultivariateNormal(mean, C + 0.01 * torch.eye(len(C)).to(C)) for mean, C in normals
        )
        torch.testing.assert_close(found[i], kl_divergence(*noisy))
    assert p.kl(p, time).abs().max() < 1e-6
    assert (p.kl(q, time) > 1).all()


def test_samples_have_the_covariance(head, factor):
    L, start = head.n_linear, torch.zeros(2).double()
    z = random(3, head.n_parameters)
    motions = head.distribution(z, factor, start)
    drawn = motions.rsample((20_000,), torch.Generator().manual_seed(0))
    assert torch.equal(drawn[..., L:], z[..., L:].expand(20_000, 3, -1))
    off = drawn[:, 1, :L] - z[1, :L]
    expected = factor[1] @ factor[1].mT
    # Of 20,000 samples a covariance is off by 1 / sqrt(20,000) of the variances.
    allowed = 6 * expected.diagonal().max().item() / 20_000**0.5
    torch.testing.assert_close(off.mT @ off / 20_000, expected, atol=allowed, rtol=0)
    assert head(drawn[:5], TIME, start).position.shape == (5, 3, 41, 2)


@shapes_unchecked()
def test_derivatives_of_any_order(head):
    z, start, velocity = random(head.n_parameters), random(2, seed=1), random(2, seed=2)
    time = torch.tensor([0.55, 0.8, 1.3]).double()
    inputs = tuple(x.requires_grad_() for x in (z, start, velocity))

    def motion(z, start, velocity):
        made = head(z, time, start, velocity, since=0.3, origin=0.5 * start)
        return made.position, made.velocity

    assert torch.autograd.gradcheck(
        motion, inputs, check_forward_ad=True, atol=1e-6, fast_mode=True
    )
    assert torch.autograd.gradgradcheck(motion, inputs, atol=1e-5, fast_mode=True)


@shapes_unchecked()
def test_maps_like_a_loop(head, factor):
    z, start = random(3, head.n_parameters), random(3, 2, seed=1)

    def path(z, start):
        return head(z, TIME, start).position

    mapped = torch.func.vmap(path)(z, start)
    torch.testing.assert_close(mapped, path(z, start))
    torch.testing.assert_close(mapped[1], path(z[1], start[1]))

    def density(z, factor, start):
        motions = head.distribution(z, factor, start)
        return motions.log_prob(TIME[::8], torch.ones(6, 2).double(), 0.1), motions.kl(
            head.distribution(linear_zero(head, z), 2 * factor, start), TIME[::8], 0.1
        )

    expected = density(z, factor, start)
    for found, value in zip(torch.func.vmap(density)(z, factor, start), expected, strict=True):
        torch.testing.assert_close(found, value)


def test_gradients_reach_mean_and_factor(head, factor):
    z, L = random(3, head.n_parameters), head.n_linear
    time, y = TIME[::10], random(3, 5, 2, seed=3)

    def density(z, factor):
        motions = head.distribution(z, factor.tril(), torch.zeros(2).double())
        reference = head.distribution(
            linear_zero(head, z), torch.eye(L).to(z), torch.zeros(2).double()
        )
        return motions.log_prob(time, y, 0.3) + motions.kl(reference, time, 0.3)

    inputs = z.requires_grad_(), factor.requires_grad_()
    assert torch.autograd.gradcheck(density, inputs, atol=1e-5, fast_mode=True)


def test_state_survives_a_file(head, tmp_path):
    save_file(head.state_dict(), tmp_path / "head.safetensors")
    other = MotionHead(2, 6, amplitude=9.0).double()
    if head.goal_centre is not None:
        other.goal_centre = torch.zeros(2)
    other.load_state_dict(load_file(tmp_path / "head.safetensors"))
    assert torch.equal(other.amplitude, head.amplitude)
    single = MotionHead(2, 6)
    z = torch.zeros(single.n_parameters)
    assert single(z, [0.0, 0.5], [0, 0]).position.dtype == torch.float32


@pytest.mark.parametrize(
    ("message", "call"),
    [
        ("columns and duration must be positive, .*; got 0, 1.0", lambda: MotionHead(0)),
        ("with an ordered range", lambda: MotionHead(2, duration=(2.0, 1.0))),
        ("amplitude must be one number or 2", lambda: MotionHead(2, amplitude=(1.0, 2.0, 3.0))),
        ("goal_centre must have", lambda: MotionHead(2, goal_centre=(1.0,))),
        ("parameters must have shape", lambda: head_of(3)(torch.zeros(5), [0.0], [0.0] * 3)),
        ("parameters must be finite", lambda: planned(z=torch.full((22,), torch.nan))),
        ("start must have", lambda: planned(start=[0.0])),
        ("non-negative", lambda: planned(time=[-1.0])),
        ("no time may be before", lambda: planned(time=[0.2], since=0.5)),
        ("since must be", lambda: planned(since=-1.0)),
        ("give since", lambda: planned(origin=[0.0, 0.0])),
        ("scale_tril must have", lambda: head_of(2).distribution(
            torch.zeros(22), torch.eye(21), [0.0, 0.0]
        )),
        ("no range", lambda: head_of(2).timing(duration=1.0)),
        ("a range", lambda: MotionHead(2, delay=1.0).timing()),
        ("strictly between", lambda: MotionHead(2, duration=(1.0, 2.0)).timing(duration=2.5)),
        ("infinite at", lambda: MotionHead(2, duration=(1.0, 2.0)).timing(duration=1.0)),
        ("widen the range", lambda: MotionHead(2, duration=(1.0, 2.0)).timing(duration=2.0)),
        ("between 0.0 and 0.5", lambda: MotionHead(2, delay=0.5).timing(delay=0.0)),
    ],
)  # fmt: skip
def test_refuses_with_a_sentence(message, call):
    with pytest.raises(ValueError, match=message):
        call()


def head_of(columns):
    return MotionHead(columns, 10)


def planned(z=None, time=(0.0, 1.0), start=(0.0, 0.0), **state):
    z = torch.zeros(22) if z is None else z
    return head_of(2)(z, list(time), list(start), **state)


COMPILED = """
import torch
from hrc_learn.dmp import JointDMP, MotionHead

t = torch.linspace(0, 2, 30)
for options in ({}, {"duration": (1.0, 2.0), "delay": 0.3}):
    head = MotionHead(2, 6, **options)
    net = torch.nn.Sequential(torch.nn.Linear(3, head.n_parameters))

    def plan(x, start):
        return head(net(x), t, start).position

    x, start = torch.randn(4, 3), torch.randn(4, 2)
    torch._dynamo.reset()
    compiled = torch.compile(plan, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(x, start), plan(x, start))
    compiled(x, start).square().sum().backward()
    assert net[0].weight.grad.abs().sum() > 0
"""


def test_compiles_without_a_break():
    """In a process of its own: a compiler cannot follow the shape checks of these tests."""
    subprocess.run([sys.executable, "-c", COMPILED], check=True)


@pytest.mark.parametrize(
    ("options", "linear", "timing"),
    [
        ({}, 22, 0),
        ({"n_basis": 6}, 14, 0),
        ({"duration": (2.0, 2.0)}, 22, 0),
        ({"duration": (1.0, 2.0)}, 22, 1),
        ({"delay": 0.1}, 22, 1),
        ({"duration": (1.0, 2.0), "delay": 0.1}, 22, 2),
    ],
)
def test_parameters_are_weights_goals_and_what_has_a_range(options, linear, timing):
    head = MotionHead(2, **options)
    counts = head.n_linear, head.n_timing, head.n_parameters
    assert counts == (linear, timing, linear + timing)
    assert head.amplitude.tolist() == [1.0, 1.0]
    motion = head(torch.zeros(head.n_parameters), [0.0, 1.0], [0.0, 0.0])
    low, high = options.get("duration", (1.0, 1.0))
    assert motion.duration.item() == pytest.approx((low * high) ** 0.5)
    assert motion.delay.item() == pytest.approx(options.get("delay", 0.0) / 2)


@pytest.mark.parametrize(
    ("options", "refused"),
    [
        ({"duration": 0.0}, True),
        ({"duration": (0.0, 1.0)}, True),
        ({"duration": math.inf}, True),
        ({"duration": (1.0, math.inf)}, True),
        ({"duration": 1e-6}, False),
        ({"delay": -1e-9}, True),
        ({"delay": math.inf}, True),
        ({"delay": 0.0}, False),
        ({"amplitude": 0.0}, True),
        ({"amplitude": -1.0}, True),
    ],
)
def test_numbers_of_a_head_have_the_right_sign(options, refused):
    if refused:
        with pytest.raises(ValueError, match=next(iter(options))):
            MotionHead(2, **options)
    else:
        assert MotionHead(2, **options).n_timing == 0


def test_modes_have_positive_means_and_unit_power_together():
    head = MotionHead(1, 12).double()
    s = torch.linspace(0, 1, 2001).double()
    y = head.response.evaluate(s)[:, 0, :12] @ _modes(head.response)
    assert (y.mean(0) >= -1e-9).all()
    assert y[:, :3].mean(0).max() > 0.1
    assert y.square().mean(0).sum().item() == pytest.approx(1, rel=1e-2)
    # The mean square of the finest is as small as white forcing makes it.
    assert y[:, -1].square().mean() < 1e-3 * y[:, 0].square().mean()


@pytest.mark.parametrize("noise", [{}, {"noise": 0.05}])
def test_encoded_parameters_are_the_most_likely_ones(head, noise):
    """By Bayes' rule with a unit normal prior, and noise relative to the amplitude."""
    z = random(head.n_parameters)
    start, velocity = random(2, seed=1), random(2, seed=2)
    time = TIME[::4]
    L = head.n_linear
    shown = head(z, time, start, velocity).position + 0.02 * random(len(time), 2, seed=4)
    shown[0] = start

    def path(linear):
        motion = head(torch.cat([linear, z[L:]]), time, start, velocity)
        return (motion.position / head.amplitude).flatten()

    zero = torch.zeros(L).double()
    J = torch.autograd.functional.jacobian(path, zero)
    deviation = noise.get("noise", 1e-4)
    missing = (shown / head.amplitude).flatten() - path(zero)
    normal = J.mT @ J + deviation**2 * torch.eye(L).double()
    expected = torch.linalg.solve(normal, J.mT @ missing)
    found = head.encode(time, shown, velocity, timing=z[L:], **noise)
    torch.testing.assert_close(found[:L], expected, rtol=1e-4, atol=1e-4)
    assert torch.equal(found[L:], z[L:])
    # Of timing that is not given, the parameters are zero.
    assert not head.encode(time, shown, velocity, **noise)[L:].any()
    with pytest.raises(ValueError, match="noise"):
        head.encode(time, shown, noise=0.0)


def test_divergence_is_by_default_of_positions_known_to_a_thousandth(head, factor):
    z, start = random(3, head.n_parameters), torch.zeros(3, 2).double()
    p, q = (head.distribution(z, k * factor, start) for k in (1.0, 1.2))
    time = TIME[::8]
    torch.testing.assert_close(p.kl(q, time), p.kl(q, time, noise=1e-3), rtol=0, atol=0)
    assert (p.kl(q, time) - p.kl(q, time, noise=1.5e-3)).abs().min() > 0


def test_times_of_a_motion_are_those_asked_but_during_its_delay(head):
    z, start = random(3, head.n_parameters), random(3, 2, seed=1)
    motion = head(z, TIME, start)
    expected = torch.maximum(TIME.expand(3, -1), motion.delay[..., None].expand(3, 1))
    torch.testing.assert_close(motion.time, expected)
    assert motion.time.dtype == torch.float64


def test_timing_is_geometric_in_durations_and_linear_in_delays():
    head = MotionHead(2, 6, duration=(0.5, 8.0), delay=0.8).double()
    timing = head.timing([2.0, 1.0, 4.0], [0.4, 0.2, 0.6])
    expected = torch.tensor([[0.5, 0.5], [0.25, 0.25], [0.75, 0.75]]).double().logit()
    torch.testing.assert_close(timing, expected, rtol=1e-6, atol=1e-6)
    # One value for several of the other.
    assert head.timing([2.0, 1.0, 4.0], 0.4).shape == (3, 2)
    late = MotionHead(2, 6, delay=0.8)
    torch.testing.assert_close(late.timing(delay=0.2), torch.tensor([0.25]).logit())


@pytest.mark.parametrize(("before", "refused"), [(0.0, False), (1e-10, False), (1e-8, True)])
def test_a_motion_continues_from_its_time_on(before, refused):
    state = {"z": torch.zeros(22).double(), "start": (0.0, 0.0), "since": 0.5}
    time = torch.tensor([0.5 - before, 0.6], dtype=torch.float64)
    if refused:
        with pytest.raises(ValueError, match="no time may be before it"):
            head_of(2)(state["z"], time, state["start"], since=0.5)
    else:
        assert head_of(2)(state["z"], time, state["start"], since=0.5).position.shape == (2, 2)


def test_samples_of_a_batch_of_factors_have_its_shape(head):
    L, start = head.n_linear, torch.zeros(2).double()
    z = random(head.n_parameters)
    factors = torch.stack([torch.zeros(L, L), torch.eye(L)]).double()
    motions = head.distribution(z, factors, start)
    drawn = motions.rsample((4, 5), torch.Generator().manual_seed(0))
    assert drawn.shape == (4, 5, 2, head.n_parameters)
    assert torch.equal(drawn[:, :, 0], z.expand(4, 5, -1))
    assert (drawn[:, :, 1, :L] != z[:L]).all()
    alone = motions.rsample()
    assert alone.shape == (2, head.n_parameters)
    mean = head.distribution(z, factors[1], start).mean(TIME)
    torch.testing.assert_close(mean.position, head(z, TIME, start).position)


def test_half_precision_of_a_network_is_planned_in_that_of_the_head():
    head = MotionHead(2, 6)
    z = random(14).to(torch.bfloat16)
    made = head(z, [0.0, 0.5, 1.0], [0.1, 0.2])
    assert made.position.dtype == torch.float32
    expected = head(z.float(), [0.0, 0.5, 1.0], [0.1, 0.2])
    torch.testing.assert_close(made.position, expected.position)
