"""Arms from descriptions in URDF and MJCF files, with links numbered from base to tool."""

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import quaternion
from hrc_learn.geometry.shapes import Colour, MeshFile
from hrc_learn.kinematics.arm import Arm, ArmShape, FingerJoint
from hrc_learn.kinematics.chain import JointKind, SerialChain
from hrc_learn.kinematics.collision import LinkCapsule
from hrc_learn.kinematics.description import (
    MOVING,
    Description,
    Joint,
    Shape,
    Transform,
    motion,
    turn_to,
)
from hrc_learn.kinematics.limits import JointLimits, complete_limits, read_limits
from hrc_learn.kinematics.mjcf import read_mjcf
from hrc_learn.kinematics.urdf import read_urdf

type LimitsGiven = Mapping[str, Mapping[str, float]] | Path | None
"""Limits that replace or complete those of a file (see `complete_limits`), or a TOML file."""

type FittedBody = tuple[Sequence[LinkCapsule], Sequence[tuple[int, int]]]
"""Capsules of an arm, and pairs of links that overlap by design, besides neighbours."""

_GREY: Colour = (0.7, 0.7, 0.72, 1.0)
# Number of finger positions, from closed to open, that the capsules contain.
_FINGER_POSTURES = 5


def read_description(path: Path) -> Description:
    """Read a robot description; the first element of the file shows if it is URDF or MJCF.

    Raises:
        ValueError: The file is neither URDF nor MJCF, or its links form no tree.
        FileNotFoundError: There is no such file.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no robot description {path}")
    text = re.sub(rb"<!--.*?-->", b"", path.read_bytes(), flags=re.DOTALL)
    first = re.search(rb"<([A-Za-z_][\w.:-]*)", text)
    is_mjcf = first is not None and first[1].startswith(b"mujoco")
    return read_mjcf(path) if is_mjcf else read_urdf(path)


def arm_from_file(
    path: Path,
    *,
    base: str | None = None,
    tip: str | None = None,
    name: str | None = None,
    tool: Float[Tensor, "4 4"] | None = None,
    limits: LimitsGiven = None,
    ready: Sequence[float] | None = None,
    body: FittedBody | None = None,
    base_turn: float = 0.0,
) -> Arm:
    """An arm from a URDF or MJCF file.

    Links that are moved by joints beyond the arm's last joint form the gripper. They belong to
    the tool, as does a hand that carries only the fingers. If moving joints branch off earlier,
    their links are left out.

    Args:
        path: The file.
        base: Link (URDF) or body (MJCF) of the base; None: the root (URDF) or world (MJCF).
        tip: Link, body or site of the flange; None: the only end of the arm, apart from the
            gripper.
        name: Name of the arm; None: the stem of the file.
        tool: Tool centre point in the frame of the flange, z in the direction of approach;
            None: the flange itself.
        limits: Limits that replace or complete those of the file; None: the TOML file with the
            same stem, `ur5e.limits.toml` for `ur5e.urdf`, if there is one.
        ready: A comfortable posture [rad, m]; None: the file's `home`, or without it a random
            posture that is far from limits and singularities.
        body: Capsules and overlapping links; None fits capsules on first use.
        base_turn: Turn of the base link about its z axis, for a file whose arm does not extend
            along the x axis [rad].

    Raises:
        ValueError: The format is unknown, the links form no serial chain, or `ready` is outside
            the limits.
        FileNotFoundError: The file is missing.
    """
    description = read_description(path)
    base, tip, joints = description.path_between(base, tip)
    moving = [joint for joint in joints if joint.kind in MOVING]
    kinds: list[JointKind] = [cast(JointKind, joint.kind) for joint in moving]
    places, mounts = _places(description, base, moving, base_turn)
    flange = places[tip][1]
    tcp = np.eye(4) if tool is None else tool.double().numpy()
    if limits is None and (sidecar := path.with_suffix(".limits.toml")).is_file():
        limits = sidecar
    names = [joint.name for joint in moving]
    chain_limits = complete_limits(
        names,
        kinds,
        [
            {"lower": j.lower, "upper": j.upper, "velocity": j.velocity, "torque": j.effort}
            for j in moving
        ],
        source=str(path),
        overrides=read_limits(limits) if isinstance(limits, Path) else limits,
    )
    posture = _ready(description, names, chain_limits, ready)
    chain = SerialChain(
        joint_names=names,
        mounts=torch.from_numpy(np.stack(mounts)),
        flange=torch.from_numpy(flange),
        tcp=torch.from_numpy(tcp),
        limits=chain_limits,
        ready=chain_limits.middle if posture is None else posture,
        kinds=kinds,
    )
    if posture is None:
        chain.ready = _comfortable(chain)
    capsules, overlapping = body or (None, ())
    return Arm(
        name=name or path.stem,
        chain=chain,
        shape=_shape(description, places, joints, np.linalg.inv(flange @ tcp)),
        capsules=capsules,
        overlapping=overlapping,
        description=path,
        base=base,
        tip=tip,
    )


def _ready(
    description: Description,
    names: Sequence[str],
    limits: JointLimits,
    given: Sequence[float] | None,
) -> Float[Tensor, " joints"] | None:
    """Ready posture [rad, m]: the given posture, or the file's `home`; None: neither exists."""
    home = description.home or {}
    if given is None:
        if any(name not in home for name in names):
            return None
        ready = torch.tensor([home[name] for name in names], dtype=torch.float64)
        if not limits.contain(ready):
            warnings.warn(
                f"{description.path}: the posture `home` is outside the limits of its joints "
                "and was moved to them",
                stacklevel=3,
            )
        return ready.clamp(limits.lower, limits.upper)
    ready = torch.as_tensor(given, dtype=torch.float64)
    if len(ready) == len(names) and not limits.contain(ready):
        wrong = next(
            i for i, x in enumerate(ready) if not limits.lower[i] <= x <= limits.upper[i]
        )
        text = f"ready posture: joint {names[wrong]} at {ready[wrong]:g} is outside its limits"
        raise ValueError(f"{text} {limits.lower[wrong]:g} to {limits.upper[wrong]:g}")
    return ready


def _places(
    description: Description, base: str, moving: Sequence[Joint], base_turn: float
) -> tuple[dict[str, tuple[int, Transform]], list[Transform]]:
    """Frame number and pose of each link, and mounts of the moving joints.

    The frame with this number carries the link, and the pose is relative to this frame.
    """
    turned = motion("revolute", np.array([0.0, 0.0, 1.0]), base_turn)
    subtree = description.rigid_subtree(base)
    places = {name: (0, turned @ pose) for name, pose in subtree.items()}
    mounts = []
    for number, joint in enumerate(moving, start=1):
        turn = turn_to(joint.axis)
        mounts.append(places[joint.parent][1] @ joint.origin @ turn)
        for name, pose in description.rigid_subtree(joint.child).items():
            places[name] = (number, turn.T @ pose)
    return places, mounts


def _shape(
    description: Description,
    places: dict[str, tuple[int, Transform]],
    path: Sequence[Joint],
    to_tool: Transform,
) -> ArmShape:
    """Meshes, collision shapes, gripper and masses.

    Args:
        description: The tree.
        places: Number of the frame that carries each link, and the link's pose there.
        path: Joints from base to tip.
        to_tool: Frame of the last joint in the frame of the tool.
    """
    last = max(number for number, _ in places.values())
    moved = next(joint for joint in reversed(path) if joint.kind in MOVING).child
    roots = [
        joint
        for link, (number, _) in places.items()
        if number == last
        for joint in description.below(link)
        if joint.kind in MOVING and joint not in path
    ]
    at_last = dict(places)  # a hand may carry another hand
    for hand in {joint.parent for joint in roots} - {moved}:
        pose = to_tool @ at_last[hand][1]
        for link, within in description.rigid_subtree(hand).items():
            places[link] = (last + 2, pose @ within)
    shapes = [
        (number, replace(shape, pose=pose @ shape.pose))
        for link, (number, pose) in places.items()
        for shape in _touching(description, link)
    ]
    bodies = dict(places)
    gripper = []
    # Rows of `ahead`: a joint; the pose of its parent link in the tool's frame, with an open
    # gripper; the gripper's joint that carries the parent, or None; the parent's pose in the
    # frame of this carrier, or in the tool's frame if there is no carrier.
    ahead: list[tuple[Joint, Transform, str | None, Transform]] = [
        (joint, at, None, at)
        for joint in roots
        for number, pose in [places[joint.parent]]
        for at in [pose if number > last else to_tool @ pose]
    ]
    for joint, parent, carrier, place in ahead:
        finger, postures = _finger(joint, parent)
        child = description.rigid_subtree(joint.child)
        drawn = {link: (0, pose) for link, pose in child.items()}
        meshes = _meshes(description, drawn, 0).get("link0", ())
        mount = place @ joint.origin
        gripper.append(replace(finger, carrier=carrier, mount=mount, meshes=meshes))
        for link, within in child.items():
            bodies[link] = (last + 2, postures[-1] @ within)
            shapes += [
                (last + 2, replace(shape, pose=at @ within @ shape.pose))
                for shape in _touching(description, link)
                for at in postures
            ]
            further = [below for below in description.below(link) if below.kind in MOVING]
            opened = postures[-1] @ within
            ahead += [(below, opened, joint.name, within) for below in further]
    hand = {link: (0, pose) for link, (number, pose) in places.items() if number > last}
    return ArmShape(
        meshes=_meshes(description, places, last),
        gripper=tuple(gripper),
        hand=_meshes(description, hand, 0).get("link0", ()),
        shapes=tuple(shapes),
        **_inertias(description, bodies, last),
    )


def _finger(joint: Joint, parent: Transform) -> tuple[FingerJoint, list[Transform]]:
    """A joint of the gripper, and its child's poses in the tool's frame as the joint opens.

    Args:
        joint: The joint.
        parent: Pose of the joint's parent link in the frame of the tool.
    """
    lower, upper = joint.lower or 0.0, joint.upper or 0.0
    closed, opened = (lower, upper) if abs(upper) >= abs(lower) else (upper, lower)
    poses = [
        parent @ joint.origin @ motion(joint.kind, joint.axis, value)
        for value in np.linspace(closed, opened, _FINGER_POSTURES).tolist()
    ]
    kind = "prismatic" if joint.kind == "prismatic" else "revolute"
    x, y, z = joint.axis.tolist()
    finger = FingerJoint(joint.name, kind, closed, opened, joint.follows, axis=(x, y, z))
    return finger, poses


def _meshes(
    description: Description, places: dict[str, tuple[int, Transform]], last: int
) -> dict[str, tuple[MeshFile, ...]]:
    """Meshes of links up to number `last`, by the name of the link (link0, ...)."""
    found: dict[str, tuple[MeshFile, ...]] = {}
    for link, (number, place) in places.items():
        for shape in description.links[link].visuals:
            if shape.path is not None and number <= last:
                pose = place @ shape.pose
                x, y, z = pose[:3, 3].tolist()
                turn = quaternion.from_matrix(torch.from_numpy(pose[:3, :3].copy()))
                w, i, j, k = turn.tolist()
                mesh = MeshFile(
                    path=shape.path,
                    position=(x, y, z),
                    orientation=(w, i, j, k),
                    scale=shape.scale,
                    colour=shape.colour or _GREY,
                )
                name = f"link{number}"
                found[name] = (*found.get(name, ()), mesh)
    return found


def _touching(description: Description, link: str) -> tuple[Shape, ...]:
    """Collision shapes of a link, or its visual shapes if it has none."""
    found = description.links[link]
    return found.collisions or found.visuals


def _inertias(
    description: Description, bodies: Mapping[str, tuple[int, Transform]], last: int
) -> dict[str, Any]:
    """Masses and pseudo-inertias of base, links, flange and tool, as fields of `ArmShape`; None
    where the description has none.
    """
    masses: list[float | None] = [None] * (last + 3)
    inertia: list[np.ndarray | None] = [None] * (last + 3)
    for name, (number, pose) in bodies.items():
        link = description.links[name]
        if link.mass is not None:
            masses[number] = (masses[number] or 0.0) + link.mass
        if link.inertia is not None:
            more, before = pose @ link.inertia @ pose.T, inertia[number]
            inertia[number] = more if before is None else before + more
    # The frame of the flange carries no bodies. Without a gripper, the tool's frame carries no
    # bodies either.
    for number in {last + 1, last + 2} - {number for number, _ in bodies.values()}:
        masses[number], inertia[number] = 0.0, np.zeros((4, 4))
    return {"masses": tuple(masses), "inertia": tuple(inertia)}


# Number and seed of the random postures among which `_comfortable` chooses.
_POSTURES, _SEED = 4096, 0


def _comfortable(chain: SerialChain) -> Float[Tensor, " joints"]:
    """Default ready posture [rad, m].

    It is the random posture with the highest sum of four scores, each at most one. The scores
    are high if the posture is far from singularities, if it is far from limits, if the tool
    points down, and if the tool is in front of the base at half of its reach.
    """
    rng = torch.Generator().manual_seed(_SEED)
    lower, upper = chain.limits.lower, chain.limits.upper
    # A joint with a range above one revolution is sampled around the middle of the range.
    half = ((upper - lower) / 2).clamp(max=torch.pi)
    random = torch.rand(_POSTURES, len(lower), generator=rng, dtype=torch.float64)
    q = chain.limits.middle + (2 * random - 1) * half
    T, J = chain.transform_and_jacobian(q)
    smallest = torch.linalg.svdvals(J)[:, -1]
    position = T[:, :3, 3]
    reach = torch.linalg.vector_norm(position, dim=-1).amax()
    wanted = torch.stack([reach / 2, 0 * reach, reach / 4])
    away = torch.linalg.vector_norm(position - wanted, dim=-1) / reach
    margin = (torch.minimum(q - lower, upper - q) / half).amin(-1)
    score = smallest / smallest.amax() + margin.clamp(max=1) - T[:, 2, 2] - away
    return q[score.argmax()]
