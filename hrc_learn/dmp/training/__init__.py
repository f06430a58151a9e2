"""Gradient training of what no closed form gives: basis, gain, and losses of any kind."""

from hrc_learn.dmp.training.basis_training import learn_basis as learn_basis
from hrc_learn.dmp.training.trajectory_losses import Bounds as Bounds
from hrc_learn.dmp.training.trajectory_losses import Box as Box
from hrc_learn.dmp.training.trajectory_losses import Clearance as Clearance
from hrc_learn.dmp.training.trajectory_losses import Jerk as Jerk
from hrc_learn.dmp.training.trajectory_losses import Loss as Loss
from hrc_learn.dmp.training.trajectory_losses import Sphere as Sphere
from hrc_learn.dmp.training.trajectory_losses import Tracking as Tracking
from hrc_learn.dmp.training.trajectory_losses import Via as Via
from hrc_learn.dmp.training.weight_training import DescentConfig as DescentConfig
from hrc_learn.dmp.training.weight_training import History as History
from hrc_learn.dmp.training.weight_training import TrainingResult as TrainingResult
from hrc_learn.dmp.training.weight_training import train as train
