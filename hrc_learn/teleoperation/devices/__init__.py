"""Devices that move the end effector, as stand-ins for a haptic one."""

from hrc_learn.teleoperation.devices.gamepad import Gamepad as Gamepad
from hrc_learn.teleoperation.devices.gamepad import GamepadConfig as GamepadConfig
from hrc_learn.teleoperation.devices.keyboard import TerminalKeyboard as TerminalKeyboard
