"""A program that moves an arm: `loop_on_stubborn_arm.py KIND LOG HOLD`."""

import ctypes
import signal
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
from stubborn_arm import StubbornArm

from hrc_learn.hardware import ArmProcess, ending_at_rest

PERIOD, TIMEOUT = 0.01, 0.2

# As at a terminal: shells start jobs in the background deaf to these.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)


def drive(arm, hold: float) -> None:
    for k in range(10_000):
        arm.command(np.full(7, 0.1))
        if k == 20 and hold:
            # Unlike time.sleep, this keeps all other threads of the process from running.
            ctypes.PyDLL(None).usleep(int(1e6 * hold))
        time.sleep(PERIOD)


def main(kind: str, log: Path, hold: float) -> None:
    if kind == "process":
        with ArmProcess(partial(StubbornArm, log), timeout=TIMEOUT) as arm:
            print(arm.pid, flush=True)
            drive(arm, hold)
    else:
        arm = StubbornArm(log, failing_stops=3)
        with ending_at_rest(arm.stop):
            print("ready", flush=True)
            drive(arm, hold)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), float(sys.argv[3]))
