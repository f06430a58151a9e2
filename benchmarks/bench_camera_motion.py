"""Detection rate of a moved camera, and rate of false alarms of a camera at rest.

Arms with the nominal imperfections of a laboratory (joint zeros, base, tool, encoder noise;
`Imperfections.nominal`) show their marker to cameras with lens distortion. The camera is fitted
to demonstrations. Then it is knocked during motions, and afterwards it rests for hours. Images
carry time stamps, so an unknown delay is not among the errors.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import math
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor

from hrc_learn import cli
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import (
    CameraReference,
    CameraWatch,
    ImageDemonstration,
)
from hrc_learn.jacobian.perspective import marker_pixels, moved
from hrc_learn.kinematics import panda
from hrc_learn.sim.imperfections import Imperfections

_FPS = 25.0
_IMAGE = (1440, 1080)
_TIME_TO_NOTICE = 2.0
_HOME = torch.tensor([0.0, 0.2, 0.0, -2.1, 0.0, 2.3, 0.8], dtype=torch.float64)
_SWING = 0.12  # standard deviation of each of three sines of a joint [rad]
_PERIOD = 12.0  # period of the slowest of these sines [s]
_PIXEL_NOISE = 0.15
"""Standard deviation of a marker's centre [px]; docs/benchmarks/kinematics.md gives 0.05 to
0.22."""
_MARKER = (0.0, 0.06, 0.03)


@dataclass(frozen=True, kw_only=True)
class Args:
    laboratories: int = 10
    """Number of pairs of arm and camera, drawn at random."""
    demonstrations: int = 10
    """Number of demonstrations with each pair, each 10 s long."""
    knocks: int = 10
    """Number of knocks of each size for each pair, in random directions across the view."""
    hours: float = 10.0
    """Total time of cameras at rest [h]."""
    seed: int = 0
    """Seed of all random numbers."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


class _Laboratory:
    """An arm with constant errors, in front of a camera that may be knocked."""

    def __init__(self, rng: np.random.Generator):
        self._rng, errors = rng, Imperfections.nominal()
        self._errors = errors
        self._zeros = torch.from_numpy(rng.uniform(-1, 1, 7) * errors.encoder_offset)
        self._tool = _small(rng, errors.tool_error, errors.tool_turn)
        turn = np.array([0.0, 0.0, rng.uniform(-1, 1) * errors.base_turn])
        self._base = Pose(
            torch.from_numpy(rng.uniform(-1, 1, 3) * errors.base_error),
            quaternion.exp(torch.from_numpy(turn)),
        )
        middle = panda.forward(_HOME).position.numpy()
        view = np.array([math.pi, 0.0, 0.0]) + rng.normal(0, 0.2, 3)
        rotation = quaternion.to_matrix(quaternion.exp(torch.from_numpy(view))).numpy()
        above = np.array([*rng.normal(0, 0.03, 2), rng.uniform(0.9, 1.3)])
        x, y, z = (above - rotation @ middle).tolist()
        optics = [math.log(rng.uniform(1100, 1800)), 720 + rng.normal(0, 10)]
        optics += [540 + rng.normal(0, 10), rng.uniform(-0.1, 0.0)]
        whole = [*optics, *view.tolist(), x, y, z, *_MARKER]
        self.camera = torch.tensor(whole, dtype=torch.float64)

    def motion(self, seconds: float) -> tuple[Pose, Pose, Float[Tensor, " frames"]]:
        """True poses, measured poses, and flags of images that arrived."""
        time = torch.arange(round(seconds * _FPS), dtype=torch.float64) / _FPS
        rate = 2 * math.pi / _PERIOD * torch.tensor([1.0, 1.7, 2.9], dtype=torch.float64)
        phase = torch.from_numpy(self._rng.uniform(0, 2 * math.pi, (3, 7)))
        size = torch.from_numpy(self._rng.normal(0, _SWING, (3, 7)))
        swing = torch.sin(time[:, None, None] * rate[:, None] + phase) * size
        q = _HOME + swing.sum(1)
        noise = torch.from_numpy(self._rng.normal(0, self._errors.encoder_noise, q.shape))
        true = self._base @ panda.forward(q + self._zeros) @ self._tool
        arrived = torch.from_numpy(self._rng.random(len(q)) > self._errors.image_loss)
        return true, panda.forward(q + noise), arrived

    def seen(self, true: Pose, camera: Float[Tensor, "13"]) -> Float[Tensor, "frames 2"]:
        pixels, _ = marker_pixels(camera, true)
        return pixels + torch.from_numpy(self._rng.normal(0, _PIXEL_NOISE, pixels.shape))

    def demonstration(self) -> ImageDemonstration:
        true, measured, arrived = self.motion(10.0)
        feature = self.seen(true, self.camera)
        return ImageDemonstration(pose=measured, feature=feature, visible=arrived)


def _small(rng: np.random.Generator, place: float, turn: float) -> Pose:
    return Pose(
        torch.from_numpy(rng.uniform(-1, 1, 3) * place),
        quaternion.exp(torch.from_numpy(rng.uniform(-1, 1, 3) * turn)),
    )


class _Knock(NamedTuple):
    name: str
    degrees: float
    millimetres: float

    def draw(self, rng: np.random.Generator) -> Float[np.ndarray, "6"]:
        """Random rotation and translation across the view."""
        angles = rng.uniform(0, 2 * math.pi, 2)
        turn, shift = (np.array([np.cos(a), np.sin(a), 0.0]) for a in angles)
        return np.concatenate(
            [np.deg2rad(self.degrees) * turn, 1e-3 * self.millimetres * shift]
        )


_KNOCKS = (
    _Knock("0.05 degrees", 0.05, 0.0),
    _Knock("0.1 degrees", 0.1, 0.0),
    _Knock("1 mm", 0.0, 1.0),
    _Knock("2 mm", 0.0, 2.0),
    _Knock("10 degrees and 10 cm", 10.0, 100.0),
)


def _noticed_after(laboratory: _Laboratory, watch: CameraWatch, twist: np.ndarray) -> float:
    """Time from a knock during a motion to the alarm [s]; infinite without one within 4 s."""
    watch.clear()
    true, measured, arrived = laboratory.motion(8.0)
    knocked = len(arrived) // 2
    before = laboratory.seen(true[:knocked], laboratory.camera)
    after = laboratory.seen(true[knocked:], moved(laboratory.camera, torch.from_numpy(twist)))
    pixels = torch.cat([before, after])
    for frame in arrived.nonzero()[:, 0].tolist():
        alarm = watch.update(frame / _FPS, measured[frame], pixels[frame])
        if alarm is not None and frame >= knocked:
            return (frame - knocked) / _FPS
    return math.inf


def _false_alarms(laboratory: _Laboratory, watch: CameraWatch, hours: float) -> tuple[int, int]:
    """Number of alarms, at most one per minute, and number of frames watched."""
    alarms = frames = 0
    for _ in range(round(hours * 60)):
        watch.clear()
        true, measured, arrived = laboratory.motion(60.0)
        pixels = laboratory.seen(true, laboratory.camera)
        seen = arrived.nonzero()[:, 0].tolist()
        frames += len(seen)
        said = [watch.update(frame / _FPS, measured[frame], pixels[frame]) for frame in seen]
        alarms += any(said)
    return alarms, frames


def main(args: Args) -> None:
    rng, console = np.random.default_rng(args.seed), Console()
    times: dict[str, list[float]] = {knock.name: [] for knock in _KNOCKS}
    thresholds, alarms, frames, spent = [], 0, 0, 0.0
    for _ in track(range(args.laboratories), description="Laboratories"):
        laboratory = _Laboratory(rng)
        demonstrations = [laboratory.demonstration() for _ in range(args.demonstrations)]
        watch = CameraWatch(CameraReference.fit(demonstrations, _FPS, _IMAGE))
        thresholds.append(watch.reference.threshold)
        for knock in _KNOCKS:
            times[knock.name] += [
                _noticed_after(laboratory, watch, knock.draw(rng)) for _ in range(args.knocks)
            ]
        start = process_time()
        more, watched = _false_alarms(laboratory, watch, args.hours / args.laboratories)
        spent, alarms, frames = spent + process_time() - start, alarms + more, frames + watched
    table = Table("camera moved by", f"noticed within {_TIME_TO_NOTICE:g} s", "median time [s]")
    figures: dict[str, float] = {}
    for name, after in times.items():
        share = float(np.mean(np.array(after) <= _TIME_TO_NOTICE))
        median = float(np.median(after))
        table.add_row(name, f"{100 * share:.0f} % of {len(after)}", f"{median:.2f}")
        figures |= {f"noticed, {name}": share, f"median time, {name}": median}
    console.print(table)
    console.print(
        f"false alarms: {alarms} in {args.hours:g} h; thresholds {min(thresholds):.1f} to "
        f"{max(thresholds):.1f} px; {1e6 * spent / max(frames, 1):.0f} us CPU a frame"
    )
    figures |= {"false alarms": alarms, "hours": args.hours}
    figures |= {"threshold, median": float(np.median(thresholds))}
    if args.json is not None:
        cli.write_json(args.json, figures)


if __name__ == "__main__":
    cli.run(main, Args)
