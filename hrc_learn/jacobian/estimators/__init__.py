"""Online estimators of the image Jacobian, behind one interface."""

from .broyden import BroydenConfig as BroydenConfig
from .broyden import BroydenEstimator as BroydenEstimator
from .composite import CompositeConfig as CompositeConfig
from .composite import CompositeEstimator as CompositeEstimator
from .fixed import FixedEstimator as FixedEstimator
from .interface import ImageJacobianEstimator as ImageJacobianEstimator
from .interface import Measurement as Measurement
from .kalman import KalmanConfig as KalmanConfig
from .kalman import KalmanEstimator as KalmanEstimator
from .paper import PaperEstimator as PaperEstimator
from .recursive_least_squares import LeastSquaresConfig as LeastSquaresConfig
from .recursive_least_squares import (
    RecursiveLeastSquaresEstimator as RecursiveLeastSquaresEstimator,
)
