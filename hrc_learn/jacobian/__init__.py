"""The image Jacobian: learned offline from demonstrations, adapted online."""

from .basis import grid as grid
from .basis import paper_grid as paper_grid
from .estimators import BroydenEstimator as BroydenEstimator
from .estimators import CompositeEstimator as CompositeEstimator
from .estimators import FixedEstimator as FixedEstimator
from .estimators import ImageJacobianEstimator as ImageJacobianEstimator
from .estimators import KalmanEstimator as KalmanEstimator
from .estimators import Measurement as Measurement
from .estimators import PaperEstimator as PaperEstimator
from .estimators import RecursiveLeastSquaresEstimator as RecursiveLeastSquaresEstimator
from .fitting import ImageJacobianFitConfig as ImageJacobianFitConfig
from .fitting import ImageJacobianFitReport as ImageJacobianFitReport
from .network import RBFImageJacobian as RBFImageJacobian
