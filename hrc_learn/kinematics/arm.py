"""Everything that the rest of the package needs to know of a robot arm, from its description.

The frames of an arm's links are those of `SerialChain`: each joint's z axis is that along or
about which it moves, so they may be turned against the frames of the file by a constant, which
is taken into account wherever something is mounted on a link.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import Pose
from hrc_learn.kinematics._assembly import (
    GripperDescription,
    LinkShape,
    LinkVisual,
    assemble,
)
from hrc_learn.kinematics._capsule_fit import fit_body
from hrc_learn.kinematics._description import Description
from hrc_learn.kinematics._mjcf import read_mjcf
from hrc_learn.kinematics._urdf import read_urdf
from hrc_learn.kinematics.chain import SerialChain
from hrc_learn.kinematics.collision import CapsuleArm
from hrc_learn.kinematics.franka import UnreachableError
from hrc_learn.kinematics.inverse import TaskSpace, solve_inverse
from hrc_learn.kinematics.limits import complete_limits, read_limits

type LimitsGiven = Mapping[str, Mapping[str, float]] | Path | None
"""Limits that replace or complete those of a description, see `complete_limits`, or a file."""

# Of arms whose description gives no masses, of the capsules' volume: a guess, a little above
# water, for aluminium shells with motors and gears in them.
_DENSITY = 1200.0  # [kg/m^3]


@dataclass(frozen=True, kw_only=True, eq=False)
class Arm:
    """A serial arm: its kinematics, its shape, its gripper."""

    name: str
    """Registered name, or the stem of the file."""
    chain: SerialChain
    """From the base to the tool centre point, with limits and a posture to start from."""
    visuals: tuple[LinkVisual, ...] = ()
    """Its real shape; empty where the package that ships the meshes is not installed."""
    gripper: GripperDescription | None = None
    """None: the description ends at the flange."""
    description: Path | None = None
    """File it comes from; None: written in this package."""
    format: str | None = None
    """"urdf" or "mjcf", of the file."""
    base: str | None = None
    """Link of the file that is the base."""
    tip: str | None = None
    """Link of the file that is the flange."""
    shapes: tuple[LinkShape, ...] = field(default=(), repr=False)
    """What the capsules of `body` contain."""
    told_masses: tuple[float | None, ...] = field(default=(), repr=False)
    """Of base, links, flange and tool [kg], where the description tells."""
    own_body: CapsuleArm | None = field(default=None, repr=False)
    """Capsules made by hand, in place of fitted ones."""

    def __repr__(self) -> str:
        return f"Arm({self.name}, {len(self.joint_names)} joints)"

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Of the chain, from the base to the tool."""
        return self.chain.joint_names

    @property
    def tool_link(self) -> int:
        """Number of the tool centre point's frame."""
        return len(self.joint_names) + 2

    @cached_property
    def body(self) -> CapsuleArm:
        """Capsules that contain each link, with the pairs of links that may touch.

        Fitted when first asked for, which takes a few seconds.
        """
        if self.own_body is not None:
            return self.own_body
        return fit_body(self.chain, [(s.link, s.shape, s.pose) for s in self.shapes])

    @cached_property
    def reach(self) -> float:
        """How far the tool centre point gets from joint 2 [m], as far as random states tell."""
        limits, rng = self.chain.limits, torch.Generator().manual_seed(0)
        share = torch.rand(5000, len(self.joint_names), generator=rng, dtype=torch.float64)
        q = limits.lower + (limits.upper - limits.lower) * share
        apart = self.chain.forward(q).position - self.chain.joint_origins(q)[:, 1]
        return float(torch.linalg.vector_norm(apart, dim=-1).max())

    @cached_property
    def masses(self) -> tuple[float, ...]:
        """Of base, links, flange and tool [kg].

        Where the description has none, 1200 kg/m^3 times the volume of the link's capsules.
        """
        count = len(self.joint_names) + 3
        told = self.told_masses or (None,) * count
        if all(mass is not None for mass in told):
            return tuple(mass or 0.0 for mass in told)
        estimated = [0.0] * count
        for capsule in self.body.capsules:
            length = float(np.linalg.norm(np.subtract(capsule.end, capsule.start)))
            volume = np.pi * capsule.radius**2 * (length + 4 / 3 * capsule.radius)
            estimated[capsule.link] += _DENSITY * volume
        return tuple(
            guess if mass is None else mass for mass, guess in zip(told, estimated, strict=True)
        )

    def inverse(
        self,
        pose: Pose,
        near: Float[Tensor, "*#batch joints"] | None = None,
        *,
        task: TaskSpace = "pose",
    ) -> Float[Tensor, "*batch joints"]:
        """Joint positions that bring the tool centre point to poses, within limits [rad, m].

        Numerically, many poses at once (`solve_inverse`, which also tells what was not found).

        Args:
            pose: Of the tool centre point in the base frame.
            near: Configuration to stay close to; the ready posture if None.
            task: What of the pose matters: an arm of five joints has none for a whole pose.

        Raises:
            UnreachableError: No such positions were found; names the first such pose.
        """
        solution = solve_inverse(self.chain, pose, near, task=task)
        if not bool(solution.found.all()):
            first = tuple((~solution.found).nonzero()[0].tolist())
            position = pose.position.expand(*solution.found.shape, 3)[first].tolist()
            raise UnreachableError(
                f"no joint positions within the limits of {self.name} were found for pose "
                f"{list(first)} of {list(solution.found.shape)}, position {position} m, "
                f"task {task!r}: move it closer to the base, turn it, or ask for less of it"
            )
        return solution.position

    def with_tool(self, tcp: Float[Tensor, "4 4"]) -> Arm:
        """The same arm with another tool centre point.

        Args:
            tcp: In the frame of the flange.
        """
        old = self.chain
        chain = SerialChain(
            joint_names=old.joint_names,
            mounts=old.mounts,
            flange=old.flange,
            tcp=tcp,
            limits=old.limits,
            ready=old.ready,
            kinds=old.kinds,
        )
        tool = self.tool_link
        shift = torch.linalg.inv(tcp.double()) @ old.tcp
        moved = shift.numpy()
        grip = self.gripper and GripperDescription(
            joints=tuple(replace(j, pose=moved @ j.pose) for j in self.gripper.joints)
        )

        def carry(part: Any) -> Any:
            return replace(part, pose=moved @ part.pose) if part.link == tool else part

        return replace(
            self,
            chain=chain,
            visuals=tuple(carry(visual) for visual in self.visuals),
            shapes=tuple(carry(shape) for shape in self.shapes),
            gripper=grip,
            own_body=self.own_body and self.own_body.on_chain(chain, {tool: shift}),
        )

    @classmethod
    def from_urdf(
        cls,
        path: str | Path,
        *,
        base: str | None = None,
        tip: str | None = None,
        package_dirs: Sequence[str | Path] = (),
        meshes: bool = True,
        **options: Any,
    ) -> Arm:
        """An arm from a URDF file.

        Args:
            path: Of the file.
            base: Link to be the base; None: the root.
            tip: Link to be the flange; None: the only end that the robot has.
            package_dirs: Folders in which `package://NAME/` is looked for first.
            meshes: Whether to look for meshes; without, the arm has a shape only as far as the
                file describes it by boxes, cylinders and spheres.
            options: `name`, `tool`, `limits` and `ready`, see `from_description`.

        Raises:
            ValueError: The file or the choice of links makes no serial chain: see the message.
            FileNotFoundError: The file or a mesh is not there.
        """
        folders = [Path(folder) for folder in package_dirs]
        description = read_urdf(Path(path), folders, meshes=meshes)
        return cls.from_description(description, base=base, tip=tip, **options)

    @classmethod
    def from_mjcf(
        cls,
        path: str | Path,
        *,
        base: str | None = None,
        tip: str | None = None,
        **options: Any,
    ) -> Arm:
        """An arm from an MJCF file, which MuJoCo reads; arguments as for `from_urdf`.

        Bodies and sites are what `base` and `tip` name; without a base it is the world.
        """
        return cls.from_description(read_mjcf(Path(path)), base=base, tip=tip, **options)

    @classmethod
    def from_package(cls, package: str, model: str, **options: Any) -> Arm:
        """An arm of the packages that fetch models over the network when first used.

        Args:
            package: `robot_descriptions` or `mujoco_menagerie`.
            model: Module of the former, such as `ur10e_description`, or folder of the latter,
                such as `universal_robots_ur10e`.
            options: As for `from_urdf` or `from_mjcf`.

        Raises:
            ModuleNotFoundError: The package is not installed.
            ValueError: It has no such model.
        """
        path = _path_from_package(package, model)
        read = cls.from_mjcf if path.suffix == ".xml" else cls.from_urdf
        return read(path, **{"name": model, **options})

    @classmethod
    def from_description(
        cls,
        description: Description,
        *,
        base: str | None = None,
        tip: str | None = None,
        name: str | None = None,
        tool: Float[Tensor, "4 4"] | None = None,
        limits: LimitsGiven = None,
        ready: Sequence[float] | None = None,
    ) -> Arm:
        """An arm from what a file was read as.

        Args:
            description: Of the robot.
            base: Link to be the base; None: the root.
            tip: Link to be the flange; None: the only end that the robot has.
            name: Of the arm; None: the stem of the file.
            tool: Tool centre point in the frame of the flange, whose z axis is to be the
                direction in which the tool approaches things; None: the flange itself.
            limits: What replaces or completes the file's limits; None: the TOML file beside
                the description named after it, `ur5e.limits.toml` for `ur5e.urdf`, if it is
                there.
            ready: A comfortable posture [rad, m]; None: the file's `home`, or one in the middle
                of the joints' ranges that is far from singularities.
        """
        parts = assemble(description, base, tip, tool)
        chain_limits = complete_limits(
            [joint.name for joint in parts.moving],
            parts.kinds,
            [
                {
                    "lower": joint.lower,
                    "upper": joint.upper,
                    "velocity": joint.velocity,
                    "torque": joint.effort,
                }
                for joint in parts.moving
            ],
            source=str(description.path),
            overrides=_overrides(description.path, limits),
        )
        names = [joint.name for joint in parts.moving]
        home = description.home
        if ready is None and home is not None and all(n in home for n in names):
            ready = [home[n] for n in names]
        chain = SerialChain(
            joint_names=names,
            mounts=torch.from_numpy(parts.mounts),
            flange=torch.from_numpy(parts.flange),
            tcp=torch.from_numpy(parts.tcp),
            limits=chain_limits,
            ready=chain_limits.middle if ready is None else torch.tensor(ready).double(),
            kinds=parts.kinds,
        )
        if ready is None:
            chain.ready = comfortable(chain)
        return cls(
            name=name or description.path.stem,
            chain=chain,
            visuals=parts.visuals,
            gripper=parts.gripper,
            description=description.path,
            format=description.format,
            base=parts.base,
            tip=parts.tip,
            shapes=parts.shapes,
            told_masses=parts.masses,
        )


def _overrides(path: Path, given: LimitsGiven) -> Mapping[str, Mapping[str, float]] | None:
    if given is None:
        beside = path.with_suffix(".limits.toml")
        return read_limits(beside) if beside.is_file() else None
    return read_limits(given) if isinstance(given, Path) else given


# Of the random postures among which `comfortable` chooses; the choice is the same every time.
_POSTURES, _SEED = 4096, 0


def comfortable(chain: SerialChain) -> Float[Tensor, " joints"]:
    """A posture to start from where nobody has chosen one [rad, m].

    Of random postures the one with most of four things, each at most one: distance from
    singularities, distance from limits, the tool pointing down, and the tool in front of the
    base, at half of its reach.
    """
    rng = torch.Generator().manual_seed(_SEED)
    lower, upper = chain.limits.lower, chain.limits.upper
    # Joints of more than a turn are as well used around their middle.
    half = ((upper - lower) / 2).clamp(max=torch.pi)
    random = torch.rand(_POSTURES, len(lower), generator=rng, dtype=torch.float64)
    q = chain.limits.middle + (2 * random - 1) * half
    T, J = chain.transform_and_jacobian(q)
    smallest = torch.linalg.svdvals(J)[:, -1]
    position = T[:, :3, 3]
    reach = torch.linalg.vector_norm(position, dim=-1).amax()
    wanted = torch.stack([reach / 2, 0 * reach, reach / 4])
    away = torch.linalg.vector_norm(position - wanted, dim=-1) / reach
    room = (torch.minimum(q - lower, upper - q) / half).amin(-1)
    score = smallest / smallest.amax() + room.clamp(max=1) - T[:, 2, 2] - away
    return q[score.argmax()]


def _path_from_package(package: str, model: str) -> Path:
    """File of a model, fetched by its package where it is not here yet."""
    try:
        if package == "robot_descriptions":
            found = import_module(f"robot_descriptions.{model}")
            path = getattr(found, "URDF_PATH", None) or getattr(found, "MJCF_PATH", None)
        elif package == "mujoco_menagerie":
            path = import_module("mujoco_menagerie").get_model_path(model)
        else:
            raise ValueError(
                f"models are fetched by robot_descriptions or mujoco_menagerie, not {package!r}"
            )
    except ModuleNotFoundError as error:
        if error.name == package:
            raise ModuleNotFoundError(
                f"{model} comes with the package {package.replace('_', '-')}: pip install it",
                name=package,
            ) from None
        raise ValueError(f"{package} has no model {model!r}") from None
    if path is None:
        raise ValueError(f"{package} has neither URDF nor MJCF of {model!r}")
    return Path(path)
