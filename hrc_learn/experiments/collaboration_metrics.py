"""Metrics of a collaboration; with several objects, each value is that of the worst object.

Success is decided by contacts and poses of the simulator, not by the report of the task.
"""

from collections.abc import Callable, Collection, Sequence
from typing import get_args

import numpy as np

from hrc_learn.experiments import run_measures as measures
from hrc_learn.experiments.collaboration_trial import CollaborationRun
from hrc_learn.experiments.metric_table import Metric, median, never, p95, success_rate
from hrc_learn.experiments.surroundings import NearWorker, worker_contacts
from hrc_learn.experiments.trials import Trial
from hrc_learn.sim import Touch
from hrc_learn.sim.hand_over import HandOver, Reach
from hrc_learn.skills.pick_and_place import RELEASE
from hrc_learn.skills.receiving import Receipt
from hrc_learn.skills.work_cell import Mishap

type Measure = Callable[[CollaborationRun], float | int | None]

_SAME_TASK = "main task not affected (Experiment 3)"


# Largest normalised error of a reproduction. The present error is the tremor of the
# demonstrating hand, which primitives do not reproduce: 0.0006 (SO-101) to 0.00102 (UR3) of the
# joints' range. This error is the same with 15, 60 and 80 basis functions.
_REPRODUCTION = 1.5e-3


def collaboration_metrics(
    objects: int, reproduction_nrmse: float
) -> list[Metric[CollaborationRun]]:
    """Metrics of a run, in the order of the table.

    Args:
        objects: Number of objects to be placed.
        reproduction_nrmse: Normalised RMS error of the primitives, from their fit.
    """
    return [
        Metric(
            "reproduction of the demonstrations, NRMSE",
            lambda run: reproduction_nrmse,
            at_most=_REPRODUCTION,
        ),
        Metric("servoing time", lambda run: _worst(run, "servo_time"), "s"),
        Metric(
            "pixel error at descent", lambda run: _worst(run, "pixel_error"), "px", at_most=5.0
        ),
        Metric("grasp offset", lambda run: max(_grasp_offsets(run), default=None), "mm"),
        _delivered("objects held flat between both pads", lambda run: run.held_flat, objects),
        *_SAFETY,
        *_HAND_OVER,
        *_COURSE,
        _delivered(
            "objects that stand on their shelf",
            _standing,
            objects,
            claim="three objects, one after the other (Experiment 3)",
        ),
        *_PULLS,
    ]


def _delivered(
    name: str, of: Callable[[CollaborationRun], Collection[str]], count: int, claim: str = ""
) -> Metric[CollaborationRun]:
    """Metric of the number of objects that meet a condition; its target is all objects."""

    def others(run: CollaborationRun) -> str:
        names = [item.name for item in run.workplace.scene.objects]
        return f"not {', '.join(name for name in names if name not in of(run))}"

    def number(run: CollaborationRun) -> int:
        return len(of(run))

    return Metric(name, number, at_least=count, claim=claim, essential=True, detail=others)


def _near_worker(of: Callable[[NearWorker], float | int]) -> Measure:
    """Measure of the arm near the worker; None without a worker."""
    return lambda run: None if run.near_worker is None else of(run.near_worker)


def _touches(hit: str, name: str) -> Metric[CollaborationRun]:
    """Metric of the number of unwanted contacts with the object `hit`."""
    return never(
        name,
        lambda run: len(_contacts(run)[hit]),
        detail=lambda run: f"first {_contacts(run)[hit][0]}",
    )


_SAFETY: Sequence[Metric[CollaborationRun]] = (
    Metric("place error", lambda run: _placed(run)[0], "mm", at_most=5.0),
    Metric("place tilt", lambda run: _placed(run)[1], "deg", at_most=3.0),
    # Five joints control the pitch of the tool. The yaw follows from the tool's position.
    Metric("place pitch", lambda run: _off_by_five_joints(run, 0), "deg", at_most=3.0),
    Metric("place yaw", lambda run: _off_by_five_joints(run, 1), "deg", at_most=3.0),
    never("joint limit violations", lambda run: measures.limit_violations(run.cell)),
    _touches("cabinet", "contacts with the cabinet"),
    _touches("table", "contacts with the table"),
    _touches("arm itself", "contacts of the arm with itself"),
    # Not listed: the rows above count the contacts by object.
    Metric("contacts", lambda run: sum(map(len, _contacts(run).values())), listed=False),
    Metric("contacts with the worker", lambda run: _worker_contacts(run)),
    Metric("min distance", lambda run: _min_distance(run), "mm"),
    # Steps in which the arm could not have stopped before reaching the worker.
    never("separation violations", _near_worker(lambda near: int((near.margin < 0).sum()))),
    Metric(
        "contact force relative to its limit",
        _near_worker(lambda near: float(near.force.max(initial=0.0))),
    ),
    never("contacts over the limit", lambda run: _too_hard(run)),
    Metric(
        "waited for the worker",
        lambda run: (
            None
            if run.visit is None
            else float((1.0 - run.cell.log["pace"]).sum() * run.cell.config.dt)
        ),
        "s",
    ),
)


def _handed(
    name: str,
    of: Callable[[Receipt, Reach, HandOver], float],
    unit: str = "",
    at_most: float | int | None = None,
) -> Metric[CollaborationRun]:
    """Metric of a hand-over; left out if there was none, or if it was not recognised."""

    def measure(run: CollaborationRun) -> float | None:
        receipt = next((p.receipt for p in run.picks if p.receipt is not None), None)
        if run.hand_over is None or receipt is None or receipt.predicted is None:
            return None
        value = float(of(receipt, run.hand_over.reaches[-1], run.hand_over))
        return None if np.isnan(value) else value

    return Metric(name, measure, unit, at_most=at_most)


_HAND_OVER: Sequence[Metric[CollaborationRun]] = (
    _handed(
        "hand-over recognised before it began",
        lambda receipt, reach, _: float(receipt.seen < reach.begin),
        at_most=0,
    ),
    _handed("other movements passed over", lambda receipt, _, __: receipt.passed_over),
    _handed(
        "hand-over recognised at this fraction of the movement",
        lambda receipt, reach, _: (
            100 * (receipt.recognised - reach.begin) / (reach.end - reach.begin)
        ),
        "%",
    ),
    _handed(
        "hand-over place, error when recognised",
        lambda receipt, _, plan: 1e3 * float(np.linalg.norm(receipt.predicted - plan.place)),
        "mm",
    ),
    _handed(
        "time until the object was held",
        lambda receipt, reach, _: receipt.taken - reach.begin,
        "s",
    ),
)

_COURSE: Sequence[Metric[CollaborationRun]] = (
    Metric(
        "cycle time",
        lambda run: run.cell.time,
        "s",
        claim="the first object on its shelf after 68 s (snapshots)",
    ),
    *(
        Metric[CollaborationRun](
            f"recovered from: {mishap}",
            lambda run, mishap=mishap: (
                sum(note.mishap == mishap for pick in run.picks for note in pick.recoveries)
                or None
            ),
        )
        for mishap in get_args(Mishap)
    ),
)

_PULLS: Sequence[Metric[CollaborationRun]] = (
    Metric(
        "end effector deviation",
        lambda run: _off_path(run) if run.pulls else _pushed(run, lambda d: 1e3 * d.position),
        "mm",
        at_most=2.0,
        claim=_SAME_TASK,
    ),
    Metric(
        "end effector rotation",
        lambda run: None if run.pulls else _pushed(run, lambda d: np.rad2deg(d.rotation)),
        "deg",
        at_most=0.5,
        claim=_SAME_TASK,
    ),
    Metric(
        "elbow moved",
        lambda run: _elbow_pulled(run) if run.pulls else _pushed(run, lambda d: 1e3 * d.elbow),
        "mm",
        # Enough to reach under the arm. If the elbow moves less, a small deviation of the end
        # effector proves nothing.
        at_least=100.0,
        claim="joint 4 dragged forward for 7 s, backward for 4 s",
    ),
    Metric("pulls", lambda run: len(run.pull_effects) or None),
)

TRIAL_METRICS: Sequence[Metric[Sequence[Trial]]] = (
    Metric("trials, success rate", success_rate),
    Metric("trials, end effector deviation (95 %)", p95("end_effector_deviation_mm"), "mm"),
    Metric("trials, elbow moved (median)", median("elbow_moved_mm"), "mm"),
    Metric("trials, grasp offset (95 %)", p95("grasp_offset_mm"), "mm"),
    Metric("trials, place error (95 %)", p95("place_error_mm"), "mm"),
    Metric("trials, place tilt (95 %)", p95("place_tilt_deg"), "deg"),
    Metric("trials, cycle time (median)", median("cycle_time_s"), "s"),
    Metric("trials, min distance (median)", median("min_distance_mm"), "mm"),
)
"""Metrics of repeated runs."""


def _worker_contacts(run: CollaborationRun) -> int | None:
    """Number of contacts with the worker; None without a worker."""
    if run.world.config.worker is None:
        return None
    return len(worker_contacts(run.world, run.cell.log, run.motion))


def _too_hard(run: CollaborationRun) -> int | None:
    """Number of steps with more force than allowed; None if the arm may not touch people."""
    near = run.near_worker
    if near is None or run.cell.config.safety.separation.mode == "ssm":
        return None
    return int((near.force > 1).sum())


def _min_distance(run: CollaborationRun) -> float | None:
    """True smallest distance of the worker from robot and load [mm]; None without a worker."""
    distance = measures.worker_distance(run.motion, len(run.cell.log))
    return 1e3 * float(distance.min()) if len(distance) else None


def _off_path(run: CollaborationRun) -> float | None:
    """Largest distance of the end effector from its path in phases with pulls [mm]."""
    off = [1e3 * effect.tool for effect in run.pull_effects if np.isfinite(effect.tool)]
    return max(off, default=None)


def _elbow_pulled(run: CollaborationRun) -> float | None:
    """Median displacement of the elbow over the pulls at random moments [mm]."""
    moved = [effect.elbow for effect in run.pull_effects]
    return 1e3 * float(np.median(moved)) if moved else None


def _worst(run: CollaborationRun, name: str) -> float | None:
    """Largest value over all objects picked from the table and released; None: no object."""
    grasped = [e for e in run.picks if e.release is not None and e.receipt is None]
    return max((float(getattr(job, name)) for job in grasped), default=None)


def _pushed(
    run: CollaborationRun, of: Callable[[measures.Deviation], np.ndarray]
) -> float | None:
    """Largest deviation in a run in which a person pushed the elbow; None without a push."""
    log = run.cell.log
    if not (log["nullspace_input"] != 0).any():
        return None
    # Deviations are NaN before the first push and after the interaction.
    deviation = measures.Deviation.of(log, run.motion, run.world)
    return float(np.nan_to_num(of(deviation)).max())


def _grasp_offsets(run: CollaborationRun) -> list[float]:
    """Horizontal distance of the end effector at the last descent onto each object [mm]."""
    log, offsets = run.cell.log, []
    for pick in run.picks:
        begin, end = pick.span
        descents = [t for t, _ in measures.spans(log, "grasp") if begin <= t < end]
        if pick.release is not None and descents:
            # Only the last attempt counts: earlier attempts missed or lost the object.
            offset = measures.grasp_offset(
                log, run.motion, run.world, pick.item.name, descents[-1]
            )
            offsets.append(1e3 * offset)
    return offsets


def _placed(run: CollaborationRun) -> tuple[float | None, float | None]:
    """Largest distance [mm] and angle [deg] of objects from their intended places."""
    errors, angles = [], []
    for pick in run.picks:
        if pick.release is None:
            continue
        pose = run.world.object_pose(pick.item.name)
        errors.append(np.linalg.norm(pose[:2, 3] - pick.goal.position[:2].numpy()))
        # Angles are relative to the true shelf: errors of the base do not count.
        angles.append(measures.place_angle(pose, pick.goal.orientation))
    if not errors:
        return None, None
    return 1e3 * float(max(errors)), float(np.rad2deg(max(angles)))


def _off_by_five_joints(run: CollaborationRun, which: int) -> float | None:
    """Largest pitch (0) or yaw (1) of placed objects [deg]; None with more than five joints."""
    if run.workplace.robot.task != "nearest pose":
        return None
    angles = [
        measures.place_pitch_and_yaw(
            run.world.object_pose(pick.item.name), pick.goal.orientation
        )[which]
        for pick in run.picks
        if pick.release is not None
    ]
    return float(np.rad2deg(max(angles))) if angles else None


def _standing(run: CollaborationRun) -> list[str]:
    """Objects that stand on their shelf, clear of the arm."""
    places = {pick.item.name: f"board_{pick.shelf}" for pick in run.picks}
    return [name for name, place in places.items() if run.world.rests_on(name, place)]


def _contacts(run: CollaborationRun) -> dict[str, tuple[Touch, ...]]:
    """Unwanted contacts, by the object that was hit."""
    released = {
        pick.item.name: start
        for pick in run.picks
        for start, _ in measures.spans(run.cell.log, RELEASE)
        # A person may stop the arm while it lowers an object.
        if pick.release is not None and pick.span[0] <= start < pick.span[1]
    }
    return measures.unwanted_contacts(run.world, run.cell.log, released)
