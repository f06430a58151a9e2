"""Registered robot arms: location of their descriptions, and values that these lack."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.kinematics.arm import Arm
from hrc_learn.kinematics.described_arm import LimitsGiven, arm_from_file
from hrc_learn.kinematics.description import turn_to
from hrc_learn.kinematics.franka import fr3, panda


class MissingModelError(ModuleNotFoundError):
    """The package that ships an arm's description is not installed."""


@dataclass(frozen=True, kw_only=True)
class _Source:
    """A description in an installed package."""

    maker: str
    package: str
    """Distribution that ships it."""
    file: str
    """Below the folder that packages are installed in."""
    base: str
    tip: str
    ready: tuple[float, ...]
    """Tool down in front of the base, or as near to that as the arm can [rad]."""
    tool: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    """Tool in the frame of the tip: origin [m] and the direction of approach, its z axis."""
    limits: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Limits missing in the file. Velocities are those of the ROS descriptions cited next to
    them: compare them with the data sheet before moving a real arm.
    """


def _degrees(*speeds: int | float, names: str, first: int = 1) -> dict[str, dict[str, float]]:
    """Limits of velocity, given in degrees per second, of joints that are numbered."""
    return {
        names.format(i): {"velocity": math.radians(speed)}
        for i, speed in enumerate(speeds, start=first)
    }


# Simulators whose descriptions alone are wanted, without what they require: gym-aloha's MuJoCo
# is older than ours, and robosuite's OpenCV takes the place of the headless one.
_INSTALL = {
    "example-robot-data": "hrc-learn[meshes]",
    "robosuite": "--no-deps robosuite==1.5.2",
    "gym-aloha": "--no-deps gym-aloha==0.1.5",
}
_ROBOTS = "cmeel.prefix/share/example-robot-data/robots"
_SUITE = "robosuite/models/assets/robots"
_H = math.pi / 2


def _universal(file: str) -> _Source:
    return _Source(
        maker="Universal Robots",
        package="example-robot-data",
        file=f"{_ROBOTS}/ur_description/urdf/{file}_robot.urdf",
        base="base_link",
        tip="tool0",
        ready=(0.0, -_H, _H, -_H, -_H, 0.0),
    )


_SOURCES = {
    "ur3": _universal("ur3"),
    "ur5": _universal("ur5"),
    "ur10": _universal("ur10"),
    "ur5e": _Source(
        maker="Universal Robots",
        package="robosuite",
        file=f"{_SUITE}/ur5e/robot.xml",
        base="base",
        tip="right_hand",
        ready=(0.0, -_H, _H, -_H, -_H, 0.0),
        # ros-industrial/universal_robot, ur_description/config/ur5e/joint_limits.yaml, which
        # has them from the UR5e's user manual 5.8: 180 degrees a second each.
        limits={"default": {"velocity": math.pi}},
    ),
    # The dimensions are those of the R800, not of the larger iiwa 14.
    "iiwa7": _Source(
        maker="KUKA",
        package="robosuite",
        file=f"{_SUITE}/iiwa/robot.xml",
        base="base",
        tip="right_hand",
        ready=(0.0, 0.65, 0.0, -1.89, 0.0, 0.6, 0.0),
        # lbr-stack/lbr_fri_ros2_stack, lbr_description/urdf/iiwa7/joint_limits.yaml.
        limits=_degrees(98, 98, 100, 130, 140, 180, 180, names="joint_{}"),
    ),
    "gen3": _Source(
        maker="Kinova",
        package="robosuite",
        file=f"{_SUITE}/kinova3/robot.xml",
        base="base",
        tip="right_hand",
        ready=(0.0, 0.65, 0.0, 1.89, 0.0, 0.6, -_H),
        # Kinovarobotics/ros_kortex, gen3/7dof/urdf/gen3_macro.xacro: large actuators 1.3963,
        # small ones 1.2218 rad/s; rounded down.
        limits=_degrees(*(79.64,) * 4, *(69.91,) * 3, names="Actuator{}"),
    ),
    "jaco": _Source(
        maker="Kinova",
        package="robosuite",
        file=f"{_SUITE}/jaco/robot.xml",
        base="base",
        tip="right_hand",
        ready=(3.192, 3.68, 0.0, 1.17, 0.05, 3.76, 3.142),
        # As example-robot-data's kinova.urdf has them of the j2s6s200, whose actuators these
        # are: 36 degrees a second, the wrist's joints 48.
        limits=_degrees(36, 36, 36, 36, 48, 48, 48, names="j2s7s300_joint_{}"),
    ),
    "sawyer": _Source(
        maker="Rethink Robotics",
        package="robosuite",
        file=f"{_SUITE}/sawyer/robot.xml",
        base="base",
        tip="right_hand",
        ready=(0.0, -1.18, 0.0, 2.18, 0.0, 0.57, 3.3161),
        # RethinkRobotics/sawyer_robot, sawyer_description/urdf/sawyer_base.urdf.xacro: 1.74,
        # 1.328, 1.957 twice, 3.485 twice and 4.545 rad/s.
        limits=_degrees(
            99.7, 76.1, 112.1, 112.1, 199.7, 199.7, 260.4, names="right_j{}", first=0
        ),
    ),
    "xarm7": _Source(
        maker="UFACTORY",
        package="example-robot-data",
        file=f"{_ROBOTS}/xarm_description/urdf/xarm7.urdf",
        base="link_base",
        tip="link_eef",
        ready=(0.0, -0.25, 0.0, 1.1, 0.0, 1.35, 0.0),
    ),
    "z1": _Source(
        maker="Unitree",
        package="example-robot-data",
        file=f"{_ROBOTS}/z1_description/urdf/z1.urdf",
        base="link00",
        tip="gripperStator",
        ready=(0.0, 1.5, -1.2, 1.0, 0.0, 0.0),
        tool=((0.12, 0.0, 0.0), (1.0, 0.0, 0.0)),
    ),
    "viperx": _Source(
        maker="Trossen Robotics",
        package="gym-aloha",
        file="gym_aloha/assets/bimanual_viperx_transfer_cube.xml",
        base="vx300s_left",
        tip="vx300s_left/gripper_link",
        ready=(0.0, -0.4, 0.6, 0.0, 1.3, 0.0),
        # Between the fingertips: where gym-aloha's own calibration sites are.
        tool=((0.15, 0.0, 0.0), (1.0, 0.0, 0.0)),
        # Interbotix/interbotix_ros_manipulators, vx300s.urdf.xacro: pi rad/s each.
        limits={"default": {"velocity": math.pi}},
    ),
    "so101": _Source(
        maker="The Robot Studio",
        package="example-robot-data",
        file=f"{_ROBOTS}/so_arm_description/urdf/so101.urdf",
        base="base_link",
        tip="gripper_frame_link",
        ready=(0.0, 0.0, 0.0, 1.4, 0.0),
    ),
}
_OWN = {"panda": panda, "fr3": fr3}


def registered_arms() -> tuple[str, ...]:
    """Names that `arm` takes."""
    return (*_OWN, *sorted(_SOURCES))


def maker_of(name: str) -> str:
    """Manufacturer of a registered arm."""
    return "Franka Robotics" if name in _OWN else _SOURCES[name].maker


def arm(
    name_or_file: str | Path,
    *,
    base: str | None = None,
    tip: str | None = None,
    tool: Float[Tensor, "4 4"] | None = None,
    limits: LimitsGiven = None,
    ready: Sequence[float] | None = None,
) -> Arm:
    """A robot arm by its name, or from a URDF or MJCF file.

    Args:
        name_or_file: One of `registered_arms()`, or a path that ends in .urdf, .xml or .mjcf.
        base: Link or body to be the base, of files; None: the root.
        tip: Link, body or site to be the flange, of files; None: the only end besides a
            gripper's.
        tool: Tool centre point in the frame of the flange, of files.
        limits: Replacements of limits, see `arm_from_file`.
        ready: A comfortable posture [rad, m].

    Raises:
        ValueError: There is no such name, or the file makes no serial chain.
        FileNotFoundError: The file, or a mesh that it names, is not there.
        MissingModelError: The package that ships the arm is not installed: says how to.
    """
    name, path = str(name_or_file), Path(name_or_file)
    choice = {"base": base, "tip": tip, "tool": tool, "limits": limits, "ready": ready}
    choice = {key: value for key, value in choice.items() if value is not None}
    if name in registered_arms():
        return _registered(name) if not choice else _described(name, choice)
    if path.suffix.lower() in (".urdf", ".xml", ".mjcf"):
        return arm_from_file(path, **choice)
    raise ValueError(
        f"no arm {name!r}: there are {', '.join(registered_arms())}, and files in URDF (.urdf) "
        "and MJCF (.xml, .mjcf)"
    )


@cache
def _registered(name: str) -> Arm:
    return _OWN[name] if name in _OWN else _described(name, {})


def _described(name: str, choice: Mapping[str, Any]) -> Arm:
    """A registered arm from its description, with some of its settings replaced."""
    if name in _OWN:
        raise ValueError(
            f"{name} is written in this package: {', '.join(choice)} cannot be chosen for it"
        )
    source = _SOURCES[name]
    settings: dict[str, Any] = {
        "name": name,
        "base": source.base,
        "tip": source.tip,
        "tool": None if source.tool is None else _placed(*source.tool),
        "limits": source.limits or None,
        "ready": source.ready,
    }
    return arm_from_file(_locate(name, source), **{**settings, **choice})


def _locate(name: str, source: _Source) -> Path:
    try:
        path = Path(str(distribution(source.package).locate_file(source.file)))
    except PackageNotFoundError:
        raise MissingModelError(
            f"the description of {name} is in the package {source.package}: pip install "
            f"{_INSTALL[source.package]}",
            name=source.package,
        ) from None
    if not path.is_file():
        raise MissingModelError(
            f"{source.package} is installed without {source.file}: install it anew, or another "
            f"version of it",
            name=source.package,
        )
    return path


def _placed(origin: Sequence[float], approach: Sequence[float]) -> Tensor:
    """A frame whose z axis has the direction `approach`."""
    T = torch.from_numpy(turn_to(torch.tensor(approach).double().numpy()))
    T[:3, 3] = torch.tensor(origin)
    return T


@dataclass(frozen=True)
class ArmChoice:
    """An arm by its name or file, as configurations keep it."""

    name: str = "panda"
    """Registered name, or a URDF or MJCF file."""
    base: str = ""
    """Base link of a file; empty: its root."""
    tip: str = ""
    """Flange link of a file, or BASE:TIP; empty: its only end."""

    def arm(self) -> Arm:
        """The arm as its description has it."""
        base, _, tip = self.tip.rpartition(":")
        return arm(self.name, base=base or self.base or None, tip=tip or None)

    def work_arm(self) -> Arm:
        """The arm with the hand of our work cell: two parallel fingers, as the Franka hand.

        Raises:
            ValueError: There is no such arm, or it has fewer than six joints.
        """
        return _equipped(self)


@cache
def _equipped(choice: ArmChoice) -> Arm:
    found = choice.arm()
    return found if found.is_franka else found.with_hand()
