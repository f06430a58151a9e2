"""Look of a scene that carries no markers: printed cartons, wood, clutter, shadows.

The physics stays that of the marked scene without its plates: clutter is seen, and touches
nothing. Frames of markers stay as sites, true places to measure against.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from jaxtyping import Float

from hrc_learn.sim.arm_model import add_box, add_picture
from hrc_learn.sim.scene import Look, SceneConfig
from hrc_learn.vision.imaging import carton, wood_grain

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.


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
        add_picture(spec, "wood", wood_grain(rng))
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


def unmarked(
    scene: SceneConfig, look: UnmarkedLook, place: Float[np.ndarray, "3"] | None = None
) -> SceneConfig:
    """The scene without any marker, with a look in their place.

    Args:
        scene: Scene with markers.
        look: Look of the scene.
        place: Place on the tool that stands for it, in the tool's frame [m]: measures refer to
            it. None: where the marker was.
    """
    arm, plate = scene.arm, scene.arm.marker
    if plate is not None:
        plate = replace(plate, printed=False)
        if place is not None:
            x, y, z = place.tolist()
            behind = float(arm.robot.tcp[:3, 3].norm())
            plate = replace(plate, position=(x, y, z + behind))
        arm = replace(arm, marker=plate)
    return replace(scene, arm=arm, look=look)
