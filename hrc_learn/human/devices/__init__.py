"""Devices that lead the hand, as stand-ins for a haptic one."""

from .gamepad import Gamepad as Gamepad
from .gamepad import GamepadConfig as GamepadConfig
from .keyboard import TerminalKeyboard as TerminalKeyboard
