"""The equations of a movement primitive in NumPy and SciPy, sharing no code with ours."""

import numpy as np
from scipy.integrate import solve_ivp


def gaussians(basis, s):
    """The basis as its docstring states it, by another route than the code's."""
    spacing = 1 / (basis.count - 1)
    if basis.domain == "time":
        c = spacing * np.arange(basis.count + 1)
        psi = np.exp(-((s - c) ** 2) / (2 * (basis.width * spacing) ** 2))
    else:
        c = np.exp(-basis.phase.decay * spacing * np.arange(basis.count))
        sigma = basis.width * np.append(c[:-1] - c[1:], c[-2] - c[-1])
        psi = np.exp(-((np.exp(-basis.phase.decay * s) - c) ** 2) / (2 * sigma**2))
    return psi


def forcing(basis, s):
    psi = gaussians(basis, s)
    return psi[: basis.count] / psi.sum() * np.exp(-basis.phase.decay * s)


def solve(spring, basis, weights, y0, rate, goal, times, push=None):
    """(y, y') at `times` by an adaptive solver; `push(s, y, y')` is an extra acceleration."""

    def rhs(s, x):
        force = forcing(basis, s) @ weights + (push(s, *x) if push else 0.0)
        return [x[1], spring.alpha * (spring.beta * (goal - x[0]) - x[1]) + force]

    return solve_ivp(
        rhs,
        (times[0], times[-1]),
        [y0, rate],
        "DOP853",
        times,
        rtol=1e-12,
        atol=1e-12,
        max_step=0.01,
    ).y
