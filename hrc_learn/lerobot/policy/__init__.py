"""Movement primitives as a LeRobot policy, `dmp`."""

from hrc_learn.lerobot.policy.configuration_dmp import DMPConfig as DMPConfig
