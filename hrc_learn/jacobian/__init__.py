"""The image Jacobian: learned offline from demonstrations, adapted online."""

from hrc_learn.jacobian.estimators.broyden import BroydenEstimator as BroydenEstimator
from hrc_learn.jacobian.estimators.estimator import FixedEstimator as FixedEstimator
from hrc_learn.jacobian.estimators.estimator import (
    ImageJacobianEstimator as ImageJacobianEstimator,
)
from hrc_learn.jacobian.estimators.estimator import Measurement as Measurement
from hrc_learn.jacobian.estimators.gradient import CompositeEstimator as CompositeEstimator
from hrc_learn.jacobian.estimators.gradient import PaperEstimator as PaperEstimator
from hrc_learn.jacobian.estimators.recursive import KalmanEstimator as KalmanEstimator
from hrc_learn.jacobian.estimators.recursive import (
    RecursiveLeastSquaresEstimator as RecursiveLeastSquaresEstimator,
)
from hrc_learn.jacobian.evidence import Learned as Learned
from hrc_learn.jacobian.evidence import LearningConfig as LearningConfig
from hrc_learn.jacobian.evidence import learn as learn
from hrc_learn.jacobian.fitting import ImageJacobianFitConfig as ImageJacobianFitConfig
from hrc_learn.jacobian.fitting import ImageJacobianFitReport as ImageJacobianFitReport
from hrc_learn.jacobian.held_out_error import CellErrors as CellErrors
from hrc_learn.jacobian.held_out_error import held_out_pairs as held_out_pairs
from hrc_learn.jacobian.network import RBFImageJacobian as RBFImageJacobian
from hrc_learn.jacobian.network import nominal_network as nominal_network
from hrc_learn.jacobian.network import stacked as stacked
from hrc_learn.jacobian.radial_basis import grid as grid
from hrc_learn.jacobian.radial_basis import paper_grid as paper_grid
from hrc_learn.jacobian.rbf_centers import Neurons as Neurons
from hrc_learn.jacobian.samples import Watched as Watched
from hrc_learn.jacobian.samples import watched as watched
