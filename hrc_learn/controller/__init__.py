"""Control of an arm near people: adaptive controller, arm loop, and safety filter."""

from hrc_learn.controller.adaptive_controller import AdaptiveController as AdaptiveController
from hrc_learn.controller.adaptive_controller import ControllerConfig as ControllerConfig
from hrc_learn.controller.adaptive_controller import ControllerState as ControllerState
from hrc_learn.controller.arm_loop import ArmLoop as ArmLoop
from hrc_learn.controller.arm_loop_state import ArmLoopConfig as ArmLoopConfig
from hrc_learn.controller.arm_loop_state import ArmReading as ArmReading
from hrc_learn.controller.constraint_layer import ConstraintConfig as ConstraintConfig
from hrc_learn.controller.constraint_layer import Distances as Distances
from hrc_learn.controller.contact_limits import BODY_REGIONS as BODY_REGIONS
from hrc_learn.controller.contact_limits import ContactConfig as ContactConfig
from hrc_learn.controller.contact_limits import SeparationConfig as SeparationConfig
from hrc_learn.controller.interface import GRIPPER_DOWN as GRIPPER_DOWN
from hrc_learn.controller.interface import INITIAL_IMAGE_JACOBIAN as INITIAL_IMAGE_JACOBIAN
from hrc_learn.controller.interface import INTERVENTIONS as INTERVENTIONS
from hrc_learn.controller.interface import Command as Command
from hrc_learn.controller.interface import Goals as Goals
from hrc_learn.controller.interface import Observation as Observation
from hrc_learn.controller.interface import SafetyConfig as SafetyConfig
from hrc_learn.controller.interface import SafetyReport as SafetyReport
from hrc_learn.controller.interface import SafetyState as SafetyState
from hrc_learn.controller.resolved_rate import BlendingConfig as BlendingConfig
from hrc_learn.controller.safety_filter import SafetyFilter as SafetyFilter
from hrc_learn.controller.task_pace import WayMakingConfig as WayMakingConfig
from hrc_learn.controller.velocity_step import VelocityStep as VelocityStep
from hrc_learn.controller.velocity_step import WantedVelocity as WantedVelocity
