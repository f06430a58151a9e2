"""The adaptive controller and the safety filter behind it."""

from .safety import INTERVENTIONS as INTERVENTIONS
from .safety import SafetyConfig as SafetyConfig
from .safety import SafetyFilter as SafetyFilter
from .safety import SafetyReport as SafetyReport
from .safety import SafetyState as SafetyState
