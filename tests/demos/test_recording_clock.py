"""Clocks and episodes of recordings that are made in memory."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hrc_learn.demos import DatasetError
from hrc_learn.demos.read.columns import ColumnSelection
from hrc_learn.demos.recording_clock import clock_of_state, read_stamps
from hrc_learn.demos.recording_files import Recording, array_field
from hrc_learn.demos.recording_meaning import Meaning
from hrc_learn.demos.recording_names import ImportOptions

pytestmark = pytest.mark.simulation

FILE = Path("data/run 1.npz")


def recording(streams=False, clocks=None, rates=None, fps=None, **arrays):
    """An episode of arrays; `clocks` names the stamps of a field."""
    fields = {}
    for name, array in arrays.items():
        array = np.asarray(array, float)
        details = {"clock": (clocks or {}).get(name, ""), "rate": (rates or {}).get(name, 0.0)}
        fields[name] = array_field(name, array, **details)
    return Recording(file=FILE, fields=fields, streams=streams, fps=fps)


def meaning(time="", cameras=None, **roles):
    selections = {
        role: ColumnSelection(role=role, columns=((name, 0),), labels=("a",))
        for role, name in roles.items()
    }
    return Meaning(selections=selections, cameras=cameras or {}, time=time)


JOINTS = {"joint_position": "q"}


def clock(one, known, **options):
    return clock_of_state(one, known, ImportOptions(**options))


STEADY = np.arange(50) / 25


@pytest.mark.parametrize(
    ("name", "stamps", "unit", "expected"),
    [
        ("t", STEADY, "", STEADY),
        ("t_ms", STEADY * 1e3, "", STEADY),
        ("t", STEADY * 1e3, "ms", STEADY),
        ("t", STEADY * 1e6, "", STEADY),  # steps of 40,000 are microseconds
        ("t", STEADY * 1e9, "", STEADY),
        ("t", 1.7e9 + STEADY, "", 1.7e9 + STEADY),
        ("t", 1.7e18 + STEADY * 1e9, "", 1.7e9 + STEADY),
        ("t", 1.7e12 + STEADY * 1e3, "", 1.7e9 + STEADY),
        # Steps from 2 Hz to 1.5 kHz.
        ("t", np.arange(9) * 0.5, "", np.arange(9) * 0.5),
        ("t", np.arange(9) / 1499, "", np.arange(9) / 1499),
        ("t", np.arange(9) * 0.7, "", np.arange(9) * 0.7e-3),
        ("t", np.arange(9) / 1501 * 1e3, "", None),
        ("t", np.arange(9) * 1.0, "", "a count of frames"),
        ("t", [0.0, 1, 2, 4, 5, 6], "", "a count of frames"),  # one frame is missing
        ("t", [0.0, 1, 2, 3, 4.5], "", np.array([0.0, 1, 2, 3, 4.5]) * 1e-3),
        ("t", np.arange(9) * 2.0, "", np.arange(9) * 2e-3),
        ("t", np.arange(9) * 0.6, "", None),
        ("t", 1.7e9 + np.arange(9), "", 1.7e9 + np.arange(9)),  # one a second, no count
        ("t", [1.7e9], "", [1.7e9]),
    ],
)
def test_the_unit_of_stamps_is_given_named_or_told_by_their_size(name, stamps, unit, expected):
    one = recording(**{name: stamps})
    if not isinstance(expected, str | None):
        np.testing.assert_allclose(read_stamps(one, name, unit), expected, rtol=1e-12)
        return
    with pytest.raises(DatasetError, match=expected or "Give the unit: --units time s"):
        read_stamps(one, name, unit)


def test_a_count_of_frames_and_stamps_in_doubt_follow_the_callers_rate_and_unit():
    q = np.arange(9.0)
    counted = recording(q=q, t=q + 1)
    found = clock(counted, meaning(time="t", **JOINTS), fps=20)
    np.testing.assert_allclose(found.time, (q + 1) / 20)
    gap = np.where(q < 5, q, q + 2)
    found = clock(recording(q=q, t=gap), meaning(time="t", **JOINTS), fps=20)
    np.testing.assert_allclose(found.time, gap / 20)
    # A camera's own stamps, one second apart, follow the unit that is given for the state's.
    slow = {"force": [1, 2], "force_t": [0, 1]}
    one = recording(q=STEADY, t=STEADY, **slow, clocks={"force": "force_t"})
    known = meaning(time="t", joint_effort="force", **JOINTS)
    with pytest.raises(DatasetError, match="force_t: steps by 1"):
        clock(one, known)
    held = clock(one, known, units={"time": "s"}).frames["force"]
    assert held.tolist() == (STEADY >= 1).astype(int).tolist()


def test_a_duration_replaces_stamps_of_all_fields_with_as_many_frames():
    one = recording(q=STEADY, force=STEADY, t=1.7e9 + STEADY)
    found = clock(one, meaning(joint_effort="force", **JOINTS), duration=10)
    np.testing.assert_allclose(found.time, np.linspace(0, 10, 50))
    assert found.frames["q"].tolist() == found.frames["force"].tolist() == [*range(50)]


def test_a_declared_unit_comes_before_that_of_the_name():
    one = recording(t_ms=STEADY)
    declared = replace(one.fields["t_ms"], unit="s")
    one = replace(one, fields={"t_ms": declared})
    np.testing.assert_allclose(read_stamps(one, "t_ms"), STEADY)
    np.testing.assert_allclose(read_stamps(one, "t_ms", "us"), STEADY * 1e-6)


@pytest.mark.parametrize(
    ("stamps", "text"),
    [
        ([0, 0.1, 0.1, 0.2], "time must increase, but goes from 0.1 to 0.1 at frame 1"),
        ([0, 0.2, 0.1, 0.3], "goes from 0.2 to 0.1 at frame 1"),
        ([0, 0.2, np.nan, 0.3], "is nan at frame 2"),
    ],
)
def test_stamps_that_stall_or_are_lost(stamps, text):
    with pytest.raises(DatasetError, match=text):
        read_stamps(recording(t=stamps), "t")


def test_states_at_a_given_rate_duration_or_that_of_the_file():
    q = np.arange(11.0)
    none = meaning(**JOINTS)
    np.testing.assert_allclose(clock(recording(q=q), none, fps=20).time, q / 20)
    np.testing.assert_allclose(clock(recording(q=q), none, duration=2).time, q / 5)
    np.testing.assert_allclose(clock(recording(q=q, fps=40), none).time, q / 40)
    np.testing.assert_allclose(clock(recording(q=q, fps=40), none, fps=20).time, q / 20)
    with pytest.raises(DatasetError, match="there are no stamps: name the field"):
        clock(recording(q=q), none)
    with pytest.raises(DatasetError, match="holds 9 stamps for 11 frames of the state"):
        clock(recording(q=q, t=STEADY[:9]), none)
    with pytest.raises(DatasetError, match="at least two frames, got 1"):
        clock(recording(q=q[:1]), none, fps=20)
    assert len(clock(recording(q=q[:2]), none, fps=20).time) == 2
    # A video of as many frames tells the rate.
    seen = meaning(cameras={"top": "video"}, **JOINTS)
    same = recording(q=q, video=q, rates={"video": 10.0})
    np.testing.assert_allclose(clock(same, seen).time, q / 10)
    with pytest.raises(DatasetError, match="there are no stamps"):
        clock(recording(q=q, video=q[:5], rates={"video": 10.0}), seen)


@pytest.mark.parametrize(
    ("gap", "step", "told"),
    [(0.49, 0.04, False), (0.51, 0.04, True), (0.9, 0.1, False), (1.1, 0.1, True)],
)
def test_jumps_of_half_a_second_and_ten_steps_are_noted(gap, step, told):
    time = np.arange(30) * step
    time[12:] += gap - step
    found = clock(recording(q=time, t=time), meaning(time="t", **JOINTS))
    np.testing.assert_allclose(found.time, time)
    text = f"run 1.npz: t jumps by {gap:.3g} s after frame 11"
    assert found.notes == ((text,) if told else ())


def test_slower_fields_hold_their_last_value():
    fast, slow = np.arange(100) / 100, np.arange(10) / 10
    one = recording(q=fast, t=fast, force=slow, force_t=slow, clocks={"force": "force_t"})
    found = clock(one, meaning(time="t", joint_effort="force", **JOINTS))
    expected = [np.flatnonzero(slow <= t + 1e-9)[-1] for t in fast]
    assert found.frames["force"].tolist() == expected
    assert found.frames["q"].tolist() == [*range(100)]
    assert found.notes == ()
    # A value counts for three of its periods, or 0.2 s.
    late = np.r_[slow[:4], slow[8:]]
    for stamps, fault in ((late, "is silent for too long at 0.61 s"), (slow[:7] - 0.001, None)):
        one = recording(q=fast, t=fast, force=stamps, s=stamps, clocks={"force": "s"})
        known = meaning(time="t", joint_effort="force", **JOINTS)
        if fault:
            with pytest.raises(DatasetError, match=fault):
                clock(one, known)
        else:
            found = clock(one, known)
            assert len(found.time) == 90
            assert found.notes == ("run 1.npz: 10 frames without force are cut at the ends",)


def test_frames_before_a_field_speaks_are_cut():
    fast = np.arange(100) / 100
    one = recording(q=fast, t=fast, f=fast[:60], s=fast[:60] + 0.3, clocks={"f": "s"})
    found = clock(one, meaning(time="t", joint_effort="f", **JOINTS))
    np.testing.assert_allclose(found.time, fast[30:])
    assert found.frames["f"][[0, -1]].tolist() == [0, 59]
    assert "30 frames without f are cut" in found.notes[0]
    late = recording(q=fast, t=fast, f=fast[:60], s=fast[:60] + 0.98, clocks={"f": "s"})
    assert len(clock(late, meaning(time="t", joint_effort="f", **JOINTS)).time) == 2
    late = recording(q=fast, t=fast, f=fast[:60], s=fast[:60] + 0.99, clocks={"f": "s"})
    with pytest.raises(DatasetError, match="the clocks of f and of the state do not overlap"):
        clock(late, meaning(time="t", joint_effort="f", **JOINTS))


@pytest.mark.parametrize("frames", [10, 11, 9, 12, 8])
def test_a_field_without_stamps_may_lack_one_frame(frames):
    q = np.arange(10.0)
    one = recording(q=q, u=np.arange(float(frames)))
    known = meaning(command_position="u", **JOINTS)
    if abs(frames - 10) > 1:
        text = f"has {frames} frames, but the state 10; without stamps"
        with pytest.raises(DatasetError, match=text):
            clock(one, known, fps=10)
        return
    found = clock(one, known, fps=10)
    assert found.frames["u"].tolist() == [min(k, frames - 1) for k in range(10)]


@pytest.mark.parametrize(
    ("frames", "rate", "fits"),
    [(20, 10.0, True), (25, 10.0, True), (27, 10.0, False), (13, 10.0, False)],
)
def test_a_video_lasts_as_long_as_the_states(frames, rate, fits):
    """States of 2 s: half a second and 5 % may be missing."""
    time = np.arange(41) / 20
    one = recording(q=time, t=time, video=np.arange(frames), rates={"video": rate})
    known = meaning(time="t", cameras={"top": "video"}, **JOINTS)
    if not fits:
        with pytest.raises(DatasetError, match=rf"lasts {frames / 10:.1f} s, the states 2.0 s"):
            clock(one, known)
        return
    found = clock(one, known)
    expected = np.minimum(np.floor(time * 10 + 1e-6), frames - 1)[: len(found.time)]
    assert found.frames["video"].tolist() == expected.tolist()


def streams(rate=100, images=20, seconds=1.0):
    state = np.arange(0, seconds, 1 / rate) + 5
    seen = np.arange(0.002, seconds, 1 / images) + 5
    return recording(
        True,
        {"q": "qt", "rgb": "it", "two": "tt"},
        q=state,
        qt=state,
        rgb=seen,
        it=seen,
        two=seen[::2],
        tt=seen[::2],
    )


def test_states_of_topics_are_thinned_to_the_fastest_camera():
    one = streams()
    seen = meaning(time="qt", cameras={"slow": "two", "top": "rgb"}, **JOINTS)
    found = clock(one, seen)
    state, images = one.fields["qt"].numbers()[:, 0], one.fields["it"].numbers()[:, 0]
    first = [state[state >= t - 1e-6][0] for t in images]
    np.testing.assert_allclose(found.time, first)
    assert found.frames["rgb"].tolist() == [*range(len(images))]
    text = "states at 100 Hz are thinned: the first state after each image of top"
    assert found.notes[-1].endswith(text)
    for rate, thinned in ((32, True), (28, False)):
        found = clock(streams(rate=rate), seen)
        assert any("thinned" in note for note in found.notes) == thinned
    assert clock(streams(), meaning(time="qt", **JOINTS)).notes == ()


@pytest.mark.parametrize("fps", [10, 25, 50])
def test_states_of_topics_are_thinned_to_a_wanted_rate(fps):
    found = clock(streams(), meaning(time="qt", **JOINTS), fps=fps)
    np.testing.assert_allclose(found.time, 5 + np.arange(fps) / fps, atol=1e-9)
    text = f"states at 100 Hz are thinned: the first state at or after each tick of {fps} Hz"
    assert found.notes[-1].endswith(text)
    # Another rate than that of the states repeats none.
    found = clock(streams(), meaning(time="qt", **JOINTS), fps=150)
    assert len(found.time) == 100
    assert (np.diff(found.time) > 0).all()


def test_the_label_of_a_recording_is_in_its_notes():
    time = np.arange(20) / 10
    time[10:] += 5
    one = replace(recording(q=time, t=time), label="demo_3")
    (note,) = clock(one, meaning(time="t", **JOINTS)).notes
    assert note.startswith("run 1.npz demo_3: t jumps")
    (note,) = clock(replace(one, label=""), meaning(time="t", **JOINTS)).notes
    assert note.startswith("run 1.npz: t jumps")
