"""Learn robot arm motions from a few demonstrations and work safely beside people.

The names of the core; demonstrations, simulation, vision and dashboards are imported from
their own packages: `hrc_learn.demos`, `.sim`, `.vision`, `.viz`.
"""

from hrc_learn.controller import AdaptiveController as AdaptiveController
from hrc_learn.controller import SafetyFilter as SafetyFilter
from hrc_learn.dmp import JointDMP as JointDMP
from hrc_learn.dmp import OrientationDMP as OrientationDMP
from hrc_learn.dmp import PoseDMP as PoseDMP
from hrc_learn.geometry import Pose as Pose
from hrc_learn.geometry import quaternion as quaternion
from hrc_learn.jacobian import RBFImageJacobian as RBFImageJacobian
from hrc_learn.kinematics import SerialChain as SerialChain
from hrc_learn.kinematics import panda as panda
