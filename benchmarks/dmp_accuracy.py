"""Accuracy of movement primitives: reproduction, orientations, gradients."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from recordings import read_recordings
from torch import Tensor

from hrc_learn.dmp import JointDMP, OrientationDMP
from hrc_learn.geometry import quaternion

TURNS = (10, 90, 179, 181, 200, 359, 361, 450, 720)
"""Angles [deg] of noise-free rotations."""
STEP = 1e-5
"""Step of central differences, for inputs of size one."""


def measure_reproduction(folder: Path) -> dict[str, float]:
    """Median error over recordings, relative to the largest range of each.

    Args:
        folder: Folder for `read_recordings`.
    """
    shown = [one for several in read_recordings(folder).values() for one in several]
    figures = {}
    for n_basis in (50, 100):
        errors = []
        for recording in shown:
            dmp = JointDMP.fit(recording.time, recording.position, n_basis)
            assert dmp.fit_report is not None
            errors.append(dmp.fit_report.nrmse.item())
        figures[f"reproduction_{n_basis}_nrmse"] = float(np.median(errors))
    return figures


NOISE, FRAME_RATE = 2e-3, 30.0
"""Noise of an inexpensive arm's encoders, as a fraction of the range (2 mrad of one radian),
and rate of the samples, as of a camera [1/s]."""
FIXED_COUNTS = (10, 20, 50, 100)


@torch.no_grad()
def measure_noise(folder: Path) -> dict[str, float]:
    """Errors of a fit with default options to noisy recordings, the first of each file.

    Positions are scaled to a range of one and resampled, and noise is added. Errors are
    relative to the original recording. Its peak acceleration is that of a fit with the largest
    number of basis functions that it supports, at most 200.

    Args:
        folder: Folder for `read_recordings`.
    """
    rng = np.random.default_rng(0)
    peaks, errors = [], []
    for recording, *_ in read_recordings(folder).values():
        time = recording.time - recording.time[0]
        position = recording.position / np.ptp(recording.position, axis=0).max()
        frames = np.arange(0.0, time[-1], 1 / FRAME_RATE)
        seen = np.stack([np.interp(frames, time, y) for y in position.T], axis=1)
        seen += NOISE * rng.standard_normal(seen.shape)
        within = time <= frames[-1]
        stamps, truth = torch.from_numpy(time[within]), torch.from_numpy(position[within])
        exact = JointDMP.fit(stamps, truth, min(200, len(stamps) // 6))
        motions = {
            count: JointDMP.fit(frames, seen, count).rollout(stamps)
            for count in (None, *(n for n in FIXED_COUNTS if n < len(frames)))
        }
        off = {n: (m.position - truth).square().mean().sqrt() for n, m in motions.items()}
        peak = exact.rollout(stamps).acceleration.abs().max()
        peaks.append((motions[None].acceleration.abs().max() / peak).item())
        errors.append((off.pop(None) / min(off.values())).item())
    return {
        "noisy_peak_acceleration_median": float(np.median(peaks)),
        "noisy_peak_acceleration_most": max(peaks),
        "noisy_error_of_best_fixed_median": float(np.median(errors)),
        "noisy_error_of_best_fixed_most": max(errors),
        "noisy_better_than_any_fixed": float(np.mean(np.array(errors) <= 1)),
    }


def measure_turns() -> dict[str, float]:
    """Largest RMSE [deg] of noise-free rotations about one axis."""
    s = torch.linspace(0, 1, 1000, dtype=torch.float64)
    axis = torch.tensor([0.48, 0.60, 0.64], dtype=torch.float64)
    errors = []
    for turn in TURNS:
        angle = math.radians(turn) * s**3 * (10 - 15 * s + 6 * s**2)
        shown = quaternion.exp(angle[:, None] * axis)
        reproduced = OrientationDMP.fit(2 * s, shown).rollout().orientation.detach()
        errors.append(quaternion.angle(reproduced, shown).square().mean().sqrt())
    return {"orientation_deg": math.degrees(max(errors))}


def measure_gradient_error() -> dict[str, float]:
    """Relative difference of derivatives of motions from central differences, in float64."""
    rng = torch.Generator().manual_seed(0)
    s = torch.linspace(0, 1, 100, dtype=torch.float64)
    vector = torch.stack([torch.sin(3 * s), s**2, torch.cos(2 * s)], dim=-1)
    joint = JointDMP.fit(2 * s, vector, 8)
    turning = OrientationDMP.fit(2 * s, quaternion.exp(vector), 8)
    time = torch.linspace(0, 2.5, 9, dtype=torch.float64)

    def move(weights: Tensor, start: Tensor, goal: Tensor, duration: Tensor) -> Tensor:
        ends = {"start": start, "goal": goal, "duration": duration, "time": time}
        return torch.func.functional_call(joint, {"weights": weights}, (), ends).velocity

    def turn(weights: Tensor, start: Tensor, goal: Tensor, duration: Tensor) -> Tensor:
        ends = {"start": start, "goal": goal, "duration": duration, "time": time}
        changed = {"motion.weights": weights}
        return torch.func.functional_call(turning, changed, (), ends).orientation

    joint.forward, turning.forward = joint.rollout, turning.rollout
    duration = torch.tensor(1.7, dtype=torch.float64)
    cases = {
        "joint": (move, (joint.weights, joint.start, joint.goal, duration)),
        "orientation": (turn, (turning.motion.weights, turning.start, turning.goal, duration)),
    }
    return {
        f"{name}_gradient_error": _gradient_error(function, inputs, rng)
        for name, (function, inputs) in cases.items()
    }


def _gradient_error(
    function: Callable[..., Tensor], inputs: tuple[Tensor, ...], rng: torch.Generator
) -> float:
    """Largest relative error of the gradient of a random sum of the outputs, along a random
    direction of each input.
    """
    inputs = tuple(x.detach().clone().requires_grad_() for x in inputs)
    seed = torch.randn(function(*inputs).shape, generator=rng, dtype=torch.float64)
    gradients = torch.autograd.grad(function(*inputs), inputs, seed)
    errors = []
    for i, (x, gradient) in enumerate(zip(inputs, gradients, strict=True)):
        direction = x.detach().abs().max() * torch.randn(x.shape, generator=rng, dtype=x.dtype)
        with torch.no_grad():
            ahead, behind = (
                (seed * function(*inputs[:i], x + h * direction, *inputs[i + 1 :])).sum()
                for h in (STEP, -STEP)
            )
        exact = (gradient * direction).sum()
        errors.append(abs(exact - (ahead - behind) / (2 * STEP)) / abs(exact))
    return torch.stack(errors).max().item()
