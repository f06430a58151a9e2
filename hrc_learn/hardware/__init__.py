"""Real arms, grippers and cameras; a driver is imported when its device is opened."""

from hrc_learn.hardware.franky_arm import FrankyArm as FrankyArm
