"""Robot descriptions in URDF, with all numbers read in double precision."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from hrc_learn.geometry.shapes import Colour
from hrc_learn.kinematics._description import (
    Description,
    Joint,
    Link,
    Shape,
    Transform,
    transform,
)


def read_urdf(
    path: Path, package_dirs: Sequence[Path] = (), *, meshes: bool = True
) -> Description:
    """Read a file.

    Args:
        path: Path of the file.
        package_dirs: Folders in which `package://NAME/` is looked for, before those above the
            file and those of ROS_PACKAGE_PATH.
        meshes: False skips mesh files; links then have no mesh shapes.

    Raises:
        ValueError: The file is not URDF, or a number or an attribute in it is missing.
        FileNotFoundError: The file or a mesh is not there.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no robot description {path}")
    try:
        robot = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise ValueError(f"{path} is no XML: {error}") from None
    if any("xacro" in element.tag for element in robot.iter()):
        raise ValueError(f"{path} is a xacro file: make URDF of it with xacro first")
    if robot.tag != "robot":
        raise ValueError(f"{path} is no URDF: it begins with <{robot.tag}>, not with <robot>")
    reader = _Reader(path, robot, package_dirs, meshes)
    links = [reader.link(element) for element in robot.findall("link")]
    if not links:
        raise ValueError(f"{path} has no links: is it complete, and made from its xacro file?")
    joints = tuple(reader.joint(element) for element in robot.findall("joint"))
    named = {link.name: link for link in links}
    for joint in joints:
        for role, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in named:
                raise ValueError(
                    f"{path}: joint {joint.name} has the {role} {link!r}, but there is no such "
                    "link"
                )
    return Description(
        name=robot.get("name", path.stem),
        path=path,
        format="urdf",
        links=named,
        joints=joints,
    )


class _Reader:
    def __init__(
        self, path: Path, robot: ElementTree.Element, package_dirs: Sequence[Path], meshes: bool
    ):
        self.path, self.meshes = path, meshes
        self.materials = {
            material.get("name"): colour
            for material in robot.iter("material")
            if (colour := self._colour(material)) is not None
        }
        ros = [Path(p) for p in os.environ.get("ROS_PACKAGE_PATH", "").split(":") if p]
        self.folders = [*package_dirs, *path.resolve().parents, *ros]

    def link(self, element: ElementTree.Element) -> Link:
        name = self._attribute(element, "name", "a link")
        mass = element.find("inertial/mass")
        return Link(
            name=name,
            mass=None if mass is None else self._number(mass, "value", f"mass of {name}"),
            visuals=self._shapes(element, "visual", name),
            collisions=self._shapes(element, "collision", name),
        )

    def joint(self, element: ElementTree.Element) -> Joint:
        name = self._attribute(element, "name", "a joint")
        kind = self._attribute(element, "type", f"joint {name}")
        ends = {}
        for role in ("parent", "child"):
            end = element.find(role)
            if end is None:
                raise ValueError(f"{self.path}: joint {name} has no <{role}>")
            ends[role] = self._attribute(end, "link", f"<{role}> of joint {name}")
        axis = np.array([1.0, 0.0, 0.0])  # the default of URDF
        if (given := element.find("axis")) is not None and kind != "fixed":
            axis = self._numbers(given, "xyz", (1.0, 0.0, 0.0), f"joint {name}")
            length = np.linalg.norm(axis)
            if length == 0:
                raise ValueError(f"{self.path}: the axis of joint {name} is zero")
            axis = axis / length
        limit, mimic = element.find("limit"), element.find("mimic")
        bounds = {}
        if limit is not None:
            for key in ("lower", "upper", "velocity", "effort"):
                if limit.get(key) is not None:
                    bounds[key] = self._number(limit, key, f"limit of joint {name}")
        follows = None
        if mimic is not None:
            leader = self._attribute(mimic, "joint", f"<mimic> of joint {name}")
            factor, offset = float(mimic.get("multiplier", 1)), float(mimic.get("offset", 0))
            follows = (leader, factor, offset)
        return Joint(
            name=name,
            kind=kind,
            parent=ends["parent"],
            child=ends["child"],
            origin=self._origin(element, f"joint {name}"),
            axis=axis,
            follows=follows,
            **bounds,
        )

    def _shapes(self, link: ElementTree.Element, role: str, name: str) -> tuple[Shape, ...]:
        shapes = []
        for element in link.findall(role):
            what = f"<{role}> of link {name}"
            geometry = element.find("geometry/*")
            if geometry is None:
                continue
            colour = None
            if (material := element.find("material")) is not None:
                colour = self._colour(material) or self.materials.get(material.get("name"))
            place = {"pose": self._origin(element, what), "colour": colour}
            if geometry.tag == "mesh":
                if self.meshes:
                    path = self._mesh(self._attribute(geometry, "filename", what), what)
                    x, y, z = self._numbers(geometry, "scale", (1.0, 1.0, 1.0), what).tolist()
                    shapes.append(Shape(kind="mesh", path=path, scale=(x, y, z), **place))
            elif geometry.tag == "box":
                x, y, z = (self._numbers(geometry, "size", None, what) / 2).tolist()
                shapes.append(Shape(kind="box", size=(x, y, z), **place))
            elif geometry.tag in ("cylinder", "capsule", "sphere"):
                radius = self._number(geometry, "radius", what)
                half = 0.0
                if geometry.tag != "sphere":
                    half = self._number(geometry, "length", what) / 2
                shapes.append(Shape(kind=geometry.tag, size=(radius, half), **place))
        return tuple(shapes)

    def _mesh(self, name: str, what: str) -> Path:
        if name.startswith("package://"):
            package, _, rest = name.removeprefix("package://").partition("/")
            tried = [folder / package / rest for folder in self.folders]
            tried += [f / rest for f in self.folders if f.name == package]
        else:
            local = Path(name.removeprefix("file://"))
            tried = [local if local.is_absolute() else self.path.parent / local]
        for path in tried:
            if path.is_file():
                return path
        raise FileNotFoundError(
            f"{self.path}: the mesh {name} ({what}) is not there; package_dirs= names folders "
            "to look in, meshes=False does without"
        )

    def _origin(self, element: ElementTree.Element, what: str) -> Transform:
        origin = element.find("origin")
        if origin is None:
            return np.eye(4)
        zero = (0.0, 0.0, 0.0)
        p = self._numbers(origin, "xyz", zero, what)
        return transform(_rotation(*self._numbers(origin, "rpy", zero, what)), p)

    def _colour(self, material: ElementTree.Element) -> Colour | None:
        colour = material.find("color")
        if colour is None:
            return None
        r, g, b, a = self._numbers(colour, "rgba", None, "a colour", 4).tolist()
        return (r, g, b, a)

    def _attribute(self, element: ElementTree.Element, key: str, what: str) -> str:
        value = element.get(key)
        if value is None:
            raise ValueError(f"{self.path}: {what} has no {key}")
        return value

    def _number(self, element: ElementTree.Element, key: str, what: str) -> float:
        return float(self._numbers(element, key, None, what, 1)[0])

    def _numbers(
        self,
        element: ElementTree.Element,
        key: str,
        default: tuple[float, ...] | None,
        what: str,
        count: int = 3,
    ) -> np.ndarray:
        text = element.get(key)
        if text is None and default is not None:
            return np.array(default)
        try:
            values = [float(word) for word in self._attribute(element, key, what).split()]
        except ValueError:
            values = []
        if len(values) != count or not all(map(math.isfinite, values)):
            raise ValueError(
                f"{self.path}: {what} has {key}={text!r}, not {count} finite number"
                f"{'s' if count > 1 else ''}"
            )
        return np.array(values)


def _rotation(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Rz(yaw) Ry(pitch) Rx(roll): about the fixed axes x, y, z in turn."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (roll, pitch, yaw))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
