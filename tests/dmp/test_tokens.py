"""Tokens of motions against what encodes, bounds and joins them in other ways."""

from functools import cache
from itertools import pairwise, product

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline

from hrc_learn.dmp.motion_components import spline
from hrc_learn.dmp.samples import check_samples
from hrc_learn.dmp.token_code import Interval, TokenCode
from hrc_learn.dmp.tokens import (
    ActionProcessor,
    MotionTokenizer,
    _levels,
    _rounded,
    _switches,
    _units,
)

TIME = torch.linspace(0, 1, 21, dtype=torch.float64)
VOCABULARY = 64


def motions(count: int, seed: int = 0, columns: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    """Sums of three oscillations, (count, 21, columns), and their start velocities."""
    rng = torch.Generator().manual_seed(seed)
    drawn = torch.rand(3, 3, count, columns, generator=rng, dtype=torch.float64)
    amplitude, phase = drawn[0], 2 * torch.pi * drawn[1]
    rate = torch.tensor([1.0, 3.0, 9.0], dtype=torch.float64)[:, None, None]
    rate = rate * (1 + 0.2 * drawn[2])
    amplitude = amplitude / rate
    angle = rate[..., None] * TIME + phase[..., None]
    position = (amplitude[..., None] * angle.sin()).sum(0).mT
    return position, (amplitude * rate * phase.cos()).sum(0)


@pytest.fixture(scope="module")
def tokenizer() -> MotionTokenizer:
    position, velocity = motions(400)
    return MotionTokenizer.fit(TIME, position, VOCABULARY, start_velocity=velocity)


@pytest.fixture(scope="module")
def gripping() -> tuple[MotionTokenizer, torch.Tensor]:
    """Tokenizer of two columns and a gripper between them, and motions that it has not seen."""
    position, _ = motions(300, columns=2)
    rng = torch.Generator().manual_seed(3)
    at = torch.randint(1, 40, (300, 1), generator=rng)
    opened = torch.rand(300, 1, generator=rng) < 0.5
    gripper = (opened ^ (torch.arange(21) >= at)).double() * 0.08
    whole = torch.stack([position[..., 0], gripper, position[..., 1]], -1)
    return MotionTokenizer.fit(TIME, whole[:250], VOCABULARY, start_known=True), whole[250:]


def limits(position: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    low, high = position.amin((0, 1)), position.amax((0, 1))
    return low - 0.1 * (high - low), high + 0.1 * (high - low)


@pytest.mark.parametrize("order", [0, 1, 2])
def test_splines_equal_scipy(order):
    count, knots = 9, np.concatenate([[0, 0, 0], np.linspace(0, 1, 7), [1, 1, 1]])
    one = BSpline(knots, np.eye(count), 3)
    expected = (one.derivative(order) if order else one)(TIME.numpy())
    assert np.abs(spline(TIME, count, order).numpy() - expected).max() < 1e-11


def test_unseen_motions_decode_to_the_tolerance(tokenizer):
    position, velocity = motions(100, seed=1)
    ids = tokenizer.encode(TIME, position, velocity)
    made = tokenizer.decode(ids, TIME, position[:, 0], velocity)
    seen = motions(400)[0].reshape(-1, 3).numpy()
    scale = torch.from_numpy(np.quantile(seen, 0.99, axis=0) - np.quantile(seen, 0.01, axis=0))
    error = ((made - position) / scale).square().mean().sqrt()
    assert 0.004 < error < 0.013  # 0.01, and some more for motions that were not seen


def test_a_smaller_tolerance_takes_more_tokens():
    position, _ = motions(80)
    counts = []
    for tolerance in (0.05, 0.02, 0.005):
        tokenizer = MotionTokenizer.fit(TIME, position, VOCABULARY, tolerance=tolerance)
        counts.append((tokenizer.encode(TIME, position) != 0).sum().item())
    assert counts[0] < 0.8 * counts[1] < 0.64 * counts[2]


def test_any_tokens_decode_within_the_demonstrated_range(tokenizer):
    position, velocity = motions(400)
    low, high = limits(position)
    rng = torch.Generator().manual_seed(5)
    ids = torch.randint(0, VOCABULARY, (400, 12), generator=rng)
    fine = torch.linspace(0, 1.2, 300, dtype=torch.float64)
    for start, rate in ((None, None), (position[:, 0], None), (position[:, 0], velocity)):
        made = tokenizer.decode(ids, fine, start, rate)
        assert made.isfinite().all()
        assert ((made >= low) & (made <= high)).all()


def test_tokens_are_the_same_in_any_unit(tokenizer):
    """Of each column, and of time; what they decode to is in the units of the motions."""
    position, velocity = motions(400)
    unit = torch.tensor([1000.0, 1.0, 1e-3], dtype=torch.float64)
    other = MotionTokenizer.fit(
        2 * TIME, unit * position, VOCABULARY, start_velocity=unit * velocity / 2
    )
    ids = tokenizer.encode(TIME, position[:40], velocity[:40])
    found = other.encode(2 * TIME, unit * position[:40], unit * velocity[:40] / 2)
    # A parameter at the middle between two levels may be rounded to either.
    assert (found == ids).double().mean() > 0.99
    rng = torch.Generator().manual_seed(6)
    drawn = torch.randint(0, VOCABULARY, (60, 12), generator=rng)
    made = tokenizer.decode(drawn, TIME)
    torch.testing.assert_close(other.decode(drawn, 2 * TIME) / unit, made, rtol=0, atol=1e-6)
    for own, scaled, limit in zip(
        (tokenizer.components.low, tokenizer.components.high),
        (other.components.low, other.components.high),
        limits(position),
        strict=True,
    ):
        torch.testing.assert_close(own, limit)
        torch.testing.assert_close(scaled, unit * limit)


def test_a_start_beyond_the_range_moves_the_limit(tokenizer):
    low, high = limits(motions(400)[0])
    start = high + 1.0
    made = tokenizer.decode([[5, 9, 33]], TIME, start)
    assert (made[0, 0] - start).abs().max() < 1e-12
    assert (made <= start + (high - low) / 10).all()


@pytest.mark.parametrize("off", [-3.0, 0.0, 3.0])
def test_control_points_reach_the_limits_or_a_tenth_beyond_the_start(tokenizer, off):
    """Whatever the parameters; a start out of the range moves the limit on its side."""
    parts = tokenizer.components
    span = (parts.high - parts.low) / 1.2
    start = parts.start + off * span
    rng = torch.Generator().manual_seed(0)
    z = 1e6 * torch.randn(200, len(parts.spread), generator=rng).double()
    points, _ = parts.polygon(z, start, torch.zeros(3))
    free = (points * parts.scale + parts.centre)[:, 2:].flatten(0, 1)
    low, high = (
        torch.minimum(parts.low, start - span / 10),
        torch.maximum(parts.high, start + span / 10),
    )
    torch.testing.assert_close(free.amin(0), low)
    torch.testing.assert_close(free.amax(0), high)


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("beyond", [0.5, 2.5, 40.0])
def test_a_velocity_out_of_the_range_turns_back_behind_its_limit(tokenizer, side, beyond):
    """The third control point is six times as far inside as the second is outside, which keeps
    motions within up to 2.5 times the margin."""
    parts = tokenizer.components
    limit = parts.high if side > 0 else parts.low
    margin = (parts.high - parts.low) / 12
    start = limit - side * margin
    # The second control point is a third of a knot's spacing along the velocity.
    rate = side * (beyond + 1) * margin * 3 * (parts.points - 3) / parts.duration
    rng = torch.Generator().manual_seed(0)
    z = 1e6 * torch.randn(40, len(parts.spread), generator=rng).double()
    points, _ = parts.polygon(z, start, rate)
    second, third = (points * parts.scale + parts.centre)[:, 1:3].unbind(1)
    torch.testing.assert_close(second, (limit + side * beyond * margin).expand(40, 3))
    inside = side * (limit - third) / margin
    expected = torch.full((3,), min(6 * beyond, 12.0)).double()
    torch.testing.assert_close(inside.amin(0), expected, rtol=1e-6, atol=1e-6)
    assert (inside <= 12 + 1e-6).all()
    if beyond <= 2.5:
        made = parts(z, torch.linspace(0, 1, 200).double(), start, rate)
        assert (side * (made - limit) <= 1e-9 * margin).all()


def test_motions_continue_what_is_executed(tokenizer):
    position, velocity = motions(50, seed=2)
    rng = torch.Generator().manual_seed(6)
    ids = torch.randint(0, VOCABULARY, (50, 9), generator=rng)
    # Another motion takes over at 0.37 s.
    now = torch.tensor([0.37], dtype=torch.float64)
    at, rate = (
        tokenizer.decode(ids, now, position[:, 0], velocity, order=order)[:, 0]
        for order in (0, 1)
    )
    zero = torch.zeros(1, dtype=torch.float64)
    following = ids.flip(0)
    for order, state in ((0, at), (1, rate)):
        made = tokenizer.decode(following, zero, at, rate, order=order)[:, 0]
        assert (made - state).abs().max() < 1e-12


def test_derivatives_are_those_of_the_motion(tokenizer):
    position, velocity = motions(5, seed=4)
    ids = tokenizer.encode(TIME, position, velocity)
    h = 1e-5
    for order in (0, 1):
        a, b = (
            tokenizer.decode(ids, TIME[1:-1] + x, position[:, 0], velocity, order=order)
            for x in (-h, h)
        )
        exact = tokenizer.decode(ids, TIME[1:-1], position[:, 0], velocity, order=order + 1)
        # Differences of a second derivative with kinks are accurate to the step.
        assert torch.allclose((b - a) / (2 * h), exact, atol=1e-3)


def test_prefixes_decode_to_coarser_motions(tokenizer):
    position, velocity = motions(100, seed=1)
    errors = []
    for length in (0, 1, 2, 4, 8):
        ids = tokenizer.encode(TIME, position, velocity, length=length)
        assert ids.shape == (100, length)
        made = tokenizer.decode(ids, TIME, position[:, 0], velocity)
        errors.append((made - position).square().mean().item())
    assert all(fine < coarse for coarse, fine in pairwise(errors))
    assert errors[-1] < 0.01 * errors[0]


def test_a_motion_decodes_at_any_rate(tokenizer):
    position, velocity = motions(10, seed=1)
    ids = tokenizer.encode(TIME, position, velocity)
    fine = torch.linspace(0, 1, 201, dtype=torch.float64)
    state = position[:, 0], velocity
    assert torch.allclose(
        tokenizer.decode(ids, fine, *state)[:, ::10], tokenizer.decode(ids, TIME, *state)
    )
    late = torch.tensor([1.0, 5.0], dtype=torch.float64)
    rest = tokenizer.decode(ids, late, *state)
    assert torch.equal(rest[:, 0], rest[:, 1])
    assert (tokenizer.decode(ids, late, *state, order=1)[:, 1] == 0).all()


def test_grippers_switch_without_ramps(gripping):
    tokenizer, position = gripping
    assert tokenizer.steps == [1]
    ids = tokenizer.encode(TIME, position)
    made = tokenizer.decode(ids, TIME, position[:, 0])
    assert torch.equal(made[..., 1], position[..., 1])
    fine = torch.linspace(0, 1, 1001, dtype=torch.float64)
    levels = tokenizer.decode(ids, fine, position[:, 0])[..., 1].unique()
    assert set(levels.tolist()) <= {0.0, 0.08}
    assert (tokenizer.decode(ids, TIME, position[:, 0], order=1)[..., 1] == 0).all()


def test_grippers_that_mostly_start_closed_are_restored_from_unknown_starts():
    """Most chunks start closed; the others close at any time."""
    position, _ = motions(300, columns=2)
    at = torch.randint(-30, 20, (300, 1), generator=torch.Generator().manual_seed(4))
    gripper = 2 * (torch.arange(21) >= at).double() - 1
    whole = torch.stack([position[..., 0], gripper, position[..., 1]], -1)
    tokenizer = MotionTokenizer.fit(TIME, whole, VOCABULARY, start_known=False)
    made = tokenizer.decode(tokenizer.encode(TIME, whole), TIME)
    assert torch.equal(made[..., 1], gripper)


def test_any_tokens_leave_grippers_on_their_levels(gripping):
    tokenizer, position = gripping
    rng = torch.Generator().manual_seed(5)
    ids = torch.randint(0, VOCABULARY, (50, 10), generator=rng)
    made = tokenizer.decode(ids, TIME, position[:, 0])
    assert set(made[..., 1].unique().tolist()) <= {0.0, 0.08}


def test_durations_are_encoded():
    position, _ = motions(100)
    duration = torch.linspace(0.7, 1.4, 100, dtype=torch.float64)[torch.randperm(100)]
    time = list(TIME * duration[:, None])
    tokenizer = MotionTokenizer.fit(time, list(position), VOCABULARY)
    ids = tokenizer.encode(torch.stack(time), position)
    made = tokenizer.decode(ids, torch.stack(time), position[:, 0])
    assert (made - position).square().mean().sqrt() < 0.03
    # Without its last sample, the same motion is cut, not stretched.
    short = tokenizer.decode(ids, torch.stack(time)[:, :-5], position[:, 0])
    assert torch.allclose(short, made[:, :-5])


def test_starts_are_encoded_on_demand():
    position, _ = motions(300)
    tokenizer = MotionTokenizer.fit(TIME, position, VOCABULARY, start_known=False)
    unseen = motions(50, seed=1)[0]
    ids = tokenizer.encode(TIME, unseen)
    assert (tokenizer.decode(ids, TIME) - unseen).square().mean().sqrt() < 0.03
    start = unseen[:, 0] + 0.1
    joined = tokenizer.decode(ids, TIME, start, torch.zeros(50, 3))
    assert (joined[:, 0] - start).abs().max() < 1e-12


def test_parameters_restore_motions_and_have_gradients(tokenizer):
    position, velocity = motions(20, seed=1)
    z = tokenizer.parameters(TIME, position, velocity).requires_grad_()
    made = tokenizer.components(z, TIME, position[:, 0], velocity)
    assert (made - position).abs().max() < 0.01
    assert z.detach().std(0)[:3].sub(1).abs().max() < 0.5  # of unit variance
    (gradient,) = torch.autograd.grad(made.sum(), z)
    assert gradient.abs().sum() > 0


def test_saved_tokenizers_decode_alike(gripping, tmp_path):
    tokenizer, position = gripping
    tokenizer.save(tmp_path / "tokens")
    loaded = MotionTokenizer.load(tmp_path / "tokens")
    ids = loaded.encode(TIME, position)
    assert torch.equal(ids, tokenizer.encode(TIME, position))
    made = tokenizer.decode(ids, TIME, position[:, 0])
    assert torch.equal(loaded.decode(ids, TIME, position[:, 0]), made)
    config = tmp_path / "tokens" / "config.json"
    config.write_text(
        config.read_text().replace('"components": {', '"components": {}, "old": {')
    )
    (config.parent / ".manifest.json").unlink()
    with pytest.raises(ValueError, match=r"not a complete tokenizer \(.*fit it again"):
        MotionTokenizer.load(config.parent)


def test_batches_equal_single_motions(gripping):
    tokenizer, position = gripping
    ids = tokenizer.encode(TIME, position[:6].reshape(2, 3, 21, 3))
    made = tokenizer.decode(ids, TIME, position[:6, 0].reshape(2, 3, 3))
    for i in range(6):
        one = tokenizer.encode(TIME, position[i])
        whole = ids.reshape(6, -1)[i]
        assert one.tolist() == whole[: len(one)].tolist()
        assert (whole[len(one) :] == 0).all()
        alone = tokenizer.decode(one, TIME, position[i, 0])
        assert torch.allclose(alone, made.reshape(6, 21, 3)[i], atol=1e-12)


def test_tokens_after_the_end_change_nothing(tokenizer):
    position, velocity = motions(1, seed=1)
    ids = tokenizer.encode(TIME, position, velocity)[0].tolist()
    assert tokenizer.length(ids) == len(ids)
    assert tokenizer.length(ids[:1]) == 2
    made = tokenizer.decode([[*ids, 0, 7, 8], ids], TIME, position[0, 0], velocity[0])
    assert torch.allclose(made[0], made[1], atol=1e-12)


@pytest.mark.parametrize(
    ("ids", "words"), [([3, 64], "token 64 is not in 0 to 63"), ([-1], "token -1")]
)
def test_tokens_beyond_the_vocabulary_are_refused(tokenizer, ids, words):
    with pytest.raises(ValueError, match=words):
        tokenizer.decode(ids, TIME)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"vocabulary_size": 8}, "vocabulary_size must be 16 to 32768, got 8"),
        ({"tolerance": 0.0}, "tolerance must lie between 0 and 1"),
        ({"motions": motions(1)[0]}, "N of 2 or more"),
        ({"motions": motions(3)[0] * torch.nan}, "motions"),
        ({"time": TIME.flip(0)}, "time"),
        ({"steps": [0]}, "steps must be columns of 4 values or fewer"),
        ({"start_velocity": torch.zeros(3, 2)}, "start_velocity must have shape"),
    ],
)
def test_bad_arguments_of_a_fit_are_named(change, words):
    with pytest.raises(ValueError, match=words):
        MotionTokenizer.fit(**{"time": TIME, "motions": motions(3)[0], **change})


def test_another_number_of_columns_is_refused(tokenizer):
    with pytest.raises(ValueError, match="motion must have 3 columns, got 2"):
        tokenizer.encode(TIME, motions(2, columns=2)[0])


@pytest.fixture(scope="module")
def processor() -> ActionProcessor:
    return ActionProcessor.fit(list(motions(300)[0].numpy()), vocab_size=VOCABULARY)


def test_processors_keep_fasts_interface(processor, tmp_path):
    chunks = motions(20, seed=1)[0].numpy()
    tokens = processor(chunks)
    assert [type(i) for row in tokens for i in row] == [int] * sum(map(len, tokens))
    made = processor.decode(tokens, time_horizon=21, action_dim=3)
    assert made.shape == chunks.shape
    assert np.sqrt(np.mean((made - chunks) ** 2)) < 0.03
    assert processor(chunks[0]) == tokens[:1]
    processor.save_pretrained(tmp_path / "processor")
    loaded = ActionProcessor.from_pretrained(tmp_path / "processor")
    assert (loaded.vocab_size, loaded.time_horizon, loaded.action_dim) == (VOCABULARY, 21, 3)
    assert np.array_equal(loaded.decode(tokens), made)
    assert processor.decode([]).shape == (0, 21, 3)
    assert processor(chunks[:0]) == []


def test_a_processor_has_the_accuracy_of_fasts_scale():
    """Tolerance 0.07 / scale, with encoded starts and time in frames; 1024 tokens."""
    chunks = motions(60)[0].numpy()
    for options, scale, vocabulary in (({}, 10, 1024), ({"scale": 2.0}, 2, 1024)):
        made = ActionProcessor.fit(list(chunks), **options)
        expected = MotionTokenizer.fit(
            np.arange(21), chunks, vocabulary, start_known=False, tolerance=0.07 / scale
        )
        assert made.vocab_size == vocabulary
        assert made.tokenizer.config == expected.config
        assert made.tokenizer.components.known == 0
    tokens = made(chunks[:2])
    assert [row[: made.tokenizer.length(row)] for row in tokens] == tokens
    assert made.decode(tokens).shape == (2, 21, 3)
    assert made.decode(tokens, time_horizon=7).shape == (2, 7, 3)
    np.testing.assert_allclose(made.decode(tokens, time_horizon=7), made.decode(tokens)[:, :7])


@pytest.mark.parametrize("scale", [0.0, -1.0, 0.07, np.nan, np.inf])
def test_a_scale_without_a_tolerance_is_refused_by_its_name(scale):
    chunks = list(motions(60)[0].numpy())
    with pytest.raises(ValueError, match=f"scale must be above 0.07 and finite, got {scale}"):
        ActionProcessor.fit(chunks, scale=scale)


@pytest.mark.slow
def test_lerobot_measures_a_processor(processor):
    from lerobot.scripts.lerobot_train_tokenizer import compute_compression_stats

    chunks = motions(50, seed=1)[0].numpy()
    statistics = compute_compression_stats(processor, chunks)
    counts = [len(row) for row in processor(chunks)]
    assert statistics["mean_token_length"] == pytest.approx(np.mean(counts))
    assert statistics["compression_ratio"] > 3


def test_units_of_columns_are_quantiles_and_limits_a_tenth_beyond():
    rng = np.random.default_rng(0)
    seen = rng.normal(size=(500, 4)) * (1.0, 30.0, 0.0, 0.0) + (0.0, 5.0, 2.0, 0.0)
    seen[0, 3] = 4.0  # within its quantiles it never moves
    found = {name: value.numpy() for name, value in _units(seen).items()}
    bottom, top = np.quantile(seen, 0.01, axis=0), np.quantile(seen, 0.99, axis=0)
    np.testing.assert_allclose(found["centre"], (bottom + top) / 2)
    np.testing.assert_allclose(found["scale"], [*(top - bottom)[:2], 1.0, 4.0])
    low, high = seen.min(0), seen.max(0)
    np.testing.assert_allclose(found["low"], low - 0.1 * (high - low))
    np.testing.assert_allclose(found["high"], high + 0.1 * (high - low))
    # Rounding never leads beyond the tenth.
    assert (found["low"] >= low - 0.1 * (high - low)).all()
    assert (found["high"] <= high + 0.1 * (high - low)).all()


def test_columns_of_two_to_four_values_are_steps():
    values = [[0], [1, 2], [1, 2, 3, 4], [1, 2, 3, 4, 5]]
    seen = np.stack([np.resize(v, 40)[::-1] for v in values], 1).astype(float)
    chosen, levels = _levels(seen, None)
    assert chosen == [1, 2]
    assert levels.tolist() == [[1, 2, 2, 2], [1, 2, 3, 4]]
    chosen, levels = _levels(seen, [1, 0, 1])
    assert chosen == [0, 1]
    assert levels.tolist() == [[0, 0], [1, 2]]
    chosen, levels = _levels(seen, [])
    assert (chosen, levels.shape) == ([], (0, 1))
    with pytest.raises(ValueError, match="steps must be columns of 4 values or fewer"):
        _levels(seen, [3])


def test_switches_are_slots_with_the_sign_of_their_direction():
    """Slot k is (k - 1) / slots of the duration; of a jump over two values there are two."""
    time = torch.linspace(0, 2, 11).double()
    first = [0, 0, 1, 1, 2, 0, 0, 0, 0, 0, 0]
    second = [5, 0, 5, 0, 5, 0, 5, 0, 5, 0, 5]
    smooth = list(range(11))
    motion = torch.tensor([first, smooth, second]).double().T[None]
    levels = torch.tensor([[0.0, 1.0, 2.0], [0.0, 5.0, 5.0]]).double()
    samples = check_samples(time, motion)
    start = torch.tensor([[0.0, 0.0]]).double()
    found = _switches(samples, start, [0, 2], levels, 10)
    assert found.tolist() == [[3, 5, -6, -6, 1, -2, 3, -4]]
    # Twice as many slots, and a start at another value.
    start = torch.tensor([[1.0, 5.0]]).double()
    found = _switches(samples, start, [0, 2], levels, 20)
    assert found.tolist() == [[-1, 5, 9, -11, -3, 5, -7, 9]]
    # Samples that do not count switch nothing.
    mask = torch.ones(1, 11).bool()
    mask[0, 2:5] = False
    samples = check_samples(time, motion, mask=mask)
    found = _switches(samples, torch.tensor([[0.0, 5.0]]).double(), [0, 2], levels, 10)
    assert found.tolist()[0][0] == -6


def test_numbers_are_rounded_to_the_least_error_and_price():
    """Of zero and both neighbours, never above the largest magnitude."""
    rng = np.random.default_rng(0)
    table = np.array([[0.5, 0.3, 0.1, 0.1, 0.0], [0.97, 0.01, 0.01, 0.005, 0.005]])
    bits = TokenCode(16, table).bits()
    x = rng.uniform(-5, 5, (300, 2))
    x[:2] = [[0.0, 0.0], [3.0, -4.0]]
    found = _rounded(torch.from_numpy(x), bits).numpy()
    price = (np.log(4) / 12) * bits.numpy()
    for value, result in zip(x, found, strict=True):
        for k, largest in enumerate((3, 4)):
            size = abs(value[k])
            choices = {min(m, largest) for m in (0, int(np.floor(size)), int(np.ceil(size)))}
            cost = {m: (m - size) ** 2 + price[k, m] for m in choices}
            assert cost[abs(int(result[k]))] == pytest.approx(min(cost.values()), abs=1e-3)
            assert result[k] * value[k] >= 0
    assert (np.abs(found) > 0).any(0).all()
    whole = _rounded(torch.from_numpy(x), None)
    np.testing.assert_array_equal(whole, np.round(x))


@pytest.fixture(scope="module")
def stepping() -> tuple[MotionTokenizer, torch.Tensor]:
    """Tokenizer of a column, and of two of steps: of three values and of two."""
    position, _ = motions(120, columns=1)
    rng = torch.Generator().manual_seed(1)
    at = torch.randint(1, 21, (120, 2), generator=rng).sort(1).values
    frames = torch.arange(21)
    up = (frames >= at[:, :1]).double() + (frames >= at[:, 1:])
    whole = torch.stack([up - 1, position[..., 0], 0.5 * (frames < at[:, 1:])], -1)
    return MotionTokenizer.fit(TIME, whole, VOCABULARY), whole


def test_steps_of_several_values_are_restored(stepping):
    tokenizer, whole = stepping
    assert tokenizer.steps == [0, 2]
    assert tokenizer.levels.tolist() == [[-1, 0, 1], [0, 0.5, 0.5]]
    assert tokenizer.config["slots"] == 20
    ids = tokenizer.encode(TIME, whole)
    made = tokenizer.decode(ids, TIME, whole[:, 0])
    assert torch.equal(made[..., [0, 2]], whole[..., [0, 2]])
    # A switch is at its time, not before.
    for shift, same in ((-1e-6, False), (1e-6, True)):
        times = TIME[1:-1] + shift
        late = tokenizer.decode(ids, times, whole[:, 0])[..., [0, 2]]
        expected = whole[:, 1:-1] if same else whole[:, :-2]
        assert torch.equal(late, expected[..., [0, 2]])
    # From another start each value is as many steps further.
    lower = whole[:, 0].clone()
    lower[:, 0], lower[:, 2] = -1.0, 0.0
    made = tokenizer.decode(ids, TIME, lower)[..., 0]
    switched = (whole[..., 0] - whole[:, :1, 0]).clamp(max=2)
    assert torch.equal(made, switched - 1)
    # By default the first value, and zero in every derivative.
    made = tokenizer.decode([[]], TIME)
    assert (made[..., 0] == -1).all()
    assert (made[..., 2] == 0).all()
    for order in (1, 2):
        rates = tokenizer.decode(ids, TIME, whole[:, 0], order=order)
        assert not rates[..., [0, 2]].any()
        assert rates[..., 1].any()


def test_a_start_between_two_values_stays_until_a_switch(stepping):
    tokenizer, whole = stepping
    start = torch.tensor([-0.8, 0.0, 0.4], dtype=torch.float64)
    made = tokenizer.decode([[]], TIME, start)
    torch.testing.assert_close(made[0, :, [0, 2]], start[[0, 2]].expand(21, -1))
    ids = tokenizer.encode(TIME, whole[:1])
    made = tokenizer.decode(ids, TIME, start)[0, :, 0]
    switched = whole[0, :, 0] > whole[0, 0, 0]
    assert switched.any()
    assert (made[~switched] == -0.8).all()
    assert torch.equal(made[switched], (whole[0, :, 0] - whole[0, 0, 0])[switched] - 1)


@pytest.mark.parametrize(("frames", "slots"), [(64, 63), (65, 64), (66, 64)])
def test_there_are_64_slots_at_most(frames, slots):
    time = torch.linspace(0, 1, frames).double()
    gripper = (time > torch.tensor([[0.3], [0.5], [0.7]])).double()
    whole = torch.stack([time.sin().expand(3, -1) + gripper / 9, gripper], -1)
    assert MotionTokenizer.fit(time, whole, 16).config["slots"] == slots


@pytest.mark.parametrize(
    ("change", "refused"),
    [
        ({"vocabulary_size": 16}, False),
        ({"vocabulary_size": 15}, True),
        ({"vocabulary_size": 32768}, False),
        ({"vocabulary_size": 32769}, True),
        ({"tolerance": 0.999}, False),
        ({"tolerance": 1.0}, True),
    ],
)
def test_limits_of_arguments_are_those_of_the_message(change, refused):
    arguments = {"time": TIME, "motions": motions(2)[0]} | change
    if refused:
        with pytest.raises(ValueError, match=next(iter(change))):
            MotionTokenizer.fit(**arguments)
    else:
        made = MotionTokenizer.fit(**arguments)
        assert made.vocabulary_size == change.get("vocabulary_size", 1024)


@pytest.mark.parametrize("columns", [1, 4])
def test_the_tolerance_is_the_error_of_each_column(columns):
    position, _ = motions(120, columns=columns)
    tokenizer = MotionTokenizer.fit(TIME, position, VOCABULARY, tolerance=0.02)
    made = tokenizer.decode(tokenizer.encode(TIME, position), TIME, position[:, 0])
    seen = position.reshape(-1, columns)
    scale = seen.quantile(0.99, dim=0) - seen.quantile(0.01, dim=0)
    error = ((made - position) / scale).square().mean().sqrt().item()
    assert 0.017 < error < 0.023


class TestCode:
    """The code of integers alone."""

    @staticmethod
    @cache
    def code(vocabulary: int = 32) -> tuple[TokenCode, np.ndarray]:
        rng = np.random.default_rng(0)
        scale = 6.0 * 0.8 ** np.arange(30)
        values = np.round(rng.laplace(scale=scale, size=(500, 30))).astype(int)
        return TokenCode.fit(values, vocabulary), values

    @pytest.mark.parametrize("vocabulary", [16, 32, 256])
    def test_vectors_are_restored(self, vocabulary):
        code, values = self.code(vocabulary)
        for row in values[:30]:
            found, complete = code.decode(code.encode(row.tolist()))
            assert complete
            restored = np.zeros(30, int)
            for index, sign, low, high in found:
                assert low == high
                restored[index] = sign * low
            assert (restored == row).all()

    def test_tokens_carry_nearly_the_most_information(self):
        code, values = self.code(256)
        bits = np.mean([8 * len(code.encode(row.tolist())) for row in values[:150]])
        entropy = sum(
            -(p * np.log2(p)).sum()
            for k in range(30)
            for p in [np.unique(values[:, k], return_counts=True)[1] / len(values)]
        )
        assert entropy < bits < 1.15 * entropy + 10

    def test_first_tokens_are_about_equally_frequent(self):
        code, values = self.code(32)
        firsts = [code.encode(row.tolist())[0] for row in values]
        counts = np.bincount(firsts, minlength=32)[1:]
        assert counts.max() < 2.5 * len(values) / 31
        assert (counts > 0).all()

    def test_one_token_ends_zeros(self):
        code, _ = self.code(16)
        assert len(code.encode([0] * 30)) == 1
        assert code.encode([3] + [0] * 29)[-1] == 0

    def test_equally_likely_values_take_about_equally_many_tokens(self):
        """Questions halve what is left: 127 values are told apart by two or three of 15."""
        code = TokenCode(16, np.full((1, 64), 1 / 64))
        assert max(len(code.encode([value])) for value in range(-63, 64)) <= 3

    def test_tables_are_counts_and_a_laplace_distribution(self):
        """Of 20 vectors, with the mean magnitude and 0.02, up to twice the largest one."""
        values = np.array([[0, 3, 0], [-1, 0, 0], [2, -3, 0], [0, 1, 0], [-2, 2, 0]])
        table = TokenCode.fit(values, 16).table
        for k, largest in enumerate((4, 6, 2)):
            size = np.abs(values[:, k])
            laplace = np.exp(-np.arange(7) / (size.mean() + 0.02)) + 1e-12
            laplace[largest + 1 :] = 0
            expected = 20 * laplace / laplace.sum() + [(size == m).sum() for m in range(7)]
            np.testing.assert_allclose(table[k], expected / expected.sum())
        assert TokenCode.fit(np.zeros((4, 0), int), 16).size == 0

    def test_bits_are_those_of_a_magnitude_and_its_sign(self):
        table = np.array([[0.5, 0.25, 0.25], [0.75, 0.25, 0.0]])
        bits = TokenCode(16, table).bits()
        assert bits.tolist() == [[1, 3, 3], [-np.log2(0.75), 3, np.inf]]

    TABLE = np.array([[0.4, 0.3, 0.2, 0.1], [0.7, 0.3, 0.0, 0.0], [0.25, 0.25, 0.25, 0.25]])

    @pytest.mark.parametrize("vocabulary", [16, 20, 64, 500])
    def test_every_vector_is_restored_from_tokens_of_its_own(self, vocabulary):
        code = TokenCode(vocabulary, self.TABLE)
        ranges = [range(-m, m + 1) for m in (3, 1, 3)]
        seen = set()
        for vector in product(*ranges):
            ids = code.encode(vector)
            assert all(0 <= i < vocabulary for i in ids)
            seen.add(tuple(ids))
            # Tokens after the end, or after a whole vector, change nothing.
            for more in ([], [0, 3], [7]) if ids[-1] == 0 or code.decode(ids)[1] else ([],):
                found, complete = code.decode(ids + more)
                assert complete
                restored = [0, 0, 0]
                for index, sign, low, high in found:
                    assert low == high
                    restored[index] = sign * low
                assert tuple(restored) == vector
        assert len(seen) == 7 * 3 * 7
        assert code.encode([9, -9, 9]) == code.encode([3, -1, 3])

    def test_a_prefix_is_what_is_known_so_far(self):
        code, values = self.code(16)
        for row in values[:20].tolist():
            ids = code.encode(row)
            for k in range(len(ids)):
                found, complete = code.decode(ids[:k])
                assert not complete
                for index, sign, low, high in found:
                    assert sign * row[index] > 0
                    assert low <= abs(row[index]) <= high
                assert [f.index for f in found] == sorted({f.index for f in found})
        assert code.decode([]) == ([], False)

    @pytest.mark.parametrize("vocabulary", [16, 64])
    def test_trees_split_the_most_probable_leaf(self, vocabulary):
        """Tunstall's code: no leaf is more probable than a node that was split."""
        code, _ = self.code(vocabulary)
        roots = [
            Interval(0, 0, 0, code._largest[0]),
            Interval(3, -1, 2, code._largest[3]),
            Interval(5, 0, 1, 3),
        ]
        for root in roots:
            tree = code._tree(root)
            assert len(tree.after) == len(tree.decided) == vocabulary - 1
            leaves = []
            for after, decided in zip(tree.after, tree.decided, strict=True):
                known = {part.index: part for part in (*decided, after)}
                probability = 1.0
                for k in range(root.index, after.index + 1):
                    if k == code.size:
                        break
                    part = known.get(k, Interval(k, 0, 0, 0))
                    chance = code.table[k, part.low : part.high + 1].sum()
                    probability *= chance / 2 if part.sign else chance
                whole = code.table[root.index, root.low : root.high + 1].sum()
                leaves.append(probability / (whole / 2 if root.sign else whole))
            assert sum(leaves) == pytest.approx(1)
            splits = []

            def total(node, tree=tree, leaves=leaves, splits=splits):
                if node < 0:
                    return leaves[-1 - node]
                found = sum(total(tree.branches[2 * node + i]) for i in (0, 1))
                splits.append(found)
                return found

            assert total(0) == pytest.approx(1)
            assert len(splits) == vocabulary - 2
            assert max(leaves) <= min(splits) * (1 + 1e-9)
            # Leaves are numbered in the order of the questions.
            met = [-1 - node for node in tree.branches if node < 0]
            assert met == sorted(met)

    def test_a_question_halves_what_is_left_as_nearly_as_it_can(self):
        code = TokenCode(16, np.array([[0.1, 0.2, 0.05, 0.3, 0.25, 0.1]]))
        for low, high in ((0, 5), (1, 5), (1, 4), (2, 5), (2, 3), (3, 4), (4, 5)):
            for sign in (1, -1) if low else (0,):
                threshold, probability, first, second = code._split(
                    Interval(0, sign, low, high)
                )
                row = code.table[0]
                total = row[low : high + 1].sum()
                if low:
                    # The first magnitude up to which more than a half lies.
                    below = [row[low : t + 1].sum() / total for t in range(low, high)]
                    more = [t for t, p in enumerate(below, low) if p > 0.5]
                    assert threshold == min(more, default=high - 1)
                else:
                    assert threshold == 0  # the first question is whether it is zero
                expected = row[low : threshold + 1].sum() / total
                assert probability == pytest.approx(expected)
                assert (first, second) == (
                    Interval(0, sign, low, threshold),
                    Interval(0, sign, threshold + 1, high),
                )
        assert code._split(Interval(0, 0, 1, 5)) == (
            -1,
            0.5,
            Interval(0, 1, 1, 5),
            Interval(0, -1, 1, 5),
        )


def test_batches_of_any_shape_are_learned_and_no_sequences_decode_to_no_motions(tokenizer):
    time, (y, _) = TIME, motions(12)
    flat, nested = (MotionTokenizer.fit(time, x) for x in (y, y.unflatten(0, (3, 4))))
    assert nested.columns == flat.columns == 3
    torch.testing.assert_close(nested.components.start, flat.components.start)
    assert flat.encode(time, y).tolist() == nested.encode(time, y).tolist()
    none = tokenizer.decode(np.zeros((0, 4), int), time)
    assert none.shape == (0, len(time), 3)
    # Like a tokenizer of words: an empty list is one sequence, the motion of no components.
    torch.testing.assert_close(tokenizer.decode([], time), tokenizer.decode([0], time))


def test_sequences_of_different_length_may_be_tensors_or_arrays(tokenizer):
    rows = [[3, 5, 7], [9]]
    expected = tokenizer.decode(rows, TIME)
    for kind in (torch.tensor, np.array):
        torch.testing.assert_close(tokenizer.decode([kind(r) for r in rows], TIME), expected)
    torch.testing.assert_close(tokenizer.decode([[[9]], [[0]]], TIME)[0, 0], expected[1])
    torch.testing.assert_close(tokenizer.decode(9, TIME), expected[1])  # as in transformers


@pytest.mark.parametrize("order", [-1, 3])
def test_orders_beyond_acceleration_are_refused(tokenizer, order):
    with pytest.raises(ValueError, match=f"order must be 0, 1 or 2, got {order}"):
        tokenizer.decode([1, 2], TIME, order=order)


def test_a_negative_length_is_refused_and_one_velocity_starts_all_motions(tokenizer):
    y = motions(12)[0]
    with pytest.raises(ValueError, match="length must not be negative, got -1"):
        tokenizer.encode(TIME, y, length=-1)
    one, all_ = (
        MotionTokenizer.fit(TIME, y, start_velocity=velocity)
        for velocity in (np.ones(3), np.ones((12, 3)))
    )
    torch.testing.assert_close(one.components.prediction, all_.components.prediction)
    with pytest.raises(ValueError, match=r"start_velocity has shape \(5, 3\), .* be \(12, 3\)"):
        MotionTokenizer.fit(TIME, y, start_velocity=np.ones((5, 3)))
