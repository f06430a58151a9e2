"""Registers the smooth robot and the smoothing steps of hrc_learn with LeRobot."""

from hrc_learn.lerobot import smoothing as smoothing
