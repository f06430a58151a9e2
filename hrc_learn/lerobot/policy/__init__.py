"""Movement primitives as a LeRobot policy, `dmp`."""

from .configuration_dmp import DMPConfig as DMPConfig
