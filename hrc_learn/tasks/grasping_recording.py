"""A grasp as it is shown: what every run records, and which region pulled when."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float

from ..viz import Box, RunRecording
from ..kinematics import panda
from .aiming import AimingConfig
from .recording import record
from .simulated_grasp import SimulatedGrasp


@dataclass(frozen=True, kw_only=True, eq=False)
class RegionActivity:
    """Which feedback led the arm, and how far it still was; NaN while nothing was aimed at."""

    approach: Float[np.ndarray, " time"]
    """Share of the joint-space approach."""
    cartesian: Float[np.ndarray, " time"]
    """Share of the Cartesian regions."""
    vision: Float[np.ndarray, " time"]
    """Share of the vision region, which acts beside the Cartesian ones."""
    potentials: dict[str, Float[np.ndarray, " time"]]
    """Of each region."""

    @classmethod
    def of(cls, run: SimulatedGrasp, config: AimingConfig) -> "RegionActivity":
        """From what was logged."""
        log, above = run.station.log, run.setting.workplace.hover()
        aimed = np.isfinite(log["target"]).all(axis=1)
        seen = aimed & np.isfinite(log["feature"]).all(axis=1)
        hand = panda.forward(torch.from_numpy(log["joint_position"]))
        goals = config.goals(above, np.zeros(2))
        turned = np.where(aimed, goals.orientation.potential(hand.orientation).numpy(), np.nan)
        vision = np.full_like(turned, np.nan)
        for k in np.flatnonzero(seen):
            region = config.goals(above, log["target"][k]).vision
            vision[k] = float(region.potential(torch.from_numpy(log["feature"][k])))
        level = log["vision_activation"]
        position = log["potential"] - turned - np.nan_to_num(level * vision)
        return cls(
            approach=log["approach"],
            cartesian=1 - log["approach"],
            vision=level,
            potentials={
                "position": position.clip(min=0),
                "orientation": turned,
                "vision": vision,
            },
        )


def record_grasp(run: SimulatedGrasp, config: AimingConfig, title: str) -> RunRecording:
    """Everything worth looking at in a grasp.

    Args:
        run: What happened.
        config: How it was aimed.
        title: What it was.
    """
    hover = run.setting.workplace.hover().position.tolist()
    region = Box(centre=(hover[0], hover[1], hover[2]), half_size=config.half_size)
    recording = record(title, run.station, run.world, run.motion, region=region)
    activity = RegionActivity.of(run, config)
    shares = {
        "share of the joint-space approach": activity.approach,
        "share of the camera": activity.vision,
    }
    return replace(
        recording, potentials={**recording.potentials, **activity.potentials, **shares}
    )
