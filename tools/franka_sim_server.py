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
import random
import signal
import socket
import struct
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from types import FrameType, SimpleNamespace
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
    parser.add_argument("--loss", type=float, default=0.0, help="share of packets lost, 0 to 1")
    parser.add_argument("--lenient", action="store_true", help="report violations only")
    parser.add_argument("--object", type=float, help="width of what is in the gripper [m]")
    parser.add_argument("--log", default="WARNING", help="level of the server's log")
    args = parser.parse_args()
    if not 0 <= args.loss < 1:
        parser.error(f"--loss must be in [0, 1), but is {args.loss}")
    os.environ.setdefault("FR3_MJCF", str(_MODEL))
    if not Path(os.environ["FR3_MJCF"]).is_file():
        parser.error(f"no model {os.environ['FR3_MJCF']}: run tools/make_franka_sim.sh first")
    logging.basicConfig(level=args.log, format="%(asctime)s %(levelname)s %(message)s")
    try:
        from franka_sim import FrankaSimServer  # pyright: ignore[reportMissingImports]
    except ImportError:
        parser.error("no franka-sim here: run this by .venv-franka-sim/bin/python")
    if args.loss:
        _lose_packets(args.loss)
    with suppress(OSError):  # where that is not allowed, other programs make states late
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
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


def _lose_packets(share: float) -> None:
    """Let sockets lose datagrams both ways: states that go out, answers that come in."""
    from franka_sim.server import state_stream  # pyright: ignore[reportMissingImports]

    rng = random.Random(0)

    class LossySocket(socket.socket):
        def sendto(self, data: bytes, *rest: Any) -> int:  # pyright: ignore[reportIncompatibleMethodOverride]
            return len(data) if rng.random() < share else super().sendto(data, *rest)

        def recvfrom(self, *rest: Any) -> tuple[bytes, Any]:
            received = super().recvfrom(*rest)
            if rng.random() < share:
                raise BlockingIOError  # as when nothing has come
            return received

    # Its own view of the module: sockets of TCP lose nothing.
    state_stream.socket = SimpleNamespace(**vars(socket) | {"socket": LossySocket})


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
