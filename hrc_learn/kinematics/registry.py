"""Arms by name or file; registered_arms.toml says where descriptions are and what they lack."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.kinematics.arm import Arm
from hrc_learn.kinematics.collision import LinkCapsule
from hrc_learn.kinematics.described_arm import FittedBody, LimitsGiven, arm_from_file
from hrc_learn.kinematics.description import turn_to
from hrc_learn.kinematics.franka import fr3, panda
from hrc_learn.store import read_toml


class MissingModelError(ModuleNotFoundError):
    """The package that ships an arm's description is not installed."""


# Simulators whose descriptions alone are wanted, without what they require: gym-aloha's MuJoCo
# is older than ours, and robosuite's OpenCV takes the place of the headless one.
_INSTALL = {
    "example-robot-data": "hrc-learn[meshes]",
    "robosuite": "--no-deps robosuite==1.5.2",
    "gym-aloha": "--no-deps gym-aloha==0.1.5",
}
_OWN = {"panda": panda, "fr3": fr3}

CAPSULES = Path(__file__).with_name("capsules.json")
"""Capsules of registered arms, fitted by tools/fit_capsules.py."""


@cache
def _sources() -> Mapping[str, Mapping[str, Any]]:
    """Descriptions in installed packages, by the name of the arm."""
    return read_toml(Path(__file__).with_name("registered_arms.toml"))


def registered_arms() -> tuple[str, ...]:
    """Names that `arm` takes."""
    return (*_OWN, *sorted(_sources()))


def maker_of(name: str) -> str:
    """Manufacturer of a registered arm."""
    return "Franka Robotics" if name in _OWN else _sources()[name]["maker"]


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
        limits: Limits that replace or complete those of a file, by joint name, or a TOML file;
            None: the file named after it, `ur5e.limits.toml` for `ur5e.urdf`, if there is one.
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
    source = _sources()[name]
    path = _locate(name, source["package"], source["file"])
    settings = {key: source.get(key) for key in ("base", "tip", "limits", "ready")}
    if tool := source.get("tool"):
        settings["tool"] = torch.from_numpy(turn_to(np.array(tool["approach"])))
        settings["tool"][:3, 3] = torch.tensor(tool["origin"])
    settings |= choice
    if not choice.keys() & {"base", "tip", "tool"}:
        settings["body"] = _fitted_body(name, path)
    return arm_from_file(path, name=name, **settings)


def _locate(name: str, package: str, file: str) -> Path:
    try:
        path = Path(str(distribution(package).locate_file(file)))
    except PackageNotFoundError:
        raise MissingModelError(
            f"the description of {name} is in the package {package}: pip install "
            f"{_INSTALL[package]}",
            name=package,
        ) from None
    if not path.is_file():
        raise MissingModelError(
            f"{package} is installed without {file}: install it anew, or another version of it",
            name=package,
        )
    return path


def _fitted_body(name: str, description: Path) -> FittedBody | None:
    """Capsules and overlapping pairs of links; None if they were fitted to another file."""
    entry = json.loads(CAPSULES.read_text(encoding="utf-8")).get(name)
    digest = hashlib.sha256(description.read_bytes()).hexdigest()
    if entry is None or entry["description_sha256"] != digest:
        return None
    capsules = [
        LinkCapsule(link=link, start=tuple(start), end=tuple(end), radius=radius)
        for link, start, end, radius in entry["capsules"]
    ]
    return capsules, [(first, second) for first, second in entry["overlapping"]]


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
