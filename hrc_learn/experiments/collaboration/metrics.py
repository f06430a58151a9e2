"""What is measured of a collaboration. Of several objects the worst counts.

Success is read from the simulator's contacts and poses, not from what the task believes.
"""

from collections import Counter
from collections.abc import Callable, Collection, Sequence
from typing import get_args

import numpy as np

from hrc_learn.experiments.collaboration.trial import CollaborationRun
from hrc_learn.experiments.collaboration.worker import worker_contacts
from hrc_learn.experiments.grip import Hold, grasp_offset, hold, place_angle
from hrc_learn.experiments.metric_table import Metric, median, p95, success_rate
from hrc_learn.experiments.monte_carlo import Trial
from hrc_learn.experiments.run_recording import (
    Deviation,
    limit_violations,
    spans,
    unwanted_contacts,
    worker_distance,
)
from hrc_learn.sim import Touch
from hrc_learn.sim.hand_over import HandOver, Reach
from hrc_learn.skills.pick_and_place import HOME, RELEASE, Mishap, PickPlaceJob
from hrc_learn.skills.receiving import Receipt

_CONTACTS = {
    "cabinet": "contacts with the cabinet",
    "table": "contacts with the table",
    "arm itself": "contacts of the arm with itself",
}
"""Names of metrics, by what was met."""


def _handed(
    of: Callable[[Receipt, Reach, HandOver], float],
) -> Callable[[CollaborationRun], float | None]:
    """Of the hand-over of a run; None where there was none, or it was not recognised."""

    def measure(run: CollaborationRun) -> float | None:
        receipt = next((p.receipt for p in run.picks if p.receipt is not None), None)
        if run.hand_over is None or receipt is None or receipt.predicted is None:
            return None
        value = float(of(receipt, run.hand_over.reaches[-1], run.hand_over))
        return None if np.isnan(value) else value

    return measure


def _apart(place: np.ndarray | None, other: np.ndarray) -> float:
    """[mm]; NaN for no place."""
    return float("nan") if place is None else 1e3 * float(np.linalg.norm(place - other))


HAND_OVER_METRICS: Sequence[Metric[CollaborationRun]] = (
    Metric(
        "hand-over recognised before it began",
        _handed(lambda told, reach, _: float(told.seen < reach.begin)),
        at_most=0,
    ),
    Metric("other movements passed over", _handed(lambda told, _, __: told.passed_over)),
    Metric(
        "hand-over recognised, true share of the movement then",
        _handed(
            lambda told, reach, _: (
                100 * (told.recognised - reach.begin) / (reach.end - reach.begin)
            )
        ),
        "%",
    ),
    Metric(
        "phase error when recognised",
        _handed(
            lambda told, reach, _: (
                100 * abs(told.phase - (told.seen - reach.begin) / (reach.end - reach.begin))
            )
        ),
        "%",
    ),
    Metric(
        "hand-over place, error when recognised",
        _handed(lambda told, _, plan: _apart(told.predicted, plan.place)),
        "mm",
    ),
    Metric(
        "hand-over place, error after the movement",
        _handed(lambda told, _, plan: _apart(told.refined, plan.place)),
        "mm",
    ),
    Metric(
        "from where it was held out to where it was taken",
        _handed(lambda told, _, plan: _apart(told.place, plan.place)),
        "mm",
    ),
    Metric(
        "from the hand setting off until the object was held",
        _handed(lambda told, reach, _: told.taken - reach.begin),
        "s",
    ),
)
"""Of the object that a person hands over."""

_FAR = 0.15
"""Elbow moved by a pull that got its way [m]."""


def collaboration_metrics(
    objects: int, reproduction_nrmse: float
) -> list[Metric[CollaborationRun]]:
    """The table.

    Args:
        objects: How many there are to be placed.
        reproduction_nrmse: Of the primitives, from their fit.
    """
    return [
        Metric(
            "reproduction of the demonstrations, NRMSE",
            lambda run: reproduction_nrmse,
            at_most=1e-3,
        ),
        Metric("servoing time", lambda run: _worst(run, lambda e: e.servo_time), "s"),
        Metric(
            "pixel error at descent",
            lambda run: _worst(run, lambda e: e.pixel_error),
            "px",
            at_most=5.0,
        ),
        Metric("grasp offset", lambda run: max(_grasp_offsets(run), default=None), "mm"),
        Metric(
            "object tilt in the hand",
            lambda run: max((np.rad2deg(h.tilt) for h in _holds(run)), default=None),
            "deg",
            at_most=3.0,
        ),
        Metric(
            "slip in the hand",
            lambda run: max((1e3 * h.slip for h in _holds(run)), default=None),
            "mm",
            at_most=3.0,
        ),
        Metric(
            "objects held flat between both pads",
            lambda run: len(run.held_flat),
            at_least=objects,
            essential=True,
            detail=lambda run: _all_but(run, run.held_flat),
        ),
        Metric("place error", lambda run: _placed(run)[0], "mm", at_most=5.0),
        Metric("place tilt", lambda run: _placed(run)[1], "deg", at_most=3.0),
        Metric(
            "joint limit violations",
            lambda run: limit_violations(run.cell),
            at_most=0,
            essential=True,
        ),
        *(
            Metric(
                name,
                lambda run, met=met: len(_contacts(run)[met]),
                at_most=0,
                essential=True,
                detail=lambda run, met=met: f"first {_contacts(run)[met][0]}",
            )
            for met, name in _CONTACTS.items()
        ),
        # Not listed, as the rows above tell what was met.
        Metric("contacts", lambda run: sum(map(len, _contacts(run).values())), listed=False),
        Metric("contacts with the worker", _met_worker),
        Metric("min distance", _min_distance, "mm"),
        Metric(
            "separation violations",
            lambda run: (
                None
                if run.separation_margin is None
                else int((run.separation_margin < 0).sum())
            ),
            at_most=0,
            essential=True,
        ),
        Metric("waited for the worker", _waited, "s"),
        *HAND_OVER_METRICS,
        Metric("free for his hands while he reaches", _free_volume, "l", resolution=0.1),
        Metric("bench he reaches comfortably", _comfortable, "%"),
        Metric(
            "cycle time",
            lambda run: run.cell.time,
            "s",
            claim="the first object on its shelf after 68 s (snapshots)",
        ),
        *(
            Metric(
                f"recovered from: {mishap}",
                lambda run, mishap=mishap: _recoveries(run)[mishap] or None,
            )
            for mishap in get_args(Mishap)
        ),
        Metric(
            "objects that stand on their shelf",
            lambda run: len(_standing(run)),
            at_least=objects,
            claim="three objects, one after the other (Experiment 3)",
            essential=True,
            detail=lambda run: _all_but(run, _standing(run)),
        ),
        Metric(
            "end effector deviation",
            lambda run: (
                _off_path(run) if run.pulls else _pushed(run, lambda d: 1e3 * d.position)
            ),
            "mm",
            at_most=2.0,
            claim="main task not affected (Experiment 3)",
        ),
        Metric(
            "end effector rotation",
            lambda run: None if run.pulls else _pushed(run, lambda d: np.rad2deg(d.rotation)),
            "deg",
            at_most=0.5,
            claim="main task not affected (Experiment 3)",
        ),
        Metric(
            "elbow moved",
            lambda run: (
                _elbow_pulled(run) if run.pulls else _pushed(run, lambda d: 1e3 * d.elbow)
            ),
            "mm",
            # Enough to reach under the arm; without it the deviation above would prove nothing.
            at_least=100.0,
            claim="joint 4 dragged forward for 7 s, backward for 4 s",
        ),
        Metric("pulls", lambda run: len(_pulled(run)) or None),
        Metric(
            "pulls with room for 150 mm",
            lambda run: sum(room >= _FAR for _, room in _pulled(run)) if run.pulls else None,
        ),
        Metric(
            "pulls with room for 150 mm that moved the elbow so far",
            lambda run: (
                sum(moved >= _FAR for moved, room in _pulled(run) if room >= _FAR)
                if run.pulls
                else None
            ),
        ),
    ]


def _met_worker(run: CollaborationRun) -> int | None:
    """None of a run without a worker."""
    if run.world.config.worker is None:
        return None
    return len(worker_contacts(run.world, run.cell.log, run.motion))


def _min_distance(run: CollaborationRun) -> float | None:
    """True one of the worker from the robot and its load; None of a run without [mm]."""
    distance = worker_distance(run.motion, len(run.cell.log))
    return 1e3 * float(distance.min()) if len(distance) else None


def _waited(run: CollaborationRun) -> float | None:
    """Time that the task did not go on before him [s]; None of a run without a worker."""
    if run.visit is None:
        return None
    return float((1.0 - run.cell.log["pace"]).sum() * run.cell.config.dt)


def _free_volume(run: CollaborationRun) -> float | None:
    """Mean over the reaches [l]."""
    rooms = run.reach_spaces
    return 1e3 * float(np.mean([room.free_volume for room in rooms])) if rooms else None


def _comfortable(run: CollaborationRun) -> float | None:
    """Mean over the reaches [%]."""
    rooms = run.reach_spaces
    return 100.0 * float(np.mean([room.comfortable for room in rooms])) if rooms else None


def _off_path(run: CollaborationRun) -> float | None:
    """Largest distance of the end effector from its path in phases that pulls reached [mm]."""
    off = [1e3 * effect.hand for effect in run.pull_effects if np.isfinite(effect.hand)]
    return max(off, default=None)


def _elbow_pulled(run: CollaborationRun) -> float | None:
    """Median over the pulls at random moments [mm]."""
    moved = [moved for moved, _ in _pulled(run)]
    return 1e3 * float(np.median(moved)) if moved else None


def _pulled(run: CollaborationRun) -> list[tuple[float, float]]:
    """How far each pull at a random moment moved the elbow, and had room to [m]."""
    pulled: dict[float, tuple[float, float]] = {}
    for effect in run.pull_effects:
        moved, room = pulled.get(effect.pull.start, (0.0, effect.room))
        pulled[effect.pull.start] = max(moved, effect.elbow), room
    return list(pulled.values())


TRIAL_METRICS: Sequence[Metric[Sequence[Trial]]] = (
    Metric("trials, success rate", success_rate),
    Metric("trials, end effector deviation (95 %)", p95("end_effector_deviation_mm"), "mm"),
    Metric("trials, elbow moved (median)", median("elbow_moved_mm"), "mm"),
    Metric("trials, grasp offset (95 %)", p95("grasp_offset_mm"), "mm"),
    Metric("trials, object tilt in the hand (95 %)", p95("object_tilt_in_the_hand_deg"), "deg"),
    Metric("trials, place error (95 %)", p95("place_error_mm"), "mm"),
    Metric("trials, place tilt (95 %)", p95("place_tilt_deg"), "deg"),
    Metric("trials, cycle time (median)", median("cycle_time_s"), "s"),
    Metric("trials, min distance (median)", median("min_distance_mm"), "mm"),
)
"""Rows of the table that repetitions add."""

CURVES = {
    "end_effector_deviation_mm": "moved by the person [mm]",
    "grasp_offset_mm": "grasp offset [mm]",
    "place_error_mm": "place error [mm]",
}
"""Drawn against the size of the imperfections: labels by the keys of values."""


def _worst(run: CollaborationRun, measured: Callable[[PickPlaceJob], float]) -> float | None:
    """Over the objects that were released on a shelf; None if it never came to that."""
    grasped = [e for e in run.picks if e.release is not None and e.receipt is None]
    return max((float(measured(e)) for e in grasped), default=None)


def _pushed(run: CollaborationRun, of: Callable[[Deviation], np.ndarray]) -> float | None:
    """Largest value in a run in which a person pushed the elbow; None of any other."""
    log = run.cell.log
    if not (log["nullspace_input"] != 0).any():
        return None
    # NaN stands for the time before the first push and after the last.
    deviation = Deviation.of(log, run.motion, run.world)
    return float(np.nan_to_num(of(deviation)).max())


def _grasp_offsets(run: CollaborationRun) -> list[float]:
    """Horizontal distance of end effector and object at the last descent, each object [mm]."""
    log, offsets = run.cell.log, []
    for pick in run.picks:
        begin, end = pick.span
        descents = [t for t, _ in spans(log, "grasp") if begin <= t < end]
        if pick.release is not None and descents:
            # The last attempt: earlier ones missed the object or lost it.
            offset = grasp_offset(log, run.motion, run.world, pick.item.name, descents[-1])
            offsets.append(1e3 * offset)
    return offsets


def _holds(run: CollaborationRun) -> list[Hold]:
    """How each object hung in the hand, from the end of the lift until it was released."""
    log, holds = run.cell.log, []
    for pick in run.picks:
        carried = [s for s in spans(log, HOME) if pick.span[0] <= s[0] < pick.span[1]]
        released = [t for t, _ in spans(log, RELEASE) if pick.span[0] <= t < pick.span[1]]
        if carried and released:
            times = carried[-1][0], released[-1]
            holds.append(hold(log, run.motion, run.world, pick.item.name, *times))
    return holds


def _placed(run: CollaborationRun) -> tuple[float | None, float | None]:
    """Distance [mm] and angle [deg] of objects from how they should stand, the worst each."""
    errors, angles = [], []
    for pick in run.picks:
        if pick.release is None:
            continue
        pose = run.world.object_pose(pick.item.name)
        errors.append(np.linalg.norm(pose[:2, 3] - pick.goal.position[:2].numpy()))
        # The world's own errors of the base apart: the shelf is where it is.
        angles.append(place_angle(pose, pick.goal.orientation))
    if not errors:
        return None, None
    return 1e3 * float(max(errors)), float(np.rad2deg(max(angles)))


def _standing(run: CollaborationRun) -> list[str]:
    """Objects that stand on their shelf, touching nothing of the arm."""
    places = {pick.item.name: f"board_{pick.shelf}" for pick in run.picks}
    return [name for name, place in places.items() if run.world.rests_on(name, place)]


def _all_but(run: CollaborationRun, names: Collection[str]) -> str:
    objects = [item.name for item in run.workplace.scene.objects]
    return f"not {', '.join(name for name in objects if name not in names)}"


def _contacts(run: CollaborationRun) -> dict[str, tuple[Touch, ...]]:
    """Contacts that there should not have been, by what was met."""
    names = [pick.item.name for pick in run.picks if pick.release is not None]
    begun = [start for start, _ in spans(run.cell.log, RELEASE)]
    return unwanted_contacts(run.world, run.cell.log, dict(zip(names, begun, strict=True)))


def _recoveries(run: CollaborationRun) -> Counter[str]:
    """How often the task recovered from each kind of mishap."""
    return Counter(note.mishap for pick in run.picks for note in pick.recoveries)
