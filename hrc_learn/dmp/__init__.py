"""Dynamic movement primitives: learned motions that start, goal and duration reshape."""

from hrc_learn.dmp import coupling as coupling
from hrc_learn.dmp import force as force
from hrc_learn.dmp.basis import GaussianBasis as GaussianBasis
from hrc_learn.dmp.basis import PeriodicBasis as PeriodicBasis
from hrc_learn.dmp.canonical import ExponentialPhase as ExponentialPhase
from hrc_learn.dmp.context import PolynomialFeatures as PolynomialFeatures
from hrc_learn.dmp.contextual import ContextualDMP as ContextualDMP
from hrc_learn.dmp.distribution import DMPDistribution as DMPDistribution
from hrc_learn.dmp.joint import JointDMP as JointDMP
from hrc_learn.dmp.orientation import OrientationDMP as OrientationDMP
from hrc_learn.dmp.orientation import OrientationState as OrientationState
from hrc_learn.dmp.orientation import OrientationTrajectory as OrientationTrajectory
from hrc_learn.dmp.pose import PoseDMP as PoseDMP
from hrc_learn.dmp.pose_motion import PoseState as PoseState
from hrc_learn.dmp.pose_motion import PoseTrajectory as PoseTrajectory
from hrc_learn.dmp.report import FitReport as FitReport
from hrc_learn.dmp.rhythmic import fit_rhythmic as fit_rhythmic
from hrc_learn.dmp.selection import BasisSelection as BasisSelection
from hrc_learn.dmp.selection import select_basis_count as select_basis_count
from hrc_learn.dmp.spring import SpringDamper as SpringDamper
from hrc_learn.dmp.state import DMPState as DMPState
from hrc_learn.dmp.stepper import Stepper as Stepper
from hrc_learn.dmp.stepper import StepperState as StepperState
from hrc_learn.dmp.trajectory import Trajectory as Trajectory
