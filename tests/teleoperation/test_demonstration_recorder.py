"""Recording at a person's word, without a person."""

import shutil

import numpy as np
import pytest

from hrc_learn.demos import DatasetError, DatasetWriter, load_demos, recover_dataset
from hrc_learn.kinematics import panda
from hrc_learn.teleoperation.demonstration_recorder import (
    UNNAMED,
    DemonstrationRecorder,
    RecordingQuality,
)

FPS = 5.0  # few frames make a demonstration of half a second


def frame(k):
    q = np.linspace(0.1, 0.7, 7) + 0.01 * k
    return {"time": k / FPS, "joint_position": q, "human_effort": np.full(7, 0.1 * k)}


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "demos"


def open_recorder(folder):
    writer = DatasetWriter(folder, FPS, "panda", panda.joint_names)
    return DemonstrationRecorder(writer, lambda: "show it")


def record(recorder, start, count):
    for k in range(start, start + count):
        recorder.add(frame(k))


def test_what_is_saved_is_in_the_dataset_and_nothing_else(folder):
    with open_recorder(folder) as recorder:
        record(recorder, 0, 5)  # before the start
        recorder.handle("start")
        record(recorder, 5, 20)
        assert recorder.status.state == "recording"
        assert recorder.status.seconds == pytest.approx(19 / FPS)
        recorder.handle("stop")
        record(recorder, 25, 5)  # after the stop
        recorder.handle("save")
        recorder.handle("start")
        record(recorder, 40, 10)
        recorder.handle("discard")
        recorder.handle("start")
        record(recorder, 60, 8)
        recorder.handle("save")  # saving stops
    assert recorder.status.saved == 2
    first, second = load_demos(folder)
    assert (len(first), len(second)) == (20, 8)
    assert first.task == "show it"
    np.testing.assert_allclose(first.joint_position[0], frame(5)["joint_position"], atol=1e-6)
    np.testing.assert_allclose(second.human_effort[-1], 6.7, atol=1e-5)
    assert first.start_time == pytest.approx(5 / FPS)


def test_starting_over_forgets_what_was_shown(folder):
    with open_recorder(folder) as recorder:
        recorder.handle("start")
        record(recorder, 0, 10)
        recorder.handle("stop")
        recorder.handle("start")
        record(recorder, 10, 6)
        recorder.handle("save")
    (demo,) = load_demos(folder)
    assert len(demo) == 6


@pytest.mark.parametrize("request_", ["stop", "save", "discard"])
def test_what_makes_no_sense_is_said_and_not_done(folder, request_):
    with open_recorder(folder) as recorder:
        recorder.handle(request_)
        assert f"nothing to {request_}" in recorder.status.note
        assert recorder.status.state == "ready"


def test_nothing_saved_leaves_no_dataset_and_nothing_else(folder):
    with open_recorder(folder) as recorder:
        recorder.handle("start")
        record(recorder, 0, 3)
        recorder.handle("discard")
        recorder.handle("start")
        recorder.add(frame(0))  # still open, but nothing moves
    assert not list(folder.parent.iterdir())


@pytest.mark.parametrize("last", ["start", "stop"])
@pytest.mark.parametrize("signal", [SystemExit, KeyboardInterrupt])
def test_a_demonstration_that_is_open_when_the_program_is_ended_is_kept(folder, last, signal):
    def run():
        with open_recorder(folder) as recorder:
            recorder.handle("start")
            record(recorder, 0, 9)
            recorder.handle(last)  # a second "start" changes nothing
            record(recorder, 9, 9)
            raise signal

    with pytest.raises(signal):
        run()
    (demo,) = load_demos(folder)
    assert len(demo) == (18 if last == "start" else 9)


@pytest.mark.parametrize("task", ["", "  "])
def test_an_open_demonstration_without_a_name_is_kept_at_the_end(folder, task):
    writer = DatasetWriter(folder, FPS, "panda", panda.joint_names)
    with DemonstrationRecorder(writer, lambda: task) as recorder:
        recorder.handle("start")
        record(recorder, 0, 9)
    (demo,) = load_demos(folder)
    assert demo.task == UNNAMED


def test_what_does_not_move_or_has_no_name_is_not_saved(folder):
    task = [" "]
    writer = DatasetWriter(folder, FPS, "panda", panda.joint_names)
    with DemonstrationRecorder(writer, lambda: task[0]) as recorder:
        recorder.handle("start")
        record(recorder, 0, 9)
        recorder.handle("save")
        assert recorder.status.state == "stopped"  # and waits for a name
        assert "Task" in recorder.status.note
        task[0] = "show it"
        recorder.handle("save")
        recorder.handle("start")
        for _ in range(9):
            recorder.add(frame(0))
        recorder.handle("save")
        assert "not moved" in recorder.status.note
        recorder.handle("start")
        record(recorder, 0, 3)
        recorder.handle("save")
        assert recorder.status.note == "nothing to save: the arm has moved for 0.4 s only"
    assert recorder.status.saved == 1
    assert [demo.task for demo in load_demos(folder)] == ["show it"]


def test_an_empty_demonstration_is_not_saved(folder):
    with open_recorder(folder) as recorder:
        recorder.handle("start")
        recorder.handle("save")
        assert "no frames" in recorder.status.note


def test_frames_that_cannot_be_written_are_reported_and_the_next_are_saved(folder):
    with open_recorder(folder) as recorder:
        recorder.handle("start")
        for k in range(4):
            recorder.add({"time": k / FPS, "joint_position": np.full(6, 0.1 * k)})
        recorder.handle("save")
        recorder._writing[0].exception()  # wait for the thread
        assert recorder.status.note.startswith("not saved: frame 0: joint_position needs 7")
        recorder.handle("start")
        record(recorder, 0, 4)
        recorder.handle("save")
    assert recorder.status.saved == 1
    assert len(load_demos(folder)[0]) == 4


def test_what_was_saved_before_a_failure_is_not_lost(folder):
    def fail():
        with open_recorder(folder) as recorder:
            recorder.handle("start")
            record(recorder, 0, 4)
            recorder.handle("save")
            raise RuntimeError("the cable came off")

    with pytest.raises(RuntimeError, match="cable") as caught:
        fail()
    assert "recover_dataset" in caught.value.__notes__[0]


FINE = 50.0


def resting_frames(moves):
    """Two seconds of rest, a second in which something moves, two of rest."""
    return [
        {
            "time": 10.0 + k / FINE,
            "joint_position": np.zeros(7),
            "gripper": 0.08,
            **moves(np.clip(k / FINE - 2.0, 0.0, 1.0)),
        }
        for k in range(251)
    ]


def without_rest(frames):
    quality = RecordingQuality(FINE)
    for f in frames:
        quality.add(f["time"], f["time"], f["joint_position"], f["gripper"])
    part = quality.moving()
    return None if part is None else frames[part]


@pytest.mark.parametrize(
    "moves",
    [
        lambda share: {"joint_position": np.array([0, 0, 0, 0.5 * share, 0, 0, 0])},
        lambda share: {"gripper": 0.08 - 0.05 * share},
        # There and back: the ends alone would tell of no motion.
        lambda share: {"joint_position": np.full(7, np.sin(np.pi * share))},
    ],
)
def test_rest_before_and_after_the_motion_is_left_out(moves):
    kept = without_rest(resting_frames(moves))
    assert kept[0]["time"] == pytest.approx(11.7, abs=0.12)
    assert kept[-1]["time"] == pytest.approx(13.7, abs=0.12)
    assert kept[0]["time"] <= 12.0
    assert kept[-1]["time"] >= 13.0


def test_an_arm_that_never_moves_has_no_moving_part():
    frames = resting_frames(lambda share: {})
    assert without_rest(frames) is None
    assert without_rest(frames[:1]) is None


def test_a_motion_that_is_cut_off_is_kept_to_its_end():
    moves = resting_frames(lambda share: {"joint_position": np.full(7, share)})
    frames = moves[:130]
    kept = without_rest(frames)
    assert kept[-1] is frames[-1]
    assert kept[0]["time"] == pytest.approx(11.7, abs=0.12)


@pytest.mark.parametrize(
    ("kept", "share"), [(lambda k: k % 5, "19 %"), (lambda k: k not in (40, 41), "2 %")]
)
def test_lost_frames_are_told_and_saving_again_insists(folder, kept, share):
    with open_recorder(folder) as recorder:
        recorder.handle("start")
        for k in filter(kept, range(1, 100)):
            recorder.add(frame(k))
        recorder.handle("save")
        told = recorder.status
        assert told.state == "stopped"
        assert (
            f"{share} of its frames are lost, up to 0.{'4' if kept(5) == 0 else '6'}"
            in told.note
        )
        assert "Save again" in told.note
        recorder.handle("save")
        assert recorder.status.state == "ready"
    assert recorder.status.saved == 1


@pytest.mark.parametrize(("late", "good"), [(18, True), (19, False)])
def test_a_loop_that_stutters_is_told(folder, late, good):
    now = [0.0]
    writer = DatasetWriter(folder, FPS, "panda", panda.joint_names)
    with DemonstrationRecorder(writer, lambda: "show it", lambda: now[0]) as recorder:
        recorder.handle("start")
        for k in range(95):  # a fifth of the steps between them may be late
            recorder.add(frame(k))
            now[0] += (2.1 if k < late else 0.9) / FPS
        recorder.handle("save")
        assert recorder.status.state == ("ready" if good else "stopped")
        assert good or f"late at {late} of 95 frames" in recorder.status.note
    assert recorder.status.saved == 1  # what is open is kept in any case


@pytest.mark.parametrize(("gap", "good"), [(1.24, True), (1.27, False)])
def test_an_arm_that_is_slower_than_the_person_is_told(folder, gap, good):
    now = [5.0]
    writer = DatasetWriter(folder, FPS, "panda", panda.joint_names)
    with DemonstrationRecorder(writer, lambda: "show it", lambda: now[0]) as recorder:
        for end in ("discard", "save"):  # the time of the last one is forgotten
            recorder.handle("start")
            for k in range(101):
                recorder.add(frame(k))
                now[0] += gap / FPS
            recorder.handle(end)
            now[0] += 60.0
        assert recorder.status.state == ("ready" if good else "stopped")
        said = "at 79 % of real time, so its recording is 1.3 times as fast"
        assert good or said in recorder.status.note
    assert recorder.status.saved == 1


def test_limits_and_contacts_are_told_before_it_is_saved(folder):
    def reach(k):
        return np.array([0.0, -0.3, 0.0, -2.0, 0.0, 1.8, 0.5]) + 0.01 * k

    writer = DatasetWriter(folder, FPS, "panda", panda.joint_names)
    with DemonstrationRecorder(writer, lambda: "show it", chain=panda) as recorder:
        recorder.handle("start")
        for k in range(20):
            q = reach(k)
            q[1] = float(panda.limits.lower[1]) + 0.01
            touching = ["finger touched table"] * (k == 7)
            recorder.add(frame(k) | {"joint_position": q}, touching)
        recorder.handle("save")
        assert recorder.status.note == (
            "not saved yet: panda_joint2 was at its limit for 4.0 s, finger touched table for "
            "0.20 s. Save again to keep it all the same"
        )
        recorder.handle("discard")
        recorder.handle("start")  # what was said of the last one is forgotten
        for k in range(20):
            recorder.add(frame(k) | {"joint_position": reach(k)})
        recorder.handle("save")
        assert recorder.status.note == "saved"


def test_a_draft_is_on_disk_until_it_is_saved_or_discarded(folder):
    now = [0.0]

    def show(recorder, count):
        now[0] = 0.0
        recorder.handle("start")
        for k in range(count):
            now[0] = k / FPS
            recorder.add(frame(k))
            recorder._thread.submit(int).result()  # wait for the thread

    def drafted():
        left = folder.with_name("copy.recording")
        shutil.copytree(folder.with_name("demos.recording"), left)
        try:
            demos = load_demos(recover_dataset(left.with_suffix("")))
            return [(len(demo), demo.task) for demo in demos]
        except DatasetError:
            return []
        finally:
            shutil.rmtree(folder.with_name("copy"), ignore_errors=True)

    writer = DatasetWriter(folder, FPS, "panda", panda.joint_names)
    with DemonstrationRecorder(writer, lambda: "", lambda: now[0]) as recorder:
        show(recorder, 10)
        assert drafted() == []  # not yet two seconds
        recorder.handle("discard")
        show(recorder, 20)
        assert drafted() == [(11, UNNAMED)]
        recorder.handle("discard")
        show(recorder, 22)  # two seconds later there is another
        assert drafted() == [(21, UNNAMED)]
        recorder.handle("discard")
        recorder._thread.submit(int).result()
        assert drafted() == []
        show(recorder, 20)
    (demo,) = load_demos(folder)
    assert (len(demo), demo.task) == (20, UNNAMED)
