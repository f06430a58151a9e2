"""A program that moves an arm until it is killed: `loop_on_franka.py HOST`.

It says the number of the process that has the loop.
"""

import sys
import time

import numpy as np

from hrc_learn.hardware import FrankaArm, FrankaConfig
from hrc_learn.kinematics import fr3 as FR3


def main(host: str) -> None:
    with FrankaArm(host, FR3, FrankaConfig(realtime=False, gripper=False)) as arm:
        begin = time.monotonic()
        while True:
            arm.command(swing(time.monotonic() - begin))
            if time.monotonic() - begin > 0.5:
                print(arm.pid, flush=True)
            time.sleep(0.02)


def swing(t: float) -> np.ndarray:
    """All joints to and fro, by 0.2 rad about where they began [rad/s]."""
    return 0.4 * np.cos(2 * t) * np.array([1, -1, 1, -1, 1, 1, 1])


def loop_of(arm: FrankaArm) -> int:
    """Number of the process that has the loop."""
    assert arm.pid is not None
    return arm.pid


if __name__ == "__main__":
    main(sys.argv[1])
