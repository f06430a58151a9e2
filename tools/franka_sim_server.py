"""Starts franka-sim, in its own environment, with all that it enforces: limits, lost packets.

    tools/make_franka_sim.sh
    .venv-franka-sim/bin/python tools/franka_sim_server.py --host 127.0.0.1 --trace arm.bin

libfranka knows one port only, 1337, and 1338 of the gripper: several servers run side by side
on loopback addresses of their own (127.0.0.2, ...). It says "listening" once it is ready.
The model is the copy that make_franka_sim.sh has made: nothing is downloaded.
"""

from __future__ import annotations

import argparse
import logging
import os
import signal
import struct
import sys
import threading
import time
from pathlib import Path
from types import FrameType
from typing import Any

_MODEL = Path(__file__).resolve().parents[1] / ".venv-franka-sim" / "model" / "fr3.xml"
_SAMPLE = struct.Struct("<23d")
"""Of the trace: time.monotonic() [s], time simulated [s], joint position [rad] and velocity
[rad/s] of the physics, and what the control box has as the commanded velocity [rad/s]."""
_EVERY = 1e-3
"""Between two samples [s]."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at")
    parser.add_argument("--trace", type=Path, help="receives what the arm does, each ms")
    parser.add_argument("--lenient", action="store_true", help="report violations only")
    parser.add_argument("--object", type=float, help="width of what is in the gripper [m]")
    parser.add_argument("--log", default="WARNING", help="level of the server's log")
    args = parser.parse_args()
    os.environ.setdefault("FR3_MJCF", str(_MODEL))
    if not Path(os.environ["FR3_MJCF"]).is_file():
        parser.error(f"no model {os.environ['FR3_MJCF']}: run tools/make_franka_sim.sh first")
    logging.basicConfig(level=args.log, format="%(asctime)s %(levelname)s %(message)s")
    try:
        from franka_sim import FrankaSimServer  # pyright: ignore[reportMissingImports]
    except ImportError:
        parser.error("no franka-sim here: run this by .venv-franka-sim/bin/python")
    server = FrankaSimServer(
        host=args.host,
        gripper_object_width=args.object,
        enforce_comm_constraints=not args.lenient,
        enforce_motion_limits=not args.lenient,
    )

    def end(number: int, frame: FrameType | None) -> None:
        raise SystemExit(0)

    signal.signal(signal.SIGTERM, end)
    watch = threading.Thread(target=_watch, args=(server, args.trace), daemon=True)
    watch.start()
    try:
        server.start()
    except KeyboardInterrupt:
        pass
    finally:
        server.stop()


def _watch(server: Any, trace: Path | None) -> None:
    """Say when the server listens, then write what the arm does."""
    simulation = server.physics_sim
    while not simulation.running:
        time.sleep(0.01)
    print("listening", flush=True)
    if trace is None:
        return
    with trace.open("wb", buffering=0) as file:
        while True:
            state = simulation.get_robot_state()
            command = server.robot_state.state["dq_d"]
            now = time.monotonic()
            sample = (now, simulation.data.time, *state["q"], *state["dq"], *command)
            file.write(_SAMPLE.pack(*sample))
            time.sleep(_EVERY)


if __name__ == "__main__":
    sys.exit(main())
