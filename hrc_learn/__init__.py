"""Learn robot arm motions from a few demonstrations and work safely beside people.

The names of the core; demonstrations, simulation, vision and dashboards are imported from
their own packages: `hrc_learn.demos`, `.sim`, `.vision`, `.viz`.
"""

from .controller import AdaptiveController as AdaptiveController
from .controller import SafetyFilter as SafetyFilter
from .dmp import JointDMP as JointDMP
from .dmp import OrientationDMP as OrientationDMP
from .dmp import PoseDMP as PoseDMP
from .geometry import Pose as Pose
from .geometry import quaternion as quaternion
from .jacobian import RBFImageJacobian as RBFImageJacobian
from .kinematics import SerialChain as SerialChain
from .kinematics import panda as panda
