"""Look of a scene that carries no markers: printed cartons, wood, clutter, shadows.

The physics stays that of the marked scene without its plates: clutter is seen, and touches
nothing. Frames of markers stay as sites, true places to measure against.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace

import cv2
import mujoco
import numpy as np
from jaxtyping import UInt8

from hrc_learn.sim.arm_model import add_box, add_picture
from hrc_learn.sim.scene import Look, SceneConfig

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.

# Texels along the longer edge of a print, and of the table.
_PRINT, _WOOD = 512, 1024


@dataclass(frozen=True, kw_only=True)
class UnmarkedLook(Look):
    """Things, light and prints of a scene without markers, drawn from a seed."""

    seed: int = 0
    """Seed of clutter and light; the same object has the same print in every scene."""
    clutter: int = 10
    """Papers and tools that lie about."""
    distractors: int = 2
    """Cartons like the object with another print."""
    shadows: bool = True
    """True: a lamp casts shadows."""

    def apply(self, spec: mujoco.MjSpec, config: SceneConfig) -> None:
        """Give a scene this look."""
        rng = np.random.default_rng([self.seed, 54])
        table, (x, y, z) = config.table, config.table.centre
        top = z + table.half_size[2]
        add_picture(spec, "wood", _wood(rng))
        spec.geom(table.name).material = "wood"
        spec.geom(table.name).rgba = np.append(rng.uniform(0.75, 1.0, 3), 1.0)
        for item in config.objects:
            add_picture(spec, f"{item.name}_print", carton(item.name, item.colour))
            spec.geom(item.name).material = f"{item.name}_print"
            spec.geom(item.name).rgba = (1.0, 1.0, 1.0, 1.0)
        item = config.objects[0]
        for k in range(self.clutter + self.distractors):
            # On the rim of the table, clear of where objects are put.
            side, along = rng.uniform(0.62, 0.95) * rng.choice([-1, 1]), rng.uniform(-0.9, 0.9)
            reach = (side, along) if rng.uniform() < 0.5 else (along, side)
            w, d, _ = table.half_size
            half = rng.uniform(0.01, 0.05, 3) * (1, 1, 0.3)
            name, colour = f"clutter{k}", (*rng.uniform(0.1, 0.9, 3), 1.0)
            if k >= self.clutter:
                half, name = np.array(item.half_size), f"distractor{k - self.clutter}"
                colour = item.colour if k == self.clutter else colour
            add_picture(spec, name, carton(f"{name} {self.seed}", colour))
            turn = rng.uniform(0, np.pi)
            add_box(
                spec.worldbody,
                name,
                half,
                (1.0, 1.0, 1.0, 1.0),
                pos=(x + reach[0] * (w - 0.06), y + reach[1] * (d - 0.06), top + half[2]),
                quat=(np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)),
                material=name,
                contype=0,
                conaffinity=0,
            )
        lamp = spec.lights[0]
        lamp.pos = np.array([x, y, 2.4]) + rng.uniform(-0.8, 0.8, 3) * (1, 1, 0.2)
        lamp.dir = np.array([x, y, 0.0]) - lamp.pos
        lamp.diffuse = np.full(3, rng.uniform(0.35, 0.65))
        lamp.castshadow = self.shadows
        spec.visual.quality.shadowsize = 2048 if self.shadows else 0


def unmarked(scene: SceneConfig, look: UnmarkedLook) -> SceneConfig:
    """The scene without any marker, with a look in their place."""
    arm = scene.arm
    if arm.marker is not None:
        arm = replace(arm, marker=replace(arm.marker, printed=False))
    return replace(scene, arm=arm, look=look)


def carton(
    name: str, colour: tuple[float, float, float, float]
) -> UInt8[np.ndarray, "height width 3"]:
    """Print of a carton: words, stripes, a badge and a table of small print, by its name."""
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    base = 255 * np.array(colour[:3])
    image = np.empty((_PRINT, _PRINT // 2, 3), np.uint8)
    image[:] = base
    inks = [rng.uniform(0, 255, 3).tolist() for _ in range(4)] + [(250, 250, 245), (20, 20, 25)]
    for _ in range(4):
        a, b = rng.integers(0, _PRINT, 2)
        ink = inks[rng.integers(len(inks))]
        cv2.line(image, (0, int(a)), (_PRINT // 2, int(b)), ink, int(rng.integers(4, 24)))
    middle = (int(rng.integers(60, 200)), int(rng.integers(90, 420)))
    cv2.circle(image, middle, int(rng.integers(30, 60)), inks[0], -1)
    cv2.circle(image, middle, int(rng.integers(12, 28)), inks[4], -1)
    for row in range(5):
        word = "".join(rng.choice(list("ABCDEFGHKLMNPRSTUVXYZ23456789"), 6))
        place = (int(rng.integers(0, 90)), 60 + 90 * row + int(rng.integers(0, 50)))
        size = float(rng.uniform(0.6, 1.8))
        cv2.putText(image, word, place, cv2.FONT_HERSHEY_DUPLEX, size, inks[4 + row % 2], 3)
    return image


def _wood(rng: np.random.Generator) -> UInt8[np.ndarray, "side side 3"]:
    """Grain along x: noise, drawn out, on the table's colour."""
    noise = rng.standard_normal((_WOOD, _WOOD)).astype(np.float32)
    grain = cv2.GaussianBlur(noise, (0, 0), sigmaX=40, sigmaY=1.5)
    level = 1 + 0.06 * grain / grain.std()
    return (level[..., None] * (205, 185, 160)).clip(0, 255).astype(np.uint8)
