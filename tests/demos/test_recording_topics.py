"""Clocks of topics, and how gaps divide the topics of a bag into episodes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hrc_learn.demos import DatasetError
from hrc_learn.demos import recording_bags as bags
from hrc_learn.demos.recording_files import Recording, array_field
from hrc_learn.demos.recording_messages import (
    Topic,
    parts_of,
)

pytestmark = pytest.mark.simulation


def parts(message, name="arm"):
    return [(n, names, np.asarray(v).tolist()) for n, names, v in parts_of(name, message)]


def topic(stamps, received, values=None, names=None):
    values = [np.zeros(2)] * len(stamps) if values is None else values
    return Topic(names=names, received=[*received], stamps=[*stamps], values=values)


TIMES = np.arange(5) / 10


@pytest.mark.parametrize(
    ("offset", "other", "own"),
    [
        (0.0, 0.0, True),
        (0.49, 9.0, True),
        (-0.49, 9.0, True),
        (0.51, 9.0, False),
        (-0.51, 9.0, False),
        (900.0, 900.4, True),  # one clock, such as that of a simulation
        (900.0, 900.6, False),
    ],
)
def test_stamps_count_on_the_clock_of_the_recorder_or_of_all(offset, other, own):
    received = TIMES + 100
    topics = {"a": topic(received + offset, received), "b": topic(received + other, received)}
    notes = []
    times = bags._times(topics, notes)
    np.testing.assert_allclose(times["a"], received + (offset if own else 0))
    text = f"a: its stamps are {offset:.3g} s from the recorder's clock: times of reception"
    assert any(note.startswith(text) for note in notes) != own


def test_topics_without_stamps_have_times_of_reception():
    received = TIMES + 100
    notes = []
    times = bags._times({"a": topic(0 * TIMES, received)}, notes)
    np.testing.assert_allclose(times["a"], received)
    assert notes == []
    # A first stamp of zero may be the start of a simulation.
    times = bags._times({"a": topic(TIMES, TIMES + 3)}, notes)
    np.testing.assert_allclose(times["a"], TIMES)


def numbers(one, places=None, order=(), name="arm/joint_positions"):
    notes = []
    places = np.arange(len(one.values)) if places is None else places
    return bags._numbers(name, one, places, order, notes), notes


def test_joints_take_the_order_of_the_description():
    values = [np.array([1.0, 2, 3])] * 5
    one = topic(TIMES, TIMES, values, ("a", "b", "c"))
    made, _ = numbers(one, order=["x", "c", "a", "b"])
    assert made.names == ("c", "a", "b")
    assert made.numbers()[0].tolist() == [3, 1, 2]
    made, _ = numbers(one, order=["c", "a"])
    assert made.names == ("a", "b", "c")


def test_topics_that_cannot_be_used_are_noted():
    made, notes = numbers(topic(TIMES, TIMES, [np.zeros(2)] * 4 + [np.zeros(3)]))
    assert (made, notes) == (
        None, ["arm/joint_positions is left out: its messages differ in size"],
    )  # fmt: skip
    lost = topic(TIMES, TIMES, [np.array([np.nan])] * 5)
    made, notes = numbers(lost, name="force")
    assert (made, notes) == (None, ["force is left out: it holds NaN"])
    assert numbers(lost)[0] is not None
    made, notes = numbers(topic(TIMES, TIMES), np.array([0, 2, 4]))
    assert made.frames == 3
    assert notes == ["arm/joint_positions: 2 messages with repeated stamps"]
    made, notes = numbers(topic(TIMES, TIMES))
    assert notes == []


@pytest.mark.parametrize(
    ("name", "kind"), [("camera_pose", "pose"), ("tcp/pose", "number"), ("ee_pose", "number")]
)
def test_poses_of_a_tool_are_known_by_their_topic(name, kind):
    made, _ = numbers(topic(TIMES, TIMES, [np.eye(4)] * 5), name=name)
    assert made.kind == kind
    made, _ = numbers(topic(TIMES, TIMES, [np.eye(3)] * 5), name=name)
    assert made.kind == "number"


def streams(**stamps):
    """A recording of topics by their stamps; images begin with `cam`."""
    fields = {}
    for name, time in stamps.items():
        time = np.asarray(time, float)
        fields[name] = array_field(name, np.arange(len(time)) * 1.0, clock=f"{name}/stamp")
        if name.startswith("cam"):
            fields[name] = replace(fields[name], kind="image")
        if name.startswith("pose"):
            fields[name] = replace(fields[name], kind="pose")
        fields[f"{name}/stamp"] = array_field(f"{name}/stamp", time, unit="s")
    return Recording(file=Path("x.mcap"), fields=fields, streams=True)


def divided(**stamps):
    notes = []
    return bags._without_gaps(streams(**stamps), notes)


LONG = np.arange(0, 4, 0.05)


def without(start, stop, time=LONG):
    """Stamps without those in between."""
    return time[(time <= start + 1e-9) | (time >= stop - 1e-9)]


@pytest.mark.parametrize(("gap", "parts"), [(0.15, 1), (0.25, 2)])
def test_a_gap_of_more_than_a_fifth_of_a_second_divides(gap, parts):
    found = divided(q=without(1.0, 1.0 + gap))
    assert len(found) == parts
    if parts == 2:
        assert [one.label for one in found] == ["part 0", "part 1"]
        assert found[0].notes == ("q is silent for 0.25 s at 1.00 s: the bag is divided there",)
        assert found[1].notes == ()
        times = [one.fields["q/stamp"].numbers()[:, 0] for one in found]
        assert times[0][-1] == pytest.approx(1.0)
        assert times[1][0] == pytest.approx(1.25)
        assert sum(map(len, times)) == len(without(1.0, 1.25))
        assert [one.fields["q"].frames for one in found] == [*map(len, times)]


@pytest.mark.parametrize(("second", "parts"), [(1.45, 2), (1.55, 3)])
def test_parts_of_less_than_half_a_second_are_left_out(second, parts):
    time = without(second, second + 0.4, without(0.7, 1.0))
    assert len(divided(q=time)) == parts


def test_images_and_joints_are_present_together():
    (one,) = divided(q=LONG, cam=LONG[10:50])
    assert one.fields["q"].frames == len(LONG)
    found = divided(q=LONG, cam=without(1.0, 1.5, LONG[10:50]))
    times = [one.fields["q/stamp"].numbers()[:, 0] for one in found]
    np.testing.assert_allclose([(t[0], t[-1]) for t in times], [(0.5, 1.0), (1.5, 2.45)])
    with pytest.raises(DatasetError, match=r"q, cam are never present together for 0.5 s"):
        divided(q=LONG, cam=LONG + 3.6)
    with pytest.raises(DatasetError, match="no topic holds joints or poses of a tool"):
        divided(cam=LONG)


def test_another_topic_that_is_silent_is_left_out():
    (one,) = divided(arm__joint_positions=LONG, force=without(1.0, 1.5))
    assert "force" not in one.fields
    assert one.notes == ("force is left out: it is silent for 0.50 s",)
    # Silent only where the joints are, too.
    found = divided(arm__joint_positions=without(1.0, 1.5), force=without(1.1, 1.4))
    assert len(found) == 2
    assert all("force" in part.fields for part in found)
    # One message is silent before and after.
    (one,) = divided(arm__joint_positions=LONG, force=LONG[:1])
    assert "force" not in one.fields


def test_without_joints_any_pose_may_be_that_of_the_tool():
    (one,) = divided(pose=LONG)
    assert one.fields["pose"].kind == "number"
    (one,) = divided(pose=LONG, q=LONG)
    assert one.fields["pose"].kind == "pose"


@pytest.mark.parametrize(("step", "at_once"), [(1.9e-4, True), (2.1e-4, False)])
def test_messages_written_at_once_have_no_times(step, at_once):
    time = np.arange(6000) * step
    (one,) = divided(q=time)
    assert one.streams != at_once
    assert (one.fields["q"].clock == "") == at_once
    assert any("written at the same time" in note for note in one.notes) == at_once
