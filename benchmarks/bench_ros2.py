"""Latency, disturbed messages and a killed node over ROS 2, and the rate of importing a bag.

The robot (`ros2_robot.py`) and the node run in processes of their own, over real middleware.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from ros2_bags import write_bag

from hrc_learn import cli
from hrc_learn.cli import write_values
from hrc_learn.demos.recording_import import plan_import, write_plan
from hrc_learn.demos.recording_names import ImportOptions
from hrc_learn.hardware.ros2_topics import Ros2Session, quality

ROBOT = Path(__file__).parent / "ros2_robot.py"


@dataclass(frozen=True, kw_only=True)
class Args:
    seconds: float = 20.0
    """Duration of each stream [s]."""
    kills: int = 10
    """Nodes that are killed."""
    megabytes: float = 200.0
    """Size of the imported bag [MB]."""
    json: Path | None = None
    """File for the measured values."""


@contextmanager
def _robot(*options: str) -> Iterator[None]:
    """A robot that publishes, until the block ends."""
    robot = subprocess.Popen([sys.executable, str(ROBOT), *options], stdout=subprocess.PIPE)
    try:
        assert robot.stdout is not None
        robot.stdout.readline()
        yield
    finally:
        robot.send_signal(signal.SIGINT)
        robot.wait(10)


def stream(seconds: float, hostile: float) -> dict[str, float]:
    """Latencies of the served node while a goal moves, and the limits that were violated."""
    with tempfile.TemporaryDirectory() as folder:
        of_robot, of_node = Path(folder) / "robot.json", Path(folder) / "node.json"
        words = ["-m", "hrc_learn.cli", "serve", "--ros2", "--duration", str(seconds)]
        command = [sys.executable, *words, "--json", str(of_node)]
        with _robot("--hostile", str(hostile), "--json", str(of_robot)):
            # A fault stops the arm as specified: the node stays, and its values end there.
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        node, seen = (
            json.loads(of_node.read_text("utf-8")),
            json.loads(of_robot.read_text("utf-8")),
        )
    kept = ("commands", "latency_p50_ms", "latency_p99_ms", "latency_p100_ms")
    return {name: node[name] for name in kept} | {"violations": seen["violations"]}


LOOP = """
import time
import numpy as np
from hrc_learn.hardware import Ros2Arm
from hrc_learn.kinematics import panda
with Ros2Arm(panda.chain) as arm:
    print("ready", flush=True)
    while True:
        arm.command(np.array([0.3, 0, 0, 0, 0, 0, 0]))
        time.sleep(0.005)
"""


def kill(times: int) -> dict[str, float]:
    """Times from `kill -9` of a node until the arm is at rest [s]."""
    from sensor_msgs.msg import JointState

    took, newest = [], {"velocity": 0.0}
    session = Ros2Session("bench")

    def take(message: JointState) -> None:
        newest["velocity"] = float(np.abs(message.velocity).max())

    session.node.create_subscription(JointState, "/joint_states", take, quality())
    with _robot():
        for _ in range(times):
            with subprocess.Popen([sys.executable, "-c", LOOP], stdout=subprocess.PIPE) as node:
                assert node.stdout is not None
                node.stdout.readline()
                while newest["velocity"] < 0.2:  # it has to be discovered first
                    if node.poll() is not None:
                        sys.exit("the commanding process ended by itself: see its error above")
                    time.sleep(0.02)
                time.sleep(0.5)
                node.kill()
            began = time.monotonic()
            while newest["velocity"] > 0.01 and time.monotonic() - began < 5:
                time.sleep(0.002)
            took.append(time.monotonic() - began)
    session.close()
    return {
        "rest_after_kill_median_s": float(np.median(took)),
        "rest_after_kill_max_s": max(took),
    }


def import_rate(megabytes: float) -> dict[str, float]:
    """Megabytes of a bag that are imported in a second of CPU time."""
    with tempfile.TemporaryDirectory() as folder:
        bag = write_bag(Path(folder) / "bag", megabytes)
        size = sum(file.stat().st_size for file in bag.rglob("*")) / 1e6
        began = sum(os.times()[:4])
        write_plan(plan_import([bag], ImportOptions()), Path(folder) / "set", "ur5e", True)
        took = sum(os.times()[:4]) - began
    return {"bag_mb": size, "import_cpu_s": took, "import_cpu_s_per_gb": 1e3 * took / size}


def main(args: Args) -> None:
    """Measure and print."""
    os.environ.setdefault("ROS_DOMAIN_ID", "99")
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    values = {"load": os.getloadavg()[0]}
    for name, hostile in (("clean", 0.0), ("hostile", 0.1)):
        found = stream(args.seconds, hostile)
        values |= {f"{name}_{key}": value for key, value in found.items()}
    values |= kill(args.kills) | import_rate(args.megabytes)
    for name, value in values.items():
        print(f"{name:28} {value:.4g}")
    write_values(args.json, values)


if __name__ == "__main__":
    cli.run(main, Args)
