"""The adaptive controller and the safety filter behind it."""

from hrc_learn.controller.action_chunk_filter import BROKEN as BROKEN
from hrc_learn.controller.action_chunk_filter import ChunkSmoother as ChunkSmoother
from hrc_learn.controller.action_chunk_filter import SmoothReport as SmoothReport
from hrc_learn.controller.action_chunk_filter import SmoothState as SmoothState
from hrc_learn.controller.blending import Activation as Activation
from hrc_learn.controller.blending import ActivationConfig as ActivationConfig
from hrc_learn.controller.blending import HandOver as HandOver
from hrc_learn.controller.config import GRIPPER_DOWN as GRIPPER_DOWN
from hrc_learn.controller.config import INITIAL_IMAGE_JACOBIAN as INITIAL_IMAGE_JACOBIAN
from hrc_learn.controller.config import ControllerConfig as ControllerConfig
from hrc_learn.controller.config import table1_config as table1_config
from hrc_learn.controller.config import table1_goals as table1_goals
from hrc_learn.controller.config import table1_joint_region as table1_joint_region
from hrc_learn.controller.controller import AdaptiveController as AdaptiveController
from hrc_learn.controller.interface import Command as Command
from hrc_learn.controller.interface import ControllerState as ControllerState
from hrc_learn.controller.interface import Goals as Goals
from hrc_learn.controller.interface import Observation as Observation
from hrc_learn.controller.monitors import lyapunov_function as lyapunov_function
from hrc_learn.controller.motion_barriers import SeparationConfig as SeparationConfig
from hrc_learn.controller.safety_filter import INTERVENTIONS as INTERVENTIONS
from hrc_learn.controller.safety_filter import SafetyConfig as SafetyConfig
from hrc_learn.controller.safety_filter import SafetyFilter as SafetyFilter
from hrc_learn.controller.safety_filter import SafetyReport as SafetyReport
from hrc_learn.controller.safety_filter import SafetyState as SafetyState
from hrc_learn.controller.watchdog import Watchdog as Watchdog
