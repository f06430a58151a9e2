"""A gripper on its threads: what is asked for, told and waited for."""

import threading
from contextlib import suppress
from types import SimpleNamespace

import pytest

from hrc_learn.hardware import GripperError
from hrc_learn.hardware import gripper as gripper_module
from hrc_learn.hardware.gripper import GripperThread

PATIENCE = 20.0


class SlowGripper:
    """Moves as slowly as it is let, and breaks when it is told to."""

    def __init__(self):
        self.width, self.calls = 0.08, []
        self.let = threading.Semaphore(0)
        self.begun = threading.Semaphore(0)
        self.failures = 0
        self.succeeds, self.broken = True, False

    def read_width(self):
        if self.broken:
            self.failures += 1
            raise OSError("no route to host")
        return self.width

    def move(self, width):
        return self._go(("move", width), width)

    def squeeze(self):
        return self._go(("squeeze",), 0.03)

    def close(self):
        self.let.release(100)

    def _go(self, call, width):
        self.calls.append(call)
        self.begun.release()
        assert self.let.acquire(timeout=PATIENCE)
        if self.broken:
            raise OSError("no route to host")
        if self.succeeds:
            self.width = width
        return self.succeeds


@pytest.fixture
def driver():
    return SlowGripper()


@pytest.fixture
def told(capfd):
    """Returns the failures printed so far."""
    text = ""

    def read():
        nonlocal text
        text += capfd.readouterr().err
        return text.split("\n")[:-1]  # the last line may be half written

    return read


@pytest.fixture
def gripper(driver):
    with GripperThread(lambda: driver) as gripper:
        yield gripper


def wait_until(condition):
    for _ in range(2000):
        if condition():
            return
        threading.Event().wait(0.01)
    raise AssertionError("it never came")


def settle(driver, gripper, width):
    """Let the move under way end, and its result be read."""
    driver.let.release()
    wait_until(lambda: gripper.width == width)


def test_nothing_waits_for_fingers_that_move(driver, gripper):
    gripper.move(0.04)
    assert driver.begun.acquire(timeout=PATIENCE)
    assert gripper.width == 0.08  # while the move is held up
    driver.width = 0.06  # half-way
    wait_until(lambda: gripper.width == 0.06)
    settle(driver, gripper, 0.04)
    assert gripper.failure is None
    gripper.check()


def test_the_newest_opening_is_next_and_those_before_it_are_dropped(driver, gripper):
    gripper.move(0.04)
    assert driver.begun.acquire(timeout=PATIENCE)
    for width in (0.05, 0.06, 0.0):
        gripper.move(width)
    driver.let.release()
    assert driver.begun.acquire(timeout=PATIENCE)
    assert driver.calls == [("move", 0.04), ("squeeze",)]


def test_an_opening_that_is_asked_for_again_is_sent_once(driver, gripper):
    for width in (0.04, 0.04, 0.0441, 0.036):
        gripper.move(width)
    assert driver.begun.acquire(timeout=PATIENCE)
    settle(driver, gripper, 0.04)
    gripper.move(0.046)
    assert driver.begun.acquire(timeout=PATIENCE)
    assert driver.calls == [("move", 0.04), ("move", 0.046)]


def test_a_failed_grasp_is_told_once_and_kept_until_the_next_opening(driver, gripper, told):
    driver.succeeds = False
    gripper.move(0.0)
    driver.let.release()
    wait_until(lambda: gripper.failure)
    with pytest.raises(GripperError, match="did not close on anything"):
        gripper.check()
    for _ in range(3):
        gripper.move(0.0)  # of a loop that goes on: neither raises nor tries again
    assert driver.calls == [("squeeze",)]
    assert told() == [f"gripper: {gripper.failure}"]
    driver.succeeds = True
    gripper.move(0.05)
    assert gripper.failure is None


def test_a_driver_that_raises_is_told_with_its_words(driver, gripper, told):
    driver.broken = True
    gripper.move(0.05)
    driver.let.release()
    wait_until(lambda: any("open to 50 mm" in failure for failure in told()))
    wait_until(lambda: any("cannot be reached" in failure for failure in told()))
    assert all("OSError: no route to host" in failure for failure in told())
    assert gripper.width == 0.08  # the newest known
    driver.broken, driver.width = False, 0.02
    wait_until(lambda: gripper.width == 0.02)  # connected again
    with pytest.raises(GripperError):
        gripper.check()  # still: the move was lost


def test_a_connection_that_stays_broken_is_told_once(driver, gripper, told):
    driver.broken = True
    wait_until(lambda: driver.failures == 2)
    driver.broken, driver.width = False, 0.01
    wait_until(lambda: gripper.width == 0.01)
    assert len(told()) == 1


def test_a_gripper_that_cannot_be_reached_is_an_error_at_once():
    def refuse():
        raise OSError("connection refused")

    with pytest.raises(GripperError, match=r"cannot be reached.*connection refused"):
        GripperThread(refuse)


def test_a_gripper_that_tells_no_width_is_not_waited_for_for_ever():
    silence = threading.Event()

    class Silent(SlowGripper):
        def read_width(self):
            silence.wait(PATIENCE)
            return 0.0

    threading.Timer(0.5, silence.set).start()
    with pytest.raises(GripperError, match=r"has not reported its width for 0\.1 s"):
        GripperThread(Silent, startup=0.1)


@pytest.mark.parametrize("width", [float("nan"), float("inf"), float("-inf")])
def test_an_opening_must_be_a_width(gripper, width):
    with pytest.raises(ValueError, match="width must be finite"):
        gripper.move(width)


def test_a_policy_that_closes_by_a_little_less_than_zero_squeezes(driver, gripper):
    gripper.move(-1e-4)
    assert driver.begun.acquire(timeout=PATIENCE)
    assert driver.calls == [("squeeze",)]


def test_its_threads_end_with_it(driver):
    gripper = GripperThread(lambda: driver)
    threads = gripper._threads
    gripper.close()
    assert not any(thread.is_alive() for thread in threads)
    assert all(thread.daemon for thread in threads)  # a program that forgets it may end


def test_a_width_of_exactly_the_narrowest_is_moved_to(driver, gripper):
    for width, call in (
        (0.005, ("move", 0.005)),
        (0.0, ("squeeze",)),
        (0.005, ("move", 0.005)),
    ):
        gripper.move(width)
        assert driver.begun.acquire(timeout=PATIENCE)
        driver.let.release()
        assert driver.calls[-1] == call
    # What differs by less is the same.
    gripper.move(0.0099)
    assert gripper._last == 0.005


def test_it_is_read_fifty_times_a_second_and_connected_again_each_second(driver, monkeypatch):
    waits, open_it = [], []

    class Condition(threading.Condition):
        def wait_for(self, reached, longest=None):
            waits.append(longest)
            return super().wait_for(reached, longest and min(longest, 0.01))

    class Opening(threading.Condition):
        """Its first wait is the constructor's."""

        def wait_for(self, reached, longest=None):
            waits.append(longest)
            found = super().wait_for(reached, longest and min(longest, PATIENCE / 10))
            if longest == PATIENCE:
                open_it.append(found)
            return found

    with monkeypatch.context() as patch:
        patch.setattr(gripper_module.threading, "Condition", Opening)
        gripper = GripperThread(lambda: driver, startup=PATIENCE)
    assert open_it == [True]  # by the reading, not by the time
    wait_until(lambda: waits.count(0.02) > 2)
    assert set(waits) == {None, 0.02, PATIENCE}
    gripper.close()
    waits.clear()
    monkeypatch.setattr(gripper_module.threading, "Condition", Condition)
    gripper = GripperThread(lambda: driver)
    driver.broken = True
    wait_until(lambda: waits.count(1.0) > 2)
    gripper.close()


def test_a_gripper_opened_while_it_is_closed_is_closed_again():
    begun, let, closed = threading.Event(), threading.Event(), []

    def open_it():
        begun.set()
        assert let.wait(PATIENCE)
        return SimpleNamespace(close=lambda: closed.append(1), read_width=lambda: 0.0)

    def construct():
        with suppress(GripperError):
            GripperThread(open_it, startup=0.01)

    opening = threading.Thread(target=construct)
    opening.start()
    assert begun.wait(PATIENCE)
    wait_until(lambda: any(t.name == "gripper reader" for t in threading.enumerate()))
    reader = next(t for t in threading.enumerate() if t.name == "gripper reader")
    wait_until(lambda: not any(t.name == "gripper mover" for t in threading.enumerate()))
    let.set()
    reader.join(PATIENCE)
    opening.join(PATIENCE)
    assert closed == [1]
