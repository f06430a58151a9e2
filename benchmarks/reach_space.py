"""Space left for a worker who reaches under the arm: free volume and posture.

Both depend only on the arm, at the times at which a hand of the worker is at a marker. The
worker's stance and lean are optimised, so that the comparison of arms does not depend on the
actual posture of the worker.

    python benchmarks/reach_space.py --placing outputs/demo/placing --aiming outputs/demo/aiming
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from hrc_learn import cli
from hrc_learn.experiments.collaboration_experiment import CollaborationExperiment
from hrc_learn.geometry import Box
from hrc_learn.kinematics import CapsuleArm, separation
from hrc_learn.log import LoggedSteps
from hrc_learn.sim import WorkerVisit, whole_arm
from hrc_learn.sim.worker import Posture
from hrc_learn.sim.worker_visit import HAND_OVER_BENCH

CLEAR = 0.05
"""Distance from the arm that a posture must keep [m]: the intrusion distance between the
capsules of body and arm, as in the clearance of the protective distance."""
# Distance from the arm that leaves room for a hand [m]: half its breadth plus `CLEAR`.
_HAND = 0.10
# Spacing of the counted points [m].
_GRID = 0.02
# Height of the space over the bench [m]: that of an elbow over a hand on the bench.
_ABOVE = 0.40
# Half width of the space around the point where the arm works [m]: the markers lie there.
_AROUND = (0.25, 0.20)
# Stances that are tried along the bench, from the worker's own [m]: a step to either side.
_ASIDE = np.linspace(-0.45, 0.45, 7)
# Leans that are tried [rad], up to the last step of RULA, a measure of ergonomics.
_LEANS = np.deg2rad(np.arange(0.0, 61.0, 5.0))
# Lean of a comfortable posture [rad]: the first step of RULA (McAtamney and Corlett 1993,
# "RULA: a survey method", Applied Ergonomics 24).
_COMFORTABLE = np.deg2rad(20.0)
# Points on the bench to reach, along either side of the space.
_PLACES = 5
# Number of postures that are evaluated together: about 100 MB.
_BLOCK = 1000


@dataclass(frozen=True, kw_only=True)
class Args:
    placing: Path
    """Folder of the placing skill."""
    aiming: Path
    """Folder of the visual-servoing skill."""
    jobs: int = 6
    """Jobs near a worker."""
    seed: int = 100
    """First seed."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> None:
    """Measure the space of each worker, and print the medians over the jobs."""
    experiment = CollaborationExperiment(placing=args.placing, aiming=args.aiming, worker=True)
    rows = []
    for seed in range(args.seed, args.seed + args.jobs):
        run = experiment.run(seed)
        if run.visit is None or not len(run.visit.markers):
            continue
        x, y, _ = run.visit.markers.mean(axis=0).tolist()
        spaces = reach_spaces(
            run.cell.log,
            run.visit,
            whole_arm(run.world.config.arm),
            space_over_bench((x, y), run.world.table_top),
            run.world.arm.encoder_offset,
        )
        rows.append(np.mean([(s.free_volume, s.comfortable) for s in spaces], axis=0))
    volume, comfortable = np.median(rows, axis=0).tolist()
    print(f"free volume {1e3 * volume:.1f} l, comfortable reach {100 * comfortable:.0f} %")
    if args.json is not None:
        figures = {"free_volume_l": 1e3 * volume, "comfortable_%": 100 * comfortable}
        cli.write_json(args.json, figures)


@dataclass(frozen=True, kw_only=True)
class ReachSpace:
    """Space while a hand is at a marker."""

    time: float
    """Time in the middle of the reach [s]."""
    free_volume: float
    """Volume over the bench, under the arm, with room for a hand [m^3]."""
    comfortable: float
    """Fraction of the bench that can be reached clear of the arm without leaning far."""
    reachable: float
    """Fraction of the bench that can be reached clear of the arm."""


def reach_spaces(
    log: LoggedSteps,
    visit: WorkerVisit,
    arm: CapsuleArm,
    over: Box,
    encoder_offset: Float[np.ndarray, " joints"],
) -> list[ReachSpace]:
    """Space at each marker that the worker reached for during a run.

    Args:
        log: Log of the run.
        visit: Visit of the worker.
        arm: Capsules of arm and tool.
        over: Box in which space is counted (`space_over_bench`).
        encoder_offset: Offset of the logged joint positions: measured minus true [rad].
    """
    spaces = []
    places = bench_places(over)
    for begin, end in visit.reaches:
        k = int(np.searchsorted(log["time"], (begin + end) / 2))
        if k == len(log["time"]):
            continue
        q = torch.from_numpy(log["joint_position"][k] - encoder_offset)
        leans = least_leans(arm, q, visit, places)
        spaces.append(
            ReachSpace(
                time=float(log["time"][k]),
                free_volume=free_volume(arm, q, over),
                comfortable=float((leans <= _COMFORTABLE + 1e-9).mean()),
                reachable=float(np.isfinite(leans).mean()),
            )
        )
    return spaces


def space_over_bench(centre: tuple[float, float], top: float) -> Box:
    """Box in which space is counted.

    Args:
        centre: Point above which the arm works [m].
        top: Height of the bench [m].
    """
    half = (*_AROUND, _ABOVE / 2)
    return Box(centre=(*centre, top + _ABOVE / 2), half_size=half)


def free_volume(arm: CapsuleArm, joint_position: Float[Tensor, " joints"], over: Box) -> float:
    """Volume of a box in which a hand keeps clear of an arm [m^3].

    Args:
        arm: Capsules of arm and tool.
        joint_position: Joint positions [rad].
        over: Box.
    """
    axes = [
        torch.arange(c - h + _GRID / 2, c + h, _GRID, dtype=torch.float64)
        for c, h in zip(over.centre, over.half_size, strict=True)
    ]
    points = torch.cartesian_prod(*axes)
    ends = points[:, None, :].expand(-1, 2, 3)
    distance = separation(arm, joint_position, ends, points.new_zeros(len(points))).distance
    return float((distance.amin(0) >= _HAND).sum()) * _GRID**3


def bench_places(over: Box) -> Float[np.ndarray, "places 3"]:
    """Grid of points on the bench under a box, at the height of a hand on it [m]."""
    x, y = (
        c + h * np.linspace(-1.0, 1.0, _PLACES)
        for c, h in zip(over.centre[:2], over.half_size[:2], strict=True)
    )
    z = over.centre[2] - over.half_size[2] + HAND_OVER_BENCH
    return np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)


def least_leans(
    arm: CapsuleArm,
    joint_position: Float[Tensor, " joints"],
    visit: WorkerVisit,
    markers: Float[np.ndarray, "markers 3"],
) -> Float[np.ndarray, " markers"]:
    """Smallest lean with which a worker reaches each marker clear of an arm [rad].

    The stance along the bench and the hand are free; NaN if there is no such posture.

    Args:
        arm: Capsules of arm and tool.
        joint_position: Joint positions [rad].
        visit: Visit of the worker, with the stance at the bench.
        markers: Positions of the hand [m].
    """
    which, postures = _reaching(visit, markers)
    leans = np.full(len(markers), np.nan)
    for first in range(0, len(which), _BLOCK):
        some = slice(first, first + _BLOCK)
        part = Posture(**{f.name: getattr(postures, f.name)[some] for f in fields(Posture)})
        ends = torch.from_numpy(visit.worker.ends(part))
        radius = torch.from_numpy(visit.worker.radius).expand(len(ends), -1)
        q = joint_position.expand(len(ends), -1)
        distance = separation(arm, q, ends, radius).distance.amin((-2, -1)).numpy()
        clear = distance >= CLEAR
        for marker, lean in zip(which[some][clear], part.lean[clear], strict=True):
            leans[marker] = np.fmin(leans[marker], lean)
    return leans


def _reaching(
    visit: WorkerVisit, markers: Float[np.ndarray, "markers 3"]
) -> tuple[Int[np.ndarray, " postures"], Posture]:
    """Postures that reach a marker, and the index of the marker of each."""
    worker = visit.worker
    standing = visit.posture(np.array(visit.released))
    heading = float(standing.heading)
    forward = np.array([np.cos(heading), np.sin(heading)])
    aside = np.array([-forward[1], forward[0]])
    rest, found = worker.hanging_hands(), []
    for number, marker in enumerate(markers):
        for step in _ASIDE:
            place = standing.place + step * aside
            x, y = (marker[:2] - place) @ np.stack([forward, aside], axis=1)
            hand = np.array([x, y, marker[2] - worker.config.floor])
            for side in (0, 1):
                needed = worker.lean_to(hand, side)
                if needed is None:
                    continue
                hands = rest.copy()
                hands[side] = hand
                found += [
                    (number, place, lean, hands) for lean in _LEANS[needed <= _LEANS + 1e-9]
                ]
    number, place, lean, hands = (
        (np.array(each) for each in zip(*found, strict=True))
        if found
        else (np.zeros(0, int), np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2, 3)))
    )
    zero = np.zeros(len(number))
    return number, Posture(
        place=place,
        heading=np.full(len(number), heading),
        lean=lean,
        stride=zero,
        swing=zero,
        hands=hands,
    )


if __name__ == "__main__":
    cli.run(main, Args)
