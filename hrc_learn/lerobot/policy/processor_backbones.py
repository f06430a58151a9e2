"""LeRobot processors of `act_dmp` and `diffusion_dmp`, those of ACT and diffusion."""

from lerobot.policies.act.processor_act import (
    make_act_pre_post_processors as make_act_dmp_pre_post_processors,
)
from lerobot.policies.diffusion.processor_diffusion import (
    make_diffusion_pre_post_processors as make_diffusion_dmp_pre_post_processors,
)

__all__ = ["make_act_dmp_pre_post_processors", "make_diffusion_dmp_pre_post_processors"]
