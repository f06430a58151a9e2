"""Cost of logging for the control loop, of writing a recording, and of a camera image.

The logged row is that of the collaboration task: 62 numbers and a flag in 13 columns. The floor
is one bare NumPy row of the same width. `log_live_us` is the time of the row while another
thread sends all rows to a viewer: CPU time of the loop's thread alone, without its waiting time
for the interpreter. Medians of CPU time on one thread, of calls made in turn.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rerun as rr
from timing import time_calls

from hrc_learn import cli
from hrc_learn.log import CameraRecording, RunRecording, StepLog
from hrc_learn.vision import CameraModel, Marker, MarkerDetector, SyntheticCamera
from hrc_learn.viz.run_dashboard import LogStream, live_sender, record_run

# number of calls timed together, since one is shorter than the resolution of the clock
STEPS = 200
TARGETS = {"log_step_us": 5.0, "log_live_us": 5.0, "camera_ms": 4.0, "detect_ms": 4.0}


@dataclass(frozen=True, kw_only=True)
class Args:
    repeats: int = 200
    """Number of calls of each kind."""
    seconds: float = 60.0
    """Duration of the run that is written as a recording, at 125 steps per second."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


def main(args: Args) -> None:
    """Measure, print a table with the targets, and write the measured values."""
    cv2.setNumThreads(1)
    figures = measure_log(args.repeats) | measure_live(args.repeats)
    figures |= measure_vision(args.repeats)
    figures |= measure_recording(args.seconds)
    for name, value in figures.items():
        target = f"   target <= {TARGETS[name]:g}" if name in TARGETS else ""
        print(f"{name:24s} {value:10.3g}{target}")
    if args.json:
        cli.write_json(args.json, figures)


def measure_log(repeats: int) -> dict[str, float]:
    """Microseconds per step."""
    values = step_values()
    width = sum(np.size(value) for value in values.values())
    rows, row = np.zeros((STEPS, width)), np.zeros(width)
    log = StepLog()

    def bare() -> None:
        for k in range(STEPS):
            rows[k] = row

    def append() -> None:
        for _ in range(STEPS):
            log.append(**values)

    calls: dict[str, Callable[[], object]] = {
        "log_floor_us": bare,
        "log_step_us": append,
    }
    timings = time_calls(calls, repeats)
    return {name: 1e6 * timing.median / STEPS for name, timing in timings.items()}


def measure_live(repeats: int) -> dict[str, float]:
    """Microseconds of the loop's thread per step, while another thread sends every step."""
    values = step_values()
    log, spent = StepLog(), []
    columns = [name for name in values if name != "time"]
    stream = rr.RecordingStream("benchmark")
    with tempfile.TemporaryDirectory() as folder:
        stream.save(Path(folder) / "live.rrd")
        with live_sender(LogStream(log, stream, columns).send, period=0.05):
            for k in range(repeats):
                began = time.thread_time()
                for step in range(STEPS):
                    values["time"] = (k * STEPS + step) / 1000
                    log.append(**values)
                spent.append(time.thread_time() - began)
                time.sleep(STEPS / 10_000)  # a loop waits for its next tick
        stream.disconnect()
    return {"log_live_us": 1e6 * float(np.median(spent)) / STEPS}


def step_values() -> dict[str, np.ndarray | float | bool]:
    """Values that a step of the collaboration task logs."""
    joints = {f"joint_{name}": np.zeros(7) for name in ("position", "command", "effort")}
    pixels = {name: np.zeros(2) for name in ("feature", "target")}
    return {
        "time": 0.0,
        **joints,
        **pixels,
        "feature_visible": True,
        "image_jacobian": np.zeros((2, 6)),
        "weight_norm": 0.0,
        "position": np.zeros(3),
        "orientation": np.zeros(4),
        "region_gradient": np.zeros(6),
        "safety": np.zeros(10),
    }


def measure_vision(repeats: int) -> dict[str, float]:
    """Milliseconds per image of 1440x1080, one marker 80 px wide."""
    model = CameraModel().look_at(np.array([0.5, 0.0, 1.3]), np.array([0.5, 0.0, 0.0]))
    pose = np.eye(4)
    pose[:3, 3] = [0.55, 0.1, 0.3]
    marker = Marker(7, 0.06)
    camera = SyntheticCamera(model, [marker], lambda: {7: pose}, rng=np.random.default_rng(0))
    image = camera.read()
    # marker 8 is not in the image
    tracking, blind = MarkerDetector([7]), MarkerDetector([7, 8])
    timings = time_calls(
        {
            "camera_ms": camera.read,
            "detect_ms": lambda: tracking.detect(image),
            "detect_missing_ms": lambda: blind.detect(image),
        },
        repeats,
    )
    return {name: 1e3 * timing.median for name, timing in timings.items()}


def measure_recording(seconds: float) -> dict[str, float]:
    """CPU seconds and megabytes of one recording, with three images per second."""
    run = long_run(seconds)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.rrd"
        timing = time_calls({"record": lambda: record_run(path, run)}, 3)["record"]
        return {"record_s": timing.median, "record_mb": path.stat().st_size / 1e6}


def long_run(seconds: float) -> RunRecording:
    """A run in which the largest fields are filled."""
    times = np.arange(0.0, seconds, 1 / 125)
    steps = len(times)
    model = CameraModel()
    feature = np.stack([700 + 50 * np.sin(times), 500 + 50 * np.cos(times)], axis=-1)
    frames = int(3 * seconds)
    image = SyntheticCamera(model, [], dict, rng=np.random.default_rng(0)).read()
    camera = CameraRecording(
        model=model,
        feature=feature,
        target=np.full_like(feature, 700.0),
        image_time=np.linspace(0.0, seconds, frames),
        images=(image,) * frames,
    )
    return RunRecording(
        title="benchmark",
        time=times,
        joint_names=tuple(f"joint{i}" for i in range(1, 8)),
        joint_position=np.sin(times[:, None] + np.arange(7)),
        position=np.sin(times[:, None] + np.arange(3)),
        camera=camera,
        image_jacobian=np.random.default_rng(0).normal(size=(steps, 2, 6)),
        nullspace_input=np.zeros((steps, 7)),
    )


if __name__ == "__main__":
    cli.run(main, Args)
