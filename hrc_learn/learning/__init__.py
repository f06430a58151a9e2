"""Models of datasets: movement primitives and image Jacobians, with their errors."""

from hrc_learn.learning.model_choice import predict as predict
from hrc_learn.learning.primitive_fitting import FittedPrimitives as FittedPrimitives
from hrc_learn.learning.primitive_fitting import Motions as Motions
from hrc_learn.learning.primitive_fitting import fit_primitives as fit_primitives
from hrc_learn.learning.primitive_fitting import load_primitive as load_primitive
from hrc_learn.learning.reproduction_error import ReproductionError as ReproductionError
