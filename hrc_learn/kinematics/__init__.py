"""Serial arms: forward kinematics, Jacobians and their inverses; the Panda."""

from hrc_learn.kinematics.chain import JointLimits as JointLimits
from hrc_learn.kinematics.chain import MotionLimits as MotionLimits
from hrc_learn.kinematics.chain import SerialChain as SerialChain
from hrc_learn.kinematics.collision import CapsuleArm as CapsuleArm
from hrc_learn.kinematics.collision import LinkCapsule as LinkCapsule
from hrc_learn.kinematics.franka import LINK_CAPSULES as LINK_CAPSULES
from hrc_learn.kinematics.franka import FrankaArm as FrankaArm
from hrc_learn.kinematics.franka import UnreachableError as UnreachableError
from hrc_learn.kinematics.franka import panda as panda
from hrc_learn.kinematics.franka import panda_body as panda_body
from hrc_learn.kinematics.franka import panda_capsules as panda_capsules
from hrc_learn.kinematics.interchange import from_pytorch_kinematics as from_pytorch_kinematics
from hrc_learn.kinematics.interchange import to_pytorch_kinematics as to_pytorch_kinematics
from hrc_learn.kinematics.interchange import to_urdf as to_urdf
from hrc_learn.kinematics.redundancy import SINGULAR_BELOW as SINGULAR_BELOW
from hrc_learn.kinematics.redundancy import arm_angle as arm_angle
from hrc_learn.kinematics.redundancy import arm_angle_and_motion as arm_angle_and_motion
from hrc_learn.kinematics.redundancy import clear_posture as clear_posture
from hrc_learn.kinematics.redundancy import comfortable_posture as comfortable_posture
from hrc_learn.kinematics.redundancy import comfortable_postures as comfortable_postures
from hrc_learn.kinematics.redundancy import null_space_projector as null_space_projector
from hrc_learn.kinematics.redundancy import pseudo_inverse as pseudo_inverse
from hrc_learn.kinematics.redundancy import singularity_damping as singularity_damping
from hrc_learn.kinematics.tool_orientation import coarse_orientation as coarse_orientation
from hrc_learn.kinematics.tool_orientation import gripper_down as gripper_down
