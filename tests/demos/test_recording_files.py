"""Fields of a recording, with their kinds, clocks and units, and its episodes."""

from pathlib import Path

import numpy as np
import pytest

from hrc_learn.demos.issues import DatasetError
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

JPEG, PNG = b"\xff\xd8\xff\xe0 and more", b"\x89PNG\r\n\x1a\n"
ROWS = np.frombuffer(JPEG.ljust(65, b"0"), np.uint8)[None].repeat(5, 0)


@pytest.mark.parametrize(
    ("name", "shape", "dtype", "kind"),
    [
        ("q", (5,), float, "number"),
        ("q", (5, 7), np.float32, "number"),
        ("q", (5, 7), bool, "number"),
        ("q", (5, 7), np.int16, "number"),
        ("q", (5, 70), np.uint8, "number"),
        ("depth", (20, 20), np.uint8, "number"),
        ("rotation", (5, 3, 3), float, "number"),
        ("pose", (5, 4, 4), float, "number"),
        ("demos", (5, 4, 3), float, "other"),
        ("demos", (5, 2, 3), float, "other"),
        ("demos", (5, 20, 30), float, "other"),
        ("grey", (5, 16, 16), np.uint8, "image"),
        ("grey", (5, 16, 15), np.uint8, "other"),
        ("grey", (5, 15, 16), np.uint8, "other"),
        ("grey", (5, 16, 16), np.uint16, "depth"),  # 16 bits, as depth cameras have
        ("colour", (5, 16, 20, 3), np.uint16, "depth"),
        ("colour", (5, 16, 20, 3), np.uint8, "image"),
        ("colour", (5, 16, 20, 3), float, "image"),
        ("colour", (5, 15, 20, 3), np.uint8, "other"),
        ("colour", (5, 20, 15, 3), np.uint8, "other"),
        ("colour", (5, 3, 16, 20), np.uint8, "image"),
        ("colour", (5, 3, 16, 15), np.uint8, "other"),
        ("colour", (5, 16, 20, 1), np.uint8, "image"),
        ("colour", (5, 16, 20, 4), np.uint8, "image"),
        ("colour", (5, 16, 20, 2), np.uint8, "other"),
        ("several", (5, 2, 16, 20, 3), np.uint8, "other"),
        ("Depth_front", (5, 16, 16), np.uint16, "depth"),
        ("Depth_front", (5, 16, 16, 1), float, "depth"),
        ("Depth_front", (5, 16, 15), np.uint16, "other"),
        ("Depth_front", (5, 7), float, "number"),
        ("name", (5,), "U3", "text"),
        ("name", (5,), "S3", "text"),
        ("name", (5,), np.dtypes.StringDType(), "text"),
        ("day", (5,), "M8[s]", "other"),
        ("wave", (5, 2), complex, "other"),
    ],
)
def test_the_kind_of_an_array_follows_from_its_name_shape_and_type(name, shape, dtype, kind):
    field = array_field(name, np.zeros(shape, dtype), unit="m", rate=5.0)
    assert (field.kind, field.shape, field.unit, field.rate) == (kind, shape, "m", 5.0)
    assert field.frames == shape[0]
    assert field.width == np.prod(shape[1:])


@pytest.mark.parametrize(
    ("array", "kind"),
    [
        (np.array([JPEG, PNG], object), "encoded"),
        (np.array([b"pour", JPEG], object), "text"),
        (np.array(["pour", "stir"], object), "text"),
        (ROWS, "encoded"),
        (ROWS[:, :64], "number"),
        (ROWS.astype(np.uint16), "number"),
        (ROWS[:, ::-1], "number"),
    ],
)
def test_images_are_known_by_their_first_bytes(array, kind):
    assert array_field("x", array).kind == kind


def test_text_has_one_component_a_frame():
    assert array_field("x", np.array([["a", "b"]] * 3)).shape == (3,)


@pytest.mark.parametrize(
    ("content", "known"),
    [
        (JPEG, True),
        (PNG, True),
        (np.frombuffer(JPEG, np.uint8), True),
        (np.frombuffer(PNG, np.uint8)[None], True),
        (b"\xff\xd8", False),
        (b"", False),
        (b"GIF89a", False),
        (b" " + JPEG, False),
    ],
)
def test_bytes_of_jpeg_and_png(content, known):
    assert is_encoded(content) == known


def test_the_last_row_of_a_transform_is_added():
    upper = np.random.default_rng(0).normal(size=(6, 3, 4))
    field = array_field("pose", upper)
    assert (field.kind, field.shape) == ("number", (6, 4, 4))
    whole = field.read(1, 4)
    np.testing.assert_array_equal(whole[:, :3], upper[1:4])
    np.testing.assert_array_equal(whole[:, 3], [[0, 0, 0, 1]] * 3)
    assert field.numbers().shape == (6, 16)


def test_a_part_reads_its_own_frames_only():
    values = np.arange(20).reshape(10, 2)
    part = array_field("x", values).part(3, 8)
    assert (part.frames, part.width, part.kind) == (5, 2, "number")
    np.testing.assert_array_equal(part.read(1, 3), values[4:6])
    np.testing.assert_array_equal(part.read(0, 99), values[3:8])
    np.testing.assert_array_equal(part.part(1, 4).read(1, 9), values[5:7])
    np.testing.assert_array_equal(part.numbers(), values[3:8])
    assert part.numbers().dtype == float


@pytest.mark.parametrize(
    ("stamps", "seconds"),
    [([], 0.2), ([4.0], 0.2), ([0, 0.05, 0.1], 0.2), ([0, 0.1, 0.2, 5], 0.3), ([0, 2], 6.0)],
)
def test_a_value_holds_for_three_periods_or_a_fifth_of_a_second(stamps, seconds):
    assert longest_hold(np.array(stamps, float)) == pytest.approx(seconds)


@pytest.mark.parametrize(
    ("declared", "unit"),
    [
        (" Sec ", "s"),
        ("NSEC", "ns"),
        ("msec", "ms"),
        ("usec", "us"),
        ("Nm", "N m"),
        ("N*m", "N m"),
        ("radian", "rad"),
        ("degree", "deg"),
        ("Percent", "%"),
        ("metre", "m"),
        ("mm", "mm"),
        ("deg/s", "deg/s"),
        ("furlong", "furlong"),
        ("m per s", "m per s"),
        ("", ""),
    ],
)
def test_declared_units_are_spelled_as_elsewhere(declared, unit):
    assert unit_in_words(declared) == unit


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("t", ""),
        ("time", ""),
        ("Time [ms]", "ms"),
        ("Time (seconds)", "s"),
        ("time(us)", "us"),
        ("%time", ""),
        ("robot/timestamp_ns", "ns"),
        ("robot/stamps", ""),
        ("camera_timestamps", ""),
        ("elapsed_time_msec", "ms"),
        ("header.stamp.secs", ""),
        ("ros_time_nanos", "ns"),
        ("Zeit", ""),
        ("t_s", "s"),
    ],
)
def test_stamps_are_known_by_name_with_their_unit(name, unit):
    assert is_time(name, array_field(name, np.zeros((4, 1))))
    assert is_time(name, array_field(name, np.zeros(4)))
    assert not is_time(name, array_field(name, np.zeros((4, 2))))
    assert not is_time(name, array_field(name, np.zeros(4, "U3")))
    assert time_unit_in(name) == unit


@pytest.mark.parametrize(
    "name",
    [
        *("execution_time", "cycle_time", "delay_t", "latency_ms", "compute_time"),
        *("process_time", "duration", "time_delta", "response_time"),
        *("times/x", "timer", "best", "tt", "temperature"),
    ],
)
def test_durations_and_other_names_are_no_stamps(name):
    assert not is_time(name, array_field(name, np.zeros(4)))


def test_a_name_without_stamps_tells_no_unit():
    assert time_unit_in("torque_ms2") == ""


def recording(lengths, clocks=()):
    """Fields of one column by their numbers of frames."""
    clocks = dict(clocks)
    fields = {
        name: array_field(name, np.zeros(frames), clock=clocks.get(name, ""))
        for name, frames in lengths.items()
    }
    return Recording(file=Path("day.h5"), fields=fields)


@pytest.mark.parametrize(
    ("name", "others", "preferred", "clock"),
    [
        # Named after the field, although another one is of its own group.
        ("arm/gripper_width", ["arm/time", "gripper_time"], "", "gripper_time"),
        ("arm/q", ["time", "arm/time", "hand/time"], "", "arm/time"),
        ("arm/left/q", ["hand/time", "arm/time", "time"], "", "time"),
        ("arm/left/q", ["hand/time", "arm/time"], "", "arm/time"),
        ("arm/q", ["hand/time", "leg/time"], "leg/time", "leg/time"),
        ("arm/q", ["hand/time", "leg/time"], "", "leg/time"),
        ("actual_q", ["actual_time", "time"], "time", "time"),
        ("target_q", ["target_time", "time"], "time", "time"),
        ("time", [], "", ""),
        ("q", ["joint"], "joint", ""),
    ],
)
def test_the_clock_of_a_field(name, others, preferred, clock):
    whole = recording(dict.fromkeys([name, *others], 8))
    assert whole.clock_of(name, preferred) == clock


def test_a_clock_has_as_many_frames_and_a_declared_one_comes_first():
    whole = recording({"q": 8, "time": 9, "stamp": 8, "late": 8}, {"late": "time"})
    assert whole.clock_of("q") == "stamp"
    assert whole.clock_of("stamp") == ""
    assert whole.clock_of("late") == "time"


@pytest.mark.parametrize(
    ("label", "key", "place"),
    [("demo_1", "q", "demo_1/q"), ("", "q", "q"), ("demo_1", None, "demo_1"), ("", None, None)],
)
def test_errors_name_the_episode_and_the_field(label, key, place):
    whole = Recording(file=Path("day.h5"), label=label, fields={})
    error = whole.error("is odd", key)
    assert (error.key, error.file) == (place, "day.h5")


class Opened:
    """A stream of 400 images that counts its openings."""

    def __init__(self):
        self.starts = []
        self.read = StreamRead(self.images)

    def images(self, start):
        self.starts.append(start)
        return iter(range(start, 400))


def test_images_read_in_any_order_are_those_of_their_frames():
    stream = Opened()
    order = np.random.default_rng(0).permutation(40) * 10
    for start in order.tolist():
        assert stream.read(start, start + 7).tolist() == [*range(start, start + 7)]
    assert stream.read(395, 420).tolist() == [*range(395, 400)]


def test_a_stream_is_opened_anew_backwards_and_beyond_100_images():
    stream = Opened()
    stream.read(3, 5)
    stream.read(5, 8)
    stream.read(20, 30)
    stream.read(130, 131)
    assert stream.starts == [3]
    stream.read(130, 131)
    assert stream.starts == [3, 130]
    stream.read(232, 233)
    assert stream.starts == [3, 130, 232]


def test_names_are_sorted_by_their_numbers():
    names = ["demo_10", "demo_2", "demo_2/cam3", "2", "demo", "a10b2", "a10b10", "a9b99"]
    expected = ["2", "a9b99", "a10b2", "a10b10", "demo", "demo_2", "demo_2/cam3", "demo_10"]
    assert sorted(names, key=natural) == sorted(expected, key=expected.index)


def split(arrays, **options):
    fields = {name: array_field(name, np.asarray(value)) for name, value in arrays.items()}
    return split_episodes(Path("day.npz"), fields, **options)


def labels(parts):
    return [part.label for part in parts]


Q = np.arange(24.0).reshape(12, 2)


def test_groups_that_count_are_episodes_wherever_they_are():
    arrays = {f"data/demo_{k}/q": Q[:k] for k in (10, 2, 1)}
    parts = split({**arrays, "data/rate": [5.0]}, label="part", fps=5)
    assert labels(parts) == [f"part/data/demo_{k}" for k in (1, 2, 10)]
    assert [part.fields["q"].frames for part in parts] == [1, 2, 10]
    assert {part.fps for part in parts} == {5}
    deep = {f"a/b/c/episode {k}/q": Q for k in range(3)}
    assert labels(split(deep)) == [f"a/b/c/episode {k}" for k in range(3)]
    deeper = {f"a/b/c/d/episode {k}/q": Q for k in range(3)}
    assert labels(split(deeper)) == [""]


@pytest.mark.parametrize(
    ("names", "episodes"),
    [
        (["demo_0/q"], ["demo_0"]),
        (["ep7/q"], ["ep7"]),
        (["traj_1/q"], ["traj_1"]),
        (["12/q"], ["12"]),
        (["run/demo_3/q"], ["run/demo_3"]),
        (["arm_0/q"], [""]),
        (["arm_0/q", "arm_1/q"], ["arm_0", "arm_1"]),
        (["arm_0/q", "arm_1/p"], [""]),
        (["arm_0/q", "leg_0/q"], [""]),
        (["q_1", "q_2"], [""]),
        (["q_1", "q_2", "p_1", "p_2"], ["1", "2"]),
        (["q/1", "q/2", "p/1", "p/2"], ["1", "2"]),
        (["q_1", "q_2", "p_1", "p_3"], [""]),
        (["q_1", "q_2", "p_1", "p_2", "other"], [""]),
    ],
)
def test_names_that_count_episodes(names, episodes):
    assert labels(split(dict.fromkeys(names, Q))) == episodes


def test_cameras_that_count_are_no_episodes():
    images = np.zeros((4, 16, 16, 3), np.uint8)
    assert labels(split({"cam_0/rgb": images, "cam_1/rgb": images})) == [""]
    scalars = {f"{name}_{k}": Q[:, :1] for name in "qp" for k in range(2)}
    assert labels(split(scalars)) == [""]


@pytest.mark.parametrize("name", ["episode_ends", "meta/episode_ends", "meta.traj_ends"])
def test_ends_split_the_arrays_that_reach_the_last_one(name):
    parts = split({"q": Q, "short": Q[:7], name: [3, 8]}, label="x")
    assert labels(parts) == ["x/episode 0", "x/episode 1"]
    assert [[*part.fields] for part in parts] == [["q"]] * 2
    np.testing.assert_array_equal(parts[0].fields["q"].numbers(), Q[:3])
    np.testing.assert_array_equal(parts[1].fields["q"].numbers(), Q[3:8])
    assert len(split({"q": Q, name: [12]})) == 1
    assert [part.fields["q"].frames for part in split({"q": Q, name: [1, 12]})] == [1, 11]


@pytest.mark.parametrize("ends", [[0, 5], [5, 5], [5, 4], [5, 13], []])
def test_ends_that_do_not_increase_up_to_the_frames_are_refused(ends):
    with pytest.raises(DatasetError, match="must increase, and not exceed the 12") as caught:
        split({"q": Q, "episode_ends": ends})
    assert str(ends[:5]) in str(caught.value)


@pytest.mark.parametrize("name", ["episode", "Trial_nr", "demo_index", "log.run_id"])
def test_a_column_that_numbers_episodes_splits_them(name):
    parts = split({"q": Q, name: np.repeat([4, 1, 9], [5, 1, 6])})
    assert [part.fields["q"].frames for part in parts] == [5, 1, 6]
    np.testing.assert_array_equal(parts[2].fields["q"].numbers(), Q[6:])
    with pytest.raises(DatasetError, match="repeats an earlier number"):
        split({"q": Q, name: np.repeat([4, 1, 4], [5, 1, 6])})
    assert len(split({"q": Q, name: np.ones((12, 2))})) == 1


def test_any_flag_ends_an_episode_after_its_frame():
    terminals, timeouts = np.zeros(12), np.zeros(12, bool)
    terminals[3], timeouts[7] = 1, True
    parts = split({"q": Q, "terminals": terminals, "timeouts": timeouts})
    assert [part.fields["q"].frames for part in parts] == [4, 4, 4]
    terminals[11] = 1
    assert len(split({"q": Q, "terminals": terminals})) == 2
    assert len(split({"q": Q, "terminals": np.zeros(12)})) == 1
    assert len(split({"q": Q, "terminals": np.eye(12)})) == 1
    # A task that is done stays done up to the last frame.
    terminals[[2, 4, 10]] = 1
    parts = split({"q": Q, "dones": terminals})
    assert [part.fields["q"].frames for part in parts] == [5, 7]
    # Flags of other lengths contradict each other.
    assert len(split({"q": Q, "terminals": terminals, "dones": timeouts[:9]})) == 1


def test_arrays_of_three_axes_hold_one_demonstration_a_layer():
    stack = np.random.default_rng(0).normal(size=(3, 12, 2))
    parts = split({"q": stack, "goal": stack[:1], "time": np.arange(12.0)})
    assert labels(parts) == ["episode 0", "episode 1", "episode 2"]
    for part, values in zip(parts, stack, strict=True):
        assert (part.fields["q"].kind, part.fields["q"].shape) == ("number", (12, 2))
        np.testing.assert_array_equal(part.fields["q"].read(2, 5), values[2:5])
        np.testing.assert_array_equal(part.fields["goal"].numbers(), stack[0])
        np.testing.assert_array_equal(part.fields["time"].numbers()[:, 0], np.arange(12))
    with pytest.raises(DatasetError, match="holds 2 demonstrations, other arrays hold 3") as c:
        split({"q": stack, "p": stack[:2]}, label="x")
    assert c.value.key == "x/p"


def test_a_field_made_of_a_function_reads_by_it():
    field = make_field("q", (9, 2), np.dtype(float), lambda a, b: Q[a:b], names=("a", "b"))
    assert isinstance(field, Field)
    assert field.names == ("a", "b")
    np.testing.assert_array_equal(field.numbers(), Q[:9])
