"""Gradient training of what no closed form gives: basis, gain, and losses of any kind."""

from hrc_learn.dmp.training.descent import DescentConfig as DescentConfig
from hrc_learn.dmp.training.descent import History as History
from hrc_learn.dmp.training.losses import Bounds as Bounds
from hrc_learn.dmp.training.losses import Clearance as Clearance
from hrc_learn.dmp.training.losses import Jerk as Jerk
from hrc_learn.dmp.training.losses import Loss as Loss
from hrc_learn.dmp.training.losses import Tracking as Tracking
from hrc_learn.dmp.training.losses import Via as Via
from hrc_learn.dmp.training.obstacles import Box as Box
from hrc_learn.dmp.training.obstacles import Sphere as Sphere
from hrc_learn.dmp.training.placement import learn_basis as learn_basis
from hrc_learn.dmp.training.result import TrainingResult as TrainingResult
from hrc_learn.dmp.training.weights import train as train
