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
from .gathering import Watched as Watched
from .gathering import watched as watched
from .held_out import CellErrors as CellErrors
from .held_out import held_out_pairs as held_out_pairs
from .learning import Learned as Learned
from .learning import LearningConfig as LearningConfig
from .learning import learn as learn
from .network import RBFImageJacobian as RBFImageJacobian
from .neurons import Neurons as Neurons
from .nominal import nominal_network as nominal_network
from .stacking import stacked as stacked
