import numpy as np
import pytest

from hrc_learn.log import Event, StepLog


def filled(steps: int, block: int = 8192) -> StepLog:
    log = StepLog(block=block)
    for k in range(steps):
        log.append(time=k / 125, joint=np.full(7, k), J=np.full((2, 6), -k), pushed=k % 3 == 0)
    return log


@pytest.mark.parametrize(
    ("steps", "block"), [(1, 8), (7, 8), (8, 8), (9, 8), (16, 8), (17, 8), (3, 1)]
)
def test_columns_come_back_whatever_the_blocks(steps, block):
    log = filled(steps, block=block)
    k = np.arange(steps)
    assert log.names == ("time", "joint", "J", "pushed")
    assert len(log) == steps
    np.testing.assert_array_equal(log["time"], k / 125)
    np.testing.assert_array_equal(log["joint"], np.repeat(k[:, None], 7, axis=1))
    np.testing.assert_array_equal(log["J"], np.broadcast_to(-k[:, None, None], (steps, 2, 6)))
    np.testing.assert_array_equal(log["pushed"], k % 3 == 0)
    assert log["pushed"].dtype == bool


def test_whole_first_values_do_not_cut_later_ones():
    log = StepLog()
    log.append(time=0, joint=np.zeros(2, dtype=int))
    log.append(time=0.008, joint=np.array([0.5, 1.5]))
    assert log["time"].tolist() == [0.0, 0.008]
    assert log["joint"][1].tolist() == [0.5, 1.5]


def test_a_column_is_a_copy():
    log = filled(3)
    log["joint"][:] = 99
    assert log["joint"][2, 0] == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"joint": np.zeros(6)}, r"row 2 .*joint is \(6,\), not \(7,\)"),
        ({"time": np.zeros(3)}, r"time is \(3,\), not \(\)"),
        ({"joint": 0.5}, r"joint is \(\), not \(7,\)"),
        ({"J": np.zeros(6)}, r"J is \(6,\), not \(2, 6\)"),
        ({"time": np.zeros(1)}, r"time is \(1,\), not \(\)"),
        ({"joint": None}, "joint is missing"),
        ({"speed": 1.0}, r"speed is \(\), not a column"),
    ],
)
def test_rows_that_do_not_fit_are_refused_and_leave_no_trace(change, message):
    log = filled(2)
    row = {"time": 0.0, "joint": np.zeros(7), "J": np.zeros((2, 6)), "pushed": False}
    row = {name: value for name, value in (row | change).items() if value is not None}
    with pytest.raises(ValueError, match=message):
        log.append(**row)
    assert len(log) == 2
    assert log["joint"].shape == (2, 7)


def test_unknown_columns_are_named_with_the_known_ones():
    with pytest.raises(KeyError, match=r"'speed' is not logged; .*'joint'"):
        filled(1)["speed"]


@pytest.mark.parametrize("start", [0, 3, 8, 11, 16, 20])
def test_blocks_give_the_rows_from_a_start_on(start):
    log = filled(20, block=8)
    times = [t for block in log.blocks(start) for t in block["time"]]
    assert times == [k / 125 for k in range(start, 20)]


@pytest.mark.parametrize("steps", [1, 20_000])
def test_a_saved_log_holds_columns_and_events(tmp_path, steps):
    log = filled(steps)
    log.event(0.5, "Approach, then “servo”")
    log.save(tmp_path / "run.npz")
    with np.load(tmp_path / "run.npz", allow_pickle=False) as file:
        assert file["event/time"].tolist() == [0.5]
        assert file["event/text"].tolist() == ["Approach, then “servo”"]
        assert len(file.files) == len(log.names) + 2
        for name in log.names:
            np.testing.assert_array_equal(file[f"column/{name}"], log[name])
            assert file[f"column/{name}"].dtype == log[name].dtype
    assert [file.name for file in tmp_path.iterdir()] == ["run.npz"]


def test_a_block_holds_at_least_a_row():
    with pytest.raises(ValueError, match="at least one row"):
        StepLog(block=0)


@pytest.mark.parametrize("rows", [None, 5, 8, 10, 99])
def test_a_snapshot_does_not_grow(rows):
    log = filled(10, block=8)
    log.event(0.0, "start")
    taken = log.snapshot(rows)
    log.append(time=1.0, joint=np.zeros(7), J=np.zeros((2, 6)), pushed=True)
    log.event(1.0, "end")
    length = 10 if rows is None else min(rows, 10)
    assert len(taken) == length
    np.testing.assert_array_equal(taken["time"], np.arange(length) / 125)
    assert taken.events == [Event(0.0, "start")]
    assert not len(StepLog().snapshot())
