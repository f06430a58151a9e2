"""Serial arms: forward kinematics, Jacobians and their inverses; the Panda."""

from .arm_angle import arm_angle as arm_angle
from .arm_angle import arm_angle_and_motion as arm_angle_and_motion
from .capsules import Capsule as Capsule
from .capsules import CapsuleArm as CapsuleArm
from .chain import SerialChain as SerialChain
from .franka import FrankaArm as FrankaArm
from .franka import panda as panda
from .inverse import UnreachableError as UnreachableError
from .limits import JointLimits as JointLimits
from .limits import MotionLimits as MotionLimits
from .panda_capsules import LINK_CAPSULES as LINK_CAPSULES
from .panda_capsules import panda_capsules as panda_capsules
from .pseudo_inverse import null_space_projector as null_space_projector
from .pseudo_inverse import pseudo_inverse as pseudo_inverse
from .pseudo_inverse import singularity_damping as singularity_damping
from .pytorch_kinematics import from_pytorch_kinematics as from_pytorch_kinematics
from .pytorch_kinematics import to_pytorch_kinematics as to_pytorch_kinematics
from .urdf import to_urdf as to_urdf
