"""One thread a process: the suite's tensors are small, and pytest-xdist brings the processes.

With OpenMP's default of a thread a core the suite takes twice the CPU time.
"""

import os

# Before torch is imported, and for the programs that tests start.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch

torch.set_num_threads(1)
