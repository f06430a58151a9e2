"""Online estimators of the image Jacobian, behind one interface."""

from hrc_learn.jacobian.estimators.broyden import BroydenConfig as BroydenConfig
from hrc_learn.jacobian.estimators.broyden import BroydenEstimator as BroydenEstimator
from hrc_learn.jacobian.estimators.estimator import FixedEstimator as FixedEstimator
from hrc_learn.jacobian.estimators.estimator import (
    ImageJacobianEstimator as ImageJacobianEstimator,
)
from hrc_learn.jacobian.estimators.estimator import Measurement as Measurement
from hrc_learn.jacobian.estimators.gradient import CompositeConfig as CompositeConfig
from hrc_learn.jacobian.estimators.gradient import CompositeEstimator as CompositeEstimator
from hrc_learn.jacobian.estimators.gradient import PaperEstimator as PaperEstimator
from hrc_learn.jacobian.estimators.recursive import KalmanConfig as KalmanConfig
from hrc_learn.jacobian.estimators.recursive import KalmanEstimator as KalmanEstimator
from hrc_learn.jacobian.estimators.recursive import LeastSquaresConfig as LeastSquaresConfig
from hrc_learn.jacobian.estimators.recursive import (
    RecursiveLeastSquaresEstimator as RecursiveLeastSquaresEstimator,
)
