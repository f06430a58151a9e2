"""Numbers that are none, and precisions that are not enough: refused, or right."""

import math

import numpy as np
import pytest
import torch
from demo_motions import arm_motion, turning_motion
from unchecked import shapes_unchecked

from hrc_learn.dmp import (
    Frames,
    JointDMP,
    MotionHead,
    MovingGoalDMP,
    OrientationDMP,
    PoseDMP,
    ProbabilisticDMP,
    Stepper,
    fit_rhythmic_orientation,
    fit_shared,
    learn,
)
from hrc_learn.geometry import Pose, quaternion

TIME, POSITION = arm_motion(n_joints=3)
BAD = [math.nan, math.inf, -math.inf]
NOT_REAL = [
    torch.zeros(3, dtype=torch.complex64),
    torch.zeros(3, dtype=torch.bool),
    np.zeros(3, complex),
    np.array(["a", "b", "c"]),
    np.zeros(3, object),
]


@pytest.fixture(scope="module", params=["single", "batch", "orientation"])
def dmp(request):
    if request.param == "orientation":
        return OrientationDMP.fit(*turning_motion(), 8)
    position = POSITION if request.param == "single" else torch.stack([POSITION] * 2)
    return JointDMP.fit(TIME, position, 8)


@shapes_unchecked()
@pytest.mark.parametrize("bad", BAD)
def test_numbers_that_are_not_finite_are_refused_by_steps_and_rollouts(dmp, bad):
    state = dmp.initial_state()
    goal = torch.full_like(dmp.goal, bad)
    push = torch.full((3,), bad, dtype=torch.float64)
    for use in (
        lambda: dmp.step(state, 0.01, goal=goal),
        lambda: dmp.step(state, 0.01, coupling=push),
        lambda: dmp.step(state, bad),
        lambda: dmp.step(state, torch.tensor(bad)),
        lambda: dmp.step(state, 0.01, phase_stopping=bad),
        lambda: dmp.step(state, 0.01, forcing_gain=bad),
        lambda: dmp.step(state, 0.01, goal=dmp.goal, goal_filter=bad),
        lambda: dmp.retarget(state, goal),
        lambda: dmp.rollout(start=goal),
        lambda: dmp.rollout(goal=goal),
        lambda: dmp.rollout(start_velocity=push),
        lambda: dmp.rollout(forcing_gain=bad),
        lambda: dmp.rollout(duration=bad),
        lambda: dmp.rollout(time=[0.0, bad]),
    ):
        with pytest.raises(ValueError, match=r"finite|positive|unit"):
            use()


@shapes_unchecked()
@pytest.mark.parametrize("back", [-0.5, torch.tensor(-0.5)])
def test_time_never_runs_backwards(dmp, back):
    state = dmp.initial_state()
    with pytest.raises(ValueError, match="dt must be finite and not negative"):
        dmp.step(state, back)
    with pytest.raises(ValueError, match="phase_stopping must be finite and not negative"):
        dmp.step(state, 0.1, phase_stopping=back)


@shapes_unchecked()
@pytest.mark.parametrize("values", NOT_REAL, ids=lambda x: str(x.dtype))
def test_only_real_numbers_are_numbers(values):
    dmp = JointDMP.fit(TIME, POSITION, 8)
    state, head = dmp.initial_state(), MotionHead(3, 4)
    series = np.resize(np.asarray(values), (len(TIME), 3))
    if isinstance(values, torch.Tensor):
        series = torch.as_tensor(series)
    for use in (
        lambda: JointDMP.fit(TIME, series, 8),
        lambda: dmp.step(state, 0.01, goal=values),
        lambda: dmp.step(state, 0.01, coupling=values),
        lambda: dmp.rollout(start=values),
        lambda: dmp.condition([1.0], values[None]),
        lambda: head(torch.zeros(head.n_parameters), [0.0, 0.5], values),
        lambda: Stepper(dmp).step(Stepper(dmp).initial_state(), 0.01, goal=np.asarray(values)),
    ):
        with pytest.raises(ValueError, match="real numbers"):
            use()
    with pytest.raises(ValueError, match="real numbers"):
        dmp.step(state, True)


def test_a_coupling_of_another_size_and_a_bad_ridge_are_named():
    dmp = JointDMP.fit(TIME, POSITION, 8)
    with pytest.raises(ValueError, match=r"coupling must have shape \(..., 3\), got \(0,\)"):
        dmp.step(dmp.initial_state(), 0.01, coupling=torch.zeros(0))
    for ridge in (math.nan, -1.0):
        with pytest.raises(ValueError, match="regularization must be finite, not negative"):
            JointDMP.fit(TIME, POSITION, 8, regularization=ridge)


def window_of_unequal_durations():
    both = JointDMP.fit(torch.stack([TIME, 2 * TIME]), torch.stack([POSITION] * 2), 8)
    both.condition([1.0], POSITION[None, 100], within=(0.5, 1.5))


def rhythms_about_different_centres():
    turn = torch.linspace(0, 2 * torch.pi, 200, dtype=torch.float64)
    axis = torch.stack([torch.sin(turn), torch.cos(turn), torch.zeros_like(turn)], -1)
    wave = quaternion.exp(0.2 * axis)
    away = quaternion.multiply(quaternion.exp(torch.tensor([0.0, 0.0, 1.0]).double()), wave)
    ProbabilisticDMP.fit(fit_rhythmic_orientation(turn, torch.stack([wave, away]), period=6.2))


def learned():
    return learn([(TIME, POSITION), (TIME, 1.1 * POSITION)], context=[1.0, 2.0], n_basis=8)


def stepped(**inputs):
    stepper = Stepper(JointDMP.fit(TIME, POSITION, 8))
    stepper.step(stepper.initial_state(), 0.01, **inputs)


def distribution():
    both = torch.stack([POSITION, 1.1 * POSITION])
    return ProbabilisticDMP.fit(JointDMP.fit(TIME, both, 8))


REFUSED = [
    (
        lambda: ProbabilisticDMP.fit(TIME, POSITION),  # pyright: ignore
        TypeError,
        "fit primitives as one batch, got Tensor",
    ),
    (lambda: ProbabilisticDMP.fit([JointDMP.fit(TIME, POSITION)]), TypeError, "got list"),
    (
        lambda: MovingGoalDMP(OrientationDMP.fit(*turning_motion(), 8)),  # pyright: ignore[reportArgumentType]
        TypeError,
        "needs a JointDMP, got OrientationDMP",
    ),
    (lambda: JointDMP.fit(TIME, POSITION, 8)[0], TypeError, "a single primitive cannot be ind"),
    (
        lambda: JointDMP.fit(TIME, POSITION, 8).condition(
            [1.0], Pose.from_vector(torch.ones(6))
        ),
        ValueError,
        "of joints or an orientation must be an array, got a Pose",
    ),
    (
        lambda: PoseDMP.fit(TIME, torch.stack([POSITION] * 2), turning_motion(len(TIME))[1]),
        ValueError,
        r"position, orientation error and body differ: \(2, \d+, 3\), \(\d+, 3\)",
    ),
    (
        window_of_unequal_durations,
        ValueError,
        "a window in seconds needs primitives of one dur",
    ),
    (rhythms_about_different_centres, ValueError, "rhythms about different centres have no"),
    (lambda: distribution().position([[0.1, 0.2]]), ValueError, r"time must be \(n,\), got"),
    (
        lambda: distribution().condition([0.5], POSITION[None, None, 100].repeat(2, 1, 1)),
        ValueError,
        r"via points must be \(n, D\), got \(2, 1, 3\)",
    ),
    (
        lambda: fit_shared([(TIME, POSITION), (TIME, torch.stack([POSITION] * 2))], 8),
        ValueError,
        r"demonstration 1: position must be \(T, 3\), without a batch",
    ),
    (
        lambda: fit_shared([(TIME, POSITION), (TIME, POSITION[:, :2])], 8),
        ValueError,
        r"demonstration 1: position must be \(T, 3\)",
    ),
    (
        lambda: learned().at(context=[math.nan]),
        ValueError,
        "context must be finite, but contains nan",
    ),
    (
        lambda: Frames(torch.eye(3)[None], torch.full((1, 3), math.nan)),
        ValueError,
        "b of frames must be finite",
    ),
    (
        lambda: Frames(math.inf * torch.ones(1, 3, 3), torch.zeros(1, 3)),
        ValueError,
        "A of frames must be finite",
    ),
    (lambda: stepped(goal=np.ones(1)), ValueError, r"goal must hold 3 real numbers"),
    (lambda: stepped(coupling=np.ones(1)), ValueError, r"coupling must hold 3 real numbers"),
]


@shapes_unchecked()
@pytest.mark.parametrize(
    ("use", "kind", "message"), REFUSED, ids=lambda x: x if isinstance(x, str) else ""
)
def test_what_has_no_meaning_is_named(use, kind, message):
    with pytest.raises(kind, match=message):
        use()


def test_autocast_changes_nothing():
    time, position = TIME.float(), POSITION.float()
    head, z = MotionHead(3, 4), torch.ones(15)

    def motions():
        dmp = JointDMP.fit(time, position, 8)
        state = dmp.step(dmp.initial_state(), 0.3, goal=dmp.goal + 0.1)
        bent = dmp.condition([1.0], [[0.1, 0.2, 0.3]])
        shown = dmp.rollout(), dmp.rollout(duration=[1.0, 2.0]), bent.rollout()
        planned = head(z, [0.1, 0.5], torch.zeros(3)).position
        return [x.position for x in shown] + [state.position, planned]

    expected = motions()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = motions()
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)
    half = head(z.bfloat16(), [0.1, 0.5], torch.zeros(3)).position
    torch.testing.assert_close(half, expected[-1])
