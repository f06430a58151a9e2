"""What options choose from. The tests hold each to the package that knows best."""

from typing import Literal

Shelf = Literal["lower", "middle", "upper"]
"""Of `hrc_learn.sim.workplace.Workplace`."""
Camera = Literal["auto", "egl", "synthetic"]
"""`hrc_learn.sim.CameraKind`."""
Channel = Literal["joint", "position", "orientation", "pose"]
"""Keys of `hrc_learn.learning.channels.CHANNELS`."""
Scaling = Literal["none", "paper", "amplitude", "rotation"]
"""Keys of `hrc_learn.dmp.forcing_scale.SCALINGS`."""
Robot = Literal["panda"]
"""Arms that the simulated work cell has."""
Variant = Literal["learned", "unadapted", "kalman", "composite", "paper", "fixed", "none"]
"""Keys of `hrc_learn.experiments.grasping.experiment.VARIANTS`, and none of them."""
Experiment = Literal[
    "near",
    "global",
    "fixed",
    "paper",
    "printed",
    "jacobian_0.3",
    "jacobian_3",
    "row_flipped",
    "rows_swapped",
    "noise",
    "latency",
    "slow_camera",
    "tilt",
    "marker_lost",
    "effort",
    "effort_noise",
    "faulty_images",
    "composite",
    "least_squares",
    "broyden",
    "corners",
    "stress",
    "stress_nan",
    "stress_late",
    "stress_lost",
    "stress_1khz",
]
"""Keys of `hrc_learn.experiments.controller.sweep.EXPERIMENTS`."""
