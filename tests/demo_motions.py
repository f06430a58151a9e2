"""Synthetic demonstrations with known properties, for tests of movement primitives."""

import torch

PERIOD = 0.83
"""Of `rhythm` [s]."""


def minimum_jerk(s):
    """Quintic from 0 to 1 that starts and ends at rest."""
    return s**3 * (10 - 15 * s + 6 * s**2)


def arm_motion(n_samples=400, n_joints=7, duration=3.0, seed=0, moving_start=False):
    """Time (T,) [s] and smooth joint positions (T, D) [rad]; nothing here is a DMP."""
    rng = torch.Generator().manual_seed(seed)

    def rand(*shape):
        return 2 * torch.rand(*shape, generator=rng, dtype=torch.float64) - 1

    s = torch.linspace(0, 1, n_samples, dtype=torch.float64)
    start, goal = rand(n_joints), rand(n_joints)
    position = start + minimum_jerk(s)[:, None] * (goal - start)
    for k in (1, 2, 3):
        bump = (k * torch.pi * s).sin() ** (1 if moving_start else 3)
        position = position + 0.2 * bump[:, None] * rand(n_joints)
    return s * duration, position


def turning_motion(n_samples=400, duration=3.0, seed=0):
    """Time (T,) [s] and smooth orientations (T, 4) that turn about a wandering axis."""
    from hrc_learn.geometry import quaternion

    time, vector = arm_motion(n_samples, 3, duration, seed, moving_start=True)
    return time, quaternion.exp(vector)


def rhythm(seed=0, n_samples=500, duration=4.2, n_joints=3):
    """Time and a sum of four harmonics about a centre, from anywhere in the cycle."""
    rng = torch.Generator().manual_seed(seed)
    time = torch.linspace(0, duration, n_samples, dtype=torch.float64)
    amplitude, shift = torch.rand(2, 4, n_joints, generator=rng, dtype=torch.float64)
    y = torch.rand(n_joints, generator=rng, dtype=torch.float64).expand(n_samples, -1)
    for k in range(4):
        angle = 2 * torch.pi * (k + 1) * (time[:, None] / PERIOD + shift[k])
        y = y + amplitude[k] / (k + 1) ** 2 * torch.sin(angle)
    return time, y
