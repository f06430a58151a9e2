"""The adaptive controller and the safety filter behind it."""

from .activation import Activation as Activation
from .activation import ActivationConfig as ActivationConfig
from .activation import HandOver as HandOver
from .config import ControllerConfig as ControllerConfig
from .controller import AdaptiveController as AdaptiveController
from .goals import Goals as Goals
from .interface import Command as Command
from .interface import ControllerState as ControllerState
from .interface import Observation as Observation
from .lyapunov import lyapunov_function as lyapunov_function
from .posture import clear_posture as clear_posture
from .posture import comfortable_posture as comfortable_posture
from .posture import comfortable_postures as comfortable_postures
from .safety import INTERVENTIONS as INTERVENTIONS
from .safety import SafetyConfig as SafetyConfig
from .safety import SafetyFilter as SafetyFilter
from .safety import SafetyReport as SafetyReport
from .safety import SafetyState as SafetyState
from .separation import SeparationConfig as SeparationConfig
from .table1 import GRIPPER_DOWN as GRIPPER_DOWN
from .table1 import INITIAL_IMAGE_JACOBIAN as INITIAL_IMAGE_JACOBIAN
from .table1 import table1_config as table1_config
from .table1 import table1_goals as table1_goals
from .table1 import table1_joint_region as table1_joint_region
from .watchdog import Watchdog as Watchdog
