"""At home in LeRobot: importing this registers what its command lines then know by name.

`--policy.discover_packages_path=hrc_learn.lerobot` does so, and so does installing
`plugins/lerobot_policy_dmp`. Networks, simulator, browser page and drivers are imported when
they are asked for.
"""

from . import envs as envs
from . import processor as processor
from . import robots as robots
from . import teleoperators as teleoperators
from .policy import DMPConfig as DMPConfig
