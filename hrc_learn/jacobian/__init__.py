"""The image Jacobian: learned offline from demonstrations, adapted online."""

from hrc_learn.jacobian.camera_correction import CameraCorrection as CameraCorrection
from hrc_learn.jacobian.camera_correction import ObjectPlane as ObjectPlane
from hrc_learn.jacobian.camera_motion import CameraMotion as CameraMotion
from hrc_learn.jacobian.camera_motion import CameraPlacement as CameraPlacement
from hrc_learn.jacobian.camera_motion import CameraReference as CameraReference
from hrc_learn.jacobian.camera_motion import CameraWatch as CameraWatch
from hrc_learn.jacobian.camera_motion import camera_placements as camera_placements
from hrc_learn.jacobian.estimator import FixedEstimator as FixedEstimator
from hrc_learn.jacobian.estimator import ImageJacobianEstimator as ImageJacobianEstimator
from hrc_learn.jacobian.estimator import KeyFrameEstimator as KeyFrameEstimator
from hrc_learn.jacobian.estimator import Measurement as Measurement
from hrc_learn.jacobian.fitting import ImageJacobianFitConfig as ImageJacobianFitConfig
from hrc_learn.jacobian.fitting import ImageJacobianFitReport as ImageJacobianFitReport
from hrc_learn.jacobian.fitting import RBFCenters as RBFCenters
from hrc_learn.jacobian.fitting import grid as grid
from hrc_learn.jacobian.fitting import paper_grid as paper_grid
from hrc_learn.jacobian.learning_estimators import BroydenConfig as BroydenConfig
from hrc_learn.jacobian.learning_estimators import BroydenEstimator as BroydenEstimator
from hrc_learn.jacobian.learning_estimators import CompositeConfig as CompositeConfig
from hrc_learn.jacobian.learning_estimators import CompositeEstimator as CompositeEstimator
from hrc_learn.jacobian.learning_estimators import KalmanConfig as KalmanConfig
from hrc_learn.jacobian.learning_estimators import KalmanEstimator as KalmanEstimator
from hrc_learn.jacobian.learning_estimators import LeastSquaresConfig as LeastSquaresConfig
from hrc_learn.jacobian.learning_estimators import PaperEstimator as PaperEstimator
from hrc_learn.jacobian.learning_estimators import (
    RecursiveLeastSquaresEstimator as RecursiveLeastSquaresEstimator,
)
from hrc_learn.jacobian.model_selection import CellErrors as CellErrors
from hrc_learn.jacobian.model_selection import EvidenceConfig as EvidenceConfig
from hrc_learn.jacobian.model_selection import EvidenceResult as EvidenceResult
from hrc_learn.jacobian.model_selection import EvidenceRound as EvidenceRound
from hrc_learn.jacobian.model_selection import HeldOutSamples as HeldOutSamples
from hrc_learn.jacobian.model_selection import cross_validate as cross_validate
from hrc_learn.jacobian.model_selection import maximize_evidence as maximize_evidence
from hrc_learn.jacobian.motion_samples import ImageDemonstration as ImageDemonstration
from hrc_learn.jacobian.motion_samples import KeyFrameConfig as KeyFrameConfig
from hrc_learn.jacobian.motion_samples import image_demonstrations as image_demonstrations
from hrc_learn.jacobian.network import RBFImageJacobian as RBFImageJacobian
from hrc_learn.jacobian.network import stack_networks as stack_networks
from hrc_learn.jacobian.perspective import MarkerCamera as MarkerCamera
from hrc_learn.jacobian.perspective import depth_gradient as depth_gradient
from hrc_learn.jacobian.perspective import fit_focal_length as fit_focal_length
