"""What holds for all tests."""

import os

# The suite's tensors are small and pytest-xdist brings the processes: with OpenMP's default of
# a thread a core it takes twice the CPU time. Set before torch is imported, and in the
# environment for the programs that tests start.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Each process in which inductor compiles would import torch.
os.environ.setdefault("TORCHINDUCTOR_COMPILE_THREADS", "1")

import gc
import random

import pytest
import torch
from hypothesis import settings
from shape_checks import first_calls_checked
from unchecked import shapes_unchecked

torch.set_num_threads(1)
torch.manual_seed(0)  # on accelerators too, once they are used
# A machine that does something else meanwhile makes no test wrong.
settings.register_profile("timeless", deadline=None)
settings.load_profile("timeless")


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Look for no garbage among the million objects of imported modules.

    While they are imported that takes a sixth of the time, and half a second in each trial and
    loop of the package that collects garbage.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        # Every 700 objects, Python's own, take 2 % of the suite's time.
        gc.set_threshold(20_000)
        gc.enable()


@pytest.fixture(autouse=True, scope="session")
def no_waiting_for_the_disk():
    """No power cut is survived by files of tests, so none waits until it is on disk."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        yield


@pytest.fixture(autouse=True)
def ordinary_priority():
    """A realtime thread starts realtime threads and processes, which starve other tests."""
    yield
    left = os.sched_getscheduler(0)
    if left != os.SCHED_OTHER:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        pytest.fail("the test leaves its thread with another scheduling")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """Random numbers repeat, and simulations run without shape checks and autograd.

    Simulations, with their fixtures, would cost twice as much.
    """
    random.seed(0)
    # `torch.manual_seed` writes a traceback for each kind of accelerator that is not in use.
    torch.default_generator.manual_seed(0)
    if torch.cuda.is_initialized():
        torch.cuda.manual_seed_all(0)
    if item.get_closest_marker("simulation") is None:
        with first_calls_checked():
            return (yield)
    differentiates = item.get_closest_marker("gradients") is not None
    with shapes_unchecked(), torch.inference_mode(not differentiates):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef, request):
    """What several tests share is made outside inference mode, whichever test comes first."""
    if fixturedef.scope == "function" or not torch.is_inference_mode_enabled():
        return (yield)
    with torch.inference_mode(False), torch.no_grad():
        return (yield)


NEEDED = {
    "browser": "a headless Chromium (Debian: apt install chromium)",
    "egl": "EGL for rendered images (Debian: apt install libegl1)",
}
"""What tests with a mark need, and where it comes from."""


def pytest_terminal_summary(terminalreporter):
    """Say last which tests did not run, as a suite that skipped them looks as green."""
    # A whole module that was skipped has no marks.
    skipped = [r for r in terminalreporter.stats.get("skipped", []) if hasattr(r, "keywords")]
    for mark, need in NEEDED.items():
        missing = sorted({report.nodeid for report in skipped if mark in report.keywords})
        if missing:
            terminalreporter.write_line(f"{len(missing)} tests did not run without {need}:")
            for name in missing:
                terminalreporter.write_line(f"    {name}")
