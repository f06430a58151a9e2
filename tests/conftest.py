"""What holds for all tests."""

import os

# The suite's tensors are small and pytest-xdist brings the processes: with OpenMP's default of
# a thread a core it takes twice the CPU time. Set before torch is imported, and in the
# environment for the programs that tests start.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import torch

torch.set_num_threads(1)


@pytest.fixture(autouse=True, scope="session")
def no_waiting_for_the_disk():
    """No power cut is survived by files of tests, so none waits until it is on disk."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        yield
