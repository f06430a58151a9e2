"""Robot descriptions in URDF, with all numbers read in double precision."""

import math
import os
import re
import warnings
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from hrc_learn.geometry.shapes import Colour
from hrc_learn.kinematics.description import (
    Description,
    Joint,
    Link,
    Shape,
    Transform,
    motion,
    pseudo_inertia,
)

_BOUNDS = ("lower", "upper", "velocity", "effort")
# `_WORDS`: attributes that hold text. `_NOT_FINITE`: in all other attributes, these words are
# numbers that are not finite.
_WORDS = ("name", "link", "joint", "type", "filename")
_NOT_FINITE = re.compile(r"\b(nan|inf|infinity)\b", re.IGNORECASE)


def read_urdf(path: Path) -> Description:
    """Read a URDF file. As in urdfdom, the file may have blank first lines, undeclared
    namespaces and unused xacro properties.

    Meshes `package://NAME/...` are looked for in the folders above the file and in
    ROS_PACKAGE_PATH. Missing meshes are left out, and a warning names the first one.

    Raises:
        ValueError: The file is not URDF, holds unexpanded xacro, lacks an attribute, or
            describes no tree.
        FileNotFoundError: The file does not exist.
    """
    robot = _parsed(path)
    if robot.tag != "robot":
        text = f"{path} is neither URDF nor MJCF: it begins with <{robot.tag}>, not with"
        raise ValueError(f"{text} <robot> or <mujoco>")
    _check_texts(path, robot)
    reader = _Reader(path, robot)
    links = [reader.link(element) for element in robot.findall("link")]
    joints = [reader.joint(element) for element in robot.findall("joint")]
    if reader.missing:
        warnings.warn(
            f"{path}: {len(reader.missing)} meshes are missing, such as {reader.missing[0]}: "
            "links without shapes get capsules (set ROS_PACKAGE_PATH to find packages)",
            stacklevel=2,
        )
    return Description(path, links, joints)


def _parsed(path: Path) -> ElementTree.Element:
    """Elements of an XML file, with the prefixes of their names unchanged."""
    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    try:
        parser.Parse(path.read_bytes().lstrip(b"\xef\xbb\xbf \t\r\n"), True)
    except expat.ExpatError as error:
        raise ValueError(f"{path} is no XML: {error}") from None
    return builder.close()


def _check_texts(path: Path, robot: ElementTree.Element) -> None:
    """Raise a ValueError if a number is not finite, or xacro other than properties is left."""
    names = [key for key, value in robot.attrib.items() if "xacro" in value]
    prefixes = ("xacro:", *(f"{name.removeprefix('xmlns:')}:" for name in names))
    harmless = tuple(prefix + kind for prefix in prefixes for kind in ("property", "arg"))
    left = [element.tag for element in robot.iter() if element.tag.startswith(prefixes)]
    left = [tag for tag in left if tag not in harmless]
    for part in (*robot.findall("link"), *robot.findall("joint")):
        for element in part.iter():
            for key, text in element.attrib.items():
                if "${" in text or "$(" in text:
                    left.append(text)
                elif key not in _WORDS and _NOT_FINITE.search(text):
                    text = f"{path}: {part.tag} {part.get('name')} has {key}={text!r}, not"
                    raise ValueError(f"{text} finite numbers")
    if left:
        raise ValueError(f"{path} holds {left[0]}: expand it with xacro first")


class _Reader:
    def __init__(self, path: Path, robot: ElementTree.Element):
        self.path = path
        self.missing: list[str] = []
        self.materials = {
            material.get("name"): colour
            for material in robot.iter("material")
            if (colour := self._colour(material)) is not None
        }
        ros = [Path(p) for p in os.environ.get("ROS_PACKAGE_PATH", "").split(":") if p]
        self.folders = [*path.resolve().parents, *ros]

    def link(self, element: ElementTree.Element) -> Link:
        name = self._attribute(element, "name", "a link")
        mass, value = element.find("inertial/mass"), None
        if mass is not None:
            value = self._number(mass, "value", f"mass of link {name}")
            if value < 0:
                raise ValueError(f"{self.path}: link {name} has the negative mass {value:g} kg")
        return Link(
            name=name,
            mass=value,
            inertia=None if value is None else self._inertia(element, value, name),
            visuals=self._shapes(element, "visual", name),
            collisions=self._shapes(element, "collision", name),
        )

    def _inertia(
        self, element: ElementTree.Element, mass: float, name: str
    ) -> Transform | None:
        """Pseudo-inertia of a link; None where the file gives only the mass."""
        moments, inertial = element.find("inertial/inertia"), element.find("inertial")
        if moments is None or inertial is None:
            return None
        what = f"inertia of link {name}"
        xx, xy, xz, yy, yz, zz = (
            self._number(moments, key, what)
            for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        )
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        pose = self._origin(inertial, what)
        return pose @ pseudo_inertia(mass, (0.0, 0.0, 0.0), inertia) @ pose.T

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
        bounds, follows = {}, None
        if limit is not None:
            # A continuous joint has no position limits, even if the file gives some.
            keys = ("velocity", "effort") if kind == "continuous" else _BOUNDS
            for key in keys:
                if limit.get(key) is not None:
                    bounds[key] = self._number(limit, key, f"limit of joint {name}")
        if mimic is not None:
            what = f"<mimic> of joint {name}"
            factor = float(self._numbers(mimic, "multiplier", (1.0,), what, 1)[0])
            offset = float(self._numbers(mimic, "offset", (0.0,), what, 1)[0])
            follows = (self._attribute(mimic, "joint", what), factor, offset)
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
                file = self._attribute(geometry, "filename", what)
                x, y, z = self._numbers(geometry, "scale", (1.0, 1.0, 1.0), what).tolist()
                if path := self._mesh(file):
                    shapes.append(Shape(kind="mesh", path=path, scale=(x, y, z), **place))
                else:
                    self.missing.append(file)
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

    def _mesh(self, name: str) -> Path | None:
        scheme, _, place = name.rpartition("://")
        if scheme in ("package", "model"):
            package, _, rest = place.partition("/")
            tried = [folder / package / rest for folder in self.folders]
            tried += [f / rest for f in self.folders if f.name == package]
        else:
            tried = [self.path.parent / place]
        return next((path for path in tried if os.path.isfile(path)), None)

    def _origin(self, element: ElementTree.Element, what: str) -> Transform:
        origin = element.find("origin")
        if origin is None:
            return np.eye(4)
        zero = (0.0, 0.0, 0.0)
        x, y, z = np.eye(3)
        roll, pitch, yaw = self._numbers(origin, "rpy", zero, what)
        # Rotations about the fixed axes x, y and z, in this order.
        turn = motion("revolute", z, yaw) @ motion("revolute", y, pitch)
        pose = turn @ motion("revolute", x, roll)
        pose[:3, 3] = self._numbers(origin, "xyz", zero, what)
        return pose

    def _colour(self, material: ElementTree.Element) -> Colour | None:
        colour = material.find("color")
        if colour is None:
            return None
        r, g, b, a = self._numbers(colour, "rgba", None, "a colour", 4).tolist()
        return (r, g, b, a)

    def _attribute(self, element: ElementTree.Element, key: str, what: str) -> str:
        value = element.get(key)
        if not value:
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
        if element.get(key) is None and default is not None:
            return np.array(default)
        text = self._attribute(element, key, what)
        try:
            values = [float(word) for word in text.split()]
        except ValueError:
            values = []
        # Python allows "_" between digits, URDF does not.
        if "_" in text or len(values) != count or not all(map(math.isfinite, values)):
            text = f"{self.path}: {what} has {key}={text!r}, not {count} finite number"
            raise ValueError(f"{text}{'s' if count > 1 else ''}")
        return np.array(values)
