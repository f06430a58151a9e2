"""Clocks and episodes of recordings that are made in memory."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hrc_learn.demos import DatasetError
from hrc_learn.demos.read.columns import ColumnSelection
from hrc_learn.demos.recording_clock import clock_of_state, read_stamps
from hrc_learn.demos.recording_files import (
    Field,
    Recording,
    StreamRead,
    array_field,
    is_encoded,
    is_time,
    longest_hold,
    make_field,
    natural,
    split_episodes,
    time_unit_in,
    unit_in_words,
)
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
        ("t", np.arange(9) * 2.0, "", np.arange(9) * 2e-3),
        ("t", np.arange(9) * 0.6, "", None),
    ],
)
def test_the_unit_of_stamps_is_given_named_or_told_by_their_size(name, stamps, unit, expected):
    one = recording(**{name: stamps})
    if isinstance(expected, np.ndarray):
        np.testing.assert_allclose(read_stamps(one, name, unit), expected, rtol=1e-12)
        return
    with pytest.raises(DatasetError, match=expected or "Give the unit: --units time s"):
        read_stamps(one, name, unit)


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
        text = f"it has {frames}, the state 10, and no stamps are its own"
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
    text = f"states at 100 Hz are thinned: the first state from each tick of {fps} Hz on"
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


def test_values_are_held_for_three_periods_or_a_fifth_of_a_second():
    assert longest_hold(np.arange(5) * 0.1) == pytest.approx(0.3)
    assert longest_hold(np.arange(5) * 0.05) == 0.2
    assert longest_hold(np.zeros(1)) == 0.2
    assert longest_hold(np.array([0, 1.0])) == 3


@pytest.mark.parametrize(
    ("name", "is_stamp", "unit"),
    [
        ("time", True, ""),
        ("a/Time_Stamp", True, ""),
        ("t_ms", True, "ms"),
        ("time [nsec]", True, "ns"),
        ("Time (seconds)", True, "s"),
        ("cycle_time", False, ""),
        ("execution_time", False, ""),
        ("temperature", False, ""),
    ],
)
def test_names_of_stamps(name, is_stamp, unit):
    assert is_time(name, array_field(name, np.zeros((4, 1)))) == is_stamp
    assert not is_time(name, array_field(name, np.zeros((4, 2))))
    assert not is_time(name, array_field(name, np.array(["x", "y"])))
    if is_stamp:
        assert time_unit_in(name) == unit


@pytest.mark.parametrize(
    ("unit", "known"),
    [("Degree", "deg"), ("nm", "N m"), ("rad", "rad"), ("meter", "m"), ("furlong", "furlong"),
     ("percent", "%"), ("", ""), (" mm ", "mm"), ("N m", "N m")],
)  # fmt: skip
def test_units_in_the_words_of_files(unit, known):
    assert unit_in_words(unit) == known


def read_zeros(shape, dtype):
    return lambda start, stop: np.zeros(shape, dtype)[start:stop]


@pytest.mark.parametrize(
    ("name", "shape", "dtype", "kind"),
    [
        ("rgb", (5, 16, 16, 3), "uint8", "image"),
        ("rgb", (5, 15, 16, 3), "uint8", "other"),
        ("rgb", (5, 16, 15, 1), "uint8", "other"),
        ("rgb", (5, 3, 16, 20), "uint8", "image"),
        ("rgb", (5, 16, 20, 4), "float32", "image"),
        ("rgb", (5, 3, 15, 20), "uint8", "other"),
        ("mono", (5, 16, 16), "uint8", "image"),
        ("mono", (5, 16, 16), "float32", "other"),
        ("mono", (5, 20), "uint8", "number"),
        ("my_Depth", (5, 16, 16), "float32", "depth"),
        ("my_Depth", (5, 15, 16), "float32", "other"),
        ("pose", (5, 4, 4), "float32", "number"),
        ("pose", (5, 3, 3), "float32", "number"),
        ("pose", (5, 2, 3), "float32", "other"),
        ("q", (5, 7), "int32", "number"),
        ("q", (5,), "bool", "number"),
        ("q", (5, 7), "complex128", "other"),
        ("q", (5,), "U4", "text"),
        ("jpg", (5, 64), "uint8", "number"),
    ],
)
def test_kinds_of_arrays(name, shape, dtype, kind):
    made = make_field(name, shape, np.dtype(dtype), read_zeros(shape, dtype))
    assert made.kind == kind
    assert made.frames == 5


JPEG = b"\xff\xd8\xff" + bytes(80)


def test_bytes_of_image_files_are_known_by_their_beginning():
    assert is_encoded(JPEG)
    assert is_encoded(b"\x89PNG....")
    assert not is_encoded(b"GIF89a")
    rows = np.frombuffer(JPEG * 3, np.uint8).reshape(3, -1)
    assert array_field("x", rows).kind == "encoded"
    assert array_field("x", rows[:, :65]).kind == "encoded"
    assert array_field("x", rows[:, :64]).kind == "number"
    objects = np.empty(2, object)
    objects[:] = [JPEG, JPEG]
    assert array_field("x", objects).kind == "encoded"
    objects[0] = b"hello"
    assert array_field("x", objects).kind == "text"


def test_transforms_of_three_rows_get_a_fourth():
    upper = np.random.default_rng(0).normal(size=(5, 3, 4))
    made = array_field("pose", upper)
    assert (made.shape, made.width) == ((5, 4, 4), 16)
    whole = made.read(1, 4)
    np.testing.assert_array_equal(whole[:, :3], upper[1:4])
    np.testing.assert_array_equal(whole[:, 3], np.tile([0, 0, 0, 1], (3, 1)))


def test_a_part_of_a_field_ends_with_it():
    part = array_field("q", np.arange(10.0)).part(3, 7)
    assert part.shape == (4,)
    assert part.read(0, 4).tolist() == [3, 4, 5, 6]
    assert part.read(1, 99).tolist() == [4, 5, 6]
    assert part.numbers().shape == (4, 1)


def test_a_stream_goes_on_where_it_stopped_and_is_opened_anew_to_go_back():
    opened = []

    def images(start):
        opened.append(start)
        yield from range(start, 1000)

    read = StreamRead(images)
    for start, stop, opens in (
        (0, 3, [0]),
        (3, 5, [0]),
        (9, 10, [0]),
        (110, 111, [0]),  # a hundred are passed over
        (212, 213, [0, 212]),
        (212, 213, [0, 212, 212]),
        (5, 7, [0, 212, 212, 5]),
    ):
        assert read(start, stop).tolist() == [*range(start, stop)]
        assert opened == opens


def test_names_are_sorted_by_their_numbers():
    names = ["demo_10", "demo_2", "demo_2b", "demo", "ep_3"]
    assert sorted(names, key=natural) == ["demo", "demo_2", "demo_2b", "demo_10", "ep_3"]
    assert sorted(["10", "2", "x"], key=natural) == ["2", "10", "x"]


def parts(**arrays):
    fields = {n.replace("__", "/"): array_field(n, np.asarray(a)) for n, a in arrays.items()}
    return [
        (
            one.label,
            {name: each.numbers().ravel().tolist() for name, each in one.fields.items()},
        )
        for one in split_episodes(FILE, fields)
    ]


Q = np.arange(6.0)


@pytest.mark.parametrize(
    ("extra", "ends"),
    [
        ({"episode_ends": np.array([2, 6])}, [2, 6]),
        ({"meta__traj_ends": np.array([2, 3, 6])}, [2, 3, 6]),
        ({"episode": np.array([0, 0, 1, 1, 1, 1])}, [2, 6]),
        ({"demo_id": np.array([4, 4, 4, 0, 0, 7])}, [3, 5, 6]),
        ({"terminals": np.array([0, 1, 0, 0, 0, 0])}, [2, 6]),
        ({"terminals": np.array([0, 1, 0, 0, 0, 1])}, [2, 6]),
        ({"dones": [0, 0, 0, 0, 0, 1], "timeouts": [0, 0, 1, 0, 0, 0]}, [3, 6]),
    ],
)
def test_episodes_end_where_the_file_says(extra, ends):
    found = parts(q=Q, **extra)
    assert [one["q"] for _, one in found] == [
        Q[a:b].tolist() for a, b in zip([0, *ends[:-1]], ends, strict=True)
    ]
    assert [label for label, _ in found] == [f"episode {k}" for k in range(len(ends))]


def test_a_single_episode_has_no_label():
    assert [label for label, _ in parts(q=Q, terminals=np.zeros(6))] == [""]
    # Flags of two lengths tell nothing, nor do vectors.
    assert len(parts(q=Q, terminals=[0, 1, 0, 0, 0, 0], dones=[0, 1])) == 1
    assert len(parts(q=Q, terminals=np.eye(6))) == 1
    # Arrays that end before the last episode hold for none of them.
    found = parts(q=Q, short=Q[:5], episode_ends=np.array([2, 6]))
    assert [*found[0][1]] == ["q"]


@pytest.mark.parametrize(
    ("extra", "text"),
    [
        ({"episode_ends": np.array([4, 2])}, "must increase up to the 6 frames there are, got"),
        ({"episode_ends": np.array([0, 6])}, "must increase"),
        ({"episode_ends": np.array([2, 7])}, "must increase"),
        ({"episode_ends": np.zeros(0, int)}, "must increase"),
        ({"episode": [0, 0, 1, 1, 0, 0]}, "comes back to earlier ones"),
    ],
)
def test_ends_that_do_not_increase(extra, text):
    with pytest.raises(DatasetError, match=text):
        parts(q=Q, **extra)


def test_arrays_of_three_axes_hold_one_demonstration_each():
    stacked = np.arange(24.0).reshape(2, 4, 3)
    one = np.arange(8.0).reshape(1, 4, 2)
    found = parts(q=stacked, shape=one, note=Q)
    assert [label for label, _ in found] == ["episode 0", "episode 1"]
    for k, (_, fields) in enumerate(found):
        assert fields["q"] == stacked[k].ravel().tolist()
        assert fields["shape"] == one[0].ravel().tolist()
        assert fields["note"] == Q.tolist()
    with pytest.raises(DatasetError, match="holds 2 demonstrations, other arrays hold 3"):
        parts(q=stacked, other=np.zeros((3, 4, 3)))


def test_groups_that_count_are_episodes():
    found = parts(demo_10__q=Q, demo_2__q=Q + 1, demo_2__u=Q)
    assert [label for label, _ in found] == ["demo_2", "demo_10"]
    assert [*found[0][1]] == ["q", "u"]
    (one,) = parts(data__traj_0__q=Q)
    assert one[0] == "data/traj_0"
    # One group alone is an episode if it is named as one.
    assert [label for label, _ in parts(arm0__q=Q)] == [""]
    assert [label for label, _ in parts(arm0__q=Q, arm1__q=Q)] == ["arm0", "arm1"]
    assert [label for label, _ in parts(arm0__q=Q, arm1__u=Q)] == [""]
    assert [label for label, _ in parts(arm0__q=Q, leg1__q=Q)] == [""]


def test_arrays_that_count_are_episodes_if_all_do():
    pair = np.stack([Q, Q], axis=1)
    found = parts(states_0=pair, actions_0=pair, states_1=pair + 1, actions_1=pair)
    assert [(label, sorted(one)) for label, one in found] == [
        ("0", ["actions", "states"]),
        ("1", ["actions", "states"]),
    ]
    assert found[1][1]["states"][:2] == [1, 1]
    assert len(parts(states_0=pair, actions_0=pair, states_1=pair)) == 1
    assert len(parts(states_0=pair, states_1=pair)) == 1
    one = pair[:, :1]
    assert len(parts(states_0=one, actions_0=one, states_1=one, actions_1=one)) == 1


def fields(*names, frames=6):
    return {n: array_field(n, np.zeros(f)) for n, f in ((n, frames) for n in names)}


@pytest.mark.parametrize(
    ("names", "of", "preferred", "clock"),
    [
        (("q", "t"), "q", "", "t"),
        (("a/q", "a/time", "b/time"), "a/q", "", "a/time"),
        (("a/q", "a/time", "time"), "a/q", "", "a/time"),
        (("a/q", "b/time", "time"), "a/q", "", "time"),
        (("a/q", "b/time", "b/stamps"), "a/q", "b/stamps", "b/stamps"),
        (("force_x", "force_time", "t"), "force_x", "", "force_time"),
        (("actual_q", "actual_time", "t"), "actual_q", "", "t"),
        (("q", "delay_time"), "q", "", ""),
        (("t",), "t", "", ""),
    ],
)
def test_stamps_nearest_to_a_field_by_their_name(names, of, preferred, clock):
    one = Recording(file=FILE, fields=fields(*names))
    assert one.clock_of(of, preferred) == clock
    assert replace(one, fields={**one.fields, **fields(of, frames=5)}).clock_of(of) == ""
    own = replace(one.fields[of], clock="mine")
    assert replace(one, fields={**one.fields, of: own}).clock_of(of) == "mine"


def test_errors_name_the_episode_and_the_field():
    one = Recording(file=FILE, label="demo_1", fields={})
    assert one.error("is lost", "q").key == "demo_1/q"
    assert one.error("is lost").key == "demo_1"
    assert replace(one, label="").error("is lost").key is None
    assert isinstance(array_field("q", Q), Field)
