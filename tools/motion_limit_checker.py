"""Lets franka-sim's own checker judge joint velocities that were sent at 1 kHz.

    tools/make_franka_sim.sh
    .venv-franka-sim/bin/python tools/motion_limit_checker.py --sent sent.npz

The archive has `position` and `velocity` (ticks, streams, 7), where the joints were after each
tick [rad] and what they were told for it [rad/s]. Each stream is checked twice, as a velocity
motion and as a position motion, where limits depend on the position at the one that the command
leads to. Where the archive has `motion` (ticks), numbers of motions that came one after another
in the one stream that there is, each of them is checked from rest, as a velocity motion only:
positions are measured then. Where it has `lower`, `upper`, `max_velocity`, `acceleration` and
`jerk` (7), and for limits that depend on the position `velocity_offset` and `deceleration`,
these take the place of the checker's tables, which are of the FR3. Prints a line of JSON:
ticks, findings, the first ones.

It needs franka-sim and NumPy, and nothing of this project.
"""

from __future__ import annotations

import argparse
import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

_SHOWN = 5
"""Findings that are told in words."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sent", type=Path, required=True, help="the archive (.npz)")
    args = parser.parse_args()
    try:
        from franka_sim.limits import checker  # pyright: ignore[reportMissingImports]
    except ImportError:
        parser.error("no franka-sim here: run this by .venv-franka-sim/bin/python")
    with np.load(args.sent) as file:
        sent = {name: file[name] for name in file.files}
    if "lower" in sent:
        use_limits(checker, sent)
    position, velocity = sent["position"], sent["velocity"]
    modes = checker.ControlMode
    if "motion" not in sent:
        verdict = findings(checker, position, velocity, (modes.VELOCITY, modes.POSITION))
    else:
        verdict = {"ticks": 0, "findings": 0, "shown": []}
        for begin, end in _motions(sent["motion"]):
            part = position[begin:end], velocity[begin:end]
            found = findings(checker, *part, (modes.VELOCITY,), first_tick=begin)
            verdict = {name: verdict[name] + found[name] for name in verdict}
        verdict["shown"] = verdict["shown"][:_SHOWN]
    print(json.dumps(verdict))


def use_limits(checker: Any, limits: dict[str, np.ndarray]) -> None:
    """Put other limits in place of the checker's, in the two modules where it reads them."""
    from franka_sim.limits import tables  # pyright: ignore[reportMissingImports]

    # Without an offset and a deceleration the curve has to be above any limit of velocity.
    offset = limits.get("velocity_offset", np.zeros(7))
    deceleration = limits.get("deceleration", np.full(7, 1e12))
    replaced = {
        "JOINT_POSITION_LIMITS": _rows(limits["lower"], limits["upper"]),
        "POSITION_BASED_VELOCITY_LIMITS": _rows(limits["max_velocity"], offset, deceleration),
        "MAX_JOINT_ACCELERATION": tuple(limits["acceleration"].tolist()),
        "MAX_JOINT_JERK": tuple(limits["jerk"].tolist()),
    }
    for name, value in replaced.items():
        for module in (tables, checker):
            if hasattr(module, name):
                setattr(module, name, value)


def _rows(*columns: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in np.stack(columns, axis=-1).tolist())


def _motions(number: np.ndarray) -> list[tuple[int, int]]:
    """Where each motion begins, and where it has ended."""
    edges = [0, *(np.flatnonzero(np.diff(number)) + 1).tolist(), len(number)]
    return list(pairwise(edges))


def findings(
    checker: Any,
    position: np.ndarray,
    velocity: np.ndarray,
    modes: tuple[Any, ...],
    first_tick: int = 0,
) -> dict[str, Any]:
    """What the checker finds in all streams, each from rest.

    Returns:
        `ticks`, checked in each of the ways; `findings`, of all; `shown`, the first in words.
    """
    velocity_mode = checker.ControlMode.VELOCITY
    found: list[str] = []
    for stream in range(position.shape[1]):
        q, v = position[:, stream].tolist(), velocity[:, stream].tolist()
        for mode in modes:
            judge = checker.MotionLimitChecker()
            rest = {"q": q[0], "q_d": q[0], "dq_d": [0.0] * 7, "ddq_d": [0.0] * 7}
            judge.start_motion(mode, rest)
            for k, (at, speed) in enumerate(zip(q, v, strict=True)):
                sent = {"dq_c": speed} if mode is velocity_mode else {"q_c": at}
                command = {"message_id": k, **sent}
                violation = judge.check(command, at)
                judge.record(command)
                if violation is not None:
                    found.append(
                        f"stream {stream}, tick {first_tick + k}: {violation.describe()}"
                    )
    ticks = int(np.prod(position.shape[:2]))
    return {"ticks": ticks, "findings": len(found), "shown": found[:_SHOWN]}


if __name__ == "__main__":
    main()
