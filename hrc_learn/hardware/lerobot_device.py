"""Open robots and teleoperators of LeRobot, and convert the units of their joints."""

from __future__ import annotations

import math
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

GRIPPER = "gripper.pos"
"""Name of a gripper's value in LeRobot: 0 to 100 % of its calibrated range."""
_ATTEMPTS = 3
_LONG = {"robot": "robot", "teleop": "teleoperator"}
"""Prefix of an option -> word in the names of LeRobot's packages, classes and functions."""
_STATUS_REGISTERS = ("Status", "Hardware_Error_Status")
"""Status registers of Feetech and Dynamixel servos; 0 means that there is no fault."""


def open_device(kind: Literal["robot", "teleop"], settings: Mapping[str, Any]) -> Any:
    """Connect to a robot or teleoperator of LeRobot.

    Args:
        kind: Robot or teleoperator.
        settings: LeRobot's settings, such as type, port and id, without the prefix "robot." or
            "teleop.".

    Raises:
        ValueError: There is no such type or setting, or one is missing.
        ConnectionError: The device cannot be reached, or is not calibrated.
        ModuleNotFoundError: LeRobot or the maker's SDK is not installed.
    """
    config, long = _config(kind, settings), _LONG[kind]
    place = f"--{kind}.type={settings['type']}"
    try:
        utils = import_module(f"lerobot.{long}s.utils")
        device = _connected(getattr(utils, f"make_{long}_from_config"), config)
    except ImportError as error:
        raise ModuleNotFoundError(
            f"{place} needs its maker's SDK: pip install 'lerobot[feetech]' (or [dynamixel]); "
            f"{in_words(error)}"
        ) from error
    except Exception as error:
        port = getattr(config, "port", None)
        raise ConnectionError(
            f"{place} cannot be reached{f' at {port}' if port else ''} ({in_words(error)}): "
            f"check cable, power and --{kind}.port (lerobot-find-port names it)."
        ) from error
    if not device.is_calibrated:
        with suppress(Exception):
            device.disconnect()
        raise ConnectionError(
            f"{place} has no calibration {config.id!r}, or its servos hold another one: run "
            f"lerobot-calibrate {place} --{kind}.id={config.id} first."
        )
    return device


def _connected(make: Callable[[Any], Any], config: Any) -> Any:
    """Connect in at most three attempts: LeRobot gives up at the first lost reply."""
    for attempt in range(_ATTEMPTS):
        device = make(config)
        try:
            device.connect(calibrate=False)
            return device
        except ConnectionError:
            with suppress(Exception):  # the port is open if the servos did not answer
                device.bus.disconnect(disable_torque=False)
            if attempt == _ATTEMPTS - 1:
                raise
    raise AssertionError


def _config(kind: str, settings: Mapping[str, Any]) -> Any:
    """Configuration of a device, as an instance of LeRobot's own class."""
    import_module("lerobot")  # without LeRobot, the error should name it
    draccus = import_module("draccus")
    package = import_module(f"lerobot.{_LONG[kind]}s")
    base = getattr(package, f"{_LONG[kind].capitalize()}Config")
    wanted = settings.get("type")
    if not isinstance(wanted, str):
        raise ValueError(f"--{kind}.type is missing: such as --{kind}.type=so101_follower")
    # LeRobot registers a type when its module is imported; some modules need an SDK.
    for module in pkgutil.iter_modules(package.__path__):
        if wanted in base.get_known_choices():
            break
        if module.ispkg:
            with suppress(ImportError):
                import_module(f"{package.__name__}.{module.name}")
    if wanted not in base.get_known_choices():
        import_module("lerobot.utils.import_utils").register_third_party_plugins()
    known = base.get_known_choices()
    if wanted not in known:
        close = get_close_matches(wanted, known, 1)
        hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(sorted(known))}"
        raise ValueError(f"--{kind}.type={wanted}: LeRobot has no such type; {hint}")
    values = {k: str(v) if k == "id" else v for k, v in settings.items()}
    try:
        return draccus.decode(base, values)
    except Exception as error:  # draccus raises several kinds of errors for the same mistake
        raise ValueError(f"--{kind}.*: {in_words(error)}") from error


def in_words(error: BaseException) -> str:
    """Message of an error in one line, at most 300 characters long."""
    return " ".join(str(error).split())[:300] or type(error).__name__


@dataclass(frozen=True, kw_only=True, eq=False)
class JointUnits:
    """Conversion between LeRobot's values of a device and joint positions in rad."""

    keys: tuple[str, ...]
    """Names of the values in LeRobot, in the order of the arm's joints."""
    scale: Float[np.ndarray, " joints"]
    """Radians per unit of each value."""
    zero: Float[np.ndarray, " joints"]
    """Position where the value is 0 [rad]."""
    span: Float[np.ndarray, " joints"]
    """Half of the calibrated range [rad]; infinite where there is none."""
    gripper: bool
    """True if the device has a gripper."""

    @classmethod
    def of(
        cls,
        device: Any,
        joint_names: Sequence[str],
        unit: str = "",
        zeros: Mapping[str, float] | None = None,
        reversed_joints: Sequence[str] = (),
    ) -> JointUnits:
        """Take the units from the calibration of a device.

        Args:
            device: Robot or teleoperator of LeRobot.
            joint_names: Joints of the arm: either with the device's names or in its order.
            unit: Unit of values without a calibration, "deg" or "rad".
            zeros: Joint positions at which LeRobot's values are 0 [rad].
            reversed_joints: Joints whose direction in LeRobot is opposite to the direction in
                the arm's description.

        Raises:
            ValueError: The joints of arm and device differ, or their unit is unknown.
        """
        named = [name for name, kind in device.action_features.items() if kind is float]
        motors = [name for name in named if name.endswith(".pos") and name != GRIPPER]
        keys = [f"{name}.pos" for name in joint_names]
        if not {*keys} <= {*motors}:
            if len(motors) != len(joint_names):
                raise ValueError(
                    f"{device.name} has {len(motors)} joints ({', '.join(motors)}), but the "
                    f"arm has {len(joint_names)} ({', '.join(joint_names)}): choose its "
                    "description by --robot NAME or FILE."
                )
            keys = motors
        zeros = dict(zeros or {})
        if unknown := {*zeros, *reversed_joints} - {*joint_names}:
            raise ValueError(
                f"zeros or reversed: no joint named {', '.join(sorted(unknown))}; joints are "
                f"{', '.join(joint_names)}."
            )
        scales, spans = zip(*(_rad_per_unit(device, key, unit) for key in keys), strict=True)
        sign = np.array([-1.0 if name in reversed_joints else 1.0 for name in joint_names])
        return cls(
            keys=tuple(keys),
            scale=sign * np.array(scales),
            zero=np.array([float(zeros.get(name, 0.0)) for name in joint_names]),
            span=np.array(spans),
            gripper=GRIPPER in named,
        )

    def observed(self, values: Mapping[str, Any]) -> tuple[Float[np.ndarray, " joints"], float]:
        """Joint positions [rad], and opening of the gripper as a fraction."""
        raw = np.array([float(values[key]) for key in self.keys])
        share = float(values[GRIPPER]) / 100 if self.gripper else 0.0
        return self.zero + self.scale * raw, share

    def action(
        self, joint_position: Float[np.ndarray, " joints"], share: float
    ) -> dict[str, float]:
        """LeRobot's action for joint positions [rad] and a gripper opening (fraction)."""
        raw = (joint_position - self.zero) / self.scale
        action = dict(zip(self.keys, map(float, raw), strict=True))
        return action | ({GRIPPER: 100 * share} if self.gripper else {})

    def alarms(self, device: Any) -> dict[str, int]:
        """Status of the servos by name, 0 without a fault; empty if they have no status."""
        bus = getattr(device, "bus", None)
        tables = getattr(bus, "model_ctrl_table", {})
        models = {motor.model for motor in getattr(bus, "motors", {}).values()}
        for register in _STATUS_REGISTERS:
            if models and all(register in tables.get(model, {}) for model in models):
                assert bus is not None
                return bus.sync_read(register, normalize=False, num_retry=2)
        return {}


def forget_late_replies(device: Any) -> None:
    """Discard late replies that a serial bus has received."""
    serial = getattr(getattr(getattr(device, "bus", None), "port_handler", None), "ser", None)
    if serial is not None:
        with suppress(Exception):  # the cable was pulled
            serial.reset_input_buffer()


class LeaderArm:
    """A teleoperator of LeRobot with the joints of an arm, such as the SO-101 leader."""

    def __init__(self, settings: Mapping[str, Any], joint_names: Sequence[str], *units: Any):
        """Connect; the ranges come from the leader's own calibration.

        LeRobot sends the values of a leader to its follower unchanged. Therefore both have the
        same unit, zeros and directions.

        Args:
            settings: LeRobot's settings of the teleoperator: type, port, id and others.
            joint_names: Joints of the arm that follows the leader.
            units: Unit, zeros and reversed joints of the follower, as in `JointUnits.of`.

        Raises:
            ValueError: There is no such type, or its joints are different.
            ConnectionError: The leader cannot be reached, or is not calibrated.
        """
        self._device = open_device("teleop", settings)
        self._units = JointUnits.of(self._device, joint_names, *units)

    def read(self) -> tuple[Float[np.ndarray, " joints"], float]:
        """Joint positions [rad], and opening of the gripper's handle as a fraction.

        Raises:
            ConnectionError: The leader does not answer.
        """
        return self._units.observed(self._device.get_action())

    def close(self) -> None:
        """Disconnect."""
        with suppress(Exception):  # the bus is gone
            self._device.disconnect()


def _rad_per_unit(device: Any, key: str, unit: str) -> tuple[float, float]:
    """Radians per unit of a joint's value, and half of its calibrated range [rad]."""
    if unit:
        return (math.pi / 180 if unit == "deg" else 1.0), math.inf
    bus = getattr(device, "bus", None)
    motor, name = getattr(bus, "motors", {}).get(key[: -len(".pos")]), key[: -len(".pos")]
    mode = getattr(getattr(motor, "norm_mode", None), "name", "")
    calibration = getattr(bus, "calibration", {}).get(name)
    resolution = getattr(bus, "model_resolution_table", {}).get(getattr(motor, "model", ""))
    half = math.inf
    if calibration is not None and resolution:
        # LeRobot counts resolution - 1 steps per turn.
        half = (calibration.range_max - calibration.range_min) * math.pi / (resolution - 1)
    if mode == "DEGREES":
        return math.pi / 180, half
    if mode == "RANGE_M100_100" and calibration is not None and math.isfinite(half):
        # In LeRobot, the drive mode reverses percentages of the range, but not degrees.
        return (-half if calibration.drive_mode else half) / 100, half
    raise ValueError(
        f"{device.name}: the unit of {key} is in no calibration: give --config "
        "site.lerobot.unit=deg, or rad."
    )
