"""Recordings and films of runs: what is drawn at a step, at which times, under which words."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from sample_runs import sample_run
from unchecked import shapes_unchecked

from hrc_learn.experiments import run_recorder
from hrc_learn.experiments.run_recorder import (
    _drawn_in,
    _matching_demonstration,
    _polyline,
    _worker_fields,
    caption,
    demonstrated_joints,
    push_arrows,
    region_of_vision,
)
from hrc_learn.kinematics import panda
from hrc_learn.log import Event, StepLog
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.visual_servoing import VisualServoConfig
from hrc_learn.viz import palette


@pytest.fixture(scope="module")
def run():
    return sample_run()


def drawn(run, step):
    """Lines of each colour, and the words of the legend."""
    lines, labels = _drawn_in(run, step)
    found: dict[str, list] = {}
    for line in lines:
        red, green, blue, opacity = line.colour
        assert opacity == 1.0
        colour = "#" + "".join(f"{round(255 * part):02X}" for part in (red, green, blue))
        found.setdefault(colour, []).append(line)
    return found, dict(labels)


@pytest.mark.parametrize("phase", ["home", "transfer", "release", "retreat", "servo", ""])
def test_the_plan_is_drawn_while_an_object_is_carried_else_the_region(run, phase):
    events = (Event(0.0, phase), Event(3.0, "later")) if phase else ()
    lines, labels = drawn(replace(run, phases=events), 100)
    carrying = phase in ("home", "transfer", "release", "retreat")
    assert ("learned motion, planned" in labels) == carrying
    assert ("region of visual servoing" in labels) == (not carrying)
    if carrying:
        path = lines[palette.GREEN.upper()]
        np.testing.assert_allclose(path[0].start, run.plan_path[0])
        np.testing.assert_allclose(path[-1].end, run.plan_path[-1])
        assert len(path) == 59
    else:
        edges = lines[palette.YELLOW.upper()]
        assert len(edges) == 12
        assert {edge.width for edge in edges} == {0.004}
    bare = replace(run, plan_path=None, region=None, phases=events)
    assert not {"learned motion, planned", "region of visual servoing"} & {*drawn(bare, 100)[1]}


@pytest.mark.parametrize(("step", "first"), [(0, 0), (50, 0), (100, 0), (150, 50), (199, 99)])
def test_the_path_of_the_last_two_seconds_is_drawn(run, step, first):
    lines, labels = drawn(run, step)
    assert labels["path of the gripper"] == palette.BLUE
    trail = lines.get(palette.BLUE.upper(), [])
    assert bool(trail) == (step > 0)
    if trail:
        np.testing.assert_allclose(trail[0].start, run.position[first])
        np.testing.assert_allclose(trail[-1].end, run.position[step])


@pytest.mark.parametrize(
    ("step", "pushes"), [(79, False), (80, True), (119, True), (120, False)]
)
def test_a_push_is_a_forearm_with_an_arrow_above_it(run, step, pushes):
    lines, labels = drawn(run, step)
    assert ("a person pulls the elbow" in labels) == pushes
    if pushes:
        at, tip = run.push[step]
        (forearm,) = lines[palette.PERSON.upper()]
        (arrow,) = (line for line in lines[palette.VERMILION.upper()] if line.head)
        np.testing.assert_allclose((forearm.start, forearm.end), (at, tip))
        above = np.array([0.0, 0.0, 0.15])
        np.testing.assert_allclose((arrow.start, arrow.end), (at + above, tip + above))
        assert (forearm.width, arrow.width) == (0.04, 0.02)


@pytest.mark.parametrize(
    ("distance", "words"), [(0.999, "1.00 m"), (0.346, "0.35 m"), (1.001, ""), (np.nan, "")]
)
def test_a_worker_nearer_than_a_metre_is_joined_to_the_arm(run, distance, words):
    nearest = np.zeros((200, 2, 3))
    nearest[:, 0] = (0.1, 0.2, 0.3)
    nearest[:, 1] = (0.1, 0.2 + distance, 0.3)
    lines, labels = drawn(replace(run, worker_nearest=nearest), 10)
    found = [label for label in labels if "worker" in label]
    assert found == ([f"distance to the worker: {words}"] if words else [])
    if words:
        (gap,) = lines[palette.PURPLE.upper()]
        np.testing.assert_allclose((gap.start, gap.end), nearest[10])
        assert gap.width == 0.01


@pytest.mark.parametrize(("count", "lines"), [(1, 0), (2, 1), (60, 59), (61, 59), (5000, 59)])
def test_a_path_is_drawn_by_60_points_at_most(count, lines):
    points = np.arange(3.0 * count).reshape(count, 3)
    made = _polyline(points, palette.RUN)
    assert len(made) == lines
    for one, other in pairwise(made):
        np.testing.assert_array_equal(one.end, other.start)
    if count > 2:
        np.testing.assert_array_equal(made[-1].end, points[-1])
        gap = points.copy()
        gap[0] = np.nan
        assert len(_polyline(gap, palette.RUN)) == lines - 1


@pytest.mark.parametrize(
    ("time", "text"), [(0.5, "Sample"), (1.0, "Hold it"), (1.9, "Hold it"), (2.0, None)]
)
def test_a_caption_is_that_of_the_phase_begun_last(run, time, text):
    phases = (Event(1.0, "hold it"), Event(2.0, "servo"))
    found = caption(replace(run, phases=phases, title="Sample"), time)
    if text is None:
        # A phase that the tasks have is told in a sentence.
        assert found not in ("servo", "Servo")
        assert len(found) > 10
    else:
        assert found == text


class Painter:
    """Pictures that are painted, with what is written on them."""

    def __init__(self, monkeypatch):
        self.painted, self.written = [], []
        monkeypatch.setattr(run_recorder, "_painter", lambda recording, camera: self)
        monkeypatch.setattr(
            run_recorder, "annotated", lambda *given: self.written.append(given) or len(given)
        )
        monkeypatch.setattr(run_recorder, "_drawn_in", lambda run, step: ([step], ["legend"]))
        monkeypatch.setattr(
            run_recorder,
            "camera_inset",
            lambda camera, width: lambda step, time: ("inset", step, time),
        )

    def __enter__(self):
        return lambda step, lines: self.painted.append((step, lines)) or f"picture {step}"

    def __exit__(self, *error):
        pass


def stretched(run, seconds):
    """The same run in another time."""
    return replace(run, time=np.linspace(5.0, 5.0 + seconds, 200))


@pytest.mark.parametrize(
    ("seconds", "pictures", "speed"),
    [
        (4.0, 60, ""),
        (16.0, 240, ""),
        (16.7, 240, ""),
        (17.6, 240, "   1.1 \u00d7"),
        (64.0, 240, "   4.0 \u00d7"),
    ],
)
def test_a_long_run_is_shown_faster(run, monkeypatch, seconds, pictures, speed):
    painter = Painter(monkeypatch)
    recording = stretched(run, seconds)
    assert len([*run_recorder.frames(recording)]) == pictures
    steps = [step for step, _ in painter.painted]
    assert (steps[0], steps[-1]) == (0, 199)
    times = np.linspace(5.0, 5.0 + seconds, pictures)
    expected = np.minimum(np.searchsorted(recording.time, times), 199)
    np.testing.assert_array_equal(steps, expected)
    picture, _, clock, labels, inset = painter.written[-1]
    assert picture == "picture 199"
    assert clock == f"{seconds:.0f} s{speed}"
    assert (labels, inset) == (["legend"], ("inset", 199, 5.0 + seconds))
    assert painter.written[0][2] == f"0 s{speed}"
    assert painter.painted[3] == (steps[3], [steps[3]])


@pytest.mark.parametrize("camera", ["none", "without images"])
def test_a_film_of_a_moment_has_two_pictures_and_no_inset(run, monkeypatch, camera):
    painter = Painter(monkeypatch)
    bare = replace(run.camera, images=(), image_time=np.empty(0))
    recording = replace(run, time=np.full(200, 3.0), camera=None if camera == "none" else bare)
    with shapes_unchecked():
        assert len([*run_recorder.frames(recording)]) == 2
    assert painter.written[0][2] == "0 s"
    assert painter.written[0][4] is None


def test_the_box_of_vision_is_above_the_table():
    workplace, servo = Workplace(), VisualServoConfig()
    box = region_of_vision(workplace, servo)
    np.testing.assert_allclose(box.centre, workplace.hover().position)
    assert box.half_size == servo.half_size


def test_pushes_below_half_a_newton_metre_and_at_short_arms_have_no_arrow():
    q = np.tile(panda.ready.numpy(), (4, 1))
    d = np.zeros((4, 7))
    d[:, 1] = (0.0, 0.5, 0.51, -0.51)
    shown = np.isfinite(push_arrows(panda, q, d)).all(axis=(1, 2))
    assert shown.tolist() == [False, False, True, True]
    short: Any = SimpleNamespace(joint_names=("a", "b", "c"))
    with shapes_unchecked():
        assert np.isnan(push_arrows(short, q[:, :3], 10 + d[:, :3])).all()


class Demo:
    time = np.array([2.0, 3.0, 6.0])
    duration = 4.0
    joint_position = np.array([[0.0, 1.0], [1.0, 1.0], [4.0, -1.0]])


def test_demonstrated_joints_are_read_at_fractions_of_the_motion():
    with shapes_unchecked():
        demo: Any = Demo()
        found = demonstrated_joints(demo, np.array([0.0, 0.25, 0.625, 1.0]))
    np.testing.assert_allclose(found, [[0, 1], [1, 1], [2.5, 0], [4, -1]])


def transfers(demonstration=True, plans=2):
    log = StepLog()
    log.event(0.0, "home")
    log.event(1.0, "transfer")
    log.event(3.0, "release")
    log.event(4.0, "transfer")
    for k in range(13):
        log.append(time=0.5 * k, joint_position=np.zeros(2))
    made: Any = [SimpleNamespace(duration=2.0), SimpleNamespace(duration=4.0)][:plans]
    demo: Any = Demo() if demonstration else None
    with shapes_unchecked():
        return _matching_demonstration(log, made, demo)


def test_each_transfer_is_compared_with_the_demonstration_at_its_own_pace():
    found = transfers()
    known = np.isfinite(found).all(axis=1)
    # From 1 s until before 3 s, and from 4 s on.
    assert np.flatnonzero(known).tolist() == [2, 3, 4, 5, 8, 9, 10, 11, 12]
    # A quarter of the motion every half second, then an eighth.
    np.testing.assert_allclose(found[2:6, 0], (0.0, 1.0, 2.0, 3.0))
    np.testing.assert_allclose(found[8:, 0], (0.0, 0.5, 1.0, 1.5, 2.0))
    one = np.isfinite(transfers(plans=1)).all(axis=1)
    assert np.flatnonzero(one).tolist() == [2, 3, 4, 5]
    assert transfers(demonstration=False) is None
    assert transfers(plans=0) is None


@pytest.mark.parametrize("tracked", [True, False])
def test_distances_of_a_worker_are_true_seen_and_protective(monkeypatch, tracked):
    monkeypatch.setattr(run_recorder, "worker_distance", lambda motion, steps: "true distance")
    pairs = [SimpleNamespace(points=np.full((2, 3), k)) for k in range(3)]

    class Log(dict):
        def __len__(self):
            return 3

    log: Any = Log(person_distance="seen", protective_distance="kept") if tracked else Log()
    motion: Any = SimpleNamespace(nearest=lambda steps: pairs[:steps])
    with shapes_unchecked():
        found = _worker_fields(motion, log)
        motion.nearest = lambda steps: ()
        assert _worker_fields(motion, log) == {}
    distance = {"true": "true distance"}
    if tracked:
        distance |= {"seen by the robot": "seen", "protective distance": "kept"}
    assert found["worker_distance"] == distance
    assert found["worker_nearest"].shape == (3, 2, 3)
