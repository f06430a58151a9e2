"""Dynamic movement primitives: learned motions that start, goal and duration reshape."""

from hrc_learn.dmp import _ude_formulation as _ude_formulation  # adds its formulation
from hrc_learn.dmp import coupling as coupling
from hrc_learn.dmp import orientation_error as orientation_error
from hrc_learn.dmp._arguments import FitReport as FitReport
from hrc_learn.dmp._closed_loop_step import DMPState as DMPState
from hrc_learn.dmp._closed_loop_step import continue_motion as continue_motion
from hrc_learn.dmp._fitting import FitOptions as FitOptions
from hrc_learn.dmp._shared_fit import SharedFit as SharedFit
from hrc_learn.dmp._shared_fit import fit_shared as fit_shared
from hrc_learn.dmp._system.bases import GaussianBasis as GaussianBasis
from hrc_learn.dmp._system.bases import LearnedGaussianBasis as LearnedGaussianBasis
from hrc_learn.dmp._system.bases import PeriodicBasis as PeriodicBasis
from hrc_learn.dmp._system.bases import SplineBasis as SplineBasis
from hrc_learn.dmp._system.closed_forms import ExponentialPhase as ExponentialPhase
from hrc_learn.dmp._system.closed_forms import SigmoidPhase as SigmoidPhase
from hrc_learn.dmp._system.closed_forms import SpringDamper as SpringDamper
from hrc_learn.dmp._system.response import Response as Response
from hrc_learn.dmp._system.response import Trajectory as Trajectory
from hrc_learn.dmp._system.response import response_of as response_of
from hrc_learn.dmp.batching import stack as stack
from hrc_learn.dmp.contextual_dmp import ContextualDMP as ContextualDMP
from hrc_learn.dmp.contextual_dmp import PolynomialFeatures as PolynomialFeatures
from hrc_learn.dmp.contextual_dmp import RidgeFit as RidgeFit
from hrc_learn.dmp.contextual_dmp import fit_ridge as fit_ridge
from hrc_learn.dmp.coordinate_adapter import CoordinateAdapter as CoordinateAdapter
from hrc_learn.dmp.dual_arm_dmp import DualArmDMP as DualArmDMP
from hrc_learn.dmp.dual_arm_dmp import DualArmState as DualArmState
from hrc_learn.dmp.exported_dmp import ExportedDMP as ExportedDMP
from hrc_learn.dmp.exported_dmp import load_stepper as load_stepper
from hrc_learn.dmp.framed_dmp import FramedDMP as FramedDMP
from hrc_learn.dmp.framed_dmp import Frames as Frames
from hrc_learn.dmp.interaction_primitive import InteractionEstimate as InteractionEstimate
from hrc_learn.dmp.interaction_primitive import InteractionPrimitive as InteractionPrimitive
from hrc_learn.dmp.joint_dmp import BasisSelection as BasisSelection
from hrc_learn.dmp.joint_dmp import JointDMP as JointDMP
from hrc_learn.dmp.joint_dmp import select_basis_count as select_basis_count
from hrc_learn.dmp.limited_dmp import LimitedDMP as LimitedDMP
from hrc_learn.dmp.limited_dmp import LimitedState as LimitedState
from hrc_learn.dmp.limited_dmp import LimitedTrajectory as LimitedTrajectory
from hrc_learn.dmp.limited_dmp import SoftLimits as SoftLimits
from hrc_learn.dmp.linear_primitive import LinearPrimitive as LinearPrimitive
from hrc_learn.dmp.mixture_dmp import MixtureDMP as MixtureDMP
from hrc_learn.dmp.motion_head import MotionDistribution as MotionDistribution
from hrc_learn.dmp.motion_head import MotionHead as MotionHead
from hrc_learn.dmp.motion_head import PlannedTrajectory as PlannedTrajectory
from hrc_learn.dmp.motion_primitive import AdaptedPrimitive as AdaptedPrimitive
from hrc_learn.dmp.motion_primitive import MotionPrimitive as MotionPrimitive
from hrc_learn.dmp.moving_goal_dmp import MovingGoalDMP as MovingGoalDMP
from hrc_learn.dmp.moving_goal_dmp import MovingGoalState as MovingGoalState
from hrc_learn.dmp.moving_goal_dmp import MovingTrajectory as MovingTrajectory
from hrc_learn.dmp.numpy_stepper import OrientationStepper as OrientationStepper
from hrc_learn.dmp.numpy_stepper import PoseStepper as PoseStepper
from hrc_learn.dmp.numpy_stepper import Stepper as Stepper
from hrc_learn.dmp.numpy_stepper import StepperState as StepperState
from hrc_learn.dmp.online_fit import OnlineFit as OnlineFit
from hrc_learn.dmp.orientation_dmp import OrientationDMP as OrientationDMP
from hrc_learn.dmp.orientation_dmp import OrientationState as OrientationState
from hrc_learn.dmp.orientation_dmp import OrientationTrajectory as OrientationTrajectory
from hrc_learn.dmp.pose_dmp import PoseDMP as PoseDMP
from hrc_learn.dmp.pose_dmp import PoseState as PoseState
from hrc_learn.dmp.pose_dmp import PoseTrajectory as PoseTrajectory
from hrc_learn.dmp.probabilistic_dmp import ProbabilisticDMP as ProbabilisticDMP
from hrc_learn.dmp.probabilistic_dmp import mean_primitive as mean_primitive
from hrc_learn.dmp.probabilistic_dmp import (
    via_point_primitive as via_point_primitive,
)
from hrc_learn.dmp.probabilistic_dmp import with_ends as with_ends
from hrc_learn.dmp.rhythmic_dmp import fit_rhythmic as fit_rhythmic
from hrc_learn.dmp.rhythmic_dmp import fit_rhythmic_orientation as fit_rhythmic_orientation
from hrc_learn.dmp.rhythmic_dmp import fit_rhythmic_pose as fit_rhythmic_pose

# Names of earlier versions.
force = coupling
MovingGoal = MovingGoalDMP
through = via_point_primitive
DMPDistribution = ProbabilisticDMP
PlacedBasis = LearnedGaussianBasis
